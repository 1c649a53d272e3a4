"""`python -m tests.unit.run_kills 200`: kill so many processes, and say at what."""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.unit.kills import kill_often


def main() -> None:
    times = int(sys.argv[1])
    with TemporaryDirectory() as folder:
        killed_at = kill_often(Path(folder), times, seed=times)
    counts = ", ".join(f"{count} at {what}" for what, count in killed_at.most_common())
    sys.stdout.write(f"{times} processes killed: {counts}; no image was lost\n")


if __name__ == "__main__":
    main()
