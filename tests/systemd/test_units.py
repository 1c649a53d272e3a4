"""systemd takes the units, and finds them well shut in."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SYSTEMD = Path(__file__).parents[2] / "systemd"
pytestmark = [
    pytest.mark.skipif(not SYSTEMD.is_dir(), reason="needs the checkout's systemd/"),
    pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze"),
]


DAEMON = ["trigpointd.service", "trigpointd@.service"]
FETCH = "trigpoint-fetch@.service"


@pytest.fixture(params=[*DAEMON, FETCH])
def unit(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A unit as it is installed, but with a program that is there."""
    name: str = request.param
    text = (SYSTEMD / name).read_text()
    installed = tmp_path / name
    program = "trigpoint-db" if name == FETCH else "trigpointd"
    installed.write_text(text.replace(f"/usr/local/lib/trigpoint/bin/{program}", sys.executable))
    return installed


def run(*command: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*map(str, command)], capture_output=True, text=True, timeout=60, check=False
    )


def test_systemd_takes_the_unit_as_it_is(unit: Path) -> None:
    done = run("systemd-analyze", "verify", "--man=no", unit)
    assert done.returncode == 0, done.stderr
    assert "trigpoint" not in done.stderr


def test_a_mistake_in_the_unit_would_be_found(unit: Path) -> None:
    unit.write_text(unit.read_text().replace("TimeoutStopSec", "TimeoutStopSeconds"))
    done = run("systemd-analyze", "verify", "--man=no", unit)
    assert "TimeoutStopSeconds" in done.stderr


def test_its_exposure_is_at_most_2(unit: Path) -> None:
    done = run("systemd-analyze", "security", "--offline=true", "--threshold=20", unit)
    assert done.returncode == 0, done.stdout
    assert "Overall exposure level" in done.stdout


@pytest.mark.parametrize("unit", DAEMON, indirect=True)
def test_cameras_stay_in_reach(unit: Path) -> None:
    lines = unit.read_text().splitlines()
    assert not [line for line in lines if line.startswith("PrivateDevices")]  # it hides /dev/video0
    assert {"DeviceAllow=char-video4linux rw", "DeviceAllow=char-usb_device rw"} <= set(lines)


def test_systemd_makes_the_user_of_the_unit(unit: Path, tmp_path: Path) -> None:
    if shutil.which("systemd-sysusers") is None:
        pytest.skip("needs systemd-sysusers")
    done = run(
        "systemd-sysusers", "--dry-run", f"--root={tmp_path}", SYSTEMD / "trigpoint.sysusers"
    )
    assert done.returncode == 0, done.stderr
    assert "Creating user 'trigpoint'" in done.stdout + done.stderr
    assert "User=trigpoint" in unit.read_text().splitlines()
