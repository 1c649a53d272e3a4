"""Networks exported for Luxonis cameras give on plain gray values what they gave before."""

import json
import sys
import tarfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
from numpy.typing import NDArray

from tests.unit.graphs import DIM, Graph, Shape, blobs, random
from tests.unit.scenes import generator
from trigpoint.errors import ConfigError, ModelError
from trigpoint.models.contract import FeaturesContract, make_contract
from trigpoint.models.features import PROFILES, FeatureModel, Profile, packaged_model
from trigpoint.models.session import open_network
from trigpoint_db.cli import app
from trigpoint_db.export_oak import export_oak

HEIGHT, WIDTH = 96, 160
SCALE = 0.02  # of the 8-bit activations


def dense(
    path: Path, *, quantized: bool = False, size: tuple[Any, Any] = ("h", "w"), **changes: Any
) -> Path:
    """A network that depends on the standardisation: it has biases, and a ReLU between."""
    graph = Graph(image=[1, 1, *size])
    weights = random("filters", DIM, 1, 8, 8) / 20
    bias = graph.constant(np.linspace(-0.5, 0.5, DIM))
    if quantized:
        scales, codes = np.full(DIM, 0.01), np.clip(np.rint(weights / 0.01), -127, 127)
        zeros = graph.constant(np.zeros(DIM), np.int8)
        constants = graph.constant(codes, np.int8), graph.constant(scales), zeros
        weight = graph.add("DequantizeLinear", *constants, axis=0)
        step, zero = graph.constant(SCALE), graph.constant(0, np.uint8)
        cells = graph.add("Conv", "image", weight, bias, strides=[8, 8])
        coded = graph.add("QuantizeLinear", cells, step, zero)
        cells = graph.add("DequantizeLinear", coded, step, zero)
    else:
        cells = graph.add("Conv", "image", graph.constant(weights), bias, strides=[8, 8])
        cells = graph.add("Relu", cells)
    outputs: dict[str, tuple[str, Shape]] = {
        "score": (blobs(graph, "image"), [1, 1, "h", "w"]),
        "desc": (cells, [1, DIM, "rows", "columns"]),
        "global": (graph.add("Flatten", graph.add("GlobalAveragePool", cells)), [1, DIM]),
    }
    fields: dict[str, Any] = {
        "kind": "features", "name": "dense", "descriptor_dim": DIM, "global_dim": DIM,
        "multiple_of": 32, "normalization": "standardize", "min_score": 0.05,
    }  # fmt: skip
    return graph.save(path, outputs, metadata=make_contract(fields | changes).to_json())


def texture(contrast: float) -> NDArray[np.uint8]:
    noise = cv2.GaussianBlur(generator("texture").normal(size=(HEIGHT, WIDTH)), (0, 0), 2)
    return np.asarray(np.clip(100 + contrast * noise / noise.std(), 0, 255), np.uint8)


def unpack(archive: Path) -> Path:
    with tarfile.open(archive) as files:
        files.extractall(archive.parent, filter="data")
    return archive.parent / "network.onnx"


def run(model: Path, values: NDArray[np.float32]) -> dict[str, NDArray[Any]]:
    return open_network(model, FeaturesContract, 1).run({"image": values[None, None]})


def export(model: Path) -> Path:
    out = model.with_suffix(".tar.xz")
    export_oak(model, out, height=HEIGHT, width=WIDTH)
    return out


@pytest.mark.parametrize(
    ("normalization", "contrast"),  # of 4 at the least, standardising takes it to one
    [("standardize", 40), ("standardize", 2), ("unit", 40), ("raw", 40)],
)
def test_features_are_those_of_the_network_it_came_from(
    tmp_path: Path, normalization: str, contrast: float
) -> None:
    model = dense(tmp_path / "m.onnx", normalization=normalization, min_score=1e-3)
    original, exported = FeatureModel.load(model), FeatureModel.load(unpack(export(model)))
    assert exported.network.contract.normalization == "raw"
    image = texture(contrast)
    expected, found = original.extract(image), exported.extract(image)
    assert len(expected) > 20
    np.testing.assert_allclose(found.keypoints, expected.keypoints, atol=0.01)
    np.testing.assert_allclose(found.descriptors, expected.descriptors, atol=1e-4)
    np.testing.assert_allclose(found.global_descriptor, expected.global_descriptor, atol=1e-4)


def test_a_blank_image_gives_numbers(tmp_path: Path) -> None:
    path = unpack(export(dense(tmp_path / "m.onnx")))
    for level in (0, 255):
        outputs = run(path, np.full((HEIGHT, WIDTH), level, np.float32))
        assert all(np.isfinite(value).all() for value in outputs.values())


def test_a_quantised_network_becomes_float_and_keeps_its_clipping(tmp_path: Path) -> None:
    model = dense(tmp_path / "m.onnx", quantized=True)
    path = unpack(export(model))
    kinds = {node.op_type for node in onnx.load(path).graph.node}
    assert not {kind for kind in kinds if "Quantize" in kind or "quantize" in kind}
    image = texture(40)
    standard = ((image - image.mean()) / image.std()).clip(-4, 4).astype(np.float32)
    before, after = run(model, standard)["desc"], run(path, image.astype(np.float32))["desc"]
    np.testing.assert_allclose(after, before, atol=0.51 * SCALE)
    assert before.min() == after.min() == 0  # where there was no ReLU, but a range


@pytest.mark.parametrize("profile", PROFILES)
def test_the_networks_in_the_box_can_be_exported(tmp_path: Path, profile: Profile) -> None:
    config = export_oak(packaged_model(profile), tmp_path / "a.tar.xz", height=96, width=128)
    outputs = {entry["name"]: entry["shape"] for entry in config["model"]["outputs"]}
    assert outputs["score"] == [1, 1, 96, 128]
    assert outputs["global"] == [1, 256]


def test_the_same_network_gives_the_same_archive(tmp_path: Path) -> None:
    model = dense(tmp_path / "m.onnx")
    assert export(model).read_bytes() == export(model).read_bytes()


def test_depthai_reads_the_archive(tmp_path: Path) -> None:
    dai = pytest.importorskip("depthai", reason="depthai is not installed (extra `oak`)")
    out = export(dense(tmp_path / "m.onnx"))
    archive = dai.NNArchive(str(out))
    assert archive.getInputSize() == (WIDTH, HEIGHT)
    assert bytes(archive.getOtherModelFormat()) == unpack(out).read_bytes()
    model = archive.getConfigV1().model
    assert model.inputs[0].name == "image"
    assert getattr(dai.ImgFrame.Type, model.inputs[0].preprocessing.daiType).name == "GRAY8"
    assert {output.name: list(output.shape) for output in model.outputs} == {
        "score": [1, 1, HEIGHT, WIDTH],
        "desc": [1, DIM, HEIGHT // 8, WIDTH // 8],
        "global": [1, DIM],
    }


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"multiple_of": 64}, "are multiples of 64; 160 x 96 is not"),
        ({"size": (480, 640)}, r"\[1, 1, 480, 640\]; 160 x 96 does not fit"),
    ],
)
def test_a_size_that_does_not_fit_is_refused(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ModelError, match=message):
        export(dense(tmp_path / "m.onnx", **changes))


def test_colours_are_refused(tmp_path: Path) -> None:
    graph = Graph(image=[1, 3, "h", "w"])
    contract = FeaturesContract(name="colours", descriptor_dim=DIM, channels=3)
    filters = graph.constant(random("colours", DIM + 1, 3, 1, 1))
    parts = graph.constant([1, DIM], np.int64)
    score, desc = graph.add(
        "Split", graph.add("Conv", "image", filters), parts, num_outputs=2, axis=1
    )
    outputs: dict[str, tuple[str, Shape]] = {
        "score": (score, [1, 1, "h", "w"]), "desc": (desc, [1, DIM, "h", "w"]),
    }  # fmt: skip
    with pytest.raises(ModelError, match="only a network with one gray channel"):
        export(graph.save(tmp_path / "m.onnx", outputs, metadata=contract.to_json()))


def test_outputs_of_unknown_size_are_refused(tmp_path: Path) -> None:
    graph = Graph(image=[1, 1, "h", "w"])
    score = blobs(graph, "image")
    some = graph.add("NonZero", graph.add("Relu", score))
    desc = graph.add("Unsqueeze", graph.add("Cast", some, to=1), graph.integers(0, 3))
    contract = FeaturesContract(name="some", descriptor_dim=4, multiple_of=32)
    outputs: dict[str, tuple[str, Shape]] = {
        "score": (score, [1, 1, "h", "w"]), "desc": (desc, [1, 4, "n", 1]),
    }  # fmt: skip
    with pytest.raises(ModelError, match="'desc' has no fixed size"):
        export(graph.save(tmp_path / "m.onnx", outputs, metadata=contract.to_json()))


def test_names_of_other_files_are_refused(tmp_path: Path) -> None:
    model = dense(tmp_path / "m.onnx")
    with pytest.raises(ConfigError, match=r"an archive's name ends in \.tar\.xz"):
        export_oak(model, tmp_path / "out.zip", height=HEIGHT, width=WIDTH)
    with pytest.raises(ConfigError, match="there is no folder"):
        export_oak(model, tmp_path / "no" / "out.tar.xz", height=HEIGHT, width=WIDTH)
    with pytest.raises(ModelError, match="no such model file"):
        export(tmp_path / "missing.onnx")


def test_the_command_says_what_it_wrote(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.tar.xz"
    model = dense(tmp_path / "m.onnx")
    size = ["--height", str(HEIGHT), "--width", str(WIDTH)]
    app(["export-oak", str(model), str(out), *size, "--json"], standalone_mode=False)
    said = json.loads(capsys.readouterr().out)
    with tarfile.open(out) as files:
        written = files.extractfile("config.json")
        assert written is not None
        assert said == {"archive": str(out), "config": json.load(written)}


def test_without_onnx_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = dense(tmp_path / "m.onnx")
    monkeypatch.setitem(sys.modules, "onnx", None)
    monkeypatch.delitem(sys.modules, "trigpoint_db.export_oak")
    with pytest.raises(ConfigError, match=r"pip install 'trigpoint\[quantize\]'"):
        app(["export-oak", str(model), str(tmp_path / "o.tar.xz")], standalone_mode=False)
