"""Tests SBF by its encoder, or by hand where no library decodes a block: blocks without a recording, odd input."""

from __future__ import annotations

import datetime as dt
import io
import math
import struct
from typing import Any

import numpy as np
import pytest
from pysbf2 import ERR_RAISE, SBF_PROTOCOL, SBFReader

from swath.drivers.driver import find_driver
from swath.drivers.gnss.nmea.sentences import encode_sentence
from swath.drivers.gnss.sbf import blocks as sbf
from swath.drivers.gnss.sbf.frame import encode_frame
from swath.drivers.gnss.sbf.parser import SbfParser
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.georef.arrays import StructArray
from swath.georef.records import (
    Chunk,
    EventMark,
    FixType,
    GnssFix,
    GnssHeading,
    ImuSamples,
    InsSolution,
    NamesEdge,
    Record,
    TimeMessage,
)
from swath.georef.timescales import PpsClock, TimeState
from swath.georef.timescales.leap_book import LeapSeconds
from tests.drivers.harness import check_damage, check_stream, feed_pieces
from tests.drivers.recordings import recording

WEEK, TOW_MS = 2443, 345_600_000
WEEK_NS = 604_800 * 10**9
UNSET = sbf.FLOAT_UNSET
BIAS_MS = -0.25
PVT = sbf.PvtGeodetic(
    4, 0, 0.82, 0.16, 500.0, 48.0, 10.0, 60.0, 1.5, 80.5, BIAS_MS, 0.2, 0, 0, 24, 0, 7, 120, 0, 0, 1, 0, 55, 4, 6, 0
)
POS_COV = sbf.PosCovGeodetic(4, 0, 4e-4, 5e-4, 9e-4, 1e-3, 1e-5, 2e-5, 0.0, 3e-5, 0.0, 0.0)
VEL_COV = sbf.VelCovGeodetic(4, 0, 1e-4, 2e-4, 3e-4, 1e-3, 1e-6, 2e-6, 0.0, 3e-6, 0.0, 0.0)
FULL_TIME = sbf.ReceiverTime(26, 11, 5, 23, 59, 42, 18, 7)
EVENT = sbf.ExtEvent(1, 0, 2.5e-4, -2.5e-4, 0)
ATTITUDE = sbf.AttEuler(20, 0, 2, 271.5, -1.25, UNSET, UNSET, UNSET, UNSET)
ATTITUDE_COV = sbf.AttCovEuler(0, 0.01, 0.04, UNSET, UNSET, UNSET, UNSET)
INS = sbf.InsNavGeod(0x24, 0, 0x48, 10, 0.82, 0.16, 500.0, 48.0, 2, 55, 0, 0)
TRIPLES = {
    sbf.INS_POSITION_SIGMA: (0.25, 0.5, 0.75),
    sbf.INS_ATTITUDE: (90.0, 2.0, -1.0),
    sbf.INS_ATTITUDE_SIGMA: (0.3, 0.2, 0.1),
    sbf.INS_VELOCITY: (60.0, 10.0, 1.5),
    sbf.INS_VELOCITY_SIGMA: (0.03125, 0.0625, 0.125),
}


def sensor(kind: int, *values: float, source: int = 32) -> sbf.SensorSet:
    """Return a measurement of three numbers, or a temperature in 0.01 °C."""
    data = struct.pack("<h22x", int(values[0])) if kind == sbf.SENSOR_INFO else struct.pack("<3d", *values)
    return sbf.SensorSet(source, 10, kind, kind + 1, data)


FORCE, RATE = sensor(sbf.SENSOR_ACCELERATION, 0.5, -0.25, 9.75), sensor(sbf.SENSOR_ANGULAR_RATE, 1.0, -2.0, 180.0)


def parse(data: bytes, **config: Any) -> tuple[list[Record], SbfParser]:
    """Parse a stream to the end; return records and parser."""
    parser = SbfParser(DeviceSettings("gnss/rover", config))
    return feed_pieces(parser, [data]), parser


def one(data: bytes, kind: type[Any]) -> Any:
    """Return the only record of a type."""
    (record,) = [record for record in parse(data)[0] if isinstance(record, kind)]
    return record


def none_of(data: bytes, *kinds: type[Any]) -> SbfParser:
    """Return the parser after asserting that no record of these types came."""
    records, parser = parse(data)
    assert not [record for record in records if isinstance(record, kinds)]
    return parser


def rows_of(data: bytes, kind: type[ImuSamples] | type[InsSolution]) -> StructArray:
    """Return all rows of one type."""
    return np.concatenate([record.rows for record in parse(data)[0] if isinstance(record, kind)])


def pvt(tow_ms: int | None = TOW_MS, week: int | None = WEEK, **changes: Any) -> bytes:
    return sbf.PVT_GEODETIC.encode(PVT._replace(**changes), tow_ms, week)


def imu(*sets: sbf.SensorSet, tow_ms: int | None = TOW_MS, week: int | None = WEEK) -> bytes:
    return sbf.encode_ext_sensor_meas(list(sets), tow_ms, week)


# --- the encoder ---


def test_pysbf2_reads_encoded_blocks() -> None:
    data = (
        pvt()
        + sbf.EXT_EVENT.encode(EVENT, TOW_MS + 3, WEEK)
        + sbf.ATT_EULER.encode(ATTITUDE, TOW_MS, WEEK)
        + sbf.ATT_COV_EULER.encode(ATTITUDE_COV, TOW_MS, WEEK)
        + sbf.END_OF_PVT.encode(sbf.NoFields(), TOW_MS, WEEK)
        + sbf.POS_COV_GEODETIC.encode(POS_COV, TOW_MS, WEEK)
    )
    reader = SBFReader(io.BytesIO(data), protfilter=SBF_PROTOCOL, quitonerror=ERR_RAISE)
    theirs = {message.identity: message for _, message in reader}
    assert list(theirs) == ["PVTGeodetic", "ExtEvent", "AttEuler", "AttCovEuler", "EndOfPVT", "PosCovGeodetic"]
    assert (theirs["PVTGeodetic"].Height, theirs["PVTGeodetic"].HAccuracy) == (500.0, 0.04)
    event = theirs["ExtEvent"]
    assert (event.Source, event.Polarity, event.RxClkBias, event.PVTAge) == (1, 0, -2.5e-4, 0)
    assert event.Offset == pytest.approx(2.5e-4, rel=1e-6)
    assert (theirs["AttEuler"].Heading, theirs["AttEuler"].Pitch, theirs["AttEuler"].Mode) == (271.5, -1.25, 2)
    assert theirs["AttCovEuler"].Cov_PitchPitch == pytest.approx(0.04)
    assert theirs["PosCovGeodetic"].Cov_lonhgt == pytest.approx(3e-5)


def stream() -> bytes:
    """Return three seconds of an INS receiver at 5 Hz, with every decoded block, and sentences and replies between."""
    pieces = []
    for step in range(15):
        tow = TOW_MS + 200 * step
        pieces += [imu(FORCE, RATE, tow_ms=tow), sbf.encode_ins_nav_geod(INS, TRIPLES, tow, WEEK), pvt(tow)]
        pieces += [sbf.POS_COV_GEODETIC.encode(POS_COV, tow, WEEK), sbf.VEL_COV_GEODETIC.encode(VEL_COV, tow, WEEK)]
        pieces += [sbf.ATT_EULER.encode(ATTITUDE, tow, WEEK), sbf.ATT_COV_EULER.encode(ATTITUDE_COV, tow, WEEK)]
        if step % 5 == 0:
            pieces += [sbf.XPPS_OFFSET.encode(sbf.XppsOffset(0, 1, 4.5), tow, WEEK)]
            pieces += [sbf.RECEIVER_TIME.encode(FULL_TIME, tow, WEEK), sbf.EXT_EVENT.encode(EVENT, tow, WEEK)]
            pieces += [b"$R: exeSBFOnce, COM1\r\nCOM1>", encode_sentence("GPZDA,235942.00,05,11,2026,00,00")]
    return b"".join(pieces)


@pytest.mark.slow
def test_records_do_not_depend_on_how_a_whole_stream_is_cut() -> None:
    whole = check_stream(lambda: SbfParser(DeviceSettings("gnss/rover")), stream())
    assert {name: len(rows) for name, rows in whole.rows.items()} == {"ImuSamples": 15, "InsSolution": 15}
    kinds = [event[0] for event in whole.events]
    assert [kinds.count(name) for name in ("GnssFix", "GnssHeading", "EventMark", "TimeMessage")] == [15, 15, 3, 9]
    assert whole.counters["bytes_skipped"] == 3 * len(b"$R: exeSBFOnce, COM1\r\nCOM1>")
    assert whole.counters["errors"] == {"clock_bias_unknown": 2}, "IMU and INS before the first position"


def test_damage_to_a_whole_stream_affects_only_the_blocks_it_hits() -> None:
    check_damage(lambda: SbfParser(DeviceSettings("gnss/rover")), stream(), examples=30)


# --- fixes ---


@pytest.mark.parametrize(
    ("mode", "error", "fix_type", "valid"),
    [
        (1, 0, FixType.SINGLE, True),
        (2, 0, FixType.DIFFERENTIAL, True),
        (3, 0, FixType.MANUAL, True),
        (4, 0, FixType.RTK_FIXED, True),
        (0x85, 0, FixType.RTK_FLOAT, True),
        (9, 0, FixType.PPP, True),  # sbfdef.h: MODE_PPP_FIXED_AMBIGUITIES
        (10, 0, FixType.PPP, True),
        (11, 0, FixType.RTK_FLOAT, True),  # sbfdef.h: MODE_RTK_FLOAT_WL_FIXED_AMBIGUITIES
        (1, 3, FixType.SINGLE, False),
        (0, 1, FixType.NONE, False),
    ],
)
def test_fix_type_follows_the_mode(mode: int, error: int, fix_type: FixType, valid: bool) -> None:
    fix = one(pvt(mode=mode, error=error), GnssFix)
    assert (fix.fix_type, fix.valid) == (fix_type, valid)
    assert one(pvt(mode=mode, error=error), TimeMessage).valid == valid


def test_do_not_use_values_become_none_or_nan() -> None:
    fields = ("lat_rad", "lon_rad", "height_m", "north_mps", "east_mps", "up_mps")
    nothing: dict[str, Any] = dict.fromkeys(fields, UNSET)
    fix = one(pvt(mode=0, error=1, satellites=255, clock_bias_ms=UNSET, **nothing), GnssFix)
    assert (fix.lat_rad, fix.lon_rad, fix.height_m, fix.velocity_l, fix.satellites) == (None,) * 5
    assert (fix.position_cov_l, fix.velocity_cov_l, fix.time.time_ns) == (None, None, TOW_MS * 10**6)
    flat = one(pvt(mode=0x81, up_mps=UNSET), GnssFix)
    assert flat.velocity_l[:2] == (10.0, 60.0)
    assert math.isnan(flat.velocity_l[2])
    assert one(pvt(horizontal_accuracy_cm=0xFFFF), GnssFix).position_cov_l is None
    unset = sbf.POS_COV_GEODETIC.encode(POS_COV._replace(height_height=UNSET), TOW_MS, WEEK)
    assert one(pvt() + unset, GnssFix).position_cov_l is None


@pytest.mark.parametrize("revision", [0, 1, 2, 5])
def test_older_and_later_revisions_are_read(revision: int) -> None:
    data = sbf.PVT_GEODETIC.encode(PVT, TOW_MS, WEEK, revision=revision)
    fix = one(data, GnssFix)
    assert (fix.lat_rad, fix.satellites) == (0.82, 24)
    assert (fix.position_cov_l is None) == (revision < 2)


def test_a_fix_is_complete_at_the_end_of_its_epoch() -> None:
    parser = SbfParser(DeviceSettings("gnss/rover"))
    assert not [r for r in feed_pieces(parser, [pvt()], close=False) if isinstance(r, GnssFix)]
    end = sbf.END_OF_PVT.encode(sbf.NoFields(), TOW_MS, WEEK)
    assert [type(r) for r in feed_pieces(parser, [end], close=False)] == [GnssFix]


def test_a_clock_bias_across_the_end_of_the_week_changes_the_week() -> None:
    early = one(pvt(0, WEEK, clock_bias_ms=0.1), GnssFix).time
    late = one(pvt(604_799_999, WEEK, clock_bias_ms=-1.5), GnssFix).time
    assert (early.week, early.time_ns) == (WEEK - 1, WEEK_NS - 100_000)
    assert (late.week, late.time_ns) == (WEEK + 1, 500_000)


# --- time ---


def test_the_second_is_named_once_an_epoch_and_only_on_the_whole_second() -> None:
    ins = sbf.encode_ins_nav_geod(INS, TRIPLES, TOW_MS, WEEK)
    assert one(pvt() + ins, TimeMessage).message == "PVTGeodetic"
    assert one(ins + pvt(), TimeMessage).message == "INSNavGeod"
    none_of(pvt(TOW_MS + 100), TimeMessage)


@pytest.mark.parametrize(("level", "valid"), [(7, True), (0x1F, True), (3, False), (1, False), (0, False)])
def test_time_is_valid_at_full_synchronisation_only(level: int, valid: bool) -> None:
    time = sbf.RECEIVER_TIME.encode(FULL_TIME._replace(sync_level=level), TOW_MS, WEEK)
    pulse = sbf.XPPS_OFFSET.encode(sbf.XppsOffset(0, 1, 4.5), TOW_MS, WEEK)
    records, _ = parse(time + pulse + pvt())
    assert [r.valid for r in records if isinstance(r, TimeMessage)] == [valid] * 3


def test_leap_seconds_are_given_only_when_the_receiver_knows_them() -> None:
    unknown = FULL_TIME._replace(leap_seconds=-128, year=-128)
    message = one(sbf.RECEIVER_TIME.encode(unknown, TOW_MS, WEEK), TimeMessage)
    assert (message.valid, message.time.leap_seconds) == (True, None)
    assert one(sbf.RECEIVER_TIME.encode(FULL_TIME, TOW_MS, WEEK), TimeMessage).time.leap_seconds == 18


@pytest.mark.parametrize(("scale", "valid"), [(1, True), (2, True), (3, False), (4, True), (6, True), (0, False)])
def test_a_pulse_on_the_receivers_own_clock_names_no_second(scale: int, valid: bool) -> None:
    data = sbf.XPPS_OFFSET.encode(sbf.XppsOffset(0, scale, -7.25), TOW_MS, WEEK)
    message = one(data, TimeMessage)
    assert (message.bound, message.valid, message.names_edge) == (True, valid, NamesEdge.PREVIOUS)
    assert message.quantisation_ns == -7.25
    assert parse(data)[1].counters.errors["xpps_time_scale"] == (not valid)


@pytest.mark.parametrize("offset", [UNSET, math.nan, math.inf, 2e6])
def test_an_absent_pps_offset_is_not_subtracted(offset: float) -> None:
    assert one(sbf.XPPS_OFFSET.encode(sbf.XppsOffset(0, 1, offset), TOW_MS, WEEK), TimeMessage).quantisation_ns == 0.0


def test_without_week_no_second_is_named_and_without_time_nothing_is_given() -> None:
    message = one(pvt(week=None), TimeMessage)
    assert (message.valid, message.time.week, message.time.time_ns) == (False, None, TOW_MS * 10**6)
    fix = one(pvt(week=None), GnssFix)
    assert (fix.time.week, fix.valid) == (None, True)
    nothing = (
        pvt(None, None)
        + sbf.RECEIVER_TIME.encode(FULL_TIME._replace(sync_level=0), None, None)
        + sbf.XPPS_OFFSET.encode(sbf.XppsOffset(0, 1, 0.0), None, None)
        + sbf.EXT_EVENT.encode(EVENT, None, None)
        + sbf.ATT_EULER.encode(ATTITUDE, None, None)
        + sbf.encode_ins_nav_geod(INS, TRIPLES, None, None)
    )
    records, parser = parse(nothing)
    assert records == []
    assert parser.counters.errors["time_unknown"] == 4
    assert parser.counters.bad_messages == 0


def test_a_week_one_rollover_behind_is_invalid() -> None:
    message = one(pvt(week=WEEK - 1024), TimeMessage)
    assert (message.valid, message.time.week) == (False, None)
    assert parse(pvt(week=WEEK - 1024))[1].counters.errors == {"date_before_floor": 1}
    records, _ = parse(pvt(week=WEEK - 1024), date_floor="2000-01-01")
    assert [r.valid for r in records if isinstance(r, TimeMessage)] == [True]
    with pytest.raises(DriverSettingsError, match="date_floor"):
        parse(b"", date_floor="soon")


@pytest.mark.parametrize(("tow_ms", "week"), [(604_800_000, WEEK), (0xFFFF_FFFE, WEEK), (0, 8192), (0, 0xFFFE)])
def test_impossible_times_are_counted(tow_ms: int, week: int) -> None:
    parser = none_of(pvt(tow_ms, week) + imu(FORCE, RATE, tow_ms=tow_ms, week=week), object)
    assert (parser.counters.bad_messages, parser.counters.errors["bad_time_stamp"]) == (2, 2)


@pytest.mark.parametrize(("told", "least_ns", "greatest_ns"), [(True, 0.0, 5.0), (False, 20.0, 300.0)])
def test_pulses_are_labelled_and_their_offsets_subtracted(told: bool, least_ns: float, greatest_ns: float) -> None:
    """Edges are up to 300 ns off; xPPSOffset comes 5 ms after each, ReceiverTime half a second late."""
    clock, parser = PpsClock(assumed_leap_seconds=17), SbfParser(DeviceSettings("gnss/rover"))
    errors = np.random.default_rng(5).uniform(-300.0, 300.0, 600).round()
    found: list[float] = []
    for second in range(600):
        edge = 10**12 + second * (10**9 + 23_000)
        clock.add_edge(edge + int(errors[second]), second)
        tow = (TOW_MS // 1000 + second) * 1000
        pulse = sbf.XPPS_OFFSET.encode(sbf.XppsOffset(0, 1, errors[second] if told else 0.0), tow, WEEK)
        time = sbf.RECEIVER_TIME.encode(FULL_TIME, tow, WEEK)
        for late_ns, data in ((5_000_000, pulse), (500_000_000, time)):
            for record in parser.feed(Chunk("gnss/rover", edge + late_ns, data)):
                assert isinstance(record, TimeMessage)
                clock.add_message("gnss/rover", record)
        if second > 300:
            gps_ns, _ = clock.gps_from_host(np.array([edge]))
            found.append(int(gps_ns[0]) - (WEEK * WEEK_NS + tow * 10**6))
    assert least_ns <= float(np.sqrt(np.mean(np.square(found)))) < greatest_ns
    assert clock.status(10**12 + 599 * 10**9 + 10**8).state is TimeState.LOCKED
    assert clock.leaps.on("gnss/rover", dt.date(2026, 1, 1)) == LeapSeconds(18, "receiver")


# --- events and heading ---


def test_an_event_is_in_gnss_time() -> None:
    """By page 426 of the reference guide its time is TOW/1000 + Offset − RxClkBias."""
    mark = one(sbf.EXT_EVENT.encode(EVENT, TOW_MS + 3, WEEK), EventMark)
    assert (mark.time.week, mark.channel, mark.rising, mark.valid) == (WEEK, "EventA", True, True)
    assert mark.time.time_ns == pytest.approx((TOW_MS + 3) * 10**6 + 250_000 + 250_000, abs=1)
    falling = one(sbf.EXT_EVENT.encode(EVENT._replace(source=2, polarity=1), TOW_MS, WEEK, revision=0), EventMark)
    assert (falling.channel, falling.rising) == ("EventB", False)
    at_the_end = one(sbf.EXT_EVENT.encode(EVENT._replace(offset_s=8e-4), 604_799_999, WEEK), EventMark)
    assert (at_the_end.time.week, at_the_end.time.time_ns) == (WEEK + 1, pytest.approx(50_000, abs=1))


@pytest.mark.parametrize("change", [{"clock_bias_s": UNSET}, {"offset_s": UNSET}, {"offset_s": 1e30}])
def test_an_event_without_clock_bias_is_invalid(change: dict[str, Any]) -> None:
    mark = one(sbf.EXT_EVENT.encode(EVENT._replace(**change), TOW_MS, WEEK), EventMark)
    assert (mark.valid, mark.time.time_ns) == (False, TOW_MS * 10**6)


def test_a_heading_uses_the_sigmas_of_its_covariances_and_the_clock_of_the_position() -> None:
    cov = sbf.ATT_COV_EULER.encode(ATTITUDE_COV, TOW_MS, WEEK)
    heading = one(pvt() + sbf.ATT_EULER.encode(ATTITUDE, TOW_MS, WEEK) + cov, GnssHeading)
    assert math.degrees(heading.heading_rad) == pytest.approx(271.5)
    assert math.degrees(heading.pitch_rad) == pytest.approx(-1.25)
    assert math.degrees(heading.heading_sigma_rad) == pytest.approx(0.1, rel=1e-6)
    assert math.degrees(heading.pitch_sigma_rad) == pytest.approx(0.2, rel=1e-6)
    assert heading.valid
    assert heading.time.time_ns == TOW_MS * 10**6 + 250_000
    alone = one(sbf.ATT_EULER.encode(ATTITUDE._replace(error=1), TOW_MS, WEEK), GnssHeading)
    assert (alone.valid, alone.heading_sigma_rad) == (False, None)


def test_a_single_antenna_gives_no_heading() -> None:
    none_of(recording("sbf", "pygpsdata_x5_attitude.log"), GnssHeading)


# --- INS and IMU: bytes by hand, in the order of Septentrio's ROS driver ---


def test_an_ins_solution_written_by_hand_is_decoded() -> None:
    fixed = struct.pack("<BBHHdddfHHBxH", 0x24, 0, 0x48, 10, 0.82, 0.16, 500.0, 48.0, 2, 55, 0, 0b11111)
    sigmas = struct.pack("<3f", 0.25, 0.5, 0.75)  # latitude, longitude, height
    attitude = struct.pack("<6f", 90.0, 2.0, -1.0, 0.3, 0.2, 0.1)  # heading, pitch, roll, and their sigmas
    velocity = struct.pack("<6f", 60.0, 10.0, 1.5, 0.03125, 0.0625, 0.125)  # east, north, up, and their sigmas
    by_hand = encode_frame(4226, fixed + sigmas + attitude + velocity, TOW_MS + 20, WEEK)
    assert by_hand == sbf.encode_ins_nav_geod(INS, TRIPLES, TOW_MS + 20, WEEK)
    [row] = rows_of(pvt() + by_hand, InsSolution)
    assert row["gps_ns"] == WEEK * WEEK_NS + (TOW_MS + 20) * 10**6 + 250_000 - 4, "drift: 0.2 ppm of 20 ms"
    assert (row["lat_rad"], row["lon_rad"], row["height_m"]) == (0.82, 0.16, 500.0)
    assert row["velocity_l"].tolist() == [10.0, 60.0, -1.5]
    assert np.degrees([row["roll_rad"], row["pitch_rad"], row["heading_rad"]]) == pytest.approx([-1.0, 2.0, 90.0])
    assert row["position_sigma_l"].tolist() == [0.25, 0.5, 0.75]
    assert row["velocity_sigma_l"].tolist() == [0.0625, 0.03125, 0.125]
    assert np.degrees(row["attitude_sigma_rad"]) == pytest.approx([0.1, 0.2, 0.3], rel=1e-6)
    assert row["status"] == 0x48


@pytest.mark.parametrize(
    "kept", [(), (sbf.INS_ATTITUDE,), (sbf.INS_VELOCITY,), (sbf.INS_POSITION_SIGMA, sbf.INS_VELOCITY)]
)
def test_absent_sub_blocks_give_nan(kept: tuple[int, ...]) -> None:
    triples = {bit: TRIPLES[bit] for bit in kept}
    [row] = rows_of(sbf.encode_ins_nav_geod(INS._replace(error=31), triples, TOW_MS, WEEK), InsSolution)
    assert np.isnan(row["heading_rad"]) == (sbf.INS_ATTITUDE not in kept)
    assert np.isnan(row["velocity_l"]).all() == (sbf.INS_VELOCITY not in kept)
    assert np.isnan(row["position_sigma_l"]).all() == (sbf.INS_POSITION_SIGMA not in kept)
    assert row["status"] == 31 << 16 | 0x48


def test_an_ins_without_a_solution_gives_no_row() -> None:
    aligning = INS._replace(error=23, lat_rad=UNSET, lon_rad=UNSET, height_m=UNSET)
    unset = {sbf.INS_ATTITUDE: (UNSET, UNSET, UNSET)}
    parser = none_of(sbf.encode_ins_nav_geod(aligning, unset, TOW_MS, WEEK), InsSolution)
    assert parser.counters.errors["ins_no_solution"] == 1
    assert parser.counters.bad_messages == 0


def test_a_block_shorter_than_its_stated_length_is_counted() -> None:
    ins = sbf.INS_NAV_GEOD.encode(INS._replace(sub_blocks=0b11111), TOW_MS, WEEK, behind=bytes(12))
    sensors = sbf.EXT_SENSOR_MEAS.encode(sbf.ExtSensorMeas(2, 28), TOW_MS, WEEK, behind=bytes(28))
    narrow = sbf.EXT_SENSOR_MEAS.encode(sbf.ExtSensorMeas(1, 20), TOW_MS, WEEK, behind=bytes(28))
    short = encode_frame(sbf.PVT_GEODETIC.number, bytes(20), TOW_MS, WEEK)
    parser = none_of(ins + sensors + narrow + short, object)
    assert (parser.counters.bad_messages, parser.counters.errors["bad_length"]) == (4, 4)


def test_inertial_samples_written_by_hand_are_decoded() -> None:
    sets = struct.pack("<BBBB3d", 32, 10, 0, 1, 0.5, -0.25, 9.75)
    sets += struct.pack("<BBBB3d", 32, 10, 1, 2, 1.0, -2.0, 180.0)
    sets += struct.pack("<BBBBh22x", 32, 10, 3, 0, 3125)
    by_hand = encode_frame(4050, struct.pack("<BB", 3, 28) + sets, TOW_MS, WEEK)
    first, second = rows_of(pvt() + by_hand + imu(RATE, FORCE, tow_ms=TOW_MS + 20), ImuSamples)
    assert first["specific_force_b"].tolist() == second["specific_force_b"].tolist() == [0.5, -0.25, 9.75]
    assert np.degrees(first["angular_rate_b"]) == pytest.approx([1.0, -2.0, 180.0])
    assert (first["device_time_ns"], first["gps_week"], first["pps_time_ns"]) == (TOW_MS * 10**6 + 250_000, WEEK, -1)
    assert second["device_time_ns"] - first["device_time_ns"] == 20 * 10**6 - 4
    assert math.isnan(first["temperature_c"]), "it came behind this sample"
    assert second["temperature_c"] == 31.25
    assert (first["status"], second["status"]) == (0x0201, 0x0201)


def test_longer_sets_and_other_measurement_types_are_skipped() -> None:
    sets = [struct.pack("<BBBB24s", *one) + bytes(4) for one in (FORCE, FORCE._replace(kind=4), RATE)]
    data = sbf.EXT_SENSOR_MEAS.encode(sbf.ExtSensorMeas(3, 32), TOW_MS, WEEK, behind=b"".join(sets))
    assert len(rows_of(data, ImuSamples)) == 1


def test_halves_in_two_blocks_join_only_at_the_same_time() -> None:
    [row] = rows_of(imu(FORCE) + imu(RATE), ImuSamples)
    assert row["specific_force_b"].tolist() == [0.5, -0.25, 9.75]
    parser = none_of(imu(FORCE) + imu(RATE, tow_ms=TOW_MS + 20), ImuSamples)
    assert parser.counters.errors["imu_incomplete"] == 1
    assert len(rows_of(imu(FORCE) + imu(FORCE, RATE), ImuSamples)) == 1
    other = FORCE._replace(source=33)
    none_of(imu(other, RATE), ImuSamples)


def test_a_sample_with_a_do_not_use_value_is_dropped() -> None:
    bad = sensor(sbf.SENSOR_ACCELERATION, 0.5, UNSET, 9.75)
    parser = none_of(imu(bad, RATE), ImuSamples)
    assert parser.counters.errors["imu_value_unset"] == 1


def test_samples_before_the_receiver_has_time_are_decoded() -> None:
    timeless, weekless = rows_of(imu(FORCE, RATE, tow_ms=None, week=None) + imu(FORCE, RATE, week=None), ImuSamples)
    assert (timeless["device_time_ns"], timeless["gps_week"]) == (-1, -1)
    assert (weekless["device_time_ns"], weekless["gps_week"]) == (TOW_MS * 10**6, -1)


def test_imu_parser_of_the_gnss_stream_gives_only_inertial_records() -> None:
    driver = find_driver("imu", "sbf")
    assert driver.transports == ("gnss",)
    parser = driver.make_parser(DeviceSettings("imu/main"))
    records = feed_pieces(parser, [stream()])
    assert {type(record) for record in records} == {ImuSamples, InsSolution}
    rows = np.concatenate([record.rows for record in records if isinstance(record, ImuSamples)])
    assert len(rows) == 15
    assert np.diff(rows["device_time_ns"])[1:] == pytest.approx(200 * 10**6, abs=100)
