"""Make the packaged files of a trained profile: ONNX, with the global head, and INT8.

    python -m training.export base --checkpoint CHECKPOINT --corpus DIR --out OUT

Writes OUT/base.fp32.onnx; `trigpoint-db quantize` makes the packaged file of it.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

import numpy as np
import onnx
import torch
from torch import Tensor, nn

from training.corpus import load_corpus
from training.network import DESCRIPTOR_DIM, PROFILES, STRIDE, Network
from training.retrieval import GLOBAL_DIM, GlobalHead, learn_head
from trigpoint.models.contract import METADATA_KEY, FeaturesContract

MIN_SCORE = -1.8  # a logit; what is seen in noise and on blank walls lies below


class Exported(nn.Module):
    """The network with its global head, as one graph."""

    def __init__(self, network: Network, head: GlobalHead) -> None:
        super().__init__()
        self.network, self.head = network, head

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return score, desc and global."""
        score, fused = self.network.look(image)
        return score, self.network.desc(fused), self.head(fused)


def fold_sums(network: Network) -> None:
    """Fold the batch norms that follow sums of convolutions into these.

    Those that follow a single convolution are folded by the exporter.
    """
    for norm_and_more, first, others in (
        (network.fused, network.fuse8, (network.fuse4, network.fuse16, network.fuse32)),
        (network.detected, network.detect4, (network.detect8,)),
    ):
        norm = norm_and_more[0]
        gain = (norm.weight / (norm.running_var + norm.eps).sqrt()).detach()
        for convolution in (first, *others):
            convolution.weight.data *= gain[:, None, None, None]
        first.bias.data = (first.bias.data - norm.running_mean) * gain + norm.bias.data
        norm_and_more[0] = nn.Identity()


def export_onnx(module: nn.Module, path: Path) -> None:
    """Write the graph, for images of any size that the strides divide."""
    shapes = {
        "image": {2: "height", 3: "width"},
        "score": {2: "height", 3: "width"},
        "desc": {2: "rows", 3: "columns"},
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            module.eval(),
            (torch.zeros(1, 1, 15 * STRIDE, 20 * STRIDE),),
            path,
            opset_version=17,
            input_names=["image"],
            output_names=["score", "desc", "global"],
            dynamic_axes=shapes,
            dynamo=False,
        )


def compress_whitening(path: Path, contract: FeaturesContract) -> None:
    """Keep the whitening in 8 bits, a scale for each row, and write the contract.

    It is the largest tensor of the file by far, and its product stays in float.
    """
    model = onnx.load(path)
    graph = model.graph
    weight = next(w for w in graph.initializer if w.name.endswith("whiten.weight"))
    values = onnx.numpy_helper.to_array(weight)
    scale = np.abs(values).max(axis=1) / 127
    rows = np.rint(values / scale[:, None]).astype(np.int8)
    tensors = {"whitening": rows, "whitening_scale": scale.astype(np.float32)}
    tensors["whitening_zero"] = np.zeros(len(scale), np.int8)
    graph.initializer.remove(weight)
    graph.initializer.extend(onnx.numpy_helper.from_array(v, k) for k, v in tensors.items())
    unpack = onnx.helper.make_node("DequantizeLinear", list(tensors), [weight.name], axis=0)
    graph.node.insert(0, unpack)
    onnx.helper.set_model_props(model, {METADATA_KEY: contract.to_json()})
    onnx.checker.check_model(model)
    onnx.save(model, path)


def main() -> None:
    """Export as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("profile", choices=PROFILES)
    for name in ("checkpoint", "corpus", "out"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    network = Network(PROFILES[arguments.profile]).to(memory_format=torch.channels_last)
    network.load_state_dict(torch.load(arguments.checkpoint, "cpu")["network"])
    fold_sums(network.eval())
    head = learn_head(network, *load_corpus(arguments.corpus), seed=arguments.seed)
    contract = FeaturesContract(
        name=arguments.profile,
        normalization="standardize",
        descriptor_dim=DESCRIPTOR_DIM,
        global_dim=GLOBAL_DIM,
        multiple_of=STRIDE,
        min_score=MIN_SCORE,
    )
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / f"{arguments.profile}.fp32.onnx"
    export_onnx(Exported(network, head), path)
    compress_whitening(path, contract)


if __name__ == "__main__":
    main()
