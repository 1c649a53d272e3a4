"""Localize image files against a map."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trigpoint.errors import TrigpointError
from trigpoint.frame import Localized, Result, describe
from trigpoint.localizer import Localizer
from trigpoint_db.build import read_frame
from trigpoint_db.poses import Query


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of a query; `error` says why its image could not be used."""

    name: str
    result: Result | None
    error: str = ""

    @property
    def reason(self) -> str:
        """In a word."""
        if self.result is None:
            return "BAD_IMAGE"
        return "LOCALIZED" if isinstance(self.result, Localized) else self.result.reason

    def to_json(self) -> dict[str, Any]:
        """Say it in JSON's types."""
        if self.result is None:
            failure = {"status": "FAILED", "reason": self.reason, "detail": self.error}
            return {"name": self.name, **failure}
        return {"name": self.name, **describe(self.result)}


def localize_images(
    localizer: Localizer, queries: Iterable[Query], folder: Path
) -> Iterator[Outcome]:
    """Localize queries one by one; an image that cannot be read does not stop the others."""
    for query in queries:
        try:
            frame = read_frame(folder / query.name, query.camera, query.name)
        except TrigpointError as error:
            yield Outcome(query.name, None, str(error))
            continue
        yield Outcome(query.name, localizer.localize(frame))
