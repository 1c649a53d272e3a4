"""What the paper's tables say, digit by digit, with where it stands there."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import combinations
from typing import Any


@dataclass(frozen=True)
class PublishedRow:
    """A row of a table.

    Parameters
    ----------
    group : str or None
        IR (image retrieval), 3D or DNN (deep networks), as the paper sorts pipelines.
    pipeline : str
    cite : tuple of str
        The paper's citation keys.
    cells : tuple of (str or None)
        For each column the text as printed; None where the paper has a dash.
    """

    group: str | None
    pipeline: str
    cite: tuple[str, ...]
    cells: tuple[str | None, ...]

    @property
    def title(self) -> str:
        """What to call it where the row "Ours" is the paper's."""
        return "the paper" if self.pipeline == "Ours" else self.pipeline

    def numbers(self, column: int) -> tuple[float, ...] | None:
        """Return the numbers of a cell."""
        cell = self.cells[column]
        return None if cell is None else tuple(map(float, cell.split("/")))


@dataclass(frozen=True)
class PublishedTable:
    """One data set's part of a table: `label` is the table's, in the paper's source."""

    label: str
    cells: str  # what the cells hold, with units
    num_references: str | None  # images to map that the paper counts in the data set
    columns: tuple[str, ...]
    rows: tuple[PublishedRow, ...]

    def row(self, pipeline: str) -> PublishedRow:
        """Return the row of a pipeline, `Ours` being the paper's."""
        return next(row for row in self.rows if row.pipeline == pipeline)

    def repeated_cells(self) -> list[tuple[str, str, tuple[str, ...]]]:
        """Return pairs of rows with the same numbers in three columns or more, and these columns.

        Medians of two methods, to three digits, are hardly equal so often: one may be a copy.
        """
        found = []
        for a, b in combinations(self.rows, 2):
            pairs = zip(self.columns, a.cells, b.cells, strict=True)
            same = tuple(column for column, x, y in pairs if x is not None and x == y)
            if len(same) > 2:
                found.append((a.pipeline, b.pipeline, same))
        return found


@cache
def load_published() -> dict[str, PublishedTable]:
    """Return the tables: 7scenes, cambridge, aachen, robotcar, averaging and timing."""
    text = (resources.files("trigpoint_db.experiments") / "published.json").read_text("utf-8")
    content: dict[str, Any] = json.loads(text)
    return {
        name: PublishedTable(
            table["label"],
            table["cells"],
            table["num_references"],
            tuple(table["columns"]),
            tuple(_make_row(**row) for row in table["rows"]),
        )
        for name, table in content["tables"].items()
    }


def _make_row(
    group: str | None, pipeline: str, cite: Sequence[str], cells: Sequence[str | None]
) -> PublishedRow:
    return PublishedRow(group, pipeline, tuple(cite), tuple(cells))
