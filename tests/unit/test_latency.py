"""Stage times from logs: whole, unfinished and damaged ones."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import CompressionType, Writer
from rich.console import Console

from trigpoint.errors import ConfigError
from trigpoint_db.latency import (
    TOTAL,
    print_latency,
    read_stage_times,
    summarize_latency,
)

FIRST = {"status": "LOCALIZED", "stage_ms": {"features": 5.0, "retrieval": 1.0}, "latency_ms": 6.5}
LOST = {"status": "LOST", "stage_ms": {"features": 7.0}, "latency_ms": 7.25}


def write_log(
    path: Path,
    *statuses: Any,
    topic: str = "trigpoint/drone/status",
    encoding: str = "json",
    finish: bool = True,
    compression: CompressionType = CompressionType.ZSTD,
) -> Path:
    """Write a log with a status and something else for each frame; a chunk for each."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1, compression=compression)
        writer.start(library="test")
        schema = writer.register_schema("trigpoint.Status", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel(topic, encoding, schema)
        other = writer.register_channel("trigpoint/drone/pose", "cdr", 0)
        for i, status in enumerate(statuses):
            data = status if isinstance(status, bytes) else json.dumps(status).encode()
            writer.add_message(other, i, b"\0\1\2", i)
            writer.add_message(channel, i, data, i)
        if finish:
            writer.finish()  # type: ignore[no-untyped-call]
    return path


def count_frames(log: Path) -> int:
    try:
        return len(read_stage_times(log)[TOTAL])
    except ConfigError:
        return 0


def test_stage_times_are_read_in_the_order_of_the_frames(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.mcap", FIRST, LOST, FIRST)
    times = read_stage_times(log)
    assert times == {
        "features": [5.0, 7.0, 5.0],
        "retrieval": [1.0, 1.0],
        TOTAL: [6.5, 7.25, 6.5],
    }
    assert list(times) == ["features", "retrieval", TOTAL]


def test_without_a_latency_the_total_is_the_sum_of_the_stages(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.mcap", {"stage_ms": {"features": 5, "retrieval": 1.5}})
    assert read_stage_times(log)[TOTAL] == [6.5]


def test_frames_that_reached_no_stage_do_not_count(tmp_path: Path) -> None:
    bad, dark = {"status": "FAILED", "latency_ms": 0.1}, {"stage_ms": {}, "latency_ms": 0.1}
    assert read_stage_times(write_log(tmp_path / "log.mcap", bad, FIRST, dark))[TOTAL] == [6.5]


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.NONE])
def test_an_unfinished_log_is_read_as_far_as_it_goes(
    tmp_path: Path, compression: CompressionType
) -> None:
    path = tmp_path / "log.mcap"
    written = write_log(path, FIRST, LOST, finish=False, compression=compression).read_bytes()
    assert read_stage_times(path)[TOTAL] == [6.5, 7.25]
    counts = []
    for end in range(0, len(written), 7):  # wherever it was cut off
        path.write_bytes(written[:end])
        counts.append(count_frames(path))
    assert counts == sorted(counts)
    assert set(counts) == {0, 1, 2}


def test_damage_in_a_whole_log_is_an_error(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.mcap", FIRST, LOST, compression=CompressionType.NONE)
    data = log.read_bytes()
    log.write_bytes(data.replace(b"LOST", b"lost", 1))
    with pytest.raises(ConfigError, match=r"log\.mcap is damaged \(crc.*trigpoint-db recover"):
        read_stage_times(log)


@pytest.mark.parametrize(
    ("topic", "encoding"), [("trigpoint/drone/pose", "json"), ("other/status", "cdr")]
)
def test_a_log_without_status_is_an_error(tmp_path: Path, topic: str, encoding: str) -> None:
    log = write_log(tmp_path / "log.mcap", FIRST, topic=topic, encoding=encoding)
    with pytest.raises(ConfigError, match=r"no stage times in .*log\.mcap"):
        read_stage_times(log)


@pytest.mark.parametrize("content", [b"", b"\x89MCAP", b"not a recording at all"])
def test_another_file_is_an_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "log.mcap").write_bytes(content)
    with pytest.raises(ConfigError, match=r"no stage times in .*give an MCAP log of trigpointd"):
        read_stage_times(tmp_path / "log.mcap")


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot read .*log\.mcap: No such file"):
        read_stage_times(tmp_path / "log.mcap")


@pytest.mark.parametrize(
    "status", [b"{", b"\xff", [1], {"stage_ms": 5}, {"stage_ms": {"a": "fast"}}]
)
def test_a_foreign_status_is_an_error(tmp_path: Path, status: Any) -> None:
    log = write_log(tmp_path / "log.mcap", status)
    with pytest.raises(ConfigError, match=r"on trigpoint/drone/status is not a status of trigp"):
        read_stage_times(log)


def test_latency_is_summarized_by_its_percentiles() -> None:
    times = {"features": [float(i) for i in range(101)], TOTAL: [3.5]}
    assert summarize_latency(times) == {
        "features": {"p50": 50.0, "p99": 99.0},
        TOTAL: {"p50": 3.5, "p99": 3.5},
    }


def test_the_table_shows_the_percentiles_of_each_stage() -> None:
    console = Console(file=io.StringIO(), width=80)
    ramp = [float(i) for i in range(101)]
    print_latency(console, {"features": ramp, TOTAL: [2 * ms for ms in ramp]})
    assert isinstance(console.file, io.StringIO)
    rows = [line.replace("│", " ").split() for line in console.file.getvalue().splitlines()]
    assert ["features", "101", "50.0", "99.0"] in rows
    assert [TOTAL, "101", "100.0", "198.0"] in rows
