"""Tests SREP for resolving emissions of echoes: pulses without a return, and the rates in headers."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from swath.drivers.parser import DeviceSettings
from swath.drivers.scanner.srep.layout import SrepHeader, encode_datagram
from swath.drivers.scanner.srep.parser import FLAG_NO_POINT, SrepParser
from swath.georef.arrays import StructArray
from swath.georef.records import ChunkBatch, ScannerReturns
from swath.georef.stream.stream import CONTEXT_FLAG

pytestmark = pytest.mark.xdist_group("kernels")

PULSES, COUNTS = 7, 524_288


def parser(*, emissions: bool, compiled: bool = False, **config: object) -> SrepParser:
    made = SrepParser(DeviceSettings("scanner/left", {"mirror_factor": 2.0} | config, compiled=compiled))
    made.emissions = emissions
    return made


def datagrams(slots: int, zones: Sequence[int], seed: int = 5) -> list[bytes]:
    """Return datagrams in which four pulses in ten have no return, and one has no return."""
    random = np.random.default_rng(seed)
    made = []
    for number, zone in enumerate(zones):
        ranges = random.integers(1, 2**32, (PULSES, slots)) * (random.random((PULSES, slots)) < 0.6 ** (1 / slots))
        if number == 3:
            ranges[:] = 0
        header = SrepHeader(number, mta_zone=zone, flags=1, tick_hz=70_000_000, first_ticks=10**9 + 9_000 * number)
        pulses = np.arange(PULSES)
        encoder = 100 * (PULSES * number + pulses)
        made.append(encode_datagram(header, 1_000 * pulses, encoder, ranges, ranges % 60_000, ranges % 999))
    return made


def rows_of(reader: SrepParser, units: list[bytes], at_once: int) -> StructArray:
    rows = []
    for first in range(0, len(units), at_once):
        some = units[first : first + at_once]
        batch = np.frombuffer(b"".join(some), np.uint8).reshape(len(some), -1)
        batch.flags.writeable = False
        host_ns = np.arange(first, first + len(some), dtype=np.int64)
        for record in reader.feed_batch(ChunkBatch("scanner/left", host_ns, batch)):
            rows += [record.rows] if isinstance(record, ScannerReturns) else []
    assert not reader.counters.errors
    return np.concatenate(rows)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("slots", [1, 3])
@pytest.mark.parametrize("at_once", [1, 4, 12])
def test_every_pulse_gives_a_row_if_ranges_are_apparent(slots: int, at_once: int, compiled: bool) -> None:
    zones = [255, 255, 2, 255, 255, 0, 0, 255, 255, 255, 255, 3]
    units = datagrams(slots, zones)
    plain = rows_of(parser(emissions=False), units, at_once)
    rows = rows_of(parser(emissions=True, compiled=compiled), units, at_once)
    alone = rows["number_of_returns"] == 0
    np.testing.assert_array_equal(rows[~alone], plain)
    assert alone.any()
    empty = rows[alone]
    for name in ("range_m", "intensity", "pulse_width_ns", "return_number", "channel"):
        assert not empty[name].any()
    assert (empty["flags"] == FLAG_NO_POINT | 4).all()
    assert (empty["mta_zone"] == 255).all()
    # all pulses of the datagrams whose byte 15 is 255, in order, each with its own time and encoder
    datagram, place = rows["pulse_id"].astype(np.int64) >> 16, rows["pulse_id"].astype(np.int64) & 0xFFFF
    apparent = rows["mta_zone"] == 255
    pulses = np.unique(np.stack([datagram[apparent], place[apparent]], axis=1), axis=0)
    wanted = [(number, pulse) for number, zone in enumerate(zones) if zone == 255 for pulse in range(PULSES)]
    assert pulses.tolist() == [list(pair) for pair in wanted]
    assert (np.diff(rows["pulse_id"].astype(np.int64)) >= 0).all()
    ticks = 10**9 + 9_000 * datagram + 1_000 * place
    assert rows["device_time_ns"].tolist() == [tick * 10**9 // 70_000_000 for tick in ticks.tolist()]
    np.testing.assert_allclose(
        rows["encoder_rad"], 100 * (PULSES * datagram + place) * (2 * math.tau / COUNTS), rtol=0, atol=1e-12
    )
    assert empty["host_time_ns"].tolist() == datagram[alone].tolist()


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("slots", [1, 3])
def test_every_pulse_gives_a_row_if_those_without_return_are_asked_for(slots: int, compiled: bool) -> None:
    units = datagrams(slots, [255, 0, 1, 2, 0, 0])
    plain = rows_of(parser(emissions=False), units, 4)
    reader = parser(emissions=False, compiled=compiled)
    reader.unanswered = True
    rows = rows_of(reader, units, 4)
    alone = rows["number_of_returns"] == 0
    np.testing.assert_array_equal(rows[~alone], plain)
    assert (rows["flags"][alone] == FLAG_NO_POINT | 4).all()
    places = [number << 16 | pulse for number in range(6) for pulse in range(PULSES)]
    assert np.unique(rows["pulse_id"].astype(np.int64)).tolist() == places


def test_pulses_without_return_are_omitted_unless_requested() -> None:
    units = datagrams(2, [255] * 5)
    assert rows_of(parser(emissions=False), units, 5)["number_of_returns"].all()
    assert parser(emissions=False).tell_rates is None


def test_pulses_of_a_polygon_carry_their_facet() -> None:
    rows = rows_of(
        parser(emissions=True, geometry={"type": "polygon", "facets": 512}), datagrams(1, [255] * 5), at_once=5
    )
    place = rows["pulse_id"].astype(np.int64)
    encoder = 100 * (PULSES * (place >> 16) + (place & 0xFFFF))
    np.testing.assert_array_equal(rows["channel"], encoder * 512 // COUNTS)
    assert rows["channel"].max() == 3


def test_flag_of_rows_without_a_point_equals_the_context_flag() -> None:
    assert FLAG_NO_POINT == CONTEXT_FLAG


def test_pulse_rates_are_reported_on_change_before_their_returns() -> None:
    told: list[tuple[int, float, int]] = []
    rates = [(100_000_000, 10**7)] * 3 + [(100_050_000, 10**7), (120_000_000, 10**7)] * 2 + [(0, 10**7), (0, 7 * 10**7)]
    units = [
        encode_datagram(SrepHeader(at, prf_mhz=prf, tick_hz=hz, first_ticks=hz * at), [0], [0], [[1]])
        for at, (prf, hz) in enumerate(rates)
    ]
    for at_once in (1, len(units)):
        told.clear()
        reader = parser(emissions=False)
        reader.tell_rates = lambda *rate: told.append(rate)
        rows_of(reader, units, at_once)
        assert told == [
            (0, 100_000.0, 10**7),
            (4 << 16, 120_000.0, 10**7),
            (5 << 16, 100_050.0, 10**7),
            (6 << 16, 120_000.0, 10**7),
            (7 << 16, 0.0, 10**7),
            (8 << 16, 0.0, 7 * 10**7),
        ]
