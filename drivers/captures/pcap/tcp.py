"""Puts the segments of TCP connections together to the streams that the receiving program read (RFC 9293, 3.4, 3.8).

Each direction of a connection is a stream of its own. A segment in sequence is delivered at once, with its own stamp.
One that came too early waits until the bytes before it arrive, and has the stamp of the packet that brought them,
because before that the receiving program could not read it. Bytes that the receiver acknowledged although the capture
does not hold them are a gap: it is reported with its size, and what follows it keeps its own stamps.
"""

from __future__ import annotations

import struct
from bisect import bisect_left, insort
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import NamedTuple

from swath.drivers.captures.base import Address

_HEADER = struct.Struct(">HHIIBB")  # ports, sequence number, acknowledgement number, length of the header, flags
_HEADER_BYTES = 20
FIN, SYN, RST, ACK = 0x01, 0x02, 0x04, 0x10
_NUMBERS = 1 << 32

ACKNOWLEDGED_NS = 100_000_000  # a packet may be captured so long after the acknowledgement of what it brings
WAITED_NS = 10_000_000_000  # without acknowledgements: a receiver waits no longer for a retransmission
MOST_AHEAD = 1 << 26  # bytes between two segments of one connection; farther is another connection
MAX_HELD_BYTES = 8 << 20  # waiting in all connections, above any receive window in common use
MAX_HELD_SEGMENTS = 4096  # waiting in one stream
MAX_STREAMS = 1024
_RECENT_BYTES = 1 << 17  # delivered bytes of a stream with which repeated ones are compared
_RECENT_SEGMENTS = 64


class TcpSegment(NamedTuple):
    """One segment with its addresses."""

    source: Address
    destination: Address
    sequence: int
    acknowledged: int
    flags: int
    data: bytes


class Delivered(NamedTuple):
    """Bytes of a stream, in sequence."""

    time_ns: int
    source: Address
    destination: Address
    data: bytes


def parse_segment(source: str, destination: str, segment: bytes) -> TcpSegment | None:
    """Return the segment behind an IP header; None where it is too short to be one."""
    if len(segment) < _HEADER_BYTES:
        return None
    from_port, to_port, sequence, acknowledged, length, flags = _HEADER.unpack_from(segment)
    at = (length >> 4) * 4
    if not _HEADER_BYTES <= at <= len(segment):
        return None
    return TcpSegment((source, from_port), (destination, to_port), sequence, acknowledged, flags, segment[at:])


class _Stream:
    """One direction of a connection. Positions count on beyond 32 bits; ``next`` is the next byte to deliver."""

    __slots__ = ("acknowledged", "acknowledged_ns", "at_first", "begun", "held", "next", "recent", "recent_bytes")

    def __init__(self) -> None:
        self.begun = False
        self.next = self.at_first = self.acknowledged = 0
        self.held: list[tuple[int, int, bytes]] = []  # position, stamp, data; by position
        self.recent_bytes = 0
        self.acknowledged_ns: int | None = None  # when a byte that has not come was first acknowledged
        self.recent: deque[tuple[int, bytes]] = deque()

    def begin(self, sequence: int) -> None:
        """Begin at a sequence number, forgetting all before."""
        self.begun = True
        self.next = self.at_first = self.acknowledged = _NUMBERS + sequence
        self.acknowledged_ns = None
        self.recent.clear()
        self.recent_bytes = 0

    def place(self, sequence: int) -> int:
        """Return the position of a sequence number, within 2^31 of the next byte."""
        return self.next + (sequence - self.next + _NUMBERS // 2) % _NUMBERS - _NUMBERS // 2

    def acknowledge(self, time_ns: int, sequence: int) -> None:
        """Note that the receiver has all bytes before a sequence number."""
        at = self.place(sequence)
        if self.next < at < self.next + MOST_AHEAD:
            self.acknowledged = max(self.acknowledged, at)
            if self.acknowledged_ns is None:
                self.acknowledged_ns = time_ns

    def go_on(self, at: int) -> None:
        """Go on with a byte."""
        self.next = at
        if self.acknowledged <= at:
            self.acknowledged_ns = None

    def remember(self, at: int, data: bytes) -> None:
        self.recent.append((at, data))
        self.recent_bytes += len(data)
        while self.recent_bytes > _RECENT_BYTES or len(self.recent) > _RECENT_SEGMENTS:
            self.recent_bytes -= len(self.recent.popleft()[1])

    def differs(self, at: int, data: bytes) -> bool:
        """Return whether repeated bytes differ from the delivered ones, as far as these are remembered."""
        for start, known in self.recent:
            low, high = max(at, start), min(at + len(data), start + len(known))
            if low < high and known[low - start : high - start] != data[low - at : high - at]:
                return True
        return False


class TcpStreams:
    """Assembles streams; memory is bounded, however many connections and gaps there are.

    Args:
        report: called with one line for each gap.

    Attributes:
        missing: bytes in gaps.
        repeated: bytes that came again; the first ones count.
        earlier: bytes that come again from before the first captured segment of a stream.
        differing: segments that came again with other bytes.
        middles: streams whose beginning was not captured.
    """

    def __init__(self, report: Callable[[str], None]) -> None:
        self.missing = self.repeated = self.earlier = self.differing = self.middles = 0
        self._report = report
        self._streams: OrderedDict[tuple[Address, Address], _Stream] = OrderedDict()
        self._held_bytes = 0
        self._out: list[Delivered] = []

    def add(self, time_ns: int, segment: TcpSegment) -> list[Delivered]:
        """Take a segment of a wanted stream; return the bytes that it lets follow."""
        key = segment.source, segment.destination
        stream = self._stream(key)
        if segment.flags & RST:  # its data are a reason in words, and its number may be any
            self._give_up_all(key, stream)
            return self._taken()
        sequence = segment.sequence
        if segment.flags & SYN:
            sequence = (sequence + 1) % _NUMBERS
            if not stream.begun or stream.place(sequence) != stream.at_first:
                self._give_up_all(key, stream)
                stream.begin(sequence)
        elif not stream.begun:
            stream.begin(sequence)
            self.middles += 1
        if segment.data and not self._probes(stream, sequence, segment):
            self._place(key, stream, time_ns, sequence, segment.data)
        self._look_after(key, stream, time_ns)
        return self._taken()

    def answer(self, time_ns: int, segment: TcpSegment) -> list[Delivered]:
        """Take a segment of the other direction, which acknowledges; return the bytes that follow a gap given up."""
        key = segment.destination, segment.source
        stream = self._streams.get(key)
        if stream is None:
            return []
        if segment.flags & RST:
            self._give_up_all(key, stream)
        elif segment.flags & ACK:
            stream.acknowledge(time_ns, segment.acknowledged)
            self._look_after(key, stream, time_ns)
        return self._taken()

    def finish(self) -> list[Delivered]:
        """Return what still waits, when the capture ends."""
        for key, stream in self._streams.items():
            self._give_up_all(key, stream)
        return self._taken()

    def _taken(self) -> list[Delivered]:
        out, self._out = self._out, []
        return out

    def _stream(self, key: tuple[Address, Address]) -> _Stream:
        stream = self._streams.get(key)
        if stream is None:
            stream = self._streams[key] = _Stream()
            if len(self._streams) > MAX_STREAMS:
                oldest, left = self._streams.popitem(last=False)
                self._give_up_all(oldest, left)
        else:
            self._streams.move_to_end(key)
        return stream

    def _probes(self, stream: _Stream, sequence: int, segment: TcpSegment) -> bool:
        """Return whether a segment is a keep-alive: one byte of no meaning before the next (RFC 1122, 4.2.3.6)."""
        is_before = len(segment.data) == 1 and stream.place(sequence) == stream.next - 1
        return is_before and not segment.flags & (SYN | FIN)

    def _place(self, key: tuple[Address, Address], stream: _Stream, time_ns: int, sequence: int, data: bytes) -> None:
        at = stream.place(sequence)
        if abs(at - stream.next) > MOST_AHEAD:
            self._give_up_all(key, stream)
            self._report(
                f"the TCP stream from {_text(key[0])} to {_text(key[1])} goes on elsewhere: the beginning of another "
                "connection was not captured"
            )
            stream.begin(sequence)
            at = stream.next
        if at > stream.next:
            before = bisect_left(stream.held, (at,))
            if before < len(stream.held) and stream.held[before][0] == at and len(stream.held[before][2]) == len(data):
                self.repeated += len(data)
                return
            insort(stream.held, (at, time_ns, data))
            self._held_bytes += len(data)
            return
        self._deliver(key, stream, time_ns, at, data)
        while stream.held and stream.held[0][0] <= stream.next:  # the gap is filled
            at, held_ns, data = stream.held.pop(0)
            self._held_bytes -= len(data)
            self._deliver(key, stream, max(time_ns, held_ns), at, data)

    def _deliver(self, key: tuple[Address, Address], stream: _Stream, time_ns: int, at: int, data: bytes) -> None:
        """Add the new bytes of a segment that begins at or before the next byte to the output."""
        again = min(len(data), stream.next - at)
        if at + again <= stream.at_first:
            self.earlier += again
        elif again:
            self.repeated += again
            self.differing += stream.differs(at, data[:again])
        if data := data[again:]:
            stream.remember(at + again, data)
            stream.go_on(at + again + len(data))
            self._out.append(Delivered(time_ns, *key, data))

    def _look_after(self, key: tuple[Address, Address], stream: _Stream, time_ns: int) -> None:
        """Give up the gap of a stream if it cannot be filled any more, or if too much waits for it."""
        while stream.held:
            known_ns = stream.acknowledged_ns
            acknowledged = known_ns is not None and abs(time_ns - known_ns) >= ACKNOWLEDGED_NS
            waited = abs(time_ns - stream.held[0][1]) >= WAITED_NS
            is_much = self._held_bytes > MAX_HELD_BYTES or len(stream.held) > MAX_HELD_SEGMENTS
            if not acknowledged and not waited and not is_much:
                return
            self._give_up(key, stream)

    def _give_up_all(self, key: tuple[Address, Address], stream: _Stream) -> None:
        while stream.held:
            self._give_up(key, stream)

    def _give_up(self, key: tuple[Address, Address], stream: _Stream) -> None:
        """Report the gap before the first waiting bytes, and deliver these up to the next gap with their own stamps."""
        count, latest_ns = stream.held[0][0] - stream.next, 0
        self.missing += count
        self._report(f"{count} bytes of the TCP stream from {_text(key[0])} to {_text(key[1])} were not captured")
        stream.go_on(stream.held[0][0])
        while stream.held and stream.held[0][0] <= stream.next:
            at, held_ns, data = stream.held.pop(0)
            self._held_bytes -= len(data)
            latest_ns = max(latest_ns, held_ns)
            self._deliver(key, stream, latest_ns, at, data)


def _text(address: Address) -> str:
    host, port = address
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
