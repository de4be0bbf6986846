"""Tests checksums against other implementations, and the framer on every recording, false syncs, cuts, limits."""

from __future__ import annotations

import functools
import operator
import random
import zlib
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyrtcm import calc_crc24q as crc24q_reference  # type: ignore[import-untyped]
from pysbf2 import calc_crc as crc16_reference
from pyubx2 import calc_checksum as fletcher_reference

from swath.drivers.framing.checksums import (
    CRC24Q_MARKED_BYTES,
    CRC24Q_STEP_BYTES,
    FLETCHER_STEP_BYTES,
    crc16_ccitt,
    crc24q,
    crc24q_marks,
    crc32_novatel,
    nmea_xor,
    ubx_fletcher,
)
from swath.drivers.framing.framer import Frame, FrameKind, Framer
from swath.drivers.framing.kinds import (
    GNSS_KINDS,
    NMEA_MAX_BYTES,
    NOVATEL,
    NOVATEL_SHORT,
    SBF,
    SBF_MAX_BYTES,
    UBX_MAX_PAYLOAD_BYTES,
)
from swath.drivers.gnss.nmea.sentences import encode_sentence
from swath.drivers.gnss.ubx.messages import encode_frame
from swath.drivers.parser import StreamParser
from swath.georef.records import Chunk, Record
from tests.drivers.builders import comparable, others_messages
from tests.drivers.harness import check_damage, check_garbage, check_stream
from tests.drivers.recordings import every_recording, expected, gpsd_lines, gpsd_output, recording

ALL_KINDS = (*GNSS_KINDS, NOVATEL, NOVATEL_SHORT, SBF)


class FramingParser(StreamParser):
    """The framer alone, as a parser; keeps the frames unless told not to."""

    def __init__(self, keep: bool = True) -> None:
        super().__init__()
        self.framer = Framer(ALL_KINDS, self.counters)
        self.frames: list[Frame] = []
        self.keep = keep

    def feed(self, chunk: Chunk) -> list[Record]:
        self._take(self.framer.feed(chunk.data, chunk.host_time_ns))
        return []

    def close(self) -> list[Record]:
        self._take(self.framer.close())
        return []

    def _take(self, frames: list[Frame]) -> None:
        if self.keep:
            self.frames += frames


def count_frames() -> FramingParser:
    """Return a parser for long runs, which copy it."""
    return FramingParser(keep=False)


def frames_of(*pieces: bytes) -> FramingParser:
    """Return a parser that was given the pieces, piece i at host time i, and closed."""
    parser = FramingParser()
    for index, piece in enumerate(pieces):
        parser.feed(Chunk("gnss/test", index, piece))
    parser.close()
    return parser


# --- checksums ---


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.binary(max_size=300))
def test_checksums_equal_other_implementations(data: bytes) -> None:
    assert nmea_xor(data) == functools.reduce(operator.xor, data, 0)
    assert bytes(ubx_fletcher(data)) == fletcher_reference(data)
    assert crc24q(data) == crc24q_reference(data)
    assert crc16_ccitt(data) == crc16_reference(data)


@pytest.mark.parametrize("length", [CRC24Q_STEP_BYTES - 1, CRC24Q_STEP_BYTES, CRC24Q_STEP_BYTES + 1, 1030, 1031, 5000])
def test_crc24q_of_long_data_equals_the_crc_of_its_joined_parts(length: int) -> None:
    data = random.Random(length).randbytes(length)
    assert crc24q(data) == crc24q_reference(data)


@pytest.mark.parametrize("begin", [0, 1, 700, CRC24Q_MARKED_BYTES - 150])
def test_crc24q_marks_are_equal_only_at_the_ends_of_a_valid_frame(begin: int) -> None:
    content = b"\xd3\x00\x04abcd"
    frame = content + crc24q_reference(content).to_bytes(3, "big")
    noise = random.Random(begin)
    data = noise.randbytes(begin) + frame + noise.randbytes(30) + frame + frame + noise.randbytes(90)
    data = data[:CRC24Q_MARKED_BYTES]
    marks = crc24q_marks(data).tolist()
    assert len(marks) == len(data) + 1
    for start in range(max(0, begin - 20), len(data)):
        for end in range(start + 3, min(len(data), start + 60)):
            assert (marks[start] == marks[end]) == (crc24q_reference(data[start:end]) == 0)


@pytest.mark.parametrize("length", [FLETCHER_STEP_BYTES - 1, FLETCHER_STEP_BYTES, FLETCHER_STEP_BYTES + 1, 30_000])
def test_fletcher_of_long_data_equals_the_checksum_of_its_joined_parts(length: int) -> None:
    data = random.Random(length).randbytes(length)
    assert bytes(ubx_fletcher(data)) == fletcher_reference(data)


def test_crc32_novatel_follows_the_bitwise_rule_of_the_manual() -> None:
    """The OEM7 manual, "32-bit CRC", has register 0, polynomial 0xEDB88320, low bit first, no inversion."""
    data = random.Random(3).randbytes(500)
    register = 0
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (0xEDB88320 if register & 1 else 0)
    assert crc32_novatel(data) == register != zlib.crc32(data)
    assert crc32_novatel(data + register.to_bytes(4, "little")) == 0


# --- every recording ---


@pytest.mark.parametrize(("family", "name"), every_recording())
def test_frame_counts_of_every_recording_match_other_decoders(family: str, name: str) -> None:
    data, entry = recording(family, name), expected(family)[name]
    parser = frames_of(data)
    counters, scan = parser.counters, entry["frame_scan_own"]
    kinds = Counter(frame.kind for frame in parser.frames)
    assert (kinds["ubx"], kinds["rtcm3"], kinds["nmea"]) == (scan["ubx_ok"], scan["rtcm3_crc_ok"], scan["nmea_ok"])
    assert kinds["novatel"] == kinds["novatel-short"] == kinds["sbf"] == 0
    assert counters.bytes_framed == sum(len(frame.data) for frame in parser.frames)
    assert counters.bytes == counters.bytes_framed + counters.bytes_skipped == len(data)
    assert comparable(counters.messages) == others_messages(name, entry)


@pytest.mark.parametrize("name", sorted(expected("sbf")))
def test_frame_counts_of_every_sbf_recording_match_other_decoders(name: str) -> None:
    data, entry = recording("sbf", name), expected("sbf")[name]
    parser = frames_of(data)
    numbers = Counter(frame.data[4] | (frame.data[5] & 0x1F) << 8 for frame in parser.frames if frame.kind == "sbf")
    assert numbers == {int(number): count for number, count in entry["frame_scan_own"]["by_id"].items()}
    others = sum(count for message, count in entry["messages"].items() if not message.startswith("SBF:"))
    if name != "pygpsdata_ubx.log":
        assert len(parser.frames) == numbers.total() + others
    assert parser.counters.bytes == parser.counters.bytes_framed + parser.counters.bytes_skipped == len(data)


# Sentences that only gpsd prints: it joins one that another interrupted, prints one that the file's end cut, and omits
# the bars with which tcp-torture marks its reads.
GPSD_ALONE = {
    "isync.log": [b"$GPGSV,4,1,15,02,11,115,36,05,34,060,48,07,00,023,,13,56,090,49*71"],
    "ublox-8.log": [b"$GNRMC,001053.00,A,4404.14083,N,12118.85886,W,0."],
}
WITH_SENTENCES = sorted(name for name, entry in expected("nmea").items() if entry.get("origin") == "gpsd")


@pytest.mark.parametrize("name", WITH_SENTENCES)
def test_nmea_sentences_match_gpsd(name: str) -> None:
    """gpsd repeats each sentence that it framed, so its output lists them."""
    ours = [frame.data.strip().replace(b"|", b"") for frame in frames_of(recording("nmea", name)).frames]
    theirs = [line.strip() for line in gpsd_lines("nmea", name) if line[:1] in (b"$", b"!")]
    if name not in GPSD_ALONE:
        assert ours == theirs
    assert Counter(theirs) - Counter(ours) == Counter(GPSD_ALONE.get(name, []))
    assert not Counter(ours) - Counter(theirs)


@pytest.mark.parametrize(
    ("family", "name", "count"),
    [
        ("rtcm3", "rtcm3.log", 2),
        ("rtcm3", "rtcm3.2.log", 192),
        ("rtcm3", "rtcm3.bndm.log", 100),
        ("ubx", "ublox-zed-f9t-rtcm3.log", 182),
    ],
)
def test_types_and_lengths_of_rtcm3_messages_match_gpsd(family: str, name: str, count: int) -> None:
    frames = [frame.data for frame in frames_of(recording(family, name)).frames if frame.kind == "rtcm3"]
    ours = [(int.from_bytes(data[3:5], "big") >> 4, len(data) - 6) for data in frames]
    assert ours == [(report["type"], report["length"]) for report in gpsd_output(family, name, "RTCM3")]
    assert len(ours) == count


# For every file that is broken by its name or by pyubx2: bytes outside frames, and frames with a wrong checksum. If the
# file's end is cut, the bytes are those that its message counts as returned and the part of the frame before them.
BROKEN = {
    "nmea": {
        "isync.log": (123, 0),  # a comment, and a sentence that another one interrupts
        "pygpsdata-BADHDR.log": (69, 0),
        "pygpsdata-badeof.log": (1, 0),
        "pygpsdata-nmeabadck.log": (138, 2),
        "pygpsdata-nmeafoo1.log": (0, 0),  # unknown, with a good checksum
        "pygpsdata-nmeafoo2.log": (0, 0),
        "quectel_nmea_poll.log": (0, 0),
    },
    "ubx": {
        "pygpsdata-BADEOF1.log": (5, 0),
        "pygpsdata-BADEOF2.log": (6 + 3, 0),
        "pygpsdata-BADEOF3.log": (1, 0),
        "pygpsdata-BADHDR.log": (100, 0),  # its B5 77
        "pygpsdata-BADNMEAEOF.log": (2 + 50, 0),
        "pygpsdata-MGASF.log": (0, 0),
        "pygpsdata-MIXED3BADCK.log": (110, 1),
        "pygpsdata-NMEABADEND.log": (2 + 30, 0),
        "ublox-8-time.log": (1 + 6 + 13, 0),
        "ublox-neo-m8t.log": (6 + 308, 0),
        "ublox-zed-f9p-sfrbx.log": (6 + 5, 0),
        "ublox-zed-f9t-rtcm3.log": (3 + 86, 0),
        "ublox-zoe-m8b-logbatch.log": (6 + 43, 0),
    },
    "rtcm3": {
        "GMSD7_20121014.rtcm3": (3 + 299, 0),
        "pygpsdata-BADHDR.log": (100, 0),
        "rtcm3.2.log": (344, 0),  # it begins within a message
    },
    "sbf": {"pygpsdata_ubx.log": (0, 0), "pygpsdata_x5_pvttruncated.log": (8 + 6, 0)},
}


def test_every_broken_recording_is_listed_in_the_table() -> None:
    for family, files in BROKEN.items():
        names = {name for name, entry in expected(family).items() if entry["errors"] or "bad" in name.lower()}
        assert names == set(files), family


@pytest.mark.parametrize(("family", "name"), [(family, name) for family in BROKEN for name in BROKEN[family]])
def test_skipped_bytes_of_broken_files_belong_to_no_frame(family: str, name: str) -> None:
    counters = frames_of(recording(family, name)).counters
    assert (counters.bytes_skipped, counters.bad_checksums) == BROKEN[family][name]


# --- false syncs, bounds, arrival ---

GOOD = encode_sentence("GPZDA,120000.00,21,11,2026,00,00")
FRAME = encode_frame(b"\x01\x22", bytes(20))


@pytest.mark.parametrize(
    "false_start",
    [
        b"\xb5b\x01\x07\xff\x1f",  # a length within the bound, so it is waited for
        b"\xb5b\x01\x07\xff\xff",
        b"\xd3\x03\xff",
        b"\xd3",
        b"\xaaD\x12\x1c\x2a\x00\x02\x20\x00\x50",
        b"\xaaD\x13\xff",
        b"$@",
        b"$@\x00\x00\xa7\x0f\x60\x00",
        b"$@\x00\x00\xa7\x0f\x00\x40",
        b"$@\x00\x00\xa7\x0f\x61\x00",  # no multiple of 4
        b"$@\x00\x00\xa7\x0f\x04\x00",
        b"$@$@$@$@$@$@$@$@",
        b"$R: setSBFOutput, Stream1, COM1\r\n",
        b"\r\nCOM1>",
        b"$GPGGA,12",
        b"$",
        b"$$$$!A!",
        b"[COM1]<OK\r\n",
        b"\xb5",
        b"*00\r\n",
    ],
)
def test_valid_frames_inside_a_false_frame_are_found(false_start: bytes) -> None:
    parser = frames_of(false_start + FRAME + GOOD + FRAME)
    assert [frame.data for frame in parser.frames] == [FRAME, GOOD, FRAME]
    assert parser.counters.bytes_skipped == len(false_start)


@pytest.mark.parametrize("read_bytes", [1, 64, 750, 100_000])
@pytest.mark.parametrize("false", [b"\xd3\x03\xff", b"\xd3\x00", b"\xd3\x01\x50\x00"])
def test_valid_frames_among_overlapping_false_frames_are_found(false: bytes, read_bytes: int) -> None:
    """Every false start is decided by a checksum of its own bytes, and each is counted."""
    [rtcm3] = frames_of(recording("rtcm3", "rtcm3.2.log")).frames[:1]
    one = false * 700 + rtcm3.data + false * 3 + rtcm3.data * 2 + GOOD + false
    stream = one * 3 + bytes(1029)
    parser = frames_of(*(stream[at : at + read_bytes] for at in range(0, len(stream), read_bytes)))
    assert [frame.data for frame in parser.frames] == [rtcm3.data, rtcm3.data, rtcm3.data, GOOD] * 3
    assert parser.counters.bad_checksums == 3 * 704
    assert parser.counters.bytes_skipped == 3 * 704 * len(false) + 1029


@pytest.mark.parametrize("kind", ALL_KINDS, ids=lambda kind: kind.name)
def test_a_false_sync_delays_at_most_its_bound(kind: FrameKind) -> None:
    starts = {
        "nmea": b"$GPTXT,",
        "ubx": b"\xb5b\x01\x07" + UBX_MAX_PAYLOAD_BYTES.to_bytes(2, "little"),
        "rtcm3": b"\xd3\x03\xff",
        "novatel": b"\xaaD\x12\x40" + bytes(4) + (24 * 1024).to_bytes(2, "little"),
        "novatel-short": b"\xaaD\x13\xff",
        "sbf": b"$@\x00\x00\xa7\x0f" + SBF_MAX_BYTES.to_bytes(2, "little"),
    }
    parser = FramingParser()
    parser.feed(Chunk("gnss/test", 0, starts[kind.name]))
    filler = b"x" * 64
    fed = len(starts[kind.name])
    while parser.counters.bytes_skipped == 0:
        assert fed <= kind.max_bytes + len(filler)
        parser.feed(Chunk("gnss/test", 0, filler))
        fed += len(filler)
    assert fed >= kind.max_bytes - 64


def test_frames_longer_than_the_bound_are_counted_and_not_waited_for() -> None:
    parser = FramingParser()
    parser.feed(Chunk("gnss/test", 0, b"\xb5b\x01\x07\x01\x20" + FRAME))
    assert [frame.data for frame in parser.frames] == [FRAME]
    assert parser.counters.errors == {"ubx_length_over_bound": 1}
    parser = FramingParser()
    parser.feed(Chunk("gnss/test", 0, b"$@\x00\x00\xa7\x0f" + (SBF_MAX_BYTES + 4).to_bytes(2, "little") + FRAME))
    assert [frame.data for frame in parser.frames] == [FRAME]
    assert parser.counters.errors == {"sbf_length_over_bound": 1}


def test_a_sentence_longer_than_the_bound_is_rejected() -> None:
    longest = encode_sentence("PTEST," + "x" * (NMEA_MAX_BYTES - 12))
    assert len(longest) == NMEA_MAX_BYTES
    assert len(frames_of(longest).frames) == 1
    assert frames_of(encode_sentence("PTEST," + "x" * (NMEA_MAX_BYTES - 11))).frames == []


@pytest.mark.parametrize(
    ("body", "name"),
    [
        ("GPGGA,120000", "GGA"),
        ("GNGGA,120001", "GGA"),
        ("AIVDM,1,1", "VDM"),
        ("PUBX,00,120000", "PUBX00"),
        ("PUBX,04,120000", "PUBX04"),
        ("PUBX,04", "PUBX04"),
        ("PUBX,041", "PUBX"),
        ("PUBX", "PUBX"),
        ("PQTMVERNO,1", "PQTMVERNO"),
        ("PASHR", "PASHR"),
        ("GPabc,1", "GP"),
        ("GPLONGERTHANANYADDRESS,1", "GPLONGERTHANANYADDRESS"),
        ("A bc,1", "A"),
    ],
)
def test_sentences_are_counted_by_name(body: str, name: str) -> None:
    assert frames_of(encode_sentence(body) * 2).counters.messages == {name: 2}


@pytest.mark.parametrize("ending", [b"\r\n", b"\n", b"", b"\r"])
def test_a_sentence_ends_with_its_line_or_its_checksum(ending: bytes) -> None:
    sentence = GOOD[:-2]
    parser = frames_of(sentence + ending + FRAME)
    taken = b"" if ending == b"\r" else ending
    assert [frame.data for frame in parser.frames] == [sentence + taken, FRAME]


def test_a_frame_has_the_arrival_time_of_its_last_byte() -> None:
    """A frame delayed by a false sync keeps the time of its own last byte."""
    false = b"\xb5b\x01\x07\x80\x00"
    parser = frames_of(b"x", FRAME[:5], FRAME[5:], false, FRAME, GOOD, bytes(200))
    assert [(frame.host_time_ns, frame.data) for frame in parser.frames] == [(2, FRAME), (4, FRAME), (5, GOOD)]


def test_an_empty_stream_can_be_closed() -> None:
    parser = frames_of(b"")
    assert (parser.counters.bytes, parser.frames) == (0, [])


# --- cut and damaged ---


@pytest.mark.parametrize("name", ["rtcm3.2.log", "pygpsdata-NTRIP-4076.log", "pygpsdata-MIXED-RTCM3.log"])
def test_rtcm3_frames_do_not_depend_on_how_the_stream_is_cut(name: str) -> None:
    outcome = check_stream(count_frames, recording("rtcm3", name))
    assert sum(outcome.counters["messages"].values()) == sum(expected("rtcm3")[name]["messages"].values())


def test_damaged_rtcm3_stream_never_raises() -> None:
    check_damage(count_frames, recording("rtcm3", "rtcm3.2.log"))


def test_garbage_never_raises() -> None:
    check_garbage(count_frames)


def test_sbf_mixed_with_nmea_and_rtcm3_does_not_depend_on_how_it_is_cut() -> None:
    """Blocks, sentences, RTCM3 and replies of the command line alternate on one port."""
    mixed = recording("sbf", "pygpsdata_mixed.log")
    blocks = recording("sbf", "pygpsdata_x5_status.log")
    reply = b"$R: setDataInOut, COM1, , SBF\r\n  DataInOut, COM1, CMD, SBF\r\nCOM1>"
    outcome = check_stream(count_frames, mixed + reply + blocks + GOOD + reply + mixed)
    assert outcome.counters["messages"]["SBF-4007"] == 2
    assert outcome.counters["messages"].total() == 2 * 6 + 13 + 1
    assert outcome.counters["bytes_skipped"] == 2 * len(reply)


def test_damaged_sbf_stream_never_raises() -> None:
    check_damage(count_frames, recording("sbf", "sbfdata.log"))
