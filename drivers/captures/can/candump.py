"""Reads the output of candump of can-utils, one frame a line, and writes it in the form of ``candump -L``.

The forms follow can-utils' lib.c (`parse_canframe`, `snprintf_long_canframe`) and candump.c (`sprint_timestamp`).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

from swath.drivers.can_frames import (
    CAN_EFF_FLAG,
    CAN_EFF_MASK,
    CAN_ERR_FLAG,
    CAN_FRAME_BYTES,
    CAN_RTR_FLAG,
    CAN_SFF_MASK,
    CANFD_BRS,
    CANFD_ESI,
    CANFD_FDF,
    CANFD_FRAME_BYTES,
    CANFD_LENGTHS,
)
from swath.drivers.captures.base import (
    LATEST_NS,
    CapturedUnit,
    CaptureTally,
    read_beginning,
    read_lines,
    report,
    until_damage,
)
from swath.drivers.captures.can.clock import FileClock, FileTime, decimal_ns, local_time
from swath.drivers.transports.base import TransportError

_Shown = tuple[str, str, bytes | None]  # stamp, interface, frame

_LINE = re.compile(r"\(([^)]{1,40})\)\s+(\S+)\s+([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#(\S*)(?:\s+[RT])?")
# of candump -L with seconds since 1970: nearly every log consists of these, which are read in one step
_COMMON_LINE = re.compile(r"\((\d{1,11})\.(\d{1,9})\)\s+(\S+)\s+([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#(\S*)(?:\s+[RT])?")
_SHOWN = re.compile(
    r"(?:\(([^)]{1,40})\)\s+)?(\S+)\s+(?:[RT]X ([-B]) ([-E])\s+)?([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})\s+"
    r"(\[\d{1,2}\]|\{[0-9A-F]\})(?:\s+(\S.*))?"
)
_XL = re.compile(r"(?:\([^)]{1,40}\)\s+)?\S+\s+(?:[0-9A-Fa-f]{5}#|(?:[RT]X .. .\s+)?[0-9A-Fa-f]{3}\s+\[\d{4}\]\s).*")
_DROPPED = re.compile(r"DROPCOUNT: dropped (\d{1,10}) CAN frames? on .*")
_SECONDS = re.compile(r"(\d{1,11})\.(\d{1,9})")
_DATE = re.compile(r"(\d{4})-(\d\d)-(\d\d) (\d\d):(\d\d):(\d\d)\.(\d{1,9})")
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
_SINCE_START = "000"  # begins the first stamp of candump -t z and -t d, and none of -t a
_LOOKED_AT_BYTES, _LOOKED_AT_LINES = 65_536, 1000
_CLASSIC_FRAME = struct.Struct("<IBBBB8s")
_FD_FRAME = struct.Struct("<IBBxx64s")


def is_candump(line: str) -> bool:
    """Return whether a line has a form of candump: of ``-L``, or as it is shown to people without it."""
    return any(form.fullmatch(_COLOURS.sub("", line)) for form in (_LINE, _SHOWN, _DROPPED))


def candump_time(path: Path) -> FileTime:
    """Return the times that a log tells by ``-t a``, ``-t A``, ``-t z`` or ``-t d``, or none; UTC without a frame."""
    return _time_of([stamp for stamp, _, _ in _looked_at(path)])


def _time_of(stamps: list[str]) -> FileTime:
    if not stamps:
        return FileTime.UTC
    first = stamps[0]
    if _DATE.fullmatch(first):
        return FileTime.LOCAL
    seconds = _SECONDS.fullmatch(first)
    if seconds is None:
        return FileTime.NONE
    return FileTime.SINCE_BEGIN if seconds[1] == _SINCE_START else FileTime.UTC


def read_candump(
    path: Path | str, channel: str | None = None, tally: CaptureTally | None = None, clock: FileClock | None = None
) -> Iterator[CapturedUnit]:
    """Read the frames of candump's output, with or without ``-L``, as SocketCAN units of 16 or 72 bytes.

    Times of ``-t a`` are UTC, those of ``-t A`` local times, those of ``-t z`` and ``-t d`` count from the first frame.
    These two are told apart by whether the stamps ever decrease in the beginning of the file. Without ``-L``, the flags
    of an FD frame are known with ``-x`` only.

    Args:
        path: the file, possibly gzipped.
        channel: only frames of this interface.
        tally: counts lines that are no frame, and frames that candump reports as missed; where None, the former raise.
        clock: the zone of local times, and the time of the first frame where the file does not tell it.

    Raises:
        TransportError: the file cannot be read, or its times are unknown; without tally also: a line is not a frame,
            and the text names it.
    """
    return until_damage(_frames(Path(path), channel, tally, clock or FileClock()), tally)


class _Stamps:
    """Turns the stamps of a log into nanoseconds since 1970."""

    def __init__(self, path: Path, clock: FileClock) -> None:
        stamps = [stamp for stamp, _, _ in _looked_at(path)]
        self._path, self._clock, self._kind = path, clock, _time_of(stamps)
        if stamps and self._kind is FileTime.NONE:
            raise TransportError(f"{path}: its frames have no times; record with candump -L, or with -t a")
        self._is_delta = self._kind is FileTime.SINCE_BEGIN and _decreases(stamps)
        self._now_ns = clock.begin(None, path) if self._kind is FileTime.SINCE_BEGIN else 0

    @property
    def is_utc(self) -> bool:
        """True if the stamps are seconds since 1970."""
        return self._kind is FileTime.UTC

    def time_ns(self, text: str) -> int | None:
        """Return the time of a frame, or None where its stamp is not one of the file's form."""
        if self._kind is FileTime.LOCAL:
            return self._local(text)
        seconds = _SECONDS.fullmatch(text)
        if seconds is None:
            return None
        time_ns = int(seconds[1]) * 1_000_000_000 + int(seconds[2].ljust(9, "0"))
        if self._is_delta:
            self._now_ns += time_ns
            return self._now_ns
        return self._now_ns + time_ns

    def _local(self, text: str) -> int | None:
        date = _DATE.fullmatch(text)
        try:
            if date is None:
                return None
            second = local_time(*map(int, date.groups()[:6]))
            return self._clock.unix_ns(second) + int(date[7].ljust(9, "0"))
        except (ValueError, OverflowError):
            return None


def _decreases(stamps: list[str]) -> bool:
    """Return whether stamps are differences: times since the start never decrease, and do not stay equal."""
    found = [decimal_ns(stamp) for stamp in stamps if _SECONDS.fullmatch(stamp)]
    later = found[1:]
    falls = any(after < before for before, after in pairwise(later))
    return falls or (len(later) > 1 and 0 < min(later) == max(later))


def _looked_at(path: Path) -> list[_Shown]:
    lines = read_beginning(path, _LOOKED_AT_BYTES)[0].decode("ascii", "replace").splitlines()[:_LOOKED_AT_LINES]
    return [found for line in lines if (found := _parsed(_COLOURS.sub("", line).strip())) is not None]


def _frames(path: Path, channel: str | None, tally: CaptureTally | None, clock: FileClock) -> Iterator[CapturedUnit]:
    stamps, is_explained = _Stamps(path, clock), False
    for number, text in read_lines(path, tally):
        common = _COMMON_LINE.fullmatch(text) if stamps.is_utc else None
        if common is not None and (frame := _frame(common[4], common[5])) is not None:
            time_ns = int(common[1]) * 1_000_000_000 + int(common[2].ljust(9, "0"))
            if time_ns <= LATEST_NS:
                is_explained = False
                if channel is None or common[3] == channel:
                    yield CapturedUnit(time_ns, frame, common[3])
                continue
        if "\x1b" in text:
            text = _COLOURS.sub("", text).strip()
        parsed = _parsed(text)
        stamp_ns = stamps.time_ns(parsed[0]) if parsed is not None else None
        if parsed is not None and parsed[2] is not None and stamp_ns is not None and stamp_ns <= LATEST_NS:
            is_explained = text.endswith("ERRORFRAME")
            if channel is None or parsed[1] == channel:
                yield CapturedUnit(stamp_ns, parsed[2], parsed[1])
            continue
        dropped = _DROPPED.fullmatch(text)
        if dropped is not None and tally is not None:
            tally.passed["frames that candump missed"] += int(dropped[1])
        elif _XL.fullmatch(text) and tally is not None:
            tally.passed["CAN XL frames"] += 1
        elif parsed is None and is_explained and tally is not None:  # by candump -e
            tally.passed["lines that explain an error frame"] += 1
        else:
            why = ": its time has another form than the first" if parsed is not None and stamp_ns is None else ""
            report(tally, f"{path}: line {number} is not a frame of candump{why}: {text[:60]}")


def _parsed(text: str) -> _Shown | None:
    """Return stamp ("" where there is none), interface and frame of a line; the frame is None where it is invalid."""
    match = _LINE.fullmatch(text)
    if match is not None:
        return match[1], match[2], _frame(match[3], match[4])
    match = _SHOWN.fullmatch(text)
    if match is None:
        return None
    flags = (CANFD_BRS if match[3] == "B" else 0) | (CANFD_ESI if match[4] == "E" else 0)
    return match[1] or "", match[2], _shown_frame(_can_id(match[5]), match[6], match[7] or "", flags)


def _shown_frame(can_id: int, size: str, body: str, flags: int) -> bytes | None:
    """Build a frame from its length in brackets and the rest of the line, which may end in the data as characters."""
    is_fd, raw_length = len(size) == 4, int(size[1:-1], 16) if size.startswith("{") else int(size[1:-1])
    length = raw_length if is_fd or size.startswith("[") else min(raw_length, 8)
    if not is_fd and body.startswith("remote request"):
        return _CLASSIC_FRAME.pack(can_id | CAN_RTR_FLAG, length, 0, 0, raw_length if raw_length > 8 else 0, b"")
    parts = re.split("[ `]", body, maxsplit=length)[:length]
    if length > (64 if is_fd else 8) or len(parts) < length or len({*map(len, parts)}) > 1:
        return None
    base = {2: 16, 8: 2}.get(len(parts[0]), 0) if parts else 16
    try:
        data = bytes(int(part, base) for part in parts) if base else None
    except ValueError:
        return None
    if data is None or (is_fd and length not in CANFD_LENGTHS):
        return None
    if length > 1 and body[len(parts[0])] == "`":  # candump -S
        data = data[::-1]
    if is_fd:
        return _FD_FRAME.pack(can_id, length, flags | CANFD_FDF, data)
    return _CLASSIC_FRAME.pack(can_id, length, 0, 0, raw_length if raw_length > 8 else 0, data)


def _can_id(identifier: str) -> int:
    """Return the ``can_id`` word of an identifier of 3 or 8 digits."""
    can_id = int(identifier, 16)
    return can_id | CAN_EFF_FLAG if len(identifier) == 8 and not can_id & CAN_ERR_FLAG else can_id


def _frame(identifier: str, content: str) -> bytes | None:
    """Build one frame from its texts before and after ``#``; return None where they are not a frame."""
    can_id = _can_id(identifier)
    if content.startswith("#"):
        return _fd_frame(can_id, content[1:])
    if content.startswith("R"):
        length = content[1:2] or "0"
        return _CLASSIC_FRAME.pack(can_id | CAN_RTR_FLAG, int(length), 0, 0, 0, b"") if length in "012345678" else None
    content, _, raw_length = content.partition("_")  # the data length code of 8 bytes may be 9 to F
    data = _bytes(content)
    if data is None or len(data) > 8 or len(raw_length) > 1 or raw_length not in "9ABCDEFabcdef":
        return None
    return _CLASSIC_FRAME.pack(can_id, len(data), 0, 0, int(raw_length, 16) if raw_length else 0, data)


def _fd_frame(can_id: int, content: str) -> bytes | None:
    """Build a frame from ``##<flags><data>``: one hexadecimal digit of flags, then the data."""
    flags, data = _bytes("0" + content[:1]), _bytes(content[1:])
    if not flags or data is None or len(data) not in CANFD_LENGTHS:
        return None
    return _FD_FRAME.pack(can_id, len(data), flags[0] | CANFD_FDF, data)


def _bytes(text: str) -> bytes | None:
    try:
        return bytes.fromhex(text.replace(".", ""))
    except ValueError:
        return None


def candump_line(time_ns: int, channel: str, frame: bytes) -> str | None:
    """Format a frame as ``candump -L`` does, to the microsecond, with its line end; return None where no such form
    exists.

    Args:
        time_ns: since 1970, not negative.
        channel: the interface.
        frame: 16 or 72 bytes.
    """
    if len(frame) not in (CAN_FRAME_BYTES, CANFD_FRAME_BYTES):
        return None
    content = _classic_text(frame) if len(frame) == CAN_FRAME_BYTES else _fd_text(frame)
    if content is None:
        return None
    seconds, rest_ns = divmod(time_ns, 1_000_000_000)
    return f"({seconds:010d}.{rest_ns // 1000:06d}) {channel} {content}\n"


def _identifier_text(can_id: int) -> str:
    if can_id & CAN_ERR_FLAG:
        return f"{can_id & (CAN_ERR_FLAG | CAN_EFF_MASK):08X}"
    return f"{can_id & CAN_EFF_MASK:08X}" if can_id & CAN_EFF_FLAG else f"{can_id & CAN_SFF_MASK:03X}"


def _classic_text(frame: bytes) -> str | None:
    can_id, length, _, _, raw_length, data = _CLASSIC_FRAME.unpack(frame)
    if length > 8:
        return None
    identifier = _identifier_text(can_id)
    if can_id & CAN_RTR_FLAG and not can_id & CAN_ERR_FLAG:
        return f"{identifier}#R{length or ''}"
    suffix = f"_{raw_length:X}" if length == 8 and 8 < raw_length <= 15 else ""
    return f"{identifier}#{data[:length].hex().upper()}{suffix}"


def _fd_text(frame: bytes) -> str | None:
    can_id, length, flags, data = _FD_FRAME.unpack(frame)
    if length not in CANFD_LENGTHS:
        return None
    return f"{_identifier_text(can_id)}##{flags & 0xF:X}{data[:length].hex().upper()}"


def held_by_line(frame: bytes) -> bool:
    """Return whether the line of a frame reads back as the same bytes; a line does not hold reserved bytes and odd
    flags.
    """
    line = candump_line(0, "can", frame)
    match = _LINE.fullmatch(line.strip()) if line else None
    return match is not None and _frame(match[3], match[4]) == frame
