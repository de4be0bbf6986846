"""PPS on a serial port's DCD line: waits with TIOCMIWAIT and stamps right after the wake-up.

The wait cannot be ended from outside, neither by closing the port nor by a time limit. It therefore runs in its own
thread, which owns its descriptor and ends with the next edge or with the device; `close` abandons the thread and
returns at once. Code that changes the settings of such a port calls `line_set`: the driver of a 16550 then reports DCD
only to waits that begin later, not to those under way. Stamps are 40 to 60 µs late, more on a busy machine: a kernel
PPS (``ldattach PPS``) is better.
"""

from __future__ import annotations

import errno
import fcntl
import os
import queue
import struct
import sys
import termios
import threading
import time
from collections import Counter

from swath.drivers.transports.base import PpsSource, RawEdge, TransportError

_TIOCMIWAIT = 0x545C  # <asm-generic/ioctls.h>
_TIOCGICOUNT = 0x545D
_ICOUNTER_DCD = struct.Struct("@12xi64x")  # field dcd of struct serial_icounter_struct, <linux/serial.h>
_lines_set: Counter[int] = Counter()  # by device number: how often this process set its line


def line_set(fd: int) -> None:
    """Note that a port's line has just been set, so that every wait for its DCD starts again.

    tcsetattr(3) turns a 16550's modem status interrupt off (`serial8250_do_set_termios`), and only the beginning of a
    TIOCMIWAIT turns it on (`uart_wait_modem_status`).
    """
    _lines_set[os.fstat(fd).st_rdev] += 1


class SerialDcdPps(PpsSource):
    """Reads edges of DCD; "assert" is the rising line."""

    def __init__(self, path: str, edge: str = "assert") -> None:
        self._path = path
        self._edge = edge
        self._watch: _Watch | None = None

    def open(self) -> None:
        """Open the port without touching its settings and begin to wait.

        Raises:
            TransportError: the port is absent, not permitted, or has no modem lines.
        """
        if self._watch is not None:
            raise TransportError(f"serial-dcd:{self._path}: is already open")
        try:
            fd = os.open(self._path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise TransportError(self._why(error)) from error
        try:
            _carrier(fd)
            changes = _dcd_changes(fd)
        except OSError as error:
            os.close(fd)
            raise TransportError(self._why(error)) from error
        self._begin(fd, changes)

    def _begin(self, fd: int, changes: int) -> None:
        self._watch = _Watch(fd, changes)
        threading.Thread(target=self._watch.run, name=f"dcd {self._path}", daemon=True).start()

    def _why(self, error: OSError) -> str:
        name = f"serial-dcd:{self._path}"
        if error.errno == errno.ENOENT:
            return f"{name}: {self._path} does not exist"
        if error.errno in (errno.EACCES, errno.EPERM):
            return f"{name}: {self._path} is not permitted to this user; add it to the group dialout"
        if error.errno in (errno.ENOTTY, errno.EINVAL):
            return f"{name}: {self._path} cannot wait for DCD (TIOCMIWAIT); use a hardware serial port"
        return f"{name}: {self._path} failed: {error.strerror}"

    def receive(self, timeout_s: float) -> list[RawEdge]:
        """Receive edges as `PpsSource.receive` does."""
        watch = self._watch
        if watch is None:
            raise TransportError(f"serial-dcd:{self._path}: is closed")
        if watch.is_deaf() and watch.edges.empty():
            self._wait_anew(watch)
        try:
            item = watch.edges.get(timeout=max(timeout_s, 0.0)) if timeout_s > 0 else watch.edges.get_nowait()
        except queue.Empty:
            return []
        if isinstance(item, OSError):
            raise TransportError(self._why(item)) from item
        return [item] if item is not None and item.edge == self._edge else []

    def _wait_anew(self, watch: _Watch) -> None:
        """Start another waiting thread; the old one ends with the next edge."""
        try:
            fd = os.dup(watch.fd)
        except OSError:  # the thread has ended; its error is next in the queue
            return
        watch.stopped.set()
        self._begin(fd, watch.changes)

    def close(self) -> None:
        """Abandon the waiting thread; a running `receive` returns."""
        watch, self._watch = self._watch, None
        if watch is not None:
            watch.stopped.set()
            watch.edges.put(None)


class _Watch:
    """Waits for edges in a thread and owns the descriptor."""

    def __init__(self, fd: int, changes: int) -> None:
        self.fd = fd
        self.changes = changes
        self._device = os.fstat(fd).st_rdev
        self._line = _lines_set[self._device]
        self._ended = False
        self.stopped = threading.Event()
        self.edges: queue.SimpleQueue[RawEdge | OSError | None] = queue.SimpleQueue()

    def is_deaf(self) -> bool:
        """Return whether the line was set after the wait began."""
        return not self._ended and _lines_set[self._device] != self._line

    def run(self) -> None:
        try:
            while not self.stopped.is_set():
                self._line = _lines_set[self._device]
                fcntl.ioctl(self.fd, _TIOCMIWAIT, termios.TIOCM_CAR)
                realtime_ns = time.clock_gettime_ns(time.CLOCK_REALTIME)
                if self.stopped.is_set():
                    break
                changes = _dcd_changes(self.fd)
                edge, sequence = edge_at_wake_up(self.changes, changes, _carrier(self.fd))
                self.changes = changes
                self.edges.put(RawEdge(realtime_ns, sequence, edge, kernel_stamp=False))
        except OSError as error:
            self._ended = True
            self.edges.put(error)
        finally:
            os.close(self.fd)


def edge_at_wake_up(changes_before: int, changes: int, carrier: bool) -> tuple[str, int]:
    """Return which edge ended the wait, and its number.

    The driver counts changes of the line. The first change after ``changes_before`` ended the wait. With an odd number
    of changes since, the line is now in the state after that edge, with an even number in the state before it. Two
    changes make a pulse, so that edges of one polarity are numbered without gaps unless one was missed.
    """
    happened = max(changes - changes_before, 1)
    rose = carrier if happened % 2 else not carrier
    return ("assert" if rose else "clear"), (changes_before + 1) >> 1


def _carrier(fd: int) -> bool:
    lines = int.from_bytes(fcntl.ioctl(fd, termios.TIOCMGET, bytes(4)), sys.byteorder)
    return bool(lines & termios.TIOCM_CAR)


def _dcd_changes(fd: int) -> int:
    return int(_ICOUNTER_DCD.unpack(fcntl.ioctl(fd, _TIOCGICOUNT, bytes(_ICOUNTER_DCD.size)))[0])
