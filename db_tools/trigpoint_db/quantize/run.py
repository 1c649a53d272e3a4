"""Calibrate, choose what stays float, compare with the float network, and keep the file or not."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import ConfigError, ModelError
from trigpoint.images import read_gray
from trigpoint.models.local import FeatureNetwork
from trigpoint.output import check_output
from trigpoint_db.build import check_files
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.quantize.comparison import compare_networks
from trigpoint_db.quantize.graph import FloatNetwork, Group
from trigpoint_db.quantize.network import fit, load_network, make_input
from trigpoint_db.quantize.pairs import (
    View,
    Warped,
    rendered_pairs,
    survey_pairs,
    warp,
)
from trigpoint_db.quantize.report import QuantizationReport
from trigpoint_db.quantize.search import PERCENTILES, Choice, Search, Track

Image = NDArray[np.uint8]
RENDERED = "pose AUC at 10 deg, rendered"
SURVEYED = "pose AUC at 10 deg, surveyed"

_MIN_TO_SPLIT = 8  # images, of which half are kept for the comparison


@dataclass(frozen=True)
class QuantizationOptions:
    """How much may be lost, and how much work goes into knowing it.

    Parameters
    ----------
    max_loss : float
        Of fp32's matching score or pose accuracy, as a share.
    keep_float : bool
        Whether layers may stay float.
    max_images : int
        Read, evenly spaced over all that are given.
    num_warped, num_rendered : int
        Pairs to compare on. Layers are chosen on other warped ones, a quarter as many.
    max_posed_pairs : int
        Of surveyed images.
    num_runs : int
        Of each network for the latency.
    seed : int
        Of all that is drawn.
    """

    max_loss: float = 0.02
    keep_float: bool = True
    max_images: int = 96
    num_warped: int = 120
    num_rendered: int = 240
    max_posed_pairs: int = 400
    num_runs: int = 30
    seed: int = 0


def _untracked(items: Iterable[Group], what: str, total: int) -> Iterator[Group]:
    return iter(items)


def quantize(
    model: Path,
    images: Sequence[Path],
    out: Path,
    *,
    options: QuantizationOptions = QuantizationOptions(),
    posed: tuple[Sequence[PosedImage], Path] | None = None,
    track: Track = _untracked,
) -> QuantizationReport:
    """Quantise a feature network to INT8 and compare the two.

    Parameters
    ----------
    model : Path
        A float network of the dense layout, with its contract.
    images : sequence of Path
        Of the kind that the network will see. The ranges and the layers come from one half, the
        numbers of the report from the other.
    out : Path
        The INT8 network, written only if the report has no `refusal`.
    options : QuantizationOptions
        See there.
    posed : sequence of PosedImage and Path, optional
        Surveyed images and their folder, for pose accuracy on them beside that on rendered ones.
    track : callable
        Shows the progress of the search.

    Returns
    -------
    QuantizationReport
        Deterministic but for the latency, and so is the file.
    """
    check_output(out, model)
    if out.exists():
        raise ConfigError(f"{out} exists; remove it first, or name another file with --out")
    reference = load_network(model)
    chosen, held_out = _read_images(images, reference, options)
    posed_pairs = _pose_pairs(posed, options)
    network = FloatNetwork(model, [make_input(image, reference) for image in chosen])
    with tempfile.TemporaryDirectory() as folder:
        loader = _Loader(Path(folder))
        choice = _choose(network, reference, loader, chosen, options, track)
        data = network.quantize(choice.quantized, choice.percentile)
        comparison = compare_networks(
            (reference, loader(data)),
            _warp(held_out, options.num_warped, options.seed + 1),
            posed_pairs,
            options.num_runs,
        )
    report = QuantizationReport(
        out=str(out),
        max_loss=options.max_loss,
        comparison=comparison,
        num_bytes=(network.num_bytes, len(data)),
        percentile=choice.percentile,
        num_layers=len(network.always_float) + len(network.groups),
        float_layers=network.always_float + tuple(group.name for group in choice.float_groups),
    )
    if report.refusal is None:
        _write(out, data)
    return report


class _Loader:
    """Opens networks by way of files in a folder."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "candidate.onnx"

    def __call__(self, data: bytes) -> FeatureNetwork:
        self._path.write_bytes(data)
        return load_network(self._path)


def _read_images(
    paths: Sequence[Path], model: FeatureNetwork, options: QuantizationOptions
) -> tuple[list[Image], list[Image]]:
    """Read images evenly spaced over all, as the network takes them: to choose, to compare."""
    if not paths:
        raise ConfigError("there are no images to calibrate with")
    spread = np.linspace(0, len(paths) - 1, min(len(paths), options.max_images)).astype(int)
    images = [fit(read_gray(paths[i]), model) for i in spread]
    if len(images) < _MIN_TO_SPLIT:
        return images, images
    return images[::2], images[1::2]


def _pose_pairs(
    posed: tuple[Sequence[PosedImage], Path] | None, options: QuantizationOptions
) -> dict[str, list[tuple[View, View]]]:
    pairs = {}
    if posed is not None:
        check_files((image.name for image in posed[0]), posed[1])
        pairs[SURVEYED] = survey_pairs(*posed, options.max_posed_pairs, options.seed)
    if options.num_rendered:
        pairs[RENDERED] = rendered_pairs(options.num_rendered, options.seed)
    return pairs


def _warp(images: Sequence[Image], num: int, seed: int) -> list[Warped]:
    rng = np.random.default_rng(seed)
    return [warp(images[i % len(images)], rng) for i in range(num)]


def _choose(
    network: FloatNetwork,
    reference: FeatureNetwork,
    loader: _Loader,
    images: Sequence[Image],
    options: QuantizationOptions,
    track: Track,
) -> Choice:
    if not network.groups:
        raise ModelError("the network has no layers that can be 8-bit")
    if not options.keep_float:
        return Choice(PERCENTILES[0], network.groups, ())
    pairs = _warp(images, options.num_warped // 4, options.seed)
    return Search(network, reference, loader, pairs).choose(options.max_loss, track)


def _write(out: Path, data: bytes) -> None:
    partial = out.with_name(f"{out.name}.{os.getpid()}.partial")
    try:
        partial.write_bytes(data)
        partial.rename(out)
    finally:
        partial.unlink(missing_ok=True)
