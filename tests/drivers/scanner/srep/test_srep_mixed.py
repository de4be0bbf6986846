"""Tests SREP datagrams of mixed lengths decoded at once, compared with one by one, with all kinds of errors."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fastcrc.crc32 import iso_hdlc as crc32

from swath.drivers.parser import DeviceSettings
from swath.drivers.scanner.rows.slots import ReturnSlots
from swath.drivers.scanner.sequence import LATE_DATAGRAMS
from swath.drivers.scanner.srep import parser as srep
from swath.drivers.scanner.srep.layout import CRC, SrepHeader, encode_datagram
from swath.drivers.scanner.srep.parser import SrepParser
from swath.georef.arrays import StructArray
from swath.georef.records import Chunk, ChunkBatch, Record
from tests.drivers.harness import Outcome, outcome

pytestmark = pytest.mark.xdist_group("kernels")

SOURCE = "scanner/left"
POLYGON = {"type": "polygon", "facets": 5}
STEP_NS = 7_000_000  # between datagrams, of host time


class Reader:
    """A parser with everything that it returned."""

    def __init__(self, *, compiled: bool = False, emissions: bool = False, clock_only: bool = False) -> None:
        settings = DeviceSettings(SOURCE, {"mirror_factor": 2.0, "geometry": POLYGON}, compiled=compiled)
        self.parser = SrepParser(settings, clock_only=clock_only)
        self.parser.emissions = emissions
        self.parser.tell_rates = lambda *rates: self.told.append(rates)
        self.told: list[tuple[int, float, int]] = []
        self.records: list[Record] = []

    def one_by_one(self, datagrams: list[bytes]) -> Reader:
        for at, datagram in enumerate(datagrams):
            self.records += self.parser.feed(Chunk(SOURCE, at * STEP_NS, datagram))
        return self

    def together(self, datagrams: list[bytes], cuts: random.Random, longest: int) -> Reader:
        """Feed at most ``longest`` datagrams at once, in batches of equal length, some of them cut, as from the log."""
        held: list[ChunkBatch] = []
        left = cuts.randint(1, longest)
        at = 0
        while at < len(datagrams):
            stop = at + 1
            most = min(left, cuts.randint(1, 20))
            while stop < len(datagrams) and stop - at < most and len(datagrams[stop]) == len(datagrams[at]):
                stop += 1
            rows = np.zeros((stop - at, 31 + len(datagrams[at])), dtype=np.uint8)  # with a message's header before each
            rows[:, 31:] = np.frombuffer(b"".join(datagrams[at:stop]), np.uint8).reshape(stop - at, -1)
            rows.flags.writeable = False
            held.append(ChunkBatch(SOURCE, np.arange(at, stop, dtype=np.int64) * STEP_NS, rows[:, 31:]))
            left -= stop - at
            at = stop
            if not left or at == len(datagrams):
                self.records += self.parser.feed_batches(held)
                held, left = [], cuts.randint(1, longest)
        return self

    def outcome(self) -> Outcome:
        """Return all records and counters."""
        return outcome(self.records, self.parser)

    def state(self) -> dict[str, Any]:
        """Return everything on which later output depends, and what was reported."""
        kept = {name: value for name, value in vars(self.parser).items() if not callable(value)}
        del kept["_scan_angle"]  # which never changes
        thinner, tracker = kept.pop("_thinner"), dict(vars(kept.pop("_tracker")))
        oldest = tracker["_last"].unwrapped - LATE_DATAGRAMS
        tracker["_missing"] = {at for at in tracker["_missing"] if at >= oldest}  # older numbers are never looked up
        return kept | tracker | {"thinner": thinner and vars(thinner), "told": self.told}


def assert_alike(one: Reader, other: Reader) -> None:
    assert one.outcome() == other.outcome()
    assert one.state() == other.state()


def datagram(chance: random.Random, header: SrepHeader, slots: int) -> bytes:
    """Return a datagram of few, many or no pulses, some with fewer returns than slots."""
    pulses = chance.choice([0, 1, 2, 9, 9, 9, 30, 60])
    numbers = np.random.default_rng(chance.getrandbits(32))
    ranges = numbers.integers(1, 1 << 32, (pulses, slots)) * (numbers.random((pulses, slots)) < 0.6)
    ticks, encoder = numbers.integers(0, 1 << 32, pulses), numbers.integers(-(1 << 20), 1 << 20, pulses)
    widths = numbers.integers(0, 1 << 16, (pulses, slots))
    return encode_datagram(header, np.sort(ticks), encoder, ranges, widths[::-1], widths)


def damaged(chance: random.Random, good: bytes) -> bytes:
    """Return the datagram truncated, extended, with a flipped bit, or with an impossible header and a right CRC."""
    kind = chance.randrange(8)
    if kind == 0:
        return good[: chance.choice([0, 1, 47, 51])]
    if kind == 1:
        return good[: chance.choice([52, 60, len(good) - 1])]
    if kind == 2:
        return good + bytes(8)
    if kind == 3:
        at = chance.randrange(len(good))
        return good[:at] + bytes([good[at] ^ 1 << chance.randrange(8)]) + good[at + 1 :]
    at, value = [(0, b"SREQ"), (4, b"\x02"), (20, bytes(4)), (40, bytes(4))][kind - 4]
    data = good[:at] + value + good[at + len(value) : -CRC.size]
    return data + CRC.pack(crc32(data))


def mixed(seed: int, number: int = 400) -> list[bytes]:
    """Return datagrams of any length with gaps, late and repeated ones."""
    chance = random.Random(seed)
    header, slots = SrepHeader(sequence=2**32 - 50, flags=5, pps_count=3, prf_mhz=2_000_000_000), 2
    units: list[bytes] = []
    for _ in range(number):
        step = 1 if chance.random() < 0.95 else chance.choice([2, 5, 100])
        ticks = header.first_ticks + 30_000 * step
        header = replace(header, sequence=(header.sequence + step) % 2**32, first_ticks=ticks)
        if chance.random() < 0.1:
            header = replace(header, mta_zone=chance.choice([0, 1, 7, 255, 255]))
        if chance.random() < 0.05:
            header = replace(header, flags=chance.choice([0, 1, 5]), prf_mhz=chance.choice([10**9, 2 * 10**9]))
        if chance.random() < 0.02:
            header = replace(header, tick_hz=chance.choice([10_000_000, 12_500_001, 70_000_000]))
        if chance.random() < 0.02:
            header = replace(header, encoder_counts=chance.choice([524_288, 100_000]))
        if chance.random() < 0.02:
            header = replace(header, pps_count=chance.choice([0, 3, 4]))
        if chance.random() < 0.03:
            slots = chance.choice([1, 2, 3])
        unit = datagram(chance, header, slots)
        units.append(damaged(chance, unit) if chance.random() < 0.06 else unit)
        if chance.random() < 0.05:
            units.insert(chance.randrange(max(0, len(units) - 6), len(units)), unit)
        if chance.random() < 0.03:
            units.append(units.pop(max(0, len(units) - 1 - chance.randrange(5))))
    return units


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("longest", [7, 10_000])
def test_any_mix_gives_the_rows_of_its_single_datagrams(seed: int, longest: int) -> None:
    units = mixed(seed)
    for emissions in (False, True):
        alone = Reader(emissions=emissions).one_by_one(units)
        for compiled in (False, True):
            some = Reader(emissions=emissions, compiled=compiled).together(units, random.Random(seed), longest)
            assert_alike(some, alone)


def test_the_mix_contains_every_kind_of_error() -> None:
    """Otherwise the previous test would prove little."""
    counters = Reader().one_by_one(mixed(0) + mixed(1)).parser.counters
    assert {"bad_length", "bad_magic", "bad_version", "bad_header"} < set(counters.errors)
    assert {"sequence_gap", "out_of_order", "duplicate", "restart"} < set(counters.errors)
    assert counters.bad_checksums > 0
    assert counters.messages["srep"] > 700
    assert counters.bytes == counters.bytes_framed + counters.bytes_skipped


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("longest", [7, 10_000])
def test_clock_records_of_a_mix_equal_those_of_its_single_datagrams(seed: int, longest: int) -> None:
    units = mixed(seed)
    some = Reader(clock_only=True).together(units, random.Random(seed), longest)
    assert_alike(some, Reader(clock_only=True).one_by_one(units))
    assert 30 < len(some.outcome().rows["DeviceClockSamples"]) < 100


@pytest.mark.parametrize("most", [1, 40, 300])
def test_pieces_of_a_mix_have_at_most_the_working_number_of_slots(monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    units = mixed(9)
    alone = Reader().one_by_one(units)
    monkeypatch.setattr(srep, "BLOCK_SLOTS", most)
    some, filled = Reader(), list[int]()
    fill = some.parser._fill

    def noted(slots: ReturnSlots, table: StructArray) -> int:
        filled.append(slots.content[:, slots.others :].size)
        return fill(slots, table)

    some.parser._fill = noted
    assert_alike(some.together(units, random.Random(0), 10_000), alone)
    assert max(filled) <= max(most, 60 * 3)  # or one datagram
    assert most == 1 or len(filled) < 0.5 * alone.parser.counters.messages["srep"]


def test_a_mix_of_one_layout_is_one_piece() -> None:
    """This holds for any number of lengths, and with datagrams without pulses or encoder between."""
    ranges = [np.full((pulses, 2), 5) for pulses in (3, 0, 1, 2, 0, 7)]
    units = [
        encode_datagram(SrepHeader(at, encoder_counts=100 if len(r) else 0), range(len(r)), 0, r)
        for at, r in enumerate(ranges)
    ]
    reader, shapes = Reader(), list[tuple[int, int]]()
    fill = reader.parser._fill

    def noted(slots: ReturnSlots, table: StructArray) -> int:
        shapes.append(slots.shape)
        return fill(slots, table)

    reader.parser._fill = noted
    assert_alike(reader.together(units, random.Random(0), 10_000), Reader().one_by_one(units))
    assert shapes == [(13, 1)]
    assert reader.parser.feed_batches([]) == []


def test_empty_batches_give_no_rows() -> None:
    reader = Reader(clock_only=True)
    for length in (0, 20, 52):
        nothing = ChunkBatch(SOURCE, np.zeros(0, dtype=np.int64), np.zeros((0, length), dtype=np.uint8))
        assert reader.parser.feed_batch(nothing) == []
        assert reader.parser.feed_batches([nothing, nothing]) == []
    assert not reader.parser.counters.errors
    unit = encode_datagram(SrepHeader(), [], [], np.zeros((0, 1)))
    one = ChunkBatch(SOURCE, np.zeros(1, dtype=np.int64), np.frombuffer(unit, np.uint8).reshape(1, -1))
    assert len(reader.parser.feed_batches([nothing, one, nothing])) == 2
