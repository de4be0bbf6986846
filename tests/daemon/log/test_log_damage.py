"""Tests damage to records between chunks, which have no CRC: no good chunk is missed, no loss is silent."""

from __future__ import annotations

import io
import json
import resource
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from small_mcap import get_summary, read_message

from swath.daemon.log.format import ChannelSpec, LogError
from swath.daemon.log.mcap.encode import encode_block, encode_json
from swath.daemon.log.mcap.scan import Damage, Record, scan, unpack_chunk
from swath.daemon.log.mcap.writer import LogWriteError, PartWriter
from swath.daemon.log.reader import open_logs
from swath.daemon.log.recover import examine, recover
from tests.builders import ROOT
from tests.daemon.builders import (
    EVENTS_CHANNEL,
    INFO,
    ROVER_CHANNEL,
    SCANNER_CHANNEL,
    START_NS,
    Content,
    mcap_doctor,
    write_part,
)
from tests.daemon.commands import swath
from tests.daemon.log.builders import official, read_all
from tests.daemon.rig import session_table

CHUNK, INDEX, DATA_END = 6, 7, 15


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return a finished part."""
    path = tmp_path_factory.mktemp("log") / "whole.mcap"
    write_part(path)
    return path.read_bytes()


def records_of(data: bytes) -> list[Record]:
    found = list(scan(io.BytesIO(data), len(data)))
    assert not any(isinstance(one, Damage) for one in found)
    return [one for one in found if isinstance(one, Record)]


def scanned(data: bytes) -> tuple[int, list[Damage]]:
    """Return intact chunks and damage."""
    found = list(scan(io.BytesIO(data), len(data)))
    chunks = sum(isinstance(one, Record) and one.opcode == CHUNK for one in found)
    return chunks, [one for one in found if isinstance(one, Damage)]


# ------------------------------------------------------------------ the end


def test_every_truncation_of_the_end_is_reported_and_repaired(tmp_path: Path, data: bytes) -> None:
    """No data are lost, but no other reader opens such a file by its index."""
    end = records_of(data)[-1]
    assert end.opcode == DATA_END
    cuts = range(end.offset, len(data), 97)
    for cut in [*cuts, end.offset + end.length, len(data) - 8, len(data) - 1]:
        path = tmp_path / "cut.mcap"
        path.write_bytes(data[:cut])
        report = recover(path)
        assert report.damage, cut
        assert report.recovered is not None, cut
        assert sum(report.messages.values()) == 1266
        assert sum(map(len, official(report.recovered).values())) == 1266
        report.recovered.unlink()


def test_every_wrong_byte_of_the_end_is_reported(data: bytes) -> None:
    end = records_of(data)[-1]
    chunks, _ = scanned(data)
    for at in range(end.offset, len(data)):
        if end.offset + 9 <= at < end.offset + 13:
            continue  # the CRC of all data is unnecessary if each chunk has its own
        content = bytearray(data)
        content[at] ^= 0x10
        found, damage = scanned(bytes(content))
        assert damage, at
        assert found == chunks


def test_padding_after_the_end_is_reported(data: bytes) -> None:
    _, damage = scanned(data + bytes(4096))
    assert [one.what for one in damage] == ["index and footer are missing, cut off or wrong"]


# ------------------------------------------------------------------ between chunks


def test_a_wrong_record_head_between_chunks_hides_no_chunk(data: bytes) -> None:
    """Every bit of every record head between chunks is flipped; all chunks are read, unreadable bytes reported."""
    chunks, _ = scanned(data)
    outside = [one for one in records_of(data) if one.opcode not in (CHUNK, DATA_END)]
    for record in outside:
        for bit in range(9 * 8):
            content = bytearray(data)
            content[record.offset + bit // 8] ^= 1 << bit % 8
            found, damage = scanned(bytes(content))
            assert found == chunks, (record.opcode, bit)
            assert damage, (record.opcode, bit)
            assert sum(one.length for one in damage) <= 2 * record.length + 20_000


def test_a_damaged_chunk_head_costs_that_chunk_only(data: bytes) -> None:
    chunks, _ = scanned(data)
    victim = [one for one in records_of(data) if one.opcode == CHUNK][4]
    for at in range(victim.offset, victim.offset + 57):
        if victim.offset + 9 <= at < victim.offset + 25:
            continue  # first and last time are an index that other readers use and Swath does not
        content = bytearray(data)
        content[at] ^= 0x41
        found, damage = scanned(bytes(content))
        assert found == chunks - 1, at - victim.offset
        assert damage


def test_unknown_records_are_skipped(tmp_path: Path, data: bytes) -> None:
    """Official readers skip unknown opcodes as well."""
    chunk = next(one for one in records_of(data) if one.opcode == CHUNK)
    private = struct.pack("<BQ", 0x93, 5000) + bytes(range(250)) * 20
    path = tmp_path / "private.mcap"
    path.write_bytes(data[: chunk.offset] + private + data[chunk.offset :])
    chunks, damage = scanned(path.read_bytes())
    assert chunks == scanned(data)[0]
    assert [one.what for one in damage] == ["index and footer are missing, cut off or wrong"]  # it points elsewhere now


def test_messages_not_covered_by_a_crc_are_not_used(tmp_path: Path, data: bytes) -> None:
    chunk = next(one for one in records_of(data) if one.opcode == CHUNK)
    loose = struct.pack("<BQHIQQ", 5, 22 + 4, 1, 0, 1, 1) + b"evil"
    content = data[: chunk.offset] + loose * 1000 + data[chunk.offset :]
    _, damage = scanned(content)
    assert (damage[0].length, damage[0].messages) == (len(loose) * 1000, 1000)
    path = tmp_path / "loose.mcap"
    path.write_bytes(content)
    (session,) = open_logs([path])
    assert all(b"evil" not in unit for rows in read_all(session).values() for _, unit in rows)


def test_a_chunk_without_crc_is_not_used() -> None:
    chunk = struct.pack("<QQQII", 0, 1, 4, 0, 0) + struct.pack("<Q", 4) + b"abcd"
    with pytest.raises(LogError, match="without a CRC"):
        unpack_chunk(chunk)


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 70_000), st.booleans())
def test_overwritten_bytes_cost_only_the_chunks_they_touch(data: bytes, seed: int, n: int, zero: bool) -> None:
    rng = np.random.default_rng(seed)
    at = int(rng.integers(8, len(data) - n))
    content = bytearray(data)
    content[at : at + n] = bytes(n) if zero else rng.bytes(n)
    whole = [one for one in records_of(data) if one.opcode == CHUNK]
    touched = [one for one in whole if one.offset < at + n and one.offset + one.length > at]
    found, damage = scanned(bytes(content))
    assert found >= len(whole) - len(touched)
    same = bytes(content) == data
    in_order = sorted(damage, key=lambda one: one.offset)
    assert damage == in_order
    assert same or damage or not touched


def test_false_chunk_heads_are_searched_quickly(data: bytes) -> None:
    """The garbage is full of heads of 16 MB chunks: each is rejected by its head, and none is read."""
    false_head = struct.pack("<BQ", CHUNK, 16 << 20)
    chunk = next(one for one in records_of(data) if one.opcode == CHUNK)

    class Counting(io.BytesIO):
        taken = 0

        def read(self, size: int | None = -1, /) -> bytes:
            got = super().read(size)
            self.taken += len(got)
            return got

    field = false_head * 20_000
    file = Counting(data[: chunk.offset] + field + data[chunk.offset :] + bytes(17 << 20))
    found = [one for one in scan(file, len(file.getbuffer())) if isinstance(one, Record) and one.opcode == CHUNK]
    assert len(found) == scanned(data)[0]
    assert file.taken < 100 << 20


# ------------------------------------------------------------------ other readers


def by_small_mcap(path: Path) -> Content:
    content: Content = {}
    with path.open("rb") as file:
        for _, channel, message in read_message(file):
            content.setdefault(channel.topic, []).append((message.log_time, bytes(message.data)))
    return content


@pytest.mark.parametrize("compression", ["auto", "none", "lz4", "zstd"])
def test_finished_and_recovered_files_are_readable_by_every_reader(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "whole.mcap"
    content = write_part(path, compression=compression)
    assert {topic: sorted(rows) for topic, rows in by_small_mcap(path).items()} == content
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    report = recover(cut)
    assert report.recovered is not None
    (session,) = open_logs([cut])
    expected = read_all(session)
    assert sum(map(len, expected.values())) > 500
    assert official(report.recovered) == official(report.recovered, seeking=False) == expected
    assert by_small_mcap(report.recovered) == expected
    verdict = mcap_doctor(report.recovered)
    assert verdict.returncode == 0, verdict.stdout
    with report.recovered.open("rb") as file:
        summary = get_summary(file)
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == sum(map(len, expected.values()))
    assert examine(report.recovered).whole


# ------------------------------------------------------------------ what stands in a directory


def test_lost_messages_are_counted_exactly_if_the_end_is_intact(tmp_path: Path, data: bytes) -> None:
    content = bytearray(data)
    content[700_000:765_536] = bytes(65_536)
    path = tmp_path / "middle.mcap"
    path.write_bytes(bytes(content))
    report = recover(path)
    assert report.messages_lost == 1266 - sum(report.messages.values())
    assert 0 < report.messages_lost < 500
    path.write_bytes(data[:1_000_000])
    assert examine(path).messages_lost is None


@pytest.mark.slow
def test_a_log_being_recorded_is_read_without_complaint_and_not_recovered(tmp_path: Path) -> None:
    """A copy of the content so far would be mistaken for the log when it is finished."""
    path = tmp_path / f"{INFO.session_id}_0.mcap"
    writer = PartWriter(path, INFO, 0)
    writer.add_channel(1, SCANNER_CHANNEL)
    units = np.zeros((20, 1206), np.uint8)
    writer.add(encode_block(1, 0, START_NS + np.arange(20, dtype=np.int64), units))
    writer.flush()
    (session,) = open_logs([tmp_path])
    assert len(read_all(session)[SCANNER_CHANNEL.topic]) == 20
    assert (session.damage, session.growing) == ([], path)
    with pytest.raises(LogError, match="is being recorded"):
        recover(path)
    told = swath("info", "--json", str(tmp_path))
    assert told.returncode == 0, told.stderr
    assert json.loads(told.stdout)["sessions"][0]["growing"] == path.name
    assert "is still being recorded" in swath("info", str(tmp_path)).stdout
    told = swath("recover", str(tmp_path))
    assert (told.returncode, "nothing to recover" in told.stdout) == (0, True)
    writer.close()
    (session,) = open_logs([tmp_path])
    read_all(session)
    assert len(session.damage) == 1
    assert recover(path).recovered is not None


@pytest.mark.slow
def test_a_part_left_empty_by_a_crash_does_not_affect_the_others(tmp_path: Path) -> None:
    good, cut = tmp_path / "a.mcap", tmp_path / "c.mcap"
    write_part(good)
    write_part(cut, part=1, finish=False)
    (tmp_path / "b.mcap").write_bytes(b"")
    told = swath("info", "--json", str(tmp_path))
    assert told.returncode == 4
    found = json.loads(told.stdout)
    assert found["sessions"][0]["sources"]["scanner/left"]["units"] == 2400
    (line,) = found["passed_over"]
    assert "b.mcap" in line
    told = swath("recover", str(tmp_path))
    assert told.returncode == 3
    assert told.stderr.count("\n") == 1
    assert "b.mcap" in told.stderr
    assert cut.with_suffix(".recovered.mcap").exists()
    assert not good.with_suffix(".recovered.mcap").exists()
    wire = tmp_path / "wire.toml"
    wire.write_text(session_table(tmp_path))
    told = swath("replay", str(tmp_path), "--wire", str(wire))
    assert told.returncode == 0, told.stderr
    assert "passed over" in told.stderr
    with pytest.raises(LogError, match=r"b\.mcap"):
        open_logs([tmp_path])


def test_text_of_a_foreign_log_is_validated_and_escaped(tmp_path: Path) -> None:
    """The text has invalid JSON, invalid numbers, console markup and control characters."""
    path = tmp_path / "stranger.mcap"
    writer = PartWriter(path, INFO, 0)
    writer.add_channel(1, EVENTS_CHANNEL)
    writer.add_channel(2, ChannelSpec("/status/gnss/rover", "json", {}, "swath.Status"))
    event = {"severity": "warning", "source": "x", "code": "[/nothing]", "text": "a\x1b[31mb [bold]c[/] \n d"}
    writer.add(encode_json(1, 0, START_NS, event))
    writer.add(encode_json(1, 1, START_NS, {"text": "only"}))
    for number, text in enumerate((b"{", b"[1]", b"\xff", b"[" * 100_000)):
        unit = np.frombuffer(text, np.uint8).reshape(1, -1)
        writer.add(encode_block(1, 2 + number, np.array([START_NS], np.int64), unit))
        writer.add(encode_block(2, number, np.array([START_NS], np.int64), unit))
    writer.add(encode_json(2, 9, START_NS, {"units": "many", "written": None, "time_state": 5, "time_sigma_ns": "x"}))
    writer.finish()
    told = swath("info", str(path))
    assert told.returncode == 0, told.stderr
    assert "[/nothing]" in told.stdout
    assert "[bold]c[/]" in told.stdout
    assert "\x1b[31mb" not in told.stdout
    assert examine(path).whole


def test_messages_whose_channel_was_lost_are_reported(tmp_path: Path) -> None:
    """Another writer may write the channel's record only once, in the first chunk that uses it."""
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2000, compression=CompressionType.NONE)
        writer.start(profile="swath", library="other")
        writer.add_metadata("swath.session", INFO.to_metadata(0))
        channel = writer.register_channel("/gnss/rover/raw", "x-swath-serial", 0)
        for number in range(100):
            writer.add_message(channel, START_NS + number, b"%0100d" % number, START_NS + number)
        writer.finish()
    (session,) = open_logs([path])
    assert len(read_all(session)["/gnss/rover/raw"]) == 100
    assert session.damage == []
    content = bytearray(path.read_bytes())
    chunks = [one for one in records_of(bytes(content)) if one.opcode == CHUNK]
    content[chunks[0].offset + 100] ^= 1
    path.write_bytes(bytes(content))
    (session,) = open_logs([path])
    assert read_all(session) == {}
    assert sum(entry.damage.messages or 0 for entry in session.damage) == 100
    assert examine(path).messages_lost == 100


def test_timestamps_that_step_back_within_a_batch_are_merged_in_order(tmp_path: Path) -> None:
    path = tmp_path / "steps.mcap"
    writer = PartWriter(path, INFO, 0)
    writer.add_channel(1, SCANNER_CHANNEL)
    writer.add_channel(2, ROVER_CHANNEL)
    rng = np.random.default_rng(5)
    for number in range(20):
        times = START_NS + number * 50_000_000 + rng.integers(0, 60_000_000, 50)
        writer.add(encode_block(1, number * 50, times, np.zeros((50, 30), np.uint8)))
        writer.add(encode_block(2, number, times[:1], np.zeros((1, 9), np.uint8)))
        writer.flush()
    writer.finish()
    (session,) = open_logs([path])
    times = np.concatenate([batch.log_time_ns for batch in session.batches_by_time()])
    assert len(times) == 1020
    assert (np.diff(times) >= 0).all()


def test_the_end_may_be_written_even_if_the_last_chunk_does_not_fit(tmp_path: Path) -> None:
    path = tmp_path / "full.mcap"
    writer = PartWriter(path, INFO, 0)
    writer.add_channel(1, SCANNER_CHANNEL)
    units = np.zeros((400, 1206), np.uint8)
    times = START_NS + np.arange(400, dtype=np.int64)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (600_000, hard))
        writer.add(encode_block(1, 0, times, units))
        writer.flush()
        writer.add(encode_block(1, 400, times, units))
        with pytest.raises(LogWriteError):
            writer.finish()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (writer.written[1], writer.lost[1]) == (400, 400)
    assert examine(path).whole
    assert len(official(path)[SCANNER_CHANNEL.topic]) == 400


def test_empty_units_and_empty_blocks_are_logged(tmp_path: Path) -> None:
    """A datagram may be empty."""
    path = tmp_path / "empty.mcap"
    writer = PartWriter(path, INFO, 0)
    writer.add_channel(1, SCANNER_CHANNEL)
    none = np.array([], np.int64)
    writer.add(encode_block(1, 0, none, np.zeros((0, 5), np.uint8)))
    writer.add(encode_block(1, 0, START_NS + np.arange(3, dtype=np.int64), np.zeros((3, 0), np.uint8)))
    writer.finish()
    (session,) = open_logs([path])
    assert read_all(session) == official(path) == {SCANNER_CHANNEL.topic: [(START_NS + n, b"") for n in range(3)]}


PEAK = """
import resource, sys
from pathlib import Path
from swath.daemon.log.reader import open_logs
from swath.daemon.log.recover import recover
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
path = Path(sys.argv[1])
count = sum(len(batch.units) for session in open_logs([path]) for batch in session.batches_by_time())
saved = recover(path).messages.total()
print(count, saved, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


@pytest.mark.slow
def test_a_log_of_any_length_is_read_and_recovered_in_little_memory(tmp_path: Path) -> None:
    """Merging by time holds one second, here 24 MB, and a chunk or two."""
    path = tmp_path / "long.mcap"
    writer = PartWriter(path, INFO, 0)
    writer.add_channel(1, SCANNER_CHANNEL)
    units = np.random.default_rng(0).integers(0, 256, (200, 1206), dtype=np.uint8)
    for number in range(500):
        times = START_NS + (number * 200 + np.arange(200, dtype=np.int64)) * 50_000
        writer.add(encode_block(1, number * 200, times, units))
    writer.flush()
    writer.close()
    assert path.stat().st_size > 120e6
    done = subprocess.run([sys.executable, "-c", PEAK, str(path)], capture_output=True, text=True, cwd=ROOT, check=True)
    count, saved, peak_kb = map(int, done.stdout.split())
    assert count == saved == 100_000
    assert peak_kb < 60_000
