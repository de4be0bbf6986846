"""Tests SBF on real recordings: pysbf2's values, every cut and damage, and the time in the blocks."""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from pysbf2 import ERR_RAISE, SBF_MSGIDS, SBF_PROTOCOL, SBFReader

from swath.drivers.gnss.sbf import blocks as sbf
from swath.drivers.gnss.sbf.frame import NAMES, Layout, number_of, read_header
from swath.drivers.gnss.sbf.parser import SbfParser, make_time_parser
from swath.drivers.parser import DeviceSettings
from swath.georef.records import FixType, GnssFix, NamesEdge, Record, TimeMessage, TimeScale
from tests.drivers.builders import of_type
from tests.drivers.harness import canonical, check_damage, check_garbage, check_stream, feed_pieces
from tests.drivers.recordings import expected, recording

SETTINGS = DeviceSettings("gnss/test")
WEEK = 2367
RECORDINGS = sorted(expected("sbf"))


def make() -> SbfParser:
    return SbfParser(SETTINGS)


def parse(*pieces: bytes) -> tuple[list[Record], SbfParser]:
    """Parse the pieces to the end; return records and parser."""
    parser = make()
    return feed_pieces(parser, pieces), parser


def blocks_of(name: str, block: str = "") -> Iterator[tuple[bytes, Any]]:
    """Yield the frames of a recording, of one block if given, with what pysbf2 reads from each."""
    reader = SBFReader(io.BytesIO(recording("sbf", name)), protfilter=SBF_PROTOCOL, quitonerror=ERR_RAISE)
    for raw, message in reader:
        if message is not None and (not block or message.identity == block):
            yield raw, message


# --- frames ---


def test_block_names_match_pysbf2() -> None:
    theirs = {number: name for number, (name, _) in SBF_MSGIDS.items()}
    assert {number: NAMES[number] for number in theirs} == theirs
    assert len(set(NAMES.values())) == len(NAMES)


@pytest.mark.parametrize("name", RECORDINGS)
def test_messages_of_every_recording_match_pysbf2(name: str) -> None:
    data = recording("sbf", name)
    records, parser = parse(data)
    theirs: Counter[str] = Counter()
    for message, count in expected("sbf")[name]["messages"].items():
        protocol, _, rest = message.partition(":")
        theirs[{"SBF": rest, "NMEA": rest[2:], "RTCM3": f"RTCM{rest}"}[protocol]] += count
    assert +parser.counters.messages == theirs
    assert (parser.counters.bad_checksums, parser.counters.bad_messages) == (0, 0)
    assert parser.counters.bytes == parser.counters.bytes_framed + parser.counters.bytes_skipped == len(data)
    times = feed_pieces(make_time_parser(SETTINGS), [data])
    assert list(map(canonical, times)) == list(map(canonical, of_type(records, TimeMessage)))


def test_nmea_from_a_septentrio_receiver_is_framed() -> None:
    """The recording is a PolaRx2 of gpsd's suite."""
    records, parser = parse(recording("nmea", "polarx2.log"))
    assert records == []
    assert parser.counters.messages.total() == expected("nmea")["polarx2.log"]["frame_scan_own"]["nmea_ok"] == 75
    assert parser.counters.bytes_skipped == 0


def test_binary_data_of_another_receiver_is_skipped() -> None:
    records, parser = parse(recording("sbf", "pygpsdata_ubx.log"))
    assert records == []
    assert parser.counters.bytes_skipped == expected("sbf")["pygpsdata_ubx.log"]["bytes"]


def test_a_recording_truncated_within_a_block_loses_only_that_block() -> None:
    records, parser = parse(recording("sbf", "pygpsdata_x5_pvttruncated.log"))
    assert parser.counters.bytes_skipped == 222 - 96 - 2 * 56
    [fix] = of_type(records, GnssFix)
    assert canonical(fix) == canonical(of_type(parse(recording("sbf", "pygpsdata_x5_pvtgeod.log"))[0], GnssFix)[0])


# --- cut and damaged ---


def test_records_do_not_depend_on_how_the_longest_recording_is_cut() -> None:
    check_stream(make, recording("sbf", "sbfdata.log"))


@pytest.mark.slow
def test_records_of_concatenated_recordings_do_not_depend_on_how_they_are_cut() -> None:
    check_stream(make, b"".join(recording("sbf", name) for name in RECORDINGS if name != "sbfdata.log"))


@pytest.mark.parametrize("name", ["sbfdata.log", "pygpsdata_x5_constellations.log"])
def test_damage_affects_only_the_blocks_it_hits(name: str) -> None:
    check_damage(make, recording("sbf", name), examples=40)


def test_garbage_never_raises() -> None:
    check_garbage(make)


# --- values: pysbf2 ---

# (layout, our field, pysbf2's attribute, factor from its value to ours)
FIELDS: dict[str, tuple[str, Layout[Any], dict[str, tuple[str, float]]]] = {
    "PVTGeodetic": (
        "pygpsdata_x5_pvtgeod.log",
        sbf.PVT_GEODETIC,
        {
            "mode": ("Type", 1),
            "error": ("Error", 1),
            "lat_rad": ("Latitude", 1),
            "lon_rad": ("Longitude", 1),
            "height_m": ("Height", 1),
            "undulation_m": ("Undulation", 1),
            "north_mps": ("Vn", 1),
            "east_mps": ("Ve", 1),
            "up_mps": ("Vu", 1),
            "course_deg": ("COG", 1),
            "clock_bias_ms": ("RxClkBias", 1),
            "clock_drift_ppm": ("RxClkDrift", 1),
            "time_system": ("TimeSystem", 1),
            "datum": ("Datum", 1),
            "satellites": ("NrSV", 1),
            "reference_id": ("ReferenceID", 1),
            "mean_correction_age_10ms": ("MeanCorrAge", 100),
            "signals": ("SignalInfo", 1),
            "bases": ("NrBases", 1),
            "latency_100us": ("Latency", 1e4),
            "horizontal_accuracy_cm": ("HAccuracy", 100),
            "vertical_accuracy_cm": ("VAccuracy", 100),
        },
    ),
    "PVTCartesian": (
        "sbfdata.log",
        sbf.PVT_CARTESIAN,
        {
            "mode": ("Type", 1),
            "error": ("Error", 1),
            "x_m": ("X", 1),
            "z_m": ("Z", 1),
            "vz_mps": ("Vz", 1),
            "clock_bias_ms": ("RxClkBias", 1),
            "clock_drift_ppm": ("RxClkDrift", 1),
        },
    ),
    "PosCovGeodetic": (
        "pygpsdata_x5_pvtgeod.log",
        sbf.POS_COV_GEODETIC,
        {
            "lat_lat": ("Cov_latlat", 1),
            "lon_lon": ("Cov_lonlon", 1),
            "height_height": ("Cov_hgthgt", 1),
            "b_b": ("Cov_bb", 1),
            "lat_lon": ("Cov_latlon", 1),
            "lat_height": ("Cov_lathgt", 1),
            "lon_height": ("Cov_lonhgt", 1),
            "height_b": ("Cov_hb", 1),
        },
    ),
    "VelCovGeodetic": (
        "pygpsdata_x5_pvtgeod.log",
        sbf.VEL_COV_GEODETIC,
        {
            "north_north": ("Cov_VnVn", 1),
            "east_east": ("Cov_VeVe", 1),
            "up_up": ("Cov_VuVu", 1),
            "north_east": ("Cov_VnVe", 1),
            "north_up": ("Cov_VnVu", 1),
            "east_up": ("Cov_VeVu", 1),
            "up_t": ("Cov_VuDt", 1),
        },
    ),
    "ReceiverTime": (
        "pygpsdata_x5_time.log",
        sbf.RECEIVER_TIME,
        {
            "year": ("UTCYear", 1),
            "month": ("UTCMonth", 1),
            "day": ("UTCDay", 1),
            "hour": ("UTCHour", 1),
            "minute": ("UTCMin", 1),
            "second": ("UTCSec", 1),
            "leap_seconds": ("DeltaLS", 1),
            "sync_level": ("SyncLevel", 1),
        },
    ),
    "xPPSOffset": (
        "pygpsdata_x5_time.log",
        sbf.XPPS_OFFSET,
        {"sync_age_s": ("SyncAge", 1), "time_scale": ("TimeScale", 1), "offset_ns": ("Offset", 1e9)},
    ),
    "AttEuler": (
        "pygpsdata_x5_attitude.log",
        sbf.ATT_EULER,
        {"satellites": ("NrSV", 1), "error": ("Error", 1), "mode": ("Mode", 1), "heading_deg": ("Heading", 1)},
    ),
    "AttCovEuler": (
        "pygpsdata_x5_attitude.log",
        sbf.ATT_COV_EULER,
        {"error": ("Error", 1), "heading_heading": ("Cov_HeadHead", 1), "pitch_roll": ("Cov_PitchRoll", 1)},
    ),
}


@pytest.mark.parametrize("block", FIELDS)
def test_fields_match_pysbf2(block: str) -> None:
    name, layout, fields = FIELDS[block]
    decoded = list(blocks_of(name, block))
    assert len(decoded) == expected("sbf")[name]["messages"][f"SBF:{block}"]
    for raw, theirs in decoded:
        ours = layout.decode(raw)
        assert number_of(raw) == layout.number
        assert read_header(raw).week == theirs.WNc
        for field, (attribute, factor) in fields.items():
            value = getattr(theirs, attribute) * factor  # rounded by pysbf2 to 12 digits behind the point
            assert getattr(ours, field) == pytest.approx(value, rel=1e-12, abs=factor * 0.5e-12), field


@pytest.mark.parametrize("block", [block for block in FIELDS if block != "PVTCartesian"])
def test_real_blocks_are_encoded_byte_for_byte(block: str) -> None:
    name, layout, _ = FIELDS[block]
    for raw, _ in blocks_of(name, block):
        header = read_header(raw)
        ours = layout.encode(layout.decode(raw), header.tow_ms, header.week, revision=header.revision)
        assert ours[4 : layout.end] == raw[4 : layout.end]
        assert len(ours) == len(raw)


def test_fixes_match_pysbf2() -> None:
    decoded = {message.identity: message for _, message in blocks_of("pygpsdata_x5_pvtgeod.log")}
    pvt, position, velocity = (decoded[name] for name in ("PVTGeodetic", "PosCovGeodetic", "VelCovGeodetic"))
    [fix] = of_type(parse(recording("sbf", "pygpsdata_x5_pvtgeod.log"))[0], GnssFix)
    assert (fix.lat_rad, fix.lon_rad, fix.height_m) == (pvt.Latitude, pvt.Longitude, pvt.Height)
    assert fix.velocity_l == (pvt.Vn, pvt.Ve, -pvt.Vu)
    assert fix.satellites == pvt.NrSV
    assert (fix.fix_type, fix.valid, pvt.Type) == (FixType.DIFFERENTIAL, True, 6)
    assert (fix.time.scale, fix.time.week) == (TimeScale.GPS, WEEK)
    assert fix.time.time_ns == pytest.approx(482_847_000 * 1e6 - pvt.RxClkBias * 1e6, abs=1)
    assert fix.position_cov_l is not None
    assert fix.velocity_cov_l is not None
    north, east, down = fix.position_cov_l
    np.testing.assert_allclose(north, [position.Cov_latlat, position.Cov_latlon, -position.Cov_lathgt])
    np.testing.assert_allclose(east, [position.Cov_latlon, position.Cov_lonlon, -position.Cov_lonhgt])
    np.testing.assert_allclose(down, [-position.Cov_lathgt, -position.Cov_lonhgt, position.Cov_hgthgt])
    north, east, down = fix.velocity_cov_l
    np.testing.assert_allclose(north, [velocity.Cov_VnVn, velocity.Cov_VnVe, -velocity.Cov_VnVu])
    np.testing.assert_allclose(east, [velocity.Cov_VnVe, velocity.Cov_VeVe, -velocity.Cov_VeVu])
    np.testing.assert_allclose(down, [-velocity.Cov_VnVu, -velocity.Cov_VeVu, velocity.Cov_VuVu])


def test_accuracies_replace_a_missing_covariance() -> None:
    """The same epoch comes with and without PosCovGeodetic; PVTGeodetic alone resolves centimetres only."""
    data = recording("sbf", "pygpsdata_x5_pvtgeod.log")
    [alone], [whole] = (of_type(parse(piece)[0], GnssFix) for piece in (data[:96], data))
    assert alone.position_cov_l is not None
    assert whole.position_cov_l is not None
    assert alone.velocity_cov_l is None
    horizontal = [2.0 * math.sqrt(fix[0, 0] + fix[1, 1]) for fix in (alone.position_cov_l, whole.position_cov_l)]
    vertical = [2.0 * math.sqrt(fix[2, 2]) for fix in (alone.position_cov_l, whole.position_cov_l)]
    assert horizontal[0] == pytest.approx(horizontal[1], abs=0.0051)
    assert vertical[0] == pytest.approx(vertical[1], abs=0.0051)


def test_every_second_of_a_recording_is_named_once() -> None:
    times = of_type(parse(recording("sbf", "sbfdata.log"))[0], TimeMessage)
    scan = expected("sbf")["sbfdata.log"]["frame_scan_own"]
    first, last = scan["first_tow_ms_wnc"], scan["last_tow_ms_wnc"]
    assert [time.time.time_ns for time in times] == [ms * 10**6 for ms in range(first[0], last[0] + 1, 1000)]
    assert {(time.time.week, time.valid, time.bound, time.names_edge) for time in times} == {
        (first[1], True, False, NamesEdge.PREVIOUS)
    }


def test_pulse_and_receiver_time_are_decoded_from_a_recording() -> None:
    decoded = {message.identity: message for _, message in blocks_of("pygpsdata_x5_time.log")}
    pulse, time = of_type(parse(recording("sbf", "pygpsdata_x5_time.log"))[0], TimeMessage)
    assert (pulse.message, pulse.bound, pulse.valid, pulse.names_edge) == ("xPPSOffset", True, True, NamesEdge.PREVIOUS)
    assert pulse.quantisation_ns == pytest.approx(decoded["xPPSOffset"].Offset * 1e9, abs=5e-4)
    assert (time.message, time.bound, time.valid, time.names_edge) == ("ReceiverTime", False, True, NamesEdge.PREVIOUS)
    assert time.time.leap_seconds == decoded["ReceiverTime"].DeltaLS == 18
    assert (time.time.week, time.time.time_ns) == (pulse.time.week, pulse.time.time_ns) == (WEEK, 483_078_000 * 10**6)
    utc = decoded["ReceiverTime"]
    of_day = time.time.time_ns // 10**9 % 86_400 - 18
    assert of_day == utc.UTCHour * 3600 + utc.UTCMin * 60 + utc.UTCSec
