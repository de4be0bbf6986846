"""PPS edges from a file or FIFO: one line an edge, ``realtime_ns sequence``, CLOCK_REALTIME.

A file is read to its end and followed as it grows. A FIFO outlives its writers: one may close and another open it.
Text that a writer leaves without a line end is discarded when it closes. Invalid lines are counted and skipped.
"""

from __future__ import annotations

import errno
import os
import stat
import threading
import time

from swath.drivers.transports.base import PpsSource, RawEdge, TransportCounters, TransportError
from swath.drivers.transports.descriptor import Gate

READ_BYTES = 65536
MAX_LINE_BYTES = 64  # two 64-bit numbers have 41 characters
FOLLOW_S = 0.02  # interval for polling a file at its end, or a FIFO without a writer
_INT64_MAX = 2**63 - 1


class FixedPps(PpsSource):
    """Reads edges from ``path``; every edge is assumed to have the requested polarity.

    Attributes:
        garbage_lines: lines, or ends of lines, that are not an edge.
    """

    def __init__(self, path: str, edge: str = "assert") -> None:
        self._path = path
        self._edge = edge
        self._fd = -1
        self._is_fifo = False
        self._at_end = False
        self._gate: Gate | None = None
        self._reading = threading.Lock()
        self._partial = b""
        self._skipping = False
        self.garbage_lines = 0

    def open(self) -> None:
        """Open the file or FIFO; a FIFO needs no writer yet.

        Raises:
            TransportError: the path is absent, not permitted, or a directory.
        """
        with self._reading:
            if self._gate is not None:
                raise TransportError(f"fixed:{self._path}: is already open")
            self._fd = self._opened()
            self._is_fifo = stat.S_ISFIFO(os.fstat(self._fd).st_mode)
            self._gate = Gate(self._fd if self._is_fifo else -1)
            self._partial, self._skipping = b"", False

    def _opened(self) -> int:
        try:
            fd = os.open(self._path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise TransportError(self._why(error)) from error
        if stat.S_ISDIR(os.fstat(fd).st_mode):
            os.close(fd)
            raise TransportError(f"fixed:{self._path}: is a directory; want a file or FIFO of edges")
        return fd

    def _why(self, error: OSError) -> str:
        if error.errno == errno.ENOENT:
            return f"fixed:{self._path}: no such file; want a file or FIFO with lines of 'realtime_ns sequence'"
        if error.errno in (errno.EACCES, errno.EPERM):
            return f"fixed:{self._path}: this user may not read it"
        return f"fixed:{self._path}: {error.strerror}"

    def receive(self, timeout_s: float) -> list[RawEdge]:
        """Receive edges as `PpsSource.receive` does."""
        deadline_s = time.monotonic() + timeout_s
        with self._reading:
            if self._gate is None:
                raise TransportError(f"fixed:{self._path}: is closed")
            gate = self._gate
            while True:
                edges = self._read_edges()
                left_s = deadline_s - time.monotonic()
                if edges or left_s <= 0 or gate.woken:
                    return edges
                self._wait(gate, left_s)

    def _wait(self, gate: Gate, left_s: float) -> None:
        if self._at_end:  # poll reports a file's end, and a FIFO after its writer closed, as ready
            gate.pause(min(left_s, FOLLOW_S))
        elif not gate.wait(left_s):
            self._see_that_it_is_there()

    def _read_edges(self) -> list[RawEdge]:
        self._at_end = False
        try:
            data = os.read(self._fd, READ_BYTES)
        except BlockingIOError:  # a FIFO with a writer and nothing in it
            return []
        except OSError as error:
            raise TransportError(self._why(error)) from error
        if data:
            return self._edges_of(data)
        self._at_end = True
        if self._is_fifo:
            self.garbage_lines += bool(self._partial)
            self._partial, self._skipping = b"", False
        self._see_that_it_is_there()
        return []

    def _see_that_it_is_there(self) -> None:
        """Raise `TransportError` if the path no longer names the open file, or the file was cut short."""
        try:
            now = os.stat(self._path)
        except OSError as error:
            raise TransportError(self._why(error)) from error
        opened = os.fstat(self._fd)
        if (now.st_dev, now.st_ino) != (opened.st_dev, opened.st_ino):
            raise TransportError(f"fixed:{self._path}: was replaced by another file")
        if not self._is_fifo and now.st_size < os.lseek(self._fd, 0, os.SEEK_CUR):
            raise TransportError(f"fixed:{self._path}: was cut short")

    def _edges_of(self, data: bytes) -> list[RawEdge]:
        *lines, self._partial = (self._partial + data).split(b"\n")
        edges = []
        for line in lines:
            edge = None if self._skipping else self._parse(line)
            self._skipping = False
            if edge is not None:
                edges.append(edge)
        if len(self._partial) > MAX_LINE_BYTES:
            self.garbage_lines += not self._skipping
            self._partial, self._skipping = b"", True
        return edges

    def _parse(self, line: bytes) -> RawEdge | None:
        fields = line.split()
        if len(fields) == 2 and len(line) <= MAX_LINE_BYTES and all(field.isdigit() for field in fields):
            realtime_ns, sequence = int(fields[0]), int(fields[1])
            if realtime_ns <= _INT64_MAX and sequence <= _INT64_MAX:
                return RawEdge(realtime_ns, sequence, self._edge)
        self.garbage_lines += 1
        return None

    def poll_counters(self) -> TransportCounters:
        """Return the number of lines that are not an edge, as ``refused``."""
        return TransportCounters(refused=self.garbage_lines)

    def close(self) -> None:
        """Wake a blocked `receive` and close the file."""
        gate = self._gate
        if gate is None:
            return
        gate.wake()
        with self._reading:
            if self._gate is not gate:
                return
            self._gate = None
            gate.close()
            os.close(self._fd)
            self._fd = -1
