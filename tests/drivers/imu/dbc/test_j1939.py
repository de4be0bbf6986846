"""Tests J1939 by a DBC: messages by PGN, choice of the device, unavailable values, and users' DBC files."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from swath.drivers.can_frames import encode_can_frame
from swath.drivers.captures.opening import read_candump
from swath.drivers.imu.dbc.j1939 import pgn_of
from swath.drivers.imu.dbc.parser import DbcParser
from swath.drivers.imu.nmea2000 import pgn_and_source
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.georef.records import ChunkBatch, Record
from tests.drivers.harness import check_packets
from tests.drivers.imu_dbc import feed, imu_rows
from tests.drivers.recordings import FIXTURES

CASES = FIXTURES / "dbc"
SIGNALS = {
    "specific_force": ["ACCS.ax", "ACCS.ay", "ACCS.az"],
    "angular_rate": ["ARI.gx", "ARI.gy", "ARI.gz"],
}
AT_REST = np.array([0.0, 0.0, -9.81])
MARK = """
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_DEF_ "VFrameFormat" "J1939PG";
"""


def case_settings(case: str, dbc: str = "imu.dbc", extra: str = "", **config: Any) -> DeviceSettings:
    contents = (CASES / case / dbc).read_bytes() + extra.encode()
    return DeviceSettings("imu/main", {"dbc": dbc, "signals": SIGNALS, **config}, {"dbc": contents})


def frames_of(case: str) -> list[tuple[int, bytes]]:
    return [(unit.time_ns, unit.data) for unit in read_candump(CASES / case / "can.log.gz")]


def parse(parser: DbcParser, units: list[tuple[int, bytes]]) -> list[Record]:
    host = np.array([time_ns for time_ns, _ in units], np.int64)
    rows = np.frombuffer(b"".join(unit for _, unit in units), np.uint8).reshape(len(units), -1)
    return [*parser.feed_batch(ChunkBatch("imu/main", host, rows)), *parser.close()]


def test_not_available_values_of_a_recording_are_dropped_and_counted() -> None:
    parser = DbcParser(case_settings("j1939-not-available"))
    rows = imu_rows(parse(parser, frames_of("j1939-not-available")))
    assert len(rows) == 250, "300 samples, 50 of them without values"
    np.testing.assert_allclose(rows["specific_force_b"], np.broadcast_to(AT_REST, (250, 3)), atol=1e-9)
    assert not rows["angular_rate_b"].any()
    assert parser.counters.errors == {"out_of_range": 50}, "this DBC does not tell that it is J1939's; its range does"
    (line,) = parser.warnings
    assert line.startswith("50 values of ACCS.ax are outside the range -320 to 322.55 of the DBC")
    marked = DbcParser(case_settings("j1939-not-available", extra=MARK))
    assert len(imu_rows(parse(marked, frames_of("j1939-not-available")))) == 250
    assert (marked.counters.errors, marked.warnings) == ({"not_available": 50}, ())


def test_a_sample_of_ones_is_not_available_where_the_dbc_says_nothing() -> None:
    """Three unsigned axes at their top count are no measurement; one at its top, or −1 in signed ones, may be one."""
    text = (CASES / "j1939-not-available/imu.dbc").read_text()
    text = text.replace("[-320|322.55]", "[0|0]").replace("[-250|250]", "[0|0]")
    units = frames_of("j1939-not-available")
    one = encode_can_frame(0x08F02D80, struct.pack("<4H", 0xFFFF, 32000, 32000, 0), extended=True)
    other = encode_can_frame(0x0CF02A80, struct.pack("<4H", *[32000] * 4), extended=True)
    units += [(units[-1][0] + 10_000_000, other), (units[-1][0] + 10_300_000, one)]
    for dbc, samples, errors in ((text, 251, {"not_available": 50}), (text.replace("@1+", "@1-"), 301, {})):
        parser = DbcParser(DeviceSettings("imu/main", {"dbc": "a.dbc", "signals": SIGNALS}, {"dbc": dbc.encode()}))
        rows = imu_rows(parse(parser, units))
        assert (len(rows), parser.counters.errors, parser.warnings) == (samples, errors, ())
    assert rows["specific_force_b"][:, 0].min() == pytest.approx(-320.01)  # minus one count


def test_a_message_of_j1939_is_found_by_its_pgn_whatever_its_source_address() -> None:
    parser = DbcParser(case_settings("j1939-source-address"))
    rows = imu_rows(parse(parser, frames_of("j1939-source-address")))
    assert len(rows) == 200
    np.testing.assert_allclose(rows["specific_force_b"], np.broadcast_to(AT_REST, (200, 3)), atol=1e-9)
    assert (parser.counters.errors, parser.warnings) == ({}, ())
    set_ = DbcParser(case_settings("j1939-source-address", source_address=0x80))
    assert len(imu_rows(parse(set_, frames_of("j1939-source-address")))) == 200
    with pytest.raises(
        DriverSettingsError, match=r"217066112 of message ARI has more than 11 bits; .* BO_ 2364549760 ARI"
    ):
        DbcParser(case_settings("j1939-source-address", "ext_no_bit31.dbc"))


def test_a_fixed_source_address_of_the_dbc_that_does_not_come_is_named_with_its_remedy() -> None:
    text = (CASES / "j1939-source-address/imu.dbc").read_text()
    text = text.replace("2364549886", str(0x80000000 | 0x0CF02A11)).replace("2297441790", str(0x80000000 | 0x08F02D11))
    parser = DbcParser(DeviceSettings("imu/main", {"dbc": "a.dbc", "signals": SIGNALS}, {"dbc": text.encode()}))
    assert parse(parser, frames_of("j1939-source-address")) == []
    assert sorted(parser.warnings) == [
        "PGN 61482 (ARI) comes from 0x80, the DBC says 0x11; set source_address = 128",
        "PGN 61485 (ACCS) comes from 0x80, the DBC says 0x11; set source_address = 128",
    ]
    elsewhere = DbcParser(case_settings("j1939-source-address", source_address=0x21))
    assert parse(elsewhere, frames_of("j1939-source-address")) == []
    assert "PGN 61482 (ARI) comes from 0x80, source_address says 0x21; set source_address = 128" in elsewhere.warnings


def acc(raw: int, source: int, priority: int = 2) -> bytes:
    return encode_can_frame(priority << 26 | 0xF02D << 8 | source, struct.pack("<4H", raw, raw, raw, 0), extended=True)


def gyr(raw: int, source: int, priority: int = 3) -> bytes:
    return encode_can_frame(priority << 26 | 0xF02A << 8 | source, struct.pack("<4H", raw, raw, raw, 0), extended=True)


def test_one_of_two_devices_is_used_and_priorities_are_free() -> None:
    frames = []
    for number in range(200):
        at = 32000 + number
        frames += [acc(at, 0x80, number % 8), acc(1, 0x81), gyr(32000, 0x81), gyr(32000, 0x80, 7 - number % 8)]
    whole = check_packets(lambda: DbcParser(case_settings("j1939-source-address")), frames)
    assert whole.counters["errors"] == {}
    for wanted, first in ((None, 0.0), (0x81, 0.01 - 320.0)):
        parser = DbcParser(case_settings("j1939-source-address", source_address=wanted))
        rows = imu_rows([*feed(parser, frames), *parser.close()])
        assert len(rows) == 200
        assert rows["specific_force_b"][0, 0] == pytest.approx(first, abs=1e-9)
        used, other = (0x80, 0x81) if wanted is None else (0x81, 0x80)
        assert (
            f"PGN 61482 (ARI) comes from 0x{other:02X} too; 0x{used:02X} is used; set source_address = {other} "
            "for the other device"
        ) in parser.warnings


def test_codes_of_values_are_counted_and_a_temperature_with_one_is_unknown() -> None:
    text = (CASES / "j1939-source-address/imu.dbc").read_text()
    text = text.replace("[-320|322.55]", "[0|0]")
    text += 'BO_ 2364541694 WARM: 8 IMU\n SG_ celsius : 0|8@1+ (1,-40) [-40|210] "degC" V\n'
    signals = {**SIGNALS, "temperature": "WARM.celsius"}
    parser = DbcParser(DeviceSettings("imu/main", {"dbc": "a.dbc", "signals": signals}, {"dbc": text.encode()}))
    frames = []
    for raw, celsius in ((32000, 65), (0xFF12, 65), (0xFE00, 65), (64255, 0xFF), (0xFD00, 0xFE), (32000, 0xFB)):
        warm = encode_can_frame(0x0CF00A80, bytes([celsius] + [255] * 7), extended=True)
        frames += [warm, acc(raw, 0x80), gyr(32000, 0x80)]
    rows = imu_rows([*feed(parser, frames), *parser.close()])
    assert rows["specific_force_b"][:, 0].tolist() == pytest.approx([0.0, 322.55, 0xFD00 * 0.01 - 320, 0.0], abs=1e-9)
    np.testing.assert_array_equal(rows["temperature_c"], np.array([25, np.nan, np.nan, np.nan], np.float32))
    assert parser.counters.errors == {"not_available": 2, "error_value": 2, "out_of_range": 1}


def test_a_dbc_with_a_byte_order_mark_is_read() -> None:
    signals = {
        "specific_force": ["IMUFD.ax", "IMUFD.ay", "IMUFD.az"],
        "angular_rate": ["IMUFD.gx", "IMUFD.gy", "IMUFD.gz"],
        "sample_ticks": "IMUFD.t",
    }
    parser = DbcParser(case_settings("dbc-utf8-bom", signals=signals))
    rows = imu_rows(parse(parser, frames_of("dbc-utf8-bom")))
    assert len(rows) == 200
    assert np.unique(np.diff(rows["device_time_ns"])).tolist() == [10_000_000]
    np.testing.assert_allclose(rows["specific_force_b"], np.broadcast_to(AT_REST, (200, 3)), atol=1e-6)
    np.testing.assert_allclose(rows["angular_rate_b"], np.broadcast_to([0.01, 0.0, 0.0], (200, 3)), atol=1e-9)


def test_units_that_the_dbc_does_not_give_are_settled_by_the_configuration() -> None:
    text = (CASES / "j1939-source-address/imu.dbc").read_text()
    empty = text.replace('"m/s^2"', '""').replace('"deg/s"', '"mdps"')

    def make(contents: str, units: dict[str, str]) -> DbcParser:
        config = {"dbc": "a.dbc", "signals": SIGNALS, "units": units}
        return DbcParser(DeviceSettings("imu/main", config, {"dbc": contents.encode()}))

    names = [f"{name}" for key in SIGNALS.values() for name in key]
    units = {name: "g" if name.startswith("ACCS") else "deg/s" for name in names}
    parser = make(empty, units)
    rows = imu_rows([*feed(parser, [acc(32100, 1), gyr(32000 + 128, 1)]), *parser.close()])
    np.testing.assert_allclose(rows["specific_force_b"][0], 9.80665, rtol=1e-12)
    np.testing.assert_allclose(rows["angular_rate_b"][0], np.radians(1.0), rtol=1e-12)
    for contents, given, fault in (
        (empty, {}, r'signal ACCS.ax of a.dbc has unit ""; .* units = \{ "ACCS.ax" = "…" \} can give'),
        (empty, {**units, "ACCS.ay": "furlong"}, 'units: ACCS.ay has "furlong"; want m/s2, g or mg'),
        (text, {"ACCS.ax": "g"}, 'units: ACCS.ax has "g", but a.dbc says "m/s.2"; remove the entry'),
        (text, {"ACCS.aq": "g"}, r"units: ACCS.aq is no signal of"),
    ):
        with pytest.raises(DriverSettingsError, match=fault):
            make(contents, given)


def test_a_source_address_needs_identifiers_that_contain_one() -> None:
    with pytest.raises(DriverSettingsError, match="source_address: message IMUFD has an 11-bit identifier"):
        DbcParser(
            case_settings(
                "dbc-utf8-bom",
                signals={
                    key: [f"IMUFD.{axis}" for axis in axes]
                    for key, axes in (("specific_force", ("ax", "ay", "az")), ("angular_rate", ("gx", "gy", "gz")))
                },
                source_address=3,
            )
        )


@pytest.mark.parametrize("identifier", [0x0CF02A80, 0x18EA10FE, 0x1DFEFFFE])
def test_pgn_agrees_with_the_bus_of_boats(identifier: int) -> None:
    assert pgn_of(identifier) == pgn_and_source(np.array([identifier], np.uint32))[0][0]
