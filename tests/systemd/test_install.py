"""`make install` puts units where systemd looks for them, `make uninstall` removes no more."""

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
pytestmark = [
    pytest.mark.skipif(not (ROOT / "Makefile").is_file(), reason="needs the checkout's Makefile"),
    pytest.mark.skipif(shutil.which("make") is None, reason="needs make"),
]
INSTALLED = {
    "lib/systemd/system/trigpoint-fetch@.service",
    "lib/systemd/system/trigpointd.service",
    "lib/systemd/system/trigpointd@.service",
    "lib/sysusers.d/trigpoint.conf",
    "lib/tmpfiles.d/trigpoint.conf",
    "lib/udev/rules.d/70-trigpoint.rules",
}


def make(target: str, root: Path, **variables: str) -> None:
    settings = [f"{name}={value}" for name, value in variables.items()]
    done = subprocess.run(
        ["make", "--silent", target, f"DESTDIR={root}", *settings],
        cwd=ROOT, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def files(root: Path) -> set[str]:
    return {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()}


@pytest.mark.parametrize("prefix", ["usr", "usr/local"])
def test_everything_is_where_systemd_looks(tmp_path: Path, prefix: str) -> None:
    make("install-units", tmp_path, PREFIX=f"/{prefix}")
    installed = {f"{prefix}/{name}" for name in INSTALLED}
    assert files(tmp_path) == installed | {"etc/trigpoint/trigpoint.toml"}
    for name in ("trigpointd", "trigpointd@"):
        unit = tmp_path / prefix / f"lib/systemd/system/{name}.service"
        assert f"\nExecStart=/{prefix}/lib/trigpoint/bin/trigpointd run " in unit.read_text()
    unit = tmp_path / prefix / "lib/systemd/system/trigpoint-fetch@.service"
    assert f"\nExecStart=/{prefix}/lib/trigpoint/bin/trigpoint-db fetch " in unit.read_text()


def test_settings_survive_another_install_and_the_uninstall(tmp_path: Path) -> None:
    make("install-units", tmp_path)
    settings = tmp_path / "etc/trigpoint/trigpoint.toml"
    settings.write_text("mine")
    make("install-units", tmp_path)
    assert settings.read_text() == "mine"
    foreign = tmp_path / "usr/local/lib/systemd/system/other.service"
    foreign.touch()
    make("uninstall", tmp_path)
    assert files(tmp_path) == {
        str(settings.relative_to(tmp_path)),
        str(foreign.relative_to(tmp_path)),
    }
