"""The contract of every transport: bytes with the kernel's time, no meaning.

A transport is opened, read by one thread and closed. Its reads block for at most the time given, so that the thread
that reads can always say that it is alive. A device that is absent or has gone raises `TransportError` with one
line; the session that owns the transport closes it, waits and opens it again.
"""

from __future__ import annotations

import errno
import termios
from abc import ABC, abstractmethod
from dataclasses import dataclass

from swath.georef.records import ByteRows, Int64Array

HEAD_ROOM_BYTES = 31  # of a message's header in the log: opcode, length, channel, sequence, two times (MCAP)


class TransportError(OSError):
    """The device cannot be opened or has gone; the text is one line: what, where, what would be right."""


def is_no_serial_port(error: BaseException) -> bool:
    """Return whether a port could not be set because it is none: ENOTTY in or below what pyserial raises."""
    below: BaseException | None = error
    while below is not None:
        if isinstance(below, OSError | termios.error) and below.args[:1] == (errno.ENOTTY,):
            return True
        below = below.__cause__ or below.__context__
    return False


@dataclass(slots=True)
class UnitBlock:
    """Consecutive units of equal length from one sender, as the kernel handed them over.

    Attributes:
        units: (n, length) uint8, one row a unit; owned by the receiver of the block until its next read.
        kernel_realtime_ns: (n,) CLOCK_REALTIME receive stamps; None where the kernel gives none (serial), and 0 in
            the rows that came without one.
        peer: (address, port) of a UDP sender; None elsewhere.
        rows: (n, `HEAD_ROOM_BYTES` + length) the memory that ``units`` lie in, without gaps, the receiver's for good:
            the room before each unit may be written to. None where there is no such room.
    """

    units: ByteRows
    kernel_realtime_ns: Int64Array | None = None
    peer: tuple[str, int] | None = None
    rows: ByteRows | None = None


@dataclass(slots=True)
class TransportCounters:
    """What the kernel says of itself, cumulative since `Transport.open`.

    Attributes:
        lost_kernel: units the kernel dropped at the socket or descriptor.
        receive_buffer_bytes: what was granted, read back; 0 where there is no such thing.
        error_frames, bus_off: CAN controller trouble.
        receive_buffer_asked_bytes: what was asked for; more than was granted means that the system's limit is lower.
        refused: what arrived and is no unit: datagrams of other senders, lines or messages nobody can read.
        line_errors: framing, parity and overrun errors of a serial line; bytes are missing or wrong, not units.
    """

    lost_kernel: int = 0
    receive_buffer_bytes: int = 0
    error_frames: int = 0
    bus_off: int = 0
    receive_buffer_asked_bytes: int = 0
    refused: int = 0
    line_errors: int = 0


class Transport(ABC):
    """One port, socket or bus."""

    def __init__(self) -> None:
        self.counters = TransportCounters()

    @abstractmethod
    def open(self) -> None:
        """Open the device.

        Raises:
            TransportError: it is absent, busy, or not permitted.
        """

    @abstractmethod
    def receive(self, timeout_s: float) -> list[UnitBlock]:
        """Wait at most ``timeout_s`` and hand over what there is, in order; an empty list on silence.

        Raises:
            TransportError: the device has gone.
        """

    @abstractmethod
    def send(self, data: bytes) -> None:
        """Send one unit (bytes to a port, a datagram, a SocketCAN frame of 16 or 72 bytes).

        Raises:
            TransportError: the device has gone.
        """

    @abstractmethod
    def close(self) -> None:
        """Close; a second call does nothing."""

    def poll_counters(self) -> TransportCounters:
        """Return counters brought up to date with the kernel's."""
        return self.counters


@dataclass(frozen=True, slots=True)
class RawEdge:
    """One PPS edge as the kernel or the line gave it, CLOCK_REALTIME."""

    realtime_ns: int
    sequence: int
    edge: str  # "assert" or "clear"
    kernel_stamp: bool = True  # False: stamped in user space after a wake-up (TIOCMIWAIT)


class PpsSource(ABC):
    """A source of edges; the same life as a `Transport`."""

    @abstractmethod
    def open(self) -> None:
        """Open the source; raises `TransportError`."""

    @abstractmethod
    def receive(self, timeout_s: float) -> list[RawEdge]:
        """Wait at most ``timeout_s`` for edges not yet handed over; an empty list on silence."""

    def poll_counters(self) -> TransportCounters:
        """Return what came and is no edge; nothing, of a source that gives edges only."""
        return TransportCounters()

    @abstractmethod
    def close(self) -> None:
        """Close; a second call does nothing."""
