"""Write the contract into a network made elsewhere, which then works as ours do."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from trigpoint.errors import ConfigError, ModelError
from trigpoint.models.contract import METADATA_KEY, Contract, FeaturesContract, make_contract
from trigpoint.models.inputs import normalize
from trigpoint.models.local import FeatureNetwork
from trigpoint.models.matching import Matchable, OnnxMatcher
from trigpoint.models.retrieval import RetrievalModel
from trigpoint.output import check_output

_HEIGHT, _WIDTH = 480, 640  # px of the test image


def adapt_model(model: Path, out: Path, fields: dict[str, Any]) -> tuple[Contract, str]:
    """Copy a network with a contract of these fields, once it has been seen to keep it.

    Returns the contract, and what the network made of a test image.
    """
    contract = make_contract(fields)
    check_output(out, model)
    partial = out.with_name(f"{out.name}.{os.getpid()}.partial")
    try:
        _write(model, partial, contract)
        found = _try(partial, contract)
        partial.replace(out)
    except ModelError as error:
        raise ModelError(str(error).replace(str(partial), str(model))) from error
    finally:
        partial.unlink(missing_ok=True)
    return contract, found


def _write(model: Path, out: Path, contract: Contract) -> None:
    try:
        import onnx
    except ImportError as error:
        raise ConfigError(
            "onnx is needed to write into a network: pip install 'trigpoint[quantize]'"
        ) from error
    if not model.is_file():
        raise ModelError(f"no such model file: {model}")
    try:
        network = onnx.load(model)
    except Exception as error:  # of protobuf, and of onnx about weights in other files
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise ModelError(f"{model} is not an ONNX file: {reason}") from error
    others = {p.key: p.value for p in network.metadata_props if p.key != METADATA_KEY}
    del network.metadata_props[:]
    onnx.helper.set_model_props(network, others | {METADATA_KEY: contract.to_json()})
    onnx.save(network, out)


def _try(path: Path, contract: Contract) -> str:
    """Run a network once; say what it found."""
    if contract.kind == "retrieval":
        vector = RetrievalModel.load(path).describe(_test_image())
        return f"a vector of {len(vector)} numbers"
    if contract.kind == "features":
        return _try_features(path, contract)
    points = np.random.default_rng(0).uniform(0, (_WIDTH, _HEIGHT), (200, 2)).astype(np.float32)
    numbers = np.random.default_rng(1).normal(size=(200, contract.descriptor_dim))
    image = Matchable(points, normalize(numbers.astype(np.float32)), _WIDTH, _HEIGHT)
    matches, _ = OnnxMatcher.load(path, contract.descriptor_dim).match(image, image)
    return f"{len(matches)} matches of 200 keypoints with themselves"


def _try_features(path: Path, contract: FeaturesContract) -> str:
    keypoints = FeatureNetwork.load(path).extract(_test_image()).keypoints
    if len(keypoints) == 0:
        raise ModelError(
            f"{path} found no keypoint in a test image; is normalization "
            f"{contract.normalization!r} what it was trained with, and min_score "
            f"{contract.min_score:g} not too high?"
        )
    return f"{len(keypoints)} keypoints"


def _test_image() -> NDArray[np.uint8]:
    """Make random squares, slightly blurred: many corners."""
    squares = np.random.default_rng(0).integers(30, 220, (_HEIGHT // 16, _WIDTH // 16))
    image = cv2.resize(squares.astype(np.uint8), (_WIDTH, _HEIGHT), interpolation=cv2.INTER_NEAREST)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.uint8)
