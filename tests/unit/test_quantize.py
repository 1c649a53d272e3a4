"""Quantisation of a small network, which harmless or broken ranges show."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from tests.unit.graphs import Graph
from tests.unit.scenes import generator
from tests.unit.small_network import texture, write_network
from trigpoint.errors import TrigpointError
from trigpoint.models.contract import METADATA_KEY, make_contract
from trigpoint.models.local import FeatureNetwork
from trigpoint_db.quantize import (
    Comparison,
    QuantizationOptions,
    QuantizationReport,
    Score,
    quantize,
)
from trigpoint_db.quantize.accuracy import Agreement, compare
from trigpoint_db.quantize.calibration import Distribution
from trigpoint_db.quantize.graph import FloatNetwork, open_session
from trigpoint_db.quantize.network import make_input

# Few pairs are noisy; the networks here either lose next to nothing or everything.
QUICK = QuantizationOptions(max_loss=0.1, num_warped=24, num_rendered=0, max_images=12, num_runs=3)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("images")
    for i in range(12):
        cv2.imwrite(str(folder / f"{i:02}.png"), texture(f"quantize {i}"))
    return sorted(folder.iterdir())


def properties(path: Path) -> dict[str, str]:
    return {entry.key: entry.value for entry in onnx.load(path).metadata_props}


@pytest.mark.slow
def test_a_harmless_quantisation_is_kept(images: list[Path], tmp_path: Path) -> None:
    model, out = write_network(tmp_path / "m.onnx"), tmp_path / "m.int8.onnx"
    report = quantize(model, images, out, options=QUICK)
    assert report.refusal is None
    assert report.comparison.agreement.cosine > 0.98
    assert out.stat().st_size < model.stat().st_size
    assert properties(out) == properties(model)
    onnx.checker.check_model(onnx.load(out))
    image = texture("another")
    before, after = (FeatureNetwork.load(path).extract(image, 300) for path in (model, out))
    assert compare([before], [after]).repeatability > 0.5


def test_a_quantisation_that_breaks_the_network_is_refused(
    images: list[Path], tmp_path: Path
) -> None:
    model, out = write_network(tmp_path / "m.onnx", explosion=1e5), tmp_path / "m.int8.onnx"
    report = quantize(model, images, out, options=replace(QUICK, keep_float=False))
    assert report.float_layers == ("parts",)
    assert report.refusal is not None
    assert "matching score" in report.refusal
    assert [path.name for path in tmp_path.iterdir()] == ["m.onnx"]


@pytest.mark.slow
def test_layers_that_break_the_network_stay_float(images: list[Path], tmp_path: Path) -> None:
    model, out = write_network(tmp_path / "m.onnx", explosion=1e5), tmp_path / "m.int8.onnx"
    report = quantize(model, images, out, options=QUICK)
    assert report.refusal is None
    assert set(report.float_layers) == {"parts", "blobs", "score"}
    assert out.stat().st_size < model.stat().st_size


@pytest.mark.slow
def test_the_same_input_gives_the_same_file(images: list[Path], tmp_path: Path) -> None:
    """In processes of their own: hashes of strings differ between these."""
    model = write_network(tmp_path / "m.onnx", explosion=1e5)
    script = (
        "import sys; from pathlib import Path; from trigpoint_db.quantize import *;"
        "model, folder, out = map(Path, sys.argv[1:]);"
        "options = QuantizationOptions(max_loss=1, num_warped=8, num_rendered=0, max_images=4);"
        "quantize(model, sorted(folder.iterdir()), out, options=options)"
    )
    outs = [tmp_path / "a.onnx", tmp_path / "b.onnx"]
    for out in outs:
        arguments = map(str, (model, images[0].parent, out))
        subprocess.run([sys.executable, "-c", script, *arguments], check=True)
    assert outs[0].read_bytes() == outs[1].read_bytes()


def score(*, loss: float, noise: float = 0.001, is_gate: bool = True) -> Score:
    return Score("matching score", 120, 0.5, 0.5 * (1 - loss), loss, noise, is_gate)


def judged(*scores: Score, num_bytes: tuple[int, int] = (400, 100)) -> str | None:
    comparison = Comparison(scores, Agreement(1.0, 0.0, 1.0, None), (2.0, 1.0))
    return QuantizationReport("o.onnx", 0.02, comparison, num_bytes, 99.9, 3, ()).refusal


def test_what_loses_little_passes() -> None:
    assert judged(score(loss=0.019), score(loss=-0.05)) is None


def test_what_loses_more_than_allowed_is_refused() -> None:
    assert "loses 2.1% of fp32's matching score" in (judged(score(loss=0.021)) or "")


def test_what_too_few_pairs_tell_is_refused() -> None:
    assert "give more images" in (judged(score(loss=0.0, noise=0.03)) or "")


def test_a_score_that_is_told_only_refuses_nothing() -> None:
    assert judged(score(loss=0.5, noise=0.5, is_gate=False)) is None


def test_what_is_not_smaller_is_refused() -> None:
    assert "not fewer" in (judged(score(loss=0.0), num_bytes=(100, 100)) or "")


def test_the_noise_of_a_loss_is_that_of_paired_scores() -> None:
    rng = generator("paired")
    fp32 = rng.uniform(0.2, 1.0, 400)
    result = Score.of("s", fp32, fp32 - 0.06 + rng.normal(0, 0.03, 400))
    assert abs(result.loss - 0.1) < 0.01
    assert 0.5 < result.noise / (0.03 / 0.6 / 20) < 2  # not of the scores' spread, ten times it


def test_a_range_leaves_out_the_outermost_values() -> None:
    counts = np.zeros(2048, np.int64)
    counts[:1000], counts[-1] = 100, 10
    values = Distribution(0.0, 2048.0, counts, (1,))
    assert values.limits(100.0) == (0.0, 2048.0)
    assert values.limits(99.9)[1] == pytest.approx(1000, abs=2)


def test_a_range_always_holds_zero() -> None:
    values = Distribution(3.0, 4.0, np.ones(2048, np.int64), (1,))
    assert values.limits(99.9)[0] == 0.0


def test_images_of_different_sizes_calibrate_together(tmp_path: Path) -> None:
    model = write_network(tmp_path / "m.onnx")
    network = FeatureNetwork.load(model)
    inputs = [make_input(texture("a")[:height], network) for height in (240, 160)]
    groups = FloatNetwork(model, inputs).groups
    assert [group.nodes for group in groups] == [("blobs", "both"), ("score",), ("desc",)]


def test_a_batch_norm_is_folded_into_its_convolution(tmp_path: Path) -> None:
    path = write_network(tmp_path / "m.onnx")
    model = onnx.load(path)
    statistics = {"scale": 2.0, "shift": 0.1, "mean": 0.05, "variance": 0.5}
    for name, value in statistics.items():
        tensor = numpy_helper.from_array(np.full(8, value, np.float32), name)
        model.graph.initializer.append(tensor)
    node = helper.make_node("BatchNormalization", ["blobs", *statistics], ["normed"])
    model.graph.node.insert(3, node)
    model.graph.node[4].input[0] = "normed"
    onnx.save(model, path)
    network = FloatNetwork(path, [make_input(texture("a"), FeatureNetwork.load(path))])
    folded = onnx.load_from_string(network.quantize((), 99.9))
    assert "BatchNormalization" not in {node.op_type for node in folded.graph.node}
    (tmp_path / "folded.onnx").write_bytes(folded.SerializeToString())
    both = [FeatureNetwork.load(p).extract(texture("b")) for p in (path, tmp_path / "folded.onnx")]
    np.testing.assert_allclose(both[0].scores, both[1].scores, atol=1e-4)


def test_integer_sums_do_not_overflow_on_any_processor(tmp_path: Path) -> None:
    graph = Graph(image=[1, 8, 16, 16])
    weights = np.ones((4, 8, 3, 3))
    path = graph.save(
        tmp_path / "m.onnx",
        {"sums": (graph.add("Conv", "image", graph.constant(weights)), [1, 4, 14, 14])},
    )
    image = generator("overflow").uniform(0.8, 1.0, (1, 8, 16, 16)).astype(np.float32)
    network = FloatNetwork(path, [{"image": image}])
    quantized = network.quantize(network.groups, 100.0)
    exact, fast = (  # in float, and by the integer kernels of the processor at hand
        open_session(quantized, optimized=optimized).run(None, {"image": image})[0]
        for optimized in (False, True)
    )
    np.testing.assert_allclose(fast, exact, atol=exact.max() / 100)


def refused(model: Path, images: list[Path], **more: Path) -> str:
    out = model.with_suffix(".int8.onnx")
    with pytest.raises(TrigpointError) as caught:
        quantize(model, images, more.get("out", out), options=QUICK)
    assert not out.exists()
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_bad_models_are_refused_in_one_line(images: list[Path], tmp_path: Path) -> None:
    assert "no such model file" in refused(tmp_path / "none.onnx", images)
    bare = write_network(tmp_path / "bare.onnx", contract=False)
    assert "has no 'trigpoint' metadata" in refused(bare, images)
    (tmp_path / "text.onnx").write_text("not a network")
    assert "is not a network that onnxruntime can load" in refused(tmp_path / "text.onnx", images)


def test_bad_images_are_refused_in_one_line(images: list[Path], tmp_path: Path) -> None:
    model = write_network(tmp_path / "m.onnx")
    assert "no images" in refused(model, [])
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"not a picture")
    assert str(broken) in refused(model, [images[0], broken])
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.full((240, 320), 90, np.uint8))
    assert "matches nothing on these images" in refused(model, [blank])


def test_a_quantised_network_is_not_quantised_again(images: list[Path], tmp_path: Path) -> None:
    model = write_network(tmp_path / "m.onnx")
    network = FloatNetwork(model, [make_input(texture("a"), FeatureNetwork.load(model))])
    (tmp_path / "q.onnx").write_bytes(network.quantize(network.groups, 99.9))
    assert "is quantised already" in refused(tmp_path / "q.onnx", images)


def test_a_file_that_is_there_is_kept(images: list[Path], tmp_path: Path) -> None:
    model, out = write_network(tmp_path / "m.onnx"), tmp_path / "there.onnx"
    out.write_text("mine")
    assert "exists" in refused(model, images, out=out)
    assert out.read_text() == "mine"


def test_other_kinds_of_network_are_refused(images: list[Path], tmp_path: Path) -> None:
    path = write_network(tmp_path / "m.onnx")
    model = onnx.load(path)
    del model.metadata_props[:]
    fields = {"kind": "retrieval", "name": "r", "global_dim": 8, "height": 64, "width": 64}
    helper.set_model_props(model, {METADATA_KEY: make_contract(fields).to_json()})
    onnx.save(model, path)
    assert "it is of kind 'retrieval', where 'features' is needed" in refused(path, images)


def test_the_sparse_layout_is_refused(images: list[Path], tmp_path: Path) -> None:
    shapes = {"keypoints": (1, 5, 2), "scores": (1, 5), "descriptors": (1, 5, 8)}
    constants = [
        helper.make_node(
            "Constant", [], [name], value=numpy_helper.from_array(np.zeros(shape, np.float32))
        )
        for name, shape in shapes.items()
    ]
    graph = helper.make_graph(
        constants,
        "sparse",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 1, "h", "w"])],
        [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in shapes.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    fields = {"kind": "features", "layout": "sparse", "name": "sparse", "descriptor_dim": 8}
    helper.set_model_props(model, {METADATA_KEY: make_contract(fields).to_json()})
    onnx.save(model, tmp_path / "sparse.onnx")
    assert "only dense feature networks" in refused(tmp_path / "sparse.onnx", images)


def command(*arguments: object, before: str = "") -> tuple[int, str, str]:
    script = f"{before}\nfrom trigpoint_db.cli import main\nmain()"
    done = subprocess.run(
        [sys.executable, "-c", script, "quantize", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


@pytest.mark.slow
def test_the_command_tells_and_exits_1(images: list[Path], tmp_path: Path) -> None:
    model = write_network(tmp_path / "m.onnx", explosion=1e5)
    asked = [model, "--images", images[0].parent, "--pairs", 12, "--json"]
    code, out, err = command(*asked, "--no-float-layers")
    assert code == 1
    report = json.loads(out)
    assert err.endswith(f"m.int8.onnx is not written: {report['refusal']}\n")
    assert report["comparison"]["scores"][0]["loss"] > 0.5
    assert [path.name for path in tmp_path.iterdir()] == ["m.onnx"]


@pytest.mark.slow
def test_the_command_says_what_to_install(images: list[Path], tmp_path: Path) -> None:
    model = write_network(tmp_path / "m.onnx")
    missing = "import sys\nsys.modules['onnx'] = None"
    code, _, err = command(model, "--images", images[0].parent, before=missing)
    assert code == 1
    assert "pip install 'trigpoint[quantize]'" in err
    assert err.count("\n") == 1
