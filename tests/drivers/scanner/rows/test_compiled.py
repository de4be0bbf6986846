"""Tests that compiled loops write what `ReturnSlots.fill` writes, byte for byte."""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from swath.drivers.driver import Driver, all_drivers
from swath.drivers.parser import DeviceSettings, DriverSettingsError, PacketParser
from swath.drivers.scanner.rows.compiled import fill
from swath.drivers.scanner.rows.filler import filler
from swath.drivers.scanner.rows.slots import FlagRule, ReturnSlots, common_words, in_order, returns_table
from swath.drivers.scanner.srep.layout import SrepHeader, encode_datagram
from swath.drivers.scanner.srep.parser import SrepParser
from swath.georef.arrays import StructArray, UInt64Array
from swath.georef.records import Record, ScannerReturns
from tests.drivers.builders import feed
from tests.fuzz.recordings import packets_of, settings_of

SCANNERS = all_drivers("scanner")
NO_RECORDING = {"velodyne-hdl32e", "velodyne-vls128"}  # they are decoded as the VLP-32C
CONTENT = np.dtype([("intensity", "<u2"), ("pulse_width", "<u2"), ("range", "<u4")])
NAMED = [None, (True, True), (True, False), (False, True), (False, False)]


def parser_of(driver: Driver, settings: DeviceSettings) -> PacketParser | None:
    """Return the parser, or None if the file belongs to another head."""
    try:
        parser = driver.make_parser(settings)
    except DriverSettingsError:
        return None
    assert isinstance(parser, PacketParser)
    return parser


def bytes_of(rows: StructArray) -> list[bytes]:
    """Return the bytes of each column: a row's own also hold what lies between its fields, which means nothing."""
    return [rows[name].tobytes() for name in rows.dtype.names or ()]


def row_bytes(records: list[Record]) -> list[list[bytes]]:
    return [bytes_of(record.rows) for record in records if isinstance(record, ScannerReturns)]


@pytest.mark.parametrize("protocol", sorted(set(SCANNERS) - NO_RECORDING))
def test_compiled_and_plain_code_give_the_same_rows_of_recordings(protocol: str) -> None:
    driver = SCANNERS[protocol]
    seen = 0
    for settings in settings_of(driver):
        if (first := parser_of(driver, settings)) is None:
            continue
        for units in packets_of(driver, first):
            plain, compiled = driver.make_parser(settings), driver.make_parser(replace(settings, compiled=True))
            assert isinstance(plain, PacketParser)
            assert isinstance(compiled, PacketParser)
            rows = row_bytes(feed(plain, units[:600]))
            assert row_bytes(feed(compiled, units[:600])) == rows
            assert compiled.counters == plain.counters
            seen += len(rows)
    assert seen > 0


@pytest.mark.parametrize(("slots", "polygon"), list(product([1, 2, 3, 8], [False, True])))
def test_compiled_and_plain_code_give_the_same_rows_for_any_number_of_slots(slots: int, polygon: bool) -> None:
    random = np.random.default_rng(slots)
    geometry = {"geometry": {"type": "polygon", "facets": 4}} if polygon else {}
    settings = DeviceSettings("scanner/left", {"mirror_factor": 2.0, **geometry})
    units = []
    for sequence in range(20):
        ranges = random.integers(1, 1 << 32, (50, slots)) * (random.random((50, slots)) < 0.6)
        header = SrepHeader(flags=5, sequence=sequence, first_ticks=50_000 * sequence, mta_zone=sequence % 4)
        encoder = random.integers(-(1 << 31), 1 << 31, 50)
        widths = random.integers(0, 65536, (50, slots))
        units.append(encode_datagram(header, np.arange(50) * 50, encoder, ranges, widths[::-1], widths))
    rows = row_bytes(feed(SrepParser(settings), units))
    assert len(rows[0][0]) > 0
    assert row_bytes(feed(SrepParser(replace(settings, compiled=True)), units)) == rows


def random_slots(slots: int, named: tuple[bool, bool] | None, seed: int) -> ReturnSlots:
    """Return slots of 40 · 30 pulses with per-pulse values in every possible shape."""
    random = np.random.default_rng(seed)
    numbers = random.integers(0, 1 << 63, (1200, slots), dtype=np.uint64) * (random.random((1200, slots)) < 0.7)
    if slots == 2:
        numbers = in_order(numbers[:, 0], numbers[:, 1])
    host_time_ns, angle = random.integers(-(1 << 62), 1 << 62, (40, 1)), random.random((40, 30))
    offset_ns, zone = random.integers(0, 50_000, (1, 30)), random.integers(0, 256, (40, 1))
    channel = random.integers(0, 1 << 16, (1, 30))
    return ReturnSlots(
        content=numbers.view(CONTENT),
        range_unit_m=0.002,
        common=common_words((40, 30), channel=channel, mta_zone=zone, flags=4),
        shape=(40, 30),
        pulse_id=random.integers(0, 1 << 62, 40),
        per_pulse={
            "host_time_ns": lambda at: at(host_time_ns),
            "device_time_ns": lambda at: at(host_time_ns) + at(offset_ns),
            "encoder_rad": lambda at: at(angle),
        },
        rule=None if named is None else FlagRule(strength_of, *named),
        pulse_width_unit_ns=np.float32(0.01) if seed % 2 else None,
    )


def strength_of(returns: StructArray) -> UInt64Array:
    """Return different values for the returns of a pulse, as `FlagRule` wants."""
    strength: UInt64Array = returns["intensity"].astype(np.uint64) << np.uint64(32) | returns["range"]
    return strength


@pytest.mark.parametrize(("named", "seed"), list(product(NAMED, [1, 2])))
def test_compiled_and_plain_code_give_the_same_rows_for_any_pulses(named: tuple[bool, bool] | None, seed: int) -> None:
    for slots in (2, 3) if named else (1, 2, 5):
        made = random_slots(slots, named, seed)
        expected, table = returns_table(made.content.size), returns_table(made.content.size)
        table.view(np.uint8)[:] = 0xA5  # arbitrary previous content
        count = made.fill(expected)
        assert count > 500
        assert fill(made, table) == count
        assert table[:count].tobytes() == expected[:count].tobytes()
        assert set(table[count:].tobytes()) <= {0xA5}


def test_without_numba_one_line_names_the_missing_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "swath.drivers.scanner.rows.compiled")
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(DriverSettingsError, match=r"needs numba; install with: pip install '\.\[process\]'"):
        filler(compiled=True)
    assert filler(compiled=False) is ReturnSlots.fill
