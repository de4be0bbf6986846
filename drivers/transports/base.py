"""The contract of every transport: bytes with the kernel's time, no meaning.

A transport is opened, read by one thread and closed. Its reads block for at most the given time, so that the reading
thread can always report that it is alive. A device that is absent or has gone raises `TransportError` with one line;
the session that owns the transport closes it, waits and opens it again.
"""

from __future__ import annotations

import errno
import termios
from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import dataclass, field

from swath.georef.arrays import Int64Array
from swath.georef.records import ByteRows

MOST_SENDERS = 256  # that are counted by name; a port scanner must not fill the memory
SENDERS_SHOWN = 3
HEAD_ROOM_BYTES = 31  # size of a message's header in the log: opcode, length, channel, sequence, two times (MCAP)


class TransportError(OSError):
    """The device cannot be opened or has gone; the text is one line with the cause, the place and the remedy."""


def is_no_serial_port(error: BaseException) -> bool:
    """Return whether a port could not be set because it is not a serial port: ENOTTY in or below pyserial's error."""
    below: BaseException | None = error
    while below is not None:
        if isinstance(below, OSError | termios.error) and below.args[:1] == (errno.ENOTTY,):
            return True
        below = below.__cause__ or below.__context__
    return False


@dataclass(slots=True)
class UnitBlock:
    """Consecutive units of equal length from one sender, as the kernel delivered them.

    Attributes:
        units: (n, length) uint8, one row a unit; owned by the receiver of the block until its next read.
        kernel_realtime_ns: (n,) CLOCK_REALTIME receive stamps; None where the kernel gives none (serial), and 0 in rows
            without a stamp.
        peer: (address, port) of a UDP sender; None elsewhere.
        rows: (n, `HEAD_ROOM_BYTES` + length) the memory that holds ``units``, without gaps; the receiver owns it for
            good and may write to the room before each unit. None where there is no such room.
    """

    units: ByteRows
    kernel_realtime_ns: Int64Array | None = None
    peer: tuple[str, int] | None = None
    rows: ByteRows | None = None


@dataclass(slots=True)
class TransportCounters:
    """Counts that the kernel and the transport keep, cumulative since `Transport.open`.

    Attributes:
        lost_kernel: units the kernel dropped at the socket or descriptor.
        receive_buffer_bytes: size that the kernel granted, read back; 0 where the transport has no such buffer.
        error_frames, bus_off: error frames of the CAN controller, and those that report bus-off.
        receive_buffer_asked_bytes: requested size; if it exceeds the granted one, the system's limit is lower.
        refused: arrivals that are not units: datagrams of other senders, unreadable lines or messages.
        refused_senders: of the refused datagrams, by address.
        line_errors: framing, parity and overrun errors of a serial line; bytes, not units, are missing or wrong.
    """

    lost_kernel: int = 0
    receive_buffer_bytes: int = 0
    error_frames: int = 0
    bus_off: int = 0
    receive_buffer_asked_bytes: int = 0
    refused: int = 0
    line_errors: int = 0
    refused_senders: Counter[str] = field(default_factory=Counter)

    def refuse(self, sender: str, units: int) -> None:
        """Count units of another sender; beyond `MOST_SENDERS` of them, without its name."""
        self.refused += units
        known = sender in self.refused_senders or len(self.refused_senders) < MOST_SENDERS
        self.refused_senders[sender if known else "others"] += units

    def refused_text(self) -> str:
        """Return the most frequent of the senders that were refused, as ``192.168.1.7 (12), …``; "" without any."""
        return ", ".join(f"{sender} ({count})" for sender, count in self.refused_senders.most_common(SENDERS_SHOWN))


class Transport(ABC):
    """The interface of one port, socket or bus."""

    def __init__(self) -> None:
        self.counters = TransportCounters()

    @abstractmethod
    def open(self) -> None:
        """Open the device.

        Raises:
            TransportError: the device is absent, busy, or not permitted.
        """

    @abstractmethod
    def receive(self, timeout_s: float) -> list[UnitBlock]:
        """Wait at most ``timeout_s`` and return the units that came, in order; an empty list on silence.

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
        """Close the device; a second call does nothing."""

    def poll_counters(self) -> TransportCounters:
        """Update the counters from the kernel's and return them."""
        return self.counters


@dataclass(frozen=True, slots=True)
class RawEdge:
    """One PPS edge with the time that the kernel or the line reader gave it, CLOCK_REALTIME."""

    realtime_ns: int
    sequence: int
    edge: str  # "assert" or "clear"
    kernel_stamp: bool = True  # False: stamped in user space after a wake-up (TIOCMIWAIT)


class PpsSource(ABC):
    """A source of edges, with the same life cycle as a `Transport`."""

    @abstractmethod
    def open(self) -> None:
        """Open the source; raises `TransportError`."""

    @abstractmethod
    def receive(self, timeout_s: float) -> list[RawEdge]:
        """Wait at most ``timeout_s`` for new edges; return an empty list on silence."""

    def poll_counters(self) -> TransportCounters:
        """Return counts of arrivals that are not edges; all 0 for a source that delivers edges only."""
        return TransportCounters()

    @abstractmethod
    def close(self) -> None:
        """Close the source; a second call does nothing."""
