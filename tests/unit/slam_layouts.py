"""The rendered room, filmed and written down as SLAM's and NeRF's data sets are, with the truth.

The writers follow the descriptions of the formats, and know nothing of the importers.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros2.writer import Writer as RosWriter
from rosbags.typesys import Stores, get_typestore

from tests.unit.layouts import POSES, View, matrix, numbers, take
from trigpoint.camera import Camera
from trigpoint.rigid import Rigid3, rotation_from_vector
from trigpoint_db.synthetic import make_room

STORE = get_typestore(Stores.ROS2_HUMBLE)
START_NS = 1_305_031_102_175_304_000
OPENGL_FROM_OPENCV = Rigid3(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
# Body x ahead, y left, z up, as REP 103 has it; the camera is 20 cm in front, turned to the right.
BODY_FROM_CAM = Rigid3.from_quaternion([0.43, -0.5, 0.56, -0.5], [0.2, -0.05, 0.1])


def moved(start: Rigid3, seconds: float) -> Rigid3:
    """Where a body is that moves and turns at constant speed: what interpolation gets right."""
    turned = start.R @ rotation_from_vector(np.array([0.02, -0.05, 0.03]) * seconds)
    return Rigid3(turned, start.t + np.array([0.3, -0.1, 0.05]) * seconds)


room = cache(make_room)


def film(
    root: Path, camera: Camera, names: Iterable[str], poses: Iterable[Rigid3]
) -> dict[str, View]:
    """Take an image from each world_from_cam."""
    views = {}
    for name, world_from_cam in zip(names, poses, strict=True):
        views[name] = take(root / name, camera, world_from_cam.inverse(), room(0))
    return views


def tum_pose(seconds: str, world_from_cam: Rigid3) -> str:
    w, x, y, z = world_from_cam.quaternion
    return f"{seconds} {numbers(world_from_cam.t, (x, y, z, w))}\n"


def write_tum(root: Path, camera: Camera) -> dict[str, View]:
    """Images 0.5 s apart; poses 0.1 s apart from the second on, but for a second in the middle."""
    times = [1305031102 + 0.175304 + 0.5 * i for i in range(6)]
    world_from_cam = [moved(POSES[0].inverse(), time - times[0]) for time in times]
    names = [f"rgb/{time:.6f}.png" for time in times]
    views = film(root, camera, names, world_from_cam)
    head = "# color images\n# file: 'rgbd_dataset_freiburg1_room.bag'\n# timestamp filename\n"
    lines = [f"{time:.6f} {name}\n" for time, name in zip(times, names, strict=True)]
    (root / "rgb.txt").write_text(head + "".join(lines))
    lines = ["# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n"]
    for i in range(25):
        seconds = f"{1305031102 + 0.52 + 0.1 * i:.4f}"
        if not 8 <= i <= 14:
            pose = moved(POSES[0].inverse(), float(seconds) - times[0])
            lines.append(tum_pose(seconds, pose))
    (root / "groundtruth.txt").write_text("".join(lines))
    return views


EUROC_BODY_FROM_CAM = """\
0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,
         0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,
        -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949,
         0.0, 0.0, 0.0, 1.0"""
EUROC_SENSOR = """\
# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [{body_from_cam}]

# Camera specific definitions.
rate_hz: 20
resolution: [{width}, {height}]
camera_model: pinhole
intrinsics: [{intrinsics}] #fu, fv, cu, cv
distortion_model: {lens}
distortion_coefficients: [{distortion}]

"""


def write_euroc(root: Path, camera: Camera) -> dict[str, View]:
    """Images 0.5 s apart, poses 5 ms apart from shortly after the first image on."""
    values = [float(word) for word in EUROC_BODY_FROM_CAM.replace(",", " ").split()]
    T = np.reshape(values, (4, 4))
    body_from_cam = Rigid3(T[:3, :3], T[:3, 3])
    start = POSES[0].inverse() @ body_from_cam.inverse()
    times_ns = [START_NS + i * 500_000_000 + 1_234_567 for i in range(4)]
    names = [f"cam0/data/{time_ns}.png" for time_ns in times_ns]
    poses = [moved(start, (t - START_NS) * 1e-9) @ body_from_cam for t in times_ns]
    mav0 = root / "mav0"
    views = film(mav0, camera, names, poses)
    lines = ["#timestamp [ns],filename", *(f"{t},{t}.png" for t in times_ns)]
    (mav0 / "cam0" / "data.csv").write_text("\r\n".join(lines) + "\r\n", newline="")
    lens = {"OPENCV": "radial-tangential", "OPENCV_FISHEYE": "equidistant"}[camera.model]
    text = EUROC_SENSOR.format(
        body_from_cam=EUROC_BODY_FROM_CAM, width=camera.width, height=camera.height, lens=lens,
        intrinsics=numbers(camera.params[:4]).replace(" ", ", "),
        distortion=numbers(camera.params[4:]).replace(" ", ", "),
    )  # fmt: skip
    (mav0 / "cam0" / "sensor.yaml").write_text(text)
    truth = mav0 / "state_groundtruth_estimate0"
    truth.mkdir()
    lines = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], ..."]
    for i in range(1, 320):
        body = moved(start, i * 0.005)
        row = numbers(body.t, body.quaternion, np.zeros(9)).replace(" ", ",")
        lines.append(f"{START_NS + i * 5_000_000},{row}")
    (truth / "data.csv").write_text("\r\n".join(lines) + "\r\n", newline="")
    return views


def intrinsics_json(camera: Camera) -> dict[str, Any]:
    """Write a camera as nerfstudio does, in COLMAP's pixel convention."""
    fx, fy, cx, cy, *distortion = camera.to_colmap()
    fisheye = camera.model == "OPENCV_FISHEYE"
    keys = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2")
    lens = dict(zip(keys, distortion or [0.0] * 4, strict=True))
    size = {"w": camera.width, "h": camera.height}
    return size | {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy} | lens


def opengl_frame(file_path: str, world_from_cam: Rigid3) -> dict[str, Any]:
    opengl = world_from_cam @ OPENGL_FROM_OPENCV.inverse()
    return {"file_path": file_path, "transform_matrix": matrix(opengl).tolist()}


def write_nerfstudio(root: Path, camera: Camera, scale: float = 1.0) -> dict[str, View]:
    """Images of one camera in a world that nerfstudio has turned, as ns-process-data leaves it."""
    names = [f"images/frame_{i + 1:05}.png" for i in range(4)]
    views = film(root, camera, names, [POSES[i].inverse() for i in range(4)])
    turned = Rigid3(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.array([0.5, 0, -1]))
    frames = []
    for i, name in enumerate(names):
        world_from_cam = turned @ POSES[i].inverse()
        world_from_cam = Rigid3(world_from_cam.R, scale * world_from_cam.t)
        frames.append(opengl_frame(f"./{name}", world_from_cam) | {"colmap_im_id": i + 1})
    contents = intrinsics_json(camera) | {
        "camera_model": "OPENCV_FISHEYE" if camera.model == "OPENCV_FISHEYE" else "OPENCV",
        "frames": frames,
        "applied_transform": matrix(turned)[:3].tolist(),
        "ply_file_path": "sparse_pc.ply",
    }
    if scale != 1.0:
        contents["applied_scale"] = scale
    (root / "transforms.json").write_text(json.dumps(contents, indent=4))
    return views


def write_instant_ngp(root: Path, cameras: list[Camera]) -> dict[str, View]:
    """Images of several cameras, intrinsics with each frame, paths as from Windows, no suffix."""
    root.mkdir(parents=True, exist_ok=True)
    views: dict[str, View] = {}
    frames = []
    for i, camera in enumerate(cameras):
        name = f"images/{i}.{'jpg' if i % 2 else 'png'}"
        views |= film(root, camera, [name], [POSES[i].inverse()])
        frame = opengl_frame(f"images\\{i}", POSES[i].inverse())
        frames.append(frame | intrinsics_json(camera) | {"sharpness": 30.0 + i})
        frames[-1]["is_fisheye"] = camera.model == "OPENCV_FISHEYE"
    contents = {"aabb_scale": 16, "fl_x": 1.0, "k1": 0.5, "frames": frames}
    (root / "transforms.json").write_text(json.dumps(contents))
    return views


def write_nerf_synthetic(root: Path) -> dict[str, View]:
    """Blender's scenes: an angle of view, no suffixes, no size, three files."""
    camera = Camera.from_colmap("SIMPLE_PINHOLE", 200, 200, (240.0, 100.0, 100.0))
    views: dict[str, View] = {}
    for split, numbers_of in (("train", (0, 1, 2)), ("val", (3,)), ("test", (4, 5))):
        names = [f"{split}/r_{i}" for i in range(len(numbers_of))]
        poses = [POSES[i].inverse() for i in numbers_of]
        views |= film(root, camera, [f"{name}.png" for name in names], poses)
        contents = {
            "camera_angle_x": 2 * np.arctan(100 / 240.0),
            "frames": [
                opengl_frame(f"./{name}", pose) | {"rotation": 0.0126}
                for name, pose in zip(names, poses, strict=True)
            ],
        }
        (root / f"transforms_{split}.json").write_text(json.dumps(contents))
    return views


def kapture_camera(camera: Camera) -> str:
    params = numbers(camera.to_colmap()).replace(" ", ", ")
    return f"{camera.model}, {camera.width}, {camera.height}, {params}"


def kapture_pose(transform: Rigid3) -> str:
    return numbers(transform.quaternion, transform.t).replace(" ", ", ")


def write_kapture(root: Path, cameras: list[Camera], posed: int) -> dict[str, View]:
    """A rig of two cameras on a car, three places; a camera of its own; some without a pose."""
    sensors = root / "sensors"
    views: dict[str, View] = {}
    rig_from_car = Rigid3.from_quaternion([0.9, 0.1, -0.2, 0.1], [0.1, 0.2, -0.3])
    right_from_rig = Rigid3.from_quaternion([0.99, 0.02, 0.05, -0.03], [-0.3, 0.0, 0.05])
    records, trajectories = [], []
    for i in range(3):
        left, right = POSES[i], right_from_rig @ POSES[i]
        for device, camera, pose in (("left", cameras[0], left), ("right", cameras[1], right)):
            name = f"mapping/{device}/{i:05}.png"
            views[name] = take(sensors / "records_data" / name, camera, pose, room(0))
            records.append(f"{i:04}, {device},  {name}\n")
        if i < posed:
            car_from_world = rig_from_car.inverse() @ POSES[i]
            trajectories.append(f"{i:8d}, car, {kapture_pose(car_from_world)}\n")
    views["alone.png"] = take(sensors / "records_data" / "alone.png", cameras[0], POSES[3], room(0))
    records.append("7, phone, alone.png\n")
    trajectories.append(f"7, phone, {kapture_pose(POSES[3])}\n")
    head = "# kapture format: 1.1\n"
    (sensors / "sensors.txt").write_text(
        f"{head}# sensor_device_id, name, sensor_type, [sensor_params]+\n"
        f"left, Hero7, camera, {kapture_camera(cameras[0])}\n"
        f"right, , camera, {kapture_camera(cameras[1])}\n"
        f"phone, gs9, camera, {kapture_camera(cameras[0])}\n"
        "gps1, , gnss, EPSG:4326\nlidar0, , lidar\n"
    )
    (sensors / "rigs.txt").write_text(
        f"{head}car, rig, {kapture_pose(rig_from_car)}\n"
        f"rig, left, 1, 0, 0, 0, 0, 0, 0\nrig, right, {kapture_pose(right_from_rig)}\n"
        "car, gps1, 1, 0, 0, 0, , , \n"
    )
    (sensors / "trajectories.txt").write_text(head + "".join(trajectories))
    (sensors / "records_camera.txt").write_text(head + "".join(records))
    return views


def stamp(time_ns: int) -> dict[str, int]:
    return {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9}


def header(time_ns: int, frame_id: str) -> dict[str, Any]:
    return {"stamp": stamp(time_ns), "frame_id": frame_id}


def xyz(values: Iterable[float]) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


def ros_pose(transform: Rigid3) -> dict[str, Any]:
    w, x, y, z = map(float, transform.quaternion)
    return {"position": xyz(transform.t), "orientation": {"x": x, "y": y, "z": z, "w": w}}


def ros_transform(time_ns: int, parent: str, child: str, transform: Rigid3) -> dict[str, Any]:
    w, x, y, z = map(float, transform.quaternion)
    rotation = {"x": x, "y": y, "z": z, "w": w}
    return {
        "header": header(time_ns, parent), "child_frame_id": child,
        "transform": {"translation": xyz(transform.t), "rotation": rotation},
    }  # fmt: skip


def ros_camera_info(camera: Camera, time_ns: int) -> dict[str, Any]:
    return {
        "header": header(time_ns, "optical"), "height": camera.height, "width": camera.width,
        "distortion_model": "plumb_bob", "d": [*map(float, camera.distortion), 0.0],
        "k": camera.K.ravel().tolist(), "r": np.eye(3).ravel().tolist(),
        "p": np.column_stack([camera.K, np.zeros(3)]).ravel().tolist(),
        "binning_x": 0, "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    }  # fmt: skip


def ros_image(path: Path, time_ns: int, frame_id: str = "optical") -> dict[str, Any]:
    """A raw image in colour, as drivers send them, its rows longer than its pixels."""
    pixels = cv2.imread(str(path))
    assert pixels is not None
    rows = np.pad(pixels.reshape(len(pixels), -1), ((0, 0), (0, 8)))
    return {
        "header": header(time_ns, frame_id), "height": pixels.shape[0], "width": pixels.shape[1],
        "encoding": "bgr8", "is_bigendian": 0, "step": rows.shape[1], "data": rows.tobytes(),
    }  # fmt: skip


def write_ros(path: Path, messages: Iterable[tuple[str, str, Any, int]]) -> Path:
    """Write messages (topic, type, fields, time of arrival)."""
    with path.open("wb") as stream, RosWriter(stream) as writer:
        schemas: dict[str, Any] = {}
        for topic, kind, message, time_ns in messages:
            if kind not in schemas:
                text = STORE.generate_msgdef(kind, ros_version=2)[0]
                schemas[kind] = writer.register_msgdef(kind, text)
            writer.write_message(topic, schemas[kind], message, time_ns, time_ns)
    return path


def foxglove_pose(transform: Rigid3) -> Pose:
    w, x, y, z = transform.quaternion
    position = Vector3(**xyz(transform.t))
    return Pose(position=position, orientation=Quaternion(x=x, y=y, z=z, w=w))


def foxglove_transform(time_ns: int, parent: str, child: str, transform: Rigid3) -> FrameTransform:
    w, x, y, z = transform.quaternion
    message = FrameTransform(
        parent_frame_id=parent, child_frame_id=child, translation=Vector3(**xyz(transform.t)),
        rotation=Quaternion(x=x, y=y, z=z, w=w),
    )  # fmt: skip
    message.timestamp.FromNanoseconds(time_ns)
    return message


def foxglove_transforms(transforms: Iterable[FrameTransform]) -> FrameTransforms:
    return FrameTransforms(transforms=transforms)


def foxglove_pose_in_frame(time_ns: int, transform: Rigid3) -> PoseInFrame:
    message = PoseInFrame(frame_id="map", pose=foxglove_pose(transform))
    message.timestamp.FromNanoseconds(time_ns)
    return message


def foxglove_calibration(camera: Camera, time_ns: int) -> CameraCalibration:
    message = CameraCalibration(
        frame_id="optical", width=camera.width, height=camera.height,
        distortion_model="plumb_bob", D=[*camera.distortion, 0.0], K=camera.K.ravel(),
    )  # fmt: skip
    message.timestamp.FromNanoseconds(time_ns)
    return message


def foxglove_image(path: Path, time_ns: int) -> CompressedImage:
    message = CompressedImage(frame_id="optical", data=path.read_bytes(), format="png")
    message.timestamp.FromNanoseconds(time_ns)
    return message


def write_foxglove(path: Path, messages: Iterable[tuple[str, Any, int]]) -> Path:
    """Write messages (topic, message, time of arrival)."""
    with path.open("wb") as stream, ProtobufWriter(stream) as writer:
        for topic, message, time_ns in messages:
            writer.write_message(topic, message, time_ns, time_ns)
    return path
