"""Small networks in the layouts that others export, written node by node."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import ArrayLike
from onnx import TensorProto, helper, numpy_helper

from tests.unit.scenes import generator
from trigpoint.models.contract import METADATA_KEY, FeaturesContract

DIM = 16  # of the descriptors
NUM_KEYPOINTS = 300
NUM_GLOBAL = 12

Shape = list[int | str]


class Graph:
    """A network in the making; `add` names what a node gives."""

    def __init__(self, **inputs: Shape) -> None:
        self._nodes: list[onnx.NodeProto] = []
        self._constants: list[onnx.TensorProto] = []
        self._inputs = inputs

    def constant(self, values: ArrayLike, kind: type = np.float32) -> str:
        name = f"constant{len(self._constants)}"
        self._constants.append(numpy_helper.from_array(np.asarray(values, kind), name))
        return name

    def integers(self, *values: int) -> str:
        return self.constant(values, np.int64)

    def hidden(self, values: ArrayLike) -> str:
        """A constant of whose shape nobody can tell before the network runs."""
        array = np.asarray(values, np.float32)
        zero = self.add("ReduceMin", self.add("Shape", "image"))  # of a batch of one: 1
        zero = self.add("Sub", zero, self.constant(1, np.int64))
        shape = self.add("Add", self.integers(*array.shape), zero)
        return str(self.add("Reshape", self.constant(array.ravel()), shape))

    def add(self, operator: str, *inputs: str, num_outputs: int = 1, **attributes: Any) -> Any:
        names = [f"{operator}{len(self._nodes)}_{i}" for i in range(num_outputs)]
        self._nodes.append(helper.make_node(operator, inputs, names, **attributes))
        return names[0] if num_outputs == 1 else names

    def save(
        self,
        path: Path,
        outputs: dict[str, tuple[str, Shape]],
        *,
        metadata: str | None = None,
        integers: tuple[str, ...] = (),
        input_type: int = TensorProto.FLOAT,
    ) -> Path:
        """Write a file; `outputs` maps names to what `add` returned and to declared shapes."""
        for name, (value, _) in outputs.items():
            self._nodes.append(helper.make_node("Identity", [value], [name]))
        graph = helper.make_graph(
            self._nodes,
            "graph",
            [helper.make_tensor_value_info(n, input_type, s) for n, s in self._inputs.items()],
            [
                helper.make_tensor_value_info(
                    name, TensorProto.INT64 if name in integers else TensorProto.FLOAT, shape
                )
                for name, (_, shape) in outputs.items()
            ],
            self._constants,
        )
        model = helper.make_model(graph, ir_version=8, opset_imports=[helper.make_opsetid("", 17)])
        if metadata is not None:
            helper.set_model_props(model, {METADATA_KEY: metadata})
        onnx.save(model, path)
        return path


def random(key: str, *shape: int) -> Any:
    return generator(key).normal(size=shape).astype(np.float32)


def gray(graph: Graph, image: str) -> str:
    return str(graph.add("ReduceMean", image, axes=[1]))


def blobs(graph: Graph, gray_image: str) -> str:
    """Score (1, 1, H, W): how much brighter a spot of 3 px is than what is around it."""
    v, u = np.mgrid[-4:5, -4:5]
    center, around = (np.exp(-(u**2 + v**2) / (2 * s**2)) for s in (1.5, 2.5))
    kernel = center / center.sum() - around / around.sum()
    kernels = graph.constant(kernel[None, None])
    return str(graph.add("Conv", gray_image, kernels, pads=[4, 4, 4, 4]))


def sparse_features(graph: Graph, image: str) -> tuple[str, str, str, str]:
    """Keypoints x and y (1, N) int64, scores (1, N) and descriptors (1, D, N)."""
    plain = gray(graph, image)
    score = blobs(graph, plain)
    highest = graph.add("MaxPool", score, kernel_shape=[5, 5], pads=[2, 2, 2, 2])
    peaks = graph.add("Where", graph.add("Equal", score, highest), score, graph.constant(0.0))
    flat = graph.add("Reshape", peaks, graph.integers(1, -1))
    scores, index = graph.add("TopK", flat, graph.integers(NUM_KEYPOINTS), num_outputs=2)
    width = graph.add("Gather", graph.add("Shape", image), graph.integers(3))
    x, y = graph.add("Mod", index, width), graph.add("Div", index, width)
    filters = graph.constant(random("filters", DIM, 1, 9, 9))
    dense = graph.add("Conv", plain, filters, pads=[4, 4, 4, 4])
    dense = graph.add("Reshape", dense, graph.integers(1, DIM, -1))
    index = graph.add("Reshape", index, graph.integers(-1))
    return x, y, scores, graph.add("Gather", dense, index, axis=2)


def stack(graph: Graph, x: str, y: str) -> str:
    """Put x and y (1, N) together to (1, N, 2)."""
    last = graph.integers(2)
    columns = [graph.add("Unsqueeze", value, last) for value in (x, y)]
    return str(graph.add("Concat", *columns, axis=2))


def superpoint_like(path: Path) -> Path:
    """As LightGlue-ONNX exports it: gray, int64 keypoints, a batch of one."""
    graph = Graph(image=[1, 1, "height", "width"])
    x, y, scores, descriptors = sparse_features(graph, "image")
    turned = graph.add("Transpose", descriptors, perm=[0, 2, 1])
    outputs: dict[str, tuple[str, Shape]] = {
        "keypoints": (stack(graph, x, y), [1, "num_keypoints", 2]),
        "scores": (scores, [1, "num_keypoints"]),
        "descriptors": (turned, [1, "num_keypoints", DIM]),
    }
    return graph.save(path, outputs, integers=("keypoints",))


def aliked_like(path: Path, height: int, width: int) -> Path:
    """As aliked-tensorrt exports it: colour, one size, keypoints of -1 to 1, no batch."""
    graph = Graph(image=[1, 3, height, width])
    x, y, scores, descriptors = sparse_features(graph, "image")
    points = graph.add("Cast", stack(graph, x, y), to=TensorProto.FLOAT)
    last = graph.constant([[[width - 1, height - 1]]])
    scaled = graph.add("Mul", graph.add("Div", points, last), graph.constant(2.0))
    outputs: dict[str, tuple[str, Shape]] = {
        "keypoints": (
            graph.add("Squeeze", graph.add("Sub", scaled, graph.constant(1.0)), graph.integers(0)),
            [NUM_KEYPOINTS, 2],
        ),
        "descriptors": (
            graph.add("Transpose", graph.add("Squeeze", descriptors, graph.integers(0))),
            [NUM_KEYPOINTS, DIM],
        ),
        "scores": (graph.add("Squeeze", scores, graph.integers(0)), [NUM_KEYPOINTS]),
    }
    return graph.save(path, outputs)


def xfeat_like(path: Path) -> Path:
    """As XFeat-ONNX exports it: `images`, no batch, and here with descriptors (1, D, N)."""
    graph = Graph(images=[1, "channel", "height", "width"])
    x, y, scores, descriptors = sparse_features(graph, "images")
    points = graph.add("Cast", stack(graph, x, y), to=TensorProto.FLOAT)
    outputs: dict[str, tuple[str, Shape]] = {
        "kpts": (graph.add("Squeeze", points, graph.integers(0)), ["num_keypoints", 2]),
        "desc": (descriptors, [1, DIM, "num_keypoints"]),
        "scores": (graph.add("Squeeze", scores, graph.integers(0)), ["num_keypoints"]),
    }
    return graph.save(path, outputs)


def edgepoint2_like(path: Path, *, metadata: str | None = None, with_global: bool = False) -> Path:
    """Dense: a score for each pixel, descriptors for cells of 8, normalised inside."""
    graph = Graph(image=[1, 1, "height", "width"])
    one, zero = graph.constant([1.0]), graph.constant([0.0])
    plain = graph.add("InstanceNormalization", "image", one, zero)
    filters = graph.constant(random("cells", DIM, 1, 8, 8))
    desc = graph.add("Conv", plain, filters, strides=[8, 8])
    outputs: dict[str, tuple[str, Shape]] = {
        "desc": (desc, [1, DIM, "rows", "columns"]),
        "score": (blobs(graph, plain), [1, 1, "height", "width"]),
    }
    if with_global:
        outputs["global"] = (
            graph.add("Flatten", graph.add("GlobalAveragePool", graph.add("Relu", desc))),
            [1, DIM],
        )
    return graph.save(path, outputs, metadata=metadata)


def for_one_size(path: Path, height: int, width: int) -> Path:
    """Dense, with a global descriptor and its contract; fails on images of any other size."""
    graph = Graph(image=[1, 1, "height", "width"])
    score = graph.add("Reshape", "image", graph.integers(1, 1, height, width))
    filters = graph.constant(random("one size", DIM, 1, 8, 8))
    desc = graph.add("Conv", "image", filters, strides=[8, 8])
    pooled = graph.add("Flatten", graph.add("GlobalAveragePool", graph.add("Relu", desc)))
    outputs: dict[str, tuple[str, Shape]] = {
        "score": (score, [1, 1, "height", "width"]),
        "desc": (desc, [1, DIM, "rows", "columns"]),
        "global": (pooled, [1, DIM]),
    }
    contract = FeaturesContract(name="one size", descriptor_dim=DIM, global_dim=DIM, multiple_of=8)
    return graph.save(path, outputs, metadata=contract.to_json())


def hangs_on_white(path: Path) -> Path:
    """Dense, with a global descriptor; never returns where the first pixel is white."""
    graph = Graph(image=[1, 1, "height", "width"])
    flat = graph.add("Reshape", "image", graph.integers(-1))
    is_white = graph.add("Floor", graph.add("Gather", flat, graph.constant(0, np.int64)))
    forever = graph.constant(2**62, np.int64)
    num_turns = graph.add("Mul", graph.add("Cast", is_white, to=TensorProto.INT64), forever)
    kinds = {"turn": TensorProto.INT64, "goes_on": TensorProto.BOOL, "zero": TensorProto.FLOAT}
    inputs = [helper.make_tensor_value_info(name, kind, []) for name, kind in kinds.items()]
    outputs = [
        helper.make_tensor_value_info(f"{name}_", kinds[name], []) for name in ("goes_on", "zero")
    ]
    nodes = [helper.make_node("Identity", [value.name[:-1]], [value.name]) for value in outputs]
    body = helper.make_graph(nodes, "turn", inputs, outputs)
    zero = graph.add(
        "Loop", num_turns, graph.constant(True, np.bool_), graph.constant(0.0), body=body
    )
    filters = graph.constant(random("hangs", DIM, 1, 8, 8))
    desc = graph.add("Conv", "image", filters, strides=[8, 8])
    pooled = graph.add("Flatten", graph.add("GlobalAveragePool", graph.add("Relu", desc)))
    outputs_of_network: dict[str, tuple[str, Shape]] = {
        "score": (graph.add("Add", "image", zero), [1, 1, "height", "width"]),
        "desc": (desc, [1, DIM, "rows", "columns"]),
        "global": (pooled, [1, DIM]),
    }
    contract = FeaturesContract(name="hangs", descriptor_dim=DIM, global_dim=DIM, multiple_of=8)
    return graph.save(path, outputs_of_network, metadata=contract.to_json())


def eigenplaces_like(path: Path, height: int = 320, width: int = 320) -> Path:
    """Retrieval: an image of ImageNet's normalisation and of one size to a vector."""
    graph = Graph(img=[1, 3, height, width])
    filters = graph.constant(random("places", NUM_GLOBAL, 3, 16, 16))
    maps = graph.add("Relu", graph.add("Conv", "img", filters, strides=[16, 16]))
    pooled = graph.add("Flatten", graph.add("GlobalAveragePool", maps))
    return graph.save(path, {"des": (pooled, [1, NUM_GLOBAL])})


def matcher_graph(dim: int = DIM) -> Graph:
    return Graph(
        kpts0=[1, "num_keypoints0", 2],
        kpts1=[1, "num_keypoints1", 2],
        desc0=[1, "num_keypoints0", dim],
        desc1=[1, "num_keypoints1", dim],
    )


def mutual_matcher(path: Path, form: str, *, dim: int = DIM, by: str = "desc") -> Path:
    """LightGlue's tensors about mutual nearest neighbours, of `desc` or of `kpts`.

    The form of the matches: "(P, 2)", "(1, P, 2)", "(P, 3)" or "(1, N)".
    """
    graph = matcher_graph(dim)
    turned = graph.add("Transpose", f"{by}1", perm=[0, 2, 1])
    similarity = graph.add("MatMul", f"{by}0", turned)  # (1, N, M)
    if by == "kpts":  # 2 p q - p p - q q is the distance, squared and negative
        similarity = graph.add("Mul", similarity, graph.constant(2.0))
        for points, axis in (("kpts0", 2), (turned, 1)):
            squares = graph.add("Mul", points, points)
            lengths = graph.add("ReduceSum", squares, graph.integers(axis))
            similarity = graph.add("Sub", similarity, lengths)
    table = graph.add("Squeeze", similarity, graph.integers(0))
    best = graph.add("ReduceMax", table, axes=[1])
    nearest = graph.add("ArgMax", table, axis=1, keepdims=0)
    back = graph.add("ArgMax", table, axis=0, keepdims=0)
    length = graph.add("Squeeze", graph.add("Shape", nearest), graph.integers(0))
    zero, one = graph.constant(0, np.int64), graph.constant(1, np.int64)
    indices = graph.add("Range", zero, length, one)
    mutual = graph.add("Equal", graph.add("Gather", back, nearest), indices)
    best = graph.add("Squeeze", best, graph.integers(1))
    if form == "(1, N)":
        none = graph.constant(-1, np.int64)
        outputs: dict[str, tuple[str, Shape]] = {
            "matches": (
                graph.add(
                    "Unsqueeze", graph.add("Where", mutual, nearest, none), graph.integers(0)
                ),
                [1, "num_keypoints0"],
            ),
            "scores": (graph.add("Unsqueeze", best, graph.integers(0)), [1, "num_keypoints0"]),
        }
        return graph.save(path, outputs, integers=("matches",))
    query = graph.add("Compress", indices, mutual)
    sides = [graph.add("Unsqueeze", query, graph.integers(1))]
    sides.append(graph.add("Unsqueeze", graph.add("Gather", nearest, query), graph.integers(1)))
    if form == "(P, 3)":
        sides.insert(0, graph.add("Sub", sides[0], sides[0]))
    pairs = graph.add("Concat", *sides, axis=1)
    shape: Shape = ["num_matches", len(sides)]
    if form == "(1, P, 2)":
        pairs, shape = graph.add("Unsqueeze", pairs, graph.integers(0)), [1, *shape]
    outputs = {
        "matches": (pairs, shape),
        "scores": (graph.add("Gather", best, query), ["num_matches"]),
    }
    return graph.save(path, outputs, integers=("matches",))


def constant_matcher(
    path: Path, pairs: list[list[int]], scores: list[float], metadata: str | None = None
) -> Path:
    """Gives the same matches for everything."""
    graph = matcher_graph()
    outputs: dict[str, tuple[str, Shape]] = {
        "matches": (graph.constant(pairs, np.int64), ["num_matches", 2]),
        "scores": (graph.constant(scores), ["num_scores"]),
    }
    return graph.save(path, outputs, integers=("matches",), metadata=metadata)


def failing_matcher(path: Path, dim: int = DIM, metadata: str | None = None) -> Path:
    """Loads, but no input is of the shape it wants."""
    graph = matcher_graph(dim)
    scores = graph.add("Reshape", "desc0", graph.integers(7, 11, 13))
    pairs = graph.constant(np.zeros((0, 2)), np.int64)
    outputs: dict[str, tuple[str, Shape]] = {
        "matches": (pairs, ["num_matches", 2]),
        "scores": (graph.add("Reshape", scores, graph.integers(-1)), ["num_scores"]),
    }
    return graph.save(path, outputs, integers=("matches",), metadata=metadata)
