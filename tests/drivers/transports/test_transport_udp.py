"""Tests UDP over real sockets of this machine: order, stamps, exact losses, filters, and clear errors."""

from __future__ import annotations

import ctypes
import random
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from swath.drivers.transports import holders
from swath.drivers.transports.base import HEAD_ROOM_BYTES, TransportError, UnitBlock
from swath.drivers.transports.spec import parse_transport
from swath.drivers.transports.udp_socket import UdpTransport

pytestmark = pytest.mark.usefixtures("one_processor")

GROUP = "239.74.163.77"


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        port: int = sock.getsockname()[1]
        return port


def transport(options: str = "", host: str = "127.0.0.1", port: int | None = None) -> UdpTransport:
    return UdpTransport(parse_transport(f"udp:{host}:{port or free_port()}{options}"))


def port_of(udp: UdpTransport) -> int:
    return udp._spec.port


@pytest.fixture
def sender() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        yield sock


def collect(udp: UdpTransport, units: int) -> list[UnitBlock]:
    """Return blocks until ``units`` have arrived or 5 s of silence."""
    blocks: list[UnitBlock] = []
    while sum(len(block.units) for block in blocks) < units:
        more = udp.receive(5.0)
        if not more:
            break
        blocks += more
    return blocks


def payloads(blocks: list[UnitBlock]) -> list[bytes]:
    return [row.tobytes() for block in blocks for row in block.units]


def test_a_burst_of_mixed_lengths_arrives_completely_and_in_order(sender: socket.socket) -> None:
    rng = random.Random(1)
    sent = [rng.randbytes(rng.choice([1, 512, 512, 1206, 1206, 1206, 8448])) for _ in range(3000)]
    udp = transport()
    udp.open()
    for data in sent:
        sender.sendto(data, ("127.0.0.1", port_of(udp)))
    blocks = collect(udp, len(sent))
    assert payloads(blocks) == sent
    for block in blocks:
        assert block.peer == sender.getsockname()
        assert block.rows is None or block.rows.flags.c_contiguous
    assert udp.poll_counters().lost_kernel == 0
    udp.close()


def test_empty_and_largest_datagrams_are_delivered(sender: socket.socket) -> None:
    udp = transport()
    udp.open()
    sent = [b"", b"\xa5" * 65507, b"", b"", b"\x5a" * 65507]
    for data in sent:
        sender.sendto(data, ("127.0.0.1", port_of(udp)))
    blocks = collect(udp, len(sent))
    assert payloads(blocks) == sent
    assert [block.units.shape for block in blocks] == [(1, 0), (1, 65507), (2, 0), (1, 65507)]
    udp.close()


def test_runs_of_equal_length_are_one_block(sender: socket.socket) -> None:
    udp = transport()
    udp.open()
    for index in range(200):
        sender.sendto(index.to_bytes(2, "big") * 603, ("127.0.0.1", port_of(udp)))
    blocks = udp.receive(5.0)
    assert [block.units.shape for block in blocks] == [(200, 1206)]
    assert np.array_equal(blocks[0].units[:, 1], np.arange(200))
    udp.close()


def test_blocks_are_not_changed_by_later_reads(sender: socket.socket) -> None:
    udp = transport()
    udp.open()
    sender.sendto(b"first", ("127.0.0.1", port_of(udp)))
    first = udp.receive(5.0)
    sender.sendto(b"other", ("127.0.0.1", port_of(udp)))
    assert payloads(udp.receive(5.0)) == [b"other"]
    assert payloads(first) == [b"first"]
    udp.close()


def test_writing_into_the_spare_bytes_before_units_changes_no_unit(sender: socket.socket) -> None:
    """Units span several of the reader's memories, with lengths that change now and then."""
    rng = random.Random(2)
    sent, length = [], 1206
    for _ in range(4000):
        length = rng.choice([90, 1206, 3000]) if rng.random() < 0.002 else length
        sent.append(rng.randbytes(length))
    udp, blocks = transport(), []
    udp.open()
    for first in range(0, len(sent), 500):
        for data in sent[first : first + 500]:
            sender.sendto(data, ("127.0.0.1", port_of(udp)))
        blocks += collect(udp, 500)
    with_room = [block for block in blocks if block.rows is not None]
    for block in with_room:
        assert block.rows is not None
        assert np.array_equal(block.rows[:, HEAD_ROOM_BYTES:], block.units)
        block.rows[:, :HEAD_ROOM_BYTES] = 0xEE
    assert payloads(blocks) == sent
    assert sum(len(block.units) for block in with_room) > 1000
    udp.close()


def test_timestamps_come_from_the_kernel_and_are_ordered(sender: socket.socket) -> None:
    udp = transport()
    udp.open()
    before = time.time_ns()
    for _ in range(300):
        sender.sendto(b"x" * 1206, ("127.0.0.1", port_of(udp)))
    after_sending = time.time_ns()
    time.sleep(0.05)  # the time of the read would be later
    stamps = np.concatenate([block.kernel_realtime_ns for block in collect(udp, 300)])
    assert stamps.dtype == np.int64
    assert len(stamps) == 300
    assert np.all(np.diff(stamps) >= 0)
    assert before <= stamps[0]
    assert stamps[-1] <= after_sending
    udp.close()


def test_the_first_datagram_after_opening_has_its_arrival_timestamp(sender: socket.socket) -> None:
    """This holds even if no other program requested timestamps; the kernel enables them with a delay."""
    for _ in range(20):
        udp = transport()
        udp.open()
        sender.sendto(b"first", ("127.0.0.1", port_of(udp)))
        time.sleep(0.02)
        before_reading_ns = time.time_ns()
        (block,) = collect(udp, 1)
        udp.close()
        assert block.kernel_realtime_ns is not None
        assert block.kernel_realtime_ns[0] < before_reading_ns
        time.sleep(0.02)  # the kernel stops, unless another program wants stamps


def test_datagrams_of_two_senders_keep_their_peer(sender: socket.socket) -> None:
    udp = transport(host="0.0.0.0")
    udp.open()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.2", 0))
        for number in range(50):
            sender.sendto(b"a%d" % (number % 10), ("127.0.0.1", port_of(udp)))
            other.sendto(b"b%d" % (number % 10), ("127.0.0.1", port_of(udp)))
        peers = [sender.getsockname(), other.getsockname()]
    blocks = collect(udp, 100)
    for peer, letter in zip(peers, (b"a", b"b"), strict=True):
        assert payloads([b for b in blocks if b.peer == peer]) == [letter + b"%d" % (n % 10) for n in range(50)]
    udp.close()


@pytest.mark.parametrize("length", [200, 1206, 8448])
def test_received_and_lost_counts_equal_the_datagrams_sent(sender: socket.socket, length: int) -> None:
    udp = transport("?buffer_mb=1")
    udp.open()
    sent = 6000
    for _ in range(sent):
        sender.sendto(bytes(length), ("127.0.0.1", port_of(udp)))
    received = sum(len(block.units) for block in iter_until_silent(udp))
    lost = udp.poll_counters().lost_kernel
    assert lost > 0
    assert received > 0
    assert received + lost == sent
    for _ in range(sent):  # once more, because the count is a total
        sender.sendto(bytes(length), ("127.0.0.1", port_of(udp)))
    received += sum(len(block.units) for block in iter_until_silent(udp))
    udp.close()
    assert received + udp.poll_counters().lost_kernel == 2 * sent


def iter_until_silent(udp: UdpTransport) -> Iterator[UnitBlock]:
    while blocks := udp.receive(0.2):
        yield from blocks


def test_counters_restart_when_reopened(sender: socket.socket) -> None:
    udp = transport("?buffer_mb=1")
    udp.open()
    for _ in range(3000):
        sender.sendto(bytes(1206), ("127.0.0.1", port_of(udp)))
    udp.close()
    assert udp.poll_counters().lost_kernel > 0
    udp.open()
    assert udp.poll_counters().lost_kernel == 0
    udp.close()


def test_source_filter_passes_one_sender_and_counts_the_others(sender: socket.socket) -> None:
    udp = transport("?source=127.0.0.2", host="0.0.0.0")
    udp.open()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as scanner:
        scanner.bind(("127.0.0.2", 0))
        for number in range(20):
            sender.sendto(b"stranger", ("127.0.0.1", port_of(udp)))
            scanner.sendto(b"%02d" % number, ("127.0.0.1", port_of(udp)))
    assert payloads(collect(udp, 20)) == [b"%02d" % number for number in range(20)]
    assert udp.poll_counters().refused == 20
    udp.close()


def multicast_sender(address: str) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind((address, 0))
    sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
    return sock


@pytest.mark.parametrize("where", ["?group={}&interface=lo", "?group={}"])
def test_only_datagrams_of_the_multicast_group_are_received(sender: socket.socket, where: str) -> None:
    udp = transport(where.format(GROUP))  # without an interface the local address, 127.0.0.1, names it
    udp.open()
    with multicast_sender("127.0.0.1") as scanner:
        sender.sendto(b"unicast", ("127.0.0.1", port_of(udp)))
        scanner.sendto(b"other group", ("239.74.163.78", port_of(udp)))
        scanner.sendto(b"group", (GROUP, port_of(udp)))
        assert payloads(collect(udp, 1)) == [b"group"]
    assert udp.receive(0.05) == []
    udp.close()


@contextmanager
def sender_at(address: str) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind((address, 0))
        yield sock


def test_two_senders_to_one_port_are_two_transports_on_one_socket() -> None:
    """Two heads and a stranger send in turn; each unit goes to its head, and the stranger is counted once and named."""
    port = free_port()
    left, right = (transport(f"?source=127.0.0.{head}", port=port) for head in (2, 3))
    left.open()
    right.open()
    with sender_at("127.0.0.2") as one, sender_at("127.0.0.3") as two, sender_at("127.0.0.4") as stranger:
        found: dict[str, list[bytes]] = {"left": [], "right": []}

        def read(name: str, udp: UdpTransport) -> None:
            while len(found[name]) < 500 and (blocks := udp.receive(5.0)):
                assert {block.peer[0] for block in blocks if block.peer} == {udp._source}
                assert all(block.kernel_realtime_ns is not None for block in blocks)
                found[name] += payloads(blocks)

        threads = [threading.Thread(target=read, args=item) for item in (("left", left), ("right", right))]
        for thread in threads:
            thread.start()
        for number in range(500):
            one.sendto(b"left %d" % number, ("127.0.0.1", port))
            two.sendto(b"right %d" % number, ("127.0.0.1", port))
            if number % 10 == 0:
                stranger.sendto(b"x", ("127.0.0.1", port))
        for thread in threads:
            thread.join()
        assert found["left"] == [b"left %d" % number for number in range(500)]
        assert found["right"] == [b"right %d" % number for number in range(500)]
        counters = left.poll_counters(), right.poll_counters()
        assert sum(one.refused for one in counters) == 50
        assert [one.refused_text() for one in counters] == ["127.0.0.4 (50)", ""]
        left.close()
        two.sendto(b"still here", ("127.0.0.1", port))
        assert payloads(collect(right, 1)) == [b"still here"]
        left.open()
        one.sendto(b"again", ("127.0.0.1", port))
        assert payloads(collect(left, 1)) == [b"again"]
        left.close()
        right.close()
    alone = transport(port=port)  # the port is free
    alone.open()
    alone.close()


def test_drops_of_a_shared_port_are_counted_once() -> None:
    port = free_port()
    left, right = (transport(f"?source=127.0.0.{head}&buffer_mb=1", port=port) for head in (2, 3))
    left.open()
    right.open()
    with sender_at("127.0.0.2") as one, sender_at("127.0.0.3") as two:
        for _ in range(3000):
            one.sendto(bytes(1206), ("127.0.0.1", port))
            two.sendto(bytes(1206), ("127.0.0.1", port))
        units = 0
        while blocks := left.receive(0.2) + right.receive(0.0):
            units += sum(len(block.units) for block in blocks)
        lost = [udp.poll_counters().lost_kernel for udp in (left, right)]
        assert (units + sum(lost), lost[1]) == (6000, 0)
        assert lost[0] > 0
        left.close()
        assert right.poll_counters().lost_kernel == 0  # those of the port before stay with the one that counted them
        right.close()


def test_what_comes_after_a_transport_left_a_shared_port_is_not_told_as_a_strangers() -> None:
    port = free_port()
    left, right = (transport(f"?source=127.0.0.{head}", port=port) for head in (2, 3))
    left.open()
    right.open()
    with sender_at("127.0.0.2") as one, sender_at("127.0.0.3") as two, sender_at("127.0.0.4") as stranger:
        stranger.sendto(b"early", ("127.0.0.1", port))
        assert right.receive(0.2) == []
        left.close()
        for sender in (one, stranger, two):
            sender.sendto(b"late", ("127.0.0.1", port))
        assert [block.peer and block.peer[0] for block in right.receive(1.0)] == ["127.0.0.3"]
    assert right.poll_counters().refused == 0
    assert left.poll_counters().refused_text() == "127.0.0.4 (2)"
    right.close()


def test_one_sender_has_one_transport() -> None:
    port = free_port()
    first, second = (transport("?source=127.0.0.2", port=port) for _ in range(2))
    first.open()
    with pytest.raises(TransportError, match=f"port {port} is in use by this program itself"):
        second.open()
    first.close()
    second.open()
    second.close()


@pytest.mark.parametrize("index", [99, None])
def test_a_replaced_interface_raises_a_transport_error(monkeypatch: pytest.MonkeyPatch, index: int | None) -> None:
    """An adapter that fell off its bus and came back would leave the socket silent without an error."""
    udp = transport("?interface=lo")
    udp.open()
    assert udp.receive(0.05) == []

    def now(name: str) -> int:
        assert name == "lo"
        if index is None:
            raise OSError("no interface with this name")
        return index

    monkeypatch.setattr(socket, "if_nametoindex", now)
    assert udp._port is not None
    udp._port._looked_s = 0.0
    with pytest.raises(TransportError, match="network interface lo has gone or was replaced"):
        udp.receive(0.05)
    udp.close()


def test_a_multicast_group_is_still_received_after_a_silence() -> None:
    udp = transport(f"?group={GROUP}")
    udp.open()
    assert udp._port is not None
    udp._port._looked_s = 0.0
    assert udp.receive(0.05) == []
    with multicast_sender("127.0.0.1") as scanner:
        scanner.sendto(b"group", (GROUP, port_of(udp)))
        assert payloads(collect(udp, 1)) == [b"group"]
    udp.close()


def test_source_filter_applies_to_multicast() -> None:
    udp = transport(f"?group={GROUP}&source=127.0.0.3")
    udp.open()
    with multicast_sender("127.0.0.2") as stranger, multicast_sender("127.0.0.3") as scanner:
        stranger.sendto(b"stranger", (GROUP, port_of(udp)))
        scanner.sendto(b"scanner", (GROUP, port_of(udp)))
        assert payloads(collect(udp, 1)) == [b"scanner"]
    assert udp.receive(0.05) == []
    udp.close()


def test_two_receivers_can_join_a_group() -> None:
    first = transport(f"?group={GROUP}")
    second = transport(f"?group={GROUP}", port=port_of(first))
    first.open()
    second.open()
    with multicast_sender("127.0.0.1") as scanner:
        scanner.sendto(b"to all", (GROUP, port_of(first)))
    assert payloads(collect(first, 1)) == payloads(collect(second, 1)) == [b"to all"]
    first.close()
    second.close()


def test_a_port_in_use_is_waited_for_without_a_table_of_ports(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """In a service whose /proc shows processes only, the device must be waited for."""
    monkeypatch.setattr(holders, "_UDP_TABLE", tmp_path / "absent")
    first = transport()
    first.open()
    with pytest.raises(TransportError, match=f"port {port_of(first)} is in use by another program"):
        transport(port=port_of(first)).open()
    first.close()


def test_error_for_a_port_in_use_names_the_holder() -> None:
    first = transport()
    first.open()
    second = transport(port=port_of(first))
    with pytest.raises(TransportError, match=f"port {port_of(first)} is in use by this program itself"):
        second.open()
    first.close()
    second.open()  # the refused one can be tried again
    second.close()


@pytest.mark.parametrize(
    ("options", "host", "says"),
    [
        ("", "203.0.113.7", "this computer has no address 203.0.113.7"),
        ("?interface=nosuch0", "0.0.0.0", "no network interface nosuch0"),
        (f"?group={GROUP}&interface=nosuch0", "0.0.0.0", "no network interface nosuch0"),
    ],
)
def test_error_on_opening_gives_the_reason(options: str, host: str, says: str) -> None:
    udp = transport(options, host=host)
    with pytest.raises(TransportError, match=says):
        udp.open()
    with pytest.raises(TransportError, match="is closed"):
        udp.receive(0.0)
    udp.close()


def test_a_granted_buffer_is_reported_in_the_requested_unit() -> None:
    udp = transport("?buffer_mb=1")
    udp.open()
    assert udp.counters.receive_buffer_asked_bytes == 1 << 20
    assert udp.counters.receive_buffer_bytes == 1 << 20
    udp.close()


def test_buffer_that_is_not_granted_shows_in_the_counters() -> None:
    """A thread without CAP_NET_ADMIN gets what net.core.rmem_max allows."""
    limit = int(Path("/proc/sys/net/core/rmem_max").read_text())
    udp = transport("?buffer_mb=1023")

    def open_without_capabilities() -> None:
        drop_capabilities()
        udp.open()

    thread = threading.Thread(target=open_without_capabilities)
    thread.start()
    thread.join()
    assert udp.counters.receive_buffer_asked_bytes == 1023 << 20
    assert udp.counters.receive_buffer_bytes == limit
    udp.close()


def drop_capabilities() -> None:
    """Take all effective capabilities from the calling thread (capset(2), version 3)."""
    header, empty = struct.pack("=Ii", 0x20080522, 0), bytes(24)
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.capset(header, empty) == 0, ctypes.get_errno()


def test_silence_gives_an_empty_list_after_the_timeout() -> None:
    udp = transport()
    udp.open()
    started = time.monotonic()
    assert udp.receive(0.1) == []
    assert time.monotonic() - started >= 0.09
    assert udp.receive(0.0) == []
    udp.close()


def test_close_from_another_thread_ends_a_blocked_receive() -> None:
    udp = transport()
    udp.open()
    got: list[object] = []
    thread = threading.Thread(target=lambda: got.append(udp.receive(60.0)))
    thread.start()
    time.sleep(0.1)
    udp.close()
    thread.join(timeout=30.0)
    assert got == [[]]
    udp.close()
    with pytest.raises(TransportError, match="is closed"):
        udp.receive(1.0)


def test_send_reaches_the_sender_of_the_source_filter() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device:
        device.bind(("127.0.0.2", 0))
        udp = transport("?source=127.0.0.2", port=device.getsockname()[1])
        udp.open()
        udp.send(b"start")
        device.settimeout(5.0)
        assert device.recv(100) == b"start"
        udp.close()


def test_send_without_a_known_peer_is_refused() -> None:
    udp = transport()
    udp.open()
    with pytest.raises(TransportError, match="has no address to send to"):
        udp.send(b"x")
    udp.close()


def test_the_reader_handles_many_senders(sender: socket.socket) -> None:
    """A device that uses a new port for every datagram keeps its order, and its ports are right."""
    udp = transport()
    udp.open()
    expected = []
    for number in range(300):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as once:
            once.sendto(number.to_bytes(2, "big"), ("127.0.0.1", port_of(udp)))
            expected.append((number, once.getsockname()[1]))
    blocks = collect(udp, 300)
    got = [
        (int.from_bytes(row.tobytes(), "big"), block.peer[1]) for block in blocks for row in block.units if block.peer
    ]
    assert got == expected
    udp.close()
