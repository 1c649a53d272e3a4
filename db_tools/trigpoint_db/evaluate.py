"""How far estimated poses are from the true ones: statistics, a table, a picture."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from trigpoint.errors import ConfigError
from trigpoint.rigid import Rigid3, rotation_angle
from trigpoint_db.figures import make_figure, save_figure
from trigpoint_db.importers.colmap import read_model
from trigpoint_db.poses import read_poses, sort_names

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PathCollection
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

# The paper's accuracy levels (its table of Aachen and RobotCar Seasons): metres, degrees.
THRESHOLDS = ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The errors of all queries; where there is no estimate, they are infinite.

    All statistics are over all queries, failures included, but for those named `localized`. A
    percentile is interpolated linearly between the two nearest ranks, numpy's default, and is
    infinite where either of these is a failure.
    """

    names: tuple[str, ...]
    position_errors_m: Array  # (N,) distances between the camera centers
    rotation_errors_deg: Array  # (N,)

    @property
    def num_queries(self) -> int:
        """How many images there were to localize."""
        return len(self.names)

    @property
    def localized(self) -> NDArray[np.bool_]:
        """Which queries have an estimate, (N,)."""
        return np.isfinite(self.position_errors_m)

    @property
    def num_localized(self) -> int:
        """How many queries have an estimate."""
        return int(self.localized.sum())

    @property
    def median_position_m(self) -> float:
        """Median position error."""
        return percentile(self.position_errors_m, 50)

    @property
    def median_rotation_deg(self) -> float:
        """Median rotation error."""
        return percentile(self.rotation_errors_deg, 50)

    @property
    def p90_position_m(self) -> float:
        """90th percentile of the position errors."""
        return percentile(self.position_errors_m, 90)

    @property
    def p90_rotation_deg(self) -> float:
        """90th percentile of the rotation errors."""
        return percentile(self.rotation_errors_deg, 90)

    @property
    def localized_median_position_m(self) -> float:
        """Median position error of the localized queries only."""
        return percentile(self.position_errors_m[self.localized], 50)

    @property
    def localized_median_rotation_deg(self) -> float:
        """Median rotation error of the localized queries only."""
        return percentile(self.rotation_errors_deg[self.localized], 50)

    @property
    def recalls(self) -> tuple[float, ...]:
        """For each of `THRESHOLDS`, the fraction of queries with both errors at most that."""
        return tuple(
            float(np.mean((self.position_errors_m <= m) & (self.rotation_errors_deg <= deg)))
            for m, deg in THRESHOLDS
        )

    def to_json(self) -> dict[str, Any]:
        """Return everything in JSON's types; what is infinite is None."""
        errors = zip(self.names, self.position_errors_m, self.rotation_errors_deg, strict=True)
        return {
            "num_queries": self.num_queries,
            "num_localized": self.num_localized,
            "median_position_m": _finite(self.median_position_m),
            "median_rotation_deg": _finite(self.median_rotation_deg),
            "p90_position_m": _finite(self.p90_position_m),
            "p90_rotation_deg": _finite(self.p90_rotation_deg),
            "localized_median_position_m": _finite(self.localized_median_position_m),
            "localized_median_rotation_deg": _finite(self.localized_median_rotation_deg),
            "recalls": [
                {"position_m": m, "rotation_deg": deg, "recall": recall}
                for (m, deg), recall in zip(THRESHOLDS, self.recalls, strict=True)
            ],
            "queries": {
                name: {"position_error_m": _finite(m), "rotation_error_deg": _finite(deg)}
                for name, m, deg in errors
            },
        }

    def print_table(self, console: Console) -> None:
        """Print the statistics over all queries, and the medians of the localized ones."""
        table = Table(title=f"{self.num_localized} of {self.num_queries} queries localized")
        table.add_column("error")
        for heading in ("median", "90th percentile", "median of localized"):
            table.add_column(heading, justify="right")
        for row, *values in (
            (
                "position (m)",
                self.median_position_m,
                self.p90_position_m,
                self.localized_median_position_m,
            ),
            (
                "rotation (deg)",
                self.median_rotation_deg,
                self.p90_rotation_deg,
                self.localized_median_rotation_deg,
            ),
        ):
            table.add_row(row, *(f"{value:.4g}" for value in values))
        console.print(table)
        recalls = Table(title="queries with errors of at most")
        for m, deg in THRESHOLDS:
            recalls.add_column(f"{m:g} m, {deg:g} deg", justify="right")
        recalls.add_row(*(f"{recall:.1%}" for recall in self.recalls))
        console.print(recalls)


def evaluate(
    estimates: Mapping[str, Rigid3], truth: Mapping[str, Rigid3], queries: Sequence[str]
) -> Evaluation:
    """Compare cam_from_world of the queries; estimates and truth of other images do not count."""
    if not queries:
        raise ConfigError("there are no queries to evaluate")
    if unknown := [name for name in queries if name not in truth]:
        raise ConfigError(
            f"{len(unknown)} of {len(queries)} queries have no true pose: {_first(unknown)}"
        )
    found = np.array([name in estimates for name in queries])
    if estimates and not found.any():
        raise ConfigError(
            f"none of the {len(estimates)} estimates ({_first(list(estimates))}) is of a query "
            f"({_first(queries)}); the names have to be the same"
        )
    localized = [name for name in queries if name in estimates]
    estimated = Rigid3.stack(estimates[name] for name in localized)
    true = Rigid3.stack(truth[name] for name in localized)
    position_m, rotation_deg = np.full((2, len(queries)), np.inf)
    position_m[found] = np.linalg.norm(estimated.center - true.center, axis=1)
    rotation_deg[found] = np.rad2deg(rotation_angle((estimated @ true.inverse()).R))
    return Evaluation(tuple(queries), position_m, rotation_deg)


def read_truth(path: Path) -> dict[str, Rigid3]:
    """Read reference poses from a COLMAP model's folder or a pose file."""
    if path.is_dir():
        return {image.name: image.cam_from_world for image in read_model(path)}
    return read_poses(path)


def plot_paths(estimates: Mapping[str, Rigid3], truth: Mapping[str, Rigid3], out: Path) -> None:
    """Draw the true path and the estimated positions from above (x, y) and from the side (x, z).

    Every pose of `truth` counts as a query, and their names have to sort along the path. The
    picture ends a little beyond the path; its legend counts the estimates outside of it.
    """
    save_figure(draw_paths(estimates, truth), out)


def draw_paths(estimates: Mapping[str, Rigid3], truth: Mapping[str, Rigid3]) -> Figure:
    """Draw what `plot_paths` writes."""
    evaluation = evaluate(estimates, truth, sort_names(truth))
    path = Rigid3.stack(truth[name] for name in evaluation.names).center
    localized = compress(evaluation.names, evaluation.localized)
    positions = Rigid3.stack(estimates[name] for name in localized).center
    lower, upper = _surroundings(path)
    width, *heights = upper - lower
    inches_a_metre = min(8.0 / width, 8.0 / sum(heights))
    width_in, height_in = width * inches_a_metre, sum(heights) * inches_a_metre
    # Wide enough for the title, and with room around the views for labels and legends.
    figure = make_figure(max(width_in, 5.0) + 2.0, height_in + 2.0, layout="compressed")
    figure.suptitle(
        f"{evaluation.num_localized} of {evaluation.num_queries} localized, "
        f"median position error {_format_length(evaluation.median_position_m)}"
    )
    above, side = figure.subplots(2, sharex=True, height_ratios=heights)
    _draw_view(above, (0, 1), path, positions, evaluation)
    points = _draw_view(side, (0, 2), path, positions, evaluation)
    above.set_title("from above", loc="left", fontsize="medium")
    side.set_title("from the side", loc="left", fontsize="medium")
    side.set_xlabel("x (m)")
    figure.legend(
        *side.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False
    )
    figure.colorbar(
        points, ax=(above, side), label="position error (m)", extend="max", aspect=40, shrink=0.9
    )
    return figure


def _draw_view(
    axes: Axes, plane: tuple[int, int], path: Array, positions: Array, evaluation: Evaluation
) -> PathCollection:
    """Draw what lies in the plane of two of the world's axes; return the estimates."""
    x, y = plane
    found = evaluation.localized
    missing = path[~found]
    links = np.stack([path[found], positions])
    lower, upper = _surroundings(path)
    num_outside = int(((positions < lower) | (positions > upper)).any(axis=1).sum())
    outside = f", {num_outside} of them outside" if num_outside else ""
    errors_m = evaluation.position_errors_m[found]
    axes.plot(path[:, x], path[:, y], color="0.55", linewidth=1.2, label="true path")
    axes.plot(links[..., x], links[..., y], color="0.55", linewidth=0.6)
    axes.plot(
        missing[:, x], missing[:, y], "x", color="crimson", label=f"not localized ({len(missing)})"
    )
    points = axes.scatter(
        positions[:, x],
        positions[:, y],
        c=errors_m,
        s=20,
        cmap="viridis",
        vmin=0.0,
        vmax=max(np.percentile(errors_m, 95), 1e-6) if len(errors_m) else 1.0,
        edgecolors="0.5",
        linewidths=0.3,
        zorder=3,
        label=f"estimate ({len(positions)}{outside})",
    )
    axes.set(xlim=(lower[x], upper[x]), ylim=(lower[y], upper[y]), aspect="equal")
    axes.set_ylabel(f"{'xyz'[y]} (m)")
    axes.grid(color="0.5", alpha=0.2)
    axes.set_axisbelow(True)
    return points


def _surroundings(path: Array) -> tuple[Array, Array]:
    """Return the corners of a box a little larger than the path, and nowhere much thinner."""
    lower, upper = path.min(axis=0), path.max(axis=0)
    longest = max((upper - lower).max(), 1.0)
    half = np.maximum((upper - lower) / 2 + 0.08 * longest, 0.15 * longest)
    middle = (lower + upper) / 2
    return middle - half, middle + half


def _format_length(metres: float) -> str:
    if not math.isfinite(metres):
        return "infinite"
    if metres < 0.01:
        return f"{metres * 1e3:.1f} mm"
    return f"{metres * 1e2:.1f} cm" if metres < 1 else f"{metres:.2f} m"


def percentile(errors: Array, q: float) -> float:
    """Return numpy's default percentile, without its inf - inf = nan; inf of nothing."""
    if len(errors) == 0:
        return math.inf
    ordered = np.sort(errors)
    rank = q * (len(errors) - 1) / 100
    below, above = ordered[math.floor(rank)], ordered[math.ceil(rank)]
    if np.isinf(above):
        return math.inf
    return float(below + (rank - math.floor(rank)) * (above - below))


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _first(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
