"""The installed service under a real systemd; `make test-systemd` boots one in qemu."""

import os
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader

pytestmark = pytest.mark.skipif(
    "TRIGPOINT_BOOT" not in os.environ, reason="needs a booted systemd; run `make test-systemd`"
)

WORLD = Path("build/systemd/world").resolve()
SETTINGS = Path("/etc/trigpoint")
STATE = Path("/var/lib/trigpoint")
TIMEOUT_S = 600
# A frame, then none for 17 minutes; or a frame, and a second later one that is never done.
IDLE, HANG = 1e-4, 0.1
ZENOH = 'zenoh = { listen = ["tcp/127.0.0.1:7447"], multicast_scouting = false }'


def run(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)


def show(unit: str, name: str) -> str:
    return run("systemctl", "show", "--value", f"--property={name}", unit).stdout.strip()


def journal(unit: str) -> str:
    return run("journalctl", "--output=cat", f"--unit={unit}").stdout


def wait_until(is_so: Callable[[], bool], unit: str) -> None:
    deadline_s = time.monotonic() + TIMEOUT_S
    while not is_so():
        assert time.monotonic() < deadline_s, (show(unit, "StatusText"), journal(unit))
        time.sleep(0.5)


def wait_until_said(unit: str, text: str) -> None:
    wait_until(lambda: text in journal(unit), unit)


def write_settings(instance: str, rate: float, more: str = "") -> None:
    """Settings of an instance, "" is the service without one."""
    (SETTINGS / instance).mkdir(exist_ok=True)
    (SETTINGS / instance / "trigpoint.toml").write_text(f"""
map = "{STATE}/hang.tpmap"
source = {{ type = "mcap", path = "{STATE}/hang.mcap", rate = {rate} }}
model = {{ network = "{STATE}/hangs.onnx" }}
log = {{ path = "/var/log/trigpoint/{instance}/%Y%m%d-%H%M%S.mcap" }}
{more}
""")


@pytest.fixture(autouse=True, scope="module")
def world() -> None:
    for name in ("hang.tpmap", "hang.mcap", "hangs.onnx"):
        shutil.copy(WORLD / name, STATE)  # which systemd has made, by tmpfiles.d
        shutil.chown(STATE / name, "trigpoint", "trigpoint")  # by sysusers.d


def test_it_starts_reloads_and_stops() -> None:
    write_settings("", IDLE, ZENOH)
    done = run("systemctl", "start", "trigpointd")
    assert done.returncode == 0, journal("trigpointd")
    wait_until(lambda: "last FEW_ANCHORS" in show("trigpointd", "StatusText"), "trigpointd")
    assert "1 FEW_ANCHORS, 0 dropped" in show("trigpointd", "StatusText")

    process = Path("/proc") / show("trigpointd", "MainPID") / "status"
    fields = dict(line.split(":\t", 1) for line in process.read_text().splitlines())
    assert fields["NoNewPrivs"] == "1"
    assert fields["Seccomp"] == "2"
    assert set(fields["Uid"].split()) == {run("id", "-u", "trigpoint").stdout.strip()}
    assert int(fields["CapBnd"], 16) == 0

    for more, said in (("mpa = 1", "going on with the settings"), (ZENOH, "taken up anew")):
        write_settings("", IDLE, more)
        assert run("systemctl", "reload", "trigpointd").returncode == 0
        wait_until_said("trigpointd", said)
    wait_until(lambda: "no frame for" in show("trigpointd", "StatusText"), "trigpointd")
    assert show("trigpointd", "NRestarts") == "0"

    assert run("systemctl", "stop", "trigpointd").returncode == 0
    assert show("trigpointd", "Result") == "success"
    assert show("trigpointd", "ExecMainStatus") == "0"
    (log,) = Path("/var/log/trigpoint").glob("*.mcap")
    with log.open("rb") as stream:
        assert make_reader(stream).get_summary() is not None  # it was closed properly


def test_a_hang_is_ended_by_the_watchdog_and_restarted() -> None:
    unit = "trigpointd@hang"
    write_settings("hang", HANG)
    assert run("systemctl", "start", unit).returncode == 0, journal(unit)
    wait_until(lambda: show(unit, "NRestarts") == "1", unit)
    assert f"{unit}.service: Watchdog timeout" in journal(unit)
    assert "Fatal Python error: Aborted" in journal(unit)
    wait_until(lambda: show(unit, "ActiveState") == "active", unit)
    run("systemctl", "stop", unit)


def test_a_crash_loop_ends() -> None:
    unit = "trigpointd@broken"
    write_settings("broken", IDLE, "mpa = 1")
    assert run("systemctl", "start", unit).returncode != 0
    wait_until(lambda: show(unit, "ActiveState") == "failed", unit)
    assert "Start request repeated too quickly" in journal(unit)
    assert journal(unit).count("unknown key 'mpa'") == 5


def test_cameras_are_in_reach_and_other_devices_are_not() -> None:
    shutil.chown("/dev/video0", group="video")  # as udev does
    Path("/dev/video0").chmod(0o660)
    Path("/dev/ttyS0").chmod(0o666)
    drop_in = Path("/run/systemd/system/trigpointd@camera.service.d/reach.conf")
    drop_in.parent.mkdir(parents=True)
    (SETTINGS / "camera").mkdir()
    program = "import sys; open(sys.argv[1], 'rb', buffering=0)"
    for device, reached in (("/dev/video0", True), ("/dev/ttyS0", False)):
        drop_in.write_text(f"""[Service]
Type=oneshot
Restart=no
WatchdogSec=0
ExecStart=
ExecStart=/usr/bin/python3 -c "{program}" {device}
""")
        run("systemctl", "daemon-reload")
        done = run("systemctl", "start", "trigpointd@camera")
        assert (done.returncode == 0) == reached, journal("trigpointd@camera")
    assert "PermissionError: [Errno 1] Operation not permitted: '/dev/ttyS0'" in journal(
        "trigpointd@camera"
    )


def test_a_map_of_the_fleet_is_kept_up_to_date() -> None:
    unit, fetched = "trigpoint-fetch@fleet", STATE / "fleet.tpmap"
    (SETTINGS / "fleet.json5").write_text("""{
        connect: { endpoints: ["tcp/127.0.0.1:7449"] },
        scouting: { multicast: { enabled: false } },
    }""")
    assert run("systemctl", "start", unit).returncode == 0, journal(unit)
    program = "/usr/local/lib/trigpoint/bin/trigpoint-db"
    publish = [program, "publish", str(STATE / "hang.tpmap"), "--key", "trigpoint/maps/fleet"]
    publisher = subprocess.Popen([*publish, "--listen", "tcp/127.0.0.1:7449"])
    try:
        wait_until(fetched.exists, unit)
        wait_until_said(unit, "fleet.tpmap: generation")
    finally:
        publisher.kill()
        publisher.wait()
    assert fetched.owner() == "trigpoint"
    assert run("systemctl", "stop", unit).returncode == 0
    assert show(unit, "Result") == "success"
