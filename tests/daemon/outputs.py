"""Outputs of a recording's frames, as sinks get them."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path

from trigpoint.database.reader import MapReader
from trigpoint.localizer import Localizer
from trigpoint.models.features import FeatureModel
from trigpoint.rigid import Rigid3
from trigpointd.pipeline import Output, Pipeline
from trigpointd.sources.mcap import McapSource

BODY_FROM_CAMERA = Rigid3.from_quaternion([0.5, -0.5, 0.5, -0.5], [0.12, 0.0, 0.03])


def localize_all(recording: Path, map_: Path, model: FeatureModel) -> list[Output]:
    """Process every frame, from a camera that looks along the body's x axis."""

    async def process() -> list[Output]:
        source = McapSource(recording)
        with MapReader.open(map_, model.identity) as reader:
            pipeline = Pipeline(Localizer(model, reader), reader, BODY_FROM_CAMERA, "map")
            async with contextlib.aclosing(source.frames()) as frames:
                outputs = [pipeline.process(captured) async for captured in frames]
        await source.close()
        return outputs

    return asyncio.run(process())
