"""A recording in, the poses of last time out. `make golden` re-records them.

The rendered flight is replayed through the daemon's own source and pipeline. On one machine a
replay is the same bit for bit (tests/daemon/test_service.py); between machines INT8 kernels round
differently, keypoints come and go, and poses differ by millimetres: hence a tolerance.
"""

from pathlib import Path

import numpy as np
import pytest

from tests.conftest import Demo
from trigpoint.frame import Localized
from trigpoint.rigid import rotation_angle
from trigpoint_db.poses import read_poses, write_poses
from trigpointd.config import Config, McapConfig
from trigpointd.pipeline import Output
from trigpointd.service import run

GOLDEN = Path(__file__).parent / "golden" / "flight.txt"
MAX_POSITION_M = 0.01
MAX_ROTATION_DEG = 0.2


class Collector:
    """A sink that keeps what it gets."""

    problem = ""

    def __init__(self) -> None:
        self.outputs: list[Output] = []

    def publish(self, output: Output) -> None:
        self.outputs.append(output)

    def close(self) -> None:
        pass


def test_the_flight_gives_the_golden_poses(demo: Demo, request: pytest.FixtureRequest) -> None:
    collector = Collector()
    source = McapConfig(type="mcap", path=demo.recording)
    totals = run(Config(map=demo.map, source=source), extra_sinks={"collector": collector})
    assert totals.num_dropped == 0
    poses = {
        str(output.time_ns): output.result.cam_from_world
        for output in collector.outputs
        if isinstance(output.result, Localized)
    }
    if request.config.getoption("--golden"):
        write_poses(GOLDEN, poses)
    golden = read_poses(GOLDEN)
    assert poses.keys() == golden.keys()
    for time_ns, pose in poses.items():
        assert np.linalg.norm(pose.center - golden[time_ns].center) < MAX_POSITION_M
        angle = np.degrees(rotation_angle(pose.R @ golden[time_ns].R.T))
        assert angle < MAX_ROTATION_DEG
