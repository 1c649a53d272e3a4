"""A picture of several methods' errors over that of one, set by set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from trigpoint_db.figures import make_figure, save_figure, scale_logarithmically


def draw_ratios(
    path: Path,
    sets: Sequence[str],
    ratios: Mapping[str, Sequence[float | None]],
    colors: Mapping[str, str],
    ours: str,
) -> None:
    """Draw each method's median position error over that of `ours`; None where there is none.

    Parameters
    ----------
    path : Path
    sets : sequence of str
        What the rows are called.
    ratios : mapping of str to sequence of float
        For each method, in the order of the sets.
    colors : mapping of str to str
        Of the methods.
    ours : str
        The method that the others are compared with.
    """
    figure = make_figure(8, 1.5 + 0.35 * len(sets))
    axes = figure.subplots()
    for method, values in ratios.items():
        known = {place: value for place, value in enumerate(values) if value is not None}
        axes.plot(
            [*known.values()],
            [*known],
            "|" if method == ours else "o",
            color=colors[method],
            markersize=14 if method == ours else 7,
            label=method,
        )
    axes.set_yticks(range(len(sets)), sets)
    axes.invert_yaxis()
    scale_logarithmically(axes)
    axes.set_xlabel(f"median position error, over that of {ours}")
    axes.grid(axis="x", which="both", alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3)
    save_figure(figure, path)
