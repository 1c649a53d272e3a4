"""Recordings made of image files: MCAP in Foxglove's schemas, as `trigpointd` replays them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from mcap.writer import CompressionType
from mcap_protobuf.writer import Writer

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpoint.output import check_output
from trigpoint.rigid import Rigid3

IMAGE_TOPIC = "/camera/image"
CALIBRATION_TOPIC = "/camera/calibration"
TRUTH_TOPIC = "/truth"
CAMERA_FRAME = "camera"
WORLD_FRAME = "world"
FORMATS = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png", ".webp": "webp"}

START_TIME_NS = 1_700_000_000 * 10**9  # any fixed time: the same images give the same bytes
_CHUNK_BYTES = 256 * 1024


@dataclass(frozen=True, eq=False)
class RecordedImage:
    """An image file, the camera that took it, and where it stood, if that is known."""

    path: Path
    camera: Camera
    cam_from_world: Rigid3 | None = None


def list_images(folder: Path) -> list[str]:
    """Return the names of the images in a folder, sorted."""
    if not folder.is_dir():
        raise ConfigError(f"no such folder: {folder}")
    names = sorted(p.name for p in folder.iterdir() if p.suffix.lower() in FORMATS)
    if not names:
        raise ConfigError(f"{folder} holds no images ({', '.join(FORMATS)})")
    return names


def write_recording(
    out: Path,
    images: Iterable[RecordedImage],
    *,
    rate_hz: float = 10.0,
    start_time_ns: int = START_TIME_NS,
) -> int:
    """Write the images as a camera's recording and return their number.

    The files go in as they are; a calibration precedes each image whose camera is another than
    that of the image before. The recording appears under its name once it is whole.
    """
    if not rate_hz > 0:
        raise ConfigError(f"a recording at {rate_hz} images a second is not possible")
    check_output(out)
    if out.exists():
        raise ConfigError(f"{out} exists; remove it first, or name another file")
    partial = out.with_name(out.name + ".partial")
    try:
        try:
            with partial.open("wb") as stream:
                # Compressing JPEG again saves nothing.
                writer = Writer(stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.NONE)
                count = _write_images(writer, images, rate_hz, start_time_ns)
                writer.finish()  # type: ignore[no-untyped-call]
            if count == 0:
                raise ConfigError(f"there are no images for the recording {out}")
            partial.replace(out)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(
            f"cannot make the recording {out}: {error.filename or out}: {error.strerror}"
        ) from error
    return count


def _write_images(
    writer: Writer, images: Iterable[RecordedImage], rate_hz: float, start_time_ns: int
) -> int:
    camera, count = None, 0
    for image in images:
        time_ns = start_time_ns + round(count * 1e9 / rate_hz)
        if image.camera != camera:
            camera = image.camera
            _write(writer, CALIBRATION_TOPIC, _calibration(camera), time_ns)
        _write(writer, IMAGE_TOPIC, _image(image.path), time_ns)
        if image.cam_from_world is not None:
            _write(writer, TRUTH_TOPIC, _truth(image.cam_from_world), time_ns)
        count += 1
    return count


def _write(
    writer: Writer,
    topic: str,
    message: CameraCalibration | CompressedImage | PoseInFrame,
    time_ns: int,
) -> None:
    message.timestamp.FromNanoseconds(time_ns)
    writer.write_message(topic, message, log_time=time_ns, publish_time=time_ns)


def _image(path: Path) -> CompressedImage:
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(
            f"{path} cannot go into a recording; convert it to one of {', '.join(FORMATS)}"
        )
    return CompressedImage(
        frame_id=CAMERA_FRAME, data=path.read_bytes(), format=FORMATS[path.suffix.lower()]
    )


def _calibration(camera: Camera) -> CameraCalibration:
    K = camera.K
    model = {"OPENCV_FISHEYE": "kannala_brandt", "FULL_OPENCV": "rational_polynomial"}.get(
        camera.model, "plumb_bob"
    )
    return CameraCalibration(
        frame_id=CAMERA_FRAME,
        width=camera.width,
        height=camera.height,
        distortion_model=model,
        D=[*camera.distortion, 0.0] if model == "plumb_bob" else camera.distortion,  # the k3
        K=K.ravel(),
        R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
        P=[*K[0], 0, *K[1], 0, *K[2], 0],
    )


def _truth(cam_from_world: Rigid3) -> PoseInFrame:
    world_from_cam = cam_from_world.inverse()
    w, x, y, z = world_from_cam.quaternion
    tx, ty, tz = world_from_cam.t
    pose = Pose(position=Vector3(x=tx, y=ty, z=tz), orientation=Quaternion(x=x, y=y, z=z, w=w))
    return PoseInFrame(frame_id=WORLD_FRAME, pose=pose)
