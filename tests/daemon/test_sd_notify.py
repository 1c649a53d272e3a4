import socket
import time
from pathlib import Path

import pytest

from trigpointd.sd_notify import Heartbeat, notify


@pytest.mark.parametrize("abstract", [False, True])
def test_the_state_reaches_the_socket(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, abstract: bool
) -> None:
    address = f"@trigpoint-{tmp_path.name}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(address.replace("@", "\0") if abstract else address)
        monkeypatch.setenv("NOTIFY_SOCKET", address)
        notify("READY=1")
        assert listener.recv(100) == b"READY=1"


def test_without_systemd_nothing_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    notify("READY=1")


def test_tries_of_a_camera_that_is_away_are_no_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        heartbeat = Heartbeat()
        said = []
        for outcome in ("NO_FRAMES", "LOCALIZED", "NO_FRAMES"):
            heartbeat.frame(outcome)
            heartbeat.beat("7 of them", {"log": "no space"} if outcome == "LOCALIZED" else {})
            said.append(listener.recv(200).decode().partition("STATUS=")[2])
            now_s[0] += 12.0
    assert said == [
        "waiting for the first frame; 7 of them",
        "frames arrive, last LOCALIZED; log: no space; 7 of them",
        "no frame for 12 s, last NO_FRAMES; 7 of them",
    ]
