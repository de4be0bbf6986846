"""Tests the log: official readers accept it; damage is reported, skipped and repaired, never believed."""

from __future__ import annotations

import fcntl
import io
import resource
import shutil
import struct
import time
import zlib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from swath.daemon.log.claim import claim, is_being_written
from swath.daemon.log.format import LogError, safe_attachment_path
from swath.daemon.log.mcap.encode import encode_block
from swath.daemon.log.mcap.scan import MAX_CHUNK_BYTES, Damage, scan, unpack_chunk
from swath.daemon.log.mcap.writer import LogWriteError, PartWriter
from swath.daemon.log.reader import open_logs
from swath.daemon.log.recover import examine, recover
from tests.daemon.builders import INFO, ROVER_CHANNEL, SCANNER_CHANNEL, START_NS, Content, mcap_doctor, write_part
from tests.daemon.log.builders import official, read_all


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Content]:
    path = tmp_path_factory.mktemp("log") / f"{INFO.session_id}_0.mcap"
    return path, write_part(path)


@pytest.mark.parametrize("compression", ["auto", "none", "lz4", "zstd"])
def test_official_readers_and_ours_agree(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "a.mcap"
    content = write_part(path, compression=compression)
    assert official(path) == content
    assert official(path, seeking=False) == content
    (session,) = open_logs([path])
    assert read_all(session) == content
    assert session.damage == []
    verdict = mcap_doctor(path)
    assert verdict.returncode == 0, verdict.stdout
    assert "│ error" not in verdict.stdout, verdict.stdout
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == sum(map(len, content.values()))
    assert {channel.topic: channel.schema_id != 0 for channel in summary.channels.values()} == {
        "/scanner/left/raw": False,
        "/gnss/rover/raw": False,
        "/events": True,
    }
    kinds = {index.compression for index in summary.chunk_indexes}
    assert kinds == ({"", "lz4"} if compression == "auto" else {compression.replace("none", "")})


def test_session_metadata_and_attachments_are_readable_by_others(whole: tuple[Path, Content]) -> None:
    with whole[0].open("rb") as file:
        reader = make_reader(file)
        (metadata,) = reader.iter_metadata()
        (attachment,) = reader.iter_attachments()
    assert metadata.metadata == INFO.to_metadata(0)
    assert (attachment.name, attachment.data) == ("config.toml", b"[session]\n")


def test_a_part_is_never_overwritten(whole: tuple[Path, Content]) -> None:
    before = whole[0].read_bytes()
    with pytest.raises(FileExistsError):
        PartWriter(whole[0], INFO, 0)
    assert whole[0].read_bytes() == before


def test_messages_are_merged_by_time_across_chunk_classes(whole: tuple[Path, Content]) -> None:
    (session,) = open_logs([whole[0]])
    times: list[int] = []
    found: Content = {}
    for batch in session.batches_by_time():
        times += batch.log_time_ns.tolist()
        rows = found.setdefault(batch.channel.topic, [])
        rows += [(t, u.tobytes()) for t, u in zip(batch.log_time_ns.tolist(), batch.units, strict=True)]
    assert times == sorted(times)
    assert found == whole[1]


def test_topics_can_be_chosen(whole: tuple[Path, Content]) -> None:
    (session,) = open_logs([whole[0]])
    topics = {batch.channel.topic for batch in session.batches(lambda topic: topic.startswith("/gnss"))}
    assert topics == {"/gnss/rover/raw"}


# ------------------------------------------------------------------ cut and damaged


def is_prefix(found: Content, content: Content) -> bool:
    return all(found[topic] == content[topic][: len(found[topic])] for topic in found)


def test_a_truncated_log_gives_every_whole_chunk_and_can_be_recovered(
    tmp_path: Path, whole: tuple[Path, Content]
) -> None:
    data = whole[0].read_bytes()
    boundaries = []
    for found in scan(io.BytesIO(data), len(data)):
        assert not isinstance(found, Damage)
        boundaries += [found.offset - 1, found.offset, found.offset + 1]
    rng = np.random.default_rng(3)
    cuts = [cut for cut in boundaries if cut > 700] + rng.integers(700, len(data), 40).tolist()
    counts = []
    for cut in sorted(cuts):
        path = tmp_path / "cut.mcap"
        path.write_bytes(data[:cut])
        (session,) = open_logs([path])
        content = read_all(session)
        assert is_prefix(content, whole[1]), cut
        counts.append(sum(map(len, content.values())))
        assert session.damage, "a file without its end must say so"
        report = recover(path)
        assert report.recovered is not None
        assert official(report.recovered) == content
        report.recovered.unlink()
    assert counts == sorted(counts)
    assert counts[-1] == sum(map(len, whole[1].values()))


def test_a_recovered_file_is_accepted_by_the_doctor_and_supersedes_the_original(
    tmp_path: Path, whole: tuple[Path, Content]
) -> None:
    path = tmp_path / whole[0].name
    path.write_bytes(whole[0].read_bytes()[:900_000])
    before = path.read_bytes()
    report = recover(path)
    assert report.recovered is not None
    assert path.read_bytes() == before
    verdict = mcap_doctor(report.recovered)
    assert verdict.returncode == 0, verdict.stdout
    (session,) = open_logs([tmp_path])
    assert [part.path for part in session.parts] == [report.recovered]
    assert session.attachments() == {"config.toml": b"[session]\n"}
    with pytest.raises(LogError, match="already exists"):
        recover(path)
    assert recover(report.recovered).whole


def test_a_tail_of_zeros_is_ignored(tmp_path: Path, whole: tuple[Path, Content]) -> None:
    """After a power cut ext4 leaves files whose length is right but whose bytes are zero."""
    data = whole[0].read_bytes()
    path = tmp_path / "zeros.mcap"
    path.write_bytes(data[:800_000] + bytes(len(data) - 800_000))
    (session,) = open_logs([path])
    content = read_all(session)
    assert is_prefix(content, whole[1])
    assert sum(map(len, content.values())) > 400
    assert session.damage


def test_zeros_in_the_middle_lose_the_chunks_they_touch(tmp_path: Path, whole: tuple[Path, Content]) -> None:
    data = bytearray(whole[0].read_bytes())
    chunks = [found for found in scan(io.BytesIO(bytes(data)), len(data)) if not isinstance(found, Damage)]
    chunks = [found for found in chunks if found.opcode == 6]
    at = 700_000
    data[at : at + 65536] = bytes(65536)
    touched = [found for found in chunks if found.offset < at + 65536 and found.offset + found.length > at]
    path = tmp_path / "middle.mcap"
    path.write_bytes(bytes(data))
    (session,) = open_logs([path])
    content = read_all(session)
    lost = {topic: set(rows) - set(content.get(topic, [])) for topic, rows in whole[1].items()}
    assert all(set(rows) <= set(whole[1][topic]) for topic, rows in content.items())
    expected = sum(len(batch) for batch in lost.values())
    assert 0 < expected <= 500
    report = examine(path)
    assert report.chunks == len(chunks) - len(touched)
    assert report.messages_lost == expected


DAMAGE = st.lists(
    st.tuples(st.floats(0, 1), st.binary(min_size=1, max_size=300), st.booleans()), min_size=1, max_size=4
)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(DAMAGE)
def test_any_damage_is_reported_and_no_false_data_is_given(
    tmp_path: Path, whole: tuple[Path, Content], damage: list[tuple[float, bytes, bool]]
) -> None:
    content = bytearray(whole[0].read_bytes())
    for share, junk, overwrite in damage:
        at = round(share * (len(content) - len(junk)))
        if overwrite:
            content[at : at + len(junk)] = junk
        else:
            del content[at : at + len(junk)]
    path = tmp_path / "damaged.mcap"
    path.write_bytes(bytes(content))
    try:
        (session,) = open_logs([path])
    except LogError:
        return  # its head was hit
    found = read_all(session)
    for topic, rows in found.items():
        assert set(rows) <= set(whole[1].get(topic, [])), topic
    if found != whole[1]:
        assert session.damage


# ------------------------------------------------------------------ strangers


def test_absurd_lengths_and_decompression_bombs_are_refused(tmp_path: Path) -> None:
    bomb = struct.pack("<QQQII", 0, 1, 1 << 40, 0, 3) + b"lz4" + struct.pack("<Q", 4) + b"\0" * 4
    with pytest.raises(LogError, match="claims"):
        unpack_chunk(bomb)
    packed = zstandard.ZstdCompressor().compress(bytes(64 << 20))
    small_claim = struct.pack("<QQQII", 0, 1, 1000, 0, 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    with pytest.raises(LogError, match="instead of 1000"):
        unpack_chunk(small_claim)
    assert MAX_CHUNK_BYTES <= 256 << 20


@pytest.mark.parametrize("name", ["../evil", "/etc/passwd", "a/../../b", "", "a\\b", "a\0b"])
def test_attachment_names_that_are_paths_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(LogError, match="is not a valid name"):
        safe_attachment_path(tmp_path, name)
    assert safe_attachment_path(tmp_path, "dbc/imu.dbc") == tmp_path / "dbc" / "imu.dbc"


def test_files_that_are_not_logs_are_refused_in_one_line(tmp_path: Path) -> None:
    for name, data in (("text.mcap", b"hello"), ("empty.mcap", b""), ("magic.mcap", b"\x89MCAP0\r\n")):
        path = tmp_path / name
        path.write_bytes(data)
        with pytest.raises(LogError) as error:
            open_logs([path])
        assert name in str(error.value)
        assert "\n" not in str(error.value)
    stranger = tmp_path / "ros.mcap"
    with stranger.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="x")
        writer.finish()
    with pytest.raises(LogError, match="profile 'ros2'"):
        open_logs([stranger])
    empty = tmp_path / "folder"
    empty.mkdir()
    with pytest.raises(LogError, match="no such file"):
        open_logs([tmp_path / "nothing"])
    with pytest.raises(LogError, match="no logs"):
        open_logs([empty])


def test_a_foreign_chunk_with_a_malformed_channel_costs_only_that_chunk(
    tmp_path: Path, whole: tuple[Path, Content]
) -> None:
    records = struct.pack("<BQ", 4, 3) + b"abc"  # a channel record is longer; the chunk's CRC is right
    chunk = (
        struct.pack("<QQQII", 0, 0, len(records), zlib.crc32(records), 0) + struct.pack("<Q", len(records)) + records
    )
    data = whole[0].read_bytes()
    first_chunk = next(
        found.offset
        for found in scan(io.BytesIO(data), len(data))
        if not isinstance(found, Damage) and found.opcode == 6
    )
    path = tmp_path / "stranger.mcap"
    path.write_bytes(data[:first_chunk] + struct.pack("<BQ", 6, len(chunk)) + chunk + data[first_chunk:])
    (session,) = open_logs([path])
    assert read_all(session) == whole[1]
    chunk_damage, index_damage = (entry.damage for entry in session.damage)
    assert chunk_damage.offset == first_chunk
    assert index_damage.what.startswith("index and footer")  # the inserted bytes moved all that it points to
    report = recover(path)
    assert report.damage == [chunk_damage, index_damage]
    assert report.recovered is not None
    assert official(report.recovered) == whole[1]


# ------------------------------------------------------------------ parts


def test_parts_are_ordered_and_a_missing_one_is_named(tmp_path: Path) -> None:
    contents = [write_part(tmp_path / f"z{9 - part}.mcap", part=part, blocks=20) for part in range(4)]
    (session,) = open_logs([tmp_path])
    assert [part.number for part in session.parts] == [0, 1, 2, 3]
    joined: Content = {topic: [row for content in contents for row in content[topic]] for topic in contents[0]}
    assert read_all(session) == joined
    (tmp_path / "z7.mcap").unlink()
    (session,) = open_logs([tmp_path])
    assert session.missing_parts == [2]
    shutil.copy(tmp_path / "z9.mcap", tmp_path / "copy.mcap")
    with pytest.raises(LogError, match="is part 0 of its session, as is"):
        open_logs([tmp_path])


def test_chunks_written_at_once_after_a_stall_are_read_in_time_order(tmp_path: Path) -> None:
    writer = PartWriter(tmp_path / "stalled.mcap", INFO, 0)
    writer.add_channel(1, SCANNER_CHANNEL)
    writer.add_channel(2, ROVER_CHANNEL)
    units = np.zeros((100, 1206), np.uint8)
    for number in range(300):  # 3 s of log time
        base_ns = START_NS + number * 10_000_000
        writer.add(encode_block(2, number, np.array([base_ns], dtype=np.int64), units[:1, :40]))
        writer.add(encode_block(1, number * 100, base_ns + np.arange(100, dtype=np.int64) * 100_000, units))
    writer.finish()
    (session,) = open_logs([tmp_path])
    times = np.concatenate([batch.log_time_ns for batch in session.batches_by_time()])
    assert len(times) == 300 * 101
    assert (np.diff(times) >= 0).all()


def test_error_for_a_directory_without_logs_gives_the_reason(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / f"{name}.mcap").touch()
    with pytest.raises(LogError) as error:
        open_logs([tmp_path], [])
    assert str(error.value) == f"{tmp_path}: no logs (*.mcap); {tmp_path}/a.mcap: is not an MCAP file, and 1 more"


# ------------------------------------------------------------------ a disk that refuses


def test_a_refused_chunk_is_counted_and_removed_and_the_writer_continues(tmp_path: Path) -> None:
    path = tmp_path / "limited.mcap"
    writer = PartWriter(path, INFO, 0)
    writer.add_channel(1, SCANNER_CHANNEL)
    writer.add_channel(2, ROVER_CHANNEL)
    units = np.zeros((400, 1206), np.uint8)
    times = START_NS + np.arange(400, dtype=np.int64)
    kept: Counter[int] = Counter()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_200_000, hard))
        writer.add(encode_block(1, 0, times, units))
        writer.flush()
        kept[1] = 400
        size = path.stat().st_size
        writer.add(encode_block(1, 400, times, units))
        writer.add(encode_block(1, 800, times, units))
        with pytest.raises(LogWriteError) as error:
            writer.flush()
        assert error.value.filename == str(path)
        assert path.stat().st_size == size == writer.bytes_written
        writer.add(encode_block(2, 0, times[:3], units[:3, :7]))
        writer.flush()
        kept[2] = 3
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert writer.written == kept
    assert writer.lost == Counter({1: 800})
    writer.finish()
    assert {topic: len(rows) for topic, rows in official(path).items()} == {
        SCANNER_CHANNEL.topic: 400,
        ROVER_CHANNEL.topic: 3,
    }
    assert mcap_doctor(path).returncode == 0


def test_a_claim_succeeds_during_a_query_by_another_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(b"")
    with path.open("rb") as asking, path.open("ab") as writing:
        fcntl.flock(asking, fcntl.LOCK_SH)
        monkeypatch.setattr(time, "sleep", lambda _: fcntl.flock(asking, fcntl.LOCK_UN))
        assert claim(writing.fileno())
        assert is_being_written(path)
    assert not is_being_written(path)
