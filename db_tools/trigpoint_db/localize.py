"""Localize image files against a map."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from trigpoint.errors import ConfigError, DatabaseError, SourceError
from trigpoint.frame import Failed, Localized, Prior, Result, describe, summarize
from trigpoint.localizer import Localizer
from trigpoint.rigid import Rigid3
from trigpoint_db.build import read_frame
from trigpoint_db.methods.baseline import Baseline, Estimate
from trigpoint_db.poses import Query


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of a query."""

    name: str
    result: Result | Estimate | Failed

    @property
    def cam_from_world(self) -> Rigid3 | None:
        """The pose, where there is one."""
        if isinstance(self.result, Localized | Estimate):
            return self.result.cam_from_world
        return None

    def summarize(self) -> str:
        """Say in a word what came of it: LOCALIZED, or the reason why not."""
        return "LOCALIZED" if isinstance(self.result, Estimate) else summarize(self.result)

    def describe(self) -> dict[str, Any]:
        """Say in JSON's types what came of it."""
        if isinstance(self.result, Estimate):
            return {"name": self.name, **self.result.describe()}
        return {"name": self.name, **describe(self.result)}


def localize_images(
    localizer: Localizer | Baseline,
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
            result: Result | Estimate | Failed = localizer.localize(frame, priors.get(query.name))
        except (ConfigError, SourceError) as error:
            result = Failed("BAD_FRAME", str(error))
        except DatabaseError as error:
            result = Failed("BAD_MAP", str(error))
        yield Outcome(query.name, result)
