"""Tests UBX on real recordings: pyubx2's and gpsd's values, every cut, leap seconds, weeks, epochs, pulses, marks."""

from __future__ import annotations

import datetime as dt
import io
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from pyubx2 import ERR_IGNORE, GET, UBX_PROTOCOL, UBXMessage, UBXReader

from swath.drivers.gnss.ubx import messages as ubx
from swath.drivers.gnss.ubx.parser import DRIVERS, UbxParser
from swath.drivers.parser import DeviceSettings
from swath.georef.records import Chunk, EventMark, FixType, NamesEdge, Record, TimeMessage, TimeScale
from swath.georef.timescales import gps_ns_from_week, whole_gps_ns
from tests.drivers.builders import times
from tests.drivers.gnss.builders import fixes
from tests.drivers.harness import (
    canonical,
    check_bytewise,
    check_damage,
    check_garbage,
    check_random_reads,
    check_stream,
    feed_pieces,
)
from tests.drivers.recordings import expected, gpsd_reports, recording

SETTINGS = DeviceSettings("gnss/test")
MS = 1_000_000
WEEK_MS = 604_800_000
GPS_EPOCH = dt.datetime(1980, 1, 6, tzinfo=dt.UTC)
RECORDINGS = sorted(expected("ubx"))


def make() -> UbxParser:
    return UbxParser(SETTINGS)


def parse(*frames: bytes) -> tuple[list[Record], UbxParser]:
    """Parse the frames to the end; return records and parser."""
    parser = make()
    return feed_pieces(parser, frames), parser


def decoded_by_pyubx2(name: str, identity: str) -> Iterator[tuple[bytes, Any]]:
    """Return frames and messages of one type, decoded by pyubx2."""
    reader = UBXReader(io.BytesIO(recording("ubx", name)), protfilter=UBX_PROTOCOL, quitonerror=ERR_IGNORE)
    for raw, message in reader:
        if message is not None and message.identity == identity:
            yield raw, message


# --- recordings ---

# (layout, our field, pyubx2's attribute, factor from its value to ours)
FIELDS: dict[str, tuple[ubx.Layout[Any], dict[str, tuple[str, float]]]] = {
    "NAV-PVT": (
        ubx.NAV_PVT,
        {
            "year": ("year", 1),
            "day": ("day", 1),
            "second": ("second", 1),
            "nano_ns": ("nano", 1),
            "satellites": ("numSV", 1),
            "lat_1e7_deg": ("lat", 1e7),
            "lon_1e7_deg": ("lon", 1e7),
            "height_mm": ("height", 1),
            "horizontal_accuracy_mm": ("hAcc", 1),
            "vel_d_mmps": ("velD", 1),
            "speed_accuracy_mmps": ("sAcc", 1),
            "pdop_1e2": ("pDOP", 1e2),
        },
    ),
    "NAV-HPPOSLLH": (ubx.NAV_HPPOSLLH, {"horizontal_accuracy_tenth_mm": ("hAcc", 10), "height_mm": ("height", 1)}),
    "NAV-TIMEGPS": (
        ubx.NAV_TIMEGPS,
        {"ftow_ns": ("fTOW", 1), "week": ("week", 1), "leap_seconds": ("leapS", 1), "time_accuracy_ns": ("tAcc", 1)},
    ),
    "NAV-TIMELS": (ubx.NAV_TIMELS, {"current": ("currLs", 1), "time_to_event_s": ("timeToLsEvent", 1)}),
    "NAV-COV": (ubx.NAV_COV, {"pos_nn": ("posCovNN", 1), "pos_ed": ("posCovED", 1), "vel_dd": ("velCovDD", 1)}),
    "NAV-SOL": (
        ubx.NAV_SOL,
        {
            "week": ("week", 1),
            "ftow_ns": ("fTOW", 1),
            "fix_type": ("gpsFix", 1),
            "x_cm": ("ecefX", 1),
            "z_cm": ("ecefZ", 1),
            "position_accuracy_cm": ("pAcc", 1),
            "vz_cmps": ("ecefVZ", 1),
            "speed_accuracy_cmps": ("sAcc", 1),
            "pdop_1e2": ("pDOP", 1e2),
            "satellites": ("numSV", 1),
        },
    ),
    "NAV-STATUS": (ubx.NAV_STATUS, {"fix_type": ("gpsFix", 1)}),
    "NAV-POSLLH": (
        ubx.NAV_POSLLH,
        {
            "lat_1e7_deg": ("lat", 1e7),
            "lon_1e7_deg": ("lon", 1e7),
            "height_mm": ("height", 1),
            "vertical_accuracy_mm": ("vAcc", 1),
        },
    ),
    "NAV-VELNED": (
        ubx.NAV_VELNED,
        {"vel_n_cmps": ("velN", 1), "vel_d_cmps": ("velD", 1), "speed_accuracy_cmps": ("sAcc", 1)},
    ),
    "TIM-TP": (ubx.TIM_TP, {"tow_ms": ("towMS", 1), "week": ("week", 1), "quantisation_ps": ("qErr", 1)}),
}


@pytest.mark.parametrize("identity", FIELDS)
def test_fields_match_pyubx2(identity: str) -> None:
    layout, fields = FIELDS[identity]
    compared = 0
    for name in RECORDINGS:
        for raw, theirs in decoded_by_pyubx2(name, identity):
            ours = layout.decode(raw)
            assert ours is not None
            for field, (attribute, factor) in fields.items():
                value = getattr(theirs, attribute)
                if attribute == "height" and identity == "NAV-HPPOSLLH":
                    assert getattr(ours, field) == pytest.approx(value, abs=1.0)  # theirs includes the 0.1 mm part
                else:
                    assert getattr(ours, field) == pytest.approx(value * factor, rel=1e-7, abs=1e-6), (name, field)
            compared += 1
    assert compared > 0


def tow_ms(utc: str) -> int:
    """Return the GPS time of week, ms, of gpsd's UTC text; there are 18 leap seconds since 2017."""
    since = dt.datetime.fromisoformat(utc) + dt.timedelta(seconds=18) - GPS_EPOCH
    return round(since.total_seconds() * 1000) % WEEK_MS


@pytest.mark.parametrize("name", ["ublox-zed-f9p-hp.log", "ublox-zed-f9p-sfrbx.log", "ublox-zed-f9t-rtcm3.log"])
def test_fixes_match_gpsd(name: str) -> None:
    """gpsd reports NAV-PVT alone, so a refined position differs by less than the last digit of each coordinate."""
    reports = {tow_ms(report["time"]): report for report in gpsd_reports("ubx", name)}
    found = fixes(feed_pieces(make(), [recording("ubx", name)]))
    compared = 0
    for fix in found:
        report = reports.get(round(fix.time.time_ns / MS))
        assert fix.lat_rad is not None
        assert fix.lon_rad is not None
        if report is None:
            continue
        assert math.degrees(fix.lat_rad) == pytest.approx(report["lat"], abs=1.01e-7)
        assert math.degrees(fix.lon_rad) == pytest.approx(report["lon"], abs=1.01e-7)
        assert fix.height_m == pytest.approx(report["altHAE"], abs=0.0011)
        assert fix.velocity_l is not None
        assert math.hypot(*fix.velocity_l[:2]) == pytest.approx(report["speed"], abs=0.0011)
        compared += 1
    assert compared >= 19
    assert compared >= len(found) - 2


def test_week_and_time_of_week_match_gpsd() -> None:
    """An M8 in time mode sends NAV-TIMEGPS, from which gpsd made UTC."""
    reports = {report["time"] for report in gpsd_reports("ubx", "ublox-8-time.log")}
    messages = [
        message
        for message in times(feed_pieces(make(), [recording("ubx", "ublox-8-time.log")]))
        if message.message == "NAV-TIMEGPS"
    ]
    utc = {
        (GPS_EPOCH + dt.timedelta(weeks=tag.week or 0, milliseconds=tag.time_ns // MS - (tag.leap_seconds or 0) * 1000))
        for tag in (message.time for message in messages)
    }
    texts = {f"{time:%Y-%m-%dT%H:%M:%S}.000Z" for time in utc}
    assert len(messages) == 88
    assert all(message.valid and message.time.leap_seconds == 18 for message in messages)
    assert len(texts & reports) >= len(reports) - 2


def test_no_recording_has_a_bad_message() -> None:
    for name in RECORDINGS:
        parser = make()
        feed_pieces(parser, [recording("ubx", name)])
        assert parser.counters.bad_messages == 0, name


def test_tim_tp_pulses_of_an_old_receiver_are_decoded() -> None:
    """ublox-lea-4t.log has TIM-TP in UTC with its quantisation, and NAV-SOL two seconds of the same week."""
    messages = times(feed_pieces(make(), [recording("ubx", "ublox-lea-4t.log")]))
    pulses = [message for message in messages if message.message == "TIM-TP"]
    assert [pulse.quantisation_ns for pulse in pulses][:1] == [16.813]
    for pulse in pulses:
        assert (pulse.names_edge, pulse.bound, pulse.valid) == (NamesEdge.NEXT, True, True)
        assert (pulse.time.scale, pulse.time.time_ns % 1_000_000_000) == (TimeScale.UTC, 0)
    tag = pulses[0].time  # week 1516, 333 344 s
    assert tag.date == dt.date(2009, 1, 25) + dt.timedelta(days=3)
    assert tag.time_ns == (333_344 - 3 * 86_400) * 1_000_000_000


@pytest.mark.slow
def test_records_do_not_depend_on_how_the_stream_is_cut() -> None:
    """The stream mixes UBX and RTCM3 and has epochs of many messages."""
    outcome = check_stream(make, recording("ubx", "ublox-zed-f9t-rtcm3.log"))
    counts = expected("ubx")["ublox-zed-f9t-rtcm3.log"]["messages"]
    assert outcome.counters["messages"]["NAV-PVT"] == counts["UBX:NAV-PVT"]


@pytest.mark.parametrize(
    "name",
    [
        "ublox-8-time.log",
        "ublox-aek-4t.log",
        "ublox-neo-m8t.log",
        "ublox-zed-f9p-hp.log",
        "mon_span.ubx",
        "pygpsdata-NAV.log",
        "pygpsdata-MIXED3.log",
    ],
)
def test_random_and_byte_by_byte_reads_give_the_same_records(name: str) -> None:
    check_random_reads(make, recording("ubx", name))
    check_bytewise(make, recording("ubx", name))


def test_damaged_stream_never_raises() -> None:
    check_damage(make, recording("ubx", "ublox-zed-f9p-hp.log"))


def test_damaged_mixed_stream_never_raises() -> None:
    check_damage(make, recording("ubx", "ublox-zed-f9t-rtcm3.log"), examples=40)


def test_garbage_never_raises() -> None:
    check_garbage(make)


@pytest.mark.parametrize("name", RECORDINGS)
def test_time_parser_gives_the_same_times_and_no_other_records(name: str) -> None:
    driver = DRIVERS[0]
    assert driver.make_time_parser is not None
    data = recording("ubx", name)
    only = feed_pieces(driver.make_time_parser(SETTINGS), [data])
    assert canonical(only) == canonical(times(feed_pieces(make(), [data])))


# --- encoded messages ---

ALL_VALID = ubx.PVT_VALID_DATE | ubx.PVT_VALID_TIME | ubx.PVT_FULLY_RESOLVED
WEEK = 2445
MIDNIGHT_MS = 6 * 86_400_000  # Saturday 2026-11-21 of week 2445


def pvt(at_ms: int, **changes: int) -> bytes:
    """Return a NAV-PVT of 2026-11-21, UTC = iTOW − 18 s, fixed at 47.1234567° N 8.7654321° W, 500 m."""
    utc_ms = (at_ms - 18_000) % 86_400_000
    hour, rest = divmod(utc_ms, 3_600_000)
    minute, rest = divmod(rest, 60_000)
    second, millisecond = divmod(rest, 1000)
    message = ubx.NavPvt(
        at_ms, 2026, 11, 21, hour, minute, second, ALL_VALID, 20, millisecond * MS, 3, 0x83, 0, 21,
        -87_654_321, 471_234_567, 500_000, 453_000, 14, 20, 60_000, -1_500, 250, 60_019, 0, 40, 0, 100, 0,
    )  # fmt: skip
    return ubx.encode_nav_pvt(message._replace(**changes))


def timegps(itow_ms: int, week: int = WEEK, valid: int = 7, ftow_ns: int = 0, leap: int = 18) -> bytes:
    return ubx.encode_nav_timegps(ubx.NavTimegps(itow_ms, ftow_ns, week, leap, valid, 20))


NOON_MS = MIDNIGHT_MS + 12 * 3_600_000


def test_pyubx2_reads_encoded_messages() -> None:
    frames = [
        pvt(NOON_MS),
        timegps(NOON_MS),
        ubx.encode_nav_hpposllh(ubx.NavHpposllh(0, 0, NOON_MS, 1, 2, 3, 4, 5, -6, 7, -8, 90, 100)),
        ubx.encode_nav_timels(ubx.NavTimels(NOON_MS, 0, 2, 18, 0, 0, 0, 0, 0, 1)),
        ubx.encode_nav_cov(ubx.NavCov(NOON_MS, 0, 1, 1, *range(12))),
        ubx.encode_nav_eoe(ubx.NavEoe(NOON_MS)),
        ubx.encode_tim_tp(ubx.TimTp(NOON_MS, 0, 5_000, WEEK, 0, 0)),
        ubx.encode_tim_tm2(ubx.TimTm2(0, 0xC8, 7, WEEK, WEEK, NOON_MS, 5, NOON_MS, 6, 30)),
    ]
    reader = UBXReader(io.BytesIO(b"".join(frames)), quitonerror=2)
    names = [message.identity for _, message in reader]
    assert names == [
        "NAV-PVT", "NAV-TIMEGPS", "NAV-HPPOSLLH", "NAV-TIMELS", "NAV-COV", "NAV-EOE", "TIM-TP", "TIM-TM2",
    ]  # fmt: skip


def test_all_messages_of_an_epoch_give_one_fix() -> None:
    covariance = (4e-4, 1e-5, 2e-5, 5e-4, 3e-5, 9e-4)
    records, parser = parse(
        pvt(NOON_MS),
        ubx.encode_nav_hpposllh(
            ubx.NavHpposllh(0, 0, NOON_MS, -87_654_321, 471_234_567, 500_000, 0, -12, 34, -5, 0, 140, 200)
        ),
        timegps(NOON_MS, ftow_ns=-250_000),
        ubx.encode_nav_cov(ubx.NavCov(NOON_MS, 0, 1, 1, *covariance, *covariance)),
        ubx.encode_nav_eoe(ubx.NavEoe(NOON_MS)),
    )
    (fix,) = fixes(records)
    assert (fix.time.scale, fix.time.week, fix.time.leap_seconds) == (TimeScale.GPS, WEEK, 18)
    assert fix.time.time_ns == NOON_MS * MS - 250_000
    assert fix.lat_rad == pytest.approx(math.radians(47.123456734), abs=1e-15)
    assert fix.lon_rad == pytest.approx(math.radians(-8.765432112), abs=1e-15)
    assert fix.height_m == pytest.approx(499.9995)
    assert fix.velocity_l == (60.0, -1.5, 0.25)
    assert fix.position_cov_l is not None
    assert np.allclose(fix.position_cov_l, [[4e-4, 1e-5, 2e-5], [1e-5, 5e-4, 3e-5], [2e-5, 3e-5, 9e-4]])
    assert (fix.fix_type, fix.satellites, fix.valid) == (FixType.RTK_FIXED, 21, True)
    assert parser.counters.errors == {}


def test_the_highest_bit_of_the_satellite_count_is_ignored() -> None:
    """M8P firmware reports 0x88 for eight satellites; no receiver uses more than 127."""
    (fix,) = fixes(parse(pvt(NOON_MS, satellites=0x88), ubx.encode_nav_eoe(ubx.NavEoe(NOON_MS)))[0])
    assert fix.satellites == 8


def test_accuracies_replace_missing_covariances() -> None:
    (fix,) = fixes(parse(pvt(NOON_MS))[0])
    assert fix.position_cov_l is not None
    assert fix.position_cov_l[0, 0] + fix.position_cov_l[1, 1] == pytest.approx(0.014**2)
    assert fix.position_cov_l[2, 2] == pytest.approx(0.020**2)


def test_an_itow_is_never_joined_with_the_week_of_another_epoch() -> None:
    """The new week's first solution comes beside the old week's number, which must not date it."""
    last, first = WEEK_MS - 1000, 0
    records, _ = parse(
        pvt(last), timegps(last, WEEK), pvt(first), timegps(last, WEEK), pvt(1000), timegps(1000, WEEK + 1)
    )  # fmt: skip
    assert [(fix.time.time_ns // (1000 * MS), fix.time.week) for fix in fixes(records)] == [
        (last // 1000, WEEK),
        (0, None),
        (1, WEEK + 1),
    ]
    weeks = {(m.time.time_ns // MS, m.time.week) for m in times(records) if m.message == "NAV-TIMEGPS"}
    assert weeks == {(last, WEEK), (1000, WEEK + 1)}


def test_a_negative_fraction_at_the_start_of_a_week_belongs_to_the_previous_week() -> None:
    (fix,) = fixes(parse(pvt(0), timegps(0, WEEK + 1, ftow_ns=-300_000))[0])
    assert (fix.time.week, fix.time.time_ns) == (WEEK, WEEK_MS * MS - 300_000)


def test_time_of_nav_pvt_is_utc_to_the_millisecond() -> None:
    (message,) = times(parse(pvt(NOON_MS, nano_ns=-277_753))[0])
    assert (message.time.scale, message.time.date, message.valid) == (TimeScale.UTC, dt.date(2026, 11, 21), True)
    assert message.time.time_ns == (12 * 3600 - 18) * 1_000_000_000
    assert (message.names_edge, message.bound, message.time.leap_seconds) == (NamesEdge.PREVIOUS, False, 18)
    (message,) = times(parse(pvt(NOON_MS + 100))[0])
    assert message.time.time_ns % 1_000_000_000 == 100 * MS  # off the second: does not vote


@pytest.mark.parametrize("missing", [ubx.PVT_VALID_DATE, ubx.PVT_VALID_TIME, ubx.PVT_FULLY_RESOLVED])
def test_time_of_nav_pvt_needs_all_validity_bits(missing: int) -> None:
    messages = times(parse(pvt(NOON_MS, valid=ALL_VALID & ~missing))[0])
    assert not any(message.valid for message in messages)


def test_leap_seconds_come_from_valid_messages_and_nav_pvt_uses_its_own_itow() -> None:
    unknown = timegps(NOON_MS, valid=ubx.TIMEGPS_TOW | ubx.TIMEGPS_WEEK)
    timels = ubx.NavTimels(NOON_MS, 0, 2, 18, 0, 0, 0, 0, 0, ubx.TIMELS_CURRENT)
    invalid = timels._replace(valid=0)
    records, _ = parse(unknown, ubx.encode_nav_timels(invalid), pvt(NOON_MS))
    assert [message.time.leap_seconds for message in times(records)] == [None, 18]
    records, _ = parse(ubx.encode_nav_timels(timels), pvt(NOON_MS))
    assert [(message.message, message.time.leap_seconds) for message in times(records)] == [
        ("NAV-TIMELS", 18),
        ("NAV-PVT", 18),
    ]


def test_a_valid_leap_second_count_does_not_make_the_time_valid() -> None:
    timels = ubx.encode_nav_timels(ubx.NavTimels(NOON_MS, 0, 2, 18, 0, 0, 0, 0, 0, ubx.TIMELS_CURRENT))
    unsure = pvt(NOON_MS, valid=ALL_VALID & ~ubx.PVT_FULLY_RESOLVED)
    records, _ = parse(timels, unsure, timels, pvt(NOON_MS), timels)
    assert [message.valid for message in times(records)] == [True, False, False, True, True]


def test_the_second_follows_itow_whatever_leap_count_utc_uses() -> None:
    """The first NAV-PVT after an insertion comes before the first message with the new count; the second is right."""
    late = pvt(NOON_MS + 1000, itow_ms=NOON_MS + 2000)  # UTC is a second earlier than with 18 s
    records, _ = parse(timegps(NOON_MS), pvt(NOON_MS), late, timegps(NOON_MS + 2000, leap=19), late)
    said = [message.time for message in times(records) if message.message == "NAV-PVT"]
    assert [tag.leap_seconds for tag in said] == [18, 18, 19]
    itows = (NOON_MS, NOON_MS + 2000, NOON_MS + 2000)
    assert [whole_gps_ns(tag, None) for tag in said] == [gps_ns_from_week(WEEK, at * MS) for at in itows]


@pytest.mark.parametrize("leap", [13, 16, 17, 38, -2])
@pytest.mark.parametrize("name", ["NAV-PVT", "NAV-TIMEUTC"])
def test_utc_with_a_stale_leap_count_gives_the_second_of_its_own_itow(name: str, leap: int) -> None:
    """The receiver's firmware counts `leap` leap seconds instead of 18, yet reports fully resolved UTC."""
    utc = dt.datetime(2026, 11, 21, 12, tzinfo=dt.UTC) - dt.timedelta(seconds=leap)
    calendar = (utc.year, utc.month, utc.day, utc.hour, utc.minute, utc.second)
    frame = (
        pvt(
            NOON_MS, **dict(zip(("year", "month", "day", "hour", "minute", "second"), calendar, strict=True)), nano_ns=0
        )
        if name == "NAV-PVT"
        else ubx.encode_nav_timeutc(ubx.NavTimeutc(NOON_MS, 20, 0, *calendar, ubx.TIMEUTC_ALL))
    )
    (message,) = times(parse(frame)[0])
    assert (message.message, message.valid, message.time.leap_seconds) == (name, True, leap)
    assert whole_gps_ns(message.time, None) == gps_ns_from_week(WEEK, NOON_MS * MS)
    messages = times(parse(timegps(NOON_MS), frame)[0])  # the confirmed count corrects UTC
    assert [item.time.leap_seconds for item in messages] == [18, 18]
    assert whole_gps_ns(messages[1].time, None) == gps_ns_from_week(WEEK, NOON_MS * MS)


def test_utc_minutes_away_from_its_itow_is_invalid() -> None:
    records, parser = parse(pvt(NOON_MS, itow_ms=NOON_MS - 300_000), pvt(NOON_MS, itow_ms=NOON_MS + 300))
    assert [message.valid for message in times(records)] == [False, False]
    assert parser.counters.errors["utc_contradicts_itow"] == 2


def test_nav_timeutc_written_by_pyubx2_is_read() -> None:
    fields = {"iTOW": NOON_MS, "nano": -277_753, "year": 2026, "month": 11, "day": 21, "hour": 11, "min": 59, "sec": 42}
    frame = UBXMessage("NAV", "NAV-TIMEUTC", GET, **fields, validTOW=1, validWKN=1, validUTC=1).serialize()
    (message,) = times(parse(frame)[0])
    assert (message.message, message.valid, message.time.leap_seconds) == ("NAV-TIMEUTC", True, 18)
    assert whole_gps_ns(message.time, None) == gps_ns_from_week(WEEK, NOON_MS * MS)


@pytest.mark.parametrize(("said", "host"), [(1024, "set"), (0, "2026-11-21"), (0, "2026-11-22"), (0, "1970-01-01")])
def test_weeks_one_rollover_behind_are_corrected_on_request_or_by_the_host_date(said: int, host: str) -> None:
    parser = UbxParser(DeviceSettings("gnss/rover", {"add_weeks": said}))
    day = 0 if host == "set" else (dt.date.fromisoformat(host) - dt.date(1970, 1, 1)).days
    frames = timegps(NOON_MS, week=WEEK - 1024) + pvt(NOON_MS, year=2007, month=4, day=7)
    (gps, utc) = times(parser.feed(Chunk("gnss/rover", day * 86_400_000 * MS + 1, frames)))
    (line,) = parser.remarks()
    if host == "1970-01-01":
        assert not gps.valid
        assert not utc.valid
        assert "2007-04-01, before 2009-01-01" in line
        assert "1024 weeks behind (then 2026-11-15;" in line
        assert "set gnss.rover.add_weeks = 1024" in line
        return
    assert [whole_gps_ns(item.time, None) for item in (gps, utc)] == [gps_ns_from_week(WEEK, NOON_MS * MS)] * 2
    assert (gps.valid, utc.valid) == (True, True)
    assert "1 roll-over of 1024 weeks behind; corrected to 2026-11-15" in line


def test_second_60_is_read_as_a_leap_second() -> None:
    """On 2016-12-31, a Saturday, 23:59:60 is 17 s behind GPS, whose new week began 17 s earlier."""
    frame = pvt(NOON_MS, itow_ms=17_000, year=2016, month=12, day=31, hour=23, minute=59, second=60)
    records, parser = parse(ubx.encode_nav_timels(ubx.NavTimels(0, 0, 2, 17, 2, 1, 17, 1930, 1, 3)), frame)
    message = times(records)[-1]
    assert (message.time.date, message.time.time_ns) == (dt.date(2016, 12, 31), 86_400 * 1_000_000_000)
    assert (message.time.leap_seconds, message.valid, parser.counters.bad_messages) == (17, True, 0)


def test_a_time_just_before_midnight_belongs_to_the_previous_day() -> None:
    frame = pvt(MIDNIGHT_MS + 18_000, nano_ns=-100 * MS, itow_ms=MIDNIGHT_MS + 17_900)
    (message,) = times(parse(frame)[0])
    assert (message.time.date, message.time.time_ns) == (dt.date(2026, 11, 20), (86_400_000 - 100) * MS)


def test_tim_tp_names_the_next_edge_and_is_bound() -> None:
    (message,) = times(parse(ubx.encode_tim_tp(ubx.TimTp(NOON_MS, 2**31, 5_000, WEEK, 0, 0)))[0])
    assert (message.names_edge, message.bound, message.valid) == (NamesEdge.NEXT, True, True)
    assert (message.time.scale, message.time.week) == (TimeScale.GPS, WEEK)
    assert message.time.time_ns == NOON_MS * MS + MS // 2
    assert message.quantisation_ns == -5.0


@pytest.mark.parametrize(
    ("flags", "reference", "valid", "quantisation_ns"),
    [
        (ubx.TP_QUANTISATION_INVALID, 0, True, 0.0),
        (ubx.TP_UTC_BASE | ubx.TP_UTC_AVAILABLE, 0x3F, True, -5.0),
        (ubx.TP_UTC_BASE, 0x3F, False, -5.0),  # UTC not known
        (0, 1, False, -5.0),  # GLONASS time
        (ubx.TP_NOT_LOCKED, 0, False, -5.0),
    ],
)
def test_tim_tp_flags_are_decoded(flags: int, reference: int, valid: bool, quantisation_ns: float) -> None:
    records, parser = parse(ubx.encode_tim_tp(ubx.TimTp(NOON_MS, 0, 5_000, WEEK, flags, reference)))
    (message,) = times(records)
    assert (message.valid, message.quantisation_ns) == (valid, quantisation_ns)
    assert parser.counters.errors["tim_tp_time_base"] == (1 if reference == 1 else 0)


def test_tim_tp_is_invalid_while_the_receiver_has_no_time() -> None:
    pulse = ubx.encode_tim_tp(ubx.TimTp(NOON_MS, 0, 0, WEEK, 0, 0))
    records, _ = parse(timegps(NOON_MS, valid=0), pulse, timegps(NOON_MS), pulse)
    assert [message.valid for message in times(records) if message.bound] == [False, True]


def test_a_week_one_rollover_behind_is_invalid_and_counted() -> None:
    records, parser = parse(
        timegps(NOON_MS, WEEK - 1024),
        ubx.encode_tim_tp(ubx.TimTp(NOON_MS, 0, 0, WEEK - 1024, 0, 0)),
        pvt(NOON_MS, year=2007),
    )
    assert [message.valid for message in times(records)] == [False, False, False]
    assert parser.counters.errors["date_before_floor"] == 3
    assert [fix.time.week for fix in fixes(records)] == [None]


def test_event_marks_of_both_edges_are_decoded() -> None:
    mark = ubx.TimTm2(1, 0xC4 | 1 << 3, 513, WEEK, WEEK + 1, NOON_MS, 250, 5, 750, 30)
    records, _ = parse(ubx.encode_tim_tm2(mark))
    rising, falling = (record for record in records if isinstance(record, EventMark))
    assert (rising.rising, rising.count, rising.channel, rising.valid) == (True, 513, "EXTINT1", True)
    assert (rising.time.week, rising.time.time_ns, rising.sigma_s) == (WEEK, NOON_MS * MS + 250, 30e-9)
    assert (falling.rising, falling.time.week, falling.time.time_ns) == (False, WEEK + 1, 5 * MS + 750)
    receiver_time = mark._replace(flags=0xC4)
    assert [r.valid for r in parse(ubx.encode_tim_tm2(receiver_time))[0] if isinstance(r, EventMark)] == [False, False]


def test_a_message_without_a_fix_is_not_an_error() -> None:
    records, parser = parse(pvt(NOON_MS, fix_type=0, flags=0, valid=0, year=0, month=0, day=0))
    (fix,) = fixes(records)
    assert (fix.lat_rad, fix.velocity_l, fix.fix_type, fix.valid) == (None, None, FixType.NONE, False)
    assert (times(records), parser.counters.bad_messages) == ([], 0)


@pytest.mark.parametrize(
    "frame",
    [
        ubx.encode_frame(b"\x01\x07", b""),
        ubx.encode_frame(b"\x01\x07", bytes(83)),
        ubx.encode_frame(b"\x0d\x01", bytes(15)),
        pvt(NOON_MS, itow_ms=WEEK_MS),
        pvt(NOON_MS, month=13),
        pvt(NOON_MS, hour=24),
        ubx.encode_tim_tp(ubx.TimTp(WEEK_MS, 0, 0, WEEK, 0, 0)),
        ubx.encode_tim_tm2(ubx.TimTm2(0, 0x80, 1, WEEK, WEEK, WEEK_MS, 0, 0, 0, 0)),
        ubx.encode_nav_cov(ubx.NavCov(NOON_MS, 0, 1, 1, math.nan, *range(11))),
    ],
)
def test_impossible_content_is_counted_as_a_bad_message(frame: bytes) -> None:
    records, parser = parse(frame)
    assert (records, parser.counters.bad_messages, parser.counters.bad_checksums) == ([], 1, 0)


def test_host_time_is_that_of_the_read_that_completed_the_frame() -> None:
    parser = make()
    frame = timegps(NOON_MS)
    assert parser.feed(Chunk("gnss/test", 5, frame[:-1])) == []
    (message,) = parser.feed(Chunk("gnss/test", 9, frame[-1:]))
    assert isinstance(message, TimeMessage)
    assert message.host_time_ns == 9
