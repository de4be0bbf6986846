"""Tests logs of CAN buses of other programs against python-can, and by lines of the makers' manuals."""

from __future__ import annotations

import datetime as dt
import gzip
import json
import os
import subprocess
import sys
from pathlib import Path

import can
import pytest

from swath.drivers.can_frames import encode_can_frame
from swath.drivers.captures.base import CaptureTally
from swath.drivers.captures.can.blf import blf_time
from swath.drivers.captures.can.candump import candump_time, read_candump
from swath.drivers.captures.opening import CapturedUnit, FileClock, FileTime, can_log_kind, can_log_time, read_can_log
from swath.drivers.transports.base import TransportError
from tests.drivers.captures.can_logs import (
    ASC_HEAD,
    ASC_LINES,
    BLF_CLASSIC,
    BLF_CLASSIC_64,
    BLF_FD_64,
    BLF_FD_CUT,
    BLF_REMOTE,
    TRC_HEAD,
    blf_container,
    blf_file,
    blf_object,
)
from tests.drivers.recordings import FIXTURES

ROOT = FIXTURES.parent
CANDUMP = FIXTURES / "canmod-gps" / "2F6913DB_00000004_00000001_candump.log.gz"
START_NS = 1_700_000_000_000_000_000
BERNE = dt.timezone(dt.timedelta(hours=1))
WRITERS = {"asc": can.ASCWriter, "blf": can.BLFWriter, "trc": can.TRCWriter}


def read(
    path: Path, text: str | bytes, clock: FileClock | None = None, tally: CaptureTally | None = None
) -> list[CapturedUnit]:
    path.write_bytes(text.encode("latin-1") if isinstance(text, str) else text)
    kind = can_log_kind(path.read_bytes()[:65_536])
    return list(read_can_log(path, kind, clock or FileClock(), tally))


def messages() -> list[can.Message]:
    """Return messages of every kind, and the frames of a recording."""
    kinds = [
        can.Message(arbitration_id=0x7FF, is_extended_id=False, data=b"\1\2"),
        can.Message(arbitration_id=0x1FFF_FFFF, data=bytes(range(8))),
        can.Message(arbitration_id=0x123, is_extended_id=False),
        can.Message(arbitration_id=0x124, is_extended_id=False, is_remote_frame=True, dlc=4),
        can.Message(arbitration_id=0x18FE_A5D3, is_fd=True, bitrate_switch=True, data=bytes(range(12))),
        can.Message(arbitration_id=0x125, is_extended_id=False, is_fd=True, data=bytes(range(64))),
    ]
    with can.CanutilsLogReader(gzip.open(CANDUMP, "rt")) as reader:
        kinds += [message for number, message in enumerate(reader) if number < 300]
    for number, message in enumerate(kinds):
        message.timestamp = 1_700_000_000.0 + number / 1024
        message.channel = int(str(message.channel).removeprefix("can")) - 1 if message.channel else 0
    return kinds


def channel_of(message: can.Message) -> str:
    """Return the name of a unit's channel: python-can counts from 0, the formats from 1."""
    assert isinstance(message.channel, int)
    return str(message.channel + 1)


def unit_of(message: can.Message) -> bytes:
    frame = encode_can_frame(
        message.arbitration_id, bytes(message.data), extended=message.is_extended_id, fd=message.is_fd,
        remote=message.is_remote_frame,
    )  # fmt: skip
    if message.is_remote_frame:
        frame = frame[:4] + bytes([message.dlc]) + frame[5:]
    return frame[:5] + bytes([frame[5] | message.bitrate_switch]) + frame[6:]


@pytest.mark.parametrize("kind", WRITERS)
def test_frames_that_python_can_writes_are_read_as_they_were(tmp_path: Path, kind: str) -> None:
    """Each format keeps what it can: python-can's TRC writes data frames of one bus only."""
    sent = [one for one in messages() if kind != "trc" or not (one.is_fd or one.is_remote_frame)]
    path = tmp_path / f"bus.{kind}"
    with WRITERS[kind](str(path)) as writer:
        for message in sent:
            writer.on_message_received(message)
    assert can_log_kind(path.read_bytes()[:65_536]) == kind
    assert can_log_time(path, kind) is FileTime.LOCAL
    tally = CaptureTally()
    units = list(read_can_log(path, kind, FileClock(), tally))
    assert [unit.data for unit in units] == list(map(unit_of, sent))
    if kind != "trc":
        assert [unit.channel for unit in units] == [channel_of(message) for message in sent]
    within_ns = {"asc": 1_500_000, "blf": 1_000_000, "trc": 1_500_000}[kind]  # of the start: milliseconds
    first_ns = units[0].time_ns
    zone = None if kind == "asc" else dt.UTC  # python-can writes ASC in the zone of this computer
    assert abs(first_ns - FileClock().unix_ns(dt.datetime.fromtimestamp(1.7e9, zone))) <= within_ns
    step = {"asc": 1000, "blf": 1000, "trc": 100_000}[kind]
    after_ns = [(message.timestamp - sent[0].timestamp) * 1e9 for message in sent]
    assert all(abs(unit.time_ns - first_ns - ns) <= step for ns, unit in zip(after_ns, units, strict=True))
    assert (tally.damage, sum(tally.passed.values())) == (0, 1 if kind == "asc" else 0)  # "Start of measurement"
    shifted = list(read_can_log(path, kind, FileClock(START_NS)))
    assert abs(shifted[0].time_ns - START_NS) < 10**9
    assert shifted[-1].time_ns - shifted[0].time_ns == units[-1].time_ns - first_ns


def test_python_can_reads_blf_and_asc_alike(tmp_path: Path) -> None:
    path = tmp_path / "bus.blf"
    with can.BLFWriter(str(path)) as writer:
        for message in messages():
            writer.on_message_received(message)
    with can.BLFReader(str(path)) as reader:
        theirs = list(reader)
    ours = list(read_can_log(path, "blf", FileClock()))
    assert [(unit_of(one), channel_of(one)) for one in theirs] == [(one.data, one.channel) for one in ours]
    assert max(abs(one.timestamp - unit.time_ns / 1e9) for one, unit in zip(theirs, ours, strict=True)) < 1e-6


class TestCandump:
    DATA = bytes.fromhex("0011223344556677")

    @pytest.mark.parametrize(
        ("line", "frame"),
        [
            ("can0  120   [8]  00 11 22 33 44 55 66 77", encode_can_frame(0x120, DATA)),
            ("can0  120   [3]  61 62 63                  'abc'", encode_can_frame(0x120, b"abc")),
            ("can0  120   [3]  63`62`61                  `abc`", encode_can_frame(0x120, b"abc")),
            ("can0  120   [2]  01100001 01100010", encode_can_frame(0x120, b"ab")),
            ("can0  120   [0]", encode_can_frame(0x120, b"")),
            ("can0  120   [0]                            ''", encode_can_frame(0x120, b"")),
            ("can0       120   [1]  07", encode_can_frame(0x120, b"\7")),
            ("can0  18FF50E5   [2]  01 02", encode_can_frame(0x18FF50E5, b"\1\2", extended=True)),
            ("can0  120  [02]  01 02", encode_can_frame(0x120, b"\1\2", fd=True)),
            ("can0  RX B E  120  [02]  01 02", bytes.fromhex("20010000 02070000 0102") + bytes(62)),
            ("can0  TX - -  120   [2]  01 02", encode_can_frame(0x120, b"\1\2")),
            ("can0  120   [4]  remote request", bytes.fromhex("20010040 04000000") + bytes(8)),
            ("can0  120   {F}  00 11 22 33 44 55 66 77", bytes.fromhex("20010000 0800000f") + DATA),
            (
                "can0  20000004   [8]  00 01 00 00 00 00 00 00   ERRORFRAME",
                bytes.fromhex("04000020 08000000 0001000000000000"),
            ),
            ("\x1b[31mcan0\x1b[0m  120   [1]  07", encode_can_frame(0x120, b"\7")),
        ],
    )  # fmt: skip
    def test_lines_for_people_are_read(self, tmp_path: Path, line: str, frame: bytes) -> None:
        """The lines are as candump prints them with -a, -S, -i, -x, -8, -e and -c (can-utils, lib.c)."""
        text = f" (1469439874.299591)  {line}\n" * 2
        units = read(tmp_path / "a.log", text)
        assert [(unit.time_ns, unit.channel, unit.data) for unit in units] == [(1469439874299591000, "can0", frame)] * 2

    @pytest.mark.parametrize(
        ("stamps", "told", "wanted_ns"),
        [
            (["1700000000.000001", "1700000000.5"], FileTime.UTC, [1000, 500_000_000]),
            (["1700000000.000000001", "1700000000.5"], FileTime.UTC, [1, 500_000_000]),
            (["2023-11-14 23:13:20.000001", "2023-11-14 23:13:20.5"], FileTime.LOCAL, [1000, 500_000_000]),
            (["000.000000", "000.010000", "000.030000"], FileTime.SINCE_BEGIN, [0, 10_000_000, 30_000_000]),
            (["000.000000", "000.020000", "000.010000"], FileTime.SINCE_BEGIN, [0, 20_000_000, 30_000_000]),
            (["000.000000", "000.010000", "000.010000"], FileTime.SINCE_BEGIN, [0, 10_000_000, 20_000_000]),
        ],
    )  # fmt: skip
    def test_every_form_of_time_is_read(
        self, tmp_path: Path, stamps: list[str], told: FileTime, wanted_ns: list[int]
    ) -> None:
        """Read -t a, with and without -N, -t A, -t z and -t d, in both kinds of lines."""
        clock = FileClock(START_NS if told is FileTime.SINCE_BEGIN else None, BERNE)
        for form in ("({}) can0 123#00", " ({})  can0  123   [1]  00"):
            text = "".join(form.format(stamp) + "\n" for stamp in stamps)
            assert [unit.time_ns - START_NS for unit in read(tmp_path / "a.log", text, clock)] == wanted_ns
            assert candump_time(tmp_path / "a.log") is told
            if told is FileTime.SINCE_BEGIN:
                with pytest.raises(TransportError, match="does not tell when it begins"):
                    list(read_candump(tmp_path / "a.log"))

    def test_lines_of_other_kinds_are_counted(self, tmp_path: Path) -> None:
        lines = [
            "(1.0) can0 123#00", "(1.0)  can0  20000004   [8]  00 01 00 00 00 00 00 00   ERRORFRAME",
            "\tcontroller-problem{rx-overflow}", "(1.0) can0 00123#81:00:12345678#11223344",
            "(1.0)  can0  123 [0004] (00|81:00:12345678) 11 22 33 44", "can0  123   [1]  00",
            "(1.0)  can0  123   [9]  00 00 00 00 00 00 00 00 00", "(1.0)  can0  123   [2]  00",
            "(1.0)  can0  123   [2]  0g 00",
        ]  # fmt: skip
        tally = CaptureTally()
        units = read(tmp_path / "a.log", "\n".join(lines), tally=tally)
        assert len(units) == 2
        assert tally.passed == {"CAN XL frames": 2, "lines that explain an error frame": 1}
        assert tally.damage == 4
        assert "line 6 is not a frame of candump: its time has another form than the first: can0" in tally.first_damage

    def test_output_without_times_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(TransportError, match="its frames have no times; record with candump -L, or with -t a"):
            read(tmp_path / "a.log", "  can0  123   [1]  00\n")


class TestAsc:
    def test_every_kind_of_event_is_read_or_counted(self, tmp_path: Path) -> None:
        tally = CaptureTally()
        units = read(tmp_path / "a.asc", ASC_HEAD + ASC_LINES, FileClock(zone=BERNE), tally)
        begin_ns = START_NS + 125_000_000
        long_data = bytes(range(12))
        assert [(unit.time_ns - begin_ns, unit.channel, unit.data) for unit in units] == [
            (500_000_100, "1", encode_can_frame(0x123, b"\x0a\xff")),
            (600_000_000, "2", encode_can_frame(0x18FF50E5, b"", extended=True)),
            (700_000_000, "1", bytes.fromhex("23010040 04000000") + bytes(8)),
            (800_000_000, "1", bytes.fromhex("00ffeb98 0c050000") + long_data + bytes(52)),
            (900_000_000, "2", bytes.fromhex("00030000 01070000 07") + bytes(63)),
            (1_000_000_000, "2", encode_can_frame(0x300, b"\7\10")),
        ]
        assert tally.passed == {"events that are not frames": 3, "requests to send": 1, "error frames": 1}
        assert (tally.damage, tally.first_damage[-60:]) == (2, tally.first_damage[-60:])
        assert "line 17 is not an event of ASC: 1.200000 1  12G" in tally.first_damage

    def test_relative_times_and_decimal_numbers_are_read(self, tmp_path: Path) -> None:
        """The stamps count from the event before, of whatever kind."""
        text = "date Mi M\xe4r 1 13:20:00 2023\nbase dec  timestamps relative\n"
        text += "0.250000 Start of measurement\n0.250000 1 291 Rx d 2 10 255\n1.000000 1 Statistic: D 0\n"
        text += "0.5 1 291x Rx d 1 9\n"
        units = read(tmp_path / "a.asc", text)
        begin_ns = round(dt.datetime(2023, 3, 1, 13, 20, tzinfo=dt.UTC).timestamp()) * 10**9
        assert [(unit.time_ns - begin_ns, unit.data) for unit in units] == [
            (500_000_000, encode_can_frame(0x123, b"\x0a\xff")),
            (2_000_000_000, encode_can_frame(0x123, b"\x09", extended=True)),
        ]

    @pytest.mark.parametrize(("stamp", "wanted_s"), [("70.0", 70), ("0.5", 60.5)])
    def test_a_second_trigger_block_goes_on_or_begins_anew(self, tmp_path: Path, stamp: str, wanted_s: float) -> None:
        block = "Begin Triggerblock Tue Nov 14 23:{}:20 2023\n{} 1 123 Rx d 0\n"
        text = "base hex  timestamps absolute\n" + block.format("13", "10.0") + block.format("14", stamp)
        units = read(tmp_path / "a.asc", text, FileClock(zone=BERNE))
        assert [(unit.time_ns - START_NS) / 1e9 for unit in units] == [10.0, wanted_s]

    def test_a_log_without_a_date_needs_a_start(self, tmp_path: Path) -> None:
        text = "base hex  timestamps absolute\n0.5 1 123 Rx d 0\n"
        with pytest.raises(TransportError, match="does not tell when it begins"):
            read(tmp_path / "a.asc", text)
        assert can_log_time(tmp_path / "a.asc", "asc") is FileTime.SINCE_BEGIN
        assert [unit.time_ns for unit in read(tmp_path / "a.asc", text, FileClock(7))] == [500_000_007]


class TestTrc:
    """The lines are the examples of PEAK's manual, with other identifiers."""

    DATA, SHORT = bytes.fromhex("00000000040000"), bytes(2)

    @pytest.mark.parametrize(
        ("version", "lines"),
        [
            ("1.1", ["1)      1059.9  Rx         0300  7  00 00 00 00 04 00 00",
                     "2)      1298.9  Tx     18FF50E5  2  00 00",
                     "5)      1346.8  Warng  FFFFFFFF  4  00 00 00 04  BUSLIGHT",
                     "6)      1349.2  Error      0008  4  00 19 08 08",
                     "7)      1352.7  Rx         0100  3  RTR"]),
            ("1.2", ["1)      1059.900  1  Rx         0300  7  00 00 00 00 04 00 00",
                     "2)      1298.900  1  Tx     18FF50E5  2  00 00",
                     "5)      1346.834  1  Warng  FFFFFFFF  4  00 00 00 04  BUSLIGHT",
                     "6)      1349.222  1  Error      0008  4  00 19 08 08",
                     "7)      1352.700  1  Rx         0100  3  RTR"]),
            ("1.3", ["1)      1059.900  1  Rx         0300  -  7  00 00 00 00 04 00 00",
                     "2)      1298.900  1  Tx     18FF50E5  -  2  00 00",
                     "5)      1346.834  1  Warng  FFFFFFFF  -  4  00 00 00 04  BUSLIGHT",
                     "6)      1349.222  1  Error      0008  -  4  00 19 08 08",
                     "7)      1352.700  1  Rx         0100  -  3  RTR"]),
        ],
    )  # fmt: skip
    def test_each_first_version_is_read(self, tmp_path: Path, version: str, lines: list[str]) -> None:
        tally = CaptureTally()
        head = TRC_HEAD.format(version, "").replace(";$COLUMNS=\n", "")
        units = read(tmp_path / "a.trc", head + "\n".join(lines), FileClock(zone=BERNE), tally)
        assert [(round((unit.time_ns - START_NS) / 1e5), unit.channel, unit.data) for unit in units] == [
            (10599, "1", encode_can_frame(0x300, self.DATA)),
            (12989, "1", encode_can_frame(0x18FF50E5, self.SHORT, extended=True)),
            (13527, "1", bytes.fromhex("00010040 03000000") + bytes(8)),
        ]
        assert (tally.damage, tally.passed) == (0, {"warnings": 1, "error frames": 1})

    def test_version_1_0_tells_its_start_in_a_comment(self, tmp_path: Path) -> None:
        text = ";##########\n;  C:\\TraceFile.trc\n;\n;  CAN activities recorded by PCAN Explorer\n"
        text += ";  Start time: 14.11.2023 23:13:20.682\n;  PCAN-Net: PCI1\n"
        text += " 1)  1841  0001  8  00 00 00 00 00 00 00 00\n 2)  1842  0008  4  ERROR 00 19 08 08\n"
        text += " 3)  1843  FFFFFFFF  4  00 00 00 04  ------BUSLIGHT\n 4)  1844  0100  3  RTR\n 5)  1845 0100 2 00\n"
        tally = CaptureTally()
        units = read(tmp_path / "a.trc", text, FileClock(zone=BERNE), tally)
        assert [(unit.time_ns - START_NS) // 10**6 for unit in units] == [682 + 1841, 682 + 1844]
        assert (tally.damage, tally.passed) == (1, {"warnings": 1, "error frames": 1})

    def test_columns_of_version_2_are_read_in_their_order(self, tmp_path: Path) -> None:
        """PEAK: FB has BRS set, FE has ESI, BI both; L is a code, l a length."""
        text = TRC_HEAD.format("2.1", "N,O,T,B,I,d,R,L,D") + "\n".join([
            " 1  1059.900 DT 1      0300 Rx -  7    00 00 00 00 04 00 00",
            " 2  1283.231 FD 2  18FF50E5 Rx -  9    " + "07 " * 12,
            " 3  1.000 FB 2 0300 Rx - 1 07",
            " 4  1.000 FE 2 0300 Rx - 1 07",
            " 5  1.000 BI 2 0300 Rx - 1 07",
            " 6  1.000 RR 1 0300 Rx - 3",
            " 7  1.000 ST 1 - Rx - 4 00 00 00 00",
            " 8  1.000 EC 1 - Rx - 2 00 00",
            " 9  1.000 ER 1 - Rx - 5 04 00 02 00 00",
            "10  1.000 EV 1 a text",
            "11  1.000 DT 1 18EBFF00 Rx - 20 " + "00 " * 20,
            "12  1.000 XX 1 0300 Rx - 0",
            "13  1.000 DT 1 0300 Rx - 3 00 00",
        ])  # fmt: skip
        tally = CaptureTally()
        units = read(tmp_path / "a.trc", text, tally=tally)
        one = bytes.fromhex("00030000 01")
        assert [(unit.channel, unit.data) for unit in units] == [
            ("1", encode_can_frame(0x300, self.DATA)),
            ("2", encode_can_frame(0x18FF50E5, b"\7" * 12, extended=True, fd=True)),
            *(("2", one + bytes([flags | 4, 0, 0, 7]) + bytes(63)) for flags in (1, 2, 3)),
            ("1", bytes.fromhex("00030040 03000000") + bytes(8)),
        ]
        assert tally.passed == {
            "states of the hardware": 1, "changes of error counters": 1, "error frames": 1, "events of users": 1,
            "messages of several frames, put together": 1, "lines of other kinds": 1,
        }  # fmt: skip
        assert tally.damage == 2
        short = TRC_HEAD.format("2.0", "N,O,T,I,d,l,D") + "1 1.0 FD 0300 Rx 12 " + "07 " * 12 + "\n"
        assert read(tmp_path / "a.trc", short)[0].data == encode_can_frame(0x300, b"\7" * 12, fd=True)
        with pytest.raises(TransportError, match=r"version 9\.9 is not known; want"):
            read(tmp_path / "a.trc", TRC_HEAD.format("9.9", "") + "1 1.0\n")


class TestBlf:
    BEGIN_NS = START_NS + 500_000_000

    def test_every_kind_of_object_is_read_or_counted(self, tmp_path: Path) -> None:
        """One object begins in one container and ends in the next; one container is not compressed."""
        objects = [
            blf_object(1, BLF_CLASSIC, (2, 123_456_789)), blf_object(86, BLF_REMOTE, (1, 5)),
            blf_object(101, BLF_CLASSIC_64, version=2), blf_object(101, BLF_FD_64), blf_object(101, BLF_FD_CUT),
            blf_object(73, bytes(32)), blf_object(96, bytes(48)), blf_object(1, BLF_CLASSIC, (7, 0)),
        ]  # fmt: skip
        whole = b"".join(objects)
        data = blf_file(blf_object(115, bytes(20)), blf_container(whole[:150]), blf_container(whole[150:], 0))
        tally = CaptureTally()
        units = read(tmp_path / "a.blf", data, FileClock(zone=BERNE), tally)
        assert [(unit.time_ns - self.BEGIN_NS, unit.channel, unit.data) for unit in units] == [
            (123_456_789, "3", encode_can_frame(0x18FF50E5, b"\1\2", extended=True)),
            (50_000, "1", bytes.fromhex("23010040 04000000") + bytes(8)),
            (0, "1", encode_can_frame(0x123, b"\7\10")),
            (0, "2", bytes.fromhex("23010000 0c070000") + bytes(range(12)) + bytes(52)),
            (0, "2", encode_can_frame(0x123, b"abcd" + bytes(8), fd=True)),
        ]
        assert (tally.damage, tally.passed) == (1, {"error frames": 1, "objects that are not frames": 2})
        assert blf_time(tmp_path / "a.blf") is FileTime.LOCAL
        no_start = blf_file(blf_container(objects[0]), start=(0,) * 8)
        with pytest.raises(TransportError, match="does not tell when it begins"):
            read(tmp_path / "a.blf", no_start)
        assert read(tmp_path / "a.blf", no_start, FileClock(7))[0].time_ns == 123_456_796

    def test_a_log_cut_or_damaged_anywhere_gives_the_rest(self, tmp_path: Path) -> None:
        frames = [blf_object(1, BLF_CLASSIC, (2, n)) for n in range(40)]
        whole = blf_file(*(blf_container(b"".join(frames[at : at + 10])) for at in range(0, 40, 10)))
        with pytest.raises(TransportError, match="is not a BLF log, or ends in its header"):
            read(tmp_path / "a.blf", whole[:50])
        counts = []
        for size in range(144, len(whole)):
            tally = CaptureTally()
            counts.append(len(read(tmp_path / "a.blf", whole[:size], tally=tally)))
            assert tally.damage <= 1
        assert counts == sorted(counts)
        assert {0, 10, 20, 30} <= {*counts}
        for at in range(150, len(whole), 7):
            tally = CaptureTally()
            changed = whole[:at] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :]
            assert 19 < len(read(tmp_path / "a.blf", changed, tally=tally)) <= 40


@pytest.mark.parametrize("kind", ["asc", "trc"])
def test_text_logs_cut_anywhere_raise_only_transport_errors(tmp_path: Path, kind: str) -> None:
    text = (
        ASC_HEAD + ASC_LINES
        if kind == "asc"
        else TRC_HEAD.format("2.1", "N,O,T,B,I,d,R,L,D") + "1 1.0 DT 1 0300 Rx - 1 00\n" * 3
    )
    found = 0
    for size in range(30, len(text)):
        (tmp_path / "a").write_text(text[:size])
        try:
            found = max(found, len(list(read_can_log(tmp_path / "a", kind, FileClock(), CaptureTally()))))
        except TransportError:
            continue
    assert found >= 2


MF4 = """
import json, sys
from pathlib import Path
from swath.drivers.captures.base import CaptureTally
from swath.drivers.captures.opening import FileClock, can_log_kind, can_log_time, read_can_log
from swath.drivers.transports.base import TransportError
path, cut = Path(sys.argv[1]), Path(sys.argv[2])
units = list(read_can_log(path, "mf4", FileClock(), CaptureTally()))
whole, results = cut.read_bytes(), []
pieces = [whole[:size] for size in (64, 3000, 20_000, len(whole) - 1)]
for changes in json.loads(sys.argv[3]):
    pieces.append(bytearray(whole[:20_000]))
    for at, content in changes:
        pieces[-1][at : at + len(content) // 2] = bytes.fromhex(content)
for piece in pieces:
    cut.write_bytes(piece)
    tally = CaptureTally()
    try:
        results.append([len(list(read_can_log(cut, "mf4", FileClock(), tally))), tally.damage, tally.first_damage])
    except TransportError as error:
        results.append([-1, 1, str(error)])
print(json.dumps([can_log_time(path, "mf4").name, [(u.time_ns, u.channel, u.data.hex()) for u in units], results]))
"""


# changes of that file: addresses, and bytes that stand there instead; asammdf 8's compiled code ends at the first
CRASHES = [(5642, "2c0f424c"), (5648, "0010"), (16812, "ffffffff")]
GIGABYTES = [(1077, "feffffff"), (7227, "f87f"), (17200, "0100"), (17203, "7f")]


@pytest.mark.slow
def test_mf4_of_a_logger_is_read_as_its_candump_log(tmp_path: Path) -> None:
    """Both are recordings of the same minute; asammdf's times are floats, a nanosecond apart at most."""
    path = FIXTURES / "canmod-gps" / "2F6913DB_00000004_00000001.MF4.gz"
    assert can_log_kind(gzip.decompress(path.read_bytes())[:100]) == "mf4"
    (tmp_path / "cut.mf4").write_bytes(gzip.decompress(path.read_bytes()))
    done = subprocess.run(
        [sys.executable, "-c", MF4, str(path), str(tmp_path / "cut.mf4"), json.dumps([CRASHES, GIGABYTES])],
        env=os.environ | {"PYTHONPATH": str(ROOT)}, cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")  # asammdf's own objects complain when they are removed
    told, units, results = json.loads(done.stdout)
    theirs = list(read_candump(CANDUMP))
    assert told == "UTC"
    assert [(f"can{channel}", data) for _, channel, data in units] == [(one.channel, one.data.hex()) for one in theirs]
    assert max(abs(time_ns - one.time_ns) for (time_ns, _, _), one in zip(units, theirs, strict=True)) <= 1
    counts = [(-1, 1), (-1, 1), (149, 1), (5587, 1), (0, 1), (0, 1)]
    assert [(count, damage) for count, damage, _ in results] == counts
    lines = [line.removeprefix(f"{tmp_path}/cut.mf4: ") for _, _, line in results]
    assert all("\n" not in line and line.startswith("asammdf cannot read ") for line in lines[:5])
    assert lines[5] == "the records of CAN_DataFrame are damaged: CAN_DataFrame.DataBytes has 234895360 bytes in one"


def test_without_asammdf_the_extra_is_named(tmp_path: Path) -> None:
    """This process has no asammdf (tests/lean)."""
    with pytest.raises(
        TransportError, match=r"MF4 files need asammdf, which is not installed: pip install '.\[import\]'"
    ):
        read(tmp_path / "a.mf4", b"MDF     4.10    ")
