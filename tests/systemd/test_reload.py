"""SIGHUP: settings, networks and map are taken up anew, or all stays as it was."""

import contextlib
import json
import shutil
import signal
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

from tests.conftest import Demo
from tests.systemd.supervisor import Supervisor, supervised, write_config
from trigpointd.config import Config, McapConfig, RequestsConfig
from trigpointd.reload import Reloads
from trigpointd.requests import Request, Responder

LOG = '[log]\npath = "log.mcap"\nframes = false\n'


def reload(daemon: Supervisor) -> None:
    """Send SIGHUP and wait until it was seen to."""
    daemon.process.send_signal(signal.SIGHUP)
    daemon.until(lambda message: "RELOADING" in message)
    daemon.until(lambda message: "READY" in message)


def localized(message: dict[str, str]) -> bool:
    return "last LOCALIZED" in message.get("STATUS", "")


def stop(daemon: Supervisor) -> str:
    """End it and return what it said."""
    daemon.process.send_signal(signal.SIGTERM)
    said = daemon.process.communicate(timeout=60)[1]
    assert daemon.process.returncode == 0, said
    return said


def statuses(log: Path) -> list[dict[str, Any]]:
    with log.open("rb") as stream:
        messages = make_reader(stream).iter_messages(topics=["trigpoint/device/status"])
        return [json.loads(message.data) for _, _, message in messages]


def test_new_settings_are_taken_up_between_two_frames(demo: Demo, tmp_path: Path) -> None:
    config = write_config(tmp_path, demo.map, demo.recording, rate=0.5, more=LOG)
    with supervised(config, 0.4) as daemon:
        daemon.until(localized)
        config.write_text(config.read_text() + "[localizer]\nmin_features = 5000\n")
        reload(daemon)
        daemon.until(lambda message: "last FEW_FEATURES" in message.get("STATUS", ""))
        said = stop(daemon)
    assert said.count("taken up anew") == 1
    results = [status.get("reason", "") for status in statuses(tmp_path / "log.mcap")]
    first = results.index("FEW_FEATURES")
    assert first > 0
    assert set(results[first:]) == {"FEW_FEATURES"}


def test_another_map_is_taken_up(demo: Demo, tmp_path: Path) -> None:
    config = write_config(tmp_path, demo.map, demo.recording, rate=0.5)
    with supervised(config, 0.4) as daemon:
        daemon.until(localized)
        shutil.copy(demo.map, tmp_path / "copy.tpmap")
        config.write_text(config.read_text().replace(str(demo.map), "copy.tpmap"))
        reload(daemon)
        (tmp_path / "copy.tpmap").unlink()  # what it reads now
        reload(daemon)
        said = stop(daemon)
    assert said.count("taken up anew") == 1
    assert f"no such map: {tmp_path}/copy.tpmap" in said


def test_a_typo_keeps_the_settings_and_is_said_once(demo: Demo, tmp_path: Path) -> None:
    config = write_config(tmp_path, demo.map, demo.recording, rate=0.5)
    with supervised(config, 0.4) as daemon:
        daemon.until(localized)
        config.write_text(config.read_text().replace("map =", "mpa ="))
        reload(daemon)
        daemon.until(lambda message: "frames arrive" in message.get("STATUS", ""))
        daemon.until(localized)
        said = stop(daemon)
    wrong = f"trigpointd: {config}: unknown key 'mpa'; did you mean 'map'?; going on with the "
    assert said.count(wrong) == 1
    assert "taken up anew" not in said


def test_what_takes_a_restart_is_named(demo: Demo, tmp_path: Path) -> None:
    config = write_config(tmp_path, demo.map, demo.recording, rate=0.5)
    with supervised(config, 0.4) as daemon:
        daemon.until(localized)
        text = config.read_text().replace("rate = 0.5", "rate = 0.25")
        config.write_text('base_key = "trigpoint/other"\n' + text)
        reload(daemon)
        said = stop(daemon)
    assert "changes of base_key, source need a restart" in said


def test_a_reload_needs_no_frame(demo: Demo, tmp_path: Path) -> None:
    config = write_config(tmp_path, demo.map, demo.recording, rate=1e-4)
    with supervised(config, 0.4) as daemon:
        daemon.until(localized)
        reload(daemon)
        assert "taken up anew" in stop(daemon)


def test_requests_are_answered_by_what_was_taken_up(demo: Demo) -> None:
    source = McapConfig(type="mcap", path=demo.recording)
    old = Config(map=demo.map, source=source)
    new = old.model_copy(update={"map_frame": "hall", "base_key": "trigpoint/other"})
    with contextlib.closing(Reloads(old, lambda: new)) as reloads:
        responder = Responder(old, RequestsConfig(), reloads.pipeline)
        reloads.followers.append(responder.use)
        reloads.request()
        assert reloads.reload() is reloads.pipeline
        settings = json.loads(responder.answer(Request("config", {})).payload)
        assert settings["map_frame"] == "hall"
        assert settings["base_key"] == old.base_key  # needs a restart
        info = responder.answer(Request("map", {}))
        assert not info.is_error, info.payload
