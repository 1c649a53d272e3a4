"""Other methods than the localizer's: known answers, and the same files as the localizer's."""

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import Demo
from tests.unit.conftest import Run
from tests.unit.scenes import Scene, generator, make_scene
from trigpoint.camera import Camera
from trigpoint.database.reader import MapReader
from trigpoint.frame import Anchor, Frame, LocalFeatures, Lost, Prior, Reason, Statistics
from trigpoint.geometry.rotation_averaging import average_rotations
from trigpoint.images import read_gray
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.models.matching import MutualNearestNeighbors
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3, rotation_angle
from trigpoint.stages import estimate_relative_poses, match_anchors
from trigpoint_db.demo import BODY_FROM_CAMERA, CAMERA
from trigpoint_db.methods.baseline import Baseline, Estimate
from trigpoint_db.methods.matched import Matched
from trigpoint_db.methods.registry import MethodName, load_method
from trigpoint_db.poses import read_poses, write_poses

LENS = Camera("PINHOLE", 640, 480, (500.0, 500.0, 319.5, 239.5))
GEOMETRIC = [name for name in MethodName if name not in ("retrieval", "latent-points")]


def observe(scene: Scene, view: int) -> LocalFeatures:
    """See every point without noise; each has a descriptor of its own."""
    codes = generator("codes").standard_normal((len(scene.points3d), 32))
    descriptors = (codes / np.linalg.norm(codes, axis=1, keepdims=True)).astype(np.float32)
    points = LENS.project(scene.views_from_world[view].apply(scene.points3d))
    count = len(points)
    return LocalFeatures(
        points.astype(np.float32), descriptors, np.ones(count, np.float32), np.ones(1, np.float32)
    )


def match_scene(scene: Scene) -> Matched:
    """Take the first view for the frame and the others for its anchors."""
    views = [observe(scene, view) for view in range(len(scene.views_from_world))]
    anchors = [
        Anchor(
            f"{i}.png",
            LENS,
            scene.views_from_world[i],
            views[i].keypoints,
            np.clip(np.rint(views[i].descriptors * 127), -127, 127).astype(np.int8),
        )
        for i in range(1, len(views))
    ]
    matcher = MutualNearestNeighbors()
    query = match_anchors(LENS, views[0], anchors, matcher, 640)
    return Matched(LENS, views[0], anchors, query, matcher, Statistics())


def require_extra(name: MethodName) -> None:
    if name == MethodName.MAP_PNP:
        pytest.importorskip("pycolmap")


@pytest.mark.parametrize("name", GEOMETRIC)
def test_exact_matches_give_the_exact_pose(name: MethodName) -> None:
    require_extra(name)
    scene = make_scene("exact", num_points=200, num_views=7)
    truth = scene.views_from_world[0]
    found = load_method(name)(match_scene(scene), LocalizerOptions())
    assert isinstance(found, Rigid3)
    np.testing.assert_allclose(found.center, truth.center, atol=1e-3)
    assert rotation_angle((found @ truth.inverse()).R) < 1e-3


def test_retrieval_gives_the_pose_of_the_first_anchor() -> None:
    scene = make_scene("retrieval")
    found = load_method(MethodName.RETRIEVAL)(match_scene(scene), LocalizerOptions())
    assert isinstance(found, Rigid3)
    np.testing.assert_array_equal(found.t, scene.views_from_world[1].t)


def test_the_midpoint_is_that_of_one_pair_and_averages_are_of_all_that_agree() -> None:
    """With anchors astray; where rotations are right, both averages are the same."""
    scene = make_scene("turned", num_points=200, num_views=8)
    matched = match_scene(scene)
    rng = generator("turns")
    views = matched.query.views
    noisy = Rigid3.from_center(views.R, views.center + rng.normal(0, 0.05, views.t.shape))
    matched = replace(matched, query=replace(matched.query, views=noisy))
    options = LocalizerOptions()
    names = (MethodName.MIDPOINT, MethodName.RELATIVE_POSES, MethodName.TRANSLATION_AVERAGING)
    found = [load_method(name)(matched, options) for name in names]
    assert all(isinstance(pose, Rigid3) for pose in found)
    centers = np.array([pose.center for pose in found if isinstance(pose, Rigid3)])
    assert np.linalg.norm(centers[1:] - centers[0], axis=1).min() > 1e-4
    np.testing.assert_allclose(centers[1], centers[2], atol=1e-5)
    chosen, relative = estimate_relative_poses(matched.query, options)
    expected = average_rotations(relative.R @ noisy[chosen].R)
    assert isinstance(found[1], Rigid3)
    np.testing.assert_allclose(found[1].R, expected, atol=1e-6)


@pytest.mark.parametrize("name", GEOMETRIC)
def test_anchors_that_share_nothing_with_the_frame_are_no_ground_for_a_pose(
    name: MethodName,
) -> None:
    require_extra(name)
    scene = make_scene("elsewhere", num_points=80, num_views=4)
    matched, rng = match_scene(scene), generator("noise")
    anchors = [
        replace(a, keypoints=rng.uniform(0, 480, a.keypoints.shape).astype(np.float32))
        for a in matched.anchors
    ]
    query = match_anchors(LENS, matched.features, anchors, matched.matcher, 640)
    matched = replace(matched, anchors=anchors, query=query)
    found = load_method(name)(matched, LocalizerOptions())
    assert found in (Reason.FEW_ANCHORS, Reason.FEW_MATCHES, Reason.FEW_INLIERS)


@pytest.fixture(scope="module")
def localizer(demo: Demo, model: FeatureModel) -> Iterator[Localizer]:
    ticks = iter(range(1_000_000))
    with MapReader.open(demo.map, model.identity) as reader:
        yield Localizer(model, reader, clock=lambda: float(next(ticks)))


def true_poses(demo: Demo, names: Sequence[str]) -> dict[str, Rigid3]:
    """Name the cameras' poses as the frames: the demo names them by their time."""
    poses = [BODY_FROM_CAMERA.inverse() @ pose for pose in read_poses(demo.truth).values()]
    return dict(zip(names, poses, strict=False))


@pytest.mark.parametrize("name", GEOMETRIC)
def test_frames_of_the_rendered_room_are_localized(
    demo: Demo, localizer: Localizer, name: MethodName
) -> None:
    require_extra(name)
    paths = sorted((demo.folder / "flight").glob("*.jpg"))
    truth = true_poses(demo, [path.name for path in paths])
    for path in (paths[0], paths[10]):
        result = Baseline(name, localizer).localize(Frame(read_gray(path), CAMERA))
        assert isinstance(result, Estimate)
        error = result.cam_from_world.center - truth[path.name].center
        assert np.linalg.norm(error) < 0.25
        assert result.statistics.generator == name
        assert result.statistics.num_anchors == 20
        assert list(result.statistics.stage_ms) == ["features", "retrieval", "matching", "pose"]


def test_a_frame_that_shows_nothing_and_one_from_nowhere_are_lost(
    demo: Demo, localizer: Localizer
) -> None:
    baseline = Baseline(MethodName.MIDPOINT, localizer)
    gray = np.full((CAMERA.height, CAMERA.width), 90, np.uint8)
    result = baseline.localize(Frame(gray, CAMERA))
    assert isinstance(result, Lost)
    assert result.reason == Reason.FEW_FEATURES
    image = read_gray(next(iter(sorted((demo.folder / "flight").glob("*.jpg")))))
    result = baseline.localize(Frame(image, CAMERA), Prior((1e4, 0.0, 0.0), 1.0))
    assert isinstance(result, Lost)
    assert result.reason == Reason.FEW_ANCHORS


@pytest.mark.parametrize("name", [MethodName.MIDPOINT, MethodName.LATENT_POINTS])
def test_poses_and_results_are_written_like_those_of_the_localizer(
    run: Run, demo: Demo, tmp_path: Path, name: MethodName
) -> None:
    lines = (demo.folder / "queries.txt").read_text().splitlines()[:3]
    (tmp_path / "queries.txt").write_text("\n".join(lines))
    names = [line.split()[0] for line in lines]
    code, out, err = run(
        "localize", demo.map, "--images", demo.folder / "flight", "--method", name,
        "--queries", tmp_path / "queries.txt", "--poses", tmp_path / "poses.txt",
        "--results", tmp_path / "results.jsonl", "--json",
    )  # fmt: skip
    assert code == 0, err
    assert json.loads(out) == {"num_queries": 3, "outcomes": {"LOCALIZED": 3}}
    results = [json.loads(line) for line in (tmp_path / "results.jsonl").read_text().splitlines()]
    assert [result["name"] for result in results] == names
    assert all((result["covariance"] is None) == (name != "latent-points") for result in results)
    truth = tmp_path / "truth.txt"
    write_poses(truth, true_poses(demo, names))
    code, out, err = run(
        "evaluate", "--poses", tmp_path / "poses.txt", "--truth", truth, "--json"
    )  # fmt: skip
    assert code == 0, err
    assert json.loads(out)["median_position_m"] < 0.2
    code, _, err = run(
        "report", demo.map, "--results", tmp_path / "results.jsonl", "--poses",
        tmp_path / "poses.txt", "--truth", truth, "--queries", tmp_path / "queries.txt",
        "--images", demo.folder / "flight", "--map-images", demo.folder / "survey",
        "-o", tmp_path / "report.html",
    )  # fmt: skip
    assert code == 0, err
    assert names[0] in (tmp_path / "report.html").read_text()


def test_map_pnp_without_pycolmap_says_what_to_install(
    run: Run, demo: Demo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr("trigpoint_db.methods.map_pnp", raising=False)
    monkeypatch.delitem(sys.modules, "trigpoint_db.methods.map_pnp", raising=False)
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    code, _, err = run(
        "localize", demo.map, "--images", demo.folder / "flight", "--method", "map-pnp",
        "--queries", demo.folder / "queries.txt", "--poses", tmp_path / "poses.txt",
        "--results", tmp_path / "results.jsonl",
    )  # fmt: skip
    assert code == 1
    assert "pip install 'trigpoint[colmap]'" in err
    assert list(tmp_path.iterdir()) == []  # before any work
