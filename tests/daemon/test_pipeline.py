"""What is said of frames while the map under the daemon changes or is damaged."""

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import Demo
from tests.unit.graphs import for_one_size
from trigpoint.camera import Camera
from trigpoint.database.reader import MapReader
from trigpoint.database.replacing import compact_map
from trigpoint.database.writer import MapWriter
from trigpoint.errors import ConfigError
from trigpoint.frame import Frame, ModelIdentity, Session
from trigpoint.images import read_gray
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.options import LocalizerOptions
from trigpoint.rigid import Rigid3
from trigpoint_db.build import append_map, build_map
from trigpoint_db.demo import CAMERA
from trigpoint_db.importers.base import PosedImage
from trigpoint_db.importers.colmap import read_model
from trigpoint_db.maps import remove_images
from trigpointd.config import Config, McapConfig
from trigpointd.pipeline import Pipeline, open_pipeline
from trigpointd.sources.base import Captured


@pytest.fixture
def survey(demo: Demo) -> list[PosedImage]:
    return read_model(demo.folder / "sparse")[:24]


@pytest.fixture
def map_path(demo: Demo, tmp_path: Path, model: FeatureModel, survey: list[PosedImage]) -> Path:
    build_map(tmp_path / "m.tpmap", survey[:1], demo.folder / "survey", model)
    return tmp_path / "m.tpmap"


@pytest.fixture
def pipeline(map_path: Path, model: FeatureModel) -> Iterator[Pipeline]:
    with MapReader.open(map_path, model.identity) as reader:
        localizer = Localizer(model, reader, clock=time.perf_counter)
        yield Pipeline(localizer, reader, Rigid3.identity(), "map")


@pytest.fixture
def captured(demo: Demo, survey: list[PosedImage]) -> Captured:
    """The second image of the survey: it sees what the first sees from elsewhere."""
    image = read_gray(demo.folder / "survey" / survey[1].name)
    return Captured(Frame(image, CAMERA, time_ns=5), log_time_ns=5)


def status(pipeline: Pipeline, captured: Captured) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads(pipeline.process(captured).status)
    return loaded


def test_images_added_under_the_daemon_are_used_from_the_next_frame_on(
    pipeline: Pipeline,
    captured: Captured,
    demo: Demo,
    map_path: Path,
    model: FeatureModel,
    survey: list[PosedImage],
) -> None:
    before = status(pipeline, captured)
    assert before["reason"] == "FEW_ANCHORS"
    append_map(map_path, survey[1:], demo.folder / "survey", model)
    after = status(pipeline, captured)
    assert after["status"] == "LOCALIZED"
    assert after["map_generation"] > before["map_generation"]


def test_a_map_compacted_under_the_daemon_is_taken_up_with_the_next_frame(
    pipeline: Pipeline,
    captured: Captured,
    demo: Demo,
    map_path: Path,
    model: FeatureModel,
    survey: list[PosedImage],
) -> None:
    append_map(map_path, survey[1:], demo.folder / "survey", model)
    before = status(pipeline, captured)
    with MapReader.open(demo.map) as reader, MapWriter.open(map_path, model.identity) as writer:
        for i in range(40):
            writer.add_record(reader.record(0), f"unwanted/{i}")
    remove_images(map_path, [f"unwanted/{i}" for i in range(40)])
    size = map_path.stat().st_size
    compact_map(map_path)
    assert map_path.stat().st_size < size - 40 * 60_000
    after = status(pipeline, captured)
    assert (before["status"], after["status"]) == ("LOCALIZED", "LOCALIZED")
    assert after["center"] == before["center"]
    assert pipeline.reader.verify() == []


def test_a_map_of_another_model_put_in_place_is_not_taken_up(
    pipeline: Pipeline, captured: Captured, map_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    status(pipeline, captured)
    other = map_path.with_name("other.tpmap")
    with MapWriter.create(other, ModelIdentity("other", "00", 64, 512)):
        pass
    other.rename(map_path)
    for _ in range(3):
        assert status(pipeline, captured)["reason"] == "FEW_ANCHORS"
    said = [record for record in caplog.records if "going on with the map" in record.message]
    assert len(said) == 1


def test_a_session_that_the_map_does_not_have_is_an_error_at_the_start(
    demo: Demo, map_path: Path
) -> None:
    options = LocalizerOptions(exclude_sessions=("winter",))
    source = McapConfig(type="mcap", path=demo.recording)
    config = Config(map=map_path, source=source, localizer=options)
    with (
        pytest.raises(ConfigError, match="exclude_sessions has 'winter', a session that the map"),
        open_pipeline(config),
    ):
        pass


def test_a_session_that_the_map_has_no_longer_is_said_once_and_costs_nothing(
    captured: Captured,
    demo: Demo,
    map_path: Path,
    model: FeatureModel,
    survey: list[PosedImage],
    caplog: pytest.LogCaptureFixture,
) -> None:
    winter = map_path.with_name("winter.tpmap")
    build_map(winter, survey[1:], demo.folder / "survey", model, session=Session("winter"))
    source = McapConfig(type="mcap", path=demo.recording)
    options = LocalizerOptions(prefer_sessions=("winter",))
    with open_pipeline(Config(map=winter, source=source, localizer=options)) as pipeline:
        assert status(pipeline, captured)["status"] == "LOCALIZED"
        append_map(map_path, survey[1:3], demo.folder / "survey", model)
        map_path.rename(winter)
        assert "anchors" in status(pipeline, captured)
        append_map(winter, survey[3:], demo.folder / "survey", model)
        assert status(pipeline, captured)["status"] == "LOCALIZED"
    said = [record for record in caplog.records if "going on without it" in record.message]
    assert len(said) == 1


def test_a_damaged_image_of_the_map_costs_the_frames_that_need_it_alone(
    demo: Demo, survey: list[PosedImage], tmp_path: Path, model: FeatureModel, captured: Captured
) -> None:
    build_map(tmp_path / "two.tpmap", survey[:2], demo.folder / "survey", model)
    data = bytearray((tmp_path / "two.tpmap").read_bytes())
    middle = len(data) - 20_000  # within the descriptors of one of the two images
    data[middle : middle + 64] = bytes(64)
    damaged = tmp_path / "damaged.tpmap"
    damaged.write_bytes(data)
    with MapReader.open(damaged, model.identity) as reader:
        pipeline = Pipeline(Localizer(model, reader), reader, Rigid3.identity(), "map")
        failed = status(pipeline, captured)
        assert (failed["status"], failed["reason"]) == ("FAILED", "BAD_MAP")
        assert "damaged" in failed["detail"]
        black = Frame(np.zeros((480, 640), np.uint8), CAMERA)
        assert status(pipeline, Captured(black, 6))["reason"] == "TOO_DARK"


def test_a_network_that_fails_on_a_frame_costs_that_frame_alone(
    demo: Demo, survey: list[PosedImage], captured: Captured, tmp_path: Path
) -> None:
    network = FeatureModel.load(for_one_size(tmp_path / "n.onnx", CAMERA.height, CAMERA.width))
    build_map(tmp_path / "n.tpmap", survey[:1], demo.folder / "survey", network)
    small = Camera("PINHOLE", 320, 240, (230.0, 230.0, 159.5, 119.5))
    assert isinstance(captured.frame, Frame)
    halved = Frame(np.ascontiguousarray(captured.frame.image[::2, ::2]), small, time_ns=6)
    with MapReader.open(tmp_path / "n.tpmap", network.identity) as reader:
        pipeline = Pipeline(Localizer(network, reader), reader, Rigid3.identity(), "map")
        failed = status(pipeline, Captured(halved, log_time_ns=6))
        assert (failed["status"], failed["reason"]) == ("FAILED", "BAD_NETWORK")
        assert status(pipeline, captured)["status"] == "LOST"
