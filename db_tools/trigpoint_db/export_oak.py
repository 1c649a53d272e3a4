"""A feature network for Luxonis cameras, as an NN Archive: what their converter takes.

On a device nobody scales or standardises an image. So the exported network takes gray values 0 to
255 of one size and standardises in the graph. It is all float, for the converter makes numbers of
the device's own kind. docs/oak.md says where the archive goes from here.
"""

from __future__ import annotations

import io
import json
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import ConfigError, ModelError
from trigpoint.models.contract import METADATA_KEY, FeaturesContract
from trigpoint.models.session import open_network
from trigpoint.output import check_output

try:
    import onnx
    from onnx import compose, helper, numpy_helper, parser, shape_inference
except ImportError as error:
    raise ConfigError(
        "export-oak needs onnx; install it with: pip install 'trigpoint[quantize]'"
    ) from error

SUFFIX = ".tar.xz"
NETWORK = "network.onnx"  # in the archive
LAYOUTS = {2: "NC", 4: "NCHW"}

_FRONT = """<ir_version: {ir}, opset_import: ["": {opset}]>
front (float[1, 1, {height}, {width}] image) => (float[1, 1, {height}, {width}] normalized)"""
# A device has 16-bit floats, and these hold no sum above 65504: so gray values are made small
# before they are squared, and means are taken of rows first.
_STEPS = {
    "standardize": """<float unit = {{64}}, float least = {{0.0625}}, float low = {{-4}},
        float high = {{4}}> {{
        scaled = Div (image, unit)
        row_means = AveragePool <kernel_shape = [1, {width}]> (scaled)
        mean = AveragePool <kernel_shape = [{height}, 1]> (row_means)
        centered = Sub (scaled, mean)
        squared = Mul (centered, centered)
        row_variances = AveragePool <kernel_shape = [1, {width}]> (squared)
        variance = AveragePool <kernel_shape = [{height}, 1]> (row_variances)
        deviation = Sqrt (variance)
        divisor = Max (deviation, least)
        standard = Div (centered, divisor)
        normalized = Clip (standard, low, high) }}""",
    "unit": "<float unit = {{255}}> {{ normalized = Div (image, unit) }}",
    "raw": "{{ normalized = Identity (image) }}",
}


def export_oak(model: Path, out: Path, *, height: int, width: int) -> dict[str, Any]:
    """Write a gray, dense feature network as an NN Archive; return the archive's config."""
    if not out.name.endswith(SUFFIX):
        raise ConfigError(f"cannot write {out}: an archive's name ends in {SUFFIX}")
    check_output(out, model)
    opened = open_network(model, FeaturesContract, num_threads=1)
    try:
        _check(opened.contract, opened.declared("image"), height, width)
        network = onnx.load(model)
        _unfold_8bit(network.graph)
        network = _fix_input(network, opened.contract, height, width)
        config = _describe(network.graph, opened.contract.name)
    except ModelError as error:
        raise ModelError(f"{model}: {error}") from error
    except KeyError as error:
        raise ModelError(
            f"{model}: {error} is of 8 bits in a way unknown here; take the float32 network"
        ) from error
    _write(out, {NETWORK: network.SerializeToString(), "config.json": json.dumps(config).encode()})
    return config


def _check(contract: FeaturesContract, declared: list[Any], height: int, width: int) -> None:
    if contract.layout != "dense" or contract.channels != 1:
        raise ModelError("only a network with one gray channel and dense outputs can be exported")
    step = contract.multiple_of
    if height % step or width % step:
        raise ModelError(f"width and height are multiples of {step}; {width} x {height} is not")
    for size, wanted in zip(declared[2:], (height, width), strict=True):
        if isinstance(size, int) and size != wanted:
            raise ModelError(f"its input is of shape {declared}; {width} x {height} does not fit")


def _unfold_8bit(graph: onnx.GraphProto) -> None:
    """Make a quantised network float: weights as they are read, activations only clipped.

    Clipped, because the quantiser drops a ReLU where the 8-bit range starts at zero anyway.
    """
    constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    floats = {n.output[0]: n.input[0] for n in graph.node if n.op_type == "QuantizeLinear"}
    nodes = []
    for node in graph.node:
        if node.op_type == "DequantizeLinear":
            source, result = node.input[0], node.output[0]
            scale, *zeros = (constants[name] for name in node.input[1:])
            zero = zeros[0] if zeros else np.zeros(scale.shape, np.uint8)
            axis = next((a.i for a in node.attribute if a.name == "axis"), 1)
            if source in constants:
                weights = {result: constants[source]}
            else:
                ends = np.iinfo(zero.dtype)
                weights = {
                    f"{result}/low": np.array(ends.min),
                    f"{result}/high": np.array(ends.max),
                }
                inputs = [floats[source], *weights]
                nodes.append(helper.make_node("Clip", inputs, [result], node.name))
            for name, values in weights.items():
                unfolded = _dequantize(values, scale, zero, axis)
                graph.initializer.append(numpy_helper.from_array(unfolded, name))
        elif node.op_type != "QuantizeLinear":
            nodes.append(node)
    del graph.node[:]
    graph.node.extend(nodes)
    used = {name for node in nodes for name in node.input}
    kept = [tensor for tensor in graph.initializer if tensor.name in used]
    del graph.initializer[:]
    graph.initializer.extend(kept)


def _dequantize(
    values: NDArray[Any], scale: NDArray[np.float32], zero: NDArray[Any], axis: int
) -> NDArray[np.float32]:
    """(values - zero) scale; of an array of scales, each is of one index on an axis."""
    shape = [-1 if i == axis else 1 for i in range(values.ndim)] if scale.size > 1 else []
    offset = zero.astype(np.float32).reshape(shape)
    return np.asarray((values.astype(np.float32) - offset) * scale.reshape(shape), np.float32)


def _fix_input(
    network: onnx.ModelProto, contract: FeaturesContract, height: int, width: int
) -> onnx.ModelProto:
    """Put the normalisation in front, for images of one size, and infer the outputs' sizes."""
    opset = next(entry.version for entry in network.opset_import if entry.domain in ("", "ai.onnx"))
    # The quantiser names domains of which nothing is used, and they cannot be joined.
    del network.opset_import[:], network.metadata_props[:], network.graph.value_info[:]
    network.opset_import.append(helper.make_opsetid("", opset))
    network = compose.add_prefix(network, "network/", rename_outputs=False)
    text = _FRONT + _STEPS[contract.normalization]
    text = text.format(ir=network.ir_version, opset=opset, height=height, width=width)
    front = parser.parse_model(text)
    io_map = [("normalized", network.graph.input[0].name)]
    try:
        network = compose.merge_models(front, network, io_map=io_map)
        for value in network.graph.output:
            value.type.tensor_type.ClearField("shape")
        network = shape_inference.infer_shapes(network, strict_mode=True, data_prop=True)
    except Exception as error:  # onnx's errors share no narrower base
        reason = str(error).splitlines()[0]
        raise ModelError(f"it cannot be made {width} x {height}: {reason}") from error
    names = {name: file for name, file in contract.names.items() if name != "image"}
    exported = contract.model_copy(update={"normalization": "raw", "names": names})
    helper.set_model_props(network, {METADATA_KEY: exported.to_json()})
    return network


def _describe(graph: onnx.GraphProto, name: str) -> dict[str, Any]:
    """Return an NN Archive's config, of version 1.0."""
    image = {"dai_type": "GRAY8", "mean": [0.0], "scale": [1.0]}
    inputs = [
        _tensor(value) | {"input_type": "image", "preprocessing": image} for value in graph.input
    ]
    metadata = {"name": name, "path": NETWORK, "precision": "float32"}
    outputs = [_tensor(value) for value in graph.output]
    model = {"metadata": metadata, "inputs": inputs, "outputs": outputs}
    return {"config_version": "1.0", "model": model}


def _tensor(value: onnx.ValueInfoProto) -> dict[str, Any]:
    shape = [dim.dim_value for dim in value.type.tensor_type.shape.dim]
    if 0 in shape or len(shape) not in LAYOUTS:
        raise ModelError(f"its tensor {value.name!r} has no fixed size, as a device needs it")
    return {"name": value.name, "dtype": "float32", "shape": shape, "layout": LAYOUTS[len(shape)]}


def _write(out: Path, files: dict[str, bytes]) -> None:
    """Write a compressed tar file; the same input gives the same bytes."""
    with tarfile.open(out, "w:xz") as archive:
        for name, data in files.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))
