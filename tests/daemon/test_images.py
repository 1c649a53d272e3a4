"""Image and calibration messages, written by Foxglove's and rosbags' own code."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from trigpoint.camera import Camera
from trigpoint.camera_messages import Calibration, Image, is_rectified
from trigpoint.errors import SourceError
from trigpointd.messages.images import parse_calibration, parse_image, to_frame

ROS = get_typestore(Stores.ROS2_HUMBLE)
TIME_NS = 1_700_000_000_123_456_789
K = [500.0, 0, 320, 0, 510, 240, 0, 0, 1]
P = [450.0, 0, 300, 0, 0, 460, 200, 0, 0, 0, 1, 0]
RATIONAL = tuple(i / 10 for i in range(8))


def smooth_image(width: int = 64, height: int = 48) -> NDArray[np.uint8]:
    """Draw colours (height, width, 3) that JPEG and a colour filter hardly change."""
    noise = np.random.default_rng(3).integers(0, 256, (height, width, 3), dtype=np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 6), dtype=np.uint8)


def calibration(model: str = "", D: tuple[float, ...] = ()) -> Calibration:
    return Calibration("cam", 640, 480, model, D, K, P)


def jpeg(quality: int = 95, *, progressive: bool = False) -> bytes:
    flags = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_PROGRESSIVE, int(progressive)]
    return bytes(cv2.imencode(".jpg", smooth_image(), flags)[1])


def ros_header() -> Any:
    stamp = ROS.types["builtin_interfaces/msg/Time"](TIME_NS // 10**9, TIME_NS % 10**9)
    return ROS.types["std_msgs/msg/Header"](stamp, "cam")


def ros_message(kind: str, *fields: Any, little_endian: bool = True) -> tuple[str, str, bytes]:
    name = f"sensor_msgs/msg/{kind}"
    message = ROS.types[name](ros_header(), *fields)
    return "cdr", name, bytes(ROS.serialize_cdr(message, name, little_endian=little_endian))


def test_a_foxglove_png_gives_its_gray_levels_and_time() -> None:
    gray = smooth_image()[..., 0]
    message = CompressedImage(frame_id="cam", data=bytes(cv2.imencode(".png", gray)[1]))
    message.timestamp.FromNanoseconds(TIME_NS)
    image = parse_image("protobuf", "foxglove.CompressedImage", message.SerializeToString())
    assert (image.time_ns, image.frame_id) == (TIME_NS, "cam")
    assert np.array_equal(image.gray(), gray)


@pytest.mark.parametrize("little_endian", [True, False])
def test_a_ros_jpeg_gives_its_gray_levels_and_time(little_endian: bool) -> None:
    data = np.frombuffer(jpeg(), np.uint8)
    image = parse_image(*ros_message("CompressedImage", "jpeg", data, little_endian=little_endian))
    assert (image.time_ns, image.frame_id) == (TIME_NS, "cam")
    expected = cv2.cvtColor(smooth_image(), cv2.COLOR_BGR2GRAY)
    assert np.abs(image.gray() - expected.astype(float)).max() < 8


def test_an_orientation_tag_does_not_turn_the_image() -> None:
    quarter_turn = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    segment = b"\xff\xe1" + (len(quarter_turn) + 2).to_bytes(2, "big") + quarter_turn
    tagged = jpeg()[:2] + segment + jpeg()[2:]
    turned = cv2.imdecode(np.frombuffer(tagged, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert turned is not None
    assert turned.shape == (64, 48)
    assert Image(0, "", tagged).gray().shape == (48, 64)


@pytest.mark.parametrize("progressive", [False, True])
@pytest.mark.parametrize("lost", [1, 2, 100, 0.5])
def test_a_jpeg_cut_short_is_an_error(lost: float, progressive: bool) -> None:
    whole = jpeg(progressive=progressive)
    kept = len(whole) - int(lost if lost >= 1 else lost * len(whole))
    with pytest.raises(SourceError, match="cut short"):
        Image(0, "", whole[:kept]).gray()


@pytest.mark.parametrize("data", [b"", b"no image", bytes(500)])
def test_bytes_that_are_no_image_are_an_error(data: bytes) -> None:
    with pytest.raises(SourceError, match="broken"):
        Image(0, "", data).gray()


def encode_raw(encoding: str, bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Turn colours into rows of raw pixels (height, row bytes), without our own code."""
    height, width = bgr.shape[:2]
    yuv = cv2.cvtColor(bgr, cv2.COLOR_BGR2YUV)
    if encoding.startswith("bayer_"):
        channel = {"b": 0, "g": 1, "r": 2}
        mosaic = np.empty((height, width), np.uint8)
        for i, letter in enumerate(encoding[6:10]):
            mosaic[i // 2 :: 2, i % 2 :: 2] = bgr[i // 2 :: 2, i % 2 :: 2, channel[letter]]
        return mosaic
    pixels = {
        "mono8": yuv[..., :1],
        "8UC1": yuv[..., :1],
        "rgb8": bgr[..., ::-1],
        "bgr8": bgr,
        "8UC3": bgr,
        "rgba8": cv2.cvtColor(bgr, cv2.COLOR_BGR2RGBA),
        "bgra8": cv2.cvtColor(bgr, cv2.COLOR_BGR2BGRA),
        "uyvy": yuv[..., [1, 0]],
        "yuv422": yuv[..., [1, 0]],
        "yuyv": yuv[..., :2],
        "yuv422_yuy2": yuv[..., :2],
    }[encoding]
    return np.ascontiguousarray(pixels).reshape(height, -1)


ENCODINGS = [
    "mono8",
    "8UC1",
    "rgb8",
    "bgr8",
    "8UC3",
    "rgba8",
    "bgra8",
    "uyvy",
    "yuv422",
    "yuyv",
    "yuv422_yuy2",
    "bayer_rggb8",
    "bayer_bggr8",
    "bayer_gbrg8",
    "bayer_grbg8",
]


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("padding", [0, 5])
def test_raw_pixels_give_their_gray_levels(encoding: str, padding: int) -> None:
    bgr = smooth_image()
    rows = np.pad(encode_raw(encoding, bgr), ((0, 0), (0, padding)), constant_values=255)
    height, step = rows.shape
    foxglove = RawImage(
        width=64, height=height, encoding=encoding, step=step, data=rows.tobytes()
    ).SerializeToString()
    ros = ros_message("Image", height, 64, encoding, 0, step, rows.ravel())
    expected = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY).astype(float)
    for image in (parse_image("protobuf", "foxglove.RawImage", foxglove), parse_image(*ros)):
        error = np.abs(image.gray() - expected)
        # A colour filter smooths; the order of the colours would err by 30 and more.
        assert error.max() <= (10 if encoding.startswith("bayer") else 1)


def test_nv12_gives_its_luma() -> None:
    luma = smooth_image()[..., 0]
    data = luma.tobytes() + bytes([128]) * (luma.size // 2)
    assert np.array_equal(Image(0, "", data, "nv12", 64, 48, 64).gray(), luma)


@pytest.mark.parametrize(
    ("width", "height", "step", "size"),
    [(64, 48, 63, 4000), (64, 48, 64, 3071), (0, 48, 64, 3072), (64, 0, 64, 3072)],
)
def test_raw_pixels_that_do_not_fit_are_an_error(
    width: int, height: int, step: int, size: int
) -> None:
    with pytest.raises(SourceError, match="does not fit"):
        Image(0, "", bytes(size), "mono8", width, height, step).gray()


@pytest.mark.parametrize("encoding", ["", "16UC1", "32FC1", "mono12"])
def test_an_unknown_encoding_names_the_known_ones(encoding: str) -> None:
    with pytest.raises(SourceError, match=f"'{encoding}' is not supported.*mono8"):
        Image(0, "", bytes(3072), encoding, 64, 48, 64).gray()


@pytest.mark.parametrize("seconds", [-1, 2**31])
def test_an_impossible_capture_time_is_an_error(seconds: int) -> None:
    message = CompressedImage(data=jpeg())
    message.timestamp.seconds = seconds
    with pytest.raises(SourceError, match="out of range"):
        parse_image("protobuf", "foxglove.CompressedImage", message.SerializeToString())


@pytest.mark.parametrize(
    "kind",
    [
        ("protobuf", "foxglove.CompressedImage"),
        ("protobuf", "foxglove.RawImage"),
        ("cdr", "sensor_msgs/msg/CompressedImage"),
        ("cdr", "sensor_msgs/msg/Image"),
    ],
)
def test_garbage_for_an_image_is_an_error(kind: tuple[str, str]) -> None:
    with pytest.raises(SourceError):
        parse_image(*kind, b"\xff\xff\xff")


@pytest.mark.parametrize(
    "kind", [("protobuf", "foxglove.CameraCalibration"), ("cdr", "sensor_msgs/msg/CameraInfo")]
)
def test_garbage_for_a_calibration_is_an_error(kind: tuple[str, str]) -> None:
    with pytest.raises(SourceError):
        parse_calibration(*kind, b"\xff\xff\xff")


@pytest.mark.parametrize(
    ("sent", "D", "model", "distortion"),
    [
        ("", (), "PINHOLE", ()),
        ("", (0.0,) * 5, "PINHOLE", ()),
        ("plumb_bob", (), "PINHOLE", ()),
        ("plumb_bob", (0.0,) * 5, "PINHOLE", ()),
        ("plumb_bob", (0.1, -0.2, 0.01, 0.02), "OPENCV", (0.1, -0.2, 0.01, 0.02)),
        ("plumb_bob", (0.1, -0.2, 0.01, 0.02, 0.0), "OPENCV", (0.1, -0.2, 0.01, 0.02)),
        ("plumb_bob", (0.1, 0, 0, 0, 0.2), "FULL_OPENCV", (0.1, 0, 0, 0, 0.2, 0, 0, 0)),
        ("rational_polynomial", (0.0, 0.1) + (0.0,) * 6, "OPENCV", (0.0, 0.1, 0.0, 0.0)),
        ("rational_polynomial", (*RATIONAL, 0.0), "FULL_OPENCV", RATIONAL),
        ("kannala_brandt", (0.1, 0.2, 0.3, 0.4), "OPENCV_FISHEYE", (0.1, 0.2, 0.3, 0.4)),
        ("equidistant", (0.1, 0.2, 0.3, 0.4), "OPENCV_FISHEYE", (0.1, 0.2, 0.3, 0.4)),
        ("fisheye", (), "OPENCV_FISHEYE", (0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_a_calibration_gives_the_camera(
    sent: str, D: tuple[float, ...], model: str, distortion: tuple[float, ...]
) -> None:
    expected = Camera(model, 640, 480, (500, 510, 320, 240, *distortion))
    foxglove = CameraCalibration(width=640, height=480, distortion_model=sent, D=D, K=K, P=P)
    parsed = parse_calibration(
        "protobuf", "foxglove.CameraCalibration", foxglove.SerializeToString()
    )
    assert parsed.camera() == expected

    roi = ROS.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    R = np.eye(3).ravel()
    fields = (480, 640, sent, np.array(D), np.array(K), R, np.array(P), 0, 0, roi)
    parsed = parse_calibration(*ros_message("CameraInfo", *fields))
    assert parsed.camera() == expected
    assert parsed.frame_id == "cam"


def test_rectified_images_take_the_projection_without_distortion() -> None:
    rectified = calibration("plumb_bob", (0.1, -0.2, 0.01, 0.02, 0.3)).camera(rectified=True)
    assert rectified == Camera("PINHOLE", 640, 480, (450, 460, 300, 200))


def test_ros_names_of_rectified_topics_are_known() -> None:
    assert is_rectified("/cam/image_rect_color/compressed")
    assert not is_rectified("/rect/image_raw")


@pytest.mark.parametrize(
    "matrix", [[], [0.0] * 9, [1.0, 0, 0, 0, 1, 0, 0, 0, 1]], ids=["none", "zero", "identity"]
)
def test_a_camera_that_was_never_calibrated_is_an_error(matrix: list[float]) -> None:
    with pytest.raises(SourceError, match="never calibrated"):
        Calibration("cam", 640, 480, "plumb_bob", (), matrix, P).camera()


@pytest.mark.parametrize(
    ("unusable", "complaint"),
    [
        (calibration("rational_polynomial", (*[0.1] * 8, 0, 0.2)), "more than 8"),
        (calibration("fisheye", (0.1, 0, 0, 0, 0.01)), "more than 4"),
        (calibration("fisheye62", (0.1,)), "plumb_bob.*kannala_brandt"),
        (calibration("", (0.1,)), "plumb_bob.*kannala_brandt"),
        (Calibration("cam", 640, 480, "", (), K[:8], P), "8 numbers instead of 9"),
        (Calibration("cam", 640, 480, "", (), [500.0, 3, *K[2:]], P), "skew of 3"),
        (Calibration("cam", 640, 480, "", (), [-500.0, *K[1:]], P), "focal length positive"),
        (Calibration("cam", 640, 480, "", (), [float("nan"), *K[1:]], P), "finite"),
        (Calibration("cam", 0, 0, "", (), K, P), "0 x 0"),
    ],
)
def test_a_calibration_that_cannot_be_used_says_why(unusable: Calibration, complaint: str) -> None:
    with pytest.raises(SourceError, match=complaint):
        unusable.camera()


def test_an_image_of_another_size_than_its_calibration_is_an_error() -> None:
    with pytest.raises(SourceError, match=r"64 x 48 px, but its camera.s calibration is for 640"):
        to_frame(Image(0, "", jpeg()), calibration().camera(), 0, "")
