"""Reads ASC logs of Vector's CANalyzer and CANoe, and of programs that write them.

Vector does not publish the form; it follows python-can 4.6 (can/io/asc.py). Own rules: times are read as decimals,
``timestamps relative`` count from the event before, trigger blocks go on with the times of the first unless theirs
begin anew, and a line that is wrong is counted.
"""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from swath.drivers.can_frames import CAN_EFF_FLAG, CANFD_BRS, CANFD_ESI, CANFD_LENGTHS, data_frame
from swath.drivers.captures.base import LATEST_NS, CapturedUnit, CaptureTally, read_lines, report, until_damage
from swath.drivers.captures.can.clock import FileClock, FileTime, decimal_ns, local_time

_DATE = re.compile(
    r"(?:date|begin\s+trigger\s?block)\s+\S+\s+(\S+)\s+(\d{1,2})\s+(\d{1,2}):(\d\d):(\d\d)(?:[.:](\d{1,9}))?"
    r"(?:\s*([AP])M)?\s+(\d{4}).*",
    re.IGNORECASE,
)
_BASE = re.compile(r"base\s+(hex|dec)(?:\s+timestamps\s+(absolute|relative))?.*", re.IGNORECASE)
_EVENT = re.compile(r"\d+\.\d+\s")
_BEGIN = re.compile(r"begin\s+trigger\s?block.*", re.IGNORECASE)
_FRAME = re.compile(r"(\d{1,3})\s+(\S+)\s+(Rx|Tx|TxRq)\s+([dr])(?:\s+(.*))?", re.IGNORECASE)
_FD_FRAME = re.compile(
    r"CANFD\s+(\d{1,3})\s+(Rx|Tx|TxRq)\s+(\S+)\s+(?:(?!\d+\s)(\S+)\s+)?([01])\s+([01])\s+([0-9a-f])\s+(\d{1,2})\s+(.*)",
    re.IGNORECASE,
)
_LIKE_FRAME = re.compile(r"\d{1,3}\s+\S+\s+(?:Rx|Tx)\s|CANFD\s+\d", re.IGNORECASE)
_ERROR = re.compile(r"(?:CANFD\s+)?\d{1,3}\s+(?:(?:Rx|Tx)\s+)?ErrorFrame.*", re.IGNORECASE)
_MONTHS = {"ja": 1, "f": 2, "ap": 4, "jun": 6, "jul": 7, "au": 8, "s": 9, "o": 10, "n": 11, "d": 12}
_EDL, _BRS, _ESI, _REMOTE = 0x1000, 0x2000, 0x4000, 0x10  # flags of an FD event
_HEAD_LINES = 200


def is_asc(line: str) -> bool:
    """Return whether a line is one of the first lines of an ASC log."""
    return _BASE.fullmatch(line) is not None or (line.lower().startswith("date ") and _DATE.fullmatch(line) is not None)


def asc_time(path: Path) -> FileTime:
    """Return whether a log tells the local time of its beginning."""
    dated = any(_local(line) is not None for _, line in islice(read_lines(path, CaptureTally()), _HEAD_LINES))
    return FileTime.LOCAL if dated else FileTime.SINCE_BEGIN


def read_asc(path: Path | str, clock: FileClock, tally: CaptureTally | None = None) -> Iterator[CapturedUnit]:
    """Read the frames of a log as SocketCAN units of 16 or 72 bytes; a channel has its number as its name.

    Args:
        path: the file, possibly gzipped.
        clock: the zone of the file's date, or the beginning of its times.
        tally: counts damage, and events of other kinds; where None, damage is raised.

    Raises:
        TransportError: the file cannot be read, or does not tell when it begins; without tally also: a line is wrong.
    """
    path = Path(path)
    return until_damage(_Log(path, clock, tally).units(), tally)


def _local(line: str) -> dt.datetime | None:
    """Return the local time of a line with a date; names of months are English or German."""
    match = _DATE.fullmatch(line)
    if match is None:
        return None
    name, day, hour, minute, second, fraction, half, year = match.groups()
    name = name.lower()
    month = next((number for start, number in _MONTHS.items() if name.startswith(start)), None)
    if month is None and name.startswith("m"):  # May, Mai, Mar, Mär in any encoding
        month = 5 if name[1:3] in ("ay", "ai") else 3
    hours = int(hour) % 12 + 12 * (half.upper() == "P") if half else int(hour)
    microseconds = int((fraction or "").ljust(6, "0")[:6])
    try:
        return local_time(int(year), month or 0, int(day), hours, int(minute), int(second), microseconds)
    except ValueError:
        return None


class _Log:
    """Reads the lines of one log."""

    def __init__(self, path: Path, clock: FileClock, tally: CaptureTally | None) -> None:
        self._path, self._clock, self._tally = path, clock, tally
        self._base, self._is_relative = 16, False
        self._began: dt.datetime | None = None  # of the file, or of its first trigger block
        self._next: dt.datetime | None = None  # of a trigger block whose first event has not come
        self._start_ns: int | None = None
        self._latest_ns = 0  # since the beginning

    def units(self) -> Iterator[CapturedUnit]:
        """Yield the units of the log."""
        for number, line in read_lines(self._path, self._tally):
            if not _EVENT.match(line):
                self._head(line)
                continue
            stamp, event = line.split(None, 1)
            try:
                time_ns = self._time_ns(decimal_ns(stamp))
                found = self._frame(event)
            except ValueError:
                report(self._tally, f"{self._path}: line {number} is not an event of ASC: {line[:60]}")
                continue
            if found is not None and time_ns <= LATEST_NS:
                yield CapturedUnit(time_ns, found[1], found[0])

    def _head(self, line: str) -> None:
        local = _local(line)
        if local is not None and _BEGIN.fullmatch(line) and self._start_ns is not None:
            self._next = local
        elif local is not None and self._start_ns is None:
            self._began = local
        elif base := _BASE.fullmatch(line):
            self._base = 16 if base[1].lower() == "hex" else 10
            self._is_relative = (base[2] or "").lower() == "relative"

    def _time_ns(self, stamp_ns: int) -> int:
        """Return the time of an event; a later trigger block counts anew if its stamps do."""
        if self._start_ns is None:
            self._start_ns = self._clock.begin(self._began, self._path)
        if self._next is not None:
            if stamp_ns < self._latest_ns and self._began is not None and not self._is_relative:
                self._start_ns += self._clock.unix_ns(self._next) - self._clock.unix_ns(self._began)
                self._began = self._next
            self._next = None
        self._latest_ns = self._latest_ns + stamp_ns if self._is_relative else stamp_ns
        return self._start_ns + self._latest_ns

    def _frame(self, event: str) -> tuple[str, bytes] | None:
        """Return channel and unit of an event, or None where it is not a frame on the bus; raises ValueError."""
        classic, fd = _FRAME.match(event), _FD_FRAME.match(event)
        direction = classic[3] if classic is not None else fd[2] if fd is not None else ""
        if direction.lower() == "txrq":
            self._pass("requests to send")
        elif classic is not None:
            channel, identifier, _, kind, rest = classic.groups()
            return channel, self._classic(identifier, kind.lower() == "r", (rest or "").split())
        elif fd is not None:
            return fd[1], self._fd(fd)
        elif _ERROR.fullmatch(event):
            self._pass("error frames")
        elif _LIKE_FRAME.match(event):
            raise ValueError(event)
        else:
            self._pass("events that are not frames")
        return None

    def _pass(self, what: str) -> None:
        if self._tally is not None:
            self._tally.passed[what] += 1

    def _can_id(self, text: str) -> int:
        if text[-1:] in "xX":
            return int(text[:-1], self._base) | CAN_EFF_FLAG
        return int(text, self._base)

    def _classic(self, identifier: str, is_remote: bool, words: list[str]) -> bytes:
        can_id = self._can_id(identifier)
        if is_remote:
            asked = int(words[0], self._base) if words and len(words[0]) == 1 else 0
            return data_frame(can_id, b"", is_fd=False, remote_length=min(asked, 8))
        length = min(int(words[0] if words else "", self._base), 8)  # codes 9 to 15 mean 8 bytes
        return data_frame(can_id, self._bytes(words[1:], length), is_fd=False)

    def _fd(self, match: re.Match[str]) -> bytes:
        """Return the unit of a CANFD event, which may be a classic frame on a bus that can do FD."""
        _, _, identifier, _, brs, esi, code, length, rest = match.groups()
        words, size = rest.split(), int(length)
        can_id, bits = self._can_id(identifier), int(words[size + 2], 16) if len(words) > size + 2 else _EDL
        if not bits & _EDL and bits & _REMOTE:
            return data_frame(can_id, b"", is_fd=False, remote_length=min(int(code, 16), 8))
        flags = (CANFD_BRS if brs == "1" or bits & _BRS else 0) | (CANFD_ESI if esi == "1" or bits & _ESI else 0)
        data = self._bytes(words, size)
        return data_frame(can_id, data, is_fd=bool(bits & _EDL), flags=flags)

    def _bytes(self, words: list[str], length: int) -> bytes:
        if len(words) < length or length > max(CANFD_LENGTHS):
            raise ValueError(length)
        return bytes(int(word, self._base) for word in words[:length])
