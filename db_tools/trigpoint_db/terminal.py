"""What the commands share: arguments of the same meaning, progress bars, hints."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from datetime import datetime
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from trigpoint.database.codec import Profile
from trigpoint.errors import ConfigError
from trigpoint.frame import Session

T = TypeVar("T")
console = Console()

Json = Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")]
Model = Annotated[str, typer.Option(help="The network: tiny, base, large, or a file (.onnx).")]
Retrieval = Annotated[
    Path | None, typer.Option(help="A retrieval network, where the other needs one beside it.")
]
MapPath = Annotated[Path, typer.Argument(metavar="MAP", help="A .tpmap file.")]
MapProfile = Annotated[
    Profile | None,
    typer.Option("--profile", help="standard, or compact: a third of the size, less precise."),
]
Keypoints = Annotated[int, typer.Option(help="At most so many an image.", min=50)]
SessionName = Annotated[
    str | None, typer.Option("--session", help="What survey the images are of, a name.")
]
SessionDate = Annotated[
    datetime | None, typer.Option("--date", formats=["%Y-%m-%d"], help="Of the survey.")
]


def fields_as_options(command: Callable[..., None]) -> Callable[..., None]:
    """Let a command have options in common with others: the fields of its dataclasses.

    Typer takes an option a parameter; this makes one of each field of a parameter that is a
    dataclass, and gives the command the dataclass.
    """
    own = inspect.signature(command, eval_str=True).parameters
    kinds = {n: p.annotation for n, p in own.items() if isinstance(p.annotation, type)}
    groups = {n: kind for n, kind in kinds.items() if is_dataclass(kind)}
    fields = {n: inspect.signature(group, eval_str=True).parameters for n, group in groups.items()}
    options = [option for n, p in own.items() for option in fields.get(n, {n: p}).values()]

    @wraps(command)
    def run(**values: Any) -> None:
        for n, group in groups.items():
            values[n] = group(**{field: values.pop(field) for field in fields[n]})
        command(**values)

    run.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [option.replace(kind=inspect.Parameter.KEYWORD_ONLY) for option in options]
    )
    run.__annotations__ = {option.name: option.annotation for option in options}
    return run


def track(items: Iterable[T], what: str, total: int) -> Generator[T, None, None]:
    """Show a progress bar on standard error, which keeps standard output clean."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True)) as progress:
        yield from progress.track(items, total=total, description=what)


def track_calibration(images: list[int]) -> Iterator[int]:
    """Show a progress bar of a calibration."""
    return track(images, "calibrating", len(images))


def make_session(name: str | None, day: datetime | None) -> Session | None:
    """Make what --session and --date name."""
    if name is None and day is not None:
        raise ConfigError("--date is that of a session; give its name with --session")
    return None if name is None else Session(name, day and day.date())


@contextmanager
def hint_at(option: str) -> Iterator[None]:
    """Say after an interruption how the command goes on."""
    try:
        yield
    except KeyboardInterrupt:
        sys.stderr.write(f"trigpoint-db: interrupted; the same command goes on with {option}\n")
        raise
