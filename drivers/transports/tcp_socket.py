"""TCP client: the byte stream of a receiver's or terminal server's port; a unit is the bytes of one read.

The kernel stamps the packet that completes a read (Linux 4.15 and newer), so a wait for more bytes after the first
delays no stamp. The other end may vanish without a word (a pulled cable, a power cut): the kernel's keep-alive finds a
host that is gone, and a connection on which nothing came for ``silent_s`` counts as dead too, because a terminal
server that was restarted may accept a connection and never use it.
"""

from __future__ import annotations

import errno
import socket
import struct
import threading
import time
from collections.abc import Callable

import numpy as np

from swath.drivers.transports.base import TransportError, UnitBlock
from swath.drivers.transports.datagrams import SO_TIMESTAMPNS, stamping
from swath.drivers.transports.descriptor import HUNG_UP, DescriptorTransport, Gate, wait_writable
from swath.drivers.transports.spec import TransportSpec

CONNECT_S = 8.0  # limit for each address of the host
OPEN_S = 18.0  # limit for name and connection; after 20 s the watchdog considers the opening stuck
SILENT_S = 10.0  # default of silent_s: ten messages of a receiver at 1 Hz
READ_BYTES = 65536
MAX_READS = 32  # bounds one receive to 2 MiB
BATCH_S = 0.010  # wait after the first byte, as for a serial port: 100 reads a second at most
SEND_TIMEOUT_S = 2.0

_SLICE_S = 0.1
_KEEPALIVE = ((socket.TCP_KEEPIDLE, 10), (socket.TCP_KEEPINTVL, 5), (socket.TCP_KEEPCNT, 3))
_TIMESPEC = struct.Struct("@ll")


def keep_alive(sock: socket.socket) -> None:
    """Make the kernel probe a silent connection: a host that does not answer for 25 s ends it."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in _KEEPALIVE:
        sock.setsockopt(socket.IPPROTO_TCP, option, value)


def why_not_connected(name: str, host: str, port: int, error: OSError | UnicodeError, hint: str) -> str:
    """Return the line that explains why a host could not be reached.

    Args:
        name: the transport's text, which begins the line.
        host, port: of the other end.
        error: raised by the attempt; UnicodeError: the name cannot be encoded for the resolver.
        hint: what to check where the host refuses the port.
    """
    if isinstance(error, UnicodeError):
        return f"{name}: {host} is not a valid host name"
    if isinstance(error, socket.gaierror):
        return f"{name}: the host name {host} is unknown; check the name and the network"
    if isinstance(error, TimeoutError):
        return f"{name}: no answer from {host} port {port} in {CONNECT_S:g} s"
    if error.errno == errno.ECONNREFUSED:
        return f"{name}: {host} refuses port {port}; {hint}"
    if error.errno in (errno.ENETUNREACH, errno.EHOSTUNREACH):
        return f"{name}: {host} is unreachable; check the network"
    return f"{name}: cannot connect: {error.strerror or error}"


def connected(name: str, connect: Callable[[], socket.socket], stopped: Callable[[], bool]) -> socket.socket:
    """Return the connection that ``connect`` makes in a thread of its own, within `OPEN_S`, or until ``stopped``.

    Raises:
        TransportError: there is none in time, or the error of ``connect``.
    """
    attempt, limit_s = _Attempt(connect), time.monotonic() + OPEN_S
    while not attempt.wait(_SLICE_S):
        if stopped() and not attempt.wait(0.0):
            attempt.leave()
            raise TransportError(f"{name}: not connected in time")
        if time.monotonic() > limit_s:
            attempt.leave()
            raise TransportError(f"{name}: no connection within {OPEN_S:g} s; check the network")
    return attempt.result()


def send_all(sock: socket.socket, name: str, data: bytes) -> None:
    """Send all bytes over a non-blocking connection; raises `TransportError` if the other end takes none for 2 s."""
    deadline_s = time.monotonic() + SEND_TIMEOUT_S
    rest = memoryview(data)
    while rest:
        if not wait_writable(sock.fileno(), deadline_s):
            raise TransportError(f"{name}: the other end accepts no data")
        try:
            rest = rest[sock.send(rest) :]
        except BlockingIOError:
            continue
        except OSError as error:
            raise TransportError(f"{name}: the connection broke: {error.strerror or error}") from error


class _Attempt(threading.Thread):
    """Connects in its own thread, however long the resolver takes; the waiting caller may leave earlier."""

    def __init__(self, connect: Callable[[], socket.socket]) -> None:
        super().__init__(name="connect", daemon=True)
        self._connect = connect
        self._lock = threading.Lock()
        self._left = False
        self._sock: socket.socket | None = None
        self._error = TransportError("not connected")
        self.start()

    def run(self) -> None:
        try:
            sock = self._connect()
        except TransportError as error:
            self._error = error
            return
        with self._lock:
            if self._left:
                sock.close()
            else:
                self._sock = sock

    def wait(self, seconds: float) -> bool:
        """Wait and return whether the attempt has ended."""
        self.join(seconds)
        return not self.is_alive()

    def leave(self) -> None:
        """Give the attempt up and close its connection, now or later."""
        with self._lock:
            self._left = True
            if self._sock is not None:
                self._sock.close()

    def result(self) -> socket.socket:
        """Return the connection, or raise the `TransportError` of the attempt."""
        if self._sock is None:
            raise self._error
        return self._sock


class TcpTransport(DescriptorTransport):
    """Receives the byte stream of one TCP server.

    Args:
        spec: ``tcp:<host>:<port>``; option silent_s.
        stopped: returns whether the opening should end early.
    """

    def __init__(self, spec: TransportSpec, stopped: Callable[[], bool] = lambda: False) -> None:
        super().__init__(spec.text or f"tcp:{spec.address}")
        self._spec = spec
        self._stopped = stopped
        self._silent_s = float(spec.options.get("silent_s", SILENT_S))
        self._sock: socket.socket | None = None
        self._heard_s = 0.0

    def _open_device(self) -> int:
        self._sock = connected(self.name, self._connect, self._stopped)
        self._heard_s = time.monotonic()
        return self._sock.fileno()

    def _connect(self) -> socket.socket:
        host, port = self._spec.host, self._spec.port
        try:
            with stamping():
                sock = socket.create_connection((host, port), CONNECT_S)
                sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        except (OSError, UnicodeError) as error:
            hint = "check the port number, and that the device serves this port"
            raise TransportError(why_not_connected(self.name, host, port, error, hint)) from error
        keep_alive(sock)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setblocking(False)
        return sock

    def _close_device(self) -> None:
        sock, self._sock = self._sock, None
        if sock is not None:
            sock.close()

    def _receive(self, gate: Gate, timeout_s: float) -> list[UnitBlock]:
        assert self._sock is not None
        deadline_s = time.monotonic() + timeout_s
        events = gate.wait(timeout_s)
        if not events:
            if not gate.woken and time.monotonic() - self._heard_s > self._silent_s:
                raise TransportError(f"{self.name}: no data for {self._silent_s:g} s; it is connected to anew")
            return []
        if not events & HUNG_UP:
            gate.pause(min(BATCH_S, deadline_s - time.monotonic()))
        blocks: list[UnitBlock] = []
        try:
            self._read_into(blocks, self._sock)
        except TransportError as error:
            self._fail_after(blocks, error)
        return blocks

    def _read_into(self, blocks: list[UnitBlock], sock: socket.socket) -> None:
        """Append a block for each read, until nothing waits or `MAX_READS`; raise `TransportError` at the end."""
        for _ in range(MAX_READS):
            try:
                data, control, _, _ = sock.recvmsg(READ_BYTES, socket.CMSG_SPACE(_TIMESPEC.size))
            except BlockingIOError:
                return
            except OSError as error:
                raise TransportError(f"{self.name}: the connection broke: {error.strerror or error}") from error
            if not data:
                raise TransportError(f"{self.name}: the other end closed the connection")
            self._heard_s = time.monotonic()
            stamps = np.array([_stamp_ns(control)], dtype=np.int64)
            blocks.append(UnitBlock(np.frombuffer(data, np.uint8)[np.newaxis, :], stamps))
            if len(data) < READ_BYTES:
                return

    def _send(self, data: bytes) -> None:
        assert self._sock is not None
        send_all(self._sock, self.name, data)


def _stamp_ns(control: list[tuple[int, int, bytes]]) -> int:
    """Return the kernel's CLOCK_REALTIME stamp of a read; 0 if it has none."""
    for level, kind, data in control:
        if (level, kind) == (socket.SOL_SOCKET, SO_TIMESTAMPNS) and len(data) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(data)
            return int(seconds * 1_000_000_000 + nanoseconds)
    return 0
