"""What a page is made of, and how it is written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from importlib.util import find_spec
from pathlib import Path

from trigpoint.errors import ConfigError
from trigpoint.output import check_output, write_atomically
from trigpoint_db.figures import require_matplotlib


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


def check_page(path: Path, *inputs: Path) -> None:
    """Refuse, before any work is done, a page that cannot be made or must not be written."""
    check_output(path, *inputs)
    if path.suffix.lower() != ".html":  # no image, map or model of a folder is called so
        raise ConfigError(f"cannot write a page to {path}; name it .html")
    require_matplotlib()
    if find_spec("jinja2") is None:
        raise ConfigError("a report needs Jinja2; install it with: pip install 'trigpoint[plots]'")


def write_page(path: Path, title: str, sections: Sequence[Section]) -> None:
    """Write a page that needs nothing but itself; texts may hold anything and are escaped."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = resources.files("trigpoint_db.report") / "page.html.j2"
    html = environment.from_string(template.read_text(encoding="utf-8")).render(
        title=title, sections=sections
    )
    write_atomically(path, html)
