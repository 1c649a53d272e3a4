"""A rendered room, photographed and written down as public data sets are, with the truth of it.

The writers follow the descriptions of the formats, and know nothing of the importers.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from trigpoint.camera import Camera
from trigpoint.rigid import Rigid3, skew
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.synthetic import World, look_along, make_room, render, render_depth

Array = NDArray[np.float64]

MAX_ERROR_PX = 0.02
# What they all see: a corner of the room, from places a metre apart, upright, tilted and rolled.
POSES = look_along(
    np.array([[-1, -1, 1.3], [-0.4, -1.3, 1.1], [-1.3, -0.3, 1.5], [-0.3, -0.6, 1.4],
              [-0.8, -0.8, 1.2], [-0.6, -1.1, 1.4]]),
    np.array([0.7, 0.8, 0.5, 0.6, 0.65, 0.75]),
    np.array([-0.1, 0.05, -0.2, -0.1, 0.0, -0.15]),
    np.array([0.0, 0.15, -0.1, 0.3, 0.05, -0.05]),
)  # fmt: skip


@dataclass(frozen=True)
class VisualSfmCamera(Camera):
    """VisualSFM's lens as it is meant: u = m (1 + radial |m|^2) takes the distortion off."""

    radial: float = 0.0

    def normalize(self, points_px: NDArray[np.floating]) -> Array:
        m = super().normalize(points_px)
        u: Array = m * (1 + self.radial * np.square(m).sum(axis=1, keepdims=True))
        return u

    def project(self, points_cam: Array) -> Array:
        u = points_cam[:, :2] / points_cam[:, 2:]
        m = u
        for _ in range(100):
            m = u / (1 + self.radial * np.square(m).sum(axis=1, keepdims=True))
        return super().project(np.column_stack([m, np.ones(len(m))]))


@dataclass(frozen=True, eq=False)
class View:
    """A photograph: what took it, from where, and some points of the room that it shows."""

    camera: Camera
    cam_from_world: Rigid3
    points3d: Array  # (M, 3)
    points2d: Array  # (M, 2) px

    def see(self, points3d: Array) -> Array:
        return self.camera.project(self.cam_from_world.apply(points3d))


def take(path: Path, camera: Camera, cam_from_world: Rigid3, world: World | None = None) -> View:
    """Photograph the room into a file; the points lie on a grid in the picture."""
    world = make_room(0) if world is None else world
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), render(world, camera, cam_from_world, seed=len(str(path))))
    small = Camera("SIMPLE_PINHOLE", 16, 12, (14.0, 7.5, 5.5))
    depth = render_depth(world, small, cam_from_world)
    u, v = np.meshgrid(np.arange(16.0), np.arange(12.0))
    xy = small.normalize(np.column_stack([u.ravel(), v.ravel()]))
    points_cam = np.column_stack([xy, np.ones(len(xy))]) * depth.reshape(-1, 1)
    points2d = camera.project(points_cam)
    inside = ((points2d > 0) & (points2d < (camera.width - 1, camera.height - 1))).all(axis=1)
    points3d = cam_from_world.inverse().apply(points_cam[inside])
    return View(camera, cam_from_world, points3d, points2d[inside])


def check_truth(images: Iterable[PosedImage], views: Mapping[str, View]) -> None:
    """Assert that cameras and poses explain where the room's points are seen, to MAX_ERROR_PX."""
    images = list(images)
    assert len(images) >= 2
    for image in images:
        view = views[image.name]
        seen = image.camera.project(image.cam_from_world.apply(view.points3d))
        assert np.abs(seen - view.points2d).max() < MAX_ERROR_PX, image.name
    for a, b in combinations(images, 2):
        assert epipolar_error_px(a, b, views).max() < MAX_ERROR_PX, (a.name, b.name)


def epipolar_error_px(a: PosedImage, b: PosedImage, views: Mapping[str, View]) -> Array:
    """Sampson distances (M,) of the points of one view from their epipolar lines in another."""
    points_b = views[b.name].see(views[a.name].points3d)
    shown = ((points_b > 0) & (points_b < (b.camera.width - 1, b.camera.height - 1))).all(axis=1)
    assert shown.sum() > 20
    x_a, x_b = (
        np.column_stack([image.camera.normalize(points[shown]), np.ones(shown.sum())])
        for image, points in ((a, views[a.name].points2d), (b, points_b))
    )
    b_from_a = b.cam_from_world @ a.cam_from_world.inverse()
    E = skew(b_from_a.t) @ b_from_a.R
    line_b, line_a = x_a @ E.T, x_b @ E
    gradient = np.hypot(np.hypot(*line_b[:, :2].T), np.hypot(*line_a[:, :2].T))
    error: Array = np.abs((x_b * line_b).sum(axis=1)) / gradient * a.camera.focal_px
    return error


def numbers(*values: object) -> str:
    """Print as data sets do."""
    return " ".join(f"{value:.12g}" for group in values for value in np.atleast_1d(np.array(group)))


def matrix(transform: Rigid3) -> Array:
    """Return the 4 x 4 matrix."""
    bottom = np.array([[0.0, 0.0, 0.0, 1.0]])
    return np.vstack([np.column_stack([transform.R, transform.t]), bottom])


KINECT = Camera("SIMPLE_PINHOLE", 640, 480, (525.0, 319.5, 239.5))
COLOR_FROM_DEPTH = Rigid3(
    np.array([[0.99996518012567637, 0.0026765126468950343, -0.0079041012313000904],
              [-0.0027409311281316700, 0.99996302803027592, -0.0081504520778013286],
              [0.0078819942130445332, 0.0081718328771890631, 0.99993554558014031]]),
    np.array([-0.025558943178152542, 0.00010109636268061706, 0.0020318321729487039]),
)  # fmt: skip


def write_seven_scenes(root: Path, num_train: int = 3) -> dict[str, View]:
    """Two sequences of each split, and a frame on which the Kinect was lost."""
    views = {}
    for i in range(len(POSES)):
        sequence = f"seq-{1 + i % 2:02}" if i < num_train else "seq-03"
        stem = f"{sequence}/frame-{i:06}"
        views[f"{stem}.color.png"] = take(root / f"{stem}.color.png", KINECT, POSES[i])
        rows = matrix((COLOR_FROM_DEPTH.inverse() @ POSES[i]).inverse())
        text = "".join("".join(f" {value: .7e}\t" for value in row) + "\r\n" for row in rows)
        (root / f"{stem}.pose.txt").write_text(text, newline="")
    lost = " -1.#IND000e+000\t" * 4 + "\r\n"
    (root / "seq-01" / "frame-000900.pose.txt").write_text(lost * 4, newline="")
    (root / "TrainSplit.txt").write_text("sequence1\r\nsequence2\r\n", newline="")
    (root / "TestSplit.txt").write_text("sequence3\r\n", newline="")
    return views


def write_pseudo_truth(folder: Path, scene: str, names: Sequence[str]) -> dict[str, View]:
    """Poses by structure from motion of images of a scene: the first three are for training."""
    folder.mkdir()
    lines, views = [], {}
    camera = Camera("SIMPLE_PINHOLE", 640, 480, (525.505, 319.5, 239.5))
    for i, name in enumerate(names):
        views[name] = take(folder / "unused.png", camera, POSES[i])
        lines.append(f"{name} {numbers(POSES[i].quaternion, POSES[i].t)} 525.505\n")
    (folder / f"{scene}_train.txt").write_text("".join(lines[:3]))
    (folder / f"{scene}_test.txt").write_text("".join(lines[3:]))
    return views


def write_cambridge(root: Path) -> dict[str, View]:
    """Three images to map, two to test, one kilometres away, and one unknown to VisualSFM."""
    views, cameras, lists = {}, [], {"train": [""] * 0, "test": [""] * 0}
    for i in range(5):
        focal, radial = 420.0 + i, 0.06 - 0.03 * i
        lens = VisualSfmCamera("SIMPLE_PINHOLE", 480, 270, (focal, 239.5, 134.5), radial)
        name = f"seq{1 + i % 2}/frame{i + 1:05}.png"
        views[name] = take(root / name, lens, POSES[i])
        center, rotation = POSES[i].center, POSES[i].quaternion
        lists["train" if i < 3 else "test"].append(f"{name} {numbers(center, rotation)}\n")
        camera = numbers(focal, rotation, center, radial)
        cameras.append(f"{name.replace('.png', '.jpg')}\t{camera} 0 \n")
    far = "seq1/frame00900"
    lists["train"].append(f"{far}.png 3e6 -2e6 1e6 1 0 0 0\n")
    cameras.append(f"{far}.jpg\t400 1 0 0 0 3e6 -2e6 1e6 0 0\n")
    lists["test"].append("seq1/frame00901.png 0 0 0 1 0 0 0\n")
    for split, lines in lists.items():
        head = "Visual Landmark Dataset V1\nImageFile, Camera Position [X Y Z W P Q R]\n\n"
        (root / f"dataset_{split}.txt").write_text(head + "".join(lines))
    (root / "reconstruction.nvm").write_text(
        f"NVM_V3 \n\n{len(cameras)}\n{''.join(cameras)}\n1\n0.5 1 2 90 90 90 1 0 7 3.5 4.5\n\n0\n"
    )
    return views


def write_aachen(root: Path) -> dict[str, View]:
    """Two images of the town, one of a sequence, two queries by day and one by night; the NVM."""
    names = ("db/1045.jpg", "db/4446.jpg", "sequences/nexus4_sequences/sequence_1/1_1.jpg",
             "query/day/nexus4/IMG_1.jpg", "query/day/milestone/2.jpg",
             "query/night/nexus5x/IMG_3.jpg")  # fmt: skip
    views, cameras, lists = {}, [], {"db": "", "day": "", "night": ""}
    for i, name in enumerate(names):
        k1 = -0.08 + 0.02 * i
        lens = Camera("SIMPLE_RADIAL", 400, 300, (300.0 + i, 199.5, 149.5, k1))
        views[name] = take(root / "images_upright" / name, lens, POSES[i])
        line = f"{name} SIMPLE_RADIAL 400 300 {300.0 + i} 200 150 {k1}\n"
        lists[name.split("/")[1] if name.startswith("query") else "db"] += line
        if i < 3:
            pose = numbers(300.0 + i, POSES[i].quaternion, POSES[i].center, -k1)
            cameras.append(f"{name} {pose} 0\n")
    model, queries = root / "3D-models" / "aachen_v_1_1", root / "queries"
    model.mkdir(parents=True)
    queries.mkdir()
    (model / "database_intrinsics_v1_1.txt").write_text(lists["db"])
    (model / "aachen_v_1_1.nvm").write_text(f"NVM_V3 \n\n3\n{''.join(cameras)}\n0\n\n0\n")
    for time in ("day", "night"):
        (queries / f"{time}_time_queries_with_intrinsics.txt").write_text(lists[time])
    return views


def write_robotcar(root: Path) -> dict[str, View]:
    """Two places to map, from two cameras of the car; two conditions, one query with a pose."""
    rear = Camera("PINHOLE", 1024, 1024, (400.0, 401.0, 507.722931, 497.687378))
    names = ("overcast-reference/rear/1417178832816233.jpg",
             "overcast-reference/rear/1417178833316172.jpg",
             "dawn/rear/1418721355046418.jpg", "night/rear/1418236234885341.jpg")  # fmt: skip
    views = {name: take(root / "images" / name, rear, POSES[i]) for i, name in enumerate(names)}
    left = root / "images" / "dawn" / "left" / "1418721355046418.jpg"
    take(left, Camera("SIMPLE_PINHOLE", 16, 16, (14.0, 7.5, 7.5)), POSES[4])
    cameras = [
        f"./{name.replace('.jpg', '.png')} {numbers(400, pose.quaternion, pose.center, 0)} 0\n"
        for name, pose in [*((n, views[n].cam_from_world) for n in names[:2]),
                           (names[0].replace("rear", "left"), POSES[4])]
    ]  # fmt: skip
    model = root / "3D-models" / "all-merged"
    model.mkdir(parents=True)
    (model / "all.nvm").write_text(f"NVM_V3\n\n3\n{''.join(cameras)}\n0\n")
    (root / "intrinsics").mkdir()
    text = "fx 400.000000\nfy 401.000000\ncx 508.222931\ncy 498.187378\n"
    (root / "intrinsics" / "rear_intrinsics.txt").write_text(text)
    world_from_cam = matrix(views[names[2]].cam_from_world.inverse())
    line = f"{names[2].replace('.jpg', '.png')} {numbers(world_from_cam.ravel())}\n"
    (root / "robotcar_v2_train.txt").write_text(line)
    return views
