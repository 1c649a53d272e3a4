"""What a network must say of itself, and what is checked of it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto

from tests.unit import graphs
from trigpoint.errors import ModelError
from trigpoint.models.contract import FeaturesContract, make_contract, read_contract
from trigpoint.models.local import FeatureNetwork
from trigpoint.models.retrieval import RetrievalModel
from trigpoint.models.session import open_network

OURS = FeaturesContract(
    name="ours", descriptor_dim=64, global_dim=256, normalization="standardize", multiple_of=32
)
DENSE = FeaturesContract(name="dense", descriptor_dim=graphs.DIM)


@pytest.mark.parametrize(
    "fields",
    [
        OURS.model_dump(),
        {"kind": "retrieval", "name": "a", "global_dim": 512, "height": 320, "width": 240},
        {"kind": "matcher", "name": "b", "descriptor_dim": 256, "min_score": 0.1},
    ],
)
def test_json_gives_back_the_contract(fields: dict[str, Any]) -> None:
    contract = make_contract(fields)
    assert read_contract(contract.to_json()) == contract
    assert json.loads(contract.to_json()) | fields == json.loads(contract.to_json())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vocabulary": "x.npz"}, "unknown field 'vocabulary'"),
        ({"kind": "detector"}, "needs a 'kind': 'features', 'retrieval' or 'matcher'"),
        ({"kind": None}, "needs a 'kind'"),
        ({"name": ""}, "'name': .* at least 1 character"),
        ({"layout": "list"}, "'layout': Input should be 'dense' or 'sparse'"),
        ({"descriptor_dim": 0}, "'descriptor_dim': .* greater than or equal to 1"),
        ({"descriptor_dim": "64"}, "'descriptor_dim': .* valid integer"),
        ({"descriptor_dim": True}, "'descriptor_dim': .* valid integer"),
        ({"channels": 2}, "'channels': Input should be 1 or 3"),
        ({"normalization": "whiten"}, "'normalization': Input should be 'standardize', 'unit'"),
        ({"normalization": "imagenet"}, "'imagenet' is of 3 channels"),
        ({"min_score": "low"}, "'min_score': .* valid number"),
        ({"keypoints": "centered"}, "'keypoints': Input should be 'px' or 'normalized'"),
        ({"names": {"kpts0": "a"}}, "names 'kpts0', which is none of image, score, desc, global"),
        ({"names": {"desc": 3}}, "'names.desc': .* valid string"),
    ],
)
def test_a_contract_is_strict(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message) as caught:
        read_contract(json.dumps(OURS.model_dump() | change))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"), [("{", "JSON"), ("[]", "contract"), ("1", "contract")]
)
def test_what_is_no_contract_is_an_error(text: str, message: str) -> None:
    with pytest.raises(ModelError, match=message) as caught:
        read_contract(text)
    assert "\n" not in str(caught.value)


def test_a_missing_field_is_named() -> None:
    with pytest.raises(ModelError, match="its contract lacks 'descriptor_dim'"):
        make_contract({"kind": "features", "name": "a"})


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        (None, "has no 'trigpoint' metadata; `trigpoint-db adapt` writes it"),
        ("{}", "needs a 'kind'"),
        (DENSE.model_copy(update={"descriptor_dim": 64}).to_json(),
         r"output 'desc' is of shape \(1, 16, rows, columns\); by its contract it is \(1, 64, any"),
        (DENSE.model_copy(update={"channels": 3}).to_json(), r"input 'image' is of shape \(1, 1,"),
        (DENSE.model_copy(update={"global_dim": 9}).to_json(), "no output 'global', but desc, sco"),
        (DENSE.model_copy(update={"names": {"image": "img"}}).to_json(), "no input 'img', but ima"),
        (DENSE.model_copy(update={"layout": "sparse"}).to_json(), "no output 'keypoints'"),
    ],
)  # fmt: skip
def test_a_network_that_breaks_its_contract_is_refused(
    tmp_path: Path, metadata: str | None, message: str
) -> None:
    path = graphs.edgepoint2_like(tmp_path / "broken.onnx", metadata=metadata)
    with pytest.raises(ModelError, match=message) as caught:
        open_network(path, FeaturesContract, 1)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def save(path: Path, contract: FeaturesContract, *, rows: int, extra: bool, half: bool) -> Path:
    """Maps of zeros, the scores of so many rows."""
    inputs: dict[str, graphs.Shape] = {"image": [1, 1, "height", "width"]}
    if extra:
        inputs["mask"] = [1, 1]
    graph = graphs.Graph(**inputs)
    outputs: dict[str, tuple[str, graphs.Shape]] = {
        "score": (graph.hidden(np.zeros((1, 1, rows, 64))), [1, 1, "a", "b"]),
        "desc": (graph.hidden(np.zeros((1, graphs.DIM, 8, 8))), [1, "dim", "c", "d"]),
    }
    kind = TensorProto.FLOAT16 if half else TensorProto.FLOAT
    return graph.save(path, outputs, metadata=contract.to_json(), input_type=kind)


def test_inputs_that_nobody_can_give_are_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "a.onnx", DENSE, rows=64, extra=True, half=False)
    with pytest.raises(ModelError, match="wants an input 'mask' beside image"):
        open_network(path, FeaturesContract, 1)
    path = save(tmp_path / "b.onnx", DENSE, rows=64, extra=False, half=True)
    with pytest.raises(ModelError, match=r"'image' is a tensor\(float16\); export it in float32"):
        open_network(path, FeaturesContract, 1)


def test_shapes_that_the_file_does_not_tell_are_checked_when_it_runs(tmp_path: Path) -> None:
    image = np.zeros((64, 64), np.uint8)
    path = save(tmp_path / "a.onnx", DENSE, rows=8, extra=False, half=False)
    with pytest.raises(ModelError, match=r"scores of shape \(8, 64\) for an image of shape \(64"):
        FeatureNetwork.load(path).extract(image)
    other = DENSE.model_copy(update={"descriptor_dim": 32})
    path = save(tmp_path / "b.onnx", other, rows=64, extra=False, half=False)
    with pytest.raises(ModelError, match=r"gave 'desc' of shape \(1, 16, 8, 8\); by its contract"):
        FeatureNetwork.load(path).extract(image)


def test_a_retrieval_network_takes_the_size_it_says(tmp_path: Path) -> None:
    graphs.eigenplaces_like(tmp_path / "plain.onnx")
    fields = {
        "kind": "retrieval", "name": "places", "global_dim": graphs.NUM_GLOBAL,
        "height": 224, "width": 224, "names": {"image": "img", "global": "des"},
    }  # fmt: skip
    path = tmp_path / "places.onnx"
    graph = graphs.Graph(img=[1, 3, 320, 320])
    vector = graph.constant(np.ones((1, graphs.NUM_GLOBAL)))
    graph.save(
        path,
        {"des": (vector, [1, graphs.NUM_GLOBAL])},
        metadata=make_contract(fields).to_json(),
    )
    with pytest.raises(ModelError, match=r"'img' is of shape \(1, 3, 320, 320\); .* \(1, 3, 224"):
        RetrievalModel.load(path)
