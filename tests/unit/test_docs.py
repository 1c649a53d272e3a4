"""What the docs say of settings and of messages is what the code does."""

import dataclasses
import re
import tomllib
from pathlib import Path

import pytest
import typer.core
import typer.main

from trigpoint.frame import Reason, Statistics
from trigpoint.options import LocalizerOptions
from trigpoint_db.cli import app
from trigpoint_db.importers.registry import IMPORTERS
from trigpoint_db.public_sets import PUBLIC_SETS
from trigpointd.config import Config, V4l2Config

DOCS = Path(__file__).parents[2] / "docs"
pytestmark = pytest.mark.skipif(not DOCS.is_dir(), reason="needs the checkout's docs/")


def test_every_setting_of_the_localizer_is_listed_with_its_default() -> None:
    rows = re.findall(r"^\| `(\w+)` \| (\S+) \|", (DOCS / "configuration.md").read_text(), re.M)
    defaults = {
        field.name: {"None": "off", "False": "false", "()": "[]"}.get(
            str(field.default), str(field.default)
        )
        for field in dataclasses.fields(LocalizerOptions)
    }
    assert {name: value.strip('"') for name, value in rows} == defaults


def test_the_example_has_every_other_setting_and_is_valid() -> None:
    text = (DOCS / "configuration.md").read_text()
    tables = tomllib.loads(text.split("```toml")[1].split("```")[0])
    config = Config.model_validate(tables)
    assert set(tables) == set(Config.model_fields) - {"localizer"}
    for name in ("source", "camera", "model", "zenoh", "log", "foxglove"):
        assert set(tables[name]) == set(type(getattr(config, name)).model_fields)
    for name in ("requests", "tls"):
        assert set(tables["zenoh"][name]) == set(type(getattr(config.zenoh, name)).model_fields)


def test_the_example_of_a_camera_has_all_its_settings_and_is_valid() -> None:
    text = (DOCS / "configuration.md").read_text()
    source = tomllib.loads(text.split("```toml")[2].split("```")[0])["source"]
    assert set(source) == set(type(V4l2Config.model_validate(source)).model_fields)


def test_every_reason_and_count_is_explained() -> None:
    text = (DOCS / "interfaces.md").read_text()
    for reason in Reason:
        assert f"`{reason}`" in text
    for field in dataclasses.fields(Statistics):
        assert f"`{field.name}`" in text


def test_the_table_of_formats_has_all_of_them() -> None:
    rows = re.findall(r"^\| `(\w+)` \|.*\| `(.*)` \|$", (DOCS / "maps.md").read_text(), re.M)
    assert [name for name, _ in rows] == list(IMPORTERS)
    commands = (DOCS / "maps.md").read_text()
    assert all(f"`{public.command}`" in commands for public in PUBLIC_SETS)


def test_the_commands_on_maps_and_data_sets_are_such() -> None:
    text = (DOCS / "maps.md").read_text() + (DOCS.parent / "README.md").read_text()
    group = typer.main.get_command(app)
    assert isinstance(group, typer.core.TyperGroup)
    lines = re.findall(r"trigpoint-db (\w[\w-]*)(.*?)[`\n]", text)
    assert {"build", "queries", "submit"} <= {name for name, _ in lines}
    for name, arguments in lines:
        command = group.commands[name]
        if isinstance(command, typer.core.TyperGroup):
            command = command.commands[arguments.split()[0]]
        known = {option for parameter in command.params for option in parameter.opts}
        named = set(
            re.findall(r"(?<![\w-])--?[a-z][\w-]*", re.sub(r"'.*?'|\".*?\"", "", arguments))
        )
        assert named <= known, (name, named - known)


def test_relative_links_lead_somewhere() -> None:
    for page in [DOCS.parent / "README.md", *DOCS.rglob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            assert target.startswith("https://") or (page.parent / target).exists(), (page, target)


def test_the_tests_of_faults_exist() -> None:
    tests = DOCS.parent / "tests"
    defined = {name for path in tests.rglob("test_*.py")
               for name in re.findall(r"def (test_\w+)", path.read_text())}  # fmt: skip
    named = set(re.findall(r"`(test_\w+)`", (DOCS / "reliability.md").read_text()))
    assert named
    assert named <= defined, named - defined
