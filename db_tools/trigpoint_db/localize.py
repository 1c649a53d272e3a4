"""Localize image files against a map."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from trigpoint.errors import ConfigError, DatabaseError, SourceError
from trigpoint.frame import Failed, Prior, Result
from trigpoint.localizer import Localizer
from trigpoint_db.build import read_frame
from trigpoint_db.poses import Query


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of a query."""

    name: str
    result: Result | Failed


def localize_images(
    localizer: Localizer,
    queries: Iterable[Query],
    folder: Path,
    priors: Mapping[str, Prior] = MappingProxyType({}),
) -> Iterator[Outcome]:
    """Localize queries one by one; an image that cannot be read does not stop the others.

    `priors` say where some of them were taken, by name.
    """
    for query in queries:
        try:
            frame = read_frame(folder, query.name, query.camera)
            result: Result | Failed = localizer.localize(frame, priors.get(query.name))
        except (ConfigError, SourceError) as error:
            result = Failed("BAD_FRAME", str(error))
        except DatabaseError as error:
            result = Failed("BAD_MAP", str(error))
        yield Outcome(query.name, result)
