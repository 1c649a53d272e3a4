"""What speaks against a pose, on scenes made for it."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.unit.scenes import generator, make_scene, project
from trigpoint.frame import Reason
from trigpoint.geometry.joint_refinement import RefinedPose
from trigpoint.geometry.triangulation import Tracks
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3
from trigpoint.stages import (
    Query,
    find_latent_points,
    refine,
    solve_latent_points,
)
from trigpoint.verdict import Evidence, gather_evidence, judge, measure_confidence, position_std

Array = NDArray[np.float64]

PX = 1 / 500
OPTIONS = LocalizerOptions()
GOOD = Evidence(
    num_candidates=250,
    num_points=200,
    num_inliers=180,
    num_rivals=0,
    spread_px=80.0,
    depth=5.0,
    depth_std_ratio=0.01,
    std_ratio=0.001,
)
CERTAIN = 1e-6 * np.eye(6)


def make_query(
    points2d: Array, views: Rigid3, seen: Array, key: str, noise_px: float = 0.3
) -> Query:
    """Match every keypoint of the query (M, 2) with where all views (V,) see it (V, M, 2)."""
    rng = generator(key)
    seen = seen + rng.normal(size=seen.shape) * noise_px * PX
    num_views, num = seen.shape[:2]
    point = np.repeat(np.arange(num), num_views)
    view = np.tile(np.arange(num_views), num)
    tracks = Tracks(point, view, seen[view, point], np.full(len(point), PX))
    return Query(
        points2d + rng.normal(size=points2d.shape) * noise_px * PX,
        PX,
        views,
        np.full(num_views, PX),
        tracks,
        [np.arange(num)] * num_views,
        list(seen),
        0,
    )


def solve(query: Query) -> tuple[Evidence, RefinedPose]:
    """Do as the localizer does; the covariance is of the images alone."""
    latent = find_latent_points(query, OPTIONS)
    num_candidates = len(latent.point)
    hypothesis = solve_latent_points(query, latent, OPTIONS)
    assert hypothesis is not None
    latent, refined = refine(query, hypothesis, OPTIONS)
    assert refined is not None
    return gather_evidence(query, num_candidates, latent, refined, OPTIONS), refined


def objection(evidence: Evidence, covariance: Array = CERTAIN) -> Reason | None:
    found = judge(evidence, measure_confidence(evidence), covariance, OPTIONS)
    return found[0] if found else None


def in_two_places(key: str) -> tuple[Query, Query]:
    """A scene that its views show once, and one that half of them show somewhere else."""
    scene = make_scene(key, num_points=300, num_views=9)
    points2d, seen = scene.points2d[0], scene.points2d[1:]
    views = scene.views_from_world[1:]
    elsewhere = Rigid3.from_center(views.R, views.center + np.array([100.0, 0, 0]))
    both = Rigid3(np.concatenate([views.R[:4], elsewhere.R[4:]]), views.t.copy())
    both.t[4:] = elsewhere.t[4:]
    return make_query(points2d, views, seen, key), make_query(points2d, both, seen, key)


def test_a_scene_at_two_places_is_ambiguous() -> None:
    once, twice = in_two_places("two places")
    evidence, refined = solve(once)
    assert evidence.num_rivals == 0
    assert objection(evidence, refined.covariance) is None
    evidence, refined = solve(twice)
    assert evidence.num_rivals > 0.8 * evidence.num_inliers
    assert objection(evidence, refined.covariance) is Reason.AMBIGUOUS


def test_something_that_has_moved_is_no_rival_while_it_is_small() -> None:
    """A fifth of the points is on a cart that stood elsewhere when the map was made."""
    scene = make_scene("cart", num_points=300, num_views=7)
    moved = scene.points3d.copy()
    moved[:60] += [0.8, 0.3, 0.5]
    points2d = project(scene.views_from_world[:1], moved)[0]
    query = make_query(points2d, scene.views_from_world[1:], scene.points2d[1:], "cart")
    evidence, refined = solve(query)
    assert evidence.num_inliers > 200
    assert objection(evidence, refined.covariance) is None


def test_points_in_one_corner_are_clustered() -> None:
    scene = make_scene("corner", num_points=200, num_views=7)
    small = project(scene.views_from_world, 0.05 * scene.points3d)
    query = make_query(small[0], scene.views_from_world[1:], small[1:], "corner", 0.1)
    evidence, _ = solve(query)
    assert evidence.spread_px < OPTIONS.min_spread_px
    assert objection(evidence) is Reason.CLUSTERED_INLIERS


def test_anchors_at_one_place_give_no_certain_pose() -> None:
    """Without a baseline there are no depths, and the query stands elsewhere."""
    scene = make_scene("one place", num_points=200, num_views=7)
    views = scene.views_from_world[1:]
    views = Rigid3.from_center(views.R, np.tile(views.center[:1], (6, 1)))
    seen = project(views, scene.points3d)
    query = make_query(scene.points2d[0], views, seen, "one place")
    latent = find_latent_points(query, OPTIONS)
    hypothesis = solve_latent_points(query, latent, OPTIONS)
    if hypothesis is None:
        return
    latent, refined = refine(query, hypothesis, OPTIONS)
    if refined is not None:
        evidence = gather_evidence(query, 200, latent, refined, OPTIONS)
        assert objection(evidence, refined.covariance) is not None


def test_anchors_on_one_line_with_the_query_determine_it_by_the_points_off_the_line() -> None:
    """Stage 1 has no center there (DEGENERATE_ANCHORS); a car drives so all the time."""
    scene = make_scene("line", num_points=300)
    along = np.array([0.0, 1.2, 0.8, 0.4, -0.4, -0.8, -1.2])
    centers = np.column_stack([np.zeros((7, 2)), along - 5.0])
    views = Rigid3.from_center(np.tile(np.eye(3), (7, 1, 1)), centers)
    seen = project(views, scene.points3d)
    _, refined = solve(make_query(seen[0], views[1:], seen[1:], "line"))
    error = np.linalg.norm(refined.cam_from_world.center - views.center[0])
    assert error < 4 * position_std(refined.covariance) < 0.1


def test_confidence_rises_with_the_share_that_agrees_and_falls_with_uncertainty() -> None:
    assert 0.99 < measure_confidence(GOOD) < 1
    fewer = replace(GOOD, num_inliers=60)
    vaguer = replace(GOOD, std_ratio=0.02)
    assert measure_confidence(replace(fewer, std_ratio=0.02)) < 0.9
    assert measure_confidence(fewer) < measure_confidence(GOOD)
    assert measure_confidence(vaguer) < measure_confidence(GOOD)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({}, None),
        ({"num_inliers": 11, "num_points": 12, "num_candidates": 12}, Reason.FEW_INLIERS),
        ({"num_inliers": 40, "std_ratio": 0.01}, Reason.LOW_CONFIDENCE),
        ({"num_rivals": 55}, Reason.AMBIGUOUS),
        ({"num_rivals": 54}, None),
        ({"spread_px": 9.9}, Reason.CLUSTERED_INLIERS),
        ({"depth_std_ratio": 0.3}, Reason.DEGENERATE_ANCHORS),
        ({"depth": 1e-2}, Reason.HIGH_UNCERTAINTY),
    ],
)
def test_each_objection_has_its_limit(changes: dict[str, float], reason: Reason | None) -> None:
    assert objection(replace(GOOD, **changes)) is reason  # type: ignore[arg-type]
