from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from trigpoint.camera import PARAMETERS, Camera
from trigpoint.errors import ConfigError

Array = NDArray[np.float64]

quick = settings(max_examples=40)
CAMERAS = [
    Camera("SIMPLE_PINHOLE", 640, 480, (500.0, 321.0, 239.0)),
    Camera("PINHOLE", 640, 480, (500.0, 510.0, 321.0, 239.0)),
    Camera("SIMPLE_RADIAL", 640, 480, (500.0, 321.0, 239.0, -0.1)),
    Camera("RADIAL", 640, 480, (500.0, 321.0, 239.0, -0.2, 0.05)),
    Camera("OPENCV", 640, 480, (500.0, 510.0, 321.0, 239.0, -0.15, 0.04, 1e-3, -2e-3)),
    Camera("OPENCV_FISHEYE", 640, 480, (300.0, 305.0, 321.0, 239.0, 0.02, -0.01, 2e-3, -1e-3)),
    # As a calibration of the rational model gives it: numerator and denominator nearly cancel.
    Camera(
        "FULL_OPENCV",
        640,
        480,
        (500.0, 510.0, 321.0, 239.0, -1.85, -21.3, 1e-3, -1e-3, 104.8, -1.95, -20.9, 103.2),
    ),
]
every_camera = pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.model)
image_points = arrays(np.float64, (7, 2), elements=st.floats(-0.9, 0.9))
FISHEYE = next(camera for camera in CAMERAS if camera.model == "OPENCV_FISHEYE")


def distorted(camera: Camera, x: Array, y: Array) -> tuple[Array, Array]:
    """Distort as COLMAP's documentation writes the models."""
    p = dict(zip(PARAMETERS[camera.model], camera.params, strict=True))
    k1, k2, p1, p2 = (p.get(name, 0.0) for name in ("k1", "k2", "p1", "p2"))
    r2 = x**2 + y**2
    if camera.model == "OPENCV_FISHEYE":
        theta = np.arctan(np.sqrt(r2))
        series = 1 + k1 * theta**2 + k2 * theta**4 + p["k3"] * theta**6 + p["k4"] * theta**8
        scale = theta * series / np.where(r2 > 0, np.sqrt(r2), 1)
        return x * scale, y * scale
    k3, k4, k5, k6 = (p.get(name, 0.0) for name in ("k3", "k4", "k5", "k6"))
    numerator = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    radial = numerator / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
        y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
    )


def test_every_model_has_a_camera_here() -> None:
    assert {camera.model for camera in CAMERAS} == set(PARAMETERS)


@every_camera
@quick
@given(points=image_points, depth=st.floats(0.1, 100))
def test_points_project_as_the_model_is_written(
    camera: Camera, points: Array, depth: float
) -> None:
    x, y = distorted(camera, *points.T)
    fx, fy = camera.focals_px
    expected = np.column_stack([fx * x + camera.K[0, 2], fy * y + camera.K[1, 2]])
    px = camera.project(depth * np.column_stack([points, np.ones(len(points))]))
    np.testing.assert_allclose(px, expected, atol=1e-9)


@every_camera
@quick
@given(points=image_points, depth=st.floats(0.1, 100))
def test_normalizing_undoes_projecting(camera: Camera, points: Array, depth: float) -> None:
    px = camera.project(depth * np.column_stack([points, np.ones(len(points))]))
    np.testing.assert_allclose(camera.normalize(px), points, atol=2e-8)  # px 6e-6


@every_camera
def test_projecting_undoes_normalizing_for_every_pixel(camera: Camera) -> None:
    px = np.mgrid[0:640:13, 0:480:13].reshape(2, -1).T.astype(np.float32)
    points = camera.normalize(px)
    back = camera.project(np.column_stack([points, np.ones(len(points))]))
    np.testing.assert_allclose(back, px, atol=1e-6)


@every_camera
def test_the_principal_point_is_the_optical_axis(camera: Camera) -> None:
    np.testing.assert_allclose(camera.project(np.array([[0, 0, 2.0]])), [[321, 239]], atol=1e-9)
    np.testing.assert_allclose(camera.normalize(np.array([[321.0, 239.0]])), [[0, 0]], atol=1e-12)


@every_camera
def test_points_behind_the_camera_and_nan_come_back_as_nan(camera: Camera) -> None:
    points = np.array([[0.1, 0.2, -1.0], [0.1, 0.2, 0.0], [np.nan, 0.0, 1.0], [0.1, 0.2, 1.0]])
    nan = np.isnan(camera.project(points))
    assert nan[:2].all()
    assert nan[2].any()
    assert not nan[3].any()
    assert np.isnan(camera.normalize(np.array([[np.nan, 100.0]]))).all()


@every_camera
def test_no_points_give_no_points(camera: Camera) -> None:
    assert camera.project(np.empty((0, 3))).shape == (0, 2)
    assert camera.normalize(np.empty((0, 2))).shape == (0, 2)


@every_camera
def test_whole_numbers_do_for_parameters(camera: Camera) -> None:
    whole = Camera(camera.model, 640, 480, tuple(int(p) for p in camera.params))
    np.testing.assert_allclose(whole.project(np.array([[0, 0, 1.0]])), [[321, 239]])


def test_pixels_beyond_a_barrel_lens_are_nan() -> None:
    # r (1 - 0.3 r^2) has its maximum 0.7027 at r = 1.054: no point projects farther out.
    camera = Camera("SIMPLE_RADIAL", 640, 480, (500.0, 320.0, 240.0, -0.3))
    points = camera.normalize(np.array([[320 + 500 * 0.70, 240.0], [320 + 500 * 0.71, 240.0]]))
    np.testing.assert_allclose(points[0], [1.0, 0.0], atol=1e-9)
    assert np.isnan(points[1]).all()


def test_fisheye_pixels_at_right_angles_and_beyond_are_nan() -> None:
    camera = Camera("OPENCV_FISHEYE", 640, 480, (200.0, 200.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0))
    degrees = np.array([80.0, 89.0, 91.0, 120.0])
    px = np.column_stack([320 + 200 * np.deg2rad(degrees), np.full(4, 240.0)])
    points = camera.normalize(px)
    np.testing.assert_allclose(points[:2, 0], np.tan(np.deg2rad(degrees[:2])), rtol=1e-9)
    assert np.isnan(points[2:]).all()


def test_fisheye_pixels_the_model_does_not_reach_are_nan() -> None:
    # At 90 degrees this lens is 462 px from its axis.
    points = FISHEYE.normalize(np.array([[321.0 + 430, 239.0], [321.0 + 470, 239.0]]))
    assert points[0, 0] > 5
    assert np.isnan(points[1]).all()


def test_the_corners_of_a_strong_lens_are_undistorted_too() -> None:
    camera = Camera("RADIAL", 640, 480, (300.0, 320.0, 240.0, -0.3, 0.1))
    points = camera.normalize(np.array([[0.0, 0.0], [639.0, 479.0]]))
    assert np.linalg.norm(points, axis=1).min() > 1.5
    back = camera.project(np.column_stack([points, np.ones(2)]))
    np.testing.assert_allclose(back, [[0, 0], [639, 479]], atol=1e-6)


def test_colmap_puts_the_first_pixel_centre_half_a_pixel_farther() -> None:
    camera = Camera.from_colmap("PINHOLE", 640, 480, (500, 510, 320, 240))
    assert camera.params == (500.0, 510.0, 319.5, 239.5)
    assert camera.to_colmap() == (500.0, 510.0, 320.0, 240.0)


@every_camera
def test_a_camera_survives_colmaps_numbers_and_text(camera: Camera) -> None:
    assert Camera.from_colmap(camera.model, 640, 480, camera.to_colmap()) == camera
    read = Camera.from_text(camera.to_text())
    assert (read.model, read.width, read.height) == (camera.model, 640, 480)
    np.testing.assert_allclose(read.params, camera.params, rtol=1e-9, atol=1e-12)


def test_text_is_read_as_colmap_writes_it() -> None:
    camera = Camera.from_text("SIMPLE_RADIAL 640 480 500.5 320 240 -0.25\n")
    assert camera == Camera("SIMPLE_RADIAL", 640, 480, (500.5, 319.5, 239.5, -0.25))
    assert camera.focal_px == 500.5
    np.testing.assert_array_equal(camera.distortion, [-0.25, 0, 0, 0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "cannot read a camera from ''"),
        ("PINHOLE 640", "cannot read a camera"),
        ("PINHOLE 640 480 500 500 x 240", "cannot read a camera"),
        ("PINHOLE 640.5 480 500 500 320 240", "cannot read a camera"),
        ("FOV 640 480 500", "'FOV' is not known; use one of SIMPLE_PINHOLE"),
        ("PINHOLE 640 480 500 320 240", r"takes 4 parameters \(fx fy cx cy\), not 3"),
        ("SIMPLE_PINHOLE 640 480 nan 320 240", "must be finite"),
        ("SIMPLE_PINHOLE 640 480 500 inf 240", "must be finite"),
        ("SIMPLE_PINHOLE 640 480 0 320 240", "focal length positive"),
        ("PINHOLE 640 480 500 -500 320 240", "focal length positive"),
        ("SIMPLE_PINHOLE 0 480 500 320 240", "size 0 x 480 is not usable"),
    ],
)
def test_a_camera_that_cannot_be_used_says_why(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Camera.from_text(text)
