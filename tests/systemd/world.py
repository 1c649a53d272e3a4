"""What the guest's daemons localize by: `python -m tests.systemd.world FOLDER`."""

import shutil
import sys
from pathlib import Path

from tests.conftest import Demo, without_progress
from tests.systemd.supervisor import write_hang
from trigpoint_db.demo import make_demo


def make_world(folder: Path) -> None:
    """A map, a recording, and a network that hangs on it and is quick enough for emulation."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "demo").mkdir(parents=True)
    make_demo(folder / "demo", num_survey=4, num_flight=4, progress=without_progress)
    write_hang(folder, Demo(folder / "demo"))


if __name__ == "__main__":
    make_world(Path(sys.argv[1]).resolve())
