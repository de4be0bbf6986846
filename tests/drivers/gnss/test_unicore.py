"""Tests Unicore N4 logs in binary and ASCII: published packets, times, headings, NMEA beside them, set-up."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from swath.drivers.framing.checksums import crc32_novatel
from swath.drivers.gnss import unicore
from swath.drivers.gnss.nmea import sentences as nmea
from swath.drivers.gnss.novatel import ascii as text
from swath.drivers.gnss.novatel import layouts as nov
from swath.drivers.gnss.unicore import BestNavVelocity, UnicoreParser, encode_ascii, encode_log
from swath.drivers.parser import DeviceSettings
from swath.drivers.startup import StartupOptions
from swath.georef.records import Chunk, FixType, GnssFix, GnssHeading, Record, TimeMessage
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
    run_stream,
)
from tests.drivers.recordings import FIXTURES

WEEK, MS = 2379, 369_797_000
S = 1_000_000_000
TIME = nov.Time(0, -4.755795596e-04, 1.302682980e-08, -18.0, 2025, 8, 14, 6, 42, 59_000, 1)
POSITION = nov.BestPos(
    *(0, 50, 47.123456789, -8.5, 507.25, 48.5, 61, 0.011, 0.012, 0.023, b"0\0\0\0", 0.5, 0.0),
    *(50, 28, 28, 0, 1, 0x12, 0x12, 0x41),
)
VELOCITY = BestNavVelocity(0, 8, 0.0, 0.0, 50.0, 330.0, -1.5, 0.04, 0.03)
HEADING = nov.Heading(0, 50, 1.0805, 341.33, -2.11, 0.0, 0.303, 0.6306, b"999\0", 18, 16, 16, 11, 0, 1, 1, 0x43)
LOGS: dict[str, tuple[Any, ...]] = {
    "RECTIME": (TIME,),
    "BESTNAV": (POSITION, VELOCITY),
    "BESTNAVH": (POSITION, VELOCITY),
    "UNIHEADING": (HEADING,),
    "UNIHEADING2": (nov.Heading2(*HEADING[:8], b"ROVR", b"MSTR", *HEADING[9:]),),
}


def make() -> UnicoreParser:
    return UnicoreParser(DeviceSettings("gnss/test"))


def parse(*data: bytes, **config: Any) -> tuple[list[Record], UnicoreParser]:
    parser = UnicoreParser(DeviceSettings("gnss/test", config))
    return feed_pieces(parser, data), parser


def test_a_rectime_has_the_bytes_and_checksum_of_a_published_packet() -> None:
    """A UM980's own packet is in satpulse's tests (uncmsg) in both forms, with checksums b3998b61 and 9f81d9db."""
    frame = encode_log("RECTIME", (TIME,), WEEK, MS)
    by_hand = bytes.fromhex("aa44b5 61 6600 2c00 00 a0 4b09 88a70a16 00000000 00 12 1200 00000000")
    assert frame[: len(by_hand)] == by_hand
    assert frame[len(by_hand) + 16 : len(by_hand) + 24].hex() == "00000000000032c0"
    published = by_hand + bytes.fromhex("b39fb0a7e62a3fbfafeea64e93f94b3e") + frame[len(by_hand) + 16 : -4]
    published += bytes.fromhex("b3998b61")
    (time,) = times(parse(published)[0])
    assert (time.time.week, time.time.time_ns, time.time.leap_seconds) == (WEEK, MS * 1_000_000, 18)
    assert (time.valid, time.quantisation_ns, time.message) == (True, 0.0, "RECTIME")
    line = (
        "RECTIMEA,97,GPS,FINE,2379,369797000,0,0,18,18;VALID,-4.755795596e-04,1.302682980e-08,-18.00000000000,"
        "2025,8,14,6,42,59000,VALID"
    )
    assert text.seal(b"#", line).endswith(b"*9f81d9db\r\n")
    assert times(parse(text.seal(b"#", line))[0]) == [time]


@pytest.mark.parametrize("name", LOGS)
def test_ascii_and_binary_give_the_same_records(name: str) -> None:
    binary, ascii_ = encode_log(name, LOGS[name], WEEK, MS), encode_ascii(name, LOGS[name], WEEK, MS)
    ours, parser = parse(ascii_)
    theirs, other = parse(binary)
    assert canonical(widened(ours)) == canonical(widened(theirs))
    assert ours
    assert parser.counters.messages == other.counters.messages == {name: 1}
    assert (parser.counters.bytes_skipped, other.counters.bad_messages) == (0, 0)


def widened(records: list[Record]) -> list[Record]:
    """Return records without covariances, which have fewer digits in ASCII than in binary."""
    return [
        replace(record, position_cov_l=None, velocity_cov_l=None) if isinstance(record, GnssFix) else record
        for record in records
    ]


def test_bestnav_gives_a_fix_with_velocity_and_sigmas() -> None:
    records, _ = parse(encode_log("BESTNAV", (POSITION, VELOCITY), WEEK, MS))
    (fix,), (time,) = fixes(records), times(records)
    assert (math.degrees(fix.lat_rad or 0), math.degrees(fix.lon_rad or 0)) == pytest.approx((47.123456789, -8.5))
    assert (fix.height_m, fix.undulation_m) == (555.75, 48.5)
    assert fix.velocity_l == pytest.approx((50 * math.cos(math.radians(330)), -25.0, 1.5))
    assert fix.position_cov_l is not None
    assert fix.velocity_cov_l is not None
    assert fix.position_cov_l.diagonal() == pytest.approx([0.011**2, 0.012**2, 0.023**2])
    assert fix.velocity_cov_l.diagonal() == pytest.approx([0.0009, 0.0009, 0.0016])
    assert (fix.fix_type, fix.satellites, fix.antenna, fix.valid) == (FixType.RTK_FIXED, 28, "primary", True)
    assert (time.message, time.valid, time.time.week) == ("BESTNAV", True, WEEK)
    (second,) = fixes(parse(encode_log("BESTNAVH", (POSITION, VELOCITY), WEEK, MS))[0])
    assert second.antenna == "secondary"
    late = VELOCITY._replace(latency_s=0.15)
    one, other = fixes(parse(encode_log("BESTNAV", (POSITION, late), WEEK, MS))[0])
    assert (one.velocity_l, other.lat_rad) == (None, None)
    assert one.time.time_ns - other.time.time_ns == pytest.approx(150_000_000, abs=10)


def test_uniheading_points_from_the_first_antenna_to_the_second() -> None:
    records, _ = parse(encode_log("UNIHEADING", (HEADING,), WEEK, MS))
    (heading,) = of_type(records, GnssHeading)
    found = (heading.heading_rad, heading.pitch_rad or 0, heading.heading_sigma_rad or 0, heading.pitch_sigma_rad or 0)
    assert [math.degrees(angle) for angle in found] == pytest.approx([341.33, -2.11, 0.303, 0.6306])
    assert heading.baseline_m == pytest.approx(1.0805)
    assert heading.valid
    manual = (  # the example of the manual, without satellites; its checksum is ee072604
        "UNIHEADINGA,97,GPS,FINE,2190,365174000,0,0,18,12;INSUFFICIENT_OBS,NONE,0.0000,0.0000,0.0000,0.0000,0.0000,"
        '0.0000,"",0,0,0,0,0,00,0,0'
    )
    frame = text.seal(b"#", manual)
    assert frame.endswith(b"*ee072604\r\n")
    (none,) = of_type(parse(frame)[0], GnssHeading)
    assert (none.valid, none.baseline_m) == (False, None)


def test_times_count_in_fine_gps_time_only() -> None:
    frame = encode_log("RECTIME", (TIME,), WEEK, MS, time_status=20)
    assert [time.valid for time in times(parse(frame)[0])] == [False]
    assert times(parse(encode_log("BESTNAV", (POSITION, VELOCITY), WEEK, MS, time_status=20))[0]) == []
    assert times(parse(encode_log("BESTNAV", (POSITION, VELOCITY), WEEK, MS + 200))[0]) == []
    records, parser = parse(encode_log("BESTNAV", (POSITION, VELOCITY), WEEK - 1356, MS, time_reference=1))
    assert (records, parser.counters.errors) == ([], {"time_reference": 1})
    records, parser = parse(encode_log("BESTNAV", (POSITION, VELOCITY), WEEK - 1024, MS))
    assert ([fix.valid for fix in fixes(records)], parser.counters.errors) == ([False], {"date_before_floor": 1})
    unset = TIME._replace(utc_status=2, clock_status=3)
    (time,) = times(parse(encode_log("RECTIME", (unset,), WEEK, MS))[0])
    assert (time.valid, time.time.leap_seconds) == (False, None)


def test_nmea_gives_the_fixes_where_no_bestnav_comes() -> None:
    gga = [nmea.encode_gga(second * S, 0.8, 0.1, 500.0, 48.0, quality=4) for second in (1, 2)]
    heading = encode_ascii("UNIHEADING", (HEADING,), WEEK, MS)
    records, _ = parse(heading, *gga)
    assert [type(record) for record in records if not isinstance(record, TimeMessage)] == [
        GnssHeading,
        GnssFix,
        GnssFix,
    ]
    both, _ = parse(encode_log("BESTNAV", (POSITION, VELOCITY), WEEK, MS), *gga)
    assert [fix.message for fix in fixes(both)] == ["BESTNAV"]


@pytest.mark.parametrize(
    "frame",
    [
        encode_log("RECTIME", (TIME,), WEEK, 604_800_000),
        encode_ascii("RECTIME", (TIME,), 70_000, MS),
        encode_ascii("BESTNAV", (POSITION, VELOCITY), WEEK, MS, time_reference="GPS,x"),
        text.seal(b"#", "UNIHEADINGA,97,GPS,FINE,2379,369797000,0,0,18,12;SOL_COMPUTED,NONE"),
        text.seal(b"#", "RECTIMEA,97,GPS"),
    ],
)
def test_impossible_content_is_counted(frame: bytes) -> None:
    records, parser = parse(frame)
    assert (records, parser.counters.bad_messages, parser.counters.errors) == ([], 1, {"bad_field": 1})


def test_a_short_log_is_counted() -> None:
    frame = encode_log("RECTIME", (TIME,), WEEK, MS)
    short = bytearray(frame[:-8])
    short[6] -= 4
    sealed = bytes(short) + crc32_novatel(bytes(short)).to_bytes(4, "little")
    assert parse(sealed)[1].counters.errors == {"bad_length": 1}


def stream() -> bytes:
    return (FIXTURES / "unicore/um982_n4.bin").read_bytes()


def test_the_fixture_is_what_the_encoder_writes() -> None:
    """The fixture holds ten seconds of a UM982 in both forms with NMEA and RTCM; no recording was available."""
    made = b""
    for second in range(10):
        at = MS + 1000 * second
        made += encode_log("RECTIME", (TIME._replace(utc_ms=(59_000 + 1000 * second) % 60_000),), WEEK, at)
        made += encode_log("BESTNAV", (POSITION, VELOCITY), WEEK, at)
        made += encode_ascii("UNIHEADING", (HEADING,), WEEK, at)
        made += encode_ascii("BESTNAVH", (POSITION, VELOCITY), WEEK, at)
        made += nmea.encode_gga((24_179 + second) * S, 0.8, 0.1, 500.0, 48.0) + b"\xd3\x00\x00\x47\xea\x4b"
    assert stream() == made
    check_random_reads(make, made)
    check_bytewise(make, made)
    assert run_stream(make, [made]).counters["messages"] == {
        **{"RECTIME": 10, "BESTNAV": 10, "UNIHEADING": 10, "BESTNAVH": 10, "GGA": 10, "RTCM-empty": 10}
    }
    driver = unicore.DRIVERS[0]
    assert driver.make_time_parser is not None
    only = feed_pieces(driver.make_time_parser(DeviceSettings("gnss/test")), [made])
    assert canonical(only) == canonical(times(parse(made)[0]))


@pytest.mark.slow
def test_every_cut_gives_the_same_and_damage_never_raises() -> None:
    check_stream(make, stream())
    check_damage(make, stream())
    check_garbage(make)


def test_setup_asks_for_time_position_heading_and_raw_data() -> None:
    settings = DeviceSettings("gnss/rover", {"secondary_lever_arm_m": [0, 1, 0], "setup": {"rate_hz": 10}})
    messages = unicore.startup_messages(settings, StartupOptions(save=True, baud=460800))
    lines = [message.lines[0] for message in messages]
    assert lines[:5] == ["CONFIG COM1 460800", unicore.PULSE, "RECTIMEB 1", "BESTNAVB 0.1", "UNIHEADINGB 0.1"]
    assert (lines[-1], messages[-1].last, messages[0].baud) == ("SAVECONFIG", True, 460800)
    answer = messages[1].listen().hear(b"noise$command,CONFIG PPS ENABLE,response: OK*5C\r\n")
    assert answer is not None
    assert answer.accepted
    refused = messages[1].listen().hear(b"$command,BESTNAVX,response: PARSING FAILED NO MATCHING FUNC BESTNAVX*1B\r\n")
    assert refused is not None
    assert (refused.accepted, refused.text) == (False, "PARSING FAILED NO MATCHING FUNC BESTNAVX")


def test_a_week_one_rollover_behind_is_corrected_by_the_host_date() -> None:
    host_ns = (315_964_800 + WEEK * 604_800 + 369_797) * S
    parser = make()
    frame = encode_log("BESTNAV", (POSITION, VELOCITY), WEEK - 1024, MS)
    (fix,) = fixes(parser.feed(Chunk("gnss/test", host_ns, frame)))
    assert (fix.time.week, fix.valid) == (WEEK, True)
    assert "1 roll-over of 1024 weeks behind" in parser.remarks()[0]
