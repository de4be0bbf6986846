"""Serial port: opened and set by pyserial, read with poll(2) and read(2); a unit is the bytes of one read.

The kernel gives no stamps here. A receive overrun loses bytes, not units (the read that lacks them still comes), so
it is counted with framing and parity errors in `TransportCounters.line_errors` and not in `lost_kernel`; parsers
see the gap as a failed checksum.
"""

from __future__ import annotations

import errno
import fcntl
import os
import struct
import termios
import time

import numpy as np
import serial

from swath.drivers.transports.base import TransportError, UnitBlock, is_no_serial_port
from swath.drivers.transports.descriptor import HUNG_UP, DescriptorTransport, Gate, wait_writable
from swath.drivers.transports.holders import process_holding
from swath.drivers.transports.pps.serial_dcd import line_set
from swath.drivers.transports.spec import TransportSpec

DEFAULT_BAUD = 115200
READ_BYTES = 65536
BATCH_S = 0.010  # wait after the first byte, so that a fast port is not read byte by byte; 920 bytes at 921600 baud
BATCH_BYTES = 2048  # the wait never exceeds half the buffer of a terminal (4096, n_tty(4))
SEND_TIMEOUT_S = 2.0

_BITS_A_BYTE = 10  # including start and stop bits
_TIOCGICOUNT = 0x545D  # <asm-generic/ioctls.h>
# struct serial_icounter_struct, <linux/serial.h>: cts dsr rng dcd rx tx frame overrun parity brk buf_overrun, reserved
_ICOUNTER = struct.Struct("@11i36x")
_ERROR_FIELDS = (6, 7, 8, 10)  # frame, overrun, parity, buf_overrun
_IFLAG = 0  # index in the list of termios.tcgetattr


class SerialTransport(DescriptorTransport):
    """Receives from one serial port, which it holds exclusively.

    Args:
        spec: ``serial:<path>``; options baud, bytesize, parity, stopbits, rtscts, xonxoff, dsrdtr, as in pyserial.
    """

    def __init__(self, spec: TransportSpec) -> None:
        super().__init__(spec.text or f"serial:{spec.address}")
        self._spec = spec
        self._path = spec.address
        self._batch_s = min(BATCH_S, BATCH_BYTES * _BITS_A_BYTE / int(spec.options.get("baud", DEFAULT_BAUD)))
        self._port: serial.Serial | None = None
        self._fd = -1
        self._errors_at_open: int | None = None

    def _open_device(self) -> int:
        spec = self._spec
        stopbits = float(spec.options.get("stopbits", "1"))
        try:
            port = serial.Serial(
                self._path,
                baudrate=int(spec.options.get("baud", DEFAULT_BAUD)),
                bytesize=int(spec.options.get("bytesize", "8")),
                parity=spec.options.get("parity", "N"),
                stopbits=stopbits if stopbits == 1.5 else int(stopbits),
                rtscts=spec.flag("rtscts"),
                xonxoff=spec.flag("xonxoff"),
                dsrdtr=spec.flag("dsrdtr"),
                timeout=0,
                exclusive=True,
            )
        except (OSError, ValueError, OverflowError, termios.error) as error:
            raise TransportError(self._why_not_opened(error)) from error
        self._port = port
        self._fd = port.fileno()
        self._set_up(port)
        return self._fd

    def _set_up(self, port: serial.Serial) -> None:
        """Set low latency where the driver supports it (FTDI delays bytes by 16 ms otherwise), and keep breaks from
        flushing.
        """
        try:
            port.set_low_latency_mode(True)
        except ValueError:  # pyserial raises it for a driver without that mode
            pass
        try:
            attributes = termios.tcgetattr(self._fd)
            attributes[_IFLAG] &= ~termios.BRKINT
            termios.tcsetattr(self._fd, termios.TCSANOW, attributes)
        except termios.error as error:
            port.close()
            raise TransportError(f"{self.name}: cannot set the line: {error.args[-1]}") from error
        line_set(self._fd)
        self._errors_at_open = self._line_errors()

    def _why_not_opened(self, error: BaseException) -> str:
        if is_no_serial_port(error):
            return f"{self.name}: {self._path} is not a serial port; see `ls /dev/serial/by-id`"
        number = getattr(error, "errno", None)
        if number == errno.ENOENT:
            return f"{self.name}: {self._path} does not exist"
        if number in (errno.EACCES, errno.EPERM):
            return f"{self.name}: {self._path} is not permitted to this user; add it to the group dialout"
        if number in (errno.EAGAIN, errno.EBUSY):
            return f"{self.name}: {self._path} is in use by {process_holding(os.path.realpath(self._path))}"
        if number in (errno.EIO, errno.ENXIO, errno.ENODEV):
            return f"{self.name}: nothing is connected to {self._path}"
        reason = os.strerror(number) if number else " ".join(str(error).split())
        return f"{self.name}: cannot open {self._path} as a serial port: {reason}"

    def _close_device(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            port.close()

    def _refresh_counters(self) -> None:
        errors = self._line_errors()
        if errors is not None and self._errors_at_open is not None:
            self.counters.line_errors = errors - self._errors_at_open

    def _line_errors(self) -> int | None:
        """Return framing, parity and overrun errors since the driver was loaded; None where it does not count them
        (pty).
        """
        try:
            counts: tuple[int, ...] = _ICOUNTER.unpack(fcntl.ioctl(self._fd, _TIOCGICOUNT, bytes(_ICOUNTER.size)))
        except OSError:
            return None
        return sum(counts[index] for index in _ERROR_FIELDS)

    def _receive(self, gate: Gate, timeout_s: float) -> list[UnitBlock]:
        deadline_s = time.monotonic() + timeout_s
        events = gate.wait(timeout_s)
        if not events:
            return []
        if not events & HUNG_UP:
            gate.pause(min(self._batch_s, deadline_s - time.monotonic()))
        try:
            data = os.read(self._fd, READ_BYTES)
        except BlockingIOError:
            return []
        except OSError as error:
            raise TransportError(self._gone(error.strerror or "read error")) from error
        if not data:
            # a readable line without data has been unplugged; poll again, as another reader may have taken the data
            if events & HUNG_UP or gate.wait(0.0):
                raise TransportError(self._gone("hung up"))
            return []
        return [UnitBlock(np.frombuffer(data, np.uint8)[np.newaxis, :])]

    def _gone(self, reason: str) -> str:
        return f"{self.name}: {self._path} was disconnected ({reason.lower()})"

    def _send(self, data: bytes) -> None:
        deadline_s = time.monotonic() + SEND_TIMEOUT_S
        rest = memoryview(data)
        while rest:
            if not wait_writable(self._fd, deadline_s):
                raise TransportError(f"{self.name}: {self._path} accepts no data; check flow control")
            try:
                rest = rest[os.write(self._fd, rest) :]
            except BlockingIOError:
                continue
            except OSError as error:
                raise TransportError(self._gone(error.strerror or "write error")) from error
