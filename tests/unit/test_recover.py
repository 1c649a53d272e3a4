"""What `trigpoint-db recover` saves of logs that are cut off or damaged."""

from __future__ import annotations

import fcntl
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from typer.testing import CliRunner

from trigpoint.errors import ConfigError
from trigpoint_db.cli import app
from trigpoint_db.recover import Recovered, recover

Found = tuple[str, str, int, int, bytes]
TOPICS = ("/image", "base/status")


def content(i: int) -> bytes:
    """Return a message that nothing else in a log looks like."""
    return f"<{i:06d}>".encode() * 6


def write_log(
    path: Path,
    count: int = 24,
    *,
    compression: CompressionType = CompressionType.NONE,
    use_chunking: bool = True,
) -> bytes:
    """Write messages, four to a chunk, whose times are their numbers."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=300, compression=compression, use_chunking=use_chunking)
        writer.start(profile="test")
        writer.add_metadata("about", {"settings": "none"})
        schema_id = writer.register_schema("Image", "jsonschema", b"{}")
        ids = [writer.register_channel(topic, "json", schema_id) for topic in TOPICS]
        for i in range(count):
            writer.add_message(ids[i % 2], 1000 + i, content(i), 2000 + i, i)
        writer.finish()  # type: ignore[no-untyped-call]
    return path.read_bytes()


def messages(path: Path) -> list[Found]:
    """Read a finished file through its index."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        found = [
            (channel.topic, schema.name if schema else "", m.log_time, m.publish_time, m.data)
            for schema, channel, m in reader.iter_messages()
        ]
        assert summary.statistics.message_count == len(found)
    return found


def expected(numbers: Iterator[int] | range) -> list[Found]:
    return [(TOPICS[i % 2], "Image", 1000 + i, 2000 + i, content(i)) for i in numbers]


def recovered_numbers(log: Path) -> list[int]:
    """Recover a log, see to it that every message is one of the original, and number them."""
    out = log.with_name("out.mcap")
    out.unlink(missing_ok=True)
    result: Recovered | str
    try:
        result = recover(log, out)
    except ConfigError as error:
        result = str(error)
    assert not out.with_name("out.mcap.partial").exists()
    assert out.exists() == isinstance(result, Recovered)
    if isinstance(result, str):
        assert "\n" not in result
        return []
    found = messages(out)
    numbers = [time_ns - 1000 for _, _, time_ns, _, _ in found]
    assert found == expected(iter(numbers))
    assert sum(result.topics.values()) == len(found)
    assert (result.start_time_ns, result.end_time_ns) == (found[0][2], found[-1][2])
    return numbers


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("recover")


def chunk_ends(path: Path) -> dict[int, int]:
    """Map the end of each chunk to the number of messages up to there."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return {
        index.chunk_start_offset + index.chunk_length: index.message_end_time - 999
        for index in summary.chunk_indexes
    }


@pytest.mark.slow
def test_a_log_cut_off_at_any_byte_gives_its_whole_chunks(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    data = write_log(log, 8)
    ends = chunk_ends(log)
    assert len(ends) >= 2
    for length in range(len(data)):
        log.write_bytes(data[:length])
        count = max((n for end, n in ends.items() if end <= length), default=0)
        assert recovered_numbers(log) == list(range(count)), length


@given(st.data())
@settings(max_examples=300)
def test_of_a_damaged_log_every_whole_chunk_is_saved_and_nothing_is_invented(
    folder: Path, data: st.DataObject
) -> None:
    log = folder / "log.mcap"
    compression = data.draw(st.sampled_from(list(CompressionType)))
    original = write_log(log, compression=compression)
    ends = sorted(chunk_ends(log).items())
    content = bytearray(original[: data.draw(st.integers(0, len(original)))])
    changes = data.draw(st.lists(st.tuples(st.integers(0, 2**20), st.integers(1, 255)), max_size=4))
    for position, change in changes:
        if content:
            content[position % len(content)] ^= change
    log.write_bytes(content)
    numbers = recovered_numbers(log)
    assert len(set(numbers)) == len(numbers)
    starts = [0, *(end for end, _ in ends)]
    firsts = [0, *(count for _, count in ends)]
    whole = [
        set(range(first, count))
        for start, (end, count), first in zip(starts, ends, firsts, strict=False)
        if content[start:end] == original[start:end]
    ]
    # Without its first chunk, a log that was not finished does not tell its topics.
    if content[: ends[0][0]] == original[: ends[0][0]]:
        assert set().union(*whole) <= set(numbers)


@given(st.data())
@settings(max_examples=100)
def test_a_log_without_chunks_is_read_up_to_where_it_breaks_off(
    folder: Path, data: st.DataObject
) -> None:
    log = folder / "plain.mcap"
    original = write_log(log, use_chunking=False)
    log.write_bytes(original[: data.draw(st.integers(0, len(original)))])
    numbers = recovered_numbers(log)
    assert numbers == list(range(len(numbers)))
    log.write_bytes(original)
    assert recovered_numbers(log) == list(range(24))


@given(st.binary(max_size=2000))
def test_what_is_no_log_gives_an_error_of_one_line(folder: Path, noise: bytes) -> None:
    (folder / "noise.mcap").write_bytes(noise)
    assert recovered_numbers(folder / "noise.mcap") == []


def test_a_damaged_chunk_costs_its_own_messages_alone(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    content = bytearray(write_log(log))
    ends = chunk_ends(log)
    (_, first), (_, second), *_ = sorted(ends.items())
    content[sorted(ends)[1] - 10] ^= 1
    log.write_bytes(content)
    out = tmp_path / "out.mcap"
    recovered = recover(log, out)
    assert messages(out) == expected([*range(first), *range(second, 24)])  # type: ignore[arg-type]
    assert recovered.finished
    assert recovered.num_damaged_bytes > 100
    assert recovered.num_orphans == 0


def test_the_index_of_a_finished_log_replaces_its_first_chunk(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    content = bytearray(write_log(log))
    first = min(chunk_ends(log).values())
    content[min(chunk_ends(log)) - 10] ^= 1
    log.write_bytes(content)
    assert recovered_numbers(log) == list(range(first, 24))
    log.write_bytes(content[:-9])
    out = tmp_path / "log.recovered.mcap"
    with pytest.raises(ConfigError, match="holds no whole chunk"):
        recover(log, out)


def test_zeros_at_the_end_are_no_messages(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    data = write_log(log)
    end, count = sorted(chunk_ends(log).items())[2]
    log.write_bytes(data[:end] + bytes(10_000))  # as a loss of power may leave it
    assert recovered_numbers(log) == list(range(count))


def test_metadata_and_attachments_are_kept(tmp_path: Path) -> None:
    log, out = tmp_path / "log.mcap", tmp_path / "out.mcap"
    with log.open("wb") as stream:
        writer = Writer(stream, index_types=IndexType.NONE)
        writer.start(profile="ros2")
        writer.add_metadata("about", {"a": "b"})
        writer.add_attachment(1, 2, "map.txt", "text/plain", b"here")
        writer.add_message(writer.register_channel("t", "json", 0), 5, b"{}", 5)
        writer.flush()  # type: ignore[no-untyped-call]
    recover(log, out)
    with out.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        [metadata], [attachment] = reader.iter_metadata(), reader.iter_attachments()
    assert (metadata.name, metadata.metadata) == ("about", {"a": "b"})
    assert (attachment.name, attachment.data) == ("map.txt", b"here")
    assert messages(out) == [("t", "", 5, 5, b"{}")]


def run(*arguments: object) -> str:
    result = CliRunner().invoke(app, ["recover", *map(str, arguments)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.stdout


def test_the_command_says_what_was_saved(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    data = write_log(log)
    log.write_bytes(data[: sorted(chunk_ends(log))[2] + 5])
    count = sorted(chunk_ends_of(data, tmp_path).values())[2]
    text = run(log)
    out = tmp_path / "log.recovered.mcap"
    assert f"{out}: {count} messages from 1970-01-01 00:00:00.000+00:00 to" in text
    assert "the log was not finished, 5 bytes of it are lost" in text
    images = (count + 1) // 2
    assert f" {images}  /image\n" in text
    assert messages(out) == expected(range(count))
    assert log.read_bytes() == data[: len(log.read_bytes())]
    facts = json.loads(run(log, "-o", tmp_path / "b.mcap", "--json"))
    assert facts["topics"] == {"/image": images, "base/status": count - images}
    assert (facts["start_time_ns"], facts["end_time_ns"]) == (1000, 999 + count)
    assert not facts["finished"]


def chunk_ends_of(data: bytes, folder: Path) -> dict[int, int]:
    (folder / "whole.mcap").write_bytes(data)
    return chunk_ends(folder / "whole.mcap")


def test_of_a_whole_log_nothing_is_lost(tmp_path: Path) -> None:
    write_log(tmp_path / "log.mcap")
    assert "24 messages" in (text := run(tmp_path / "log.mcap"))
    assert "nothing was lost" in text


def test_a_log_is_replaced_only_on_request(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    data = write_log(log)
    log.write_bytes(data[:-20])
    with pytest.raises(ConfigError, match="it is an input"):
        run(log, "-o", log)
    (tmp_path / "other.mcap").write_bytes(b"precious")
    with pytest.raises(ConfigError, match=r"other\.mcap exists"):
        run(log, "-o", tmp_path / "other.mcap")
    with pytest.raises(ConfigError, match="either -o or --in-place"):
        run(log, "-o", tmp_path / "third.mcap", "--in-place")
    assert (tmp_path / "other.mcap").read_bytes() == b"precious"
    assert log.read_bytes() == data[:-20]
    run(log, "--in-place")
    assert messages(log) == expected(range(24))


def test_a_log_that_is_being_written_is_not_replaced(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    data = write_log(log)
    with log.open("ab") as writing:
        fcntl.flock(writing, fcntl.LOCK_EX)
        with pytest.raises(ConfigError, match=r"a daemon is writing .*log\.mcap"):
            run(log, "--in-place")
        assert log.read_bytes() == data
        run(log)
    assert messages(tmp_path / "log.recovered.mcap") == expected(range(24))


@pytest.mark.parametrize(
    ("name", "complaint"),
    [("none.mcap", "No such file"), ("", "directory"), ("empty.mcap", "empty")],
)
def test_what_cannot_be_read_is_named(tmp_path: Path, name: str, complaint: str) -> None:
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(ConfigError, match=complaint) as error:
        run(tmp_path / name, "-o", tmp_path / "out.mcap")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out.mcap").exists()
