"""Results of experiments, and the units of work of one that is not done yet.

store = Store(folder)
store.begin("noise", {"seed": 0})
for key in store.each(keys, "noise"):  # those that an interrupted run has not done
    store[key] = measure_one(key)
store.write("noise", {"rows": [store[key] for key in keys]})
"""

from __future__ import annotations

import json
import os
import platform
import re
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from trigpoint.errors import ConfigError
from trigpoint.output import open_text
from trigpoint_db.terminal import track

NUM_DIGITS = 6  # significant ones of the numbers in results
LIBRARIES = ("trigpoint", "numpy", "onnxruntime", "opencv-python-headless")


class Store:
    """A folder with `NAME.json` of what is done and `NAME.jsonl` of what is under way.

    Parameters
    ----------
    folder : Path
        Made where it is missing.
    """

    def __init__(self, folder: Path) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"cannot write to {folder}: {error.strerror}") from error
        self.folder = folder
        self._units: dict[str, Any] = {}

    def begin(self, name: str, settings: Mapping[str, Any]) -> None:
        """Go on with an interrupted run of the same settings, or begin anew."""
        self._path = self.folder / f"{name}.jsonl"
        begun, *done = _read_lines(self._path) or [None]
        if begun != json.loads(json.dumps(settings)):
            done = []
        self._units = {line["key"]: line["value"] for line in done}
        with open_text(self._path) as file:
            file.writelines(_line(value) for value in (settings, *done))

    def each(self, keys: Sequence[str], label: str) -> Iterator[str]:
        """Give the keys whose units are not done, with a progress bar over all of them."""
        for key in track(keys, label, len(keys)):
            if key not in self._units:
                yield key

    def __contains__(self, key: str) -> bool:
        return key in self._units

    def __getitem__(self, key: str) -> Any:
        return self._units[key]

    def __setitem__(self, key: str, value: Any) -> None:
        with self._path.open("a") as file:
            file.write(_line({"key": key, "value": value}))
        self._units[key] = value

    def write(self, name: str, result: Mapping[str, Any]) -> Path:
        """Write the result of an experiment, and where it was measured; its units go."""
        path = self.folder / f"{name}.json"
        with open_text(path) as file:
            file.write(dump({"machine": machine(), **result}))
        (self.folder / f"{name}.jsonl").unlink(missing_ok=True)
        return path


def read_result(path: Path) -> dict[str, Any]:
    """Read what `Store.write` has written."""
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from error
    except ValueError as error:
        raise ConfigError(f"{path} is not the result of an experiment; measure it anew") from error
    if not isinstance(result, dict) or "machine" not in result:
        raise ConfigError(f"{path} is not the result of an experiment; measure it anew")
    return result


def dump(result: Mapping[str, Any]) -> str:
    """Write JSON with short numbers and short lists on one line; inf and nan are errors."""
    text = json.dumps(_rounded(result), indent=1, allow_nan=False)
    return re.sub(r"\[[^\[\]{}]*\]", lambda flat: " ".join(flat[0].split()), text) + "\n"


def machine() -> dict[str, Any]:
    """Name the processor and the versions that count."""
    cpuinfo = Path("/proc/cpuinfo")
    info = cpuinfo.read_text() if cpuinfo.is_file() else ""
    model = re.search(r"^model name\s*: (.*)$", info, re.MULTILINE)
    return {
        "processor": model[1] if model else platform.processor() or platform.machine(),
        "num_cores": os.cpu_count(),
        # Instructions that add four 8-bit products at once, which INT8 networks live on.
        "has_8bit_dot_products": re.search(r"vnni|asimddp", info) is not None,
        "python": platform.python_version(),
        **{name: version(name) for name in LIBRARIES},
    }


def _line(value: Any) -> str:
    return json.dumps(value, allow_nan=False) + "\n"


def _read_lines(path: Path) -> list[Any]:
    """Read the settings and the units after them, up to the first line that is damaged."""
    lines: list[Any] = []
    if path.is_file():
        for text in path.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                line = json.loads(text)
            except ValueError:
                break
            is_unit = isinstance(line, dict) and isinstance(line.get("key"), str)
            # All that is written is ASCII: the rest stands for bytes that are not.
            if not text.isascii() or (lines and not (is_unit and "value" in line)):
                break
            lines.append(line)
    return lines


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.{NUM_DIGITS}g}")
    if isinstance(value, Mapping):
        return {key: _rounded(item) for key, item in value.items()}
    return [_rounded(item) for item in value] if isinstance(value, list | tuple) else value
