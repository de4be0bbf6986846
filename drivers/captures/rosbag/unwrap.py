"""Takes devices' units out of ROS messages, serialised as CDR (ROS 2) or in the form of ROS 1.

CDR: OMG formal/02-06-51 (15.3) behind the four bytes of encapsulation of DDSI-RTPS (OMG formal/2022-04-01, 10.2): a
number is aligned to its size, from the end of these bytes. ROS 1 aligns nothing.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from swath.drivers.can_frames import (
    CAN_EFF_FLAG,
    CAN_EFF_MASK,
    CAN_ERR_FLAG,
    CAN_RTR_FLAG,
    CANFD_FDF,
    CANFD_LENGTHS,
)
from swath.drivers.captures.rosbag.messages import SENTENCE, RawType
from swath.georef.timescales import SECOND_NS

_CLASSIC_FRAME, _FD_FRAME = struct.Struct("<IBBxx8s"), struct.Struct("<IBBxx64s")
_PAYLOADS = ("data", "buf", "message_data", "message", "sentence")  # the fields that hold the bytes, by message


class Unit(NamedTuple):
    """One unit of a message.

    Attributes:
        stamp_ns: the message's own time of it, nanoseconds since 1970; 0: the message has none.
        data: its bytes; None: the message contradicts itself about it.
        second: it came from the head's second port.
    """

    stamp_ns: int
    data: bytes | None
    second: bool = False


class Form(Protocol):
    """One way to read a message."""

    def units(self, data: bytes) -> Iterable[Unit]:
        """Return the units of a message; raise ValueError if the message does not have this form."""


class Unwrapper:
    """Takes the units out of the messages of one topic, whose form is the first that fits."""

    def __init__(self, forms: Sequence[Form]) -> None:
        self._forms = list(forms)

    def units(self, data: bytes) -> list[Unit]:
        """Return the units of a message.

        Raises:
            ValueError: the message fits no form.
        """
        first: ValueError | None = None
        for number, form in enumerate(self._forms):
            try:
                found = list(form.units(data))
            except (ValueError, AttributeError, TypeError, struct.error) as error:  # fields are missing, or others
                first = first or ValueError(str(error))
                continue
            if number:
                self._forms.insert(0, self._forms.pop(number))
            return found
        raise first or ValueError("its definition is unknown")


class Decoded:
    """Reads messages of any definition, by a function that decodes them into objects."""

    def __init__(self, raw: RawType, decode: Any) -> None:
        self._raw = raw
        self._decode = decode

    def units(self, data: bytes) -> Iterator[Unit]:
        """Return the units of a message; raises ValueError."""
        message = self._decode(data)
        if self._raw.carries == "can":
            yield Unit(_stamp_ns(message), _can_frame(message))
            return
        for packet in getattr(message, "packets", [getattr(message, "packet", message)]):
            payload = next((getattr(packet, name) for name in _PAYLOADS if hasattr(packet, name)), None)
            if payload is None:
                raise ValueError(f"has none of the fields {', '.join(_PAYLOADS)}")
            size = getattr(packet, "size", len(payload))
            content = payload[:size].tobytes() if size <= len(payload) else None
            if self._raw.name == SENTENCE and content is not None:
                content = _line(content)
            yield Unit(_stamp_ns(packet), content, bool(getattr(packet, "is_difop", 0)))


def _stamp_ns(packet: Any) -> int:
    """Return the packet's own stamp, or that of its header; 0 if it has neither."""
    stamp = getattr(packet, "stamp", None) or getattr(getattr(packet, "header", None), "stamp", None)
    return 0 if stamp is None else int(stamp.sec) * SECOND_NS + int(stamp.nanosec)


def _line(sentence: bytes) -> bytes:
    """Return a sentence as a line, as it was on the wire: messages hold it with or without the line's end."""
    text = sentence.rstrip(b"\0")
    return text if text.endswith(b"\n") else text.rstrip(b"\r") + b"\r\n"


def _can_frame(message: Any) -> bytes | None:
    """Return the frame as SocketCAN has it; None if its length is impossible."""
    can_id = int(message.id) & (CAN_EFF_FLAG | CAN_RTR_FLAG | CAN_ERR_FLAG | CAN_EFF_MASK)
    can_id |= CAN_EFF_FLAG if message.is_extended else 0
    can_id |= CAN_ERR_FLAG if message.is_error else 0
    data = message.data.tobytes()
    if hasattr(message, "len"):
        length = int(message.len)
        fits = length in CANFD_LENGTHS and length <= len(data) <= 64
        return _FD_FRAME.pack(can_id, length, CANFD_FDF, data) if fits else None
    can_id |= CAN_RTR_FLAG if message.is_rtr else 0
    return _CLASSIC_FRAME.pack(can_id, message.dlc, 0, data) if message.dlc <= 8 else None


@dataclass(frozen=True, slots=True)
class Packets:
    """Reads messages of packets without an object for each: ``[Header] packets[]``, each ``stamp data [size]``.

    Attributes:
        ros2: serialised as CDR.
        header: the message begins with a header.
        length: bytes of the field ``data`` of every packet; None: each packet says it.
        sized: the field ``size`` follows, the number of those bytes that the packet has.
    """

    ros2: bool
    header: bool
    length: int | None
    sized: bool

    def units(self, data: bytes) -> Iterable[Unit]:
        """Return the units of a message; raises ValueError."""
        try:
            if self.length is None:
                return self._varying(data)
            return self._equal(data, self.length)
        except struct.error as error:
            raise ValueError("ends in a packet") from error

    def _begin(self, data: bytes) -> tuple[str, int, int]:
        """Return the byte order, the number of packets, and where the first one begins."""
        order, at = "<", 0
        if self.ros2:
            if data[:2] not in (b"\0\0", b"\0\1"):
                raise ValueError("is not CDR; if its messages are compressed, give the folder of the bag")
            order, at = "<" if data[1] else ">", 4
        if self.header:  # stamp (ROS 1: behind a number), name of the frame
            at += 8 if self.ros2 else 12
            at = self._aligned(at + 4 + struct.unpack_from(order + "I", data, at)[0])
        return order, struct.unpack_from(order + "I", data, at)[0], at + 4

    def _aligned(self, at: int) -> int:
        return (at + 3) & ~3 if self.ros2 else at

    def _end(self, data: bytes, end: int) -> None:
        if not 0 <= len(data) - end <= (3 if self.ros2 else 0):
            raise ValueError(f"has {len(data)} bytes, but its packets end at {end}")

    def _equal(self, data: bytes, length: int) -> Iterable[Unit]:
        order, count, at = self._begin(data)
        size_at = self._aligned(8 + length)
        last = size_at + 4 if self.sized else 8 + length
        stride = self._aligned(last)
        self._end(data, at + (count - 1) * stride + last if count else at)
        if not count:
            return []
        kind = order + ("i4" if self.ros2 else "u4")
        stamps = np.ndarray((count, 2), kind, data, at, (stride, 4)).astype(np.int64)
        stamps_ns = (stamps[:, 0] * SECOND_NS + (stamps[:, 1] & 0xFFFF_FFFF)).tolist()
        begins = range(at + 8, at + 8 + count * stride, stride)
        if not self.sized:
            return [Unit(time, data[begin : begin + length]) for time, begin in zip(stamps_ns, begins, strict=True)]
        sizes = np.ndarray((count,), order + "u4", data, at + size_at, (stride,)).tolist()
        return [
            Unit(time, data[begin : begin + size] if size <= length else None)
            for time, begin, size in zip(stamps_ns, begins, sizes, strict=True)
        ]

    def _varying(self, data: bytes) -> list[Unit]:
        order, count, at = self._begin(data)
        head = struct.Struct(order + ("iII" if self.ros2 else "III"))
        size_of = struct.Struct(order + "I")
        found, end = [], at
        for _ in range(count):
            seconds, rest_ns, length = head.unpack_from(data, at)
            begin = at + head.size
            end, size = begin + length, length
            if self.sized:
                end = self._aligned(end) + 4
                size = size_of.unpack_from(data, end - 4)[0]
            payload = data[begin : begin + size] if size <= length else None
            found.append(Unit(seconds * SECOND_NS + rest_ns, payload))
            at = self._aligned(end)
        self._end(data, end)
        return found
