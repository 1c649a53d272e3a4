"""ONNX sessions that keep their contract.

A network is one file with the contract in its metadata, so that another network is a file and a
config line away.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from trigpoint.errors import ModelError
from trigpoint.models.contract import (
    METADATA_KEY,
    Contract,
    FeaturesContract,
    MatcherContract,
    RetrievalContract,
    Shape,
    Shapes,
    read_contract,
)

C = TypeVar("C", FeaturesContract, RetrievalContract, MatcherContract)


@dataclass(frozen=True, eq=False)
class Network(Generic[C]):
    """A network whose tensors go by the contract's names."""

    path: Path
    contract: C
    session: ort.InferenceSession

    def declared(self, name: str) -> list[int | str | None]:
        """Return the shape that the file declares for a tensor; empty where it does not tell."""
        nodes = [*self.session.get_inputs(), *self.session.get_outputs()]
        shapes = {node.name: node.shape for node in nodes}
        return list(shapes[self.contract.tensor(name)])

    def run(self, inputs: Mapping[str, NDArray[np.float32]]) -> dict[str, NDArray[Any]]:
        """Run it once; the outputs have shapes of the contract."""
        contract = self.contract
        shapes = contract.outputs
        try:
            values = self.session.run(
                [contract.tensor(name) for name in shapes],
                {contract.tensor(name): value for name, value in inputs.items()},
            )
        except Exception as error:  # onnxruntime's errors share no narrower base
            reason = str(error).splitlines()[0]
            raise ModelError(f"the network {contract.name!r} cannot run: {reason}") from error
        outputs = dict(zip(shapes, values, strict=True))
        for name, value in outputs.items():
            if not _fits(value.shape, shapes[name]):
                raise ModelError(
                    f"the network {contract.name!r} gave {contract.tensor(name)!r} of shape "
                    f"{value.shape}; {_expected(shapes[name])}"
                )
        return outputs


def open_network(path: Path, kind: type[C], num_threads: int) -> Network[C]:
    """Load a network of a kind and check that it keeps its contract."""
    if not path.is_file():
        raise ModelError(f"no such model file: {path}")
    try:
        session = open_session(path, num_threads)
    except Exception as error:  # onnxruntime's errors share no narrower base
        reason = str(error).splitlines()[0]
        raise ModelError(f"{path} is not a network that onnxruntime can load: {reason}") from error
    try:
        contract = _read_contract(session, kind)
        _check_inputs(session, contract)
        _check_shapes(session.get_outputs(), contract, contract.outputs, "output")
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error
    return Network(path, contract, session)


def open_session(path: Path, num_threads: int) -> ort.InferenceSession:
    """Load a graph, with or without a contract."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = num_threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 4  # what goes wrong is raised
    # Spinning threads would burn the cores that geometry needs between two frames.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def _read_contract(session: ort.InferenceSession, kind: type[C]) -> C:
    metadata = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
    if metadata is None:
        raise ModelError(
            f"it has no {METADATA_KEY!r} metadata; `trigpoint-db adapt` writes it (docs/models.md)"
        )
    contract = read_contract(metadata)
    if not isinstance(contract, kind):
        wanted = kind.model_fields["kind"].default
        raise ModelError(f"it is of kind {contract.kind!r}, where {wanted!r} is needed")
    return contract


def _check_inputs(session: ort.InferenceSession, contract: Contract) -> None:
    nodes = session.get_inputs()
    _check_shapes(nodes, contract, contract.inputs, "input")
    known = [contract.tensor(name) for name in contract.inputs]
    for node in nodes:
        if node.name not in known:
            raise ModelError(f"it wants an input {node.name!r} beside {', '.join(known)}")
        if node.type != "tensor(float)":
            raise ModelError(f"its input {node.name!r} is a {node.type}; export it in float32")


def _check_shapes(nodes: list[Any], contract: Contract, expected: Shapes, what: str) -> None:
    shapes = {node.name: node.shape for node in nodes}
    for name, alternatives in expected.items():
        tensor = contract.tensor(name)
        if tensor not in shapes:
            raise ModelError(
                f"it has no {what} {tensor!r}, but {', '.join(sorted(shapes))}; "
                f"`names` in its contract may say which of these is {name!r}"
            )
        if shapes[tensor] and not _fits(shapes[tensor], alternatives):
            raise ModelError(
                f"its {what} {tensor!r} is of shape {_format(shapes[tensor])}; "
                f"{_expected(alternatives)}"
            )


def _fits(shape: Any, alternatives: tuple[Shape, ...]) -> bool:
    """Say whether a shape is one of several; a dimension of no known size is of any."""
    return any(
        len(shape) == len(wanted)
        and all(
            size == want or want is None or not isinstance(size, int)
            for size, want in zip(shape, wanted, strict=True)
        )
        for wanted in alternatives
    )


def _expected(alternatives: tuple[Shape, ...]) -> str:
    return f"by its contract it is {' or '.join(_format(shape) for shape in alternatives)}"


def _format(shape: Any) -> str:
    sizes = ", ".join("any" if size is None else str(size) for size in shape)
    return f"({sizes},)" if len(shape) == 1 else f"({sizes})"


def hash_files(*paths: Path) -> str:
    """SHA-256 over the contents of files, in order."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()
