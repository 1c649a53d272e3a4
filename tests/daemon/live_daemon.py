"""`trigpointd run` with a camera of 100 frames a second that shows one picture: PICTURE CONFIG."""

import logging
import sys
from pathlib import Path

from tests.daemon.zenoh_daemon import Camera
from trigpointd import service
from trigpointd.config import Config, load_config


def open_camera(config: Config) -> Camera:
    return Camera(Path(sys.argv[1]))


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, stream=sys.stderr)
    service.open_source = open_camera  # type: ignore[assignment]
    service.run(load_config(Path(sys.argv[2])))
