"""The page of all results."""

import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.unit.conftest import Run
from trigpoint.errors import ConfigError
from trigpoint_db.experiments import averaging, noise
from trigpoint_db.experiments.page import write_page
from trigpoint_db.experiments.store import Store

DOCS = Path(__file__).parents[2] / "docs"


def averaging_result(error: float) -> dict[str, Any]:
    row = {"set": "chess", "num_mapped": 3, "num_queries": 5, "num_chosen": 2, "num_averaged": 2}
    medians = {method: error * (1 + place) for place, method in enumerate(noise.METHODS)}
    settings = {"network": "base", "num_anchors": 20, "max_queries": 2}
    return {**settings, "rows": [{**row, "medians": medians}]}


def test_new_results_take_the_place_of_old_ones_and_the_others_stay(tmp_path: Path) -> None:
    docs, first, second = tmp_path / "docs", tmp_path / "first", tmp_path / "second"
    Store(first).write("averaging", averaging_result(0.0303))
    Store(first).write("noise", noise.measure(20, Store(first)))
    page = write_page(first, docs).read_text()
    assert page.index("## Noise") < page.index("## Center against")
    assert "0.0303" in page
    Store(second).write("averaging", averaging_result(0.0404))
    page = write_page(second, docs).read_text()
    assert "## Noise" in page
    assert "0.0404" in page
    assert "0.0303" not in page
    for name in ("noise", "averaging"):
        assert (docs / "images" / "experiments" / f"{name}.png").stat().st_size < 150_000
        assert f"(images/experiments/{name}.png)" in page


def test_the_paper_s_scenes_stand_beside_its_numbers_in_centimetres() -> None:
    table = averaging.write_table(averaging_result(0.0303))
    assert "| Chess | 4 cm | 3 cm | 3.03 cm | 6.06 cm | 9.09 cm | 12.1 cm |" in table
    assert "| Stairs | 11 cm | 10 cm | - | - | - | - |" in table
    assert "smaller median than translation, Govindu in 1 of 1 rows" in table
    assert "At most 2 queries of each set" in table


def test_without_results_it_says_how_to_get_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="experiment noise --output"):
        write_page(tmp_path, tmp_path / "docs")


def snapshot(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("text", ["{", '{"machine": {}}', '{"machine": 1, "rows": 2}'])
def test_a_damaged_result_is_named_and_leaves_the_docs_as_they_are(
    tmp_path: Path, text: str
) -> None:
    docs, first, second = tmp_path / "docs", tmp_path / "first", tmp_path / "second"
    Store(first).write("averaging", averaging_result(0.0303))
    Store(first).write("noise", noise.measure(20, Store(first)))
    write_page(first, docs)
    before = snapshot(docs)
    Store(second).write("noise", noise.measure(21, Store(second)))
    (second / "averaging.json").write_text(text)
    with pytest.raises(ConfigError, match=r"second/averaging\.json is not .* measure it anew"):
        write_page(second, docs)
    assert snapshot(docs) == before


def test_results_that_the_docs_have_already_can_be_named(tmp_path: Path) -> None:
    Store(tmp_path / "experiments").write("averaging", averaging_result(0.0303))
    assert "0.0303" in write_page(tmp_path / "experiments", tmp_path).read_text()


def test_a_folder_of_results_that_is_missing_is_named(tmp_path: Path, run: Run) -> None:
    Store(tmp_path / "experiments").write("averaging", averaging_result(0.03))
    code, _, error = run("experiment", "page", tmp_path / "typo", tmp_path)
    assert code == 1
    assert f"there is no folder {tmp_path / 'typo'}" in " ".join(error.split())


def test_the_command_names_the_page(tmp_path: Path, run: Run) -> None:
    Store(tmp_path).write("averaging", averaging_result(0.03))
    code, out, _ = run("experiment", "page", tmp_path, tmp_path / "docs")
    assert (code, out.strip()) == (0, str(tmp_path / "docs" / "experiments.md"))


@pytest.mark.skipif(not DOCS.is_dir(), reason="needs the checkout's docs/")
def test_no_number_on_the_page_was_typed(tmp_path: Path) -> None:
    """It is what its results make of it."""
    shutil.copytree(DOCS / "experiments", tmp_path / "experiments")
    (tmp_path / "nothing new").mkdir()
    page = write_page(tmp_path / "nothing new", tmp_path)
    assert page.read_text() == (DOCS / "experiments.md").read_text()
