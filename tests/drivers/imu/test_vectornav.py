"""Tests VectorNav: every value of three recordings of a VN-310 by INSTINCT's decoding, and what they lack."""

from __future__ import annotations

import csv
import gzip
import struct
from collections.abc import Iterator
from math import degrees, radians
from typing import Any

import numpy as np
import pytest

from swath.drivers.driver import find_driver
from swath.drivers.framing.framer import FALSE_SYNC, UNDECIDED
from swath.drivers.imu.vectornav import wire
from swath.drivers.imu.vectornav.parser import VectornavParser, attitude, make_time_parser
from swath.drivers.imu.vectornav.startup import receiver_startup_messages, startup_messages
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.drivers.startup import Answer, StartupOptions
from swath.georef.records import (
    Chunk,
    DeviceStatus,
    FixType,
    GnssFix,
    ImuSamples,
    InsSolution,
    Record,
    TimeMessage,
)
from tests.drivers.harness import check_damage, check_garbage, check_random_cuts, check_stream
from tests.drivers.recordings import FIXTURES
from tests.drivers.vnb import read_messages

FOLDER = FIXTURES / "vectornav"
IMU_FILE, GNSS_FILE, DYNAMIC_FILE = "FixedSize_vn310-imu", "FixedSize_vn310-gnss", "DynamicSize_vn310-gnss"
SATELLITES = ("SatInfo", "RawMeas")  # fields that the driver skips by their length
GROUPS = {"Time": "", "IMU": "", "Att": "", "INS": "", "GNSS1": "gnss1.", "GNSS2": "gnss2."}
# column of INSTINCT -> name here, if it differs by more than capitals
NAMES = {
    **{"UTC": "utc", "TimeUTC": "utc", "GpsTow": "gps_tow", "GpsWeek": "gps_week", "SyncInCnt": "sync_in_count"},
    **{"SyncOutCnt": "sync_out_count", "TimeGps": "time_gps", "TimeGpsPps": "time_gps_pps", "Temp": "temperature"},
    **{"Pres": "pressure", "DeltaTime": "delta_theta", "NumSats": "satellites", "PosU": "pos_sigma"},
    **{"VelU": "vel_sigma", "TimeU": "time_sigma", "YprU": "ypr_sigma", "DCM": "dcm", "DOP": "dop"},
    **{"InsStatus": "ins_status", "TimeStatus": "time_status"},
}
BITS = {
    "time_status": {"timeOk": 1, "dateOk": 2, "utcTimeValid": 4},
    "time_info": {"timeOk": 1, "dateOk": 2, "utcTimeValid": 4},
    "ins_status": {
        "Mode": 3,
        "GpsFix": 4,
        "IMU": 16,
        "MagPres": 32,
        "GNSS": 64,
        "GpsHeadingIns": 256,
        "GpsCompass": 512,
    },
}
# index of each column's value in its field, where the order differs
PLACES = {"dcm": (0, 3, 6, 1, 4, 7, 2, 5, 8), "quaternion": (3, 0, 1, 2)}


def messages(name: str) -> list[bytes]:
    return read_messages(FOLDER / f"{name}.vnb.gz")


def columns(name: str) -> tuple[list[str], list[list[str]]]:
    """Return titles and whole rows; the last row of one file breaks off."""
    head, *rows = csv.reader(gzip.decompress((FOLDER / f"{name}.csv.gz").read_bytes()).decode().splitlines())
    return head, [row for row in rows if len(row) == len(head)]


def make(**config: Any) -> VectornavParser:
    return VectornavParser(DeviceSettings("imu/main", config))


def parse(*data: bytes, **config: Any) -> tuple[list[Record], VectornavParser]:
    parser = make(**config)
    return [*parser.feed(Chunk("imu/main", 7, b"".join(data))), *parser.close()], parser


def rows_of(records: list[Record], kind: type[ImuSamples] | type[InsSolution]) -> Any:
    found = [record.rows for record in records if isinstance(record, kind)]
    return np.concatenate(found) if found else np.empty(0)


def of(records: list[Record], kind: Any) -> list[Any]:
    return [record for record in records if isinstance(record, kind)]


# --- what INSTINCT read ---


def expected_values(head: list[str], row: list[str]) -> Iterator[tuple[str, str, int, float]]:
    """Name, bits and place of each value that a row of INSTINCT's has, and the value."""
    seen: dict[str, int] = {}
    for title, text in zip(head, row, strict=True):
        group, _, rest = title.partition("::")
        parts = rest.split(" [")[0].split("::")
        if not rest or parts[0] in SATELLITES:
            continue
        plain = "".join(f"_{one.lower()}" if one.isupper() and at else one.lower() for at, one in enumerate(parts[0]))
        name = GROUPS[group] + NAMES.get(parts[0], plain)
        bits = parts[-1] if parts[-1] in BITS.get(name.split(".")[-1], {}) else ""
        place = seen.get(name, 0)
        seen[name] = place + (not bits)
        yield name, bits, PLACES.get(name, range(99))[place], float(text)


@pytest.mark.parametrize("name", [IMU_FILE, GNSS_FILE, DYNAMIC_FILE])
def test_every_value_is_the_one_that_instinct_read(name: str) -> None:
    head, rows = columns(name)
    found = {wire.read_values(message)["time_startup"][0]: message for message in messages(name)}
    assert len(found) == {IMU_FILE: 18, GNSS_FILE: 12, DYNAMIC_FILE: 70}[name]
    assert len(rows) == {IMU_FILE: 18, GNSS_FILE: 12, DYNAMIC_FILE: 41}[name]
    compared = set()
    for row in rows:
        message = found[int(row[head.index("Time::TimeStartup [ns]")])]
        assert wire.measure(message, 0, False) == len(message)
        values = wire.read_values(message)
        for key, bits, place, value in expected_values(head, row):
            field = key.split(".")[-1]
            if bits:
                mask = BITS[field][bits]
                assert (values[key][0] & mask) // (mask & -mask) == value, (key, bits)
            elif field == "time_info":
                assert values[key][1] == value, key
            else:
                assert values[key][place] == pytest.approx(value, rel=2e-7, abs=1e-12), (key, place)
            compared.add(key)
        assert set(values) == compared
    assert len(compared) == {IMU_FILE: 20, GNSS_FILE: 47, DYNAMIC_FILE: 35}[name]


def test_samples_are_the_uncompensated_measurements_with_their_gps_time() -> None:
    head, rows = columns(IMU_FILE)
    table = {title: np.array([float(row[at] or "nan") for row in rows]) for at, title in enumerate(head)}
    records, parser = parse(*messages(IMU_FILE))
    found = rows_of(records, ImuSamples)
    for axis, letter in enumerate("XYZ"):
        accel, rate = table[f"IMU::UncompAccel::{letter} [m/s^2]"], table[f"IMU::UncompGyro::{letter} [rad/s]"]
        np.testing.assert_allclose(found["specific_force_b"][:, axis], accel, rtol=2e-7)
        np.testing.assert_allclose(found["angular_rate_b"][:, axis], rate, rtol=2e-7)
    np.testing.assert_allclose(found["temperature_c"], table["IMU::Temp [Celsius]"], rtol=1e-6)
    assert set(found["gps_week"]) == {2165}
    assert found["device_time_ns"].tolist() == [int(row[head.index("Time::GpsTow [ns]")]) for row in rows]
    assert (parser.remarks(), parser.counters.errors) == ([], {})


def test_increments_are_divided_by_their_own_interval() -> None:
    increments = rows_of(parse(*messages(IMU_FILE), sample="increment")[0], ImuSamples)
    rates = rows_of(parse(*messages(IMU_FILE))[0], ImuSamples)
    head, rows = columns(IMU_FILE)
    angle = [radians(float(row[head.index("IMU::DeltaTheta::Y [deg]")])) for row in rows]
    interval = [float(row[head.index("IMU::DeltaTime [s]")]) for row in rows]
    np.testing.assert_allclose(increments["angular_rate_b"][:, 1], np.divide(angle, interval), rtol=1e-6)
    # both are the motion of a unit at rest, including gravity
    np.testing.assert_allclose(increments["specific_force_b"], rates["specific_force_b"], atol=0.06)
    np.testing.assert_allclose(increments["angular_rate_b"], rates["angular_rate_b"], atol=0.02)


def test_specific_force_at_rest_points_up_in_the_axes_of_the_body() -> None:
    """The attitude turns it to north, east, down as −9.8 m/s², so axes and angles are those of the conventions."""
    for message in messages(IMU_FILE):
        values = wire.read_values(message)
        roll, pitch, yaw = attitude(values) or (0.0,) * 3
        cr, sr, cp, sp, cy, sy = (f(angle) for angle in (roll, pitch, yaw) for f in (np.cos, np.sin))
        turn = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ [[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]
        force_l = turn @ [[1, 0, 0], [0, cr, -sr], [0, sr, cr]] @ np.array(values["uncomp_accel"])
        np.testing.assert_allclose(force_l, [0, 0, -9.8], atol=0.08)


def test_the_quaternion_is_the_same_attitude_as_the_angles() -> None:
    for name in (IMU_FILE, GNSS_FILE, DYNAMIC_FILE):
        for message in messages(name):
            values = wire.read_values(message)
            by_quaternion, by_angles = attitude({"quaternion": values["quaternion"]}), attitude(values)
            assert by_quaternion is not None
            assert by_angles is not None
            turn = np.subtract(by_quaternion, by_angles)
            assert abs((np.degrees(turn) + 180) % 360 - 180).max() < 0.01


def test_solutions_fixes_and_seconds_of_the_recording() -> None:
    records, parser = parse(*messages(GNSS_FILE))
    head, rows = columns(GNSS_FILE)
    solutions = rows_of(records, InsSolution)
    assert len(solutions) == 12
    column = {title: at for at, title in enumerate(head)}
    for solution, row in zip(solutions, rows, strict=True):

        def value(title: str, row: list[str] = row) -> float:
            return float(row[column[title]])

        assert solution["gps_ns"] == 2165 * 604_800_000_000_000 + int(row[column["Time::GpsTow [ns]"]])
        assert degrees(solution["lat_rad"]) == pytest.approx(value("INS::PosLla::latitude [deg]"), abs=1e-13)
        assert solution["height_m"] == pytest.approx(value("INS::PosLla::altitude [m]"), abs=1e-9)
        assert degrees(solution["heading_rad"]) == pytest.approx(value("Att::YawPitchRoll::Y [deg]"), rel=1e-6)
        assert degrees(solution["roll_rad"]) == pytest.approx(value("Att::YawPitchRoll::R [deg]"), rel=1e-6)
        assert degrees(solution["attitude_sigma_rad"][2]) == pytest.approx(value("Att::YprU::Y [deg]"), rel=1e-6)
        assert solution["velocity_l"][2] == pytest.approx(value("INS::VelNed::D [m/s]"), rel=1e-6)
        assert set(solution["position_sigma_l"]) == {np.float32(value("INS::PosU [m]"))}
    fixes = of(records, GnssFix)
    assert {fix.antenna for fix in fixes} == {"primary", "secondary"}
    assert {fix.fix_type for fix in fixes} == {FixType.DIFFERENTIAL}
    first = fixes[0]
    assert (first.time.time_ns, first.time.week, first.time.leap_seconds) == (200632599585647, 2165, 18)
    np.testing.assert_allclose(np.sqrt(np.diag(first.position_cov_l)), [3.2110248, 2.3637588, 6.0670466], rtol=1e-6)
    assert len({(fix.antenna, fix.time.time_ns) for fix in fixes}) == len(fixes)
    seconds = of(records, TimeMessage)
    assert seconds
    assert all(message.time.time_ns % 1_000_000_000 == 0 and message.valid for message in seconds)
    assert parser.counters.errors == {}


def test_a_unit_that_does_not_track_gives_its_state_and_no_solution() -> None:
    records, parser = parse(*messages(DYNAMIC_FILE))
    assert parser.counters.messages == {"groups 1+3+4+5+6": 70}
    assert parser.counters.errors == {"ins_no_solution": 70}
    assert max(map(len, messages(DYNAMIC_FILE))) > 2000
    assert {type(record) for record in records} == {TimeMessage, DeviceStatus}
    assert next(status.values["ins_mode"] for status in of(records, DeviceStatus)) == 0
    seconds = [message.time.time_ns for message in of(records, TimeMessage) if message.valid]
    assert np.diff(seconds).tolist() == [1_000_000_000] * (len(seconds) - 1)


def test_samples_however_cut() -> None:
    whole = check_stream(make, b"".join(messages(IMU_FILE)))
    assert whole.counters["bytes_skipped"] == 0


@pytest.mark.slow
def test_solutions_however_cut() -> None:
    check_stream(make, b"".join(messages(GNSS_FILE)))


def test_messages_of_variable_size_however_cut_and_damaged() -> None:
    data = b"".join(messages(DYNAMIC_FILE))
    check_random_cuts(make, data, count=60)
    check_random_cuts(make, b"".join(messages(GNSS_FILE)), count=60)
    check_damage(make, data[30_000:36_000], examples=20, starts=[b"\xfa\x7a", b"\xfa\x08\0\x80\1\0"])
    check_garbage(make, examples=20, starts=[b"\xfa\x01\x29\0", b"\xfa\x08\0\x80\1\0", b"$VNERR,01*"])


# --- what the recordings lack ---


def message(*fields: tuple[int, int, tuple[Any, ...]]) -> bytes:
    return wire.encode_frame({(group, number): wire.encode_field(group, number, *v) for group, number, v in fields})


def test_the_example_of_the_manual() -> None:
    """UM005, 5.2.4, has yaw, pitch and roll in the common group."""
    frame = bytes.fromhex("FA01080093502E42833EF13F48B504BB9288")
    values = wire.read_values(frame)
    assert wire.VECTORNAV.intact(frame)
    assert frame == message((wire.COMMON, 3, values["yaw_pitch_roll"]))
    assert values["yaw_pitch_roll"] == pytest.approx((43.578686, 1.8847202, -0.0020249654))


def test_every_field_has_the_size_of_the_makers_sdk() -> None:
    sizes: dict[int, dict[int, int]] = {}
    for (group, number), parts in wire.FIELDS.items():
        sizes.setdefault(group, {})[number] = struct.calcsize("<" + "".join(one for _, one in parts))
    receiver = [8, 8, 2, 1, 1, 24, 24, 12, 12, 12, 4, 4, 2, 28]
    assert [*sizes[wire.COMMON].values()] == [8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8]
    assert [*sizes[wire.TIME].values()] == [8, 8, 8, 2, 8, 8, 8, 4, 4, 1]
    assert [*sizes[wire.IMU].values()] == [2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2, 40]
    assert [*sizes[wire.ATTITUDE].values()] == [2, 12, 16, 36, 12, 12, 12, 12, 12, 12, 28, 24, 12, 4]
    assert [*sizes[wire.INS].values()] == [2, 24, 24, 12, 12, 12, 12, 12, 12, 4, 4, 68, 64]
    for group in wire.RECEIVERS:
        assert sizes[group] == {**dict(enumerate(receiver)), 17: 2, 18: 8}
    assert [*sizes[16].values()] == [48, 48, 48, 92, 80, 76, 68, 20, 40, 60, 320, 192]
    assert [*sizes[17].values()] == [8, 2, 2, 12, 36, 12, 36, 4, 4, 4, 4, 40, 144, 12, 36]


def test_fields_of_the_common_group_and_the_latched_counter() -> None:
    sample = message(
        (wire.COMMON, 0, (5_000_000_000,)), (wire.COMMON, 2, (300_000_000,)), (wire.COMMON, 9, (1, 2, 3, 4, 5, 6))
    )
    records, _ = parse(sample, pps="main")
    [row] = rows_of(records, ImuSamples)
    assert (row["device_time_ns"], row["pps_time_ns"], row["gps_week"]) == (5_000_000_000, 4_700_000_000, -1)
    assert (row["specific_force_b"].tolist(), row["angular_rate_b"].tolist()) == ([1, 2, 3], [4, 5, 6])


def test_time_is_gps_time_only_while_the_unit_vouches_for_it() -> None:
    def at(status: int, week: int = 2165, tow_ns: int = 100_200_000_000) -> bytes:
        return message(
            *((wire.TIME, 0, (9,)), (wire.TIME, 2, (tow_ns,)), (wire.TIME, 3, (week,)), (wire.TIME, 9, (status,))),
            *((wire.IMU, 2, (1, 2, 3)), (wire.IMU, 3, (0, 0, 0)), (wire.IMU, 0, (5,)), (wire.IMU, 11, (0x101,))),
        )

    records, parser = parse(at(3), at(1, tow_ns=101_000_000_000), at(7, week=1000), at(7, week=0))
    rows = rows_of(records, ImuSamples)
    assert rows["gps_week"].tolist() == [2165, -1, -1, -1]
    assert rows["device_time_ns"].tolist() == [100_200_000_000, 9, 9, 9]
    assert set(rows["status"]) == {0x50101}
    assert [(one.time.time_ns, one.valid) for one in of(records, TimeMessage)] == [
        (100_000_000_000, True),
        (101_000_000_000, False),
    ]
    assert parser.counters.errors == {"date_before_floor": 1}
    timed = make_time_parser(DeviceSettings("imu/main"))
    assert timed.feed(Chunk("imu/main", 7, at(3))) == of(records, TimeMessage)[:1]


def test_compensated_samples_are_taken_with_a_remark_and_halves_are_counted() -> None:
    both = message((wire.COMMON, 5, (0.1, 0, 0)), (wire.COMMON, 8, (0, 0, -9.8)))
    records, parser = parse(both, message((wire.COMMON, 5, (0.1, 0, 0))), message((wire.COMMON, 11, (0.01,) * 7)))
    assert len(rows_of(records, ImuSamples)) == 1
    assert parser.counters.errors == {"sample_incomplete": 1, "increments_only": 1}
    assert "output UncompAccel and UncompGyro" in parser.remarks()[0]
    _, parser = parse(both, message((wire.IMU, 6, (0.01,) * 4)), sample="increment")
    assert parser.counters.errors == {"rates_only": 1, "sample_incomplete": 1}


def test_impossible_values_are_counted() -> None:
    nan = message((wire.COMMON, 9, (float("nan"), 2, 3, 4, 5, 6)))
    zero = message((wire.COMMON, 11, (0.0, 1, 1, 1, 1, 1, 1)))
    for data, config in ((nan, {}), (zero, {"sample": "increment"})):
        records, parser = parse(data, **config)
        assert rows_of(records, ImuSamples).size == 0
        assert parser.counters.errors == {"bad_value": 1}


def test_a_counter_that_goes_back_is_a_restart() -> None:
    sample = [message((wire.COMMON, 0, (ns,)), (wire.COMMON, 9, (1, 2, 3, 4, 5, 6))) for ns in (9, 10, 3)]
    assert parse(*sample)[1].counters.errors == {"restart": 1}


def test_a_receiver_without_fix_gives_a_fix_without_position() -> None:
    fields = [(1, (100_000_000_000,)), (2, (2165,)), (3, (4,)), (4, (1,)), (5, (0, 0, 0)), (12, (3, 18))]
    [fix] = of(parse(message(*((wire.GNSS1, number, values) for number, values in fields)))[0], GnssFix)
    assert (fix.lat_rad, fix.valid, fix.fix_type, fix.satellites) == (None, False, FixType.NONE, 4)
    assert fix.time.leap_seconds is None


def test_an_unknown_field_ends_the_search_and_a_long_header_is_no_message() -> None:
    assert wire.measure(b"\xfa\x02\x00\x04" + bytes(60), 0, False) == FALSE_SYNC
    assert wire.measure(b"\xfa\x80\x80\x80\x01" + bytes(60), 0, False) == FALSE_SYNC
    assert wire.measure(b"\xfa\x08" + b"\0\x80" * 12, 0, False) == FALSE_SYNC
    assert wire.measure(b"\xfa\x08\x00\x40", 0, False) == UNDECIDED
    assert wire.measure(b"\xfa\x08\x00\x40\x24\x00", 0, False) == FALSE_SYNC  # 36 satellites of at most 35


# --- set-up ---


def test_startup_asks_for_what_the_driver_reads_and_finds_the_answer() -> None:
    messages = startup_messages(DeviceSettings("imu/main", {"rate_hz": 400.0}), StartupOptions(save=True, baud=921600))
    texts = [one.lines[0] for one in messages]
    assert texts[0] == "VNWRG,05,921600"
    assert texts[3:] == ["VNWRG,75,1,2,06,023D,081C", "VNWRG,76,1,16,32,020C,0102,0613", "VNWNV"]
    receiver = receiver_startup_messages(DeviceSettings("gnss/rover"), StartupOptions(save=True))
    assert [one.lines[0] for one in receiver] == ["VNWRG,77,1,160,08,16BE", "VNWNV"]
    assert (messages[-1].data, messages[-1].last, messages[0].baud) == (b"$VNWNV*57\r\n", True, 921600)
    increments = startup_messages(DeviceSettings("imu/main", {"sample": "increment"}), StartupOptions())
    assert increments[2].lines == ("VNWRG,75,1,4,06,023D,08D0",)
    stream = b"".join(read_messages(FOLDER / f"{IMU_FILE}.vnb.gz"))
    for answer, wanted in (
        (b"$VNWRG,75,1,2,06,023D,081C*5C\r\n", Answer(True)),
        (b"$VNERR,09*78\r\n", Answer(False, "ERR,09")),
    ):
        for size in (1, 7, 4096):
            listener, data = messages[3].listen(), stream + answer + stream
            heard = (listener.hear(data[at : at + size]) for at in range(0, len(data), size))
            assert next((one for one in heard if one is not None), None) == wanted
    assert messages[3].listen().hear(stream + b"$VNWRG,76,1*5C\r\n") is None


def test_a_rate_that_does_not_divide_800_is_refused() -> None:
    with pytest.raises(DriverSettingsError, match="rate_hz: got 300, want a rate that divides 800"):
        startup_messages(DeviceSettings("imu/main", {"rate_hz": 300.0}), StartupOptions())


def test_the_driver_is_registered() -> None:
    assert find_driver("imu", "vectornav").make_time_parser is make_time_parser
