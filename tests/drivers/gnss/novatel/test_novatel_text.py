"""Tests NovAtel's ASCII logs: the records of the binary logs that novatel-edie converted, framing, bad fields."""

from __future__ import annotations

import gzip
from typing import Any

import numpy as np
import pytest

from swath.drivers.gnss.novatel import ascii as text
from swath.drivers.gnss.novatel import layouts as nov
from swath.drivers.gnss.novatel.encoder import encode_log
from swath.drivers.gnss.novatel.parser import NovatelParser
from swath.drivers.parser import DeviceSettings
from swath.georef.records import DeviceStatus, GnssFix, GnssHeading, ImuSamples, InsSolution, Record, TimeMessage
from tests.drivers.builders import of_type, rows_of, times
from tests.drivers.harness import check_bytewise, check_random_reads, feed_pieces, outcome
from tests.drivers.novatel_ascii import FIXTURES, recording

WEEK, MS = 2300, 302_400_000


DIGITS = {  # half of the last digit that novatel-edie writes: m and m/s 1e-4, latitude 1e-11 deg, attitude 1e-9 deg
    **{"lat_rad": 1e-13, "lon_rad": 1e-13, "height_m": 1.1e-4, "velocity_l": 5.1e-5, "roll_rad": 1e-11},
    **{"pitch_rad": 1e-11, "heading_rad": 1e-11, "position_sigma_l": 5.1e-5, "velocity_sigma_l": 5.1e-5},
    **{"attitude_sigma_rad": 1e-6, "specific_force_b": 1e-9, "angular_rate_b": 1e-9},
}


def make() -> NovatelParser:
    return NovatelParser(DeviceSettings("gnss/rover"))


def parse(data: bytes) -> tuple[list[Record], NovatelParser]:
    parser = make()
    return feed_pieces(parser, [data]), parser


def edie(name: str) -> bytes:
    """Return the ASCII logs that NovAtel's own decoder wrote from a binary recording.

    The decoder marks secondary antennas by _2.
    """
    return gzip.decompress((FIXTURES / f"{name}.edie.ascii.gz").read_bytes())


def assert_same(ours: Record, theirs: Record) -> None:
    """Compare fields; ASCII logs are rounded to their digits."""
    assert type(ours) is type(theirs)
    for name in type(ours).__dataclass_fields__:
        one, other = getattr(ours, name), getattr(theirs, name)
        if isinstance(one, float):
            assert one == pytest.approx(other, rel=1e-6, abs=1.1e-4 if name.endswith("_m") else 2e-9), name
        elif isinstance(one, np.ndarray):
            np.testing.assert_allclose(one, other, rtol=2e-3, atol=1e-7, err_msg=name)
        elif isinstance(one, dict):
            assert one == pytest.approx(other, rel=1e-3, abs=1e-9), name
        elif isinstance(one, tuple) and isinstance(one[0], float):
            assert one == pytest.approx(other, abs=1e-4), name
        else:
            assert one == other, name


@pytest.mark.parametrize(
    ("name", "kinds"),
    [
        ("align.gps", {GnssHeading}),
        ("bestpos.gps", {GnssFix, InsSolution, TimeMessage}),
        ("time.gps", {TimeMessage}),
        ("ins1.gps", {InsSolution, DeviceStatus}),
        ("unit_test_vectors.bin", {GnssFix, InsSolution, ImuSamples}),
        ("oemv_200911218.gps", {GnssFix, TimeMessage}),
    ],
)
def test_ascii_logs_give_the_records_of_the_binary_ones(name: str, kinds: set[type]) -> None:
    ours, parser = parse(edie(name))
    theirs, _ = parse(recording(name))
    assert parser.counters.errors.keys() <= {"imu_scale_unknown", "time_unknown", "date_before_floor"}
    for kind in (TimeMessage, GnssFix, GnssHeading, DeviceStatus):
        found: list[Any] = of_type(ours, kind)
        wanted: list[Any] = of_type(theirs, kind)
        for one, other in zip(found, wanted, strict=True):
            assert_same(one, other)
    for array in (InsSolution, ImuSamples):
        if any(isinstance(record, array) for record in theirs):
            found_rows, wanted_rows = rows_of(ours, array), rows_of(theirs, array)
            assert found_rows.shape == wanted_rows.shape
            for field in wanted_rows.dtype.names or ():
                if field != "host_time_ns":
                    size = DIGITS.get(field, 0.0)
                    np.testing.assert_allclose(found_rows[field], wanted_rows[field], rtol=1e-12, atol=size)
    assert kinds <= {type(record) for record in ours}


def test_a_recording_in_ascii_gives_its_thousand_positions() -> None:
    """BESTPOS.GPS was recorded in ASCII: a thousand times one epoch, half a second off a whole one."""
    records, parser = parse(recording("BESTPOS.GPS"))
    assert parser.counters.messages == {"BESTPOS": 1000}
    assert len(of_type(records, GnssFix)) == 1000
    assert {fix.time.time_ns for fix in of_type(records, GnssFix)} == {450_849_500_000_000}
    assert times(records) == []
    assert parser.counters.bytes_skipped == 2  # an empty line at the end


def sample(layout: nov.Layout) -> nov.Body:
    """Return a body of plausible numbers: the week where it has one, known enumerations, 1.5, b"AAAA"."""
    values: list[float | bytes] = []
    for name, code in zip(layout.body._fields, text.wire_codes(layout.wire), strict=True):
        known = {"week": WEEK, "ins_status": 3, "datum": 61, "imu_type": 58, "position_type": 50, "velocity_type": 8}
        value = b"AAAA" if code == "4s" else 1.5 if code in "df" else known.get(name, 0)
        values.append(value)
    return layout.body._make(values)


BODIES = {layout.name: sample(layout) for layout in nov.LAYOUTS.values()}


def test_every_log_is_encoded_and_read_back_as_in_binary() -> None:
    stream = b""
    imu = nov.InsConfig(58)
    for name, body in BODIES.items():
        frame = text.encode_ascii(name, body, WEEK, MS)
        stream += frame + encode_log(name, body, WEEK, MS)
        one, other = make(), make()
        ours = outcome(feed_pieces(one, [text.encode_ascii("INSCONFIG", imu, WEEK, MS), frame]), one)
        theirs = [encode_log("INSCONFIG", imu, WEEK, MS), encode_log(name, body, WEEK, MS)]
        wanted = outcome(feed_pieces(other, theirs), other)
        assert (ours.events, ours.rows) == (wanted.events, wanted.rows), name
        assert ours.events or ours.rows or name == "INSCONFIG"
        assert (one.counters.messages, one.counters.bad_messages) == (other.counters.messages, 0)
        assert one.counters.bytes_skipped == 0
    assert (FIXTURES / "encoded_both_forms.asc").read_bytes() == stream
    check_random_reads(make, stream)
    check_bytewise(make, stream)


def test_the_secondary_antenna_is_marked_in_the_name() -> None:
    frame = text.encode_ascii("BESTPOS", BODIES["BESTPOS"], WEEK, MS)
    secondary = text.seal(b"#", frame[1 : frame.rindex(b"*")].decode().replace("BESTPOSA", "BESTPOSA_1"))
    (fix,) = of_type(parse(secondary)[0], GnssFix)
    assert fix.antenna == "secondary"


@pytest.mark.parametrize(
    "change",
    [
        ("SOL_COMPUTED", "9999999999999"),
        ("FINESTEERING,2300", "FINESTEERING,x"),
        ("FINESTEERING,2300", "FINESTEERING,70000"),
        ("302400.000", "604800.000"),
        (";", ","),
        ("47.0", "forty"),
        ('"AAAA",', ""),
    ],
)
def test_impossible_fields_are_counted(change: tuple[str, str]) -> None:
    position = BODIES["BESTPOS"]
    assert isinstance(position, nov.BestPos)
    frame = text.encode_ascii("BESTPOS", position._replace(lat_deg=47.0), WEEK, MS)
    content = frame[1 : frame.rindex(b"*")].decode()
    assert content.replace(*change) != content
    records, parser = parse(text.seal(b"#", content.replace(*change, 1)))
    assert (of_type(records, GnssFix), parser.counters.bad_messages, parser.counters.errors["bad_field"]) == ([], 1, 1)


def test_unknown_names_are_no_solution_and_a_wrong_checksum_is_skipped() -> None:
    frame = text.encode_ascii("BESTPOS", BODIES["BESTPOS"], WEEK, MS)
    content = frame[1 : frame.rindex(b"*")].decode()
    (fix,) = of_type(parse(text.seal(b"#", content.replace("SOL_COMPUTED", "SOL_NEW")))[0], GnssFix)
    assert not fix.valid
    records, parser = parse(frame.replace(b"1.5", b"1.4"))
    assert (records, parser.counters.bad_checksums, parser.counters.bytes_framed) == ([], 1, 0)
    long = b"#RANGEA," + b"1" * 20_000
    assert parse(long)[1].counters.errors == {"novatel-ascii_length_over_bound": 1}
