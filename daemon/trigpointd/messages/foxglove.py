"""Frames and cameras as Foxglove's messages, from which the same frame can be made again."""

from __future__ import annotations

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

from trigpoint.camera import Camera
from trigpoint.frame import Frame


def raw_image(frame: Frame) -> RawImage:
    """Write the gray levels of a frame, as they are."""
    height, width = frame.image.shape
    message = RawImage(
        width=width, height=height, encoding="mono8", step=width, data=frame.image.tobytes()
    )
    message.timestamp.FromNanoseconds(frame.time_ns)
    return message


def camera_calibration(camera: Camera, time_ns: int) -> CameraCalibration:
    """Write the intrinsics of a camera, as they are known at a time."""
    K = camera.K
    fisheye = camera.model == "OPENCV_FISHEYE"
    message = CameraCalibration(
        width=camera.width,
        height=camera.height,
        distortion_model="kannala_brandt" if fisheye else "plumb_bob",
        D=camera.distortion if fisheye else [*camera.distortion, 0.0],  # plumb_bob: k3
        K=K.ravel(),
        R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
        P=[*K[0], 0, *K[1], 0, *K[2], 0],
    )
    message.timestamp.FromNanoseconds(time_ns)
    return message
