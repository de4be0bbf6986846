"""Tests CAN with python-can on real multicast and a real pty; SocketCAN as far as possible without a CAN kernel."""

from __future__ import annotations

import itertools
import os
import socket
import struct
import threading
import time
import tty
from collections.abc import Callable, Iterator

import can
import numpy as np
import pytest

from swath.drivers.can_frames import CANFD_BRS, CANFD_FDF, encode_can_frame
from swath.drivers.transports.base import Transport, TransportError, UnitBlock
from swath.drivers.transports.can.adapter import PythonCanTransport, pack_frame, unpack_frame
from swath.drivers.transports.can.bitrate import bitrate_of_link, interface_bitrate
from swath.drivers.transports.can.socketcan import SocketCanTransport
from swath.drivers.transports.datagrams import MessageReader, ask_stamps
from swath.drivers.transports.opening import open_transport
from swath.drivers.transports.spec import parse_transport

pytestmark = pytest.mark.usefixtures("one_processor")

MULTICAST = "can:udp_multicast:239.74.163.2?port={}"


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("", 0))
        port: int = sock.getsockname()[1]
        return port


def collect(transport: Transport, count: int) -> list[UnitBlock]:
    """Return blocks until ``count`` units came or 5 s were silent."""
    blocks: list[UnitBlock] = []
    while sum(len(block.units) for block in blocks) < count:
        more = transport.receive(5.0)
        if not more:
            break
        blocks += more
    return blocks


def frames(blocks: list[UnitBlock]) -> list[bytes]:
    return [row.tobytes() for block in blocks for row in block.units]


def message(identifier: int, data: bytes, *, extended: bool = False) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=extended)


# ---- frames


def test_classic_frames_match_the_log_layout() -> None:
    assert pack_frame(message(0x123, b"\x01\x02\x03")) == encode_can_frame(0x123, b"\x01\x02\x03")
    assert pack_frame(message(0x18FF1234, bytes(8), extended=True)) == encode_can_frame(
        0x18FF1234, bytes(8), extended=True
    )
    # by hand: can_frame of <linux/can.h>
    assert pack_frame(message(0x7FF, b"\xaa")) == bytes.fromhex("ff070000 01 000000 aa00000000000000")


def test_remote_frame_carries_its_length_and_no_data() -> None:
    remote = can.Message(arbitration_id=0x10, is_extended_id=False, is_remote_frame=True, dlc=8)
    assert pack_frame(remote) == bytes.fromhex("10000040 08 000000 0000000000000000")


def test_an_fd_frame_matches_the_log_layout() -> None:
    fd = can.Message(arbitration_id=0x55, is_extended_id=False, is_fd=True, bitrate_switch=True, data=bytes(range(12)))
    frame = pack_frame(fd)
    assert len(frame) == 72
    assert frame[:8] == struct.pack("<IBBxx", 0x55, 12, CANFD_FDF | CANFD_BRS)
    assert frame[8:20] == bytes(range(12))
    assert frame[20:] == bytes(52)


@pytest.mark.parametrize(
    "flags", list(itertools.product((False, True), repeat=3)), ids=lambda flags: "".join("01"[flag] for flag in flags)
)
def test_a_frame_converts_to_a_message_and_back(flags: tuple[bool, bool, bool]) -> None:
    extended, fd, special = flags
    sent = can.Message(
        arbitration_id=0x1234567 if extended else 0x345,
        is_extended_id=extended,
        is_fd=fd,
        is_remote_frame=special and not fd,
        error_state_indicator=special and fd,
        bitrate_switch=fd,
        dlc=8,
        data=None if special and not fd else b"abcdefgh",
    )
    assert unpack_frame(pack_frame(sent)).equals(sent, timestamp_delta=None, check_direction=False)


@pytest.mark.parametrize("sent", [message(0x800, b""), message(-1, b""), message(1, bytes(8))])
def test_a_message_that_fits_no_frame_is_refused(sent: can.Message) -> None:
    sent.data = bytearray(9) if sent.arbitration_id == 1 else sent.data
    with pytest.raises(ValueError, match="not a CAN frame"):
        pack_frame(sent)


@pytest.mark.parametrize("frame", [b"", bytes(15), bytes(17), b"\0\0\0\0\x09".ljust(16, b"\0")])
def test_bytes_that_are_not_a_frame_are_not_sent(frame: bytes) -> None:
    with pytest.raises(ValueError, match="CAN frame"):
        unpack_frame(frame)


# ---- udp_multicast


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def bus(port: int) -> Iterator[can.BusABC]:
    bus = can.Bus(interface="udp_multicast", channel="239.74.163.2", port=port, ignore_config=True)
    yield bus
    bus.shutdown()


@pytest.fixture
def transport(port: int) -> Iterator[PythonCanTransport]:
    transport = PythonCanTransport(parse_transport(MULTICAST.format(port)))
    transport.open()
    yield transport
    transport.close()


def test_frames_arrive_in_order_with_kernel_timestamps(transport: PythonCanTransport, bus: can.BusABC) -> None:
    sent = [message(0x100 + n % 5, n.to_bytes(4, "big")) for n in range(500)]
    before_ns = time.time_ns()
    for item in sent:
        bus.send(item)
    after_ns = time.time_ns()
    time.sleep(0.05)  # the time of the read would be later
    blocks = collect(transport, len(sent))
    assert frames(blocks) == [pack_frame(item) for item in sent]
    stamps = np.concatenate([block.kernel_realtime_ns for block in blocks])
    assert np.all(np.diff(stamps) >= 0)
    assert before_ns - 1000 <= stamps[0]  # python-can hands them over as float seconds, 238 ns apart
    assert stamps[-1] <= after_ns + 1000
    assert transport.poll_counters().lost_kernel == 0


def test_classic_and_fd_frames_can_be_mixed(transport: PythonCanTransport, bus: can.BusABC) -> None:
    sent = [
        can.Message(arbitration_id=n, is_extended_id=False, is_fd=n in (3, 4), data=bytes([n])) for n in range(1, 7)
    ]
    for item in sent:
        bus.send(item)
    time.sleep(0.05)
    blocks = collect(transport, len(sent))
    assert frames(blocks) == [pack_frame(item) for item in sent]
    assert [block.units.shape for block in blocks] == [(2, 16), (2, 72), (2, 16)]


def test_error_frames_and_bus_off_are_delivered_and_counted(transport: PythonCanTransport, bus: can.BusABC) -> None:
    for error_class in (0x04, 0x40):  # controller problems; bus off
        bus.send(can.Message(arbitration_id=error_class, is_extended_id=False, is_error_frame=True, data=bytes(8)))
    units = frames(collect(transport, 2))
    assert [int.from_bytes(unit[:4], "little") for unit in units] == [0x2000_0004, 0x2000_0040]
    assert transport.counters.error_frames == 2
    assert transport.counters.bus_off == 1


@pytest.mark.parametrize("garbage", [b"", b"\x00", b"\xc1\xff", b"\x93\x01\x02\x03", b"not msgpack" * 20])
def test_garbage_on_the_group_is_counted_and_skipped(
    transport: PythonCanTransport, bus: can.BusABC, port: int, garbage: bytes
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        bus.send(message(1, b"a"))
        stranger.sendto(garbage, ("239.74.163.2", port))
        bus.send(message(2, b"b"))
    assert frames(collect(transport, 2)) == [pack_frame(message(1, b"a")), pack_frame(message(2, b"b"))]
    assert transport.poll_counters().refused == 1


def test_received_and_lost_counts_equal_the_frames_sent(bus: can.BusABC, port: int) -> None:
    transport = PythonCanTransport(parse_transport(MULTICAST.format(port)))
    transport.open()
    assert transport._sock is not None
    transport._sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
    sent = 600
    for number in range(sent):
        bus.send(message(1, number.to_bytes(4, "big")))
    received = 0
    while blocks := transport.receive(0.2):
        received += sum(len(block.units) for block in blocks)
    lost = transport.poll_counters().lost_kernel
    transport.close()
    assert lost > 0
    assert received + lost == sent


# ---- slcan on a pty


class SlcanAdapter:
    """The far end of an slcan line: a pty that answers as the adapter does."""

    def __init__(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(self.master)
        self.path = os.ttyname(slave)
        os.close(slave)
        self.transport = PythonCanTransport(parse_transport(f"can:slcan:{self.path}?sleep_after_open=0"))
        self.transport.open()

    def say(self, text: bytes) -> None:
        os.write(self.master, text)

    def close(self) -> None:
        self.transport.close()
        if self.master >= 0:
            os.close(self.master)


@pytest.fixture
def adapter() -> Iterator[SlcanAdapter]:
    adapter = SlcanAdapter()
    yield adapter
    adapter.close()


def test_slcan_frames_are_received(adapter: SlcanAdapter) -> None:
    assert os.read(adapter.master, 100).endswith(b"O\r")  # the adapter is told to open its channel
    adapter.say(b"t1232AABB\rT18FF12340\r\rr0104\r" + b"t7FF81122334455667788\r" * 20)
    expected = [
        encode_can_frame(0x123, b"\xaa\xbb"),
        encode_can_frame(0x18FF1234, b"", extended=True),
        pack_frame(can.Message(arbitration_id=0x10, is_extended_id=False, is_remote_frame=True, dlc=4)),
        *[encode_can_frame(0x7FF, bytes.fromhex("1122334455667788"))] * 20,
    ]
    blocks = collect(adapter.transport, len(expected))
    assert frames(blocks) == expected
    assert all(block.kernel_realtime_ns is None for block in blocks)  # stamped by python-can on reading


def test_slcan_frames_are_sent(adapter: SlcanAdapter) -> None:
    os.read(adapter.master, 100)
    adapter.transport.send(encode_can_frame(0x321, b"\x01\x02"))
    assert os.read(adapter.master, 100) == b"t32120102\r"


@pytest.mark.parametrize("garbage", [b"tXYZ2AABB\r", b"t1\r", b"\xff\xfe\r", b"t1239112233445566778899\r"])
def test_slcan_garbage_is_counted_and_later_frames_arrive(adapter: SlcanAdapter, garbage: bytes) -> None:
    adapter.say(garbage)
    assert adapter.transport.receive(1.0) == []
    assert adapter.transport.counters.refused == 1
    adapter.say(b"t1230\r")
    assert frames(collect(adapter.transport, 1)) == [encode_can_frame(0x123, b"")]


def test_unplugging_an_slcan_adapter_raises_a_transport_error(adapter: SlcanAdapter) -> None:
    os.close(adapter.master)
    adapter.master = -1
    with pytest.raises(TransportError, match=r"the CAN (bus failed|adapter was disconnected)"):
        adapter.transport.receive(5.0)
    adapter.transport.close()


@pytest.mark.parametrize(
    ("interface", "cut_off", "whole"),
    [
        ("serial", "aa010203", "aa00000000" + "02" + "23010000" + "aabb" + "bb"),
        ("seeedstudio", "aac223", "aac2" + "2301" + "aabb" + "55"),
    ],
)
def test_a_truncated_binary_frame_is_counted_and_the_next_one_arrives(interface: str, cut_off: str, whole: str) -> None:
    """An adapter that resets, or a line that loses bytes, must not end the thread that reads it."""
    master, slave = os.openpty()
    tty.setraw(slave)
    transport = PythonCanTransport(parse_transport(f"can:{interface}:{os.ttyname(slave)}?timeout=0.05"))
    transport.open()
    try:
        os.write(master, bytes.fromhex(cut_off))
        assert transport.receive(1.0) == []
        assert transport.counters.refused == 1
        os.write(master, bytes.fromhex(whole))
        assert frames(collect(transport, 1)) == [encode_can_frame(0x123, b"\xaa\xbb")]
    finally:
        transport.close()
        os.close(master)
        os.close(slave)


# ---- what every bus must do


def test_a_virtual_bus_without_a_file_descriptor_works() -> None:
    transport = PythonCanTransport(parse_transport("can:virtual:swath-test"))
    transport.open()
    with can.Bus(interface="virtual", channel="swath-test", ignore_config=True) as other:
        other.send(message(5, b"virtual"))
        blocks = collect(transport, 1)
        assert frames(blocks) == [encode_can_frame(5, b"virtual")]
        assert blocks[0].kernel_realtime_ns is None
        assert transport.receive(0.05) == []
        transport.send(encode_can_frame(6, b"back"))
        answer = other.recv(5.0)
        assert answer is not None
        assert bytes(answer.data) == b"back"
    transport.close()


@pytest.mark.parametrize("kind", [MULTICAST, "can:virtual:swath-blocked"])
def test_close_from_another_thread_ends_a_blocked_receive(kind: str) -> None:
    text = kind.format(free_port())
    transport = open_transport(parse_transport(text))
    transport.open()
    got: list[object] = []
    thread = threading.Thread(target=lambda: got.append(transport.receive(60.0)))
    thread.start()
    time.sleep(0.1)
    transport.close()
    thread.join(timeout=30.0)
    assert got == [[]]
    with pytest.raises(TransportError, match="is closed"):
        transport.receive(0.0)


def test_a_failing_bus_raises_a_transport_error(monkeypatch: pytest.MonkeyPatch) -> None:
    transport = PythonCanTransport(parse_transport("can:virtual:swath-dying"))
    transport.open()

    def die(_: float) -> None:
        raise can.CanOperationError("the adapter reports an error") from OSError(5, "Input/output error")

    monkeypatch.setattr(transport._bus, "recv", die)
    with pytest.raises(TransportError, match="the CAN bus failed: Input/output error"):
        transport.receive(0.1)
    transport.close()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("can:slcan:/nonexistent/ttyACM0", "cannot open the CAN bus: No such file or directory"),
        ("can:socketcand:x", r"socketcand needs the options \?host=…&port=…"),
        ("can:serial:/dev/null", "cannot open the CAN bus: /dev/null is not a serial port; see `ls /dev/serial/by-id`"),
        ("can:slcan:/dev/null", "cannot open the CAN bus: /dev/null is not a serial port; see `ls /dev/serial/by-id`"),
        ("can:udp_multicast:10.0.0.1", "cannot open the CAN bus: Invalid argument"),
        ("can:kvaser:0", "the library of the kvaser adapter is not installed"),
        ("can:socketcan:nosuch0", "network interface nosuch0 does not exist; see `ip link`"),
    ],
)
def test_error_on_opening_gives_the_reason(text: str, says: str) -> None:
    transport = open_transport(parse_transport(text))
    with pytest.raises(TransportError, match=says) as caught:
        transport.open()
    assert "\n" not in str(caught.value)
    transport.close()


# ---- SocketCAN


def kernel_has_can() -> bool:
    try:
        socket.socket(29, socket.SOCK_RAW, 1).close()
    except OSError:
        return False
    return True


def test_socketcan_refuses_an_interface_that_is_not_can() -> None:
    transport = SocketCanTransport(parse_transport("can:socketcan:lo"))
    if kernel_has_can():
        says = "lo is gone or is no CAN interface"
    else:
        says = r"this kernel has no CAN support loaded; run `modprobe can_raw`"
    with pytest.raises(TransportError, match=says):
        transport.open()
    transport.close()


def test_socketcan_counts_error_frames_and_bus_off() -> None:
    transport = SocketCanTransport(parse_transport("can:socketcan:can0"))
    identifiers = [0x123, 0x2000_0004, 0x2000_0040, 0x2000_0044, 0x8000_0040]
    units = b"".join(struct.pack("<IB3x8x", identifier, 8) for identifier in identifiers)
    transport._count_errors(UnitBlock(np.frombuffer(units, np.uint8).reshape(-1, 16)))
    assert transport.counters.error_frames == 3
    assert transport.counters.bus_off == 2


def test_frame_slots_of_the_reader_keep_classic_and_fd_apart() -> None:
    """SocketCAN is read like UDP with slots of 72 bytes and no sender; a datagram pair stands in for the bus."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    ask_stamps(near)
    reader = MessageReader(72, 256, peers=False)
    sent = [bytes([n]) * (72 if n in (3, 4, 5) else 16) for n in range(10)]
    for frame in sent:
        far.send(frame)
    blocks = reader.blocks(reader.read(near.fileno()))
    assert frames(blocks) == sent
    assert [block.units.shape for block in blocks] == [(3, 16), (3, 72), (4, 16)]
    assert all(block.peer is None for block in blocks)
    assert reader.blocks(reader.read(near.fileno())) == []
    near.close()
    far.close()


# ---- bit rate of an interface


def attribute(kind: int, value: bytes) -> bytes:
    return struct.pack("=HH", 4 + len(value), kind) + value.ljust((len(value) + 3) & ~3, b"\0")


def link_message(info: bytes) -> bytes:
    """Return an RTM_NEWLINK as the kernel sends it: header, ifinfomsg, name, link info."""
    body = struct.pack("=BxHiII", 0, 280, 4, 0, 0) + attribute(3, b"can0\0") + attribute(18, info)
    return struct.pack("=IHHII", 16 + len(body), 16, 0, 1, 0) + body


def can_info(bitrate: int) -> bytes:
    timing = attribute(1, struct.pack("=8I", bitrate, 875, 125, 6, 7, 2, 1, 1))
    state = attribute(4, struct.pack("=I", 0))
    return attribute(1, b"can\0") + attribute(2 | 0x8000, state + timing)


def test_bit_rate_is_read_from_a_link_message() -> None:
    assert bitrate_of_link(link_message(can_info(1_000_000))) == 1_000_000
    assert bitrate_of_link(link_message(attribute(1, b"vcan\0"))) is None


@pytest.mark.parametrize("cut", [lambda m, n: m[:n], lambda m, n: m[:n] + b"\xff" + m[n + 1 :]], ids=["cut", "flipped"])
def test_a_damaged_link_message_never_raises(cut: Callable[[bytes, int], bytes]) -> None:
    whole = link_message(can_info(500_000))
    for at in range(len(whole)):
        bitrate_of_link(cut(whole, at))


def test_interfaces_without_a_bit_rate_give_none() -> None:
    assert interface_bitrate("lo") is None
    assert interface_bitrate("nosuch0") is None


# ---- socketcand on loopback


def test_a_closed_gateway_is_detected_and_reopened() -> None:
    with socket.create_server(("127.0.0.1", 0)) as gateway:
        gateway.settimeout(10.0)

        def greet() -> socket.socket:
            connection, _ = gateway.accept()
            connection.sendall(b"< hi >")
            for _ in ("open", "rawmode"):
                connection.recv(100)
                connection.sendall(b"< ok >")
            return connection

        port = gateway.getsockname()[1]
        for _ in range(2):
            transport = PythonCanTransport(parse_transport(f"can:socketcand:can0?host=127.0.0.1&port={port}"))
            opening = threading.Thread(target=transport.open, daemon=True)
            opening.start()
            with greet() as connection:
                opening.join()
                assert transport.receive(0.05) == []
                connection.sendall(b"< frame 123 1.5 AABB >")
                assert frames(collect(transport, 1)) == [encode_can_frame(0x123, b"\xaa\xbb")]
                connection.sendall(b"< frame 124 1.5 CC >")
            assert frames(collect(transport, 1)) == [encode_can_frame(0x124, b"\xcc")]
            with pytest.raises(TransportError, match="the gateway closed the connection"):
                transport.receive(5.0)
            transport.close()


def test_a_gateway_with_a_single_client_is_retried_until_it_is_free() -> None:
    """The gateway may take a while to notice that a client has gone, and refuses the next one meanwhile."""
    with socket.create_server(("127.0.0.1", 0)) as gateway:

        def serve() -> None:
            with gateway.accept()[0] as only:
                gateway.close()
                only.sendall(b"< hi >")
                while only.recv(100):
                    only.sendall(b"< ok >")

        port = gateway.getsockname()[1]
        serving = threading.Thread(target=serve, daemon=True)
        serving.start()
        transport = PythonCanTransport(parse_transport(f"can:socketcand:can0?host=127.0.0.1&port={port}"))
        transport.open()
        transport.close()
        serving.join(5.0)


def test_an_absent_gateway_is_contacted_once(caplog: pytest.LogCaptureFixture) -> None:
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))  # it does not listen
        port = nobody.getsockname()[1]
        transport = PythonCanTransport(parse_transport(f"can:socketcand:can0?host=127.0.0.1&port={port}"))
        with pytest.raises(TransportError, match="cannot open the CAN bus: Connection refused"):
            transport.open()
    assert not [record for record in caplog.records if "Failed to connect" in record.message]
