"""Poses of the anchors that are nearly right, and what follows for the query's."""

import numpy as np
import pytest
from scipy.stats import chi2

from tests.unit.scenes import generator, make_scene
from tests.unit.test_pose_refinement import errors
from trigpoint.frame import PoseNoise
from trigpoint.geometry.joint_refinement import invert_symmetric, refine_jointly
from trigpoint.geometry.pose_refinement import RefinedPose, perturb, refine_pose
from trigpoint.geometry.triangulation import LatentPoints, Tracks, triangulate
from trigpoint.rigid import Rigid3

PX = 1 / 500
SIGMA_PX = 0.5
NOISE = PoseNoise(0.0, 0.01, 0.002, 0.0)
EXACT = PoseNoise(0.0, 0.0, 0.0, 0.0)


def near(pose: Rigid3) -> Rigid3:
    return perturb(pose, np.array([2, -3, 2, 1, -2, 1]) * 1e-3)


class Survey:
    """A query (the first view) and anchors whose poses the map has wrong by `noise`."""

    def __init__(
        self,
        key: str,
        noise: PoseNoise = NOISE,
        sigma_px: float = SIGMA_PX,
        num_points: int = 100,
        num_wrong: int = 0,
    ) -> None:
        scene = make_scene(key, num_points, num_views=7)
        rng = generator(key + " noise")
        self.truth, anchors = scene.views_from_world[0], scene.views_from_world[1:]
        noisy = scene.points2d + rng.normal(0, sigma_px * PX, scene.points2d.shape)
        self.query = noisy[0]
        distances = np.linalg.norm(anchors.center - self.truth.center, axis=1)
        # Errors are those of the map: what the map says plus the error is the truth.
        self.map = perturb(anchors, rng.normal(size=(6, 6)) * noise.std(distances))
        self.query[:num_wrong] += rng.uniform(-0.1, 0.1, (num_wrong, 2))
        point = np.repeat(np.arange(num_points), 6)
        view = np.tile(np.arange(6), num_points)
        xy = noisy[1:].transpose(1, 0, 2).reshape(-1, 2)
        tracks = Tracks(point, view, xy, np.full(len(point), PX))
        self.latent = LatentPoints(np.arange(num_points), *triangulate(self.map, tracks), tracks)

    def refine_jointly(self, start: Rigid3, noise: PoseNoise = NOISE) -> RefinedPose | None:
        return refine_jointly(
            start, self.map, self.latent, self.query,
            px=PX, sigma_px=SIGMA_PX, pose_noise=noise, max_error_px=8.0,
        )  # fmt: skip

    def refine_alone(self, start: Rigid3) -> RefinedPose | None:
        return refine_pose(
            start, self.latent.points3d, self.query,
            point_covariance=self.latent.covariance / PX**2, sigma=SIGMA_PX * PX,
            max_error=8.0 * PX,
        )  # fmt: skip


def test_exact_measurements_give_the_exact_pose() -> None:
    survey = Survey("joint exact", EXACT, sigma_px=0.0)
    start = near(survey.truth)
    refined = survey.refine_jointly(start)
    assert refined is not None
    assert np.abs(errors(refined.cam_from_world, survey.truth)).max() < 1e-6


@pytest.mark.parametrize("noise", [EXACT, NOISE])
def test_exact_anchors_give_what_the_two_steps_of_the_paper_give(noise: PoseNoise) -> None:
    survey = Survey("joint alone", EXACT)
    alone = survey.refine_alone(near(survey.truth))
    assert alone is not None
    joint = survey.refine_jointly(alone.cam_from_world, noise)
    assert joint is not None
    std = np.sqrt(np.diag(alone.covariance))
    difference = errors(joint.cam_from_world, alone.cam_from_world)
    # Believed to be uncertain, they count for less: the pose moves, and is known less well.
    limit = 0.5 if noise is EXACT else 3.0
    assert (np.abs(difference) < limit * std).all()
    ratio = np.sqrt(np.diag(joint.covariance)) / std
    if noise is EXACT:
        np.testing.assert_allclose(ratio, 1, atol=0.25)
    else:
        assert (ratio > 1.2).all()


def test_anchors_that_are_off_bend_the_pose_less_when_they_may_move() -> None:
    joint, alone = [], []
    for trial in range(40):
        survey = Survey(f"joint off {trial}")
        start = survey.refine_alone(near(survey.truth))
        assert start is not None
        refined = survey.refine_jointly(start.cam_from_world)
        assert refined is not None
        alone.append(errors(start.cam_from_world, survey.truth))
        joint.append(errors(refined.cam_from_world, survey.truth))
    ratio = np.sqrt(np.mean(np.square(joint), axis=0) / np.mean(np.square(alone), axis=0))
    assert (ratio < 0.9).all(), ratio


def test_the_covariance_says_how_far_off_the_pose_is() -> None:
    center, rotation = [], []
    for trial in range(100):
        survey = Survey(f"joint covariance {trial}")
        refined = survey.refine_jointly(survey.truth)
        assert refined is not None
        e, C = errors(refined.cam_from_world, survey.truth), refined.covariance
        center.append(e[:3] @ np.linalg.solve(C[:3, :3], e[:3]))
        rotation.append(e[3:] @ np.linalg.solve(C[3:, 3:], e[3:]))
    for nees in (np.array(center), np.array(rotation)):
        assert 2.2 < nees.mean() < 4.0  # 3 is right
        assert 0.88 <= (nees < chi2.ppf(0.95, 3)).mean() <= 1.0


def test_wrong_matches_in_the_query_do_not_move_the_pose() -> None:
    good, bad = Survey("joint wrong"), Survey("joint wrong", num_wrong=30)
    refined = [survey.refine_jointly(survey.truth) for survey in (good, bad)]
    assert refined[0] is not None
    assert refined[1] is not None
    std = np.sqrt(np.diag(refined[0].covariance))
    difference = errors(refined[1].cam_from_world, refined[0].cam_from_world)
    assert (np.abs(difference) < 1.5 * std).all()
    assert refined[1].inliers[:30].mean() < 0.2
    assert refined[1].inliers[30:].all()


def test_the_unit_of_length_does_not_matter() -> None:
    survey = Survey("joint unit")
    one = survey.refine_jointly(survey.truth)
    assert one is not None
    for scale in (1e-4, 1e4):
        larger = Survey("joint unit")
        larger.map = Rigid3(survey.map.R, survey.map.t * scale)
        larger.latent = LatentPoints(
            survey.latent.point, *triangulate(larger.map, survey.latent.tracks),
            survey.latent.tracks,
        )  # fmt: skip
        other = larger.refine_jointly(Rigid3(survey.truth.R, survey.truth.t * scale))
        assert other is not None
        np.testing.assert_allclose(
            other.cam_from_world.center / scale, one.cam_from_world.center, atol=1e-6
        )


def test_too_few_points_determine_no_pose() -> None:
    survey = Survey("joint few", num_points=3)
    assert survey.refine_jointly(survey.truth) is None


def test_points_behind_the_query_determine_no_pose() -> None:
    survey = Survey("joint behind")
    turned = Rigid3(np.diag([-1.0, 1.0, -1.0]) @ survey.truth.R, survey.truth.t)
    assert survey.refine_jointly(turned) is None


def test_cofactors_invert_as_lapack_does() -> None:
    A = generator("invert").normal(size=(50, 3, 3))
    H = A @ np.swapaxes(A, 1, 2) * np.logspace(-12, 12, 50)[:, None, None]
    np.testing.assert_allclose(invert_symmetric(H) @ H, np.tile(np.eye(3), (50, 1, 1)), atol=1e-6)
