from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from trigpoint.camera import Camera
from trigpoint.errors import ConfigError
from trigpointd.config import DepthaiConfig, McapConfig, V4l2Config, load_config

MINIMAL = """
map = "place.tpmap"
[source]
type = "mcap"
path = "flight.mcap"
"""

OAK = """
map = "place.tpmap"
[source]
type = "depthai"
"""

CAMERA = """
map = "place.tpmap"
[source]
type = "v4l2"
device = "/dev/video0"
camera = "PINHOLE 640 480 460 461 320 240"
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "trigpointd.toml"
    path.write_text(text)
    return path


def test_a_minimal_file_is_enough_and_paths_are_relative_to_it(tmp_path: Path) -> None:
    config = load_config(write(tmp_path, MINIMAL))
    assert config.map == tmp_path / "place.tpmap"
    assert isinstance(config.source, McapConfig)
    assert config.source.path == tmp_path / "flight.mcap"
    assert config.localizer.num_anchors == 20
    assert config.zenoh is None
    np.testing.assert_array_equal(config.camera.body_from_camera.R, np.eye(3))


def test_every_table_is_read(tmp_path: Path) -> None:
    text = (
        MINIMAL
        + """
rate = 2.0
[camera]
position_m = [1, 2, 3]
rotation_wxyz = [0.5, -0.5, 0.5, -0.5]
[model]
num_threads = 1
[localizer]
num_anchors = 50
generator = "anchor_pairs"
[zenoh]
mode = "client"
connect = ["tcp/127.0.0.1:7447"]
[log]
path = "/var/log/trigpoint.mcap"
"""
    )
    config = load_config(write(tmp_path, text))
    assert isinstance(config.source, McapConfig)
    assert config.source.rate == 2.0
    assert config.localizer.num_anchors == 50
    assert config.log is not None
    assert config.log.path == Path("/var/log/trigpoint.mcap")
    # The camera's z axis, ahead, is the body's x axis.
    np.testing.assert_allclose(config.camera.body_from_camera.R @ [0, 0, 1], [1, 0, 0], atol=1e-12)


def test_an_oak_camera_needs_no_more_than_its_type(tmp_path: Path) -> None:
    assert load_config(write(tmp_path, OAK)).source == DepthaiConfig(type="depthai")
    text = 'device = "10.0.0.7"\nsocket = "CAM_B"\nfps = 15\nmax_exposure_ms = 4'
    expected = DepthaiConfig(
        type="depthai", device="10.0.0.7", socket="CAM_B", fps=15, max_exposure_ms=4
    )
    assert load_config(write(tmp_path, OAK + text)).source == expected


def test_a_cameras_intrinsics_are_read_as_colmap_writes_them(tmp_path: Path) -> None:
    source = load_config(write(tmp_path, CAMERA)).source
    assert isinstance(source, V4l2Config)
    assert source.device == Path("/dev/video0")
    assert source.camera == Camera("PINHOLE", 640, 480, (460, 461, 319.5, 239.5))
    assert (source.format, source.fps) == ("YUYV", None)
    assert "PINHOLE 640 480 460" in source.model_dump_json()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (MINIMAL.replace("map =", "mpa ="), "unknown key 'mpa'; did you mean 'map'"),
        (MINIMAL + "rat = 1", "unknown key 'source.rat'; did you mean 'rate'"),
        (MINIMAL + "[localizer]\nnum_anchor = 9", "did you mean 'num_anchors'"),
        (MINIMAL + "[zenho]", "unknown key 'zenho'; did you mean 'zenoh'"),
        ("map = 'a'", "'source' is missing"),
        (MINIMAL + "[localizer]\nnum_anchors = 1", "num_anchors must be at least 2"),
        (MINIMAL + "[localizer]\nmin_inliers = -3", "min_inliers must be positive"),
        (MINIMAL + "[localizer]\nnum_anchors = 'x'", "'localizer.num_anchors': .*valid integer"),
        (MINIMAL + "[camera]\nrotation_wxyz = [1, 1, 0, 0]", "unit quaternion"),
        (OAK + "max_exposure = 2", "unknown key 'source.max_exposure'; .*'max_exposure_ms'"),
        (OAK + "socket = 'CAM_Z'", "'source.socket': "),
        (OAK + "fps = 0", "'source.fps': "),
        (OAK + "exposure_ms = 2", "'source': .* needs both exposure_ms and iso"),
        (OAK + "exposure_ms = 2\niso = 400\nmax_exposure_ms = 2", "omit exposure_ms"),
        (MINIMAL.replace("mcap\"\npath", "video\"\npath"),
         "'source.type': must be one of 'mcap', 'v4l2', 'depthai', not 'video'"),
        (MINIMAL.replace("type =", "typ ="), "unknown key 'source.typ'; did you mean 'type'"),
        (MINIMAL.replace('type = "mcap"', ""), "'source.type' is missing"),
        (MINIMAL.replace('path = "flight.mcap"', ""), "'source.path' is missing"),
        ("map = 'a'\nsource = 3", "'source': .*object"),
        (CAMERA.replace("device", "devise"), "unknown key 'source.devise'; did you mean 'device'"),
        (CAMERA.replace("PINHOLE", "PINEHOLE"), "'source.camera': .*'PINEHOLE' is not known; use"),
        (CAMERA.replace(" 240", ""), "'source.camera': .*takes 4 parameters"),
        (CAMERA + "format = 'RGB3'", "'source.format': Input should be 'YUYV', 'GREY'"),
        (CAMERA + "fps = 0", "'source.fps': .*greater than 0"),
        ("base_key = '/x/'\n" + MINIMAL, "'base_key'"),
        (MINIMAL + "rate = nan", "'source.rate'"),
        (MINIMAL + "[localizer]\nnum_anchors = '20'", "'localizer.num_anchors': .*valid integer"),
        (MINIMAL + "[log]\npath = 'a'\nframes = 0", "'log.frames': .*valid boolean"),
        (MINIMAL + "[log]\npath = '%Y/a'", "'log.path': .*not in a folder's"),
        (MINIMAL + "[log]\npath = 'a-%s'", "'log.path': .*takes %Y, %m, %d, %H, %M and %S"),
        (MINIMAL + "[log]\npath = 'a'\nmax_part_s = 0", "'log.max_part_s'"),
        (MINIMAL + "[log]\npath = 'a'\noverwrite = true\nmax_part_mb = 9", "leave out overwrite"),
        (MINIMAL + "[localizer]\nmin_confidence = 40", "min_confidence must be at most 1"),
        (MINIMAL + "[model]\nnetwork = 3", "'model.network': .* 'tiny', 'base', 'large' or"),
        (MINIMAL + "[model]\npath = 'a'", "unknown key 'model.path'"),
        ("map = ", "is not TOML"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(ConfigError, match=message) as caught:
        load_config(path)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(path))


def test_a_network_is_a_profile_or_a_file_beside_the_settings(tmp_path: Path) -> None:
    assert load_config(write(tmp_path, MINIMAL)).model.network == "base"
    tiny = load_config(write(tmp_path, MINIMAL + '[model]\nnetwork = "tiny"')).model
    assert (tiny.network, tiny.retrieval, tiny.matcher) == ("tiny", None, None)
    text = '[model]\nnetwork = "a.onnx"\nretrieval = "b.onnx"\nmatcher = "/opt/c.onnx"'
    files = load_config(write(tmp_path, MINIMAL + text)).model
    assert files.network == tmp_path / "a.onnx"
    assert files.retrieval == tmp_path / "b.onnx"
    assert files.matcher == Path("/opt/c.onnx")


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot read .*: No such file"):
        load_config(tmp_path / "none.toml")


def test_a_time_of_a_recording_is_one_of_tomls_and_has_a_zone(tmp_path: Path) -> None:
    text = 'map = "m.tpmap"\n[source]\ntype = "mcap"\npath = "r.mcap"\nstart_time = '
    source = load_config(write(tmp_path, text + "2026-11-21T10:15:00+02:00\n")).source
    assert isinstance(source, McapConfig)
    assert source.start_time == datetime(2026, 11, 21, 8, 15, tzinfo=UTC)
    with pytest.raises(ConfigError, match=r"'source.start_time': .*timezone") as caught:
        load_config(write(tmp_path, text + "2026-11-21T10:15:00\n"))
    assert "\n" not in str(caught.value)
