"""The float network and its INT8 version on the same pairs."""

from __future__ import annotations

import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import ModelError
from trigpoint.models.inputs import to_tensor
from trigpoint.models.local import Extraction, FeatureNetwork
from trigpoint_db.quantize.accuracy import Agreement, compare, match_warped, score_poses
from trigpoint_db.quantize.network import fit
from trigpoint_db.quantize.pairs import View, Warped

Array = NDArray[np.float64]
Networks = tuple[FeatureNetwork, FeatureNetwork]  # fp32, INT8

_NUM_RESAMPLES = 1000


@dataclass(frozen=True)
class Score:
    """The mean of a score over the same pairs with both networks; more is better.

    `loss` is the share of fp32's that INT8 lacks; `noise` is what the draw of the pairs makes of
    it: the bootstrap's standard error of the paired loss.
    """

    name: str
    num_pairs: int
    fp32: float
    int8: float
    loss: float
    noise: float
    is_gate: bool

    @classmethod
    def of(cls, name: str, fp32: Array, int8: Array, *, is_gate: bool = True) -> Score:
        """Summarise the scores (P,) of each pair."""
        lost = (fp32 - int8) / max(float(fp32.mean()), 1e-9)
        drawn = np.random.default_rng(0).integers(len(lost), size=(_NUM_RESAMPLES, len(lost)))
        noise = float(lost[drawn].mean(axis=1).std())
        means = float(fp32.mean()), float(int8.mean())
        return cls(name, len(lost), *means, float(lost.mean()), noise, is_gate)


@dataclass(frozen=True)
class Comparison:
    """Scores, likeness and medians of the time of a run on one thread, fp32's and INT8's."""

    scores: tuple[Score, ...]
    agreement: Agreement
    latency_ms: tuple[float, float]


def compare_networks(
    networks: Networks,
    warped: Sequence[Warped],
    posed: Mapping[str, Sequence[tuple[View, View]]],
    num_runs: int,
) -> Comparison:
    """Match warped pairs, find relative poses of sets of posed pairs, and take the time."""
    features = [_extract(network, warped) for network in networks]
    matched = [match_warped(warped, each) for each in features]
    if not matched[0].correct.any():
        raise ModelError("the float network matches nothing on these images: nothing to compare")
    # A keypoint of fp32 is what both are measured by: finding fewer of them is a loss, too.
    visible = np.maximum(matched[0].visible, 1)
    fp32, int8 = matched
    scores = [
        Score.of("matching score", fp32.correct / visible, int8.correct / visible),
        Score.of("corner AUC at 3 px", fp32.corner_score, int8.corner_score, is_gate=False),
    ]
    for name, pairs in posed.items():
        scores.append(Score.of(name, *(score_poses(network, pairs) for network in networks)))
    return Comparison(
        tuple(scores),
        compare(*([first for first, _ in each] for each in features)),
        _time(networks, warped[0], num_runs),
    )


def _extract(
    network: FeatureNetwork, pairs: Sequence[Warped]
) -> list[tuple[Extraction, Extraction]]:
    return [(network.extract(pair.first), network.extract(pair.second)) for pair in pairs]


def _time(networks: Networks, pair: Warped, num_runs: int) -> tuple[float, float]:
    """Return medians of interleaved runs: what slows one down slows down the other."""
    times_ms: tuple[list[float], list[float]] = ([], [])
    for _ in range(num_runs + 2):
        for network, times in zip(networks, times_ms, strict=True):
            tensor = to_tensor(fit(pair.first, network), network.contract)
            start = time.perf_counter()
            network.network.run({"image": tensor})
            times.append(1e3 * (time.perf_counter() - start))
    fp32, int8 = (statistics.median(times[2:]) for times in times_ms)  # the first ones warm up
    return fp32, int8
