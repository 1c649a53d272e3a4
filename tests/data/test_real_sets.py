"""Real images with reference poses: build, localize, evaluate, by the commands of the README."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from tests.conftest import DATA
from tests.daemon.test_service import run, subscriber, write_config
from trigpoint.geometry.similarity import Similarity3
from trigpoint.rigid import rotation_angle, rotation_from_vector
from trigpoint_db.demo import BODY_FROM_CAMERA
from trigpoint_db.importers.colmap import read_model, write_model
from trigpoint_db.poses import read_queries

pytestmark = pytest.mark.skipif(
    not DATA.is_dir(), reason=f"needs the posed images in {DATA}, which are not ours to ship"
)


def trigpoint_db(*arguments: object, code: int = 0) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "trigpoint_db.cli", *map(str, arguments)],
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == code, done.stderr
    return done.stdout + (done.stderr if code else "")


@pytest.mark.parametrize(
    ("name", "split", "min_localized", "max_median_m", "max_median_deg"),
    [
        ("7scenes_redkitchen", "", 29, 0.003, 0.1),
        ("7scenes_redkitchen", "_block", 44, 0.010, 0.4),
        # Units are arbitrary here: the camera centers spread 3.06 and 3.66.
        ("fox", "", 10, 0.005, 0.06),
        ("fox", "_block", 15, 0.005, 0.06),
        ("tnt_truck", "", 25, 0.004, 0.06),
        ("tnt_truck", "_block", 31, 0.010, 0.2),
        ("kitti_seq1", "", 20, 0.012, 0.10),
        ("kitti_seq1", "_block", 32, 0.020, 0.12),
        ("strecha_fountain_p11", "", 2, 0.005, 0.03),
        ("strecha_fountain_p11", "_block", 4, 0.008, 0.05),
    ],
)
def test_real_queries_are_localized(
    tmp_path: Path,
    name: str,
    split: str,
    min_localized: int,
    max_median_m: float,
    max_median_deg: float,
) -> None:
    folder = DATA / name
    queries = folder / f"queries{split}.txt"
    map_, poses, results = tmp_path / "m.tpmap", tmp_path / "poses.txt", tmp_path / "results.jsonl"
    trigpoint_db("build", map_, folder, "--list", folder / f"map{split}.txt")
    trigpoint_db(
        "localize", map_, "--images", folder / "images", "--queries", queries,
        "--poses", poses, "--results", results,
    )  # fmt: skip
    report: dict[str, Any] = json.loads(
        trigpoint_db(
            "evaluate", "--poses", poses, "--truth", folder, "--queries", queries, "--json"
        )
    )
    assert report["num_localized"] >= min_localized
    assert report["median_position_m"] <= max_median_m
    assert report["median_rotation_deg"] <= max_median_deg
    lines = [json.loads(line) for line in results.read_text().splitlines()]
    assert len(lines) == report["num_queries"]
    assert sum(line["status"] == "LOCALIZED" for line in lines) == report["num_localized"]
    assert all(line["stage_ms"]["features"] > 0 for line in lines)


@pytest.mark.parametrize("name", ["7scenes_redkitchen", "fox", "tnt_truck", "kitti_seq1"])
def test_one_half_of_a_survey_comes_back_into_the_frame_of_the_other(
    tmp_path: Path, name: str
) -> None:
    """Moved, turned and scaled by chance; off by less than 1 % of the scale and of the extent."""
    folder = DATA / name
    posed = read_model(folder / "sparse")
    rng = np.random.default_rng(list(name.encode()))
    turn = rotation_from_vector(rng.normal(0, 2, 3))
    away = Similarity3(float(np.exp(rng.normal(0, 1.5))), turn, rng.normal(0, 50, 3))
    moved = [replace(i, cam_from_world=away.move(i.cam_from_world)) for i in posed[1::2]]
    write_model(tmp_path / "survey", moved)
    (tmp_path / "map.txt").write_text("\n".join(image.name for image in posed[::2]))
    map_ = tmp_path / "m.tpmap"
    trigpoint_db(
        "build", map_, folder / "sparse", "--images", folder / "images",
        "--list", tmp_path / "map.txt",
    )  # fmt: skip
    report = json.loads(
        trigpoint_db(
            "align", map_, tmp_path / "survey", "--images", folder / "images",
            "-o", tmp_path / "aligned", "--sample", 40, "--json",
        )
    )  # fmt: skip
    assert abs(report["scale"] * away.scale - 1) < 0.01
    assert np.rad2deg(rotation_angle(np.array(report["R"]) @ away.R)) < 0.5
    truth = {image.name: image.cam_from_world.center for image in posed}
    centers = np.array(list(truth.values()))
    extent = np.linalg.norm(centers.max(axis=0) - centers.min(axis=0))
    for image in read_model(tmp_path / "aligned"):
        assert np.linalg.norm(image.cam_from_world.center - truth[image.name]) < 0.01 * extent


def test_frames_of_another_place_are_refused(tmp_path: Path) -> None:
    kitchen, truck = DATA / "7scenes_redkitchen", DATA / "tnt_truck"
    map_, poses = tmp_path / "m.tpmap", tmp_path / "poses.txt"
    trigpoint_db("build", map_, kitchen)
    said = trigpoint_db(
        "localize", map_, "--images", truck / "images", "--queries", truck / "queries.txt",
        "--poses", poses, code=1,
    )  # fmt: skip
    assert "no query was localized" in said
    assert poses.read_text() == ""


def test_a_second_process_receives_every_pose_of_the_kitchen(tmp_path: Path, port: int) -> None:
    kitchen = DATA / "7scenes_redkitchen"
    trigpoint_db("build", tmp_path / "kitchen.tpmap", kitchen, "--list", kitchen / "map.txt")
    trigpoint_db(
        "record", tmp_path / "kitchen.mcap", "--images", kitchen / "images",
        "--queries", kitchen / "queries.txt", "--truth", kitchen,
    )  # fmt: skip
    config = write_config(
        tmp_path, tmp_path / "kitchen.tpmap", tmp_path / "kitchen.mcap", port=port
    )
    with subscriber(port) as samples:
        done = run("trigpointd", "run", "--config", config)
    assert done.returncode == 0, done.stderr
    assert "29 LOCALIZED, 0 dropped" in done.stderr
    assert len(samples["pose"]) == len(samples["status"]) == 29
    truth = read_model(kitchen / "sparse")
    names = [query.name for query in read_queries(kitchen / "queries.txt")]
    centers = {image.name: (BODY_FROM_CAMERA @ image.cam_from_world).center for image in truth}
    decode = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr
    for sample, name in zip(samples["pose"], names, strict=True):
        message: Any = decode(
            sample.payload.to_bytes(), "geometry_msgs/msg/PoseWithCovarianceStamped"
        )
        position = message.pose.pose.position
        assert np.linalg.norm(centers[name] - [position.x, position.y, position.z]) < 0.02
