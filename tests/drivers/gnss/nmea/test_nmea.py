"""Tests NMEA on real recordings: counts, gpsd's values, every cut, times, epochs, and receivers without a fix."""

from __future__ import annotations

import datetime as dt
import math

import numpy as np
import pytest

from swath.drivers.gnss.nmea import sentences as nmea
from swath.drivers.gnss.nmea.parser import DRIVERS, NmeaParser
from swath.drivers.parser import DeviceSettings, DriverSettingsError
from swath.georef.records import Chunk, FixType, GnssFix, GnssHeading, NamesEdge, Record, TimeMessage, TimeScale
from tests.drivers.builders import of_type, times
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
S = 1_000_000_000
DAY = dt.date(2026, 11, 21)
POSITION = (math.radians(47.123456789), math.radians(-8.5))


def make() -> NmeaParser:
    return NmeaParser(SETTINGS)


def parse(*sentences: bytes, config: dict[str, object] | None = None) -> tuple[list[Record], NmeaParser]:
    """Parse the sentences to the end; return records and parser."""
    parser = NmeaParser(DeviceSettings("gnss/test", config or {}))
    return feed_pieces(parser, sentences), parser


# --- recordings ---

# gpsd adds this to the dates of recordings older than its release expects
GPSD_ROLLOVER = dt.timedelta(weeks=1024)
WITH_POSITIONS = [
    "beidou-bd.log",
    "bu353-glonass.log",
    "gp-320fw-2019-04-06-overflow.log",
    "hemi.log",
    "isync.log",
    "nmea-fuzzy-cases.log",
    "nmea-rtk.log",
    "polarx2.log",
    "quectelLC79D-1.log",
    "ublox-8.log",
    "ublox-lea-5h.log",
    "ublox-zed-f9p-nmea.log",
]


@pytest.mark.parametrize("name", WITH_POSITIONS)
def test_fixes_match_gpsd(name: str) -> None:
    """Each fix with a position has a report of gpsd at its time with the same coordinates, height and date."""
    reports: dict[int, list[dict[str, object]]] = {}
    for report in gpsd_reports("nmea", name):
        at = dt.datetime.fromisoformat(str(report["time"]))
        of_day = at - at.replace(hour=0, minute=0, second=0, microsecond=0)
        reports.setdefault(round(of_day.total_seconds() * 1000), []).append(report)
    compared = 0
    for fix in fixes(feed_pieces(make(), [recording("nmea", name)])):
        if not fix.valid or fix.lat_rad is None or fix.lon_rad is None:
            continue
        for report in reports.get(fix.time.time_ns // 1_000_000, []):
            assert math.degrees(fix.lat_rad) == pytest.approx(report["lat"], abs=1e-9)
            assert math.degrees(fix.lon_rad) == pytest.approx(report["lon"], abs=1e-9)
            if fix.height_m is not None and "altHAE" in report:
                assert fix.height_m == pytest.approx(report["altHAE"], abs=0.001)
            if fix.time.date is not None:
                date = dt.date.fromisoformat(str(report["time"])[:10])
                assert fix.time.date in (date, date - GPSD_ROLLOVER)
            compared += 1
    assert compared >= min(5, len(reports))


def test_only_the_broken_recordings_have_bad_messages() -> None:
    """april6_2019 has the invalid date 2208-1; tcp-torture and nmeafoo2 have overwritten fields."""
    bad = {}
    for name in expected("nmea"):
        parser = make()
        feed_pieces(parser, [recording("nmea", name)])
        if parser.counters.bad_messages:
            bad[name] = parser.counters.bad_messages
    assert bad == {"april6_2019.log": 1, "tcp-torture.log": 1, "pygpsdata-nmeafoo2.log": 1}


def test_sentences_without_checksum_are_counted_and_reported() -> None:
    """Many receivers send them by default; the stream has 20 with a line end of either kind."""
    text = b"".join(
        b"$GPRMC,0900%02d.00,A,4728.92,N,00854.30,E,0.0,90.0,150626,,%s" % (at, (b"\r\n", b"\n")[at % 2])
        for at in range(20)
    )
    checked_one = b"$GPVTG,,,,,,,,,N*30\r\n"
    outcome = check_stream(make, text + checked_one + text[:50])
    assert outcome.counters["errors"] == {"nmea_without_checksum": 20}
    parser = make()
    assert feed_pieces(parser, [text]) == []
    assert parser.remarks() == [
        "gnss/test: 20 sentences have no checksum and are not read; switch the checksum on in the receiver"
    ]
    feed_pieces(checked := make(), [recording("nmea", "ublox-zed-f9p-nmea.log"), text[:64]])
    assert checked.remarks() == []


def test_empty_sentences_are_reported_until_the_receiver_knows_its_time() -> None:
    """The sentences of a receiver without sky (ros-drivers/nmea_navsat_driver #5)."""
    empty = b"$GPGGA,,,,,,0,,,,,,,,*66\r\n$GPRMC,,V,,,,,,,,,,N*53\r\n$GPGLL,,,,,,V,N*64\r\n$GPVTG,,,,,,,,,N*30\r\n"
    parser = make()
    assert feed_pieces(parser, [empty * 3]) == []
    (remark,) = parser.remarks()
    assert remark.startswith("gnss/test: its 6 sentences of time and position are empty: the receiver knows neither")
    feed_pieces(parser, [recording("nmea", "ublox-zed-f9p-nmea.log")])
    assert parser.remarks() == []


def test_a_date_one_rollover_behind_is_invalid_and_counted() -> None:
    """april6_2019.log comes from a receiver that sends 1999 after the roll-over of 2019-04-06."""
    parser = make()
    records = feed_pieces(parser, [recording("nmea", "april6_2019.log")])
    assert [message.valid for message in times(records)] == [False]
    assert parser.counters.errors["date_before_floor"] == 1
    assert [fix.time.date for fix in fixes(records)] == [None]


def test_a_date_one_rollover_behind_is_corrected_by_the_host_date() -> None:
    """The computer's clock is right here, and the date is the one that gpsd has for the sentence."""
    (report,) = [report for report in gpsd_reports("nmea", "april6_2019.log") if "time" in report]
    at = dt.datetime.fromisoformat(str(report["time"]))
    parser = make()
    records = parser.feed(Chunk("gnss/test", int(at.timestamp() * S), recording("nmea", "april6_2019.log")))
    records += parser.close()
    (message,) = times(records)
    assert (message.valid, message.time.date) == (True, at.date())
    assert [fix.time.date for fix in fixes(records) if fix.valid and fix.time.date] == [at.date()]
    assert parser.counters.errors["date_before_floor"] == 0
    assert parser.remarks() == [
        "gnss/test: sends the date 1999-08-22, 1 roll-over of 1024 weeks behind; corrected to 2019-04-07, because "
        "the host clock shows that date"
    ]


@pytest.mark.parametrize("weeks", [1024, 2048])
@pytest.mark.parametrize("name", ["RMC", "ZDA"])
def test_dates_several_rollovers_behind_are_corrected(weeks: int, name: str) -> None:
    """RMC has a year of two digits, so 1987 and 2007 lie before 2026."""
    said, time = DAY - dt.timedelta(weeks=weeks), 12 * 3600 * S
    sentences = {"RMC": nmea.encode_rmc(time, said, *POSITION, 1.0, 0.0), "ZDA": nmea.encode_zda(time, said)}
    host_ns = int(dt.datetime(DAY.year, DAY.month, DAY.day, 12, tzinfo=dt.UTC).timestamp()) * S
    parser = make()
    records = parser.feed(Chunk("gnss/test", host_ns, sentences[name])) + parser.close()
    (message,) = times(records)
    assert (message.valid, message.time.date) == (True, DAY)
    (line,) = parser.remarks()
    behind = "1 roll-over of" if weeks == 1024 else "2 roll-overs of"
    assert f"sends the date {said}, {behind} 1024 weeks behind; corrected to 2026-11-21" in line


@pytest.mark.slow
def test_records_do_not_depend_on_how_the_stream_is_cut() -> None:
    outcome = check_stream(make, recording("nmea", "ublox-8.log"))
    assert outcome.counters["bad_checksums"] == outcome.counters["bad_messages"] == 0


@pytest.mark.parametrize("name", ["nmea-rtk.log", "polarx2.log", "hemi.log", "isync.log"])
def test_random_and_byte_by_byte_reads_give_the_same_records(name: str) -> None:
    check_random_reads(make, recording("nmea", name))
    check_bytewise(make, recording("nmea", name))


def test_damaged_stream_never_raises() -> None:
    check_damage(make, recording("nmea", "ublox-8.log"))


def test_garbage_never_raises() -> None:
    check_garbage(make)


@pytest.mark.parametrize("name", [*WITH_POSITIONS, "pygpsdata-nmea4.log"])
def test_time_parser_gives_the_same_times_and_no_other_records(name: str) -> None:
    driver = DRIVERS[0]
    assert driver.make_time_parser is not None
    data = recording("nmea", name)
    only = feed_pieces(driver.make_time_parser(SETTINGS), [data])
    assert canonical(only) == canonical(times(feed_pieces(make(), [data])))


# --- values ---


def test_encoded_sentences_are_read_back() -> None:
    time = 45_296 * S + 250_000_000
    records, parser = parse(
        nmea.encode_gga(time, *POSITION, 412.5, 47.25, quality=4, satellites=17),
        nmea.encode_rmc(time, DAY, *POSITION, 60.0, math.radians(30.0)),
        nmea.encode_gst(time, 0.01, 0.02, 0.03),
        nmea.encode_hdt(math.radians(271.5)),
    )
    (fix,) = fixes(records)
    assert (fix.time.scale, fix.time.time_ns, fix.time.date) == (TimeScale.UTC, time, DAY)
    assert fix.lat_rad == pytest.approx(POSITION[0], abs=1e-14)
    assert fix.lon_rad == pytest.approx(POSITION[1], abs=1e-14)
    assert fix.height_m == pytest.approx(459.75)  # altitude above the geoid plus the geoid's height
    assert fix.velocity_l is not None
    assert fix.velocity_l[0] == pytest.approx(60 * math.cos(math.pi / 6), abs=1e-3)
    assert fix.velocity_l[1] == pytest.approx(30.0, abs=1e-3)
    assert math.isnan(fix.velocity_l[2])
    assert fix.position_cov_l is not None
    assert np.allclose(fix.position_cov_l, np.diag([1e-4, 4e-4, 9e-4]))
    assert (fix.fix_type, fix.satellites, fix.valid) == (FixType.RTK_FIXED, 17, True)
    (heading,) = of_type(records, GnssHeading)
    assert isinstance(heading, GnssHeading)
    assert heading.heading_rad == pytest.approx(math.radians(271.5))
    assert parser.counters.messages == {"GGA": 1, "RMC": 1, "GST": 1, "HDT": 1}


def test_times_name_the_previous_edge_in_utc() -> None:
    time = 12 * 3600 * S
    records, _ = parse(nmea.encode_rmc(time, DAY, *POSITION, 1.0, 0.0), nmea.encode_zda(time, DAY))
    for message, name in zip(times(records), ("RMC", "ZDA"), strict=True):
        assert (message.message, message.names_edge, message.bound, message.valid) == (
            name,
            NamesEdge.PREVIOUS,
            False,
            True,
        )
        assert (message.time.scale, message.time.time_ns, message.time.date) == (TimeScale.UTC, time, DAY)
        assert message.time.leap_seconds is None


def test_second_60_is_read_as_a_leap_second() -> None:
    eve = dt.date(2016, 12, 31)
    records, parser = parse(nmea.encode_zda(86_400 * S, eve), nmea.encode_rmc(86_400 * S, eve, *POSITION, 1.0, 0.0))
    assert [(message.time.time_ns, message.time.date, message.valid) for message in times(records)] == [
        (86_400 * S, eve, True)
    ] * 2
    assert b"235960.00" in nmea.encode_zda(86_400 * S, eve)
    assert parser.counters.bad_messages == 0


@pytest.mark.parametrize(
    "time", ["240000.00", "126000.00", "120060.00", "125960.00", "12000", "1200x0.00", "-10000.00", "120000.0.0"]
)
def test_impossible_times_are_counted_as_bad_messages(time: str) -> None:
    records, parser = parse(nmea.encode_sentence(f"GPZDA,{time},21,11,2026,00,00"))
    assert (records, parser.counters.bad_messages, parser.counters.messages["ZDA"]) == ([], 1, 1)


@pytest.mark.parametrize(
    "body",
    [
        "GPZDA,120000.00,31,02,2026,00,00",
        "GPZDA,120000.00,21,11,999999999999,00,00",
        "GPRMC,120000.00,A,4700.0,N,00830.0,E,1.0,2.0,311302,,,A",
        "GPRMC,120000.00,A,4700.0,X,00830.0,E,1.0,2.0,211126,,,A",
        "GPGGA,120000.00,9100.0,N,00830.0,E,1,08,1.0,400.0,M,47.0,M,,",
        "GPGGA,120000.00,4700.0,N,00830.0,E,1,08,1.0,nan,M,47.0,M,,",
        "GPGGA,120000.00,4760.0,N,00830.0,E,1,08,1.0,400.0,M,47.0,M,,",
        "GPGGA,120000.00,47,N,00830.0,E,1,08,1.0,400.0,M,47.0,M,,",
        "GPGST,120000.00,,,,,1e999,1.0,1.0",
    ],
)
def test_impossible_fields_are_counted_as_bad_messages(body: str) -> None:
    records, parser = parse(nmea.encode_sentence(body))
    assert (of_type(records, GnssFix), parser.counters.bad_messages) == ([], 1)


@pytest.mark.parametrize(
    ("latitude", "longitude", "degrees"),
    [
        ("4730", "00845", (47.5, 8.75)),
        ("4730.", "00845.", (47.5, 8.75)),
        ("4759.9999999", "17959.9999999", (48.0, 180.0)),
        ("9000.0", "18000.0", (90.0, 180.0)),
    ],
)
def test_decimals_may_be_missing(latitude: str, longitude: str, degrees: tuple[float, float]) -> None:
    body = f"GPGGA,120000.00,{latitude},S,{longitude},W,1,08,1.0,500.0,M,48.0,M,,"
    (fix,) = fixes(parse(nmea.encode_sentence(body))[0])
    assert fix.lat_rad is not None
    assert fix.lon_rad is not None
    assert (-np.degrees(fix.lat_rad), -np.degrees(fix.lon_rad)) == pytest.approx(degrees, abs=1e-8)


def test_a_sentence_without_a_fix_is_not_an_error() -> None:
    records, parser = parse(
        b"$GPHDT,,T*1B\r\n$GPGGA,,,,,,0,,,,M,,M,,*66\r\n$GPVTG,,T,,M,,N,,K,N*2C\r\n$GPZDA,,,,,,*48\r\n",
        b"$GPRMC,,V,,,,,,,,,,N*53\r\n",
        nmea.encode_sentence("GPGGA,120000.00,,,,,0,00,99.99,,,,,,"),
    )
    (fix,) = records
    assert isinstance(fix, GnssFix)
    assert (fix.lat_rad, fix.height_m, fix.fix_type, fix.valid) == (None, None, FixType.NONE, False)
    assert (parser.counters.bad_messages, parser.counters.errors) == (0, {})


def test_a_height_without_geoid_separation_is_ignored() -> None:
    records, _ = parse(nmea.encode_sentence("GPGGA,120000.00,4700.0,N,00830.0,E,1,08,1.0,400.0,M,,M,,"))
    (fix,) = fixes(records)
    assert fix.height_m is None
    assert fix.valid


def test_gns_position_matches_gga() -> None:
    """fixtures/nmea/pygpsdata-nmea4.log has this sentence: 56.0 m above a geoid 48.5 m above the ellipsoid."""
    records, parser = parse(b"$GNGNS,103607.00,5327.03942,N,00214.42462,W,AANN,06,5.88,56.0,48.5,,,V*34\r\n")
    (fix,) = fixes(records)
    assert math.degrees(fix.lat_rad or 0.0) == pytest.approx(53.450657, abs=1e-9)
    assert math.degrees(fix.lon_rad or 0.0) == pytest.approx(-2.24041033333, abs=1e-9)
    assert fix.height_m == pytest.approx(104.5)
    assert (fix.fix_type, fix.valid, fix.satellites, fix.message) == (FixType.SINGLE, True, 6, "GNS")
    assert parser.counters.errors == {}


def gns(modes: str) -> bytes:
    """Return a sentence of `POSITION` 400 m above the geoid, which is 47 m above the ellipsoid."""
    return nmea.encode_sentence(f"GNGNS,000001.00,4707.4074,N,00830.0000,W,{modes},12,0.80,400.0,47.0,,,V")


@pytest.mark.parametrize(
    ("modes", "fix_type"),
    [
        ("RRNN", FixType.RTK_FIXED),
        ("FA", FixType.RTK_FLOAT),
        ("DAAN", FixType.DIFFERENTIAL),  # GGA of the same second: quality 2 (mikalhart/TinyGPSPlus #48)
        ("NA", FixType.SINGLE),
        ("EN", FixType.DEAD_RECKONING),
        ("NNNN", FixType.NONE),
    ],
)
def test_fix_type_follows_the_best_mode_of_gns(modes: str, fix_type: FixType) -> None:
    (fix,) = fixes(parse(gns(modes))[0])
    assert fix.fix_type is fix_type


def test_gga_has_precedence_over_gns_and_single_constellation_gns_gives_no_position() -> None:
    satellites_only = nmea.encode_sentence("GLGNS,000001.00,,,,,,7,,,,,")
    gga = nmea.encode_gga(S, *POSITION, 401.0, 47.0, quality=4)
    records, parser = parse(gns("AANN"), satellites_only, gga, nmea.encode_zda(S, DAY))
    (fix,) = fixes(records)
    assert (fix.message, fix.height_m, fix.fix_type) == ("GGA", 448.0, FixType.RTK_FIXED)
    assert [message.valid for message in times(records)] == [True]
    assert parser.counters.errors == {}


def test_zda_is_valid_only_while_the_receiver_has_a_fix() -> None:
    no_fix = nmea.encode_sentence("GPGGA,120000.00,,,,,0,00,99.99,,,,,,")
    records, _ = parse(
        nmea.encode_zda(0, DAY),  # alone so far: believed
        no_fix,
        nmea.encode_zda(S, DAY),
        nmea.encode_gga(2 * S, *POSITION, 1.0, 2.0),
        nmea.encode_zda(2 * S, DAY),
    )
    assert [message.valid for message in times(records)] == [True, False, True]


def test_status_v_makes_the_time_invalid() -> None:
    records, _ = parse(nmea.encode_rmc(S, DAY, *POSITION, 1.0, 0.0, valid=False))
    assert [message.valid for message in times(records)] == [False]
    assert [fix.valid for fix in fixes(records)] == [False]


# --- epochs ---


def epoch(second: int, order: str) -> list[bytes]:
    sentences = {
        "G": nmea.encode_gga(second * S, *POSITION, 400.0 + second, 47.0),
        "R": nmea.encode_rmc(second * S, DAY, *POSITION, 10.0 + second, 0.0),
        "S": nmea.encode_gst(second * S, 1.0 + second, 1.0, 1.0),
        "Z": nmea.encode_zda(second * S, DAY),
        "V": nmea.encode_vtg(10.0 + second, 0.0),
    }
    return [sentences[letter] for letter in order]


@pytest.mark.parametrize("order", ["GRS", "RGS", "SGR", "GSR", "RVGSZ", "GVSZ", "ZGVS"])
def test_each_epoch_gives_one_fix_in_any_sentence_order(order: str) -> None:
    records, parser = parse(*(sentence for second in range(5) for sentence in epoch(second, order)))
    found = fixes(records)
    assert [fix.time.time_ns for fix in found] == [second * S for second in range(5)]
    for second, fix in enumerate(found):
        assert fix.height_m == pytest.approx(447.0 + second)
        assert fix.velocity_l is not None
        assert fix.velocity_l[0] == pytest.approx(10.0 + second, abs=1e-3)
        assert fix.position_cov_l is not None
        assert fix.position_cov_l[0, 0] == pytest.approx((1.0 + second) ** 2)
        assert fix.time.date == DAY
    assert parser.counters.errors == {}


def test_a_fix_is_given_with_the_last_sentence_of_its_epoch_once_the_order_is_known() -> None:
    parser = make()
    when: list[tuple[int, int]] = []
    for second in range(4):
        for sentence in epoch(second, "RGS"):
            when += [(second, fix.time.time_ns // S) for fix in fixes(feed_pieces(parser, [sentence], close=False))]
    assert when == [(1, 0), (1, 1), (2, 2), (3, 3)]


def test_sigmas_sent_every_third_epoch_are_not_lost() -> None:
    """Every third epoch has a GST at its end; the others wait for the next epoch rather than lose it."""
    records, parser = parse(
        *(sentence for second in range(12) for sentence in epoch(second, "GRS" if second % 3 == 0 else "GR"))
    )
    assert [fix.position_cov_l is not None for fix in fixes(records)] == [second % 3 == 0 for second in range(12)]
    assert parser.counters.errors == {}


def test_a_date_of_another_epoch_is_not_taken() -> None:
    records, _ = parse(*epoch(0, "GZ"), nmea.encode_gga(86_399 * S, *POSITION, 1.0, 1.0))
    assert [fix.time.date for fix in fixes(records)] == [DAY, None]


def test_ubx_and_rtcm3_on_the_same_port_are_counted() -> None:
    parser = make()
    feed_pieces(parser, [recording("ubx", "pygpsdata-MIXED-RTCM3.log")])
    assert parser.counters.messages["NAV-PVT"] == 1
    assert sum(count for name, count in parser.counters.messages.items() if name.startswith("RTCM")) == 7
    assert parser.counters.bytes_skipped == 0


# --- settings ---


def test_date_floor_can_be_lowered_by_the_configuration() -> None:
    old = nmea.encode_zda(S, dt.date(2007, 5, 1))
    assert [message.valid for message in times(parse(old)[0])] == [False]
    assert [message.valid for message in times(parse(old, config={"date_floor": "2000-01-01"})[0])] == [True]
    assert [message.valid for message in times(parse(old, config={"date_floor": dt.date(2000, 1, 1)})[0])] == [True]


@pytest.mark.parametrize("value", ["yesterday", 2009])
def test_an_invalid_date_floor_is_refused(value: object) -> None:
    with pytest.raises(DriverSettingsError, match="date_floor"):
        NmeaParser(DeviceSettings("gnss/test", {"date_floor": value}))


def test_host_time_is_that_of_the_read_that_completed_the_sentence() -> None:
    parser = make()
    sentence = nmea.encode_zda(S, DAY)
    assert parser.feed(Chunk("gnss/test", 5, sentence[:20])) == []
    (message,) = parser.feed(Chunk("gnss/test", 9, sentence[20:]))
    assert isinstance(message, TimeMessage)
    assert message.host_time_ns == 9
