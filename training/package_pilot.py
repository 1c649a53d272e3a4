"""Write the contract into the pilot network's metadata and put it into the package.

    python training/package_pilot.py PILOT_DIR

PILOT_DIR holds pilot.int8.onnx and pilot.vlad.npz.
"""

import shutil
import sys
from pathlib import Path

import onnx

from trigpoint.models.session import METADATA_KEY, Contract

WEIGHTS = Path(__file__).parent.parent / "runtime" / "trigpoint" / "models" / "weights"
CONTRACT = Contract(
    name="pilot",
    descriptor_dim=64,
    multiple_of=32,
    long_side_px=640,
    normalization="standardize",
    min_score=-2.0,
    vocabulary="pilot.vlad.npz",
)


def main() -> None:
    """Copy the files of the folder given, with the contract."""
    source = Path(sys.argv[1])
    model = onnx.load(source / "pilot.int8.onnx")
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, {METADATA_KEY: CONTRACT.to_json()})
    onnx.save(model, WEIGHTS / "pilot.int8.onnx")
    shutil.copyfile(source / "pilot.vlad.npz", WEIGHTS / "pilot.vlad.npz")


if __name__ == "__main__":
    main()
