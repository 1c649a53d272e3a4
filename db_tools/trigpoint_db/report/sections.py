"""The sections of a report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from trigpoint.database.reader import MapReader
from trigpoint.rigid import Rigid3
from trigpoint_db.calibrate import describe_noise
from trigpoint_db.coverage import Coverage, Grade, horizontal_axes, mean_up
from trigpoint_db.coverage_picture import draw_coverage
from trigpoint_db.evaluate import Evaluation, draw_paths, percentile
from trigpoint_db.figures import make_figure, scale_logarithmically, to_svg
from trigpoint_db.gaps import Place
from trigpoint_db.maps import count_sessions
from trigpoint_db.report.page import Section, Table
from trigpoint_db.report.results import QueryResult

Array = NDArray[np.float64]
MAX_LISTED = 15


def map_section(reader: MapReader, num_bytes: int) -> Section:
    """Say what the map is."""
    centers = reader.poses().center
    extent = " x ".join(f"{side:.3g}" for side in np.ptp(centers, axis=0)) if len(centers) else "-"
    rows = [
        ["images", str(len(reader))],
        ["size", f"{num_bytes / 1e6:.1f} MB, {num_bytes / 1e3 / max(len(reader), 1):.1f} kB each"],
        ["sessions", ", ".join(str(s) for s in count_sessions(reader) if s) or "none"],
        ["network", reader.model.name],
        ["extent of the cameras", extent],
        ["poses", describe_noise(reader.pose_noise)],
    ]
    return Section("Map", table=Table(["", ""], rows))


def coverage_sections(
    coverage: Coverage, gaps: Sequence[Place], wanted: Sequence[Place]
) -> list[Section]:
    """Show the coverage from above, and what to photograph."""
    counts = coverage.counts
    weak = [gap for gap in gaps if gap.grade is not Grade.STRONG]
    text = (
        f"Each of {len(coverage.probes)} images was localized without those that are nearer to it "
        f"than {coverage.apart:g} (distance over depth, or radians): {counts['strong']} are "
        f"strong, {counts['thin']} thin, {counts['blind']} blind. {len(weak)} of {len(gaps)} "
        "places in gaps between images are out of their reach. Squares are places on the ground, "
        "wedges the headings of the images taken there."
    )
    sections = [Section("Coverage", text, to_svg(draw_coverage(coverage, gaps, wanted)))]
    if wanted:
        rows = [
            [", ".join(f"{x:.3g}" for x in place.cam_from_world.center), place.grade, place.reason]
            for place in wanted[:MAX_LISTED]
        ]
        more = f" The first {MAX_LISTED}:" if len(wanted) > MAX_LISTED else ""
        sections.append(
            Section(
                "To photograph",
                f"{len(wanted)} poses would fill gaps and strengthen weak places.{more}",
                table=Table(["place", "now", "why"], rows),
            )
        )
    return sections


def error_section(positions: Array, rotations_deg: Array, text: str) -> Section:
    """Draw which share of the images is localized within an error; infinite ones are failures."""
    figure = make_figure(8.0, 3.4)
    for axes, errors, label in zip(
        figure.subplots(1, 2, sharey=True),
        (positions, rotations_deg),
        ("position error (the map's unit)", "rotation error (degrees)"),
        strict=True,
    ):
        found = np.sort(errors[np.isfinite(errors)])
        if len(found):
            shares = np.arange(1, len(found) + 1) / len(errors)
            floor = max(found[-1] * 1e-5, 1e-12)
            axes.step(
                np.append(np.maximum(found, floor), found[-1] * 2),
                np.append(shares, shares[-1]),
                where="post",
                color="#3b8bc4",
            )
        scale_logarithmically(axes)
        axes.axhline(1.0, color="0.5", linewidth=0.6, linestyle=":")
        axes.set(xlabel=label, ylim=(0, 1.05))
        axes.grid(color="0.5", alpha=0.25)
    figure.axes[0].set_ylabel("share of the images")
    rows = [
        [name, *(_percentile(errors, q) for q in (50, 90)), _percentile(errors, 100)]
        for name, errors in (("position", positions), ("rotation (degrees)", rotations_deg))
    ]
    table = Table(["error", "median", "90th percentile", "largest"], rows)
    return Section("Errors", text, to_svg(figure), table)


def _percentile(errors: Array, q: float) -> str:
    """Format a percentile of all images; it is a failure where so many failed."""
    value = percentile(errors, q)
    return f"{value:.3g}" if np.isfinite(value) else "no pose"


def timing_section(stage_ms: Sequence[Mapping[str, float]], text: str) -> Section:
    """Draw how long the stages took."""
    stages = list(dict.fromkeys(stage for times in stage_ms for stage in times))
    times = {stage: np.array([t[stage] for t in stage_ms if stage in t]) for stage in stages}
    times["all"] = np.array([sum(t.values()) for t in stage_ms])
    figure = make_figure(8.0, 0.6 + 0.3 * len(stages))
    axes = figure.subplots()
    bars = [float(np.median(times[stage])) for stage in stages]
    tails = [float(np.percentile(times[stage], 90) - np.median(times[stage])) for stage in stages]
    axes.barh(stages, bars, xerr=[[0] * len(bars), tails], color="#3b8bc4", ecolor="0.5")
    axes.invert_yaxis()
    axes.set_xlabel("ms: median, and up to the 90th percentile")
    axes.grid(axis="x", color="0.5", alpha=0.25)
    rows = [
        [stage.replace("_", " "), *(f"{np.percentile(ms, q):.1f}" for q in (50, 90, 99))]
        for stage, ms in times.items()
    ]
    headings = ["stage (ms)", "median", "90th percentile", "99th"]
    return Section("Times", text, to_svg(figure), Table(headings, rows))


def outcome_section(results: Sequence[QueryResult]) -> Section:
    """Count what came of the queries."""
    counts = Counter(result.reason or "LOCALIZED" for result in results)
    rows = [
        [outcome, str(count), f"{count / len(results):.1%}"]
        for outcome, count in counts.most_common()
    ]
    return Section("Outcomes", table=Table(["outcome", "queries", "share"], rows))


def path_section(
    estimates: Mapping[str, Rigid3],
    truth: Mapping[str, Rigid3],
    evaluation: Evaluation,
    up: Array | None,
) -> Section:
    """Draw the true path and the estimates, from above and from the side."""
    asked = {name: truth[name] for name in evaluation.names}
    if up is None:
        up = mean_up(Rigid3.stack(asked.values()))
    upright = Rigid3(np.vstack([horizontal_axes(up), up]), np.zeros(3)).inverse()
    text = f"{evaluation.num_localized} of {evaluation.num_queries} queries have a pose."
    figure = draw_paths(
        {name: pose @ upright for name, pose in estimates.items()},
        {name: pose @ upright for name, pose in asked.items()},
    )
    return Section("Paths", text, to_svg(figure))
