"""Which layers stay float: found by measuring what each does to the features."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from trigpoint.models.local import Extraction, FeatureNetwork
from trigpoint_db.quantize.accuracy import compare, match_warped
from trigpoint_db.quantize.comparison import Score
from trigpoint_db.quantize.graph import FloatNetwork, Group
from trigpoint_db.quantize.pairs import Warped

Load = Callable[[bytes], FeatureNetwork]
Track = Callable[[Iterable[Group], str, int], Iterator[Group]]

PERCENTILES = (99.9, 99.99, 100.0)  # of the calibrated values, that a range holds


@dataclass(frozen=True)
class Choice:
    """A quantisation: the percentile of its ranges, and the groups that are 8-bit or float."""

    percentile: float
    quantized: tuple[Group, ...]
    float_groups: tuple[Group, ...]


class Search:
    """Measures candidates against the float network, on pairs of its own.

    Parameters
    ----------
    network : FloatNetwork
        To be quantised.
    reference : FeatureNetwork
        The same as it came.
    load : callable
        Opens the file that `network` gives.
    pairs : sequence of Warped
        The first of each is where features are compared, all are where they are matched.
    """

    def __init__(
        self, network: FloatNetwork, reference: FeatureNetwork, load: Load, pairs: Sequence[Warped]
    ) -> None:
        self._network, self._load, self._pairs = network, load, pairs
        self._reference = self._extract(reference)
        self._correct = match_warped(pairs, self._reference).correct

    def _extract(self, model: FeatureNetwork) -> list[tuple[Extraction, Extraction]]:
        return [(model.extract(pair.first), model.extract(pair.second)) for pair in self._pairs]

    def damage(self, groups: Sequence[Group], percentile: float) -> float:
        """Return how far features move where only these groups are 8-bit."""
        model = self._load(self._network.quantize(groups, percentile))
        features = [model.extract(pair.first) for pair in self._pairs]
        return compare([first for first, _ in self._reference], features).damage

    def loss(self, groups: Sequence[Group], percentile: float) -> float:
        """Return the share of right matches that is lost where these groups are 8-bit.

        With twice the noise on top: it is what one may count on.
        """
        model = self._load(self._network.quantize(groups, percentile))
        correct = match_warped(self._pairs, self._extract(model)).correct
        score = Score.of("", self._correct, correct)
        return score.loss + 2 * score.noise

    def choose(self, max_loss: float, track: Track) -> Choice:
        """Leave in float what it takes for a loss of matches within `max_loss`, and no more.

        Each group is made 8-bit alone. In the order of the damage groups become float again until
        the loss is within the limit; where, bisection finds, since more in float does not lose
        more. Of those, the dearest first, each that can be 8-bit all the same becomes so.
        """
        groups = self._network.groups
        losses = {percentile: self.loss(groups, percentile) for percentile in PERCENTILES}
        percentile = min(losses, key=losses.__getitem__)
        if losses[percentile] <= max_loss:
            return Choice(percentile, groups, ())
        damage = [
            self.damage([group], percentile) for group in track(groups, "layers", len(groups))
        ]
        worst_first = [groups[i] for i in np.argsort(-np.array(damage), kind="stable")]
        too_few, enough = 0, len(groups)
        while enough - too_few > 1:
            middle = (too_few + enough) // 2
            if self.loss(_without(groups, worst_first[:middle]), percentile) <= max_loss:
                enough = middle
            else:
                too_few = middle
        kept = worst_first[:enough]
        for group in sorted(kept, key=lambda group: -group.cost):
            fewer = [other for other in kept if other is not group]
            if self.loss(_without(groups, fewer), percentile) <= max_loss:
                kept = fewer
        return Choice(percentile, _without(groups, kept), tuple(kept))


def _without(groups: Sequence[Group], others: Sequence[Group]) -> tuple[Group, ...]:
    return tuple(group for group in groups if group not in others)
