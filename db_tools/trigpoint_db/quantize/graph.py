"""The network's graph: what of it can be 8-bit, in which groups, and at what price it is not.

onnxruntime's quantiser writes the file: in QDQ form, a QuantizeLinear and a DequantizeLinear around
all that is 8-bit, from which the runtime makes integer kernels.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime as ort

from trigpoint.errors import ConfigError, ModelError
from trigpoint_db.quantize.calibration import Distribution, Inputs, calibrate

try:
    import onnx
    from onnxruntime import quantization as ortq
    from onnxruntime.quantization.calibrate import TensorsData
    from onnxruntime.quantization.qdq_quantizer import QDQQuantizer
except ImportError as error:
    raise ConfigError(
        "quantising needs onnx; install it with: pip install 'trigpoint[quantize]'"
    ) from error

MIN_OPSET = 13  # the first with a scale for each channel

# Layers with weights and layers that join others start a group; what follows one belongs to it.
_WEIGHTED = ("Conv", "ConvTranspose", "Gemm", "MatMul")
_JOINING = ("Add", "Concat")
_FOLLOWING = ("AveragePool", "Clip", "DepthToSpace", "MaxPool", "Relu", "Reshape", "Resize")
# onnxruntime's integer kernels are slower than float on less (an image, of one channel or three).
_MIN_CHANNELS = 4
_NUMBER_COST = 64  # multiplications in whose time a number is written and read again


@dataclass(frozen=True)
class Group:
    """Layers that are 8-bit or float together; `cost` of float is in multiplications.

    By count and not by the clock, so that the same input gives the same output.
    """

    name: str
    nodes: tuple[str, ...]
    cost: float


class FloatNetwork:
    """A network as it came, prepared for quantisation and run once on the calibration images."""

    def __init__(self, path: Path, inputs: Sequence[Inputs]) -> None:
        original = _load(path)
        self.num_bytes = original.ByteSize()
        self._properties = {entry.key: entry.value for entry in original.metadata_props}
        self._model = _prepare(original)
        self._nodes = {node.name: node for node in self._model.graph.node}
        self._weights = {w.name: w for w in self._model.graph.initializer}
        self._distributions = self._observe(inputs)
        self.groups = tuple(
            Group(name, tuple(nodes), sum(map(self._cost, nodes)))
            for name, nodes in self._members().items()
        )
        self.always_float = tuple(n for n, node in self._nodes.items() if self._is_narrow(node))

    def _observe(self, inputs: Sequence[Inputs]) -> dict[str, Distribution]:
        model = onnx.ModelProto()
        model.CopyFrom(self._model)
        outputs = {output.name for output in model.graph.output}
        floats = onnx.TensorProto.FLOAT
        for value in self._model.graph.value_info:
            if value.type.tensor_type.elem_type == floats and value.name not in outputs:
                model.graph.output.append(value)
        return calibrate(open_session(model.SerializeToString(), optimized=False), inputs)

    def _members(self) -> dict[str, list[str]]:
        members: dict[str, list[str]] = {}
        group_of: dict[str, str] = {}  # of each tensor
        for name, node in self._nodes.items():
            if self._is_narrow(node):
                continue
            weighted = node.op_type in _WEIGHTED and node.input[1] in self._weights
            if weighted or node.op_type in _JOINING:
                group = name
            elif node.op_type in _FOLLOWING and node.input[0] in group_of:
                group = group_of[node.input[0]]
            else:
                continue
            members.setdefault(group, []).append(name)
            group_of.update(dict.fromkeys(node.output, group))
        return members

    def _is_narrow(self, node: onnx.NodeProto) -> bool:
        channels = self._shape(node.input[0])[1:2] if node.op_type == "Conv" else ()
        return bool(channels) and channels[0] < _MIN_CHANNELS

    def _cost(self, name: str) -> float:
        node = self._nodes[name]
        out = self._shape(node.output[0])
        numbers = np.prod(out)
        multiplications = 0.0
        if node.op_type in _WEIGHTED:
            size = np.prod(self._weights[node.input[1]].dims)
            if node.op_type == "Conv":
                places = out[2:]
            elif node.op_type == "ConvTranspose":
                places = self._shape(node.input[0])[2:]
            else:
                places = out[:-1]
            numbers += size
            multiplications = size * np.prod(places)
        return float(multiplications + _NUMBER_COST * numbers)

    def _shape(self, tensor: str) -> tuple[int, ...]:
        known = self._distributions.get(tensor)
        return () if known is None else known.shape

    def quantize(self, groups: Iterable[Group], percentile: float) -> bytes:
        """Return an ONNX file in which these groups are 8-bit and all else is float."""
        model = onnx.ModelProto()
        model.CopyFrom(self._model)
        nodes = [node for group in groups for node in group.nodes]
        if nodes:  # the quantiser takes none for all
            model = _quantize(model, nodes, self._ranges(percentile))
        del model.metadata_props[:]
        onnx.helper.set_model_props(model, self._properties)
        return bytes(model.SerializeToString(deterministic=True))

    def _ranges(self, percentile: float) -> TensorsData:
        ranges = {
            name: tuple(np.array(limit, np.float32) for limit in known.limits(percentile))
            for name, known in self._distributions.items()
        }
        return TensorsData(ortq.CalibrationMethod.MinMax, ranges)


def _quantize(model: onnx.ModelProto, nodes: list[str], ranges: TensorsData) -> onnx.ModelProto:
    quantizer = QDQQuantizer(
        model,
        per_channel=True,
        # Weights of 7 bits: x86 without VNNI sums two products in 16 bits, which 8 overflow.
        reduce_range=True,
        weight_qType=ortq.QuantType.QInt8,
        activation_qType=ortq.QuantType.QUInt8,
        tensors_range=ranges,
        nodes_to_quantize=nodes,
        nodes_to_exclude=[],
        op_types_to_quantize=[*_WEIGHTED, *_JOINING, *_FOLLOWING],
        extra_options={"ActivationSymmetric": False, "WeightSymmetric": True},
    )
    quantizer.quantize_model()
    quantizer.model.topological_sort()
    quantized: onnx.ModelProto = quantizer.model.model
    return quantized


def _load(path: Path) -> onnx.ModelProto:
    try:
        model = onnx.load(path)
    except Exception as error:  # protobuf's errors share no narrower base
        raise ModelError(f"{path} is not an ONNX file: {error}") from error
    kinds = {node.op_type for node in model.graph.node}
    if any("QuantizeLinear" in kind or "Integer" in kind or "QLinear" in kind for kind in kinds):
        raise ModelError(f"{path} is quantised already; give the float network it was made from")
    opset = max(entry.version for entry in model.opset_import if entry.domain in ("", "ai.onnx"))
    if opset < MIN_OPSET:
        raise ModelError(f"{path} has opset {opset}; export it with {MIN_OPSET} or newer")
    return model


def _prepare(model: onnx.ModelProto) -> onnx.ModelProto:
    """Fold constants and batch norms into the layers before them, infer types, name all nodes."""
    with tempfile.TemporaryDirectory() as folder:
        folded = Path(folder) / "folded.onnx"
        options = _options()
        options.optimized_model_filepath = str(folded)
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_BASIC
        ort.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
        prepared = onnx.shape_inference.infer_shapes(onnx.load(folded))
    for node in prepared.graph.node:
        node.name = node.output[0]  # names of nodes need not be there, or differ
    return prepared


def _options() -> ort.SessionOptions:
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return options


def open_session(network: bytes, *, optimized: bool = True) -> ort.InferenceSession:
    """Open an ONNX file's bytes on one thread."""
    options = _options()
    if not optimized:
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
    return ort.InferenceSession(network, options, providers=["CPUExecutionProvider"])
