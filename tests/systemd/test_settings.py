"""The settings that are installed load, and explain every key."""

import dataclasses
import re
import tomllib
from pathlib import Path
from typing import Any, get_args

import pytest

from trigpoint.options import LocalizerOptions
from trigpointd.config import Config, DepthaiConfig, Section, V4l2Config, load_config

SETTINGS = Path(__file__).parents[2] / "systemd" / "trigpoint.toml"
pytestmark = pytest.mark.skipif(not SETTINGS.is_file(), reason="needs the checkout's systemd/")


def defaults(kind: Any) -> dict[str, Any]:
    """The keys of a table and their defaults; None where there is none."""
    if dataclasses.is_dataclass(kind):
        return {field.name: field.default for field in dataclasses.fields(kind)}
    fields = {name: field.get_default() for name, field in kind.model_fields.items()}
    return {name: None if repr(value) == "PydanticUndefined" else value
            for name, value in fields.items()}  # fmt: skip


def tables(annotation: Any) -> list[Any]:
    """The kind of table that a field holds, of several the first."""
    kinds = [kind for kind in (annotation, *get_args(annotation)) if isinstance(kind, type)]
    return [kind for kind in kinds if issubclass(kind, Section | LocalizerOptions)][:1]


def keys(kind: Any = Config, table: str = "") -> list[tuple[str, str, Any]]:
    """Every key of the settings: table, name, default."""
    if kind is LocalizerOptions:
        return [(table, *item) for item in defaults(kind).items()]
    found: list[tuple[str, str, Any]] = []
    for name, field in kind.model_fields.items():
        kinds = tables(field.annotation)
        found += [item for inner in kinds for item in keys(inner, f"{table}.{name}".strip("."))]
        found += [] if kinds else [(table, name, defaults(kind)[name])]
    return found


def shown() -> dict[tuple[str, str], list[tuple[bool, Any]]]:
    """What the file says of each key: whether it is commented out, and the value."""
    said: dict[tuple[str, str], list[tuple[bool, Any]]] = {}
    table = ""
    for line in SETTINGS.read_text().splitlines():
        if heading := re.fullmatch(r"#?\[([\w.]+)\]", line):
            table = heading[1]
        elif setting := re.fullmatch(r"(#?)((\w+) = .*)", line):
            value = tomllib.loads(setting[2])[setting[3]]
            said.setdefault((table, setting[3]), []).append((bool(setting[1]), value))
    return said


def test_they_load() -> None:
    assert load_config(SETTINGS).map == Path("/var/lib/trigpoint/place.tpmap")


def test_they_load_with_every_line_in_force(tmp_path: Path) -> None:
    text = re.sub(r"^#(\w+ = |\[)", r"\1", SETTINGS.read_text(), flags=re.MULTILINE)
    (tmp_path / "all.toml").write_text(text)
    config = load_config(tmp_path / "all.toml")
    assert config.localizer.max_latency_ms is not None


def test_every_key_is_there_and_no_other() -> None:
    assert set(shown()) == {(table, key) for table, key, _ in keys()}


def test_what_is_commented_out_is_the_default() -> None:
    values = {
        (table, key): list(default) if isinstance(default, tuple) else default
        for table, key, default in keys()
        if default is not None
    }
    said = {key: value for key, lines in shown().items() for comment, value in lines if comment}
    assert {key: said[key] for key in values.keys() & said.keys()} == {
        key: values[key] for key in values.keys() & said.keys()
    }


@pytest.mark.parametrize("kind", [V4l2Config, DepthaiConfig])
def test_cameras_are_explained_in_place_of_the_recording(
    tmp_path: Path, kind: type[Section]
) -> None:
    text = SETTINGS.read_text()
    name = get_args(kind.model_fields["type"].annotation)[0]
    block = text[text.index(f'##type = "{name}"') :].partition("\n\n")[0]
    assert set(re.findall(r"^##+(\w+) = ", block, re.MULTILINE)) == kind.model_fields.keys()
    source = re.sub(r"^##(?!#)", "", block, flags=re.MULTILINE)
    settings = tmp_path / "camera.toml"
    settings.write_text(
        re.sub(r"(?s)(?<=\[source\]\n).*?(?=\n\[)", lambda _: source, text, count=1)
    )
    loaded = load_config(settings).source
    assert isinstance(loaded, kind)
    for key, field in kind.model_fields.items():
        if not field.is_required() and field.default is not None:
            assert getattr(loaded, key) == field.default
