"""The records of an MCAP file that are whole, whatever has happened to the others.

A file is a row of records, some of them chunks of messages with the checksum of what is in them.
What a checksum vouches for is kept: where the row is broken, the next chunk whose checksum is right
is looked for. Chunks that some programs write without one are taken while the row holds.
A file without chunks is read up to the first broken record.
"""

from __future__ import annotations

import mmap
import re
import struct
from collections.abc import Callable, Iterator
from io import BytesIO
from typing import Any
from zlib import crc32

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

_RECORD = struct.Struct("<BQ")  # opcode, length of what follows
_CHUNK = struct.Struct("<QQQII")  # times, size, checksum, length of the compression's name
_FOOTER_BYTES = _RECORD.size + 20
_CHUNK_START = re.compile(rb"\x06(?=.{5}\0\0\0)", re.DOTALL)  # of less than a terabyte
_READERS: dict[int, Callable[[ReadDataStream], Any]] = {
    Opcode.HEADER: Header.read,
    Opcode.FOOTER: Footer.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.MESSAGE_INDEX: MessageIndex.read,
    Opcode.CHUNK_INDEX: ChunkIndex.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex.read,
    Opcode.STATISTICS: Statistics.read,
    Opcode.METADATA: Metadata.read,
    Opcode.METADATA_INDEX: MetadataIndex.read,
    Opcode.SUMMARY_OFFSET: SummaryOffset.read,
    Opcode.DATA_END: DataEnd.read,
}
# What mcap and its decompressors raise on bytes that are not as they should be.
DAMAGE = (
    McapError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    RuntimeError,
    MemoryError,
    OverflowError,
)


class Salvage:
    """The whole records of a log.

    Attributes
    ----------
    finished : bool
        Whether the log has its end.
    num_damaged_bytes : int
        What `records` has passed over so far.
    """

    def __init__(self, data: mmap.mmap) -> None:
        self._data = data
        self.finished = data[-len(MCAP0_MAGIC) :] == MCAP0_MAGIC
        self.num_damaged_bytes = 0

    def summary(self) -> list[McapRecord]:
        """Read the records of the index, where the log has one and its checksum is right."""
        return _summary(self._data)

    def records(self) -> Iterator[tuple[McapRecord, bool]]:
        """Yield what is whole, in the log's order, and whether a checksum vouches for it."""
        data, position, chunked = self._data, len(MCAP0_MAGIC), False
        end = len(data) - (len(MCAP0_MAGIC) if self.finished else 0)
        while position < end:
            opcode, content = _record_at(data, position)
            chunked |= opcode == Opcode.CHUNK
            records = _read(opcode, content)
            if records is None:
                found = _find_chunk(data, position + 1)
                self.num_damaged_bytes += found - position
                position = found
                continue
            for record in records:
                # In a log of chunks, a message outside of them is one of another record's bytes.
                if opcode == Opcode.CHUNK or not (chunked and isinstance(record, Message)):
                    yield record, opcode == Opcode.CHUNK
            position += _RECORD.size + len(content)


def _summary(data: mmap.mmap) -> list[McapRecord]:
    start_of_footer = len(data) - len(MCAP0_MAGIC) - _FOOTER_BYTES
    if start_of_footer < 0:
        return []
    start, _, checksum = struct.unpack_from("<QQI", data, start_of_footer + _RECORD.size)
    if not 0 < start <= start_of_footer or crc32(data[start : -len(MCAP0_MAGIC) - 4]) != checksum:
        return []
    try:
        return list(StreamReader(BytesIO(data[start:]), skip_magic=True).records)
    except DAMAGE:
        return []


def _record_at(data: mmap.mmap, position: int) -> tuple[int, bytes]:
    """Return opcode and content of a record; opcode 0, which none has, where it does not fit."""
    start = position + _RECORD.size
    if start > len(data):
        return 0, b""
    opcode, length = _RECORD.unpack_from(data, position)
    return (opcode, data[start : start + length]) if start + length <= len(data) else (0, b"")


def _read(opcode: int, content: bytes) -> list[McapRecord] | None:
    """Read a record, or all that are in a chunk; None where it is not as it should be."""
    stream = ReadDataStream(BytesIO(content))
    try:
        if opcode == Opcode.CHUNK:
            return breakup_chunk(Chunk.read(stream), validate_crc=True)
        if opcode == Opcode.MESSAGE:
            return [Message.read(stream, len(content))]
        record: McapRecord = _READERS[opcode](stream)
    except (*DAMAGE, LookupError):
        return None
    if opcode == Opcode.ATTACHMENT and content[-4:] != struct.pack("<I", crc32(content[:-4])):
        return None
    return [record] if stream.count == len(content) else None


def _find_chunk(data: mmap.mmap, position: int) -> int:
    """Return where the next chunk with a right checksum begins, or the end of the log."""
    for match in _CHUNK_START.finditer(data, position):
        start = match.start()
        if not _looks_like_chunk(data, start):
            continue
        opcode, content = _record_at(data, start)
        if _read(opcode, content):
            return start
    return len(data)


def _looks_like_chunk(data: mmap.mmap, position: int) -> bool:
    """Whether the sizes in a chunk's header agree, and it has a checksum."""
    start = position + _RECORD.size
    try:
        _, length = _RECORD.unpack_from(data, position)
        *_, checksum, name_bytes = _CHUNK.unpack_from(data, start)
        (num_bytes,) = struct.unpack_from("<Q", data, start + _CHUNK.size + name_bytes)
    except struct.error:
        return False
    return bool(checksum) and length == _CHUNK.size + name_bytes + 8 + num_bytes
