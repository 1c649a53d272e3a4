"""The numbers quoted from the paper are those of its LaTeX source, digit by digit."""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from trigpoint_db.experiments import averaging, timing
from trigpoint_db.experiments.published import PublishedTable, load_published

SEED = Path(__file__).parents[2].parent / "shared" / "seed"
PARTS = {
    "tab:results_7": ("7scenes", "cambridge"),
    "tab:results_aachen_robot": ("aachen", "robotcar"),
    "tab:transl-camera-averaging": ("averaging",),
    "tab:timing": ("timing",),
}


def read_source() -> str:
    sources = sorted(SEED.glob("*.txt")) if SEED.is_dir() else []
    if not sources:
        pytest.skip(f"needs the paper's source in {SEED}")
    return sources[0].read_text()


def read_cells(source: str, label: str) -> list[list[str]]:
    """Read the body of a table: rows of cells, in which only the text is left."""
    tabular = source[: source.index(rf"\label{{{label}}}")].rsplit(r"\begin{tabular", 1)[1]
    tabular = tabular.split(r"\end{tabular")[0]
    for command in (r"\\cline\{[^}]*\}", r"\\hline", r"\\multirow\{[^}]*\}\s*\{[^}]*\}\s*"):
        tabular = re.sub(command, "", tabular)
    for _ in range(3):  # commands in commands
        tabular = re.sub(
            r"\\(?:textbf|textcolor\{red\}|rotatebox\{90\}|multicolumn\{\d+\}\{[^}]*\})\{([^{}]*)\}",
            r"\1",
            tabular,
        )
    rows = [[cell.strip() for cell in row.split("&")] for row in tabular.split(r"\\")]
    return [row for row in rows if len(row) > 2]


@pytest.mark.parametrize(("label", "names"), PARTS.items())
def test_every_number_is_that_of_the_source(label: str, names: tuple[str, ...]) -> None:
    tables = [load_published()[name] for name in names]
    assert {table.label for table in tables} == {label}
    columns = [column for table in tables for column in table.columns]
    heading, *rows = [row for row in read_cells(read_source(), label) if len(row) >= len(columns)]
    assert heading[-len(columns) :] == columns
    assert len(rows) == len(tables[0].rows)
    group: str | None = None
    for i, row in enumerate(rows):
        title, cells = row[-len(columns) - 1], row[-len(columns) :]
        quoted = [table.rows[i] for table in tables]
        assert [cell or "-" for part in quoted for cell in part.cells] == cells
        pipeline = re.sub(r"\s*~?\s*\\cite\{\w+\}", "", title)
        group = row[0].strip("{} ") or group
        for part in quoted:
            assert part.pipeline == pipeline
            assert list(part.cite) == re.findall(r"\\cite\{(\w+)\}", title)
            has_groups = len(row) > len(columns) + 1 and pipeline != "Ours"
            assert part.group == (group if has_groups else None)


def test_the_sizes_of_the_data_sets_are_those_of_the_source() -> None:
    counted = re.findall(r"contains ([\d,]+) reference images", read_source())
    tables = load_published()
    names = ("7scenes", "cambridge", "aachen", "robotcar")  # in the order of the text
    assert [tables[name].num_references for name in names] == counted


def test_tables_are_whole_without_the_source() -> None:
    tables = load_published()
    assert set(tables) == {name for names in PARTS.values() for name in names}
    for table in tables.values():
        assert all(len(row.cells) == len(table.columns) for row in table.rows)
        lengths = {len(n) for row in table.rows for n in numbers_of(table, row.pipeline)}
        assert len(lengths) == 1


def numbers_of(table: PublishedTable, pipeline: str) -> list[tuple[float, ...]]:
    row = table.row(pipeline)
    every = (row.numbers(column) for column in range(len(table.columns)))
    return [numbers for numbers in every if numbers is not None]


def test_numbers_are_degrees_before_metres() -> None:
    table = load_published()["7scenes"]
    assert table.row("Ours").numbers(table.columns.index("Kitchen")) == (1.18, 0.04)
    assert table.row("GAM").numbers(0) is None


def test_the_average_printed_is_that_of_the_scenes() -> None:
    """A transcription error would stand out; two roundings are allowed for."""
    for name in ("7scenes", "cambridge"):
        table = load_published()[name]
        for row in table.rows:
            *scenes, average = [row.numbers(i) for i in range(len(table.columns))]
            if average is None:
                continue
            known = [numbers for numbers in scenes if numbers is not None]
            for i, printed in enumerate(average):
                mean = sum(numbers[i] for numbers in known) / len(known)
                assert mean == pytest.approx(printed, rel=0.02, abs=0.011), (name, row.pipeline)


def replace_number(
    monkeypatch: pytest.MonkeyPatch, module: ModuleType, name: str, old: str, new: str
) -> None:
    """Let a module find another number in a table."""
    table = load_published()[name]
    rows = [
        replace(row, cells=tuple(new if cell == old else cell for cell in row.cells))
        for row in table.rows
    ]
    changed = {name: replace(table, rows=tuple(rows))}
    monkeypatch.setattr(module, "load_published", lambda: changed)


def test_the_page_quotes_the_scenes_from_these_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    result = {"num_anchors": 20, "max_queries": 2, "rows": []}
    assert "| St.Mary's | 17 cm | 13 cm |" in averaging.write_table(result)
    replace_number(monkeypatch, averaging, "averaging", "13", "12")
    assert "| St.Mary's | 17 cm | 12 cm |" in averaging.write_table(result)


def test_the_page_quotes_the_times_from_these_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    rows: list[Mapping[str, Any]] = [{"anchors": "50", "ms": {timing.TOTAL: 190.3}}]
    text = timing.write_paper(rows)
    assert "| the paper's method | 3 | 14 | 7 | 1538 | 361 | 1903 | 7.431 | 1,717 |" in text
    assert "The stages of HLOC + SG add up to 1998 ms; its total says 1998." in text
    assert "total is 10 times ours" in text
    replace_number(monkeypatch, timing, "timing", "361", "341")
    text = timing.write_paper(rows)
    assert "| 1538 | 341 | 1903 |" in text
    assert "The stages of the paper's method add up to 1903 ms; its total says 1903." in text


def test_rows_that_repeat_another_are_found() -> None:
    assert load_published()["7scenes"].repeated_cells() == [
        ("DenseVLAD+Inter.", "GeM", ("Pumpkin", "Kitchen", "Stairs"))
    ]
    assert load_published()["cambridge"].repeated_cells() == []
