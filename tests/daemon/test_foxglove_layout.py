"""The layout for Foxglove shows what a log holds."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from tests.conftest import Demo

LAYOUT = Path(__file__).parents[2] / "docs" / "foxglove-layout.json"
pytestmark = pytest.mark.skipif(not LAYOUT.is_file(), reason="needs the checkout's docs/")
# What the panels that name topics can show.
SCHEMAS = {
    "annotations": {"foxglove.ImageAnnotations"},
    "imageTopic": {"foxglove.CompressedImage", "foxglove.RawImage"},
    "calibrationTopic": {"foxglove.CameraCalibration"},
    "cameraInfoTopic": {"foxglove.CameraCalibration"},
    "topics": {
        "foxglove.CameraCalibration",
        "foxglove.CompressedImage",
        "foxglove.PointCloud",
        "foxglove.RawImage",
        "foxglove.SceneUpdate",
    },
    "topicPath": {"trigpoint.Status"},
}


@pytest.fixture(scope="module")
def layout() -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads(LAYOUT.read_text())
    return loaded


@pytest.fixture(scope="module")
def log(demo: Demo, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("layout") / "log.mcap"
    options = ["--map", demo.map, "--log", path, "--end", "0.5"]
    replay = [sys.executable, "-m", "trigpointd.cli", "replay", demo.recording, *options]
    subprocess.run(list(map(str, replay)), check=True)
    return path


@pytest.fixture(scope="module")
def schemas(log: Path) -> dict[str, str]:
    """The names of the schemas by topic."""
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return {
        channel.topic: summary.schemas[channel.schema_id].name
        for channel in summary.channels.values()
    }


def named_topics(config: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Every topic that a panel names, and by which setting."""
    if isinstance(config, dict):
        if key in ("annotations", "topics"):
            yield from ((key, topic) for topic in config)
        for name, value in config.items():
            yield from named_topics(value, name)
    elif key in SCHEMAS:
        yield key, config


def paths(config: Any) -> Iterator[str]:
    """Every message path that a panel draws."""
    yield from (path["value"] for path in config.get("paths", ()))


def leaves(node: Any) -> list[str]:
    return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])


def test_every_panel_has_its_place(layout: dict[str, Any]) -> None:
    assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])
    kinds = {name.split("!")[0] for name in layout["configById"]}
    assert kinds == {"3D", "Image", "Plot", "RawMessages", "StateTransitions"}


def test_a_log_holds_every_topic_in_a_form_that_its_panel_shows(
    layout: dict[str, Any], schemas: dict[str, str]
) -> None:
    named = list(named_topics(layout["configById"]))
    assert {key for key, _ in named} == SCHEMAS.keys()
    for key, topic in named:
        assert schemas[topic] in SCHEMAS[key], (key, topic)


def test_a_log_holds_nothing_that_the_layout_leaves_out(
    layout: dict[str, Any], schemas: dict[str, str]
) -> None:
    named = {topic for _, topic in named_topics(layout["configById"])}
    # Transforms need no panel of their own; the pose is the body's transform.
    assert schemas.keys() - named == {"trigpoint/device/pose", "trigpoint/device/transforms"}


def test_every_path_leads_to_a_number_or_a_word(layout: dict[str, Any], log: Path) -> None:
    with log.open("rb") as stream:
        [*_, (_, _, message)] = make_reader(stream).iter_messages(["trigpoint/device/status"])
    status = json.loads(message.data)
    drawn = {path for config in layout["configById"].values() for path in paths(config)}
    fields = {path.removeprefix("trigpoint/device/status.") for path in drawn}
    assert fields == {"status", "num_inliers", "confidence", "latency_ms"}
    assert all(isinstance(status[field], int | float | str) for field in fields)


def test_the_frames_it_follows_are_those_of_the_transforms(
    layout: dict[str, Any], log: Path
) -> None:
    followed = {c["followTf"] for c in layout["configById"].values() if "followTf" in c}
    with log.open("rb") as stream:
        data = b"".join(
            message.data
            for _, _, message in make_reader(stream).iter_messages(["trigpoint/device/transforms"])
        )
    assert followed
    assert all(frame.encode() in data for frame in followed)


def test_the_documented_command_moves_it_to_another_base_key(layout: dict[str, Any]) -> None:
    page = LAYOUT.with_name("foxglove.md").read_text()
    found = re.search(r"sed '([^']+)' docs/foxglove-layout\.json", page)
    assert found is not None
    done = subprocess.run(
        ["sed", found[1], str(LAYOUT)], capture_output=True, text=True, check=True
    )
    moved = json.loads(done.stdout)
    assert moved.keys() == layout.keys()
    assert "trigpoint/device" not in done.stdout
