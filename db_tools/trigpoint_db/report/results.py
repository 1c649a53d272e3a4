"""What `trigpoint-db localize --results` has written, read again."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from trigpoint.errors import ConfigError
from trigpoint_db.poses import read_lines


class QueryResult(BaseModel):
    """What a report needs of a line."""

    model_config = ConfigDict(frozen=True, extra="ignore", strict=True, allow_inf_nan=False)

    name: str
    reason: str | None  # why there is no pose; None where there is one
    anchors: tuple[str, ...] = ()  # names, best first
    stage_ms: dict[str, float] = {}


def read_results(path: Path) -> list[QueryResult]:
    """Read the lines that `localize --results` writes."""
    results = []
    for where, line in read_lines(path):
        try:
            results.append(QueryResult.model_validate_json(line))
        except ValidationError as error:
            raise ConfigError(
                f"{where}: {line[:80]!r} is no result of `trigpoint-db localize --results`"
            ) from error
    if not results:
        raise ConfigError(f"{path} holds no results")
    return results
