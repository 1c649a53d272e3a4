"""Run the commands of a page again, and put what they print in the place of what is there.

    python -m benchmarks.maps.walkthrough DATA [--page docs/maps.md] [--folder DIR]

In the blocks of the page that begin with ```console, lines that begin with `$ ` or follow a
backslash are commands for the shell; the others are what they printed. A command that ends with
`&` goes on to the end; it is waited for until it prints a line. They run in DIR, a temporary folder
by default, where DATA is called `data`; pictures of the page that they made are copied beside it.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from functools import partial
from pathlib import Path

_BLOCK = re.compile(r"^```console\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_COMMAND = re.compile(r"^\$ (?:.*\\\n)*.*$", re.MULTILINE)
_PICTURE = re.compile(r"!\[[^]]*\]\((images/[^)]+)\)")


def rerun(page: str, folder: Path) -> str:
    """Return the page with what its commands print now."""
    with ExitStack() as background:
        return _BLOCK.sub(partial(_rerun_block, folder, background), page)


def _rerun_block(folder: Path, background: ExitStack, block: re.Match[str]) -> str:
    lines = []
    for command in _COMMAND.findall(block[1]):
        print(command, file=sys.stderr)
        lines += [command, *_run(command.removeprefix("$ "), folder, background)]
    return "\n".join(["```console", *lines, "```"])


def _run(command: str, folder: Path, background: ExitStack) -> list[str]:
    process = subprocess.Popen(
        ["sh", "-c", f"exec {command[:-2]}" if command.endswith(" &") else command],
        cwd=folder, env=os.environ | {"COLUMNS": "100"},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    if command.endswith(" &"):
        background.callback(process.wait)
        background.callback(process.terminate)
        first = process.stdout.readline().rstrip()
        return [first] if first else []
    printed, said = process.communicate()
    if process.returncode:
        sys.exit(f"exit code {process.returncode}: {said}")
    return [line.rstrip() for line in printed.rstrip().splitlines()]


def main() -> None:
    """Rewrite the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--page", type=Path, default=Path("docs/maps.md"))
    parser.add_argument("--folder", type=Path, help="made, and kept")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        folder.mkdir(exist_ok=True)
        (folder / "data").symlink_to(arguments.data.resolve())
        page = rerun(arguments.page.read_text(), folder)
        for picture in _PICTURE.findall(page):
            if (made := folder / Path(picture).name).is_file():
                (arguments.page.parent / picture).write_bytes(made.read_bytes())
    arguments.page.write_text(page)


if __name__ == "__main__":
    main()
