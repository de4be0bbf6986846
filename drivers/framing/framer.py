"""Finds frames of several protocols in one stream of bytes, with any other bytes between them.

One port often carries UBX, NMEA and RTCM3 together, or NovAtel logs with prompts between. The framer knows a table of
frame kinds (`swath.drivers.framing.kinds`); a new kind is an entry there.

Rules, the same however the stream is cut:

- A candidate is decided once, from the bytes after its start alone. Until then all bytes from it on are held back,
  at most ``FrameKind.max_bytes``, which bounds the delay that a false sync can cause.
- A frame with a good checksum is returned, and the scan continues after it.
- Otherwise one byte is skipped and the scan continues with the next, so that a good frame inside a false one is found.
- `close` decides on the bytes present.

One compiled expression searches the buffer; Python code runs once for each candidate, not for each byte.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swath.drivers.parser import ParserCounters

UNDECIDED = 0  # result of a measure: the bytes so far do not determine the length
FALSE_SYNC = -1  # … this is not a frame
MAX_NAMES = 1024  # names of messages that are counted separately; a receiver sends a few dozen
OTHER_NAMES = "other"
OVER_BOUND = -2  # … the stated length exceeds the protocol's longest frame; counted
NO_CHECKSUM = -3  # … a whole frame, but for its checksum; counted


class Frame(NamedTuple):
    """One frame with a good checksum.

    Attributes:
        kind: name of its `FrameKind`.
        host_time_ns: host time of the read that brought its last byte.
        data: all its bytes, sync and checksum included.
    """

    kind: str
    host_time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class FrameKind:
    """Describes how a protocol lays frames into a stream.

    Attributes:
        name: ``nmea``, ``ubx``, …
        sync: the bytes allowed at each of a frame's first positions.
        max_bytes: length of the longest frame, the most that a false sync can hold back.
        measure: ``(buffer, start, final)`` -> length of the frame at ``start`` in bytes, which may end beyond the
            buffer; or `UNDECIDED`, `FALSE_SYNC`, `OVER_BOUND`, `NO_CHECKSUM`. ``final`` means that the stream has
            ended.
        intact: whether the checksum of a complete frame is good.
        message_name: the name under which a good frame is counted.
        marks: returns, for up to twice ``max_bytes``, one number for each place between bytes; the numbers at two
            places are equal exactly where an intact frame may lie between. For a checksum that is too expensive to
            compute for each of many overlapping false frames; None for any other.
    """

    name: str
    sync: tuple[bytes, ...]
    max_bytes: int
    measure: Callable[[bytes, int, bool], int]
    intact: Callable[[bytes], bool]
    message_name: Callable[[bytes], str]
    marks: Callable[[bytes], NDArray[np.uint32]] | None = None

    def __deepcopy__(self, memo: dict[int, object]) -> FrameKind:
        """Return the same object: a kind never changes, so a parser's copy shares it."""
        return self


def sync_expression(kinds: Sequence[FrameKind]) -> re.Pattern[bytes]:
    """Return an expression with one group for each kind; it matches a whole sync, or the start of one at the buffer's
    end.
    """
    groups = []
    for kind in kinds:
        expression = b""
        for allowed in reversed(kind.sync):
            one = b"[" + b"".join(b"\\x%02x" % byte for byte in allowed) + b"]"
            expression = one + (b"(?:\\Z|" + expression + b")" if expression else b"")
        groups.append(b"(" + expression + b")")
    return re.compile(b"|".join(groups), re.DOTALL)


class _Overlaps:
    """Checks the frames of one buffer whose kind has marks; frames that overlap a bad one share one table of marks."""

    def __init__(self, buffer: bytes) -> None:
        self._buffer = buffer
        self._bad_end = 0  # furthest end of the bad frames so far
        self._kind: FrameKind | None = None  # the kind that computed the marks
        self._marks = memoryview(b"")
        self._marked = 0  # the place of the first mark

    def intact(self, kind: FrameKind, start: int, data: bytes) -> bool:
        """Return whether the checksum of a complete frame is good."""
        assert kind.marks is not None
        end = start + len(data)
        if start >= self._bad_end:
            good = kind.intact(data)
        else:
            if kind is not self._kind or end - self._marked >= len(self._marks):
                self._kind, self._marked = kind, start
                self._marks = kind.marks(self._buffer[start : start + 2 * kind.max_bytes]).data
            good = self._marks[start - self._marked] == self._marks[end - self._marked]
        if not good:
            self._bad_end = max(self._bad_end, end)
        return good


class Framer:
    """Scans a bounded buffer for frames and updates the parser's counters.

    Args:
        kinds: the kinds to look for, from `swath.drivers.framing.kinds`.
        counters: the framer updates bytes, bytes_framed, bytes_skipped, messages, bad_checksums and errors.
    """

    def __init__(self, kinds: Sequence[FrameKind], counters: ParserCounters) -> None:
        self.counters = counters
        self._kinds = tuple(kinds)
        self._search = sync_expression(kinds).search
        self._pieces: list[bytes] = []
        self._held = 0  # bytes in the pieces
        self._needed = 0  # held bytes below which a scan cannot decide
        self._offset = 0  # stream offset of the first held byte
        self._arrivals: deque[tuple[int, int]] = deque()  # (stream offset after a read, its host time)

    def feed(self, data: bytes, host_time_ns: int) -> list[Frame]:
        """Take one read; return the frames that it completed, in order."""
        self.counters.bytes += len(data)
        self._pieces.append(data)
        self._held += len(data)
        self._arrivals.append((self._offset + self._held, host_time_ns))
        return self._scan(final=False) if self._held >= self._needed else []

    def close(self) -> list[Frame]:
        """Return the frames still held back behind a false sync at the end of the stream; the other bytes count as
        skipped.
        """
        return self._scan(final=True)

    def _scan(self, *, final: bool) -> list[Frame]:
        buffer = self._pieces[0] if len(self._pieces) == 1 else b"".join(self._pieces)
        frames: list[Frame] = []
        overlaps, messages = _Overlaps(buffer), self.counters.messages
        position, framed = 0, 0
        self._needed = 0
        while match := self._search(buffer, position):
            start = match.start()
            kind = self._kinds[(match.lastindex or 1) - 1]
            length = kind.measure(buffer, start, final)
            end = start + length
            if length <= 0 or end > len(buffer):
                if needed := self._without_end(kind, length, len(buffer) - start, final):
                    position, self._needed = start, needed
                    break
                position = start + 1
                continue
            data = buffer[start:end]
            if kind.intact(data) if kind.marks is None else overlaps.intact(kind, start, data):
                frames.append(Frame(kind.name, self._arrival(self._offset + end), data))
                name = kind.message_name(data)  # noise can make any name: the surplus shares one
                messages[name if name in messages or len(messages) < MAX_NAMES else OTHER_NAMES] += 1
                framed += end - start
                position = end
            else:
                self.counters.bad_checksums += 1
                position = start + 1
        else:
            position = len(buffer)
        self._release(buffer, position, framed)
        return frames

    def _without_end(self, kind: FrameKind, length: int, there: int, final: bool) -> int:
        """Return how many bytes to wait for from the candidate's start; 0 if it is not a frame. ``there`` bytes are
        present.
        """
        if length == UNDECIDED:
            length = there + 1
        elif length == OVER_BOUND:
            self.counters.errors[f"{kind.name}_length_over_bound"] += 1
        elif length == NO_CHECKSUM:
            self.counters.errors[f"{kind.name}_without_checksum"] += 1
        return 0 if final or length < 0 else length

    def _arrival(self, end_offset: int) -> int:
        """Return the host time of the read that brought the byte before ``end_offset``."""
        while self._arrivals[0][0] < end_offset:
            self._arrivals.popleft()
        return self._arrivals[0][1]

    def _release(self, buffer: bytes, position: int, framed: int) -> None:
        """Forget the first ``position`` bytes; those in no frame count as skipped."""
        self.counters.bytes_framed += framed
        self.counters.bytes_skipped += position - framed
        self._offset += position
        self._pieces = [buffer[position:]] if position < len(buffer) else []
        self._held = len(buffer) - position
        while self._arrivals and self._arrivals[0][0] <= self._offset:
            self._arrivals.popleft()
