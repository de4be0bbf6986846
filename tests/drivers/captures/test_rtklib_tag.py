"""Tests RTKLIB's time tags: its own files, files laid out by hand from src/stream.c, and our writer's."""

from __future__ import annotations

import contextlib
import gzip
import io
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swath.drivers.captures.opening import CaptureTally, read_tagged
from swath.drivers.captures.serial import TagWriter, read_tags
from swath.drivers.transports.base import TransportError

FIXTURES = Path(__file__).parents[3] / "fixtures" / "rtklib"
HEAD = b"TIMETAG RTKLIB 2.4.3 b34".ljust(60, b"\0") + struct.pack("<I", 123_456)
OPENED_UTC_S = 1_700_000_000  # 2023-11-14T22:13:20Z
OPENED_GPS_S = OPENED_UTC_S + 18  # GPS − UTC since 2017, IERS Bulletin C 52
WRITES = [(0, 100), (1000, 300), (1000, 301), (2_500, 400)]  # milliseconds, size of the stream

LAYOUTS = {"4 and 4": ("I", "I"), "4 and 8": ("I", "Q"), "8 and 8": ("q", "Q"), "8 and 4": ("q", "I")}


def tag_file(
    seconds: str = "I", size: str = "I", writes: list[tuple[int, int]] = WRITES, fraction: float = 0.25
) -> bytes:
    """Return a tag file whose fields have these struct codes."""
    body = struct.pack(f"<{seconds}d", OPENED_GPS_S, fraction)
    return HEAD + body + b"".join(struct.pack(f"<I{size}", *write) for write in writes)


def expected(writes: list[tuple[int, int]] = WRITES) -> list[tuple[int, int]]:
    """Return the times and sizes stored in the file."""
    return [((OPENED_UTC_S * 1000 + 250 + tick) * 1_000_000, size) for tick, size in writes]


@pytest.mark.parametrize("count", [0, 1, 2, 4, 400])
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("fraction", [0.25, 0.123, 0.999999, 1e-6])
def test_every_tag_layout_is_recognised_by_its_field_sizes(layout: str, count: int, fraction: float) -> None:
    writes = (WRITES + [(3000 + n, 500 + n * 100) for n in range(count)])[:count]
    seconds, size = LAYOUTS[layout]
    found = list(read_tags(io.BytesIO(tag_file(seconds, size, writes, fraction))))
    assert found == [(time_ns + round((fraction - 0.25) * 1e9), at) for time_ns, at in expected(writes)]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_truncated_entry_is_ignored(layout: str) -> None:
    data = tag_file(*LAYOUTS[layout], [*WRITES, (5000, 450)])
    assert list(read_tags(io.BytesIO(data[:-3]))) == expected()


def test_sizes_and_ticks_of_32_bits_wrap() -> None:
    writes = [(2**32 - 1, 2**32 - 10), (4, 20)]
    many = [(1 + n, 10 + n) for n in range(200)]
    found = list(read_tags(io.BytesIO(tag_file(writes=[*many, *writes]))))[-2:]
    assert [size for _, size in found] == [2**32 - 10, 2**32 + 20]
    assert found[1][0] - found[0][0] == 5_000_000


@pytest.mark.parametrize(
    "data",
    [b"", b"TIMETAG", b"x" * 200, HEAD, HEAD + b"\xff" * 200, HEAD + bytes(100)],
    ids=["empty", "short", "other", "head", "ones", "zeros"],
)
def test_a_file_that_is_not_a_tag_file_is_refused_in_one_line(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "rover.ubx").write_bytes(b"bytes")
    (tmp_path / "rover.ubx.tag").write_bytes(data)
    with pytest.raises(TransportError, match=r"rover.ubx.tag: .*want the time tags of RTKLIB's str2str") as error:
        list(read_tagged(tmp_path / "rover.ubx", tmp_path / "rover.ubx.tag"))
    assert "\n" not in str(error.value)


@given(st.binary(max_size=400))
def test_garbage_raises_only_transport_errors(data: bytes) -> None:
    with contextlib.suppress(ValueError):
        assert all(0 <= size for _, size in read_tags(io.BytesIO(HEAD + data)))


def test_bytes_carry_the_time_at_which_they_were_written(tmp_path: Path) -> None:
    stream = bytes(range(200)) + bytes(200)
    path, tags = tmp_path / "rover.ubx.gz", tmp_path / "rover.ubx.tag"
    path.write_bytes(gzip.compress(stream + b"rest"))
    tags.write_bytes(tag_file())
    units = list(read_tagged(path, tags))
    assert b"".join(unit.data for unit in units) == stream + b"rest"
    assert [unit.time_ns for unit in units] == [time_ns for time_ns, _ in [*expected(), expected()[-1]]]
    assert [len(unit.data) for unit in units] == [100, 200, 1, 99, 4]


def test_receiver_tags_follow_the_epochs_of_its_solution_within_milliseconds() -> None:
    """RTKLIB's own solution has epochs in GPS time; each byte was written within milliseconds of them."""
    text = gzip.decompress((FIXTURES / "gnss_1934_sf.pos.gz").read_bytes()).decode()
    epochs = [line[:23].replace("/", "-").replace(" ", "T") for line in text.splitlines()[1:]]
    epoch_ms = np.array(epochs, "datetime64[ms]").astype(np.int64) - 18_000  # GPS − UTC
    tags = np.array(list(read_tags(io.BytesIO(gzip.decompress((FIXTURES / "gnss_1934.ubx.tag.gz").read_bytes())))))
    assert tags.shape == (7036, 2)
    assert (np.diff(tags, axis=0) >= 0).all()
    written_ms = tags[:, 0] // 1_000_000
    assert (written_ms[0] - epoch_ms[0], written_ms[-1] - epoch_ms[-1]) == (308, 290)
    behind_ms = written_ms[np.searchsorted(written_ms, epoch_ms)] - epoch_ms
    assert np.percentile(behind_ms, 98) < 50


def test_imu_tags_follow_the_clock_of_the_imu(tmp_path: Path) -> None:
    """Each line has the IMU's milliseconds; its time of writing stays within 30 ms of them for 9 minutes."""
    data = gzip.decompress((FIXTURES / "imu_1934.csv.gz").read_bytes()).replace(b"\n", b"\r\n")
    (tmp_path / "imu.csv").write_bytes(data)
    units = list(read_tagged(tmp_path / "imu.csv", FIXTURES / "imu_1934.csv.tag.gz"))
    assert len(units) == 37_632
    assert b"".join(unit.data for unit in units) == data
    ends = np.cumsum([len(unit.data) for unit in units])
    lines = data.splitlines(keepends=True)
    of_line = np.searchsorted(ends, np.cumsum([len(line) for line in lines]))
    written_ms = np.array([unit.time_ns for unit in units])[of_line] // 1_000_000
    ticks_ms = np.array([int(line.rpartition(b",")[2]) for line in lines])
    apart_ms = (written_ms - written_ms[0]) - (ticks_ms - ticks_ms[0])
    assert len(lines) == 54_860
    assert np.abs(apart_ms - np.median(apart_ms)).max() < 30
    assert np.abs(apart_ms - np.median(apart_ms)).mean() < 5


def test_a_stream_with_altered_line_ends_does_not_fit_its_tags() -> None:
    tally = CaptureTally()
    for _ in read_tagged(FIXTURES / "imu_1934.csv.gz", FIXTURES / "imu_1934.csv.tag.gz", tally):
        pass
    assert tally.damage == 1
    assert "counts " in tally.first_damage
    assert "bytes more than imu_1934.csv.gz holds" in tally.first_damage


def test_mismatched_tags_raise_an_error_after_the_good_bytes(tmp_path: Path) -> None:
    path, tags = tmp_path / "rover.ubx", tmp_path / "rover.ubx.tag"
    path.write_bytes(bytes(350))
    tags.write_bytes(tag_file())
    tally = CaptureTally()
    units = list(read_tagged(path, tags, tally))
    assert sum(len(unit.data) for unit in units) == 350
    assert tally.damage == 1
    assert "counts 50 bytes more than rover.ubx holds" in tally.first_damage


@given(
    st.lists(st.tuples(st.integers(0, 10**12), st.integers(1, 1 << 20)), min_size=1, max_size=30),
    st.integers(1_200_000_000 * 10**9, 2**32 * 10**9 - 10**14),
)
def test_written_tags_are_read_back_to_the_millisecond(steps: list[tuple[int, int]], first_ns: int) -> None:
    times = first_ns + np.cumsum([0, *(step for step, _ in steps[:-1])])
    sizes = np.cumsum([size for _, size in steps])
    stream = io.BytesIO()
    writer = TagWriter(stream, first_ns)
    for at in range(0, len(times), 7):
        writer.add(times[at : at + 7], sizes[at : at + 7])
    data = stream.getvalue()
    assert data[:14] == b"TIMETAG RTKLIB"
    assert len(data) == 64 + 12 + 8 * len(steps)
    found = list(read_tags(io.BytesIO(data)))
    assert [size for _, size in found] == sizes.tolist()
    assert [time_ns for time_ns, _ in found] == (times // 10**6 * 10**6).tolist()


def test_tags_written_for_rtklib_never_step_back_in_time() -> None:
    stream = io.BytesIO()
    TagWriter(stream, 10**18).add(np.array([10**18, 10**18 - 10**9, 10**18 + 10**9]), np.array([1, 2, 3]))
    ticks = np.frombuffer(stream.getvalue()[76:], "<u4").reshape(-1, 2)[:, 0]
    assert ticks.tolist() == [0, 0, 1000]
    assert struct.unpack_from("<I", stream.getvalue(), 60) == (10**12 % 2**32,)
