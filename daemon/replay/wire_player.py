"""Sends recorded units over wires again at their recorded pace: ptys, UDP, TCP, CAN, and PPS edges into FIFOs.

`swath replay` plays logs with it, the demonstration plays captures; a recorder, gpsd or a maker's viewer listens.
"""

from __future__ import annotations

import array
import contextlib
import fcntl
import os
import select
import socket
import stat
import termios
import time
import tty
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from swath.drivers.transports.base import TransportError
from swath.drivers.transports.opening import open_transport
from swath.drivers.transports.spec import TransportSpec

EMPTY_LOOKS = 15  # of 10 ms each, after which a port counts as read to its end
_PATIENCE_S = 1.0  # a reader that takes no bytes for so long loses them; the loss is counted
_LATE_S = 0.002  # units due within this are sent without another sleep
_PTYS = "/dev/pts"
LONGEST_PAUSE_NS = 3600 * 1_000_000_000  # between units; a longer one in a log is a step of its time


@dataclass(frozen=True, slots=True)
class TimedUnit:
    """One unit and its time; ``source`` selects the output."""

    time_ns: int
    source: str
    data: bytes


class Output(ABC):
    """The sending end of a source's transport."""

    @abstractmethod
    def send(self, data: bytes, due_realtime_ns: int) -> bool:
        """Send one unit; return False if no reader took it."""

    def has_reader(self) -> bool:
        """Return whether the other end is open; True if that cannot be known (UDP, CAN)."""
        return True

    @abstractmethod
    def close(self) -> None:
        """Close the output and remove everything that it created."""


class PtyOutput(Output):
    """A pseudo-terminal, linked from the path where a recorder expects its serial port."""

    def __init__(self, path: Path) -> None:
        if path.exists() and not (path.is_symlink() and path.resolve().is_relative_to(_PTYS)):
            # a link may be udev's, to a receiver: once replaced, it would be missing until the receiver is plugged in
            # again
            text = "already exists and is not a link to a pseudo-terminal; choose another path"
            raise TransportError(f"{path}: {text}")
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self._port = os.ttyname(slave)
        os.close(slave)  # so that the master shows whether a reader is present
        os.set_blocking(self._master, False)
        path.unlink(missing_ok=True)
        path.symlink_to(self._port)
        self._path = path
        self._patience_s = _PATIENCE_S

    def has_reader(self) -> bool:
        """Return whether the port is open at the other end."""
        poll = select.poll()
        poll.register(self._master, 0)
        return not any(event & select.POLLHUP for _, event in poll.poll(0))

    def send(self, data: bytes, due_realtime_ns: int) -> bool:
        """Write all bytes and wait up to one second for a slow reader; once that time has run out, do not wait for it
        again.

        Otherwise a port without an active reader would delay all other sources at each of its units.
        """
        view = memoryview(data)
        deadline = time.monotonic() + self._patience_s
        while view:
            try:
                view = view[os.write(self._master, view) :]
            except BlockingIOError:
                if not select.select([], [self._master], [], max(0.0, deadline - time.monotonic()))[1]:
                    self._patience_s = 0.0
                    return False
        self._patience_s = _PATIENCE_S
        return True

    def close(self) -> None:
        """Let a reader take the last bytes, which hanging up would discard; then remove the link and hang up."""
        if self.has_reader():
            self._drain()
        self._path.unlink(missing_ok=True)
        os.close(self._master)

    def _drain(self) -> None:
        port = os.open(self._port, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
        deadline = time.monotonic() + self._patience_s
        waiting, empty = array.array("i", [1]), 0
        try:
            # the last bytes may still be in transit between the two ends, where neither end counts them
            while empty < EMPTY_LOOKS and time.monotonic() < deadline:
                fcntl.ioctl(port, termios.FIONREAD, waiting)
                empty = 0 if waiting[0] else empty + 1
                time.sleep(0.01)
        finally:
            os.close(port)


class TcpOutput(Output):
    """Listens where a recorder connects to, and sends to the newest connection."""

    def __init__(self, spec: TransportSpec) -> None:
        try:
            self._server = socket.create_server((spec.host, spec.port))
        except OSError as error:
            reason = error.strerror or str(error)
            text = f"{spec.text}: cannot listen there: {reason}; give tcp:127.0.0.1:<port> to replay"
            raise TransportError(text) from error
        self._server.setblocking(False)
        self._reader: socket.socket | None = None

    def has_reader(self) -> bool:
        """Return whether a recorder is connected; accept the newest connection."""
        while True:
            try:
                reader, _ = self._server.accept()
            except OSError:
                return self._reader is not None
            self._leave()
            reader.settimeout(_PATIENCE_S)
            self._reader = reader

    def send(self, data: bytes, due_realtime_ns: int) -> bool:
        """Write all bytes; leave a reader that takes none for one second."""
        if not self.has_reader():
            return False
        assert self._reader is not None
        try:
            self._reader.sendall(data)
        except OSError:
            self._leave()
            return False
        return True

    def _leave(self) -> None:
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def close(self) -> None:
        """Close the connection, whose last bytes the kernel still delivers, and stop listening."""
        self._leave()
        self._server.close()


class UdpOutput(Output):
    """Sends datagrams to the port that a recorder listens on."""

    def __init__(self, spec: TransportSpec) -> None:
        group = spec.options.get("group")
        host = group or ("127.0.0.1" if spec.host in ("0.0.0.0", "") else spec.host)
        self._address = (host, spec.port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        if source := spec.options.get("source"):
            with contextlib.suppress(OSError):  # the one sender that is accepted may be this computer
                self._socket.bind((source, 0))
        if group:
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)

    def send(self, data: bytes, due_realtime_ns: int) -> bool:
        """Send one datagram."""
        try:
            self._socket.sendto(data, self._address)
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class CanOutput(Output):
    """Sends frames to the bus that a recorder listens on."""

    def __init__(self, spec: TransportSpec) -> None:
        self._transport = open_transport(spec)
        self._transport.open()

    def send(self, data: bytes, due_realtime_ns: int) -> bool:
        """Send one SocketCAN frame."""
        try:
            self._transport.send(data)
        except TransportError:
            return False
        return True

    def close(self) -> None:
        """Leave the bus."""
        self._transport.close()


class PpsOutput(Output):
    """Writes edges as lines ``realtime_ns sequence`` into the FIFO of a ``fixed:`` source."""

    def __init__(self, path: Path) -> None:
        if not path.exists():
            os.mkfifo(path)
        elif not stat.S_ISFIFO(path.stat().st_mode):
            raise TransportError(f"{path}: already exists and is not a FIFO; remove it or choose another path")
        self._path = path
        self._fd = -1
        self._sequence = 0

    def has_reader(self) -> bool:
        """Return whether the FIFO has a reader; if so, the FIFO is open afterwards."""
        if self._fd < 0:
            try:
                self._fd = os.open(self._path, os.O_WRONLY | os.O_NONBLOCK)
            except OSError:
                return False
        return True

    def send(self, data: bytes, due_realtime_ns: int) -> bool:
        """Write the edge that is due now; ``data`` is not used."""
        self._sequence += 1
        if not self.has_reader():
            return False
        try:
            os.write(self._fd, f"{due_realtime_ns} {self._sequence}\n".encode())
        except BlockingIOError:
            return False
        except BrokenPipeError:
            os.close(self._fd)
            self._fd = -1
            return False
        return True

    def close(self) -> None:
        """Close and remove the FIFO."""
        if self._fd >= 0:
            os.close(self._fd)
        self._path.unlink(missing_ok=True)


def open_output(spec: TransportSpec) -> Output:
    """Open the sending end of a transport of the configuration.

    Raises:
        TransportError: it cannot be made.
    """
    if spec.kind == "serial":
        return PtyOutput(Path(spec.address))
    if spec.kind == "tcp":
        return TcpOutput(spec)
    return UdpOutput(spec) if spec.kind == "udp" else CanOutput(spec)


def wait_for_readers(outputs: Mapping[str, Output], seconds: float, stopped: Callable[[], bool]) -> list[str]:
    """Wait until every port and FIFO has a reader; return the sources that still have none after ``seconds``."""
    deadline = time.monotonic() + seconds
    while missing := [source for source, output in outputs.items() if not output.has_reader()]:
        if time.monotonic() >= deadline or stopped():
            return missing
        time.sleep(0.05)
    return []


@dataclass(slots=True)
class PlayReport:
    """The counts of sent units, by source.

    Attributes:
        units, bytes: sent.
        refused: units that no reader took in time.
        passed_over: units of sources without an output.
        latest_s: the largest delay of a unit.
        played_s: recorded time from the first to the last unit, without steps.
        jumps: number of time steps of more than an hour, forwards or back, for which the player did not wait.
    """

    units: Counter[str] = field(default_factory=Counter)
    bytes: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    passed_over: Counter[str] = field(default_factory=Counter)
    latest_s: float = 0.0
    played_s: float = 0.0
    jumps: int = 0


def play(
    units: Iterable[TimedUnit],
    outputs: Mapping[str, Output],
    *,
    pace: float = 1.0,
    progress: Callable[[float, PlayReport], None] | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> PlayReport:
    """Send units when they are due: the first now, the others after it as recorded, ``pace`` times as fast.

    A step of more than an hour between two units is not a pause: the later unit is sent at once, and the pace continues
    from there.

    Args:
        units: in time order; those of sources without an output are skipped.
        outputs: by source.
        pace: 1 is as recorded.
        progress: called about ten times a second with the played seconds.
        stopped: ends the play early when it returns True.
    """
    report = PlayReport()
    # loopback keeps the order of datagrams only if they are sent from one processor
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    start_ns = realtime_ns = 0
    first_ns: int | None = None
    last_ns = 0
    told_s = 0.0
    for unit in units:
        if stopped():
            break
        if unit.source not in outputs:
            report.passed_over[unit.source] += 1
            continue
        if first_ns is None:
            first_ns = unit.time_ns
            start_ns, realtime_ns = time.monotonic_ns(), time.time_ns()  # reading up to the first unit took time
        elif abs(unit.time_ns - last_ns) > LONGEST_PAUSE_NS:
            first_ns += unit.time_ns - last_ns
            report.jumps += 1
        last_ns = unit.time_ns
        due_s = (unit.time_ns - first_ns) * 1e-9 / pace
        _sleep_until(start_ns, due_s, stopped)
        if stopped():
            break
        sent = outputs[unit.source].send(unit.data, realtime_ns + round(due_s * 1e9))
        _count(report, unit, sent)
        report.played_s = due_s * pace
        now_s = (time.monotonic_ns() - start_ns) * 1e-9
        report.latest_s = max(report.latest_s, now_s - due_s)
        if progress is not None and now_s - told_s > 0.1:
            told_s = now_s
            progress(due_s, report)
    return report


def _sleep_until(start_ns: int, due_s: float, stopped: Callable[[], bool]) -> None:
    while (wait_s := due_s - (time.monotonic_ns() - start_ns) * 1e-9) > _LATE_S and not stopped():
        time.sleep(min(wait_s, 0.2))


def _count(report: PlayReport, unit: TimedUnit, sent: bool) -> None:
    if sent:
        report.units[unit.source] += 1
        report.bytes[unit.source] += len(unit.data)
    else:
        report.refused[unit.source] += 1
