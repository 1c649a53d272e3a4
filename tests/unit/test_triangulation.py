from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from tests.unit.scenes import Scene, generator, make_scene
from trigpoint.geometry.points_last import project
from trigpoint.geometry.triangulation import (
    Tracks,
    keep_agreeing,
    triangulate,
    triangulate_robust,
)
from trigpoint.rigid import Rigid3, rotation_from_vector


def all_tracks(points2d: np.ndarray) -> Tracks:
    """Every view sees every point: (V, M, 2)."""
    num_views, num_points = points2d.shape[:2]
    point = np.repeat(np.arange(num_points), num_views)
    view = np.tile(np.arange(num_views), num_points)
    return Tracks(point, view, points2d[view, point], np.ones(len(point)))


def noisy(scene: Scene, sigma: float) -> Tracks:
    noise = generator(f"noise {sigma}").normal(0, sigma, scene.points2d.shape)
    return all_tracks(scene.points2d + noise)


def test_exact_observations_give_the_exact_points() -> None:
    scene = make_scene("exact")
    points3d = triangulate(scene.views_from_world, all_tracks(scene.points2d))
    np.testing.assert_allclose(points3d, scene.points3d, atol=1e-9)


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6), scale=st.floats(0.01, 100))
def test_points_follow_when_the_world_is_moved_and_scaled(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    scene = make_scene(f"similarity {seed}", num_points=5, num_views=3)
    tracks = noisy(scene, 1e-3)
    moved_from_world = Rigid3(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3) * 10)
    points3d = triangulate(scene.views_from_world, tracks)
    views = scene.views_from_world @ moved_from_world.inverse()
    moved_views = Rigid3(views.R, views.t * scale)
    moved = triangulate(moved_views, tracks)
    np.testing.assert_allclose(
        moved, moved_from_world.apply(points3d) * scale, rtol=1e-6, atol=1e-6 * scale
    )


def proposition_2(
    gamma_1: np.ndarray,
    rho_1: float,
    gammas: np.ndarray,
    views_from_first: Rigid3,
    *,
    printed: bool,
) -> float:
    """The objective of Proposition 2 for one point, term by term.

    With homogeneous g_k = (x, y, 1) and the point in view k, G_k = rho R_k1 g_1 + T_k1, the error
    there is |g_k - G_k / e3^T G_k|^2 = |g_k|^2 - 2 g_k^T G_k / e3^T G_k + |G_k|^2 / (e3^T G_k)^2,
    and |G_k|^2 = rho^2 |g_1|^2 + |T_k1|^2 + 2 rho g_1^T R_k1^T T_k1. The paper prints rho |g_1|^2.
    """
    g = np.append(gamma_1, 1.0)
    total = float(((gammas[0] - gamma_1) ** 2).sum())
    for k in range(1, len(gammas)):
        R, T = views_from_first.R[k], views_from_first.t[k]
        g_k = np.append(gammas[k], 1.0)
        depth = rho_1 * (R @ g)[2] + T[2]
        square = (rho_1 if printed else rho_1**2) * g @ g + T @ T + 2 * rho_1 * g @ R.T @ T
        total += float(g_k @ g_k - 2 * (rho_1 * g_k @ R @ g + g_k @ T) / depth + square / depth**2)
    return total


def test_triangulation_minimises_the_objective_of_proposition_2() -> None:
    scene = make_scene("proposition 2", num_points=10)
    views = scene.views_from_world
    views_from_first = views @ views[0].inverse()
    tracks = noisy(scene, 5e-3)
    points3d = triangulate(views, tracks, num_iterations=20)
    seen = project(views, np.repeat(points3d, tracks.lengths, axis=0), tracks.view)
    residuals = seen.xy.T - tracks.xy
    for j, X in enumerate(points3d):
        gammas = tracks.xy[tracks.point == j]
        in_first = views[0].apply(X)
        at = np.array([*(in_first[:2] / in_first[2]), in_first[2]])

        def objective(
            v: np.ndarray, gammas: np.ndarray = gammas, *, printed: bool = False
        ) -> float:
            return proposition_2(v[:2], v[2], gammas, views_from_first, printed=printed)

        e1 = float((residuals[tracks.point == j] ** 2).sum())
        assert objective(at) == pytest.approx(e1, rel=1e-6)  # it is E1 of eq. 13
        best = minimize(
            objective, at, method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-14}
        )
        assert objective(at) <= best.fun + 1e-12  # and we are at its minimum
        assert abs(objective(at, printed=True) - e1) > 10 * e1  # which the printed form is not


def test_parallel_rays_give_a_point_far_away() -> None:
    views = Rigid3.from_center(np.tile(np.eye(3), (2, 1, 1)), np.array([[0, 0, 0], [1.0, 0, 0]]))
    tracks = Tracks(np.array([0, 0]), np.array([0, 1]), np.zeros((2, 2)), np.ones(2))
    assert np.isfinite(triangulate(views, tracks)).all()


def test_two_views_at_one_place_give_finite_numbers() -> None:
    R = rotation_from_vector(np.array([[0, 0, 0], [0, 0.1, 0]]))
    views = Rigid3.from_center(R, np.zeros((2, 3)))
    tracks = Tracks(
        np.array([0, 0]), np.array([0, 1]), np.array([[0, 0], [-0.1003, 0]]), np.ones(2)
    )
    assert np.isfinite(triangulate(views, tracks)).all()


def test_a_point_behind_its_views_is_refused() -> None:
    views = Rigid3.from_center(np.tile(np.eye(3), (2, 1, 1)), np.array([[0, 0, 0], [1.0, 0, 0]]))
    behind = np.array([0.5, 0.2, -3.0])
    xy = np.stack([(behind - c)[:2] / (behind - c)[2] for c in views.center])
    latent = triangulate_robust(
        views, Tracks(np.array([0, 0]), np.array([0, 1]), xy, np.ones(2)), max_error_px=0.01
    )
    assert len(latent.point) == 0


def test_wrong_observations_are_dropped_and_the_others_kept() -> None:
    scene = make_scene("outliers", num_points=50, num_views=6)
    rng = generator("outliers noise")
    points2d = scene.points2d + rng.normal(0, 5e-4, scene.points2d.shape)
    wrong = rng.random((6, 50)) < 0.15
    points2d[wrong] += rng.choice([-1, 1], (wrong.sum(), 2)) * rng.uniform(
        0.1, 0.3, (wrong.sum(), 2)
    )
    tracks = all_tracks(points2d)
    latent = triangulate_robust(scene.views_from_world, tracks, max_error_px=3e-3)
    kept = np.zeros((6, 50), bool)
    kept[latent.tracks.view, latent.tracks.point] = True
    assert not (kept & wrong).any()
    assert kept[~wrong].mean() > 0.9
    errors = np.linalg.norm(latent.points3d - scene.points3d[latent.point], axis=1)
    assert np.median(errors) < 5e-3


def test_of_two_places_that_look_alike_the_observations_of_one_are_kept() -> None:
    """Three views show the points, two show copies of them elsewhere, one something else."""
    scene = make_scene("copies", num_points=60, num_views=6)
    views = scene.views_from_world
    moved = views.center + np.outer([0, 0, 0, 1, 1, 0], [40.0, 3.0, 0])
    views = Rigid3.from_center(views.R, moved)
    seen = scene.points2d + generator("copies").normal(0, 1e-3, scene.points2d.shape)
    seen[5] = generator("something else").uniform(-0.4, 0.4, seen[5].shape)
    tracks = all_tracks(seen)
    kept = keep_agreeing(views, replace(tracks, px=np.full(len(tracks), 2e-3)), max_error_px=2.0)
    num_kept = np.bincount(kept.view, minlength=6)
    assert (num_kept[:3] >= 55).all()
    assert (num_kept[3:] < 15).all()
    latent = triangulate_robust(views, replace(kept, px=np.full(len(kept), 2e-3)), max_error_px=2.0)
    errors = np.linalg.norm(latent.points3d - scene.points3d[latent.point], axis=1)
    assert len(errors) >= 50
    assert np.median(errors) < 0.05


def test_points_seen_once_are_left_out() -> None:
    scene = make_scene("once", num_points=3, num_views=3)
    tracks = all_tracks(scene.points2d)
    tracks = tracks[(tracks.point != 1) | (tracks.view == 0)]
    latent = triangulate_robust(scene.views_from_world, tracks, max_error_px=1e-3)
    np.testing.assert_array_equal(latent.point, [0, 2])


def test_no_tracks_give_no_points() -> None:
    scene = make_scene("none", num_points=1)
    empty = all_tracks(scene.points2d)[np.zeros(4, bool)]
    assert len(triangulate_robust(scene.views_from_world, empty, max_error_px=1e-3).point) == 0


def test_a_pixel_is_as_large_as_its_view_sees_it() -> None:
    """The same error counts less in a view with large pixels, and may be too much in a fine one."""
    scene = make_scene("pixels", num_points=20, num_views=3)
    points2d = scene.points2d.copy()
    points2d[2] += 0.01
    tracks = all_tracks(points2d)
    coarse = replace(tracks, px=np.where(tracks.view == 2, 0.05, 0.001))
    fine = replace(tracks, px=np.full(len(tracks), 0.001))
    error_coarse, error_fine = (
        np.linalg.norm(triangulate(scene.views_from_world, t) - scene.points3d, axis=1)
        for t in (coarse, fine)
    )
    assert (error_coarse < 0.1 * error_fine).all()
    kept = triangulate_robust(scene.views_from_world, coarse, max_error_px=2).tracks
    assert len(kept) == len(tracks)
    kept = triangulate_robust(scene.views_from_world, fine, max_error_px=2).tracks
    assert len(kept) < len(tracks)
