"""Features of images, extracted here or by workers."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import threadpoolctl

from trigpoint.camera import Camera
from trigpoint.camera_messages import Image
from trigpoint.errors import ConfigError, ModelError, SourceError
from trigpoint.frame import Frame, LocalFeatures, ModelIdentity
from trigpoint.models.features import FeatureModel
from trigpoint_db.messages import read_image
from trigpoint_db.workers import Processes, Workers, do_in_order

if TYPE_CHECKING:
    from trigpoint_db.cluster import Cluster


@dataclass(frozen=True, eq=False)
class EncodedImage:
    """An image as it is stored, and the camera that took it: what goes to a worker."""

    where: str
    name: str
    camera: Camera
    image: Image

    @classmethod
    def read(cls, images: Path, name: str, camera: Camera) -> EncodedImage:
        """Read an image from a folder or from a recording."""
        if images.is_file():
            return cls(f"{images}: {name}", name, camera, read_image(images, name))
        path = images / name
        try:
            return cls(str(path), name, camera, Image(0, "", path.read_bytes()))
        except OSError as error:
            raise SourceError(f"cannot read {path}: {error.strerror}") from error

    def decode(self) -> Frame:
        """Decode it; one that is broken, or not of the camera's size, is an error."""
        try:
            return Frame(self.image.gray(), self.camera, name=self.name)
        except (ConfigError, SourceError) as error:
            raise type(error)(f"{self.where}: {error}") from error

    def __str__(self) -> str:
        return self.where


@dataclass(frozen=True)
class NetworkFiles:
    """How a worker loads the network: a profile in the box or files, and what they have to be."""

    name: str
    retrieval: Path | None  # paths as they are on the worker
    identity: ModelIdentity


@dataclass(frozen=True, eq=False)
class Crew:
    """Workers and the network that they use."""

    workers: Workers
    network: NetworkFiles


@contextmanager
def open_crew(jobs: int, cluster: str | None, network: NetworkFiles) -> Iterator[Crew | None]:
    """Start processes or go to a cluster; None where the work is done by this process alone."""
    if jobs > 1 and cluster is not None:
        raise ConfigError("give --jobs for this machine or --cluster for others, not both")
    if jobs == 1 and cluster is None:
        yield None
        return
    with Processes(jobs) if cluster is None else _join(cluster) as workers:
        yield Crew(workers, network)


def _join(address: str) -> Cluster:
    try:
        from trigpoint_db.cluster import Cluster  # imports distributed, an extra
    except ImportError as error:
        raise ConfigError(
            "--cluster needs the extra `cluster`: pip install 'trigpoint[cluster]'"
        ) from error
    return Cluster(address)


def extract_features(
    images: Iterable[EncodedImage], model: FeatureModel, max_keypoints: int
) -> Iterator[LocalFeatures]:
    """Extract features of images, one by one."""
    return (model.extract(image.decode().image, max_keypoints) for image in images)


def extract_by_workers(
    images: Iterable[EncodedImage], crew: Crew, max_keypoints: int
) -> Iterator[LocalFeatures]:
    """Have workers extract features of images, with the results in their order."""
    work = partial(_extract, crew.network, crew.workers.num_threads, max_keypoints)
    return do_in_order(work, images, crew.workers)


def _extract(
    network: NetworkFiles, num_threads: int, max_keypoints: int, image: EncodedImage
) -> LocalFeatures:
    with _loading:
        model = _load(network, num_threads)
    return model.extract(image.decode().image, max_keypoints)


_loading = threading.Lock()  # a worker may have several threads


@lru_cache(maxsize=1)
def _load(network: NetworkFiles, num_threads: int) -> FeatureModel:
    threadpoolctl.threadpool_limits(1, user_api="blas")  # as in `trigpoint-db` itself
    model = FeatureModel.load(network.name, retrieval=network.retrieval, num_threads=num_threads)
    if model.identity != network.identity:
        raise ModelError(
            f"the network {network.name} on {socket.gethostname()} is another than here, "
            f"{model.identity.sha256[:12]} and {network.identity.sha256[:12]}; "
            "install the same version, or copy the file there"
        )
    return model
