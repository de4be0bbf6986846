"""Tests headings in NMEA: THS, HPR, PASHR and PTNL,AVR, their quality, and which of them counts."""

from __future__ import annotations

import io
import math

import pynmea2
import pytest
from pyubx2 import NMEA_PROTOCOL, UBXReader

from swath.drivers.gnss.nmea import sentences as nmea
from swath.drivers.gnss.nmea.parser import BETTER_HEADING_LASTS, NmeaParser
from swath.drivers.parser import DeviceSettings
from swath.georef.records import GnssHeading, Record, TimeScale
from tests.drivers.builders import of_type
from tests.drivers.harness import check_bytewise, check_random_reads, feed_pieces
from tests.drivers.recordings import FIXTURES

S = 1_000_000_000
RAD = math.radians


def parse(*sentences: bytes) -> tuple[list[GnssHeading], NmeaParser]:
    parser = NmeaParser(DeviceSettings("gnss/test"))
    records: list[Record] = feed_pieces(parser, sentences)
    return of_type(records, GnssHeading), parser


def test_a_um982_with_ths_and_hpr_gives_a_heading_each_second() -> None:
    """At 1 Hz come GGA, RMC, THS and HPR; HPR counts, because it has time and quality, but the first THS is earlier."""
    stream = (FIXTURES / "nmea/um982_heading.nmea").read_bytes()
    headings, parser = parse(stream)
    counts = parser.counters.messages
    assert counts["THS"] == counts["HPR"] == 30
    assert [heading.message for heading in headings] == ["THS", *["HPR"] * 30]
    assert all(heading.valid for heading in headings)
    assert [math.degrees(heading.heading_rad) for heading in headings[1:]] == pytest.approx([341.33] * 30)
    assert math.degrees(headings[1].pitch_rad or 0.0) == pytest.approx(-2.11)
    assert headings[1].time is not None
    assert headings[1].time.time_ns == (9 * 3600 + 15 * 60 + 10) * S
    assert (parser.counters.bad_messages, parser.counters.errors) == (0, {})
    ths_only = b"".join(line for line in stream.splitlines(keepends=True) if b"HPR" not in line)
    assert [heading.message for heading in parse(ths_only)[0]] == ["THS"] * 30
    for check in (check_random_reads, check_bytewise):
        check(lambda: NmeaParser(DeviceSettings("gnss/test")), stream[:2000])


@pytest.mark.parametrize(
    ("mode", "error"),
    [("A", {}), ("E", {"heading_estimated": 1}), ("S", {"heading_estimated": 1}), ("V", {"heading_not_valid": 1})],
)
def test_ths_counts_in_mode_a_only(mode: str, error: dict[str, int]) -> None:
    (heading,), parser = parse(nmea.encode_ths(RAD(271.5), mode=mode))
    assert math.degrees(heading.heading_rad) == pytest.approx(271.5)
    assert (heading.valid, heading.time, heading.heading_sigma_rad) == (mode == "A", None, None)
    assert parser.counters.errors == error
    assert parse(nmea.encode_ths(None, mode="V"))[0] == []


def test_hpr_matches_pynmeagps_and_needs_fixed_ambiguities() -> None:
    sentence = nmea.encode_hpr(45_296 * S, RAD(341.33), RAD(-2.11))
    _, theirs = UBXReader(io.BytesIO(sentence), protfilter=NMEA_PROTOCOL).read()
    assert (theirs.heading, theirs.pitch, theirs.quality) == (341.33, -2.11, 4)
    (heading,), _ = parse(sentence)
    assert (heading.time and heading.time.time_ns, heading.time and heading.time.scale) == (45_296 * S, TimeScale.UTC)
    for quality, error in ((5, "heading_not_fixed"), (1, "heading_not_fixed"), (0, "heading_not_valid")):
        (heading,), parser = parse(nmea.encode_hpr(0, 1.0, 0.0, quality=quality))
        assert (heading.valid, parser.counters.errors) == (False, {error: 1})


def test_pashr_gives_the_vehicles_heading_with_its_sigma_and_no_pitch() -> None:
    sigmas = (RAD(0.02), RAD(0.03), RAD(0.051))
    sentence = nmea.encode_pashr(45_296 * S, RAD(-1.25), RAD(2.5), RAD(271.5), sigmas)
    theirs = pynmea2.parse(sentence.decode())
    assert (theirs.true_heading, theirs.roll, theirs.pitch, theirs.heading_accuracy) == (271.5, -1.25, 2.5, 0.051)
    (heading,), _ = parse(sentence)
    assert math.degrees(heading.heading_rad) == pytest.approx(271.5)
    assert math.degrees(heading.heading_sigma_rad or 0.0) == pytest.approx(0.051)
    assert (heading.pitch_rad, heading.valid, heading.message) == (None, True, "PASHR")
    (unknown,), _ = parse(nmea.encode_pashr(0, 0.0, 0.0, 1.0, (0.0, 0.0, 0.0)))
    assert unknown.heading_sigma_rad is None
    (refused,), parser = parse(nmea.encode_pashr(0, 0.0, 0.0, 1.0, sigmas, gps_quality=0))
    assert (refused.valid, parser.counters.errors) == (False, {"heading_not_valid": 1})
    ashtech = nmea.encode_sentence("PASHR,ATT,130018.0,085.69,+00.91,-00.05,0.0015,0.0068,0")
    headings, parser = parse(ashtech)
    assert (headings, parser.counters.bad_messages) == ([], 0)


def test_avr_matches_pynmea2() -> None:
    """The first sentence is the example in Trimble's OEM receiver help."""
    example = nmea.encode_sentence("PTNL,AVR,181059.6,+149.4688,Yaw,+0.0134,Tilt,,,60.191,3,2.5,6")
    for sentence, yaw, tilt, length in (
        (example, 149.4688, 0.0134, 60.191),
        (nmea.encode_avr(45_296 * S, RAD(149.4688), RAD(0.0134), 1.8), 149.4688, 0.0134, 1.8),
    ):
        theirs = pynmea2.parse(sentence.decode())
        assert (float(theirs.yaw_angle), float(theirs.tilt_angle), theirs.gps_quality) == (yaw, tilt, "3")
        (heading,), _ = parse(sentence)
        found = math.degrees(heading.heading_rad), math.degrees(heading.pitch_rad or 0.0), heading.baseline_m
        assert found == pytest.approx((yaw, tilt, length))
        assert (heading.valid, heading.message) == (True, "PTNL,AVR")
    (refused,), parser = parse(nmea.encode_avr(0, 1.0, 0.0, 1.8, quality=2))
    assert (refused.valid, parser.counters.errors) == (False, {"heading_not_fixed": 1})
    other = nmea.encode_sentence("PTNL,VHD,030556.00,300998,187.718,-22.138,-76.929,-5.015,0.033,0.006,3,07,2.4,M")
    assert parse(other)[0] == []


def test_sentences_without_quality_count_again_when_the_others_stop() -> None:
    silent = [nmea.encode_hdt(1.0)] * BETTER_HEADING_LASTS
    assert [heading.message for heading in parse(nmea.encode_hpr(0, 1.0, 0.0), *silent)[0]] == ["HPR", "HDT"]


def test_a_broken_heading_is_a_bad_message() -> None:
    for body in ("GNTHS,34x,A", "GNHPR,250000.00,1.0,0.0,0.0,4,9,0.0,0", "PASHR,120000.00,nan,T,,,,,,,1,1"):
        headings, parser = parse(nmea.encode_sentence(body))
        assert (headings, parser.counters.bad_messages) == ([], 1)


def test_the_encoded_fixture_is_what_the_encoders_write() -> None:
    made = b""
    for second in range(4):
        at = second * S
        made += nmea.encode_pashr(at, RAD(-1.25), RAD(2.5), RAD(271.5), (RAD(0.02), RAD(0.03), RAD(0.051)))
        made += nmea.encode_avr(at, RAD(149.4688), RAD(0.0134), 1.8) + nmea.encode_ths(1.0, mode="AEV"[second % 3])
    assert (FIXTURES / "nmea/encoded_headings.nmea").read_bytes() == made
    assert len(parse(made)[0]) == 8
