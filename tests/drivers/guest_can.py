"""Tests SocketCAN in a virtual machine whose kernel has it, as root: `pytest tests/drivers/guest_can.py`.

The modules vcan and can_raw must be loaded. The last test needs can0 and can1 on one bus (two emulated kvaser_pci:
qemu's ``-object can-bus,id=cb -device kvaser_pci,canbus=cb``, twice).
"""

from __future__ import annotations

import socket
import struct
import subprocess
import threading
import time
from collections.abc import Iterator

import pytest

from swath.drivers.can_frames import encode_can_frame
from swath.drivers.transports.base import Transport, TransportError
from swath.drivers.transports.can.bitrate import interface_bitrate
from swath.drivers.transports.can.socketcan import SocketCanTransport
from swath.drivers.transports.spec import parse_transport


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)


def can(channel: str, options: str = "") -> SocketCanTransport:
    return SocketCanTransport(parse_transport(f"can:socketcan:{channel}{options}"))


def frames(transport: Transport) -> list[bytes]:
    """Return all frames until 0.5 s of silence."""
    got: list[bytes] = []
    while blocks := transport.receive(0.5):
        got += [row.tobytes() for block in blocks for row in block.units]
    return got


@pytest.fixture
def vcan() -> Iterator[str]:
    ip("link", "add", "vcan7", "type", "vcan")
    ip("link", "set", "up", "vcan7")
    yield "vcan7"
    subprocess.run(["ip", "link", "del", "vcan7"], check=False, stderr=subprocess.DEVNULL)


@pytest.fixture
def raw(vcan: str) -> Iterator[socket.socket]:
    with socket.socket(29, socket.SOCK_RAW, 1) as sock:
        sock.bind((vcan,))
        yield sock


def test_frames_arrive_in_order_with_kernel_timestamps(vcan: str) -> None:
    sender, receiver = can(vcan), can(vcan)
    sender.open()
    receiver.open()
    sent = [encode_can_frame(0x100 + n % 7, n.to_bytes(4, "big"), fd=n % 50 == 0) for n in range(2000)]
    before_ns = time.time_ns()
    for frame in sent:
        sender.send(frame)
    after_ns = time.time_ns()
    got: list[bytes] = []
    stamps: list[int] = []
    while blocks := receiver.receive(0.5):
        got += [row.tobytes() for block in blocks for row in block.units]
        for block in blocks:
            assert block.kernel_realtime_ns is not None
            stamps += block.kernel_realtime_ns.tolist()
    assert got == sent
    assert len(stamps) == len(sent)
    assert [before_ns, *stamps, after_ns] == sorted([before_ns, *stamps, after_ns])
    assert frames(sender) == []  # a sender does not receive its own frames
    sender.close()
    receiver.close()


def test_received_and_lost_counts_equal_the_frames_sent(vcan: str, raw: socket.socket) -> None:
    receiver = can(vcan)
    receiver.open()
    assert receiver._sock is not None
    receiver._sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 20_000)
    for _ in range(3000):
        raw.send(encode_can_frame(1, b"x"))
    received = len(frames(receiver))
    lost = receiver.poll_counters().lost_kernel
    assert lost > 0
    assert received + lost == 3000
    receiver.close()


def test_error_frames_and_bus_off_are_delivered_and_counted(vcan: str, raw: socket.socket) -> None:
    receiver = can(vcan)
    receiver.open()
    for error_class in (0x04, 0x40):
        raw.send(struct.pack("<IB3x8x", 0x2000_0000 | error_class, 8))
    assert len(frames(receiver)) == 2
    assert (receiver.counters.error_frames, receiver.counters.bus_off) == (2, 1)
    receiver.close()


def test_an_interface_that_goes_down_and_up_again_is_reopened(vcan: str) -> None:
    receiver = can(vcan, "?bitrate=500000")
    receiver.open()
    timer = threading.Timer(0.3, ip, ("link", "set", "down", vcan))
    timer.start()
    with pytest.raises(TransportError, match=f"{vcan} is down; run `ip link set {vcan} up type can bitrate 500000`"):
        receiver.receive(30.0)
    timer.join()
    receiver.close()
    with pytest.raises(TransportError, match="is down"):
        receiver.open()
    ip("link", "set", "up", vcan)
    receiver.open()
    with socket.socket(29, socket.SOCK_RAW, 1) as sock:
        sock.bind((vcan,))
        sock.send(encode_can_frame(2, b"again"))
    assert frames(receiver) == [encode_can_frame(2, b"again")]
    receiver.close()


def test_an_interface_that_is_removed_raises_a_transport_error(vcan: str) -> None:
    receiver = can(vcan)
    receiver.open()
    timer = threading.Timer(0.3, ip, ("link", "del", vcan))
    timer.start()
    with pytest.raises(TransportError, match=f"{vcan} is gone"):
        receiver.receive(30.0)
    timer.join()
    with pytest.raises(TransportError, match=f"{vcan} is gone"):
        receiver.send(encode_can_frame(1, b""))
    receiver.close()
    with pytest.raises(TransportError, match=f"network interface {vcan} does not exist"):
        receiver.open()


def test_opening_an_interface_that_is_not_can_is_refused() -> None:
    with pytest.raises(TransportError, match="lo is gone or is no CAN interface"):
        can("lo").open()


def test_controllers_with_a_bit_rate_exchange_frames() -> None:
    for channel in ("can0", "can1"):
        ip("link", "set", channel, "type", "can", "bitrate", "500000")
        ip("link", "set", "up", channel)
        assert interface_bitrate(channel) == 500_000
    sender, receiver = can("can0"), can("can1")
    sender.open()
    receiver.open()
    sent = [encode_can_frame(0x18FF0000 | n, n.to_bytes(8, "big"), extended=True) for n in range(100)]
    for frame in sent:
        sender.send(frame)
        time.sleep(0.005)  # otherwise the emulated controller overruns and sends error frames
    assert frames(receiver) == sent
    sender.close()
    receiver.close()
