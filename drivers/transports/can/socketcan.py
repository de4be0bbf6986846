"""SocketCAN: a raw AF_CAN socket with kernel stamps, drop count, CAN FD and error frames.

Bit rate and state belong to the system (``ip link``, systemd-networkd), not to a socket;
`swath.drivers.transports.can.bitrate` reads the interface's bit rate.
"""

from __future__ import annotations

import errno
import os
import socket
import struct
import time

import numpy as np

from swath.drivers.can_frames import CAN_ERR_FLAG, CANFD_FRAME_BYTES
from swath.drivers.transports.base import TransportError, UnitBlock
from swath.drivers.transports.datagrams import DropCounter, MessageReader, ask_receive_buffer, ask_stamps
from swath.drivers.transports.descriptor import DescriptorTransport, Gate, wait_writable
from swath.drivers.transports.spec import TransportSpec

SLOTS = 256
BATCH_S = 0.016  # 130 frames of a full 1 Mbit/s bus; the kernel has their stamps
MAX_CALLS = 16
DEFAULT_BUFFER_MB = 4
SEND_TIMEOUT_S = 1.0

# <linux/can.h>, <linux/can/raw.h>, <linux/can/error.h>
_AF_CAN = 29
_CAN_RAW = 1
_SOL_CAN_RAW = 101
_CAN_RAW_ERR_FILTER = 2
_CAN_RAW_FD_FRAMES = 5
_ERROR_CLASSES = 0x1FFF_FFFF  # CAN_ERR_MASK: every class of error frame
_ERROR_BUS_OFF = 0x40
_ALL_ERRORS = struct.pack("@I", _ERROR_CLASSES)


class SocketCanTransport(DescriptorTransport):
    """Receives one SocketCAN interface; a unit is a frame of 16 or 72 bytes, error frames included.

    Args:
        spec: ``can:socketcan:<interface>``; options bitrate, data_bitrate (compared by ``swath check``, not set),
            fd, buffer_mb.
        batch_s: wait for more frames after the first.
    """

    def __init__(self, spec: TransportSpec, batch_s: float = BATCH_S) -> None:
        super().__init__(spec.text or f"can:{spec.address}")
        self._spec = spec
        self._channel = spec.channel
        self._batch_s = batch_s
        self._sock: socket.socket | None = None
        self._drops: DropCounter | None = None
        self._reader = MessageReader(CANFD_FRAME_BYTES, SLOTS, peers=False)

    def _open_device(self) -> int:
        try:
            socket.if_nametoindex(self._channel)
        except OSError as error:
            raise TransportError(
                f"{self.name}: network interface {self._channel} does not exist; see `ip link`"
            ) from error
        sock = self._socket()
        try:
            self._configure(sock)
        except OSError as error:
            sock.close()
            raise TransportError(self._why(error)) from error
        self._sock = sock
        self._drops = DropCounter(sock)
        return sock.fileno()

    def _socket(self) -> socket.socket:
        try:
            return socket.socket(_AF_CAN, socket.SOCK_RAW | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC, _CAN_RAW)
        except OSError as error:
            if error.errno == errno.EAFNOSUPPORT:
                text = "this kernel has no CAN support loaded; run `modprobe can_raw`"
            else:
                text = f"cannot open a CAN socket: {error.strerror}"
            raise TransportError(f"{self.name}: {text}") from error

    def _configure(self, sock: socket.socket) -> None:
        asked = int(self._spec.options.get("buffer_mb", DEFAULT_BUFFER_MB)) << 20
        self.counters.receive_buffer_asked_bytes = asked
        self.counters.receive_buffer_bytes = ask_receive_buffer(sock, asked)
        ask_stamps(sock)
        sock.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FD_FRAMES, int(self._spec.flag("fd", default=True)))
        sock.setsockopt(_SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, _ALL_ERRORS)
        sock.bind((self._channel,))
        pending = sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)  # reports an interface that is down
        if pending:
            raise OSError(pending, os.strerror(pending))

    def _why(self, error: OSError) -> str:
        channel = self._channel
        if error.errno == errno.ENETDOWN:
            bitrate = self._spec.options.get("bitrate")
            setting = f" type can bitrate {bitrate}" if bitrate else ""
            return f"{self.name}: {channel} is down; run `ip link set {channel} up{setting}`"
        if error.errno in (errno.ENODEV, errno.ENXIO):
            return f"{self.name}: {channel} is gone or is not a CAN interface; see `ip link show type can`"
        return f"{self.name}: CAN socket failed: {error.strerror}"

    def _close_device(self) -> None:
        if self._sock is not None:
            self._sock.close()
            self._sock = None

    def _refresh_counters(self) -> None:
        if self._drops is not None:
            self.counters.lost_kernel = self._drops.update()

    def _receive(self, gate: Gate, timeout_s: float) -> list[UnitBlock]:
        deadline_s = time.monotonic() + timeout_s
        if not gate.wait(timeout_s):
            return []
        batch_s = min(self._batch_s, deadline_s - time.monotonic())
        if batch_s > 0:
            time.sleep(batch_s)
        assert self._sock is not None
        blocks: list[UnitBlock] = []
        for _ in range(MAX_CALLS):
            try:
                count = self._reader.read(self._sock.fileno())
            except OSError as error:
                self._fail_after(blocks, TransportError(self._why(error)))
                break
            blocks += self._reader.blocks(count)
            if count < self._reader.offered:
                break
        for block in blocks:
            self._count_errors(block)
        return blocks

    def _count_errors(self, block: UnitBlock) -> None:
        identifiers = block.units[:, :4].copy().view("<u4")[:, 0]
        errors = identifiers[(identifiers & CAN_ERR_FLAG) != 0]
        self.counters.error_frames += len(errors)
        self.counters.bus_off += int(np.count_nonzero(errors & _ERROR_BUS_OFF))

    def _send(self, data: bytes) -> None:
        assert self._sock is not None
        deadline_s = time.monotonic() + SEND_TIMEOUT_S
        while True:
            try:
                self._sock.send(data)
                return
            except OSError as error:
                full = error.errno in (errno.ENOBUFS, errno.EAGAIN)
                if not full or time.monotonic() > deadline_s:
                    raise TransportError(self._why(error)) from error
            if wait_writable(self._sock.fileno(), deadline_s):
                time.sleep(0.001)  # ENOBUFS: the interface's own queue is full, which poll does not report
