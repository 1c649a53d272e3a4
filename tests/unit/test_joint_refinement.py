"""Poses of the anchors that are nearly right, and what follows for the query's."""

from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from tests.unit.scenes import generator, make_scene
from tests.unit.test_pose_refinement import errors
from trigpoint.frame import PoseNoise
from trigpoint.geometry.joint_refinement import RefinedPose, refine_jointly
from trigpoint.geometry.pose_refinement import MIN_POINTS, perturb, refine_pose
from trigpoint.geometry.triangulation import LatentPoints, Tracks, triangulate
from trigpoint.rigid import Rigid3, rotate

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
        self.query, self.points = noisy[0], scene.points3d
        distances = np.linalg.norm(anchors.center - self.truth.center, axis=1)
        # Errors are those of the map: what the map says plus the error is the truth.
        self.map = perturb(anchors, rng.normal(size=(6, 6)) * noise.std(distances))
        self.query[:num_wrong] += rng.uniform(-0.1, 0.1, (num_wrong, 2))
        point = np.repeat(np.arange(num_points), 6)
        view = np.tile(np.arange(6), num_points)
        xy = noisy[1:].transpose(1, 0, 2).reshape(-1, 2)
        tracks = Tracks(point, view, xy, np.full(len(point), PX))
        self.latent = LatentPoints(triangulate(self.map, tracks), tracks)

    def refine_jointly(self, start: Rigid3, noise: PoseNoise = NOISE) -> RefinedPose | None:
        return refine_jointly(
            start, self.map, self.latent, self.query,
            px=PX, sigma_px=SIGMA_PX, pose_noise=noise, max_error_px=8.0,
        )  # fmt: skip

    def refine_alone(self, start: Rigid3) -> Rigid3 | None:
        return refine_pose(
            start, self.latent.points3d, self.query, sigma=SIGMA_PX * PX, max_error=8.0 * PX
        )


def test_exact_measurements_give_the_exact_pose() -> None:
    survey = Survey("joint exact", EXACT, sigma_px=0.0)
    start = near(survey.truth)
    refined = survey.refine_jointly(start)
    assert refined is not None
    assert np.abs(errors(refined.cam_from_world, survey.truth)).max() < 1e-6


def test_anchors_that_may_move_leave_the_pose_less_certain() -> None:
    survey = Survey("joint alone", EXACT)
    alone = survey.refine_alone(near(survey.truth))
    assert alone is not None
    exact = survey.refine_jointly(alone, EXACT)
    loose = survey.refine_jointly(alone, NOISE)
    assert exact is not None
    assert loose is not None
    std = np.sqrt(np.diag(exact.covariance))
    assert (np.abs(errors(exact.cam_from_world, alone)) < std).all()  # the paper's two steps
    assert (np.sqrt(np.diag(loose.covariance)) > 1.2 * std).all()


def test_anchors_that_are_off_bend_the_pose_less_when_they_may_move() -> None:
    joint, alone = [], []
    for trial in range(40):
        survey = Survey(f"joint off {trial}")
        start = survey.refine_alone(near(survey.truth))
        assert start is not None
        refined = survey.refine_jointly(start)
        assert refined is not None
        alone.append(errors(start, survey.truth))
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
        tracks = survey.latent.tracks
        larger.latent = LatentPoints(triangulate(larger.map, tracks), tracks)
        other = larger.refine_jointly(Rigid3(survey.truth.R, survey.truth.t * scale))
        assert other is not None
        np.testing.assert_allclose(
            other.cam_from_world.center / scale, one.cam_from_world.center, atol=1e-6
        )


def test_wrong_matches_alone_give_no_pose_that_few_agree_with() -> None:
    for trial in range(60):
        survey = Survey(f"x{trial}", num_points=8)
        survey.query += generator(f"w{trial}").uniform(-0.03, 0.03, (8, 2))
        refined = survey.refine_jointly(survey.truth)
        assert refined is None or refined.inliers.sum() >= MIN_POINTS


def test_too_few_points_determine_no_pose() -> None:
    survey = Survey("joint few", num_points=3)
    assert survey.refine_jointly(survey.truth) is None


def test_points_behind_the_query_determine_no_pose() -> None:
    survey = Survey("joint behind")
    turned = Rigid3(np.diag([-1.0, 1.0, -1.0]) @ survey.truth.R, survey.truth.t)
    assert survey.refine_jointly(turned) is None


def test_the_points_covariance_predicts_their_scatter() -> None:
    squares = []
    for trial in range(60):
        survey = Survey(f"joint points {trial}", EXACT)
        refined = survey.refine_jointly(survey.truth, EXACT)
        assert refined is not None
        e = survey.latent.points3d - survey.points
        squares.append(np.einsum("mi,mij,mj->m", e, np.linalg.inv(refined.point_covariance), e))
    # Three degrees of freedom; Cauchy's loss takes a little trust from each observation.
    assert 2.2 < np.mean(squares) < 3.0


def test_points_whose_rays_are_parallel_have_no_depth() -> None:
    """Of a point of two copies of a place the rays are parallel: it is as far as can be."""
    survey = Survey("joint parallel", EXACT)
    tracks, far = survey.latent.tracks, survey.latent.tracks.point < 10
    sight = survey.truth.R.T @ np.array([0.05, 0.1, 1.0])
    in_view = rotate(survey.map.R[tracks.view], sight)
    xy = np.where(far[:, None], in_view[:, :2] / in_view[:, 2:], tracks.xy)
    points3d = survey.latent.points3d.copy()
    points3d[:10] = 1e5 * sight
    survey.latent = LatentPoints(points3d, replace(tracks, xy=xy))
    refined = survey.refine_jointly(survey.truth, EXACT)
    assert refined is not None
    distances = np.linalg.norm(points3d - survey.truth.center, axis=1)
    std = np.sqrt(np.linalg.eigvalsh(refined.point_covariance)[:, -1])
    assert (std[:10] > 0.5 * distances[:10]).all()
    assert (std[10:] < 0.1 * distances[10:]).all()
