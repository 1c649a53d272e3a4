"""The daemon as systemd sees it: its notifications on a real socket, its end by real signals."""

import signal
from pathlib import Path

import pytest

from tests.conftest import Demo
from tests.systemd.supervisor import supervised, write_config, write_hang

WATCHDOG_S = 0.4
SILENCE_S = 10 * WATCHDOG_S


def test_ready_comes_first_and_stopping_last(demo: Demo, tmp_path: Path) -> None:
    config = write_config(tmp_path, demo.map, demo.recording, rate=20.0)
    with supervised(config, WATCHDOG_S) as daemon:
        messages = daemon.until(lambda message: "STOPPING" in message)
        assert daemon.process.wait(60) == 0
    assert messages[0] == {"READY": "1"}
    assert all(message.get("WATCHDOG") == "1" for message in messages[1:-1])


def test_the_status_tells_of_source_frames_and_the_last_outcome(demo: Demo, tmp_path: Path) -> None:
    config = write_config(tmp_path, demo.map, demo.recording, rate=0.5)
    with supervised(config, WATCHDOG_S) as daemon:
        *_, before = daemon.until(lambda message: "STATUS" in message)
        *_, later = daemon.until(lambda message: "last" in message.get("STATUS", ""))
    assert before["STATUS"] == "waiting for the first frame; no frames, 0 dropped"
    assert later["STATUS"].startswith("frames arrive, last LOCALIZED; ")
    assert later["STATUS"].endswith(" LOCALIZED, 0 dropped")


def test_a_camera_without_frames_is_no_hang(demo: Demo, tmp_path: Path) -> None:
    config = write_config(tmp_path, demo.map, demo.recording, rate=1e-4)  # a frame in 17 minutes
    with supervised(config, WATCHDOG_S) as daemon:
        messages = daemon.until(lambda message: "no frame for" in message.get("STATUS", ""))
    assert sum(message.get("WATCHDOG") == "1" for message in messages) > 10


def test_a_network_that_never_returns_starves_the_watchdog(demo: Demo, tmp_path: Path) -> None:
    with supervised(write_hang(tmp_path, demo), WATCHDOG_S) as daemon:
        daemon.until(lambda message: "last" in message.get("STATUS", ""))
        with pytest.raises(TimeoutError):
            daemon.until(lambda message: "STOPPING" in message, SILENCE_S)
        assert daemon.process.poll() is None
        daemon.process.send_signal(signal.SIGABRT)  # as systemd does then
        assert daemon.process.wait(60) == -signal.SIGABRT
        said = daemon.process.stderr.read() if daemon.process.stderr else ""
    assert "Fatal Python error: Aborted" in said
    assert "in extract" in said  # where it hung


def test_without_a_watchdog_the_status_comes_all_the_same(demo: Demo, tmp_path: Path) -> None:
    config = write_config(tmp_path, demo.map, demo.recording, rate=0.1)
    with supervised(config, watchdog_s=0.0) as daemon:
        daemon.until(lambda message: "last LOCALIZED" in message.get("STATUS", ""))
