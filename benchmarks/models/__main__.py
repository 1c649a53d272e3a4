"""Our feature networks beside RootSIFT and EdgePoint2, in one run.

    python -m benchmarks.models ../shared/data [--photographs DIR] [--edgepoint2 CHECKOUT]
        [--fp32 DIR] [--model FILE] [--only pairs,speed] [--pairs N] [--jobs N] [--output FILE]

DATA holds a folder for each set, as for `benchmarks.localizer`; --photographs is the folder that
the networks were trained on, of which every tenth picture is held out. EdgePoint2 is run from its
authors' checkout (https://github.com/HITCSC/EdgePoint2) and needs torch. The packaged networks
always take part; --fp32 adds those named *.fp32.onnx, --model any other that `FeatureModel` loads.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import textwrap
from pathlib import Path
from typing import Any

from benchmarks.models import homographies, localization, poses, retrieval, rotation, speed
from benchmarks.models.methods import find_methods
from benchmarks.models.run import make_plan, measure_all, measure_speed, open_pool
from benchmarks.stage_times import describe_machine
from trigpoint.errors import TrigpointError
from trigpoint.output import check_output, open_text

TABLES = {
    "pairs": ("Relative pose", poses),
    "homographies": ("Homographies", homographies),
    "retrieval": ("Retrieval", retrieval),
    "rotation": ("Rotation in the image plane", rotation),
    "localization": ("Localization", localization),
    "speed": ("Speed", speed),
}
NUM_PAIRS = 150


def write_report(results: dict[str, dict[str, Any]]) -> str:
    """Lay out all tables in Markdown."""
    machine = describe_machine().rpartition(";")[0]  # its last words are of stage_times
    parts = [f"# Feature networks side by side\n\n{machine}; one thread"]
    for table, (title, module) in TABLES.items():
        if results.get(table):
            caption = textwrap.fill(" ".join(module.CAPTION.split()), 100)
            parts.append(f"## {title}\n\n{caption}\n\n{module.tabulate(results[table])}")
    return "\n\n".join(parts) + "\n"


def compare(arguments: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Measure all there is: results by table and method."""
    with tempfile.TemporaryDirectory() as scratch:
        methods = find_methods(
            arguments.fp32,
            arguments.edgepoint2,
            arguments.model,
            arguments.retrieval,
            Path(scratch),
        )
        with open_pool(arguments.jobs) as pool:
            plan = make_plan(
                arguments.data, arguments.photographs, arguments.only, arguments.pairs, pool
            )
            results = measure_all(methods, plan, pool)
        if "speed" in arguments.only:
            results["speed"] = measure_speed(methods, plan)
    return results


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.models", description=__doc__.splitlines()[0]
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--photographs", type=_folder)
    parser.add_argument("--edgepoint2", type=_folder)
    parser.add_argument("--fp32", type=_folder)
    parser.add_argument("--model", type=Path, action="append", default=[])
    parser.add_argument("--retrieval", type=Path, help="for those of --model without their own")
    parser.add_argument("--only", type=_tables, default=list(TABLES))
    parser.add_argument("--pairs", type=_count, default=NUM_PAIRS, help="of each set")
    parser.add_argument("--jobs", type=_count, default=2, help="processes")
    parser.add_argument("--output", type=Path, help="Markdown")
    parser.add_argument("--json", type=Path, help="every error of every case")
    return parser.parse_args()


def _count(text: str) -> int:
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return int(text)


def _folder(text: str) -> Path:
    if not Path(text).is_dir():
        raise argparse.ArgumentTypeError(f"there is no folder {text}")
    return Path(text)


def _tables(text: str) -> list[str]:
    wanted = text.split(",")
    if unknown := sorted(set(wanted) - set(TABLES)):
        raise argparse.ArgumentTypeError(f"{unknown[0]!r} is not one of {', '.join(TABLES)}")
    return [table for table in TABLES if table in wanted]


def main() -> None:
    """Measure, print, write."""
    arguments = parse_arguments()
    try:
        check_output(arguments.output)
        check_output(arguments.json)
        results = compare(arguments)
        report = write_report(results)
        print(report)
        for path, text in ((arguments.output, report), (arguments.json, json.dumps(results))):
            if path is not None:
                with open_text(path) as file:
                    file.write(text)
    except TrigpointError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
