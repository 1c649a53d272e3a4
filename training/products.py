"""Write the graph that multiplies descriptors in integers: `python -m training.products`.

MatMulInteger of (N, D) by (D, M); onnxruntime is the one dependency that has a fast kernel for it.
"""

from __future__ import annotations

from pathlib import Path

import onnx
from onnx import TensorProto, helper

PATH = Path("runtime/trigpoint/models/weights/products.onnx")


def make_graph() -> onnx.ModelProto:
    """Make it: left of 8 bits with its zero at 128, right signed, products of 32 bits."""
    node = helper.make_node("MatMulInteger", ["left", "right", "zero"], ["products"])
    graph = helper.make_graph(
        [node],
        "products",
        [
            helper.make_tensor_value_info("left", TensorProto.UINT8, ["N", "D"]),
            helper.make_tensor_value_info("right", TensorProto.INT8, ["D", "M"]),
        ],
        [helper.make_tensor_value_info("products", TensorProto.INT32, ["N", "M"])],
        [helper.make_tensor("zero", TensorProto.UINT8, [], [128])],
    )
    opset = helper.make_opsetid("", 17)
    return helper.make_model(graph, opset_imports=[opset], ir_version=8, producer_name="")


if __name__ == "__main__":
    onnx.save(make_graph(), PATH)
