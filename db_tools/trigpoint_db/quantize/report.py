"""What quantisation gained and lost, and whether that is good enough."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from rich.console import Console
from rich.table import Table

from trigpoint_db.quantize.comparison import Comparison


@dataclass(frozen=True)
class QuantizationReport:
    """The outcome; `refusal` says in one line why the file was not written, if it was not."""

    out: str
    max_loss: float
    comparison: Comparison
    num_bytes: tuple[int, int]  # fp32 and INT8
    percentile: float
    num_layers: int
    float_layers: tuple[str, ...]

    @property
    def refusal(self) -> str | None:
        """Why the INT8 network may not be used, or None."""
        limit = f"{self.max_loss:.1%}"
        for score in self.comparison.scores:
            if not score.is_gate:
                continue
            if score.loss > self.max_loss:
                return (
                    f"INT8 loses {score.loss:.1%} of fp32's {score.name}, and --max-loss is "
                    f"{limit}; calibrate with images like those it will see"
                )
            if score.noise > self.max_loss:
                return (
                    f"{score.num_pairs} pairs tell the {score.name} to {score.noise:.1%} only, "
                    f"and --max-loss is {limit}; give more images"
                )
        if self.num_bytes[1] >= self.num_bytes[0]:
            return f"INT8 has {self.num_bytes[1]} bytes, not fewer than fp32's {self.num_bytes[0]}"
        return None

    def to_json(self) -> dict[str, Any]:
        """Return everything in JSON's types."""
        return {**asdict(self), "refusal": self.refusal}

    def print_table(self, console: Console) -> None:
        """Print fp32 against INT8."""
        table = Table(title=f"fp32 and INT8; at most {self.max_loss:.1%} may be lost")
        table.add_column("")
        for heading in ("pairs", "fp32", "INT8", "loss", "+-"):
            table.add_column(heading, justify="right")
        for s in self.comparison.scores:
            numbers = (f"{s.fp32:.4f}", f"{s.int8:.4f}", f"{s.loss:.2%}", f"{s.noise:.2%}")
            table.add_row(
                s.name + ("" if s.is_gate else " (told only)"), str(s.num_pairs), *numbers
            )
        table.add_section()
        (ms, ms8), (size, size8) = self.comparison.latency_ms, self.num_bytes
        table.add_row("latency, 1 thread (ms)", "", f"{ms:.1f}", f"{ms8:.1f}", f"x {ms / ms8:.2f}")
        table.add_row(
            "size (bytes)", "", f"{size:,}", f"{size8:,}", f"x {size / size8:.2f}", end_section=True
        )
        agreement = self.comparison.agreement
        for name, value in (
            ("keypoints within 1 px of fp32's", agreement.repeatability),
            ("cosine of their descriptors", agreement.cosine),
            ("cosine of global descriptors", agreement.global_cosine),
        ):
            if value is not None:
                table.add_row(name, "", "", f"{value:.4f}")
        console.print(table)
        names = ", ".join(self.float_layers) or "none"
        console.print(
            f"ranges hold {self.percentile:g} % of the values; "
            f"float layers, {len(self.float_layers)} of {self.num_layers}: {names}",
            soft_wrap=True,
            highlight=False,
        )
