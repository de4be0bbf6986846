"""Common parts of transports on a file descriptor: waiting for it, and closing it from another thread at any time."""

from __future__ import annotations

import os
import select
import threading
import time
from abc import abstractmethod
from collections.abc import Sized

from swath.drivers.transports.base import Transport, TransportCounters, TransportError, UnitBlock

HUNG_UP = select.POLLHUP | select.POLLERR | select.POLLNVAL


class Gate:
    """Waits until a descriptor is ready, the time is over, or any thread calls `wake`."""

    def __init__(self, fd: int, events: int = select.POLLIN) -> None:
        self._wake_fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._lock = threading.Lock()
        self._open = True
        self.woken = False
        self._fd = fd
        self._poll = select.poll()
        if fd >= 0:
            self._poll.register(fd, events)
        self._poll.register(self._wake_fd, select.POLLIN)
        self._wake_poll = select.poll()
        self._wake_poll.register(self._wake_fd, select.POLLIN)

    def wait(self, timeout_s: float) -> int:
        """Wait and return the descriptor's poll events; 0 when the time is over or the gate was woken."""
        ready = dict(self._poll.poll(max(0.0, timeout_s) * 1000.0))
        return 0 if self._wake_fd in ready else ready.get(self._fd, 0)

    def pause(self, time_s: float) -> None:
        """Wait for a time, ignoring the descriptor, until the gate is woken."""
        self._wake_poll.poll(max(0.0, time_s) * 1000.0)

    def wake(self) -> None:
        """Make every present and future `wait` return at once."""
        self.woken = True
        with self._lock:
            if self._open:
                os.eventfd_write(self._wake_fd, 1)

    def close(self) -> None:
        """Close the gate's own descriptor, not the one that it waits for."""
        with self._lock:
            if self._open:
                self._open = False
                os.close(self._wake_fd)


class DescriptorTransport(Transport):
    """A transport that waits on a descriptor; `close` may be called from another thread than `receive`.

    A subclass opens its device in `_open_device`, which returns the descriptor to wait on (-1: none), reads in
    `_receive` and sends in `_send`. `_receive` and `_send` are called on an open transport only.
    """

    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name
        self._reading = threading.Lock()
        self._sending = threading.Lock()
        self._counting = threading.Lock()
        self._gate: Gate | None = None
        self._held: TransportError | None = None

    @abstractmethod
    def _open_device(self) -> int: ...

    @abstractmethod
    def _close_device(self) -> None: ...

    @abstractmethod
    def _receive(self, gate: Gate, timeout_s: float) -> list[UnitBlock]: ...

    @abstractmethod
    def _send(self, data: bytes) -> None: ...

    def _refresh_counters(self) -> None:
        """Update `counters` from the kernel's; the device is open."""

    def open(self) -> None:
        """Open the device and reset the counters."""
        with self._reading, self._sending, self._counting:
            if self._gate is not None:
                raise TransportError(f"{self.name}: is already open")
            self.counters = TransportCounters()
            self._held = None
            self._gate = Gate(self._open_device())

    def receive(self, timeout_s: float) -> list[UnitBlock]:
        """Receive units as `Transport.receive` does; return an empty list at once when another thread closes."""
        with self._reading:
            held, self._held = self._held, None
            if held is not None:
                raise held
            return self._receive(self._opened(), timeout_s)

    def _fail_after(self, units: Sized, error: TransportError) -> None:
        """Raise a read error at once, or with the next `receive` if units were read before it."""
        if not units:
            raise error
        self._held = error

    def send(self, data: bytes) -> None:
        """Send one unit as `Transport.send` does."""
        with self._sending:
            self._opened()
            self._send(data)

    def close(self) -> None:
        """Wake a blocked `receive` and close; the counters keep their last values."""
        gate = self._gate
        if gate is None:
            return
        gate.wake()
        with self._reading, self._sending, self._counting:
            if self._gate is not gate:
                return
            self._refresh_counters()
            self._gate = None
            gate.close()
            self._close_device()

    def poll_counters(self) -> TransportCounters:
        """Update the counters from the kernel's and return them; once closed, return the last values."""
        with self._counting:
            if self._gate is not None:
                self._refresh_counters()
        return self.counters

    def _opened(self) -> Gate:
        if self._gate is None:
            raise TransportError(f"{self.name}: is closed")
        return self._gate


def wait_writable(fd: int, deadline_s: float) -> bool:
    """Wait and return whether ``fd`` takes data before ``deadline_s`` of `time.monotonic`."""
    poll = select.poll()
    poll.register(fd, select.POLLOUT)
    ready = poll.poll(max(0.0, deadline_s - time.monotonic()) * 1000.0)
    return any(events & select.POLLOUT for _, events in ready)
