"""CAN through python-can: all its interfaces except SocketCAN, which has its own transport.

python-can delivers messages, one Python object each; they become SocketCAN frames here, so that the log has the same
form for every adapter. Where the interface is a datagram socket (udp_multicast), the kernel's stamps and its count of
drops are used as for UDP; the stamps of other adapters come from their own clocks or from the host's read, and are not
passed on.

Units are frames of Linux: `struct can_frame` (16 bytes) and `struct canfd_frame` (72). <linux/can.h>: can_id u32 with
its flags, len u8, flags u8 (FD only), two reserved bytes, 8 or 64 bytes of data; little-endian.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import socket
import stat
import struct
import time
from typing import Any

import can
import numpy as np

from swath.drivers.can_frames import (
    CAN_EFF_FLAG,
    CAN_EFF_MASK,
    CAN_ERR_FLAG,
    CAN_FRAME_BYTES,
    CAN_RTR_FLAG,
    CAN_SFF_MASK,
    CANFD_BRS,
    CANFD_FDF,
    CANFD_FRAME_BYTES,
)
from swath.drivers.transports.base import TransportError, UnitBlock, is_no_serial_port
from swath.drivers.transports.datagrams import DropCounter, ask_receive_buffer, stamping
from swath.drivers.transports.descriptor import HUNG_UP, DescriptorTransport, Gate
from swath.drivers.transports.spec import TransportSpec

HEADER = struct.Struct("<IBBxx")
ERROR_BUS_OFF = 0x40  # <linux/can/error.h>, CAN_ERR_BUSOFF, in the identifier of an error frame
FD_ERROR_STATE = 0x02  # CANFD_ESI

SOCKETCAND = "can.interfaces.socketcand.socketcand"
CONNECT_S = 2.0  # limit for the connection to a gateway
# a gateway that loses its power does not close the connection: it counts as dead after 25 s
_KEEPALIVE = ((socket.TCP_KEEPIDLE, 10), (socket.TCP_KEEPINTVL, 5), (socket.TCP_KEEPCNT, 3))
KERNEL_STAMPED = frozenset({"udp_multicast"})
MAX_FRAMES = 1000  # bounds one receive
SLICE_S = 0.1  # a bus without a descriptor is polled in slices, so that a close from outside is noticed
BATCH_S = 0.032  # 260 frames of a full 1 Mbit/s bus; the kernel has their stamps
BUFFER_BYTES = 4 << 20
SEND_TIMEOUT_S = 1.0

_UNREADABLE = (ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, struct.error)
_MISSING = re.compile(r"missing \d+ required .*arguments?: (.*)")  # Python's message about missing options
_NAME = re.compile(r"'(\w+)'")
_WORDS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}


def keyword_value(text: str) -> int | float | bool | str:
    """Convert an option's text to the type that python-can's interfaces expect: int, float, bool, or the text
    itself.
    """
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    try:
        return int(text, 0)
    except ValueError:
        pass
    try:
        return float(text)
    except ValueError:
        return text


class PythonCanTransport(DescriptorTransport):
    """Receives one bus of python-can; a unit is a frame of 16 or 72 bytes.

    Args:
        spec: ``can:<interface>:<channel>``; every option is a keyword of that interface's bus.
    """

    def __init__(self, spec: TransportSpec) -> None:
        super().__init__(spec.text or f"can:{spec.address}")
        self._spec = spec
        self._kernel_stamped = spec.interface in KERNEL_STAMPED
        self._bus: can.BusABC | None = None
        self._fd = -1
        self._sock: socket.socket | None = None
        self._drops: DropCounter | None = None
        self._connection: socket.socket | None = None

    def _open_device(self) -> int:
        keywords: dict[str, Any] = {key: keyword_value(value) for key, value in self._spec.options.items()}
        spec = self._spec
        try:
            if spec.interface == "socketcand":
                vars(importlib.import_module(SOCKETCAND))["connect_to_server"] = _connect_once
            with stamping() if self._kernel_stamped else contextlib.nullcontext():
                self._bus = can.Bus(interface=spec.interface, channel=spec.channel, ignore_config=True, **keywords)
        except NameError as error:  # a python-can interface raises it when its maker's library is not installed
            raise TransportError(
                f"{self.name}: the library of the {spec.interface} adapter is not installed"
            ) from error
        except (can.CanError, OSError, ImportError, *_UNREADABLE) as error:
            raise TransportError(f"{self.name}: cannot open the CAN bus: {self._why_not_opened(error)}") from error
        self._fd = _descriptor(self._bus)
        self._watch_socket()
        self._connection = _connection(self._bus)
        return self._fd

    def _why_not_opened(self, error: Exception) -> str:
        if is_no_serial_port(error):
            return f"{self._spec.channel} is not a serial port; see `ls /dev/serial/by-id`"
        if isinstance(error, TypeError) and (found := _MISSING.search(str(error))):
            wanted = "&".join(f"{name}=…" for name in _NAME.findall(found[1]))
            return f"{self._spec.interface} needs the options ?{wanted}"
        return _one_line(error)

    def _watch_socket(self) -> None:
        """Request a larger buffer and count drops, if the bus is on a datagram socket."""
        if self._fd < 0 or not stat.S_ISSOCK(os.fstat(self._fd).st_mode):
            return
        sock = socket.socket(fileno=os.dup(self._fd))
        if sock.type != socket.SOCK_DGRAM:
            sock.close()
            return
        self._sock = sock
        self.counters.receive_buffer_asked_bytes = BUFFER_BYTES
        self.counters.receive_buffer_bytes = ask_receive_buffer(sock, BUFFER_BYTES)
        self._drops = DropCounter(sock)

    def _close_device(self) -> None:
        if self._sock is not None:
            self._sock.close()
            self._sock = self._drops = None
        bus, self._bus, self._connection = self._bus, None, None
        if bus is None:
            return
        try:
            bus.shutdown()
        except (can.CanError, OSError):  # slcan sends a last command to its device, which may have gone
            port = getattr(bus, "serialPortOrig", None)
            if port is not None:
                port.close()

    def _refresh_counters(self) -> None:
        if self._drops is not None:
            self.counters.lost_kernel = self._drops.update()

    def _receive(self, gate: Gate, timeout_s: float) -> list[UnitBlock]:
        frames: list[bytes] = []
        stamps: list[int] = []
        for message in self._messages(gate, timeout_s):
            try:
                frames.append(pack_frame(message))
            except ValueError:
                self.counters.refused += 1
                continue
            stamps.append(round(message.timestamp * 1e9))
            if message.is_error_frame:
                self.counters.error_frames += 1
                self.counters.bus_off += bool(message.arbitration_id & ERROR_BUS_OFF)
        return _blocks(frames, stamps if self._kernel_stamped else None)

    def _messages(self, gate: Gate, timeout_s: float) -> list[can.Message]:
        """Return the messages of the bus, after waiting for the first."""
        messages: list[can.Message] = []
        if self._fd >= 0:
            deadline_s = time.monotonic() + timeout_s
            events = gate.wait(timeout_s)
            if not events:
                return []
            if self._kernel_stamped:  # the kernel's stamps allow a wait for more
                gate.pause(min(BATCH_S, deadline_s - time.monotonic()))
        else:
            messages += self._first_in_slices(gate, timeout_s)
            if not messages:
                return []
            events = 0
        refused = self.counters.refused
        while len(messages) < MAX_FRAMES:
            try:
                message = self._read(0.0)
            except TransportError as error:
                self._fail_after(messages, error)
                break
            if message is None:
                break
            messages.append(message)
        if events & HUNG_UP and not messages and self.counters.refused == refused:
            raise TransportError(f"{self.name}: the CAN adapter was disconnected")
        return messages

    def _first_in_slices(self, gate: Gate, timeout_s: float) -> list[can.Message]:
        deadline_s = time.monotonic() + timeout_s
        while not gate.woken:
            left_s = deadline_s - time.monotonic()
            message = self._read(min(max(left_s, 0.0), SLICE_S))
            if message is not None:
                return [message]
            self._see_that_it_is_connected()
            if left_s <= 0:
                break
        return []

    def _see_that_it_is_connected(self) -> None:
        """Raise `TransportError` if the gateway closed the connection; socketcand's bus would then read nothing in a
        busy loop.
        """
        try:
            ended = self._connection is not None and not self._connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        except BlockingIOError:
            return
        except OSError as error:
            raise TransportError(f"{self.name}: the connection broke: {_one_line(error)}") from error
        if ended:
            raise TransportError(f"{self.name}: the gateway closed the connection")

    def _read(self, timeout_s: float) -> can.Message | None:
        """Return one message; None on silence, or on unreadable input, which is counted."""
        assert self._bus is not None
        try:
            return self._bus.recv(timeout_s)
        except can.CanError as error:
            if not isinstance(error.__cause__, _UNREADABLE):
                raise TransportError(f"{self.name}: the CAN bus failed: {_one_line(error)}") from error
            self._refuse(undecodable=isinstance(error.__cause__, UnicodeDecodeError))
        except OSError as error:
            raise TransportError(f"{self.name}: the CAN bus failed: {_one_line(error)}") from error
        except _UNREADABLE:
            self._refuse(undecodable=False)
        return None

    def _refuse(self, *, undecodable: bool) -> None:
        """Count unreadable input; slcan fails on an undecodable line again and again until it is flushed."""
        self.counters.refused += 1
        flush = getattr(self._bus, "flush", None)
        if undecodable and flush is not None:
            flush()

    def _send(self, data: bytes) -> None:
        assert self._bus is not None
        message = unpack_frame(data)
        message.timestamp = time.time()  # udp_multicast includes it in the datagram
        try:
            self._bus.send(message, timeout=SEND_TIMEOUT_S)
        except (can.CanError, OSError) as error:
            raise TransportError(f"{self.name}: sending failed: {_one_line(error)}") from error


def _descriptor(bus: can.BusABC) -> int:
    try:
        return int(bus.fileno())
    except (NotImplementedError, can.CanError):
        return -1


def _connect_once(connection: socket.socket, host: str, port: int) -> None:
    """Connect socketcand's bus; raises OSError where no gateway listens.

    python-can's own function tries for 10 s, thousands of times a second, with a line on stderr each time. A separate
    trial connection would occupy some gateways, which serve one client only.
    """
    connection.settimeout(CONNECT_S)
    try:
        connection.connect((host, port))
    except BaseException:  # no other code holds the socket
        connection.close()
        raise
    connection.settimeout(None)


def _connection(bus: can.BusABC) -> socket.socket | None:
    """Return the connection of a socketcand bus, with keepalive set; None for any other bus.

    python-can has no public access to it.
    """
    found = getattr(bus, "_SocketCanDaemonBus__socket", None)
    if not isinstance(found, socket.socket):
        return None
    found.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in _KEEPALIVE:
        found.setsockopt(socket.IPPROTO_TCP, option, value)
    return found


def _one_line(error: BaseException) -> str:
    """Return the root cause of an error: the system's text where one exists, else the interface's own."""
    root = error
    while root.__cause__ is not None or root.__context__ is not None:
        root = root.__cause__ or root.__context__ or root
    if isinstance(root, OSError) and root.strerror:
        return root.strerror
    return " ".join(str(error).split()) or type(error).__name__


def _blocks(frames: list[bytes], stamps: list[int] | None) -> list[UnitBlock]:
    """Group frames into blocks of equal length, in order."""
    blocks: list[UnitBlock] = []
    first = 0
    for last in range(1, len(frames) + 1):
        if last < len(frames) and len(frames[last]) == len(frames[first]):
            continue
        units = np.frombuffer(b"".join(frames[first:last]), np.uint8).reshape(last - first, len(frames[first]))
        realtime_ns = None if stamps is None else np.array(stamps[first:last], np.int64)
        blocks.append(UnitBlock(units, realtime_ns))
        first = last
    return blocks


def pack_frame(message: can.Message) -> bytes:
    """Pack a python-can message into a frame: 16 bytes, or 72 for CAN FD.

    Raises:
        ValueError: the identifier or the length does not fit a frame.
    """
    flags = (
        (CAN_EFF_FLAG if message.is_extended_id else 0)
        | (CAN_RTR_FLAG if message.is_remote_frame else 0)
        | (CAN_ERR_FLAG if message.is_error_frame else 0)
    )
    largest = CAN_EFF_MASK if message.is_extended_id or message.is_error_frame else CAN_SFF_MASK
    data = b"" if message.is_remote_frame else bytes(message.data)
    length = message.dlc if message.is_remote_frame else len(data)
    if not 0 <= message.arbitration_id <= largest or not 0 <= length <= (64 if message.is_fd else 8):
        raise ValueError(f"not a CAN frame: identifier {message.arbitration_id:#x}, {length} bytes")
    if not message.is_fd:
        return HEADER.pack(message.arbitration_id | flags, length, 0) + data.ljust(8, b"\0")
    fd_flags = (
        CANFD_FDF
        | (CANFD_BRS if message.bitrate_switch else 0)
        | (FD_ERROR_STATE if message.error_state_indicator else 0)
    )
    return HEADER.pack(message.arbitration_id | flags, length, fd_flags) + data.ljust(64, b"\0")


def unpack_frame(frame: bytes) -> can.Message:
    """Unpack a frame into a python-can message; its time stamp is 0.

    Raises:
        ValueError: the frame has not 16 or 72 bytes, or its length field exceeds the data.
    """
    if len(frame) not in (CAN_FRAME_BYTES, CANFD_FRAME_BYTES):
        raise ValueError(f"a CAN frame has {CAN_FRAME_BYTES} or {CANFD_FRAME_BYTES} bytes, not {len(frame)}")
    identifier, length, fd_flags = HEADER.unpack_from(frame)
    if length > len(frame) - HEADER.size:
        raise ValueError(f"a CAN frame of {len(frame)} bytes cannot hold {length} bytes of data")
    extended, error = bool(identifier & CAN_EFF_FLAG), bool(identifier & CAN_ERR_FLAG)
    is_fd, remote = len(frame) == CANFD_FRAME_BYTES, bool(identifier & CAN_RTR_FLAG)
    return can.Message(
        arbitration_id=identifier & (CAN_EFF_MASK if extended or error else CAN_SFF_MASK),
        is_extended_id=extended,
        is_remote_frame=remote,
        is_error_frame=error,
        is_fd=is_fd,
        bitrate_switch=is_fd and bool(fd_flags & CANFD_BRS),
        error_state_indicator=is_fd and bool(fd_flags & FD_ERROR_STATE),
        dlc=length,
        data=None if remote else frame[HEADER.size : HEADER.size + length],
    )
