"""A publisher at fault: python -m tests.unit.flaky_publisher MAP KEY ENDPOINT FAULT.

After three chunks it `dies`, or `stalls`: does not answer any more. Or it `lies`: alters a byte of
one chunk. Or it `lacks` that chunk.
"""

import os
import signal
import sys
import threading
from itertools import count
from pathlib import Path

import zenoh

from trigpoint.database.reader import MapReader
from trigpoint_db.fleet.offer import Offer
from trigpoint_db.fleet.zenoh import open_session

NUM_CHUNKS = 3


def publish(map_: Path, key: str, endpoint: str, fault: str) -> None:
    with MapReader.open(map_) as reader:
        offer = Offer(reader, map_.parent)
    session = open_session(None, None, [endpoint])
    numbers = count()
    kept: list[zenoh.Query] = []  # asked and not answered

    def reply_manifest(query: zenoh.Query) -> None:
        with query:
            query.reply(f"{key}/manifest", offer.manifest.model_dump_json().encode())

    def reply_chunk(query: zenoh.Query) -> None:
        if fault in ("dies", "stalls") and next(numbers) >= NUM_CHUNKS:
            if fault == "dies":
                os.kill(os.getpid(), signal.SIGKILL)
            kept.append(query)
            return
        digest = str(query.key_expr).rpartition("/")[2]
        data = offer.read(digest)
        assert data is not None
        is_at_fault = digest == offer.manifest.chunks[1]
        if fault == "lies" and is_at_fault:
            data = data[:-1] + bytes([data[-1] ^ 1])
        with query:
            if fault == "lacks" and is_at_fault:
                query.reply_err("not in this generation")
                return
            query.reply(str(query.key_expr), data)

    session.declare_queryable(f"{key}/manifest", reply_manifest, complete=True)
    session.declare_queryable(f"{key}/chunk/*", reply_chunk, complete=True)
    print("ready", flush=True)  # noqa: T201
    threading.Event().wait()


if __name__ == "__main__":
    publish(Path(sys.argv[1]), *sys.argv[2:])
