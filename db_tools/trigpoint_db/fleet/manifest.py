"""What a published map is: its chunks, each known by its SHA-256."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from trigpoint.database.snapshot import MAX_MAP_BYTES
from trigpoint.errors import SourceError

CHUNK_BYTES = 2**20
Hash = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class Manifest(BaseModel):
    """A map as a publisher offers it. It comes from the network: what is wrong is an error."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True)

    num_bytes: int = Field(ge=1, le=MAX_MAP_BYTES)
    sha256: Hash
    chunk_bytes: int = Field(ge=2**12, le=2**26)
    chunks: list[Hash]
    generation: int
    num_images: int
    model: str
    model_sha256: str

    @model_validator(mode="after")
    def _check_count(self) -> Manifest:
        if len(self.chunks) != -(-self.num_bytes // self.chunk_bytes):
            raise ValueError(f"{len(self.chunks)} chunks are not {self.num_bytes} bytes")
        return self

    @classmethod
    def decode(cls, payload: bytes) -> Manifest:
        """Read JSON."""
        try:
            return cls.model_validate_json(payload)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"])) or "it"
            raise SourceError(f"the manifest cannot be used: {where}: {first['msg']}") from error

    def size_of(self, chunk: int) -> int:
        """Return the bytes of a chunk: the last one may be shorter."""
        return min(self.chunk_bytes, self.num_bytes - chunk * self.chunk_bytes)

    @cached_property
    def places(self) -> dict[str, list[int]]:
        """The chunks with each hash."""
        places: dict[str, list[int]] = {}
        for chunk, digest in enumerate(self.chunks):
            places.setdefault(digest, []).append(chunk)
        return places


@dataclass(frozen=True)
class Hashes:
    """Of a file."""

    num_bytes: int
    sha256: str
    chunks: list[str]


def hash_file(fd: int, chunk_bytes: int = CHUNK_BYTES) -> Hashes:
    """Hash a file as a whole and by chunks."""
    whole, chunks, offset = hashlib.sha256(), list[str](), 0
    while data := os.pread(fd, chunk_bytes, offset):
        whole.update(data)
        chunks.append(hashlib.sha256(data).hexdigest())
        offset += len(data)
    return Hashes(offset, whole.hexdigest(), chunks)


def hash_whole(path: Path) -> str:
    """Hash a file as a whole only, in half the time."""
    with path.open("rb", buffering=0) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
