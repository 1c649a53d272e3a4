"""Markdown tables, and the numbers in them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from trigpoint_db.evaluate import percentile


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]], num_words: int = 1) -> str:
    """Lay out a table; all but the first `num_words` columns are numbers."""
    rule = ["---"] * num_words + ["---:"] * (len(header) - num_words)
    return "\n".join("| " + " | ".join(row) + " |" for row in (header, rule, *rows))


def number(value: float | None, num_digits: int = 3) -> str:
    """Write a number with so many significant digits; None, where there is none, as a dash."""
    if value is None:
        return "-"
    return "inf" if math.isinf(value) else f"{_round(value, num_digits):,g}"


def finite(value: float) -> float | None:
    """Return a number as JSON has it: None where it is infinite or not known."""
    return float(value) if math.isfinite(value) else None


def median(errors: Sequence[float | None], percent: float = 50) -> float | None:
    """Return a percentile of errors, the median by default; None is a failure, and infinite."""
    known = [math.inf if error is None else error for error in errors]
    return finite(percentile(np.array(known), percent))


def geometric_mean(values: Iterable[float | None]) -> float | None:
    """Return the geometric mean of those that are known and not zero; None where none is."""
    logs = [math.log(value) for value in values if value]
    return math.exp(sum(logs) / len(logs)) if logs else None


def _round(value: float, num_digits: int) -> float:
    return float(f"{value:.{num_digits}g}")
