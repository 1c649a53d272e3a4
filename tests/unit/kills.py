"""Processes killed at random moments while they change a map.

A process adds and removes images, merges the map with another one and compacts it, again and again,
and says before and after each change what it does. After its death the map has to hold exactly what
was said to be done, and of the change in work all or nothing; all the while, a reader has the map
open as a daemon has.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import random
import signal
import time
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from tests.unit.maps import MODEL, add, make_features, make_map, make_pose
from trigpoint.database.reader import MapReader
from trigpoint.database.replacing import compact_map
from trigpoint.database.writer import MapWriter
from trigpoint.frame import restore_descriptors
from trigpoint_db.maps import merge_maps, remove_images

MAX_LIFE_S = 0.15
NUM_IMAGES = 60
OTHERS = range(1000, 1020)  # of the map to merge with


def kill_often(folder: Path, times: int, seed: int = 0) -> Counter[str]:
    """Kill so many processes, check the map after each; return what they were killed at."""
    path, rng = make_map(folder / "m.tpmap", NUM_IMAGES // 2), random.Random(seed)
    with MapWriter.create(folder / "other.tpmap", MODEL) as writer:
        for index in OTHERS:
            add(writer, index)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.unit.kills"])
    killed_at: Counter[str] = Counter()
    images = set(range(NUM_IMAGES // 2))
    with MapReader.open(path) as reader:
        for number in range(times):
            said, saying = context.Pipe(duplex=False)
            process = context.Process(target=change_forever, args=(folder, number, saying))
            process.start()
            saying.close()
            said.recv()  # it has begun
            time.sleep(rng.uniform(0, MAX_LIFE_S))
            process.kill()
            process.join()
            assert process.exitcode == -signal.SIGKILL  # not of itself
            done, in_work = listen(said)
            require_images(reader, images)  # as they were before all that
            images = follow(images, done)
            # A commit whose end its writer did not live to note shows when the next one comes.
            MapWriter.open(path, MODEL).close()
            reader.refresh()
            if len(reader) != len(images):
                images = follow(images, [in_work])
            require_images(reader, images)
            require_merged(folder / "merged.tpmap")
            killed_at[in_work.split()[0] if in_work else "nothing"] += 1
    compact_map(path)
    (folder / "merged.tpmap").unlink(missing_ok=True)
    merge_maps(path, folder / "other.tpmap", folder / "merged.tpmap")
    left = {p.name.removesuffix("-lock") for p in folder.iterdir()}
    assert left <= {"m.tpmap", "other.tpmap", "merged.tpmap"}, left
    return killed_at


def change_forever(folder: Path, seed: int, saying: Connection) -> None:
    """Change the map until killed."""
    path, out, rng = folder / "m.tpmap", folder / "merged.tpmap", random.Random(seed)
    with MapReader.open(path) as reader:
        images = {int(Path(name).stem) for name in reader.names()}
    saying.send("ready")
    while True:
        index, kind = rng.randrange(NUM_IMAGES), rng.choice(["image", "image", "merge", "compact"])
        if kind == "image" and index in images:
            saying.send(f"remove {index}")
            remove_images(path, [f"folder/{index}.png"])
            images.remove(index)
        elif kind == "image":
            saying.send(f"add {index}")
            with MapWriter.open(path, MODEL) as writer:
                add(writer, index)
            images.add(index)
        elif kind == "merge":
            out.unlink(missing_ok=True)
            saying.send("merge")
            merge_maps(path, folder / "other.tpmap", out)
        else:
            saying.send("compact")
            compact_map(path)
        saying.send("done")


def listen(said: Connection) -> tuple[list[str], str]:
    """Return the changes that were done and the one that was in work, "" for none."""
    words: list[str] = []
    with contextlib.suppress(EOFError), said:
        while True:
            words.append(said.recv())
    begun = [word for word in words if word != "done"]
    num_done = len(words) - len(begun)
    assert len(begun) - num_done in (0, 1)
    return begun[:num_done], (begun[num_done:] or [""])[0]


def follow(images: set[int], changes: list[str]) -> set[int]:
    """Return the images after changes."""
    images = set(images)
    for change in changes:
        kind, _, index = change.partition(" ")
        if kind == "add":
            images.add(int(index))
        elif kind == "remove":
            images.remove(int(index))
    return images


def require_images(reader: MapReader, images: set[int]) -> None:
    """The map is whole and holds these images, each as it was added."""
    assert reader.verify() == []
    names = reader.names()
    assert sorted(names) == sorted(f"folder/{index}.png" for index in images)
    for place, name in enumerate(names):
        index = int(Path(name).stem)
        anchor, features = reader.anchor(place), make_features(index)
        np.testing.assert_allclose(anchor.cam_from_world.t, make_pose(index).t, rtol=1e-12)
        np.testing.assert_allclose(anchor.keypoints, features.keypoints, atol=0.01)
        np.testing.assert_allclose(
            restore_descriptors(anchor.descriptors), features.descriptors, atol=0.02
        )
        (found,), _ = reader.search(features.global_descriptor, 1)
        assert found == place


def require_merged(path: Path) -> None:
    """A merged map is whole, or not there."""
    if path.exists():
        with MapReader.open(path) as reader:
            images = {int(Path(name).stem) for name in reader.names()}
            assert set(OTHERS) < images
            require_images(reader, images)
