"""Damage to the records between chunks, which have no CRC: no good chunk is passed over, nothing is lost silently."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_mcap import get_summary, read_message

from daemon.log.format import LogError
from daemon.log.reader import open_logs
from daemon.log.recover import examine, recover
from daemon.log.scan import Damage, Record, scan, unpack_chunk
from tests.daemon.test_log import Content, doctor, official, read_all, write_part

CHUNK, INDEX, DATA_END = 6, 7, 15


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A finished part."""
    path = tmp_path_factory.mktemp("log") / "whole.mcap"
    write_part(path)
    return path.read_bytes()


def records_of(data: bytes) -> list[Record]:
    found = list(scan(io.BytesIO(data), len(data)))
    assert not any(isinstance(one, Damage) for one in found)
    return [one for one in found if isinstance(one, Record)]


def scanned(data: bytes) -> tuple[int, list[Damage]]:
    """Good chunks and damage."""
    found = list(scan(io.BytesIO(data), len(data)))
    chunks = sum(isinstance(one, Record) and one.opcode == CHUNK for one in found)
    return chunks, [one for one in found if isinstance(one, Damage)]


# ------------------------------------------------------------------ the end


def test_every_cut_of_the_end_is_told_and_mended(tmp_path: Path, data: bytes) -> None:
    """Nothing of the data is lost, but no other reader opens such a file by its index."""
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


def test_every_byte_of_the_end_that_is_wrong_is_told(data: bytes) -> None:
    end = records_of(data)[-1]
    chunks, _ = scanned(data)
    for at in range(end.offset, len(data)):
        if end.offset + 9 <= at < end.offset + 13:
            continue  # the CRC of all data, which nobody needs where each chunk has its own
        content = bytearray(data)
        content[at] ^= 0x10
        found, damage = scanned(bytes(content))
        assert damage, at
        assert found == chunks


def test_padding_behind_the_end_is_told(data: bytes) -> None:
    _, damage = scanned(data + bytes(4096))
    assert [one.what for one in damage] == ["index and footer are missing, cut off or wrong"]


# ------------------------------------------------------------------ between chunks


def test_a_wrong_head_outside_chunks_leads_past_no_chunk(data: bytes) -> None:
    """Every bit of every head between chunks: all chunks are still read, and what is unreadable is told."""
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
            continue  # first and last time: an index for others, of no use to us
        content = bytearray(data)
        content[at] ^= 0x41
        found, damage = scanned(bytes(content))
        assert found == chunks - 1, at - victim.offset
        assert damage


def test_records_of_others_are_passed_over(tmp_path: Path, data: bytes) -> None:
    """An opcode we do not know is none of our business; official readers pass over it as well."""
    chunk = next(one for one in records_of(data) if one.opcode == CHUNK)
    private = struct.pack("<BQ", 0x93, 5000) + bytes(range(250)) * 20
    path = tmp_path / "private.mcap"
    path.write_bytes(data[: chunk.offset] + private + data[chunk.offset :])
    chunks, damage = scanned(path.read_bytes())
    assert chunks == scanned(data)[0]
    assert [one.what for one in damage] == ["index and footer are missing, cut off or wrong"]  # it points elsewhere now


def test_messages_that_no_crc_covers_are_not_used(tmp_path: Path, data: bytes) -> None:
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
def test_bytes_overwritten_anywhere_cost_what_they_touch_and_no_more(
    data: bytes, seed: int, n: int, zero: bool
) -> None:
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


def test_a_field_of_false_chunk_heads_is_searched_fast(data: bytes) -> None:
    """Garbage full of what looks like a chunk of 16 MB: each is weighed by its head, none is read."""
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
def test_finished_and_recovered_files_for_every_reader(tmp_path: Path, compression: str) -> None:
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
    verdict = doctor(report.recovered)
    assert verdict.returncode == 0, verdict.stdout
    with report.recovered.open("rb") as file:
        summary = get_summary(file)
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == sum(map(len, expected.values()))
    assert examine(report.recovered).whole
