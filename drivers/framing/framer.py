"""Finds frames of several protocols in one stream of bytes, whatever lies between them.

One port often carries UBX, NMEA and RTCM3 together, or NovAtel logs with prompts between. The framer knows a table of
frame kinds (`swath.drivers.framing.kinds`); a new kind is an entry there.

Rules, the same however the stream is cut:

- A candidate is decided once, from the bytes behind it alone. Until then everything from it on is held back, which is
  at most ``FrameKind.max_bytes``: a false sync costs no more delay than that.
- A frame whose checksum is good is handed out and the scan goes on behind it.
- Otherwise one byte is skipped and the scan goes on with the next: a good frame inside a false one is found.
- `close` decides as if nothing more ever came.

Searching is one compiled expression over the buffer; Python code runs once a candidate, not once a byte.
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

UNDECIDED = 0  # what a measure says while the bytes there are do not tell the length
FALSE_SYNC = -1  # … when this is no frame after all
MAX_NAMES = 1024  # of messages that are counted each by itself; a receiver sends a few dozen
OTHER_NAMES = "other"
OVER_BOUND = -2  # … when the length it claims is beyond what the protocol knows; counted


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
    """A protocol's way to lay frames into a stream.

    Attributes:
        name: ``nmea``, ``ubx``, …
        sync: the bytes allowed at each of the first places of a frame.
        max_bytes: the longest frame; what a false sync can hold back.
        measure: ``(buffer, start, final)`` -> length of the frame at ``start`` in bytes, which may reach beyond the
            buffer; or `UNDECIDED`, `FALSE_SYNC`, `OVER_BOUND`. With ``final`` nothing more will come.
        intact: whether the checksum of a complete frame is good.
        message_name: what a good frame is counted as.
        marks: of up to twice ``max_bytes``, a number a place between them; those at two places are equal just where an
            intact frame may lie between. For a checksum that is dear to make anew for each of many false frames that
            overlap; None: it is not.
    """

    name: str
    sync: tuple[bytes, ...]
    max_bytes: int
    measure: Callable[[bytes, int, bool], int]
    intact: Callable[[bytes], bool]
    message_name: Callable[[bytes], str]
    marks: Callable[[bytes], NDArray[np.uint32]] | None = None

    def __deepcopy__(self, memo: dict[int, object]) -> FrameKind:
        """Return a kind never changes: a parser's copy shares it."""
        return self


def sync_expression(kinds: Sequence[FrameKind]) -> re.Pattern[bytes]:
    """Return one group a kind; matches a whole sync, or the beginning of one at the end of the buffer."""
    groups = []
    for kind in kinds:
        expression = b""
        for allowed in reversed(kind.sync):
            one = b"[" + b"".join(b"\\x%02x" % byte for byte in allowed) + b"]"
            expression = one + (b"(?:\\Z|" + expression + b")" if expression else b"")
        groups.append(b"(" + expression + b")")
    return re.compile(b"|".join(groups), re.DOTALL)


class _Overlaps:
    """The frames of one buffer whose kind has marks; those that overlap a bad one share the work of their checksums."""

    def __init__(self, buffer: bytes) -> None:
        self._buffer = buffer
        self._bad_end = 0  # of the bad frames so far
        self._kind: FrameKind | None = None  # whose marks these are
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
    """A bounded buffer and the scan over it; counts into the parser's counters.

    Args:
        kinds: what may come, `swath.drivers.framing.kinds`.
        counters: bytes, bytes_framed, bytes_skipped, messages, bad_checksums and errors are kept here.
    """

    def __init__(self, kinds: Sequence[FrameKind], counters: ParserCounters) -> None:
        self.counters = counters
        self._kinds = tuple(kinds)
        self._search = sync_expression(kinds).search
        self._pieces: list[bytes] = []
        self._held = 0  # bytes in the pieces
        self._needed = 0  # fewer held bytes decide nothing
        self._offset = 0  # stream offset of the first held byte
        self._arrivals: deque[tuple[int, int]] = deque()  # (stream offset behind a read, its host time)

    def feed(self, data: bytes, host_time_ns: int) -> list[Frame]:
        """Take one read; return the frames it completed, in order."""
        self.counters.bytes += len(data)
        self._pieces.append(data)
        self._held += len(data)
        self._arrivals.append((self._offset + self._held, host_time_ns))
        return self._scan(final=False) if self._held >= self._needed else []

    def close(self) -> list[Frame]:
        """Return the stream has ended: frames still held back behind a false sync; the rest is skipped."""
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
                name = kind.message_name(data)  # noise makes any: those beyond what devices have are one
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
        """Return bytes to wait for from the candidate's start on, of which some are there; 0 if it is no frame."""
        if length == UNDECIDED:
            length = there + 1
        elif length == OVER_BOUND:
            self.counters.errors[f"{kind.name}_length_over_bound"] += 1
        return 0 if final or length < 0 else length

    def _arrival(self, end_offset: int) -> int:
        """Return host time of the read that brought the byte before ``end_offset``."""
        while self._arrivals[0][0] < end_offset:
            self._arrivals.popleft()
        return self._arrivals[0][1]

    def _release(self, buffer: bytes, position: int, framed: int) -> None:
        """Forget the first ``position`` bytes; what of them was in no frame is skipped."""
        self.counters.bytes_framed += framed
        self.counters.bytes_skipped += position - framed
        self._offset += position
        self._pieces = [buffer[position:]] if position < len(buffer) else []
        self._held = len(buffer) - position
        while self._arrivals and self._arrivals[0][0] <= self._offset:
            self._arrivals.popleft()
