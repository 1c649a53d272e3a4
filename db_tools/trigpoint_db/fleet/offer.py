"""What a publisher offers: a map as one commit left it, whatever a writer does meanwhile."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from trigpoint.database.reader import MapReader
from trigpoint.errors import ConfigError, DatabaseError
from trigpoint_db.fleet.manifest import CHUNK_BYTES, Manifest, hash_file


class Offer:
    """A copy of a snapshot, without a name in the map's folder, and its manifest."""

    def __init__(self, reader: MapReader, folder: Path) -> None:
        if problems := reader.verify():
            raise DatabaseError(f"the map is damaged and is not published: {problems[0]}")
        try:
            self._file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115
            reader.copy_to(self._file.fileno())
        except (OSError, DatabaseError) as error:
            raise ConfigError(
                f"cannot copy the map within {folder}: {error}; the copy is what is published, and "
                "its space is needed there"
            ) from error
        hashes = hash_file(self._file.fileno())
        self.manifest = Manifest(
            num_bytes=hashes.num_bytes,
            sha256=hashes.sha256,
            chunk_bytes=CHUNK_BYTES,
            chunks=hashes.chunks,
            generation=reader.generation,
            num_images=len(reader),
            model=reader.model.name,
            model_sha256=reader.model.sha256,
        )

    def read(self, sha256: str) -> bytes | None:
        """Return the chunk with a hash, None if there is none."""
        if sha256 not in self.manifest.places:
            return None
        chunk = self.manifest.places[sha256][0]
        offset = chunk * self.manifest.chunk_bytes
        return os.pread(self._file.fileno(), self.manifest.size_of(chunk), offset)

    def close(self) -> None:
        """Give the space of the copy back."""
        self._file.close()
