"""Images that are better left out: planted ones are found, others are not."""

import json
import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.conftest import Demo
from tests.unit.conftest import Run
from tests.unit.maps import make_map
from trigpoint.camera import Camera
from trigpoint.database.reader import MapReader
from trigpoint.database.writer import MapWriter
from trigpoint.errors import ConfigError
from trigpoint.images import read_gray
from trigpoint.models.features import FeatureModel
from trigpoint.rigid import Rigid3, rotation_angle
from trigpoint_db.build import build_map
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.importers.colmap import read_model, write_model
from trigpoint_db.overlap import TwoView, measure_overlap
from trigpoint_db.selection import Density, Flaw, find_needless, measure_blur, select

FIRST = 112  # of the demo's images: those before are there for these to overlap with
BLURRED, MOVED, TWICE, WALL = "000116.jpg", "000128.jpg", "000121b.jpg", "wall.jpg"


def blur(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), 2.5)


def smear(image: np.ndarray) -> np.ndarray:
    kernel = np.full((1, 11), 1 / 11, np.float32)
    return cv2.filter2D(image, -1, kernel)


@pytest.fixture(scope="module")
def survey(demo: Demo, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[PosedImage]]:
    """The last stations of the demo's survey, some images of which were spoilt."""
    folder = tmp_path_factory.mktemp("planted")
    shutil.copytree(demo.folder / "survey", folder / "images")
    posed = read_model(demo.folder / "sparse")[FIRST:]
    for name, spoil in ((BLURRED, blur), (MOVED, smear)):
        path = folder / "images" / name
        cv2.imwrite(str(path), spoil(read_gray(path)))
    rng = np.random.default_rng(0)
    again = read_gray(folder / "images" / "000121.jpg")
    cv2.imwrite(str(folder / "images" / TWICE), again, [cv2.IMWRITE_JPEG_QUALITY, 80])
    wall = np.rint(180 + rng.normal(0, 2, (480, 640))).astype(np.uint8)
    cv2.imwrite(str(folder / "images" / WALL), wall)
    by_name = {image.name: image for image in posed}
    same = by_name["000121.jpg"].cam_from_world
    nudged = Rigid3(same.R, same.t + 1e-3)
    camera = posed[0].camera
    planted = [PosedImage(TWICE, camera, nudged), PosedImage(WALL, camera, posed[3].cam_from_world)]
    posed = sorted([*posed, *planted], key=lambda image: image.name)
    write_model(folder / "sparse", posed)
    return folder, posed


@pytest.fixture(scope="module")
def spoilt_map(
    demo: Demo, survey: tuple[Path, list[PosedImage]], model: FeatureModel
) -> tuple[Path, Path]:
    """The demo's map with these images in the place of its last."""
    folder, posed = survey
    build_map(folder / "new.tpmap", posed, folder / "images", model)
    path = folder / "map.tpmap"
    with (
        MapReader.open(demo.map) as whole,
        MapReader.open(folder / "new.tpmap") as new,
        MapWriter.create(path, model.identity) as writer,
    ):
        for reader, indices in ((whole, range(FIRST)), (new, range(len(new)))):
            for index in indices:
                record = reader.record(index)
                writer.add_record(record, record.name)
    return path, folder / "images"


def test_planted_images_are_found_and_no_others(
    spoilt_map: tuple[Path, Path], model: FeatureModel
) -> None:
    path, images = spoilt_map
    with MapReader.open(path) as reader:
        found = select(reader, images, model.long_side_px, first=FIRST)
    # Of the two that are the same, either one.
    assert {f.name.replace("b.jpg", ".jpg"): f.flaw for f in found.findings} == {
        BLURRED: Flaw.BLURRED,
        MOVED: Flaw.BLURRED,
        "000121.jpg": Flaw.DUPLICATE,
        WALL: Flaw.NO_OVERLAP,
    }
    assert found.num_images == 140 - FIRST + 2
    assert 1.0 < found.median_depth < 5.0
    assert found.counts == {"no_overlap": 1, "blurred": 2, "duplicate": 1, "dense": 0}
    assert str(found) == "1 no overlap, 2 blurred, 1 duplicate"


def test_select_lists_them_and_writes_a_map_without_them(
    run: Run, spoilt_map: tuple[Path, Path], tmp_path: Path
) -> None:
    path, images = spoilt_map
    out = tmp_path / "selected.tpmap"
    asked = ["select", path, "--images", images, "--density", "40%", "--density-angle", 50]
    code, said, _ = run(*asked, "--json", "-o", out)
    assert code == 0
    facts = json.loads(said)
    flaws = {image["name"]: image["flaw"] for image in facts["images"]}
    assert flaws[BLURRED] == "blurred"
    assert facts["counts"]["dense"] > 0
    with MapReader.open(path) as before, MapReader.open(out) as after:
        assert after.names() == [name for name in before.names() if name not in flaws]
        assert after.verify() == []
        assert len(after) == facts["num_images_left"]


def test_build_counts_them_and_leaves_them_out_when_asked(
    run: Run, survey: tuple[Path, list[PosedImage]], tmp_path: Path
) -> None:
    folder, posed = survey
    names = tmp_path / "names.txt"
    first, last = [image.name for image in posed[:20]], [image.name for image in posed[20:24]]
    names.write_text("\n".join([*first, WALL]))
    asked = ["build", tmp_path / "m.tpmap", folder, "--list", names]
    code, said, _ = run(*asked)
    assert code == 0
    assert "1 no overlap" in said
    assert "1 duplicate; --select leaves such images out" in said
    (tmp_path / "m.tpmap").unlink()
    code, said, _ = run(*asked, "--select", "--json")
    assert code == 0
    facts = json.loads(said)
    flaws = {image["name"]: image["flaw"] for image in facts["selection"]["images"]}
    assert flaws[WALL] == "no_overlap"
    assert "duplicate" in (flaws.get("000121.jpg"), flaws.get(TWICE))
    kept = [name for name in first if name not in flaws]
    assert facts["num_images_added"] == len(kept)
    names.write_text("\n".join([*kept, *last]))
    code, said, _ = run("add", *asked[1:], "--skip-existing", "--select", "--json")
    assert code == 0
    facts = json.loads(said)
    assert facts["selection"]["num_images"] == len(last)
    flaws |= {image["name"]: image["flaw"] for image in facts["selection"]["images"]}
    with MapReader.open(tmp_path / "m.tpmap") as reader:  # what was there stays
        assert reader.names() == kept + [name for name in last if name not in flaws]
    code, _, said = run("build", tmp_path / "c.tpmap", folder, "--density", "1")
    assert code == 1
    assert "--density is for --select" in said


@pytest.mark.parametrize("text", ["", "x", "-1", "0", "inf", "nan", "5 m", "%"])
def test_a_density_that_is_none_is_an_error(text: str) -> None:
    with pytest.raises(ConfigError, match="a density is a distance"):
        Density.from_text(text, 15.0)


def test_a_density_is_a_distance_or_a_share_of_the_depth() -> None:
    assert Density.from_text("0.5", 10.0) == Density(0.5, False, 10.0)
    assert Density.from_text("10%", 10.0) == Density(0.1, True, 10.0)


def test_blur_rises_with_the_kernel_whatever_the_picture_shows(demo: Demo) -> None:
    for name in ("000000.jpg", "000033.jpg", "000077.jpg"):
        image = read_gray(demo.folder / "survey" / name)
        measured = [measure_blur(image, 640)]
        for sigma in (1.0, 2.0, 4.0):
            blurred = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.uint8)
            measured.append(measure_blur(blurred, 640))
        assert measured == sorted(measured)
        assert 0 < measured[0] < measured[-1] < 1


def test_an_image_of_one_gray_is_as_blurred_as_can_be() -> None:
    assert measure_blur(np.full((60, 80), 128, np.uint8), 640) == 1.0


def test_kept_images_are_apart_and_the_others_near_one_of_them() -> None:
    rng = np.random.default_rng(3)
    R = Rotation.from_rotvec(rng.normal(0, 0.3, (80, 3))).as_matrix()
    poses = Rigid3.from_center(R, rng.uniform(0, 2, (80, 3)))
    needless = find_needless(poses, rng.permutation(80).tolist(), 0.6, 20.0)
    kept = [i for i in range(80) if i not in needless]

    def near(i: int, j: int) -> bool:
        distance = np.linalg.norm(poses.center[i] - poses.center[j])
        return bool(distance <= 0.6 and rotation_angle(poses.R[i] @ poses.R[j].T) <= np.pi / 9)

    assert 0 < len(kept) < 80
    assert not any(near(i, j) for i in kept for j in kept if i != j)
    assert all(j in kept and near(i, j) for i, j in needless.items())


def test_the_first_of_two_that_are_near_is_kept() -> None:
    poses = Rigid3(np.stack([np.eye(3)] * 2), np.zeros((2, 3)))
    assert find_needless(poses, [1, 0], 0.1, 1.0) == {0: 1}
    assert find_needless(poses, [1, 0], 0.1, 1.0, lambda i, j: False) == {}
    assert find_needless(poses, [1, 0], float("nan"), 1.0) == {}
    assert find_needless(poses, [1], 0.1, 1.0, first=1) == {1: 0}  # the first is there already


def test_a_map_of_two_images_of_nothing_has_no_overlap(model: FeatureModel, tmp_path: Path) -> None:
    camera = Camera("PINHOLE", 640, 480, (500.0, 500.0, 319.5, 239.5))
    rng = np.random.default_rng(1)
    names = ["a.png", "b.png"]
    for name in names:
        cv2.imwrite(str(tmp_path / name), rng.integers(120, 130, (480, 640), np.uint8))
    posed = [PosedImage(name, camera, Rigid3.identity()) for name in names]
    build_map(tmp_path / "m.tpmap", posed, tmp_path, model)
    with MapReader.open(tmp_path / "m.tpmap") as reader:
        found = select(reader, tmp_path, model.long_side_px)
        assert [finding.flaw for finding in found.findings] == [Flaw.NO_OVERLAP] * 2
        assert found.to_json()["median_depth"] is None
        with pytest.raises(ConfigError, match="give --density in the map's unit"):
            select(reader, tmp_path, model.long_side_px, density=Density.from_text("10%", 15.0))


def test_a_depth_that_is_known_is_not_lost_to_a_pair_that_shows_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pairs = iter([TwoView(np.zeros((30, 2), int), 5.0), TwoView(np.zeros((35, 2), int), math.nan)])
    monkeypatch.setattr("trigpoint_db.overlap.verify_pair", lambda *_: next(pairs))
    with MapReader.open(make_map(tmp_path / "m.tpmap", 3)) as reader:
        assert measure_overlap(reader, 0, 640, enough=40) == (35, 5.0)
