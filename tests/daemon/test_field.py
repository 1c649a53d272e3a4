"""The daemon as a process where things go wrong around it: its router, its peers, its end."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import zenoh
from mcap.reader import make_reader

from tests.conftest import Demo
from tests.daemon.test_service import daemon, wait_until_larger, write_config
from tests.daemon.zenoh_daemon import connect, get, open_session, wait_until
from trigpoint_db.demo import CAMERA
from trigpoint_db.importers.colmap import read_model

AWAY_S = 30
STOP_S = 60  # the service's TimeoutStopSec= is 5; a loaded machine may need more


def read_log(path: Path) -> tuple[dict[str, int], list[dict[str, Any]]]:
    """Return how many messages there are of each topic's last part, and the statuses."""
    with path.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None  # it was closed properly
        assert summary.statistics is not None
        counts = summary.statistics.channel_message_counts
        by_topic = {c.topic.rsplit("/", 1)[1]: counts[id_] for id_, c in summary.channels.items()}
        statuses = [
            json.loads(m.data) for _, _, m in reader.iter_messages(["trigpoint/test/status"])
        ]
    return by_topic, statuses


@contextlib.contextmanager
def router(port: int) -> Iterator[list[str]]:
    """A router, with the keys of what passes through it."""
    keys: list[str] = []
    with open_session(mode="router", listen__endpoints=[f"tcp/127.0.0.1:{port}"]) as session:
        session.declare_subscriber("trigpoint/**", lambda s: keys.append(str(s.key_expr)))
        yield keys


@pytest.mark.slow
def test_while_the_router_is_away_for_30_s_poses_go_on_in_the_log(
    demo: Demo, tmp_path: Path, port: int
) -> None:
    """Both modes at once, since it takes those 30 s."""
    configs = {}
    for mode in ("client", "peer"):
        (tmp_path / mode).mkdir()
        configs[mode] = config = write_config(
            tmp_path / mode, demo.map, demo.recording, port=port, more="rate = 4.0\nloop = true"
        )
        text = config.read_text().replace("trigpoint/test", f"trigpoint/{mode}")
        config.write_text(text.replace("[zenoh]", f'[zenoh]\nmode = "{mode}"'))
    logs = [config.with_name("log.mcap") for config in configs.values()]
    poses = {f"trigpoint/{mode}/pose" for mode in configs}
    with contextlib.ExitStack() as stack:
        with router(port) as keys:
            processes = [stack.enter_context(daemon(config)) for config in configs.values()]
            wait_until(lambda: poses <= set(keys))
        until_s = time.monotonic() + AWAY_S
        while time.monotonic() < until_s:
            for log in logs:
                wait_until_larger(log, log.stat().st_size + 1)
        with router(port) as keys:
            wait_until(lambda: poses <= set(keys))
        said = []
        for process in processes:
            process.send_signal(signal.SIGTERM)
            assert process.wait(STOP_S) == 0
            assert process.stderr is not None
            said.append(process.stderr.read())
    for text, who in zip(said, ("no Zenoh router", "nobody"), strict=True):
        changes = [line for line in text.splitlines() if "Zenoh is there" in line or who in line]
        assert any(f"{who} answers at tcp/127.0.0.1:{port}" in line for line in changes)
        assert all(a != b for a, b in pairwise(changes))  # each is said once
    for mode, log in zip(configs, logs, strict=True):
        with log.open("rb") as stream:
            reader = make_reader(stream)
            messages = list(reader.iter_messages([f"trigpoint/{mode}/status"]))
        statuses = [json.loads(message.data) for _, _, message in messages]
        localized = [status for status in statuses if status["status"] == "LOCALIZED"]
        assert len(localized) > 0.9 * len(statuses)
        assert statuses[-1]["num_dropped"] == 0


@contextlib.contextmanager
def live_daemon(picture: Path, config: Path) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "tests.daemon.live_daemon", str(picture), str(config)]
    root = Path(__file__).parents[2]
    paths = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        command, cwd=root, env=paths, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def test_sigterm_in_a_flood_of_requests_and_frames_ends_it_in_order(
    demo: Demo, tmp_path: Path, port: int
) -> None:
    picture = demo.folder / "survey" / read_model(demo.folder / "sparse")[5].name
    config = write_config(tmp_path, demo.map, demo.recording)
    config.write_text(
        config.read_text() + f"""
[zenoh]
listen = ["tcp/127.0.0.1:{port}"]
multicast_scouting = false
[zenoh.requests]
max_rate_hz = 10000.0
cameras = {{ phone = "{CAMERA.to_text()}" }}
"""
    )  # fmt: skip
    image, is_over, answers = picture.read_bytes(), threading.Event(), list[str]()
    received: list[zenoh.Sample] = []

    def flood() -> None:
        with connect(port) as session:
            while not is_over.is_set():
                replies = get(session, "trigpoint/test/localize?camera=phone", image, "image/jpeg")
                answers.extend(text for _, text in replies)
                if not replies:  # the daemon has left
                    return

    with live_daemon(picture, config) as process:
        assert process.stderr is not None
        assert any("localizing" in line for line in process.stderr)
        flooding = [threading.Thread(target=flood) for _ in range(6)]
        with connect(port) as session:
            session.declare_subscriber("trigpoint/test/status", received.append)
            for thread in flooding:
                thread.start()
            try:
                wait_until(lambda: any("LOCALIZED" in answer for answer in answers))
                wait_until(lambda: any("busy" in answer for answer in answers))
                wait_until(lambda: len(received) >= 10)
                process.send_signal(signal.SIGTERM)
                assert process.wait(STOP_S) == 0
            finally:
                is_over.set()
                for thread in flooding:
                    thread.join()
        assert "stopping" in process.stderr.read()
    by_topic, statuses = read_log(tmp_path / "log.mcap")
    assert by_topic["status"] == by_topic["image"] == len(statuses)
    # The last frame, which was in work, has been published as well as logged.
    assert json.loads(received[-1].payload.to_bytes()) == statuses[-1]
    assert {status["status"] for status in statuses} == {"LOCALIZED"}
