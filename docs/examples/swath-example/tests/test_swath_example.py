"""Tests both drivers by their encoders: values computed by hand, any cut of the stream, bytes that are no frame."""

from __future__ import annotations

import math

import numpy as np
import pytest
from swath_example import receiver, scanner

from swath.drivers.interface import (
    Chunk,
    ChunkBatch,
    DeviceClockSamples,
    DeviceSettings,
    DriverSettingsError,
    GnssFix,
    Record,
    ScannerReturns,
    TimeMessage,
)

STREAM = (
    b"noise" + receiver.encode(2400, 345_000, 47.5, 9.25, 812.345) + b"EX" + receiver.encode(2400, 345_200, 0, 0, 0)
)
FRAMES = 2 * (receiver.HEAD_BYTES + receiver.FIX.size + receiver.CRC_BYTES)


def read_in_pieces(size: int) -> list[Record]:
    """Return what the receiver's parser makes of the stream in pieces of a size; every byte must be counted."""
    parser = receiver.DRIVER.make_parser(DeviceSettings("gnss/rover"))
    records = []
    for start in range(0, len(STREAM), size):
        records += parser.feed(Chunk("gnss/rover", 1000, STREAM[start : start + size]))
    records += parser.close()
    counters = parser.counters
    assert (counters.bytes, counters.bytes_framed, counters.bytes_skipped) == (len(STREAM), FRAMES, 7)
    return records


def test_a_fix_has_radians_and_metres_and_names_its_second() -> None:
    time, fix, *_ = read_in_pieces(len(STREAM))
    assert isinstance(time, TimeMessage)
    assert (time.time.week, time.time.time_ns, time.valid) == (2400, 345_000_000_000, True)
    assert isinstance(fix, GnssFix)
    assert fix.lat_rad == pytest.approx(math.radians(47.5), abs=1e-9)
    assert fix.height_m == pytest.approx(812.345)


@pytest.mark.parametrize("size", [1, 2, 7, 50])
def test_the_same_bytes_give_the_same_records_however_they_are_cut(size: int) -> None:
    assert read_in_pieces(size) == read_in_pieces(len(STREAM))


def test_a_return_has_metres_and_the_time_of_its_own_pulse() -> None:
    returns = np.array([(0, 100_000, 0, 0, 7, 0), (2000, 50_000, -4500, 1000, 9, 1)], scanner.RETURN)
    data = scanner.encode(3, 5_000_000, 4_000_000, 1, returns)
    settings = DeviceSettings("scanner/left", {"options": {"range_unit_mm": 2, "least_intensity": 8}})
    clock, found = scanner.DRIVER.make_parser(settings).feed(Chunk("scanner/left", 1000, data))
    assert isinstance(clock, DeviceClockSamples)
    assert clock.rows[["device_time_ns", "pps_time_ns", "pps_count", "locked"]].tolist() == [
        (5_002_000, 4_000_000, 1, 1)
    ]
    assert isinstance(found, ScannerReturns)
    [row] = found.rows
    assert (row["device_time_ns"], row["range_m"], row["pulse_id"]) == (5_002_000, 100.0, 241)
    assert row["encoder_rad"] == pytest.approx(math.radians(-45.0))
    assert row["elevation_rad"] == pytest.approx(math.radians(10.0))


@pytest.mark.parametrize("first", [0, 2**32 - 2])
def test_datagrams_of_others_and_gaps_are_counted(first: int) -> None:
    parser = scanner.DRIVER.make_parser(DeviceSettings("scanner/left"))
    numbers = [first, (first + 1) % 2**32, (first + 4) % 2**32]
    sent = [scanner.encode(number, 0, -1, 0, np.zeros(2, scanner.RETURN)) for number in numbers]
    units = np.frombuffer(b"".join([*sent, b"x" * len(sent[0])]), np.uint8).reshape(4, -1)
    parser.feed_batch(ChunkBatch("scanner/left", np.zeros(4, np.int64), units))
    parser.feed(Chunk("scanner/left", 0, b"?"))
    assert dict(parser.counters.errors) == {"bad_magic": 1, "bad_length": 1, "sequence_gap": 2}
    counters = parser.counters
    assert counters.bytes == counters.bytes_framed + counters.bytes_skipped


def test_a_wrong_option_is_refused() -> None:
    with pytest.raises(DriverSettingsError, match="range_unit_mm"):
        scanner.DRIVER.make_parser(DeviceSettings("scanner/left", {"options": {"range_unit_mm": 3}}))
