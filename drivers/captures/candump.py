"""Reads and writes logs in the form of ``candump -L`` of can-utils, one frame a line.

The form follows can-utils' lib.c (`parse_canframe`) and candump.c.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from pathlib import Path

from swath.drivers.can_frames import (
    CAN_EFF_FLAG,
    CAN_EFF_MASK,
    CAN_ERR_FLAG,
    CAN_FRAME_BYTES,
    CAN_RTR_FLAG,
    CAN_SFF_MASK,
    CANFD_FDF,
    CANFD_FRAME_BYTES,
    CANFD_LENGTHS,
)
from swath.drivers.captures.base import (
    LATEST_NS,
    CapturedUnit,
    CaptureTally,
    read_lines,
    report,
    until_damage,
)

_LINE = re.compile(r"\((\d{1,11})\.(\d{1,9})\)\s+(\S+)\s+([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#(\S*)(?:\s+[RT])?")
_SHOWN = re.compile(r"(?:\([^)]*\)\s+)?\S+\s+(?:[RT]X [-B] [-E]\s+)?[0-9A-Fa-f]{3,8}\s+\[\d{1,2}\](?:\s.*)?")
_DROPPED = re.compile(r"DROPCOUNT: dropped (\d{1,10}) CAN frames? on .*")
_CLASSIC_FRAME = struct.Struct("<IBBBB8s")
_FD_FRAME = struct.Struct("<IBBxx64s")


def is_candump(line: str) -> bool:
    """Return whether a line has the form of ``candump -L``."""
    return _LINE.fullmatch(line) is not None or _DROPPED.fullmatch(line) is not None


def is_shown_candump(line: str) -> bool:
    """Return whether a line has the form that candump prints without ``-L``, for people to read."""
    return _SHOWN.fullmatch(line) is not None


def read_candump(
    path: Path | str, channel: str | None = None, tally: CaptureTally | None = None
) -> Iterator[CapturedUnit]:
    """Read the frames of a ``candump -L`` log as SocketCAN units of 16 or 72 bytes.

    Args:
        path: the file, possibly gzipped.
        channel: only frames of this interface.
        tally: counts lines that are no frame, and frames that candump reports as missed; where None, the former raise.

    Raises:
        TransportError: the file cannot be read; without tally also: a line is not a frame, and the text names it.
    """
    return until_damage(_frames(Path(path), channel, tally), tally)


def _frames(path: Path, channel: str | None, tally: CaptureTally | None) -> Iterator[CapturedUnit]:
    for number, text in read_lines(path, tally):
        match = _LINE.fullmatch(text)
        frame = _frame(match[4], match[5]) if match else None
        time_ns = int(match[1]) * 1_000_000_000 + int(match[2].ljust(9, "0")) if match else 0
        dropped = _DROPPED.fullmatch(text)
        if dropped is not None and tally is not None:
            tally.passed["frames that candump missed"] += int(dropped[1])
        elif match is None or frame is None or time_ns > LATEST_NS:
            report(tally, f"{path}: line {number} is not a frame of candump -L: {text[:60]}")
        elif channel is None or match[3] == channel:
            yield CapturedUnit(time_ns, frame, match[3])


def _frame(identifier: str, content: str) -> bytes | None:
    """Build one frame from its texts before and after ``#``; return None where they are not a frame."""
    can_id = int(identifier, 16)
    if len(identifier) == 8 and not can_id & CAN_ERR_FLAG:
        can_id |= CAN_EFF_FLAG
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
    return match is not None and _frame(match[4], match[5]) == frame
