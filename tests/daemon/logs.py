"""Outputs with a number in them, and which numbers a log holds."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import numpy as np
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Channel
from mcap.records import Message as Record
from mcap.stream_reader import StreamReader

from trigpoint.frame import Failed
from trigpointd.pipeline import Output
from trigpointd.sources.base import BadFrame, Captured

STATUS = "base/status"


def numbered(i: int, noise_bytes: int = 0) -> Output:
    """Make a status with a number in it, and twice as many characters as bytes are asked for."""
    noise = np.random.default_rng(i).bytes(noise_bytes).hex()
    status = json.dumps({"i": i, "noise": noise}).encode()
    return Output(Captured(BadFrame(i, "", ""), i), Failed("BAD_FRAME", ""), None, status)


def numbers_in(path: Path) -> list[int]:
    """Read a finished log through its index."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_summary() is not None
        statuses = reader.iter_messages([STATUS])
        return [json.loads(message.data)["i"] for _, _, message in statuses]


def numbers_in_unfinished(path: Path) -> list[int]:
    """Read what comes before the place where a log breaks off, with mcap alone."""
    found: list[int] = []
    statuses = set[int]()  # ids of the channel, of which there may be one
    with path.open("rb") as stream, contextlib.suppress(EndOfFile):
        for record in StreamReader(stream).records:
            if isinstance(record, Channel) and record.topic == STATUS:
                statuses.add(record.id)
            elif isinstance(record, Record) and record.channel_id in statuses:
                found.append(json.loads(record.data)["i"])
    return found
