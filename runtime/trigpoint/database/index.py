"""An inverted file of the retrieval rows, for maps in which comparing all of them takes long.

The rows are divided among lists, each of those most like one centroid; a search looks at the lists
whose centroids are most like the query (Sivic and Zisserman, ICCV 2003; with k-means over global
descriptors Jegou, Douze and Schmid, PAMI 2011). They lie in the map like everything else, with
checksums and in one commit. `docs/adr/0015-inverted-file.md` says what was measured beside it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from trigpoint.database.retrieval import Retrieval
from trigpoint.database.snapshot import Snapshot, reporting
from trigpoint.database.writer import MapWriter

Array32 = NDArray[np.float32]
Index = NDArray[np.intp]

MIN_ROWS = 50_000  # with fewer, comparing all takes but some milliseconds
_SAMPLES_PER_LIST = 40
_NUM_ITERATIONS = 8
_CHUNK = 4096  # rows that are compared with all centroids at once


def build_index(path: Path, track: Callable[[range], Iterable[int]] = iter) -> int:
    """Write an index of all rows into a map, in one commit; returns how many lists it has.

    An older index is replaced. It takes as much memory as the rows do on disk. `track` shows
    progress, list by list.
    """
    with reporting(path), closing(Snapshot(path)) as snapshot:
        model = snapshot.metadata.model
    with MapWriter.open(path, model) as writer:
        with reporting(path), closing(Snapshot(path)) as snapshot:
            rows, num_rows = Retrieval(snapshot), snapshot.metadata.num_images
            if num_rows == 0:
                return 0
            centroids = _find_centroids(rows, num_rows)
            nearest = np.concatenate([assign(b.descriptors, centroids) for b in rows.blocks()])
            used, list_of = np.unique(nearest, return_inverse=True)
            ends = np.cumsum(np.bincount(list_of))
            members = np.split(np.argsort(list_of, kind="stable"), ends[:-1])
            lists = ((members[i], rows.gather(members[i])) for i in track(range(len(used))))
            writer.put_index(num_rows, centroids[used], lists)
        return len(used)


def _find_centroids(rows: Retrieval, num_rows: int) -> Array32:
    num_lists = math.ceil(4 * math.sqrt(num_rows))
    num_samples = min(num_rows, _SAMPLES_PER_LIST * num_lists)
    sample = np.random.default_rng(0).choice(num_rows, num_samples, replace=False)
    return cluster(rows.descriptors(sample), num_lists)


def cluster(samples: Array32, num_lists: int) -> Array32:
    """Return centroids (L, G), unit vectors, of samples (N, G): spherical k-means.

    It begins with the first samples. One that no sample is nearest to stays where it is.
    """
    centroids = np.resize(samples, (num_lists, samples.shape[1]))
    ones = np.ones(len(samples), np.float32)
    for _ in range(_NUM_ITERATIONS):
        nearest = assign(samples, centroids)
        members = csr_array((ones, (nearest, np.arange(len(samples)))), (num_lists, len(samples)))
        sums = members @ samples
        norms = np.linalg.norm(sums, axis=1, keepdims=True)
        centroids = np.where(norms > 0, sums / np.maximum(norms, 1e-12), centroids)
    return centroids


def assign(rows: Array32, centroids: Array32) -> Index:
    """Return the most similar centroid of each row (N,)."""
    chunks = (rows[start : start + _CHUNK] for start in range(0, len(rows), _CHUNK))
    return np.concatenate([(chunk @ centroids.T).argmax(axis=1) for chunk in chunks])
