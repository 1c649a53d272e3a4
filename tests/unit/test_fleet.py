"""Maps published and fetched over real Zenoh sessions on loopback."""

import contextlib
import json
import os
import re
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest

from tests.unit.conftest import Run
from tests.unit.flaky_publisher import NUM_CHUNKS
from tests.unit.maps import MODEL, add, make_features, require_image
from trigpoint.database.reader import MapReader
from trigpoint.database.snapshot import MAX_MAP_BYTES
from trigpoint.database.writer import MapWriter
from trigpoint.errors import ConfigError, SourceError
from trigpoint_db.fleet.fetch import fetch_map
from trigpoint_db.fleet.manifest import CHUNK_BYTES, Manifest
from trigpoint_db.fleet.offer import Offer
from trigpoint_db.fleet.zenoh import Publisher, RemoteMap, check_key, open_session

KEY = "trigpoint/maps/office"
UNIT = Path(__file__).parents[2] / "systemd" / "trigpoint-fetch@.service"
NUM_IMAGES = 500
TIMEOUT_S = 60
STOP_S = 10  # of the unit


@pytest.fixture(scope="module")
def office_bytes(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A map of a dozen chunks."""
    path = tmp_path_factory.mktemp("office") / "office.tpmap"
    with MapWriter.create(path, MODEL) as writer:
        for index in range(NUM_IMAGES):
            add(writer, index, features=make_features(index, num_keypoints=1000))
    return path.read_bytes()


@pytest.fixture
def office(office_bytes: bytes, tmp_path: Path) -> Path:
    (tmp_path / "ground").mkdir()
    path = tmp_path / "ground" / "office.tpmap"
    path.write_bytes(office_bytes)
    return path


@pytest.fixture
def out(tmp_path: Path) -> Path:
    (tmp_path / "drone").mkdir()
    return tmp_path / "drone" / "office.tpmap"


@pytest.fixture
def endpoint(port: int) -> str:
    return f"tcp/127.0.0.1:{port}"


def extend(path: Path, index: int = NUM_IMAGES) -> None:
    with MapWriter.open(path, MODEL) as writer:
        add(writer, index)


def generation_of(path: Path) -> int:
    with MapReader.open(path) as reader:
        assert reader.verify() == []
        return reader.generation


def wait_until(is_true: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + TIMEOUT_S
    while not is_true():
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


def untracked(chunks: Iterable[int], what: str, total: int) -> Iterable[int]:
    return chunks


@contextlib.contextmanager
def publishing(path: Path, endpoint: str) -> Iterator[Publisher]:
    with Publisher(open_session(None, None, [endpoint]), KEY, path) as publisher:
        yield publisher


@contextlib.contextmanager
def reaching(endpoint: str, kind: type[RemoteMap] = RemoteMap) -> Iterator[RemoteMap]:
    session = open_session(None, [endpoint], None)
    try:
        yield kind(session, KEY)
    finally:
        session.close()  # type: ignore[no-untyped-call]


@contextlib.contextmanager
def process(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """Run a module; it is gone at the end."""
    started = subprocess.Popen(
        [sys.executable, "-m", *map(str, arguments)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    try:
        yield started
    finally:
        started.kill()
        started.communicate()


@contextlib.contextmanager
def flaky(office: Path, endpoint: str, fault: str) -> Iterator[subprocess.Popen[str]]:
    with process("tests.unit.flaky_publisher", office, KEY, endpoint, fault) as publisher:
        assert publisher.stdout is not None
        assert publisher.stdout.readline() == "ready\n"
        yield publisher


def fetching(out: Path, endpoint: str, *more: object) -> list[object]:
    return ["fetch", KEY, "-o", out, "--connect", endpoint, *more]


def num_fetched(out: Path) -> int:
    """Count the chunks that are in the file beside a map."""
    partial = out.with_name(out.name + ".fetch")
    data = partial.read_bytes() if partial.exists() else b""
    return sum(any(data[i : i + CHUNK_BYTES]) for i in range(0, len(data), CHUNK_BYTES))


def num_bytes_read() -> int:
    """Count what this process has read from files."""
    counts = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
    return int(counts["rchar"])


def test_a_map_arrives_and_a_commit_costs_what_it_has_changed(
    office: Path, out: Path, endpoint: str, run: Run
) -> None:
    with publishing(office, endpoint) as publisher:
        code, text, _ = run(*fetching(out, endpoint, "--json"))
        assert code == 0
        assert json.loads(text)["num_bytes_fetched"] == office.stat().st_size
        with MapReader.open(out) as reader:  # as a daemon has it
            extend(office)
            assert publisher.refresh()
            code, text, _ = run(*fetching(out, endpoint, "--json"))
            assert code == 0
            assert 0 < json.loads(text)["num_bytes_fetched"] <= 4 * CHUNK_BYTES
            assert len(reader) == NUM_IMAGES
            assert reader.refresh()
            assert reader.verify() == []
            require_image(reader, NUM_IMAGES)
        code, text, _ = run(*fetching(out, endpoint))
        assert code == 0
        assert "up to date" in text
    assert {path.name for path in out.parent.iterdir()} <= {out.name, out.name + "-lock"}
    assert {path.name for path in office.parent.iterdir()} <= {office.name, office.name + "-lock"}


def test_a_map_that_is_up_to_date_is_read_once_until_it_changes(
    office: Path, out: Path, endpoint: str
) -> None:
    with publishing(office, endpoint), reaching(endpoint) as remote:
        fetch_map(remote, out, patience_s=TIMEOUT_S, track=untracked)
        good = out.read_bytes()
        num_read = []
        for _ in range(2):
            before = num_bytes_read()
            fetched = fetch_map(remote, out, patience_s=TIMEOUT_S, track=untracked)
            assert not fetched.is_new
            num_read.append(num_bytes_read() - before)
        assert num_read[0] >= len(good) > CHUNK_BYTES > num_read[1]
        status = out.stat()
        with out.open("r+b") as file:  # of the same size
            file.write(bytes(16))
        os.utime(out, ns=(status.st_atime_ns, status.st_mtime_ns))
        fetched = fetch_map(remote, out, patience_s=TIMEOUT_S, track=untracked)
    assert fetched.is_new
    assert 0 < fetched.num_bytes_fetched <= CHUNK_BYTES
    assert out.read_bytes() == good


def test_a_publisher_killed_in_the_middle_and_started_again(
    office: Path, out: Path, endpoint: str
) -> None:
    with process("trigpoint_db.cli", *fetching(out, endpoint, "--json")) as fetch:
        with flaky(office, endpoint, "dies") as publisher:
            assert publisher.wait(TIMEOUT_S) == -9
        assert fetch.poll() is None
        with process("trigpoint_db.cli", "publish", office, "--key", KEY, "--listen", endpoint):
            text, err = fetch.communicate(timeout=TIMEOUT_S)
    assert fetch.returncode == 0, err
    assert json.loads(text)["num_images"] == NUM_IMAGES
    assert generation_of(out) == generation_of(office)


def test_a_fetch_killed_in_the_middle_goes_on(
    office: Path, out: Path, endpoint: str, run: Run
) -> None:
    with (
        flaky(office, endpoint, "stalls"),
        process("trigpoint_db.cli", *fetching(out, endpoint)) as fetch,
    ):
        wait_until(lambda: num_fetched(out) >= NUM_CHUNKS)
        code, _, err = run(*fetching(out, endpoint))  # another one at the same time
        assert code == 1
        assert "another writer has it open" in err
        fetch.kill()
        fetch.wait(TIMEOUT_S)
    assert not out.exists()
    extend(office)  # the manifest is another one, most of its chunks are the same
    with publishing(office, endpoint):
        code, text, _ = run(*fetching(out, endpoint, "--json"))
    assert code == 0
    assert json.loads(text)["num_bytes_fetched"] < office.stat().st_size - CHUNK_BYTES
    assert generation_of(out) == generation_of(office)


def test_a_stop_does_not_wait_for_a_publisher_that_stalls(
    office: Path, out: Path, endpoint: str
) -> None:
    with (
        flaky(office, endpoint, "stalls"),
        process("trigpoint_db.cli", *fetching(out, endpoint, "--watch")) as fetch,
    ):
        wait_until(lambda: num_fetched(out) >= NUM_CHUNKS)
        fetch.terminate()
        assert fetch.wait(STOP_S) == 130
    assert num_fetched(out) == NUM_CHUNKS


def test_a_publisher_that_stalls_is_waited_for_no_longer_than_asked(
    office: Path, out: Path, endpoint: str
) -> None:
    with (
        flaky(office, endpoint, "stalls"),
        process("trigpoint_db.cli", *fetching(out, endpoint, "--timeout", 3)) as fetch,
    ):
        _, err = fetch.communicate(timeout=TIMEOUT_S / 2)
    assert fetch.returncode == 1
    assert f"nothing came on {KEY} for 3 s" in err
    assert num_fetched(out) == NUM_CHUNKS


def test_silence_is_not_taken_for_a_refusal(
    office: Path, endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with flaky(office, endpoint, "stalls"), reaching(endpoint) as remote:
        wait_until(lambda: remote.get_manifest(TIMEOUT_S) is not None)
        manifest = remote.get_manifest(TIMEOUT_S)
        assert manifest is not None
        *answered, silent = manifest.chunks[: NUM_CHUNKS + 1]
        assert [len(remote.get_chunk(chunk)) for chunk in answered] == [1] * NUM_CHUNKS
        monkeypatch.setattr("trigpoint_db.fleet.zenoh._REPLY_TIMEOUT_S", 0.1)
        assert remote.get_chunk(silent) == []


def test_a_chunk_that_is_not_what_the_manifest_says_is_not_taken(
    office: Path, out: Path, endpoint: str, run: Run
) -> None:
    out.write_bytes(b"the old one")
    with flaky(office, endpoint, "lies"):
        code, _, err = run(*fetching(out, endpoint))
    assert code == 1
    assert f"chunk 1 of {KEY} does not have the hash of its manifest" in err
    assert "\n" not in err
    assert out.read_bytes() == b"the old one"


def test_a_publisher_that_lacks_what_it_announces_is_not_asked_for_ever(
    office: Path, out: Path, endpoint: str
) -> None:
    with (
        flaky(office, endpoint, "lacks"),
        process("trigpoint_db.cli", *fetching(out, endpoint)) as fetch,
    ):
        _, err = fetch.communicate(timeout=TIMEOUT_S / 2)
    assert fetch.returncode == 1
    assert f"what is announced on {KEY} is not to be had there, 3 times" in err
    assert not out.exists()


def test_a_map_that_changes_while_it_is_fetched(office: Path, out: Path, endpoint: str) -> None:
    sizes: list[int] = []
    with publishing(office, endpoint) as publisher:
        last = publisher.manifest.chunks[-1]

        class Watched(RemoteMap):
            def get_chunk(self, sha256: str) -> list[bytes | None]:
                if sha256 == last and publisher.manifest.num_images == NUM_IMAGES:
                    extend(office)
                    assert publisher.refresh()
                answers = super().get_chunk(sha256)
                sizes.extend(len(answer) for answer in answers if answer is not None)
                return answers

        with reaching(endpoint, Watched) as remote:
            fetched = fetch_map(remote, out, patience_s=TIMEOUT_S, track=untracked)
    assert fetched.manifest.num_images == NUM_IMAGES + 1
    assert fetched.num_bytes_fetched == sum(sizes) > office.stat().st_size / 2
    assert generation_of(out) == generation_of(office)


def test_what_could_not_be_published_is_tried_again(
    office: Path, endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_room(*_: object) -> Offer:
        raise ConfigError("no room")

    with publishing(office, endpoint) as publisher:
        before = publisher.manifest.generation
        extend(office)
        with monkeypatch.context() as full:
            full.setattr("trigpoint_db.fleet.zenoh.Offer", no_room)
            with pytest.raises(ConfigError, match="no room"):
                publisher.refresh()
        assert publisher.manifest.generation == before
        assert publisher.refresh()
        assert publisher.manifest.generation == generation_of(office)
        assert not publisher.refresh()


def test_what_keeps_a_publisher_from_the_newest_commit_goes_to_standard_error(
    office: Path, endpoint: str
) -> None:
    with process(
        "trigpoint_db.cli", "publish", office, "--key", KEY, "--listen", endpoint
    ) as publish:
        assert publish.stdout is not None
        assert publish.stderr is not None
        assert "office.tpmap: generation" in publish.stdout.readline()
        damaged = office.with_name("damaged")
        damaged.write_bytes(b"no map")
        damaged.replace(office)
        readable, _, _ = select.select([publish.stdout, publish.stderr], [], [], TIMEOUT_S)
        assert readable == [publish.stderr]
        said = publish.stderr.readline()
    assert said.endswith("; the last good state stays published\n")


def test_two_fetch_while_a_writer_writes(office: Path, out: Path, endpoint: str) -> None:
    is_over = threading.Event()

    def write() -> None:
        index = NUM_IMAGES
        while not is_over.is_set():
            extend(office, index)
            index += 1

    writer = threading.Thread(target=write)
    writer.start()
    try:
        with publishing(office, endpoint) as publisher:
            other = out.with_name("other.tpmap")
            with (
                process("trigpoint_db.cli", *fetching(out, endpoint)) as first,
                process("trigpoint_db.cli", *fetching(other, endpoint)) as second,
            ):
                assert [p.wait(TIMEOUT_S) for p in (first, second)] == [0, 0]
            published = publisher.manifest
    finally:
        is_over.set()
        writer.join()
    for path in (out, other):
        assert generation_of(path) == published.generation
    assert generation_of(office) > published.generation
    assert out.read_bytes() == other.read_bytes()


def test_watch_follows_the_generations(office: Path, out: Path, endpoint: str) -> None:
    with (
        publishing(office, endpoint) as publisher,
        process("trigpoint_db.cli", *fetching(out, endpoint, "--watch")) as fetch,
    ):
        for index in range(NUM_IMAGES, NUM_IMAGES + 2):
            wait_until(lambda: out.exists() and generation_of(out) == generation_of(office))
            extend(office, index)
            assert publisher.refresh()
        wait_until(lambda: generation_of(out) == generation_of(office))
        assert fetch.poll() is None


def test_watch_outlives_what_goes_wrong(office: Path, out: Path, endpoint: str) -> None:
    MapWriter.create(out, MODEL).close()
    with (
        publishing(office, endpoint) as publisher,
        process("trigpoint_db.cli", *fetching(out, endpoint, "--watch")) as fetch,
    ):
        with MapWriter.open(out, MODEL):  # a map that is written to is not replaced
            assert fetch.stderr is not None
            said = next(line for line in fetch.stderr if "another writer" in line)
        assert said.endswith("; trying again\n")
        extend(office)
        assert publisher.refresh()
        wait_until(lambda: generation_of(out) == generation_of(office))


@pytest.mark.skipif(not UNIT.is_file(), reason="needs the checkout's systemd/")
def test_the_unit_fetches_what_it_is_named_for(office: Path, tmp_path: Path, endpoint: str) -> None:
    """Its ExecStart, without systemd: what %i and the variables stand for is filled in."""
    settings = {"connect": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
    (tmp_path / "fleet.json5").write_text(json.dumps(settings))
    unit = UNIT.read_text()
    (command,) = re.findall(r"^ExecStart=\S+/trigpoint-db (.*)$", unit, re.MULTILINE)
    command = re.sub(r"\$\{\w+\}", str(tmp_path), command.replace("%i", "office"))
    with publishing(office, endpoint), process("trigpoint_db.cli", *command.split()) as fetch:
        assert fetch.stdout is not None
        assert "office.tpmap: generation" in fetch.stdout.readline()
        fetch.terminate()
        assert f"SuccessExitStatus={fetch.wait(TIMEOUT_S)}" in unit.splitlines()
    assert generation_of(tmp_path / "office.tpmap") == generation_of(office)


def test_a_full_disk_keeps_the_old_map(office: Path, tmp_path: Path, endpoint: str) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    fetch = f"exec {sys.executable} -m trigpoint_db.cli fetch {KEY} -o {disk}/m.tpmap"
    script = (
        f"mount -t tmpfs -o size=4m none {disk} || exit 77; echo old > {disk}/m.tpmap; "
        f"({fetch} --connect {endpoint}); code=$?; cat {disk}/m.tpmap; ls -A {disk}; exit $code"
    )
    with publishing(office, endpoint):
        done = subprocess.run(
            ["unshare", "-rm", "sh", "-c", script],
            capture_output=True, text=True, timeout=TIMEOUT_S, check=False,
        )  # fmt: skip
    if done.returncode == 77 or "unshare" in done.stderr:
        pytest.skip(f"a disk cannot be mounted here: {done.stderr.strip()}")
    assert done.returncode == 1
    assert done.stdout == "old\nm.tpmap\n"
    assert "MB are free; make room there" in done.stderr
    assert done.stderr.count("\n") == 1


def test_nobody_publishes(out: Path, endpoint: str, run: Run) -> None:
    code, _, err = run(*fetching(out, endpoint, "--timeout", 1))
    assert code == 1
    assert f"nothing came on {KEY} for 1 s" in err
    assert list(out.parent.iterdir()) == []


@pytest.mark.parametrize("key", ["", "/a", "a//b", "maps/*", "maps/**", "a?b", "a#b"])
def test_keys_that_cannot_be_used(key: str) -> None:
    with pytest.raises(ConfigError, match="key"):
        check_key(key)


def test_a_key_is_looked_at_before_an_endpoint(office: Path, out: Path, run: Run) -> None:
    for command in (["publish", office, "--key", "a//b"], ["fetch", "a//b", "-o", out]):
        code, _, err = run(*command, "--listen", "nonsense")
        assert code == 1
        assert err.startswith("trigpoint-db: 'a//b' is no key")


def test_no_map_takes_the_place_of_another_file(tmp_path: Path, endpoint: str, run: Run) -> None:
    notes = tmp_path / "notes.txt"
    notes.write_text("keep me")
    code, _, err = run(*fetching(notes, endpoint, "--timeout", 1))
    assert (code, "is no map by its name" in err) == (1, True)
    assert notes.read_text() == "keep me"


@pytest.mark.parametrize("listen", ["nonsense", "tcp/256.0.0.1:1"])
def test_endpoints_that_cannot_be_used(listen: str, office: Path, run: Run) -> None:
    code, _, err = run("publish", office, "--key", KEY, "--listen", listen)
    assert code == 1
    assert "write an endpoint as" in err
    assert "\n" not in err


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"num_bytes": 0}, "num_bytes"),
        ({"num_bytes": MAX_MAP_BYTES + 1}, "num_bytes"),
        ({"chunks": []}, "0 chunks"),
        ({"sha256": "f" * 63}, "sha256"),
        ({"chunk_bytes": 1}, "chunk_bytes"),
    ],
)
def test_manifests_that_cannot_be_used(change: dict[str, object], said: str) -> None:
    good = Manifest(
        num_bytes=5, sha256="0" * 64, chunk_bytes=4096, chunks=["0" * 64], generation=1,
        num_images=1, model="m", model_sha256="0" * 64,
    )  # fmt: skip
    with pytest.raises(SourceError, match=said) as caught:
        Manifest.decode(json.dumps(good.model_dump() | change).encode())
    assert "\n" not in str(caught.value)
    assert Manifest.decode(good.model_dump_json().encode()) == good
