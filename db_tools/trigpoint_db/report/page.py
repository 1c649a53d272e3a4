"""What a page is made of, and how it is written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from trigpoint.errors import ConfigError
from trigpoint_db.poses import write_atomically


@dataclass(frozen=True)
class Table:
    """Rows of texts below headings; all but the first column are numbers or short words."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Picture:
    """A JPEG image and what is to see on it."""

    jpeg_base64: str
    text: str


@dataclass(frozen=True)
class Section:
    """A part of a page; what is empty is not shown."""

    title: str
    text: str = ""
    svg: str = ""  # an element that is known to be harmless: not escaped
    table: Table | None = None
    pictures: Sequence[Picture] = ()


def write_page(path: Path, title: str, sections: Sequence[Section]) -> None:
    """Write a page that needs nothing but itself; texts may hold anything and are escaped."""
    try:
        from jinja2 import Environment, StrictUndefined
    except ImportError as error:
        raise ConfigError(
            "a report needs Jinja2; install it with: pip install 'trigpoint[plots]'"
        ) from error
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = resources.files("trigpoint_db.report") / "page.html.j2"
    html = environment.from_string(template.read_text(encoding="utf-8")).render(
        title=title, sections=sections
    )
    write_atomically(path, html)
