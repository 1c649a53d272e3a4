"""A small feature network, made here: blobs for keypoints, cosines for descriptors."""

from pathlib import Path

import cv2
import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from tests.unit.scenes import generator
from trigpoint.models.contract import METADATA_KEY, make_contract

DIM, SIZE = 24, 16


def blob_filter() -> NDArray[np.float64]:
    """Subtract a wide Gaussian from a narrow one."""
    narrow, wide = (cv2.getGaussianKernel(9, sigma) for sigma in (1.4, 2.2))
    return np.asarray(narrow @ narrow.T - wide @ wide.T, np.float64)


def cosine_filters() -> NDArray[np.float64]:
    """Take the lowest frequencies of a patch, without the mean."""
    x = (np.arange(SIZE) + 0.5) / SIZE * np.pi
    order = sorted((u + v, u, v) for u in range(SIZE) for v in range(SIZE))[1 : DIM + 1]
    window = np.exp(-(((np.arange(SIZE) - 7.5) / 5) ** 2))
    rows = [np.outer(np.cos(v * x) * window, np.cos(u * x) * window) for _, u, v in order]
    filters = np.array(rows)
    centred: NDArray[np.float64] = filters - filters.mean(axis=(1, 2), keepdims=True)
    return centred


def make_weights(explosion: float) -> dict[str, NDArray[np.float32]]:
    """The first layer parts bright from dark in four channels, which the others join again."""
    rng, signs = generator("weights"), np.array([1.0, -1.0, 0.5, -0.5])
    blobs = np.multiply.outer([1.0, -1.0, *rng.normal(0, 0.01, 6)], signs)[..., None, None]
    blobs = blobs * blob_filter()
    blobs[7] *= explosion
    last = np.zeros((1, 8, 1, 1))
    last[0, :2] = 48.0
    weights = {
        "w0": signs.reshape(4, 1, 1, 1),
        "w1": blobs,
        "w2": last,
        "b2": np.array([-4.0]),
        "w3": signs[:, None, None] * cosine_filters()[:, None],
    }
    return {name: np.asarray(weight, np.float32) for name, weight in weights.items()}


def write_network(path: Path, *, explosion: float = 1.0, contract: bool = True) -> Path:
    """Write a network, one of whose hidden channels, of no use, is as large as `explosion`."""
    nodes = [
        helper.make_node("Conv", ["image", "w0"], ["parts"]),
        helper.make_node("Relu", ["parts"], ["stem"]),
        helper.make_node("Conv", ["stem", "w1"], ["blobs"], pads=[4, 4, 4, 4]),
        helper.make_node("Relu", ["blobs"], ["both"]),
        helper.make_node("Conv", ["both", "w2", "b2"], ["score"]),
        helper.make_node("Conv", ["stem", "w3"], ["desc"], strides=[4, 4], pads=[6, 6, 6, 6]),
    ]
    graph = helper.make_graph(
        nodes,
        "small",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 1, "h", "w"])],
        [
            helper.make_tensor_value_info("score", TensorProto.FLOAT, [1, 1, "h", "w"]),
            helper.make_tensor_value_info("desc", TensorProto.FLOAT, [1, DIM, "y", "x"]),
        ],
        [numpy_helper.from_array(w, name) for name, w in make_weights(explosion).items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    if contract:
        fields = {"kind": "features", "name": "small", "descriptor_dim": DIM, "multiple_of": 8}
        fields |= {"normalization": "standardize", "long_side_px": 320, "min_score": 0.5}
        helper.set_model_props(model, {METADATA_KEY: make_contract(fields).to_json(), "by": "us"})
    onnx.save(model, path)
    return path


def texture(key: str) -> NDArray[np.uint8]:
    """Squares of many sizes."""
    rng, image = generator(key), np.full((240, 320), 120, np.uint8)
    for size in np.geomspace(80, 6, 400):
        x, y = rng.integers((-20, -20), (320, 240))
        level = int(rng.integers(20, 235))
        cv2.rectangle(image, (int(x), int(y)), (int(x + size), int(y + size)), level, -1)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8), np.uint8)
