"""ONNX sessions and the contract that a feature network keeps.

A network is one file with the contract in its metadata, so that another network is a file and a
config line away. The metadata property `trigpoint` is a JSON object with the fields of `Contract`.

    input   image  (1, 1, H, W) float32   gray, H and W multiples of `multiple_of`
    output  score  (1, 1, H, W) float32   keypoint logits
    output  desc   (1, D, H/s, W/s) float32   descriptors, need not be normalised; s divides H and W
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import onnxruntime as ort

from trigpoint.errors import ModelError

METADATA_KEY = "trigpoint"
INPUT, SCORE, DESCRIPTORS = "image", "score", "desc"


@dataclass(frozen=True)
class Contract:
    """What a feature network wants of its input and says of its outputs."""

    name: str
    descriptor_dim: int
    multiple_of: int  # H and W of the input
    long_side_px: int  # larger images are scaled down to this
    normalization: (
        str  # "standardize" ((x - mean) / max(std, 4), clipped to +-4) or "unit" (x / 255)
    )
    min_score: float  # logit below which a peak is no keypoint
    vocabulary: str  # file name of the retrieval vocabulary beside the network

    def __post_init__(self) -> None:
        texts = (self.name, self.vocabulary)
        counts = (self.descriptor_dim, self.multiple_of, self.long_side_px)
        if not (
            all(isinstance(text, str) and text for text in texts)
            and all(isinstance(count, int) and 1 <= count <= 65_536 for count in counts)
            and isinstance(self.min_score, int | float)
            and Path(self.vocabulary).name == self.vocabulary
        ):
            raise ModelError(f"the contract {self} is not one that docs/models.md describes")
        if self.normalization not in ("standardize", "unit"):
            raise ModelError(
                f"normalization {self.normalization!r} is not known; use 'standardize' or 'unit'"
            )

    def to_json(self) -> str:
        """Write the metadata property."""
        return json.dumps(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Contract:
        """Read the metadata property."""
        try:
            return cls(**json.loads(text))
        except (TypeError, ValueError) as error:
            raise ModelError(f"its metadata is not this version's contract: {error}") from error


def open_session(path: Path, num_threads: int) -> tuple[ort.InferenceSession, Contract]:
    """Load a network and check that it keeps the contract."""
    if not path.is_file():
        raise ModelError(f"no such model file: {path}")
    options = ort.SessionOptions()
    options.intra_op_num_threads = num_threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    # Spinning threads would burn the cores that geometry needs between two frames.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors share no narrower base
        reason = str(error).splitlines()[0]
        raise ModelError(f"{path} is not a network that onnxruntime can load: {reason}") from error
    return session, _check(session, path)


def _check(session: ort.InferenceSession, path: Path) -> Contract:
    metadata = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
    if metadata is None:
        raise ModelError(
            f"{path} has no {METADATA_KEY!r} metadata; docs/models.md tells how to add it"
        )
    inputs = {node.name: node.shape for node in session.get_inputs()}
    outputs = {node.name: node.shape for node in session.get_outputs()}
    if set(inputs) != {INPUT} or not {SCORE, DESCRIPTORS} <= set(outputs):
        raise ModelError(
            f"{path} maps {sorted(inputs)} to {sorted(outputs)}; "
            f"the contract is {INPUT!r} to {SCORE!r} and {DESCRIPTORS!r}"
        )
    try:
        contract = Contract.from_json(metadata)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error
    for name, channels in ((SCORE, 1), (DESCRIPTORS, contract.descriptor_dim)):
        if len(outputs[name]) != 4 or outputs[name][1] != channels:
            raise ModelError(
                f"{path} gives {name!r} of shape {outputs[name]}; "
                f"by its metadata it is (1, {channels}, height, width)"
            )
    return contract


def hash_files(*paths: Path) -> str:
    """SHA-256 over the contents of files, in order."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()
