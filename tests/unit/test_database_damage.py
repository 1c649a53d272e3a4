"""Files that are no maps, or no longer. Run as a program, this file reads damaged maps."""

import os
import re
import struct
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import lmdb
import numpy as np
import pytest

from tests.unit.maps import MODEL, add, make_features, make_map, require_image
from trigpoint.database import schema
from trigpoint.database.reader import MapReader
from trigpoint.database.rows import Row, encode_block, quantize_row
from trigpoint.database.writer import MapWriter
from trigpoint.errors import DatabaseError

PAGE_BYTES = 4096


def write_foreign(path: Path, name: bytes | None) -> None:
    """Make an LMDB file of another program, with or without a named database."""
    with lmdb.open(str(path), subdir=False, max_dbs=1, lib_version=0) as environment:
        database = environment.open_db(name)
        with environment.begin(write=True, db=database) as txn:
            txn.put(b"key", b"value")


def alter_entry(path: Path, key: bytes, payload: bytes | None) -> None:
    """Replace or delete an entry, with a checksum that is right."""
    with (
        lmdb.open(str(path), subdir=False, lib_version=0) as environment,
        environment.begin(write=True) as txn,
    ):
        if payload is None:
            txn.delete(key)
        else:
            txn.put(key, schema.seal(key, payload))


def alter_byte(path: Path, found_by: bytes) -> None:
    """Flip one bit of each place where these bytes lie in the file: some are of no use any more."""
    octets = path.read_bytes()
    places = [match.start() for match in re.finditer(re.escape(found_by), octets)]
    assert places
    with path.open("r+b") as file:  # in place, under readers that have it open
        for place in places:
            file.seek(place)
            file.write(bytes([octets[place] ^ 1]))


def stored_keypoints(index: int) -> bytes:
    """The last ten keypoints of an image of `add`, as they lie in the file."""
    px = make_features(index).keypoints[-10:].astype(np.float64)
    return np.rint((px + 0.5) * 65_535 / 640).astype("<u2").tobytes()


NO_MAPS: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.touch(),
    "text": lambda path: path.write_text("points3D\n" * 9000),
    "short": lambda path: path.write_bytes(b"\0" * 100),
    "noise": lambda path: path.write_bytes(np.random.default_rng(1).bytes(50_000)),
    "jpeg": lambda path: path.write_bytes(
        cv2.imencode(".jpg", np.eye(200, dtype=np.uint8))[1].tobytes()
    ),
    "foreign": lambda path: write_foreign(path, None),
    "foreign, named": lambda path: write_foreign(path, b"images"),
}


@pytest.mark.parametrize("kind", NO_MAPS)
def test_what_is_no_map_is_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a.tpmap"
    NO_MAPS[kind](path)
    before = path.read_bytes()
    for use in (MapReader.open, lambda path: MapWriter.open(path, MODEL)):
        with pytest.raises(DatabaseError, match=r"a\.tpmap: not a Trigpoint map") as caught:
            use(path)
        assert "\n" not in str(caught.value)
    assert path.read_bytes() == before


def test_a_path_without_a_file_says_what_to_do(tmp_path: Path) -> None:
    for use in (MapReader.open, lambda path: MapWriter.open(path, MODEL)):
        with pytest.raises(DatabaseError, match=r"no such map: .*b\.tpmap; `trigpoint-db build`"):
            use(tmp_path / "b.tpmap")
    with pytest.raises(DatabaseError, match="not a regular file"):
        MapReader.open(tmp_path)
    with pytest.raises(DatabaseError, match="its folder does not exist"):
        MapWriter.create(tmp_path / "none" / "a.tpmap", MODEL)
    with pytest.raises(DatabaseError, match="exists already"):
        MapWriter.create(make_map(tmp_path / "a.tpmap", 1), MODEL)


def test_a_map_of_another_model_is_refused_and_both_are_named(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 1)
    other = replace(MODEL, name="newer", sha256="f" * 64)
    for open_ in (MapReader.open, MapWriter.open):
        with pytest.raises(DatabaseError, match=r"'test' 000.*not with .*'newer' fff.*rebuild"):
            open_(path, other)


def test_a_map_of_another_format_is_refused(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 1)
    alter_entry(path, schema.METADATA_KEY, b'{"format": 9, "shards": []}')
    with pytest.raises(DatabaseError, match="a map of format 9, and this version reads format 5"):
        MapReader.open(path)


def test_a_map_cut_short_is_refused_wherever_it_is_cut(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 20)
    size = path.stat().st_size
    for left in (size - 1, size - PAGE_BYTES, size // 2, 2 * PAGE_BYTES):
        os.truncate(path, left)
        with pytest.raises(DatabaseError, match=f"cut short: it should have {size} bytes"):
            MapReader.open(path)


def test_a_map_cut_short_while_open_is_an_error(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 20)
    with MapReader.open(path) as reader:
        os.truncate(path, PAGE_BYTES)
        for read in (reader.names, lambda: reader.anchor(3)):
            with pytest.raises(DatabaseError, match="cut short while open"):
                read()
        assert "cut short while open" in reader.verify()[0]


def test_a_flipped_bit_is_found_where_it_lies_and_nowhere_else(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 20)
    alter_byte(path, stored_keypoints(7))
    with MapReader.open(path) as reader:
        for _ in range(2):
            with pytest.raises(DatabaseError, match=r"image 7 is damaged: its checksum.*restore"):
                reader.anchor(7)
        assert reader.verify() == ["image 7 is damaged: its checksum does not match (folder/7.png)"]
        require_image(reader, 8)


def test_a_flipped_bit_among_the_retrieval_rows_stops_the_search(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 20)
    query = make_features(7).global_descriptor
    alter_byte(path, quantize_row(query)[1].tobytes())
    with MapReader.open(path) as reader:
        with pytest.raises(DatabaseError, match="retrieval block 0 is damaged"):
            reader.search(query, 1)
        assert reader.verify() == ["retrieval block 0 is damaged: its checksum does not match"]
        require_image(reader, 7)


def test_damage_after_a_record_was_read_is_found_by_verify(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 3)
    with MapReader.open(path) as reader:
        require_image(reader, 1)
        assert reader.verify() == []
        alter_byte(path, stored_keypoints(1))
        assert reader.verify() == ["image 1 is damaged: its checksum does not match (folder/1.png)"]


def row(session: int = 0) -> Row:
    return Row(np.float32(1), np.zeros(3, np.float32), session, np.ones(32, np.int8))


@pytest.mark.parametrize(
    ("key", "payload", "problem"),
    [
        (schema.name_key("folder/1.png"), None, "the index entry of 'folder/1.png' is missing"),
        (
            schema.name_key("folder/1.png"),
            schema.encode_index(2),
            "the name 'folder/1.png' does not lead to image 1",
        ),
        (schema.features_key(2), None, "image 2 is missing (folder/2.png)"),
        (schema.block_key(0), None, "retrieval block 0 is missing"),
        (
            schema.block_key(0),
            encode_block([row(), row()]),
            "retrieval block 0 has 2 rows, not 3",
        ),
        (
            schema.block_key(0),
            encode_block([row(), row(session=1), row()]),
            "retrieval block 0 has images of an unknown session",
        ),
        (schema.image_key(3), b"", "there are 12 entries where 11 belong"),
    ],
)
def test_verify_finds_what_does_not_fit_together(
    tmp_path: Path, key: bytes, payload: bytes | None, problem: str
) -> None:
    path = make_map(tmp_path / "a.tpmap", 3)
    alter_entry(path, key, payload)
    with MapReader.open(path) as reader:
        assert problem in reader.verify()


def test_an_image_under_the_key_of_another_is_damage(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 3)
    with (
        lmdb.open(str(path), subdir=False, lib_version=0) as environment,
        environment.begin(write=True) as txn,
    ):
        txn.put(schema.features_key(2), txn.get(schema.features_key(1), b""))
    with MapReader.open(path) as reader, pytest.raises(DatabaseError, match="image 2 is damaged"):
        reader.anchor(2)


def test_a_writer_refuses_a_map_whose_list_of_free_pages_is_damaged(tmp_path: Path) -> None:
    path = make_map(tmp_path / "a.tpmap", 3)
    octets = bytearray(path.read_bytes())
    roots = max(  # commit; roots of the free list and of the map
        struct.unpack_from("<144x Q", octets, meta)
        + struct.unpack_from("<80x Q 40x Q", octets, meta)
        for meta in (0, PAGE_BYTES)
    )
    _, free_list, tree = roots
    end = (free_list + 1) * PAGE_BYTES
    struct.pack_into("<Q", octets, end - 8, tree)  # the map's root is said to be free
    path.write_bytes(octets)
    with MapReader.open(path) as reader:
        assert reader.verify() == []
    with pytest.raises(DatabaseError, match=r"both reachable and in the freeDB.*restore"):
        MapWriter.open(path, MODEL)


@pytest.mark.parametrize(
    ("num_images", "name_bytes"),
    [(20, 30), (150, 480)],  # a tree of one page; one of three levels
)
def test_random_damage_is_reported_and_never_crashes(
    tmp_path: Path, num_images: int, name_bytes: int
) -> None:
    path = tmp_path / "a.tpmap"
    with MapWriter.create(path, MODEL) as writer:
        for index in range(num_images):
            add(writer, index, name=f"{index:0{name_bytes}}")
            if index % 8 == 7:
                writer.commit()
    reader = subprocess.run(
        [sys.executable, "-m", "tests.unit.test_database_damage", path],
        cwd=Path(__file__).parents[2],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert reader.returncode == 0, reader.stderr
    outcomes = reader.stdout.split()
    assert len(outcomes) == NUM_CASES
    assert set(outcomes) == {"refused", "found", "unharmed"}


NUM_CASES = 90


def damage(octets: bytearray, case: int) -> None:
    """Do one of six kinds of harm."""
    rng = np.random.default_rng(case)
    size = len(octets)
    tree = [
        start
        for start in range(0, size, PAGE_BYTES)
        if struct.unpack_from("<H", octets, start + 10)[0] in (1, 2)  # branches and leaves
    ]
    start, page = int(rng.integers(size)), int(rng.choice(tree))
    match case % 6:
        case 0:
            octets[start] ^= 1 << int(rng.integers(8))
        case 1:
            length = min(int(rng.integers(1, 20_000)), size - start)
            octets[start : start + length] = rng.bytes(length)
        case 2:
            del octets[start:]
        case 3:  # headers and pointers of the tree
            struct.pack_into("<H", octets, page + 2 * int(rng.integers(30)), rng.integers(65_536))
        case 4:
            for place in rng.integers(PAGE_BYTES, size=4):
                octets[page + int(place)] ^= 1 << int(rng.integers(8))
        case 5:
            other = start // PAGE_BYTES * PAGE_BYTES
            octets[page : page + PAGE_BYTES] = octets[other : other + PAGE_BYTES]


def read_everything(path: Path) -> str:
    """Read all there is; errors other than DatabaseError end the program."""
    try:
        reader = MapReader.open(path, MODEL)
    except DatabaseError:
        return "refused"
    reads: list[Callable[[], object]] = [
        reader.names,
        lambda: reader.search(make_features(0).global_descriptor, 5),
        *(partial(reader.anchor, index) for index in range(len(reader))),
    ]
    failures = 0
    with reader:
        for read in reads:
            try:
                read()
            except DatabaseError:
                failures += 1
        problems = reader.verify()
    if failures and not problems:
        raise RuntimeError(f"{failures} failures to read that verify() does not know of")
    return "found" if problems else "unharmed"


def write_something(path: Path) -> None:
    """Add to a damaged map, or be refused."""
    with suppress(DatabaseError), MapWriter.open(path, MODEL) as writer:
        for index in range(1000, 1010):
            add(writer, index)


if __name__ == "__main__":
    original = Path(sys.argv[1])
    for case_ in range(NUM_CASES):
        damaged = bytearray(original.read_bytes())
        damage(damaged, case_)
        copy = original.with_name(f"{case_}.tpmap")
        copy.write_bytes(damaged)
        sys.stdout.write(read_everything(copy) + "\n")
        sys.stdout.flush()
        write_something(copy)
        copy.unlink()
