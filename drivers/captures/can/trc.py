"""Reads TRC traces of PEAK's PCAN-View and PCAN-Explorer, versions 1.0 to 2.1.

Source: "PEAK CAN TRC File Format", PEAK-System 2020: its examples of each version and its list of types. Of the types
of FD frames, FE has ESI and BI has both bits, as the manual says; python-can 4.6 reads FE as both and BI as ESI.
"""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from swath.drivers.can_frames import CAN_EFF_FLAG, CANFD_BRS, CANFD_ESI, CANFD_LENGTHS, data_frame
from swath.drivers.captures.base import (
    LATEST_NS,
    CaptureDamageError,
    CapturedUnit,
    CaptureTally,
    read_lines,
    report,
    until_damage,
)
from swath.drivers.captures.can.clock import FileClock, FileTime, decimal_ns, local_time

_DAY_ZERO = local_time(1899, 12, 30)  # of the start time
_DAY_NS, _MS_NS = 86_400_000_000_000, 1_000_000
_KEY = re.compile(r";\$(FILEVERSION|STARTTIME|COLUMNS)\s*=\s*(\S+)", re.IGNORECASE)
_START = re.compile(
    r";\s*Start time:\s*(\d{1,2})\.(\d{1,2})\.(\d{4}) (\d{1,2}):(\d\d):(\d\d)\.(\d{1,3})(?:\.(\d{1,3}))?"
)  # as version 1.0 tells it; programs of later versions write it in other orders too, beside ;$STARTTIME
_FIRST_VERSION = re.compile(r";\s+CAN activities recorded by .*|;\s*;?-+\+-.*")
# columns by version: number, offset, bus, type, identifier, reserved, length, data
_COLUMNS = {"1.0": "NOIlD", "1.1": "NOTIlD", "1.2": "NOBTIlD", "1.3": "NOBTIRlD"}
_FD_FLAGS = {"FD": 0, "FB": CANFD_BRS, "FE": CANFD_ESI, "BI": CANFD_BRS | CANFD_ESI}
_FRAMES = {"DT", "RR", "RX", "TX", *_FD_FLAGS}
_OTHERS = {
    "ER": "error frames",
    "ERROR": "error frames",
    "EC": "changes of error counters",
    "ST": "states of the hardware",
    "EV": "events of users",
    "WARNG": "warnings",
}
_NO_ID = "FFFFFFFF"  # a warning of version 1.0
_HEAD_LINES = 200


def is_trc(line: str) -> bool:
    """Return whether a line is one of the first lines of a trace."""
    return _KEY.match(line) is not None or _FIRST_VERSION.fullmatch(line) is not None


def trc_time(path: Path) -> FileTime:
    """Return whether a trace tells the local time of its beginning."""
    head = _Head()
    for _, line in islice(read_lines(path, CaptureTally()), _HEAD_LINES):
        head.take(line)
    return FileTime.SINCE_BEGIN if head.began is None else FileTime.LOCAL


def read_trc(path: Path | str, clock: FileClock, tally: CaptureTally | None = None) -> Iterator[CapturedUnit]:
    """Read the frames of a trace as SocketCAN units of 16 or 72 bytes; a bus has its number as its name.

    Args:
        path: the file, possibly gzipped.
        clock: the zone of the file's start time, or the beginning of its times.
        tally: counts damage, and lines of other kinds; where None, damage is raised.

    Raises:
        TransportError: the file cannot be read, or does not tell when it begins; without tally also: a line is wrong.
    """
    return until_damage(_units(Path(path), clock, tally), tally)


class _Head:
    """The lines of a trace that begin with a semicolon."""

    def __init__(self) -> None:
        self.version = "1.0"
        self.columns = ""
        self.began: dt.datetime | None = None

    def take(self, line: str) -> None:
        """Take a line, whatever it is."""
        if key := _KEY.match(line):
            name, value = key[1].upper(), key[2].rstrip(";")
            if name == "FILEVERSION":
                self.version = value
            elif name == "COLUMNS":
                self.columns = value.replace(",", "")
            else:
                self._begin(value)
        elif (start := _START.match(line)) and self.began is None:
            day, month, year, hour, minute, second = map(int, start.groups()[:6])
            fraction = start[7].ljust(3, "0") + (start[8] or "").ljust(3, "0")
            try:
                self.began = local_time(year, month, day, hour, minute, second, int(fraction))
            except ValueError:
                return

    def _begin(self, days: str) -> None:
        try:
            self.began = _DAY_ZERO + dt.timedelta(microseconds=round(decimal_ns(days, _DAY_NS) / 1000))
        except (ValueError, OverflowError):
            return

    def layout(self) -> str:
        """Return the columns of the lines, "" for a version that is unknown."""
        return self.columns or _COLUMNS.get(self.version, "")


def _units(path: Path, clock: FileClock, tally: CaptureTally | None) -> Iterator[CapturedUnit]:
    head = _Head()
    start_ns: int | None = None
    for number, line in read_lines(path, tally):
        if line.startswith(";"):
            head.take(line)
            continue
        layout = head.layout()
        if not layout:
            raise CaptureDamageError(f"{path}: version {head.version[:10]} is not known; want 1.0 to 1.3, 2.0 or 2.1")
        if start_ns is None:
            start_ns = clock.begin(head.began, path)
        try:
            offset_ns, channel, frame = _frame(layout, line, tally)
        except (ValueError, KeyError, IndexError):
            report(tally, f"{path}: line {number} is not a message of TRC {head.version[:10]}: {line[:60]}")
            continue
        if frame is not None and start_ns + offset_ns <= LATEST_NS:
            yield CapturedUnit(start_ns + offset_ns, frame, channel)


def _frame(layout: str, line: str, tally: CaptureTally | None) -> tuple[int, str, bytes | None]:
    """Return offset, channel and unit of a line, None where it is no frame; raises ValueError, KeyError, IndexError."""
    words = line.split(None, len(layout) - 1)
    cells = dict(zip(layout, words, strict=False))
    offset_ns, channel = decimal_ns(cells["O"], _MS_NS), cells.get("B", "1")
    kind, data = cells.get("T", "DT").upper(), cells.get("D", "").split()
    if "T" not in layout:  # version 1.0 says it after the length
        word = data[0].upper() if data else ""
        kind = "WARNG" if cells["I"] == _NO_ID else word if word == "ERROR" else kind
    if kind not in _FRAMES:
        if tally is not None:
            tally.passed[_OTHERS.get(kind, "lines of other kinds")] += 1
        if kind not in _OTHERS:
            raise ValueError(kind)
        return offset_ns, channel, None
    can_id = int(cells["I"], 16) | (CAN_EFF_FLAG if len(cells["I"]) > 4 else 0)
    is_fd = kind in _FD_FLAGS
    length = int(cells["l"]) if "l" in cells else _of_code(int(cells["L"]), is_fd)
    if length > 8 and not is_fd:
        if tally is not None:
            tally.passed["messages of several frames, put together"] += 1
        return offset_ns, channel, None
    if kind == "RR" or data[:1] == ["RTR"]:
        return offset_ns, channel, data_frame(can_id, b"", is_fd=False, remote_length=length)
    if len(data) < length:
        raise ValueError(length)
    content = bytes(int(byte, 16) for byte in data[:length])
    return offset_ns, channel, data_frame(can_id, content, is_fd=is_fd, flags=_FD_FLAGS.get(kind, 0))


def _of_code(code: int, is_fd: bool) -> int:
    """Return the length that a data length code means."""
    return CANFD_LENGTHS[code] if is_fd else min(code, 8) if code <= 15 else code
