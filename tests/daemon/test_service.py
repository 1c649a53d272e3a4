"""The daemon as a process of its own: real signals, a real Zenoh session on loopback."""

import contextlib
import json
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import zenoh
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoders
from mcap_ros2.decoder import DecoderFactory as RosDecoders
from rosbags.typesys import Stores, get_typestore

from tests.conftest import Demo
from trigpoint.camera import Camera
from trigpoint.rigid import Rigid3, rotation_angle
from trigpoint_db.demo import BODY_FROM_CAMERA
from trigpoint_db.poses import read_poses
from trigpoint_db.recording import RecordedImage, write_recording

TIMEOUT_S = 60


def command(program: str, *arguments: object) -> list[str]:
    return [sys.executable, "-m", f"{program}.cli", *map(str, arguments)]


def run(program: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(program, *arguments), capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )


def write_config(
    folder: Path, map_: Path, recording: Path, *, port: int | None = None, more: str = ""
) -> Path:
    zenoh_table = "" if port is None else f"""
[zenoh]
connect = ["tcp/127.0.0.1:{port}"]
multicast_scouting = false
wait_for_subscriber_s = 20
"""  # fmt: skip
    path = folder / "trigpointd.toml"
    path.write_text(f"""
map = "{map_}"
base_key = "trigpoint/test"
[camera]
position_m = [0.12, 0.0, 0.03]
rotation_wxyz = [0.5, -0.5, 0.5, -0.5]
[log]
path = "log.mcap"
{zenoh_table}
[source]
type = "mcap"
path = "{recording}"
{more}
""")
    return path


@contextlib.contextmanager
def subscriber(port: int) -> Iterator[dict[str, list[zenoh.Sample]]]:
    """Collect what arrives, by the last part of the key."""
    settings = zenoh.Config()
    settings.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    settings.insert_json5("scouting/multicast/enabled", "false")
    samples: dict[str, list[zenoh.Sample]] = {"pose": [], "status": [], "alive": []}

    def collect(sample: zenoh.Sample) -> None:
        samples[str(sample.key_expr).rsplit("/", 1)[1]].append(sample)

    with zenoh.open(settings) as session:
        session.declare_subscriber("trigpoint/test/*", collect)
        session.liveliness().declare_subscriber("trigpoint/test/alive", collect)
        yield samples


def test_a_subscriber_receives_every_pose_and_status(demo: Demo, tmp_path: Path, port: int) -> None:
    with subscriber(port) as samples:
        done = run(
            "trigpointd",
            "run",
            "--config",
            write_config(tmp_path, demo.map, demo.recording, port=port),
        )
        assert done.returncode == 0, done.stderr
    statuses = [json.loads(sample.payload.to_bytes()) for sample in samples["status"]]
    localized = [status for status in statuses if status["status"] == "LOCALIZED"]
    assert len(statuses) == 16
    assert len(localized) >= 15
    assert [status["time_ns"] for status in statuses] == sorted(s["time_ns"] for s in statuses)
    assert len(samples["pose"]) == len(localized)
    assert [sample.kind for sample in samples["alive"]] == [
        zenoh.SampleKind.PUT,
        zenoh.SampleKind.DELETE,
    ]

    truth = read_poses(demo.truth)  # body_from_world
    decode = get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr
    for sample, status in zip(samples["pose"], localized, strict=True):
        assert str(sample.encoding) == (
            "application/cdr;geometry_msgs/msg/PoseWithCovarianceStamped"
        )
        message: Any = decode(
            sample.payload.to_bytes(), "geometry_msgs/msg/PoseWithCovarianceStamped"
        )
        time_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        assert time_ns == status["time_ns"]
        assert message.header.frame_id == "map"
        p, q = message.pose.pose.position, message.pose.pose.orientation
        world_from_body = Rigid3.from_quaternion([q.w, q.x, q.y, q.z], [p.x, p.y, p.z])
        expected = truth[str(time_ns)].inverse()
        assert np.linalg.norm(world_from_body.t - expected.t) < 0.05
        assert np.degrees(rotation_angle(world_from_body.R @ expected.R.T)) < 1.0
        covariance = message.pose.covariance.reshape(6, 6)
        np.testing.assert_allclose(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance)[0] > 0


def test_the_log_opens_with_independent_readers_and_replays(demo: Demo, tmp_path: Path) -> None:
    done = run("trigpointd", "run", "--config", write_config(tmp_path, demo.map, demo.recording))
    assert done.returncode == 0, done.stderr
    log = tmp_path / "log.mcap"
    with log.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[ProtobufDecoders(), RosDecoders()])
        topics = [c.topic for c in reader.get_summary().channels.values()]  # type: ignore[union-attr]
        assert sorted(topics) == [
            "/camera/calibration", "/camera/image", "trigpoint/test/anchors",
            "trigpoint/test/annotations", "trigpoint/test/path", "trigpoint/test/points",
            "trigpoint/test/pose", "trigpoint/test/status", "trigpoint/test/transforms",
        ]  # fmt: skip
        images = list(reader.iter_decoded_messages(topics=["/camera/image"]))
        poses = list(reader.iter_decoded_messages(topics=["trigpoint/test/pose"]))
        drawn = list(reader.iter_decoded_messages(topics=["trigpoint/test/annotations"]))
    assert len(images) == len(drawn) == 16
    drawn_ns = [d.decoded_message.points[0].timestamp.ToNanoseconds() for d in drawn]
    assert drawn_ns == [i.decoded_message.timestamp.ToNanoseconds() for i in images]
    assert len(poses) >= 15
    assert poses[0].decoded_message.pose.pose.orientation.w is not None
    for recording, out in ((demo.recording, "a.txt"), (log, "b.txt")):
        done = run("trigpointd", "replay", recording, "--map", demo.map, "--poses", tmp_path / out)
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.txt").read_bytes() == (tmp_path / "b.txt").read_bytes()


def test_the_same_replay_twice_gives_the_same_bytes(demo: Demo, tmp_path: Path) -> None:
    texts = []
    for name in ("first.txt", "second.txt"):
        done = run(
            "trigpointd", "replay", demo.recording, "--map", demo.map, "--poses", tmp_path / name
        )
        assert done.returncode == 0, done.stderr
        texts.append((tmp_path / name).read_bytes())
    assert texts[0] == texts[1]
    assert texts[0].count(b"\n") >= 15


@contextlib.contextmanager
def daemon(config: Path) -> Iterator[subprocess.Popen[str]]:
    """A daemon that has begun to localize, and is ended by whoever asked for it."""
    with subprocess.Popen(
        command("trigpointd", "run", "--config", config), stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if "localizing" in line:
                break
        try:
            yield process
        finally:
            process.kill()


def wait_until_larger(file: Path, num_bytes: int) -> None:
    deadline_s = time.monotonic() + TIMEOUT_S
    while not file.exists() or file.stat().st_size < num_bytes:
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


def test_sigterm_ends_it_in_order(demo: Demo, tmp_path: Path) -> None:
    config = write_config(tmp_path, demo.map, demo.recording, more="rate = 0.5")
    log = tmp_path / "log.mcap"
    with daemon(config) as process:
        wait_until_larger(log, 200_000)  # frames are written, others are still to come
        process.send_signal(signal.SIGTERM)
        assert process.wait(10) == 0
        assert "stopping" in (process.stderr.read() if process.stderr else "")
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None  # it was closed properly
    assert summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    by_topic = {channel.topic: counts[id_] for id_, channel in summary.channels.items()}
    # What was in work has been published: a status for each image.
    assert 1 <= by_topic["/camera/image"] < 16
    assert by_topic["trigpoint/test/status"] == by_topic["/camera/image"]


def test_sigterm_ends_the_wait_for_a_subscriber(demo: Demo, tmp_path: Path, port: int) -> None:
    config = write_config(tmp_path, demo.map, demo.recording, port=port)
    with daemon(config) as process:
        process.send_signal(signal.SIGTERM)
        assert process.wait(10) == 0


def test_if_nobody_subscribes_it_goes_on(demo: Demo, tmp_path: Path, port: int) -> None:
    config = write_config(tmp_path, demo.map, demo.recording, port=port)
    config.write_text(config.read_text().replace("subscriber_s = 20", "subscriber_s = 0.2"))
    done = run("trigpointd", "run", "--config", config)
    assert done.returncode == 0
    assert "nobody has subscribed to the poses in 0.2 s" in done.stderr


def test_after_kill_9_the_log_is_recovered_and_replays(demo: Demo, tmp_path: Path) -> None:
    config = write_config(tmp_path, demo.map, demo.recording, more="rate = 4.0")
    log = tmp_path / "log.mcap"
    with daemon(config) as process:
        wait_until_larger(log, 600_000)
        process.kill()
    logged = 0
    with contextlib.suppress(EndOfFile), log.open("rb") as stream:
        for record in StreamReader(stream).records:
            logged += isinstance(record, Message) and record.channel_id == 2
    assert logged >= 5  # of some 80 kB each
    whole = tmp_path / "whole.mcap"
    done = run("trigpoint_db", "recover", log, "-o", whole)
    assert done.returncode == 0, done.stderr
    assert re.search(rf" {logged} +/camera/image\n", done.stdout)
    poses = {}
    for recording in (log, whole, demo.recording):
        out = tmp_path / f"{recording.stem}.txt"
        done = run("trigpointd", "replay", recording, "--map", demo.map, "--poses", out)
        assert done.returncode == 0, done.stderr
        assert ("`trigpoint-db recover`" in done.stderr) == (recording == log)
        poses[recording] = out.read_text()
    assert len(read_poses(tmp_path / "whole.txt")) == logged
    assert poses[log] == poses[whole]
    assert poses[demo.recording].startswith(poses[whole])
    done = run("trigpoint_db", "verify", demo.map)
    assert done.returncode == 0, done.stdout


def test_each_part_of_a_log_replays_the_same_poses(demo: Demo, tmp_path: Path) -> None:
    config = write_config(tmp_path, demo.map, demo.recording)
    config.write_text(config.read_text().replace('"log.mcap"', '"log.mcap"\nmax_part_mb = 1'))
    done = run("trigpointd", "run", "--config", config)
    assert done.returncode == 0, done.stderr
    parts = sorted(tmp_path.glob("log.*.mcap"))
    assert len(parts) >= 2
    poses = {}
    for recording in (*parts, demo.recording):
        out = tmp_path / "poses.txt"
        done = run("trigpointd", "replay", recording, "--map", demo.map, "--poses", out)
        assert done.returncode == 0, done.stderr
        poses[recording] = out.read_text()
    whole = poses.pop(demo.recording)
    assert "".join(poses.values()) == whole
    with parts[-1].open("rb") as stream:
        reader = make_reader(stream)
        [metadata] = reader.iter_metadata()
        statuses = [
            json.loads(m.data) for _, _, m in reader.iter_messages(["trigpoint/test/status"])
        ]
    settings = json.loads(metadata.metadata["settings"])
    assert settings["map"] == str(demo.map)
    assert all((s["num_unlogged"], s["problems"]) == (0, {}) for s in statuses)
    assert "age_ms" not in statuses[0]


def test_a_part_of_a_recording_is_replayed(demo: Demo, tmp_path: Path) -> None:
    arguments = ("replay", demo.recording, "--map", demo.map)
    done = run("trigpointd", *arguments, "--start", "0.5", "--end", "0.8", "--rate", "5")
    assert done.returncode == 0, done.stderr
    assert "3 LOCALIZED" in done.stdout
    for wrong in (
        ("--start", "2"), ("--start", "-1"), ("--end", "nan"), ("--rate", "0"),
        ("--log", tmp_path / "%s.mcap"),
    ):  # fmt: skip
        done = run("trigpointd", *arguments, *wrong)
        assert done.returncode == 1
        assert done.stderr.startswith("trigpointd: ")
        assert done.stderr.count("\n") == 1


def test_a_log_folder_that_vanishes_does_not_stop_the_daemon(demo: Demo, tmp_path: Path) -> None:
    config = write_config(tmp_path, demo.map, demo.recording, more="rate = 8.0\nloop = true")
    folder = tmp_path / "stick"
    folder.mkdir()
    config.write_text(config.read_text().replace('"log.mcap"', '"stick/log.mcap"\nflush_s = 0.1'))
    with daemon(config) as process:
        assert process.stderr is not None
        wait_until_larger(folder / "log.mcap", 200_000)
        shutil.rmtree(folder)
        assert "recording pauses" in process.stderr.readline()
        folder.mkdir()
        assert "recording goes on in" in process.stderr.readline()
        process.send_signal(signal.SIGTERM)
        assert process.wait(10) == 0
    with (folder / "log.000001.mcap").open("rb") as stream:
        reader = make_reader(stream)
        statuses = [
            json.loads(m.data) for _, _, m in reader.iter_messages(["trigpoint/test/status"])
        ]
    assert "was deleted" in statuses[0]["problems"]["log"]
    assert statuses[0]["num_unlogged"] > 0
    times_ns = [status["time_ns"] for status in statuses]
    assert times_ns == sorted(times_ns)


def test_a_corrupt_image_in_a_recording_does_not_stop_the_stream(
    demo: Demo, tmp_path: Path
) -> None:
    images = sorted((demo.folder / "flight").glob("*.jpg"))[:4]
    (tmp_path / "bad.jpg").write_bytes(images[1].read_bytes()[:5000])
    dark = np.zeros((480, 640), np.uint8)
    cv2.imwrite(str(tmp_path / "dark.png"), dark)
    paths = [images[0], tmp_path / "bad.jpg", images[2], tmp_path / "dark.png", images[3]]
    camera = Camera("OPENCV", 640, 480, (460, 460, 319.5, 239.5, -0.08, 0.02, 0.001, -0.0005))
    write_recording(tmp_path / "damaged.mcap", [RecordedImage(path, camera) for path in paths])
    done = run("trigpointd", "replay", tmp_path / "damaged.mcap", "--map", demo.map)
    assert done.returncode == 0, done.stderr
    assert "1 BAD_FRAME, 3 LOCALIZED, 1 TOO_DARK, 0 dropped" in done.stdout


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"map": "nowhere.tpmap"}, "nowhere.tpmap"),
        ({"recording": "nowhere.mcap"}, "nowhere.mcap"),
    ],
)
def test_missing_files_are_one_line_and_exit_1(
    demo: Demo, tmp_path: Path, change: dict[str, str], message: str
) -> None:
    files = {"map": demo.map, "recording": demo.recording, **change}
    done = run("trigpointd", "replay", files["recording"], "--map", files["map"])
    assert done.returncode == 1
    assert done.stderr.startswith("trigpointd: ")
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_port_in_use_is_one_line_and_exit_1(demo: Demo, tmp_path: Path, port: int) -> None:
    config = write_config(tmp_path, demo.map, demo.recording)
    config.write_text(config.read_text() + f"[zenoh]\nlisten = ['tcp/127.0.0.1:{port}']\n")
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", port))
        listener.listen()
        done = run("trigpointd", "run", "--config", config)
    assert done.returncode == 1
    assert f"cannot open a Zenoh session on tcp/127.0.0.1:{port}" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_log_that_exists_is_one_line_and_exit_1(demo: Demo, tmp_path: Path, port: int) -> None:
    config = write_config(tmp_path, demo.map, demo.recording, port=port)
    (tmp_path / "log.mcap").write_text("precious")
    done = run("trigpointd", "run", "--config", config)
    assert done.returncode == 1
    errors = [line for line in done.stderr.splitlines() if "poses go to" not in line]
    assert len(errors) == 1
    assert "log.mcap exists" in errors[0]
    assert (tmp_path / "log.mcap").read_text() == "precious"


def test_check_config_opens_what_is_named(demo: Demo, tmp_path: Path) -> None:
    config = write_config(tmp_path, demo.map, demo.recording)
    done = run("trigpointd", "check-config", config)
    assert done.returncode == 0
    assert f"{demo.recording}: images on /camera/image, OPENCV 640 480 460 460" in done.stdout
    good = config.read_text()
    for right, wrong in (("map.tpmap", "nap.tpmap"), ("log.mcap", "lag/log.mcap")):
        config.write_text(good.replace(right, wrong))
        done = run("trigpointd", "check-config", config)
        assert done.returncode == 1
        assert wrong.partition("/")[0] in done.stderr


def test_a_camera_that_is_not_there_is_waited_for_but_fails_the_check(
    demo: Demo, tmp_path: Path
) -> None:
    config = write_config(tmp_path, demo.map, demo.recording)
    camera = 'device = "video-none"\ncamera = "PINHOLE 640 480 460 460 320 240"'
    text = config.read_text().replace('"mcap"', '"v4l2"')
    config.write_text(text.replace(f'path = "{demo.recording}"', camera))
    done = run("trigpointd", "check-config", config)
    assert done.returncode == 1
    absent = f"trigpointd: camera {tmp_path}/video-none: it is not there: plug it in, or name "
    assert done.stderr == absent + "another source.device\n"
    with daemon(config) as process:
        assert process.stderr is not None
        assert process.stderr.readline().startswith(absent)
        process.send_signal(signal.SIGTERM)
        assert process.wait(10) == 0
        assert absent not in process.stderr.read()


def test_without_poselib_opencv_does_its_part(demo: Demo, tmp_path: Path) -> None:
    """As on aarch64, for which PoseLib has no wheel."""
    program = "import sys; sys.modules['poselib'] = None; from trigpointd.cli import main; main()"
    poses = tmp_path / "poses.txt"
    arguments = ["replay", demo.recording, "--map", demo.map, "--poses", poses]
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        capture_output=True, text=True, timeout=TIMEOUT_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    truth, found = read_poses(demo.truth), read_poses(poses)
    assert len(found) >= 15
    errors_m = [
        np.linalg.norm(pose.center - (BODY_FROM_CAMERA.inverse() @ truth[time_ns]).center)
        for time_ns, pose in found.items()
    ]
    assert np.median(errors_m) < 0.01


def test_a_failed_start_costs_no_file(demo: Demo, tmp_path: Path) -> None:
    poses = tmp_path / "poses.txt"
    poses.write_text("precious")
    done = run("trigpointd", "replay", demo.recording, "--map", tmp_path / "no", "--poses", poses)
    assert done.returncode == 1
    assert poses.read_text() == "precious"
    recording = tmp_path / "copy.mcap"
    recording.write_bytes(demo.recording.read_bytes())
    done = run("trigpointd", "replay", recording, "--map", demo.map, "--poses", recording)
    assert done.returncode == 1
    assert "it is an input" in done.stderr
    config = write_config(tmp_path, demo.map, recording)
    config.write_text(config.read_text().replace('"log.mcap"', f'"{recording}"\noverwrite = true'))
    done = run("trigpointd", "run", "--config", config)
    assert done.returncode == 1
    assert "it is an input" in done.stderr
    assert recording.read_bytes() == demo.recording.read_bytes()
