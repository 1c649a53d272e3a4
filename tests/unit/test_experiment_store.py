"""What an experiment has done so far survives an interruption; its result says where it is from."""

import json
from pathlib import Path

import pytest

from trigpoint.errors import ConfigError
from trigpoint_db.experiments.store import Store, read_result

KEYS = ["a", "b", "c"]


def run_until(folder: Path, settings: dict[str, int], last: str) -> list[str]:
    """Do the units that are left, up to one of them; return which were done."""
    store = Store(folder)
    store.begin("squares", settings)
    done = []
    for key in store.each(KEYS, "squares"):
        store[key] = {"value": KEYS.index(key) ** 2}
        done.append(key)
        if key == last:
            break
    return done


def test_an_interrupted_run_goes_on(tmp_path: Path) -> None:
    assert run_until(tmp_path, {"seed": 0}, "b") == ["a", "b"]
    assert run_until(tmp_path, {"seed": 0}, "c") == ["c"]
    store = Store(tmp_path)
    store.begin("squares", {"seed": 0})
    assert [store[key]["value"] for key in KEYS] == [0, 1, 4]


def test_other_settings_begin_anew(tmp_path: Path) -> None:
    run_until(tmp_path, {"seed": 0}, "b")
    assert run_until(tmp_path, {"seed": 1}, "c") == KEYS


def test_a_line_cut_off_counts_as_not_done(tmp_path: Path) -> None:
    run_until(tmp_path, {"seed": 0}, "b")
    path = tmp_path / "squares.jsonl"
    path.write_text(path.read_text()[:-8])
    assert run_until(tmp_path, {"seed": 0}, "c") == ["b", "c"]


@pytest.mark.parametrize(
    "damage",
    [b"[]", b"12", b'"text"', b'{"key": "c"}', b'{"key": [], "value": 1}',
     b'{"key": "c", "value": "\xff"}', b"\xff\xfe"],
)  # fmt: skip
def test_from_a_damaged_line_on_nothing_counts_as_done(tmp_path: Path, damage: bytes) -> None:
    run_until(tmp_path, {"seed": 0}, "b")
    path = tmp_path / "squares.jsonl"
    settings, first, second = path.read_bytes().splitlines()
    path.write_bytes(b"\n".join([settings, first, damage, second, b""]))
    assert run_until(tmp_path, {"seed": 0}, "c") == ["b", "c"]


@pytest.mark.parametrize("settings", [b"\xff", b"[]", b"12", b""])
def test_with_damaged_settings_it_begins_anew(tmp_path: Path, settings: bytes) -> None:
    run_until(tmp_path, {"seed": 0}, "b")
    path = tmp_path / "squares.jsonl"
    path.write_bytes(settings + path.read_bytes()[len(b'{"seed": 0}') :])
    assert run_until(tmp_path, {"seed": 0}, "c") == KEYS


def test_a_result_is_read_as_it_was_written_and_a_new_run_begins_after_it(tmp_path: Path) -> None:
    run_until(tmp_path, {"seed": 0}, "c")
    path = Store(tmp_path).write("squares", {"rows": [1 / 3, 2, None], "name": "x"})
    result = read_result(path)
    assert result["rows"] == [0.333333, 2, None]
    assert result["machine"]["num_cores"] >= 1
    assert run_until(tmp_path, {"seed": 0}, "c") == KEYS


def test_what_is_no_number_in_json_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="Out of range"):
        Store(tmp_path).write("squares", {"error": float("inf")})


@pytest.mark.parametrize("text", ["{", "[]", json.dumps({"rows": []})])
def test_other_files_are_no_results(tmp_path: Path, text: str) -> None:
    path = tmp_path / "noise.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match="measure it anew"):
        read_result(path)


def test_a_file_in_the_folder_s_place_is_named(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    with pytest.raises(ConfigError, match="cannot write to"):
        Store(tmp_path / "out")
