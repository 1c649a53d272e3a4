import pickle

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpoint.rigid import Rigid3
from trigpoint_db.synthetic import (
    Surface,
    World,
    flight_poses,
    look_along,
    look_at,
    make_room,
    render,
    render_depth,
    survey_poses,
)

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

PINHOLE = Camera("PINHOLE", 320, 240, (250.0, 255.0, 158.3, 121.1))
OPENCV = Camera("OPENCV", 320, 240, (230.0, 232.0, 158.2, 121.9, -0.25, 0.08, 2e-3, -1e-3))
FISHEYE = Camera("OPENCV_FISHEYE", 320, 240, (150.0, 151.0, 161.2, 118.4, 0.03, -0.01, 2e-3, 0.0))
SMALL = Camera("PINHOLE", 80, 60, (58.0, 58.0, 39.5, 29.5))  # for geometry that needs no detail
X, Y, Z = np.eye(3)


def wall(texture: Image, *, x: float = 0.0, size: float = 1.0) -> Surface:
    """Make a square upright in the plane of constant x, about the z axis, seen from -x."""
    corner = np.array([x, size / 2, size / 2])
    return Surface.from_texture(corner, -Y, -Z, size, size, texture)


def plain(level: int) -> Image:
    return np.full((64, 64), level, dtype=np.uint8)


def checkerboard(squares: int, texels: int) -> Image:
    dark = np.indices((squares, squares)).sum(axis=0) % 2
    return np.kron(dark, np.ones((texels, texels))).astype(np.uint8) * 200 + 30


def pixels(camera: Camera) -> Array:
    grid = np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height)))
    return np.stack(grid, axis=-1).reshape(-1, 2)


def sees(camera: Camera, depth: Array, points_cam: Array) -> tuple[NDArray[np.bool_], Array]:
    """Return which points a picture with this depth shows, and where."""
    px = np.nan_to_num(camera.project(points_cam), nan=-1e4)
    column, row = (np.clip(np.rint(px[:, i]), -1e4, 1e4).astype(int) for i in range(2))
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    there = depth[np.where(inside, row, 0), np.where(inside, column, 0)]
    return inside & (np.abs(there / points_cam[:, 2] - 1) < 0.03), px


def points_seen(camera: Camera, depth: Array, cam_from_world: Rigid3) -> Array:
    """Return the world points (H * W, 3) that a picture with this depth shows."""
    rays = np.column_stack([camera.normalize(pixels(camera)), np.ones(depth.size)])
    return cam_from_world.inverse().apply(rays * depth.reshape(-1, 1))


@pytest.fixture(scope="module")
def room() -> World:
    return make_room(0)


@pytest.mark.parametrize("camera", [PINHOLE, OPENCV, FISHEYE], ids=lambda camera: camera.model)
@pytest.mark.parametrize("center", [(-1.5, 0, 0), (-1.3, 0.7, -0.5), (-0.9, -0.4, 0.2)])
def test_a_texture_corner_is_drawn_where_its_point_projects(
    camera: Camera, center: tuple[float, float, float]
) -> None:
    squares = 8
    world = World((wall(checkerboard(squares, 20)),))
    cam_from_world = look_at(center, (0, 0.02, 0.01))
    image = render(world, camera, cam_from_world, seed=None).astype(np.float32)
    y, z = np.meshgrid(*(2 * [np.arange(1, squares) / squares - 0.5]))
    corners = np.stack([np.zeros_like(y), y, z], axis=-1).reshape(-1, 3)
    expected = camera.project(cam_from_world.apply(corners))
    inside = ((expected > 10) & (expected < (camera.width - 10, camera.height - 10))).all(axis=1)
    start = expected[inside].astype(np.float32)[:, None] + np.float32(0.4)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    # cornerSubPix takes edges for smooth; on pixel-sharp ones it is a tenth of a pixel off.
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    error_px = cv2.cornerSubPix(smooth, start, (4, 4), (-1, -1), stop)[:, 0] - expected[inside]
    assert inside.sum() > 20
    assert np.linalg.norm(error_px, axis=1).max() < 0.1
    assert np.abs(error_px.mean(axis=0)).max() < 0.02


@pytest.mark.parametrize("camera", [PINHOLE, OPENCV, FISHEYE], ids=lambda camera: camera.model)
def test_depth_is_the_distance_along_the_axis_to_the_plane(camera: Camera) -> None:
    cam_from_world = look_along((-2.0, 0.3, 0.1), 0.1, -0.2, 0.3)
    depth = render_depth(World((wall(plain(0), size=3.0),)), camera, cam_from_world).ravel()
    rays = np.column_stack([camera.normalize(pixels(camera)), np.ones(depth.size)])
    normal = cam_from_world.R @ X
    plane_depth = normal @ cam_from_world.t / (rays @ normal)  # the plane holds the origin
    points = cam_from_world.inverse().apply(rays * plane_depth[:, None])
    hit = (plane_depth > 0) & (np.abs(points[:, 1:]) < 1.5).all(axis=1)
    assert 0.2 < hit.mean() < 1
    np.testing.assert_allclose(depth, np.where(hit, plane_depth, np.inf), rtol=1e-9)


def test_where_nothing_is_the_picture_is_black_and_the_depth_infinite() -> None:
    world = World((wall(plain(200)),))
    cam_from_world = look_at((-1.0, 0, 0), (0, 0.5, 0))
    depth = render_depth(world, PINHOLE, cam_from_world)
    image = render(world, PINHOLE, cam_from_world, seed=None)
    hit = np.isfinite(depth)
    assert 0.1 < hit.mean() < 0.9
    assert (image[cv2.dilate(hit.astype(np.uint8), np.ones((3, 3))) == 0] == 0).all()
    assert (image[cv2.erode(hit.astype(np.uint8), np.ones((3, 3))) == 1] == 200).all()
    away = look_at((-1.0, 0, 0), (-2, 0, 0))
    assert np.isinf(render_depth(world, PINHOLE, away)).all()


def test_a_surface_is_not_seen_from_behind() -> None:
    world = World((wall(plain(200)),))
    assert render(world, PINHOLE, look_at((-1.0, 0, 0), (0, 0, 0)), seed=None).max() == 200
    assert render(world, PINHOLE, look_at((1.0, 0, 0), (0, 0, 0)), seed=None).max() == 0


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_nearer_surface_hides_the_farther(order: tuple[int, int]) -> None:
    surfaces = (wall(plain(100), size=0.5), wall(plain(200), x=1.0, size=4))
    world = World((surfaces[order[0]], surfaces[order[1]]))
    cam_from_world = look_at((-1.0, 0, 0), (0, 0, 0))
    image = render(world, PINHOLE, cam_from_world, seed=None)
    depth = render_depth(world, PINHOLE, cam_from_world)
    assert (image[120, 158], depth[120, 158]) == (100, pytest.approx(1.0))
    assert (image[120, 10], depth[120, 10]) == (200, pytest.approx(2.0))


def test_a_surface_that_reaches_behind_the_camera_is_drawn_in_front() -> None:
    floor = Surface.from_texture(np.array([-5.0, 5.0, -1.0]), X, -Y, 10, 10, plain(90))
    cam_from_world = look_along((0, 0, 0), 0.3, 0, 0)
    depth = render_depth(World((floor,)), PINHOLE, cam_from_world)
    rows = np.arange(190, 240)  # shows the floor nearer than its end
    np.testing.assert_allclose(depth[rows, 160], 255.0 / (rows - 121.1))
    assert np.isinf(depth[:120]).all()


def test_pixels_outside_the_range_of_a_lens_stay_empty() -> None:
    camera = Camera("OPENCV_FISHEYE", 100, 100, (25.0, 25.0, 49.5, 49.5, 0.0, 0.0, 0.0, 0.0))
    world = World((wall(plain(200), size=50),))
    cam_from_world = look_at((-1.0, 0, 0), (0, 0, 0))
    depth = render_depth(world, camera, cam_from_world)
    image = render(world, camera, cam_from_world, seed=None)
    assert not np.isnan(depth).any()
    assert depth[50, 50] == pytest.approx(1.0)
    assert np.isinf(depth[0, 0])
    assert (image[50, 50], image[0, 0]) == (200, 0)


def test_far_textures_are_averaged_not_aliased() -> None:
    world = World((wall(checkerboard(200, 2)),))
    image = render(world, PINHOLE, look_at((-4.0, 0, 0), (0, 0, 0)), seed=None)
    seen = image[100:140, 140:180].astype(float)
    assert abs(seen.mean() - 130) < 2
    assert seen.std() < 5


def test_a_pixel_looks_the_same_in_another_picture_of_the_room(room: World) -> None:
    flight = flight_poses(room, 200)
    for i in (20, 90, 160):
        a, b = flight[i], flight[i + 3]
        image_a, image_b = (render(room, OPENCV, pose, seed=None) for pose in (a, b))
        depth_a, depth_b = (render_depth(room, OPENCV, pose) for pose in (a, b))
        visible, px = sees(OPENCV, depth_b, b.apply(points_seen(OPENCV, depth_a, a)))
        here, there = image_a.ravel()[visible].astype(float), px[visible, ::-1].T
        difference, difference_2px_aside = (
            np.abs(map_coordinates(image_b.astype(float), there + shift, order=1) - here).mean()
            for shift in (0, 2)
        )
        assert visible.mean() > 0.6
        assert difference < 6
        assert difference_2px_aside > 2 * difference


def test_pictures_repeat_with_their_seed_and_differ_with_another(room: World) -> None:
    pose = flight_poses(room, 10)[3]
    ideal, first = (render(room, PINHOLE, pose, seed=seed) for seed in (None, 1))
    assert (render(room, PINHOLE, pose, seed=1) == first).all()
    assert (render(room, PINHOLE, pose, seed=2) != first).mean() > 0.5
    assert (render(room, PINHOLE, pose, seed=None) == ideal).all()
    assert ideal.dtype == first.dtype == np.uint8
    assert ideal.shape == first.shape == (240, 320)


@pytest.mark.slow
def test_rooms_repeat_with_their_seed_and_differ_with_another(room: World) -> None:
    pose = flight_poses(room, 10)[3]
    image = render(room, PINHOLE, pose, seed=None)
    again, other = make_room.__wrapped__(0), make_room.__wrapped__(1)
    assert (render(again, PINHOLE, pose, seed=None) == image).all()
    assert (render(other, PINHOLE, pose, seed=None) != image).mean() > 0.5


def test_a_world_survives_the_way_to_another_process() -> None:
    world = World((wall(checkerboard(8, 40)),))
    pose = look_at((-1.0, 0.1, 0), (0, 0, 0))
    image = render(world, PINHOLE, pose, seed=5)
    assert (render(pickle.loads(pickle.dumps(world)), PINHOLE, pose, seed=5) == image).all()


def test_a_camera_that_looks_at_a_point_sees_it_upright_in_the_middle() -> None:
    centers = np.random.default_rng(0).uniform(-2, 2, (20, 3))
    target = np.array([0.3, -5.0, 0.7])
    poses = look_at(centers, target)
    np.testing.assert_allclose(poses.center, centers, atol=1e-12)
    seen = poses.apply(target)
    np.testing.assert_allclose(seen[:, :2], 0, atol=1e-12)
    assert (seen[:, 2] > 0).all()
    assert (np.linalg.det(poses.R) > 0.999).all()
    assert (poses.R[:, 1, 2] < 0).all()  # the picture's down is down


def test_roll_is_clockwise_seen_from_behind_and_pitch_upwards() -> None:
    rolled = look_along(np.zeros(3), 0.0, 0.0, 0.2)
    right = rolled.R[0]
    np.testing.assert_allclose(right, [0, -np.cos(0.2), -np.sin(0.2)], atol=1e-12)
    raised = look_along(np.zeros(3), 0.0, 0.2, 0.0)
    np.testing.assert_allclose(raised.R[2], [np.cos(0.2), 0, np.sin(0.2)], atol=1e-12)


def test_clearance_is_signed() -> None:
    world = World((wall(plain(0)),))
    points = np.array([[-0.2, 0, 0], [0.2, 0.1, 0.1], [-0.3, 0.9, 0]])
    np.testing.assert_allclose(world.clearance(points), [0.2, -0.2, 0.5])


@pytest.mark.parametrize("seed", [0, 1])
def test_the_flight_is_smooth_and_clear_of_everything(room: World, seed: int) -> None:
    flight = flight_poses(room, 1000, seed)
    assert len(flight) == 1000
    assert room.clearance(flight.center).min() >= 0.4
    steps = np.linalg.norm(np.diff(flight.center, axis=0), axis=1)
    np.testing.assert_allclose(steps, steps.mean(), rtol=0.05)
    turns = np.diff(np.unwrap(np.arctan2(flight.R[:, 2, 1], flight.R[:, 2, 0])))
    assert np.rad2deg(np.abs(turns) / steps).max() < 150  # degrees a metre
    assert np.abs(np.arcsin(flight.R[:, 2, 2])).max() < 0.3  # pitch
    assert np.abs(np.arcsin(flight.R[:, 0, 2])).max() < 0.1  # roll
    assert np.ptp(flight.center, axis=0).min() > 0.5  # in all three directions
    survey = survey_poses(room, 140)
    assert (
        np.linalg.norm(survey.center[:, None] - flight_poses(room, 200, seed).center, axis=2).min()
        > 0.01
    )


def test_a_world_without_space_for_a_flight_is_refused() -> None:
    narrow = World((wall(plain(0)), wall(plain(0), x=0.3)))
    with pytest.raises(ConfigError, match="more space"):
        flight_poses(narrow, 10)


def test_every_place_of_the_flight_is_in_several_survey_images(room: World) -> None:
    survey, flight = survey_poses(room, 140), flight_poses(room, 8)
    assert len(survey) == 140
    assert room.clearance(survey.center).min() > 0.4
    depths = [render_depth(room, SMALL, survey[i]) for i in range(len(survey))]
    for i in range(len(flight)):
        points = points_seen(SMALL, render_depth(room, SMALL, flight[i]), flight[i])
        overlaps = [
            sees(SMALL, depth, survey[j].apply(points))[0].mean() for j, depth in enumerate(depths)
        ]
        assert np.sum(np.array(overlaps) > 0.3) >= 5


def test_more_survey_images_than_places_are_refused(room: World) -> None:
    with pytest.raises(ConfigError, match="fewer images"):
        survey_poses(room, 100_000)


def test_the_room_is_closed_and_worth_tracking_everywhere(room: World) -> None:
    flight = flight_poses(room, 8)
    for i in range(len(flight)):
        depth = render_depth(room, OPENCV, flight[i])
        assert depth.min() > 0.3
        assert depth.max() < 9
        image = render(room, OPENCV, flight[i], seed=i)
        corners = cv2.goodFeaturesToTrack(image, 2000, 0.01, 3)[:, 0]
        cells = (np.arange(0, 241, 80), np.arange(0, 321, 80))
        counts = np.histogram2d(corners[:, 1], corners[:, 0], cells)[0]
        assert len(corners) > 400
        assert counts.min() >= 5
        assert 70 < image.mean() < 150
