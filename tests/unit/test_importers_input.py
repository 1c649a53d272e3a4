"""What importers say of damaged data sets: one line, with the file and the line's number."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.unit.layouts import COLOR_FROM_DEPTH, POSES, matrix, numbers
from trigpoint.errors import ConfigError
from trigpoint_db.importers.base import pose_from_matrix, read_image_size
from trigpoint_db.importers.registry import find_format, read_dataset

IDENTITY = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
HEADING = "Visual Landmark Dataset V1\nImageFile, Camera Position [X Y Z W P Q R]\n\n"
# A PNG file up to its size, 480 x 270: nobody decodes these images.
PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\x01\xe0\0\0\x01\x0e"


def seven_scenes(root: Path) -> None:
    (root / "seq-01").mkdir()
    (root / "seq-01" / "frame-000000.pose.txt").write_text(IDENTITY)
    (root / "TrainSplit.txt").write_text("sequence1\n")
    (root / "TestSplit.txt").write_text("")


def cambridge(root: Path) -> None:
    (root / "seq1").mkdir()
    (root / "seq1" / "a.png").write_bytes(PNG)
    (root / "dataset_train.txt").write_text(HEADING + "seq1/a.png 0 0 0 1 0 0 0\n")
    (root / "dataset_test.txt").write_text(HEADING)
    (root / "reconstruction.nvm").write_text("NVM_V3\n\n1\nseq1/a.jpg 400 1 0 0 0 0 0 0 0.1 0\n")


def aachen(root: Path) -> None:
    model, queries = root / "3D-models" / "aachen_v_1_1", root / "queries"
    model.mkdir(parents=True)
    queries.mkdir()
    (model / "aachen_v_1_1.nvm").write_text("NVM_V3\n\n1\ndb/1.jpg 400 1 0 0 0 0 0 0 0 0\n")
    lists = [model / "database_intrinsics_v1_1.txt"]
    lists += [queries / f"{t}_time_queries_with_intrinsics.txt" for t in ("day", "night")]
    for path, name in zip(lists, ("db/1.jpg", "query/day/1.jpg", "query/night/1.jpg"), strict=True):
        path.write_text(f"{name} SIMPLE_RADIAL 400 300 300 200 150 0.1\n")


def robotcar(root: Path) -> None:
    model, intrinsics = root / "3D-models" / "all-merged", root / "intrinsics"
    model.mkdir(parents=True)
    intrinsics.mkdir()
    name = "overcast-reference/rear/1.png"
    (model / "all.nvm").write_text(f"NVM_V3\n\n1\n./{name} 400 1 0 0 0 0 0 0 0 0\n")
    (intrinsics / "rear_intrinsics.txt").write_text("fx 400\nfy 400\ncx 508\ncy 498\n")
    line = f"dawn/rear/1.png {numbers(np.eye(4).ravel())}\n"
    (root / "robotcar_v2_train.txt").write_text(line)


def pseudo_truth(root: Path) -> None:
    seven_scenes(root)
    for split in ("train", "test"):
        text = "seq-01/frame-000000.color.png 1 0 0 0 0 0 0 525\n"
        (root / f"{root.name}_{split}.txt").write_text(text)


NVM, TRAIN = "reconstruction.nvm", "dataset_train.txt"
FRAME = "seq-01/frame-000000.pose.txt"
INTRINSICS, V2 = "intrinsics/rear_intrinsics.txt", "robotcar_v2_train.txt"
LIST = "3D-models/aachen_v_1_1/database_intrinsics_v1_1.txt"
NIGHT = "queries/night_time_queries_with_intrinsics.txt"
PSEUDO = "pseudo_train.txt"


@pytest.mark.parametrize(
    ("write", "name", "text", "message"),
    [
        (seven_scenes, "TestSplit.txt", None, "cannot read .*TestSplit.txt: No such file"),
        (seven_scenes, "TrainSplit.txt", "sequence1\nseq-02\n", ":2: expected 'sequence1' or the"),
        (seven_scenes, "TrainSplit.txt", "sequence1\nsequence1\n", ":2: seq-01 is in this file tw"),
        (seven_scenes, "TrainSplit.txt", "sequence2\n", ":1: .*seq-02 holds no frames; unzip"),
        (seven_scenes, FRAME, "1 0 0 0\n0 1 0\n", ":2: expected a row of a 4 x 4 matrix, not '0 1"),
        (seven_scenes, FRAME, "1 0 0 0\n0 1 x 0\n", ":2: expected a row of a 4 x 4 matrix"),
        (seven_scenes, FRAME, IDENTITY[:24], "pose.txt: a 4 x 4 matrix has 16 numbers, not 12"),
        (seven_scenes, FRAME, IDENTITY.replace("1", "2"), "pose.txt: the matrix is no rigid"),
        (pseudo_truth, PSEUDO, None, "cannot read .*pseudo_train.txt: No such file"),
        (pseudo_truth, PSEUDO, "a.png 1 0 0 0 0 0 0\n", ":1: expected 'name qw qx qy qz tx ty tz"),
        (pseudo_truth, PSEUDO, "a.png 1 0 0 0 0 nan 0 525\n", ":1: the pose .* is not finite"),
        (pseudo_truth, PSEUDO, "a.png 1 0 0 0 0 0 0 0\n", ":1: camera parameters .* not usable"),
        (pseudo_truth, PSEUDO, "a 1 0 0 0 0 0 0 525\n" * 2, ":2: a is in this file twice"),
        (cambridge, NVM, None, "cannot read .*reconstruction.nvm: No such file"),
        (cambridge, NVM, "", "reconstruction.nvm: expected 'NVM_V3'"),
        (cambridge, NVM, "ply\n", ":1: expected 'NVM_V3', the head of an NVM file, not 'ply'"),
        (cambridge, NVM, "NVM_V3\n\nmany\n", ":3: expected the number of cameras, not 'many'"),
        (cambridge, NVM, "NVM_V3\n\n2\na 9 1 0 0 0 0 0 0 0 0\n", "is cut off: it has 1 of its 2"),
        (cambridge, NVM, "NVM_V3\n\n1\na 9 1 0 0 0 0 0 0\n", ":4: expected 'name focal qw qx"),
        (cambridge, NVM, "NVM_V3\n\n1\na 9 1 0 0 0 0 nan 0 0 0\n", ":4: the pose .* not finite"),
        (cambridge, NVM, "NVM_V3\n\n1\nseq1/a.jpg 400 1 0 0 0 0 0 0 -2 0\n", ":4: .* too strong"),
        (cambridge, NVM, "NVM_V3\n\n1\nseq1/a.jpg 0 1 0 0 0 0 0 0 0 0\n", ":4: .* not usable"),
        (cambridge, NVM, "NVM_V3\n\n1\nseq1/a.jpg 400 1 0 0 0 0 0 0 inf 0\n", ":4: .* not usable"),
        (cambridge, TRAIN, "", ":1: expected 'Visual Landmark Dataset V1'"),
        (cambridge, TRAIN, "a.png 0 0 0 1 0 0 0\n", ":1: expected 'Visual Landmark Dataset V1'"),
        (cambridge, TRAIN, HEADING + "a.png 0 0 0 1 0 0\n", ":4: expected 'name x y z w p q r'"),
        (cambridge, TRAIN, HEADING + "a.png 0 0 inf 1 0 0 0\n", ":4: the pose .* is not finite"),
        (cambridge, TRAIN, HEADING + "a.png 0 0 0 0 0 0 0\n", ":4: the quaternion .* is not one"),
        (cambridge, TRAIN, HEADING + "b 0 0 0 1 0 0 0\n" * 2, ":5: b is in this file twice"),
        (cambridge, "seq1/a.png", None, "cannot read .*a.png: No such file"),
        (cambridge, "seq1/a.png", "a picture\n", "a.png: the image of 10 bytes is no JPEG or PNG"),
        (aachen, NIGHT, None, "cannot read .*night_time.*: No such file"),
        (aachen, NIGHT, "query/night/1.jpg\n", ":1: expected 'name MODEL width height params"),
        (aachen, LIST, "db/2.jpg PINHOLE 4 3 3 3 2 1\n", "nvm:4: .* has no camera of db/1.jpg"),
        (robotcar, INTRINSICS, None, "cannot read .*rear_intrinsics.txt: No such file"),
        (robotcar, INTRINSICS, "fx 400\nfy\n", ":2: expected 'fx 400.0' or the like, not 'fy'"),
        (robotcar, INTRINSICS, "fx 400\nfy 400\ncx 508\n", "has no line 'cy ...'"),
        (
            robotcar,
            INTRINSICS,
            "fx 0\nfy 1\ncx 1\ncy 1\n",
            "rear_intrinsics.txt: camera parameters",
        ),
        (robotcar, V2, "dawn/rear/1.png 1 0 0\n", ":1: expected 'name m00 m01"),
        (robotcar, V2, f"a {numbers(np.eye(4).ravel())}\n" * 2, ":2: a is in this file twice"),
        (robotcar, V2, f"a {'nan ' * 16}\n", ":1: the pose is not finite"),
        (robotcar, V2, f"a {'0 ' * 16}\n", ":1: the matrix is no rigid transform"),
    ],
)
def test_damaged_data_sets_are_one_line(
    tmp_path: Path, write: Callable[[Path], None], name: str, text: str | None, message: str
) -> None:
    root = tmp_path / "pseudo"
    root.mkdir()
    write(root)
    poses = root if write is pseudo_truth else None
    name_of_format = find_format(root)
    assert len(read_dataset(root, poses=poses).mapped) == 1
    if text is None:
        (root / name).unlink()
    else:
        (root / name).write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        read_dataset(root, name_of_format, poses=poses)
    assert "\n" not in str(caught.value)


def test_lists_without_poses_say_what_is_missing(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text("a.jpg PINHOLE 4 3 3 3 2 1\n")
    with pytest.raises(ConfigError, match="name the file of their poses: --poses"):
        read_dataset(tmp_path / "list.txt")


def test_a_matrix_and_its_transform_are_the_same() -> None:
    transform = COLOR_FROM_DEPTH @ POSES[3]
    read = pose_from_matrix("here", matrix(transform).ravel().tolist())
    np.testing.assert_allclose(read.R, transform.R, atol=1e-12)
    np.testing.assert_allclose(read.t, transform.t, atol=1e-12)


@pytest.mark.parametrize("at", [(0, 0), (2, 3), (3, 3), (3, 0)])
def test_a_matrix_that_mirrors_or_scales_is_refused(at: tuple[int, int]) -> None:
    values = matrix(POSES[0])
    values[at] = np.nan if at == (2, 3) else values[at] + 0.5
    with pytest.raises(ConfigError, match=r"here: the (matrix is no rigid|pose is not finite)"):
        pose_from_matrix("here", values.ravel().tolist())
    mirrored = matrix(POSES[0])
    mirrored[0, :3] *= -1
    with pytest.raises(ConfigError, match="no rigid transform"):
        pose_from_matrix("here", mirrored.ravel().tolist())


def test_the_size_of_an_image_is_read_from_its_head(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(PNG)
    assert read_image_size(tmp_path / "a.png") == (480, 270)


def test_a_number_beyond_any_measure_is_one_line(tmp_path: Path) -> None:
    cambridge(tmp_path)
    (tmp_path / "reconstruction.nvm").write_text("NVM_V3\n\n" + "9" * 23 + "\n")
    with pytest.raises(ConfigError, match="is damaged, or not of the format cambridge") as caught:
        read_dataset(tmp_path)
    assert "\n" not in str(caught.value)
