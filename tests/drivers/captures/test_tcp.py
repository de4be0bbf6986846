"""Tests the streams of TCP connections in captures: a recorded connection, and packets lost, late or repeated."""

from __future__ import annotations

import gzip
import random
import struct
from pathlib import Path

import pytest

from swath.drivers.captures.base import Address, CaptureDamageError, CapturedUnit, CaptureTally
from swath.drivers.captures.opening import read_network, read_pcap
from swath.drivers.captures.pcap import tcp
from swath.drivers.captures.pcap.tcp import TcpSegment, TcpStreams
from tests.drivers.captures.network import (
    ACK,
    COMPUTER,
    DEVICE,
    ETHERNET,
    FIN,
    FIRST_NS,
    RST,
    SYN,
    Side,
    Timed,
    a_ms_apart,
    acknowledging,
    from_device,
    pcap_of,
    tcp_packet,
)
from tests.drivers.recordings import FIXTURES

MS_NS = 1_000_000


def is_wanted(source: Address, destination: Address) -> bool:
    return source[1] == DEVICE.port


def read(path: Path, frames: list[Timed]) -> tuple[list[CapturedUnit], CaptureTally]:
    path.write_bytes(pcap_of(frames))
    tally = CaptureTally()
    return list(read_network(path, is_wanted, tally)), tally


def counts(tally: CaptureTally) -> dict[str, int]:
    return {what: count for what, count in tally.passed.items() if count}


def test_a_recorded_connection_gives_the_bytes_that_were_sent() -> None:
    """The expected bytes are those that the recorded server wrote, from the file that it read."""
    tally = CaptureTally()
    units = list(read_network(FIXTURES / "captures" / "tcp.pcap.gz", is_wanted, tally))
    sent = gzip.decompress((FIXTURES / "novatel" / "propak6-basic-fix.gps.gz").read_bytes())[:60_000]
    assert b"".join(unit.data for unit in units) == sent
    assert (tally.damage, counts(tally)) == (0, {"segments of TCP sent to devices": 1})
    assert {unit.channel for unit in units} == {"tcp"}
    assert {unit.source for unit in units} == {("127.0.0.1", 28784)}
    assert [unit.time_ns for unit in units] == sorted(unit.time_ns for unit in units)
    assert not list(read_pcap(FIXTURES / "captures" / "tcp.pcap.gz"))


@pytest.mark.parametrize("seed", range(4))
def test_streams_in_disorder_are_the_streams_that_were_sent(tmp_path: Path, seed: int) -> None:
    """Three connections, whose numbers pass 2^32: segments are late, repeated, joined anew, and cut by IP."""
    rng = random.Random(seed)
    computers = [Side("192.168.3.10", 40_000 + number) for number in range(3)]
    sent = {computer.port: rng.randbytes(9000) for computer in computers}
    queues: list[list[bytes]] = []
    for computer in computers:
        first, at = 2**32 - rng.randrange(1, 6000), 0
        order: list[tuple[float, bytes]] = []
        packets = [tcp_packet(DEVICE, computer, first - 1, flags=SYN | ACK)]
        while at < 9000:
            size = rng.randrange(1, 700)
            data = sent[computer.port][at : at + size]
            order.append((len(order) + rng.choice((0, 0, 0, 3.5)), tcp_packet(DEVICE, computer, first + at, data)))
            if rng.random() < 0.2:  # a repetition that was cut at other bytes
                start = max(0, at - rng.randrange(300))
                again = sent[computer.port][start : at + size // 2]
                order.append((len(order) + 2, tcp_packet(DEVICE, computer, first + start, again)))
            at += size
        packets += [packet for _, packet in sorted(order, key=lambda one: one[0])]
        queues.append([*packets, tcp_packet(DEVICE, computer, first + 9000, flags=FIN | ACK)])
    frames = []
    while queues := [queue for queue in queues if queue]:
        frames.append(ETHERNET + rng.choice(queues).pop(0))
    units, tally = read(tmp_path / "a.pcap", a_ms_apart(frames))
    for computer in computers:
        got = b"".join(unit.data for unit in units if unit.destination and unit.destination[1] == computer.port)
        assert got == sent[computer.port]
    assert (tally.damage, tally.missing_bytes, tally.passed["segments of TCP sent again with other bytes"]) == (0, 0, 0)
    assert tally.passed["bytes of TCP sent again"] > 0
    assert [unit.time_ns for unit in units] == sorted(unit.time_ns for unit in units)


def test_a_late_segment_is_stamped_when_it_could_be_read(tmp_path: Path) -> None:
    frames = [from_device(99, b"early", SYN), from_device(109, b"third"), from_device(105, b"2nd!"), from_device(114)]
    units, tally = read(tmp_path / "a.pcap", a_ms_apart(frames))
    assert [(unit.time_ns - FIRST_NS, unit.data) for unit in units] == [
        (0, b"early"), (2 * MS_NS, b"2nd!"), (2 * MS_NS, b"third"),
    ]  # fmt: skip
    assert counts(tally) == {}


def test_bytes_that_the_receiver_has_but_not_the_capture_are_a_gap(tmp_path: Path) -> None:
    """Keep the stamps of what follows a gap, which was read when it came; an acknowledgement ends it after 0.1 s."""
    frames = [
        (0, from_device(99, flags=SYN)), (1, from_device(100, b"abc")), (2, from_device(110, b"def")),
        (3, from_device(120, b"ghi")), (4, acknowledging(103)), (5, acknowledging(123)), (60, from_device(123, b"jkl")),
        (106, acknowledging(126)), (107, from_device(103, b"too late")), (108, from_device(126, b"mno")),
    ]  # fmt: skip
    units, tally = read(tmp_path / "a.pcap", [(FIRST_NS + ms * MS_NS, frame) for ms, frame in frames])
    assert [((unit.time_ns - FIRST_NS) // MS_NS, unit.data) for unit in units] == [
        (1, b"abc"), (2, b"def"), (3, b"ghi"), (60, b"jkl"), (108, b"mno"),
    ]  # fmt: skip
    assert (tally.damage, tally.missing_bytes) == (2, 14)
    assert tally.first_damage == (
        f"{tmp_path}/a.pcap: 7 bytes of the TCP stream from 192.168.3.1:28784 to 192.168.3.10:40123 were not captured"
    )
    with pytest.raises(CaptureDamageError, match="7 bytes of the TCP stream"):
        list(read_network(tmp_path / "a.pcap", is_wanted))


def test_a_gap_without_acknowledgements_waits_ten_seconds_for_a_repetition(tmp_path: Path) -> None:
    for kept_alive_ms, wanted in ((10_009, b"abcdefghi"), (10_010, b"abcghi")):
        frames = [(0, from_device(99, b"abc", SYN)), (10, from_device(106, b"ghi"))]
        frames += [(kept_alive_ms, from_device(109)), (20_000, from_device(103, b"def"))]
        units, tally = read(tmp_path / "a.pcap", [(FIRST_NS + ms * MS_NS, frame) for ms, frame in frames])
        assert b"".join(unit.data for unit in units) == wanted
        assert tally.missing_bytes == 9 - len(wanted)


@pytest.mark.parametrize(
    "end", [[], [from_device(0, flags=RST)], [acknowledging(103, RST | ACK)]], ids=["end", "1", "2"]
)
def test_what_waits_at_the_end_is_delivered_behind_its_gap(tmp_path: Path, end: list[bytes]) -> None:
    frames = [from_device(99, b"abc", SYN), from_device(110, b"def"), *end]
    units, tally = read(tmp_path / "a.pcap", a_ms_apart(frames))
    assert [(unit.time_ns - FIRST_NS, unit.data) for unit in units] == [(0, b"abc"), (MS_NS, b"def")]
    assert (tally.damage, tally.missing_bytes) == (1, 7)


def test_a_capture_from_the_middle_begins_with_its_first_segment(tmp_path: Path) -> None:
    """A keep-alive repeats the byte before the next with any content (RFC 1122, 4.2.3.6)."""
    frames = [
        acknowledging(500), from_device(500, b"abc"), from_device(502, b"\0"), from_device(480, bytes(20)),
        from_device(490, bytes(10) + b"abcdef"), from_device(500, b"aXc"),
    ]  # fmt: skip
    units, tally = read(tmp_path / "a.pcap", a_ms_apart(frames))
    assert b"".join(unit.data for unit in units) == b"abcdef"
    assert counts(tally) == {
        "TCP streams captured from their middle on": 1,
        "bytes of TCP from before the capture": 20,
        "bytes of TCP sent again": 16,
        "segments of TCP sent again with other bytes": 1,
    }
    assert tally.damage == 0


def test_a_new_connection_on_the_same_ports_begins_anew(tmp_path: Path) -> None:
    """The third begins without a SYN that was captured, at a number that no window reaches."""
    frames = [
        from_device(99, flags=SYN | ACK), from_device(99, flags=SYN | ACK), from_device(100, b"one"),
        from_device(110, b"late"), from_device(4_000_000_000, flags=SYN | ACK), from_device(4_000_000_001, b"two"),
        from_device(4_000_000_004, flags=FIN | ACK), from_device(1_000_000_000, b"three"),
    ]  # fmt: skip
    units, tally = read(tmp_path / "a.pcap", a_ms_apart(frames))
    assert [unit.data for unit in units] == [b"one", b"late", b"two", b"three"]
    assert (tally.damage, tally.missing_bytes) == (2, 7)


def test_segments_of_network_cards_of_ipv6_and_in_fragments_are_read(tmp_path: Path) -> None:
    """A card that segments leaves the length 0 (TSO, up to 64 KiB and more); IP may cut a segment like any packet."""
    large = tcp_packet(DEVICE, COMPUTER, 1)
    large = large[:2] + b"\0\0" + large[4:] + bytes(70_000)
    segment = tcp_packet(DEVICE, COMPUTER, 70_001, b"six")[20:]
    six = struct.pack(">IHBB", 6 << 28, len(segment), 6, 64) + bytes(15) + b"\1" + bytes(15) + b"\2" + segment
    whole = tcp_packet(DEVICE, COMPUTER, 70_001, b"in two parts")
    parts = [whole[:6] + b"\x20\0" + whole[8:44], whole[:6] + b"\0\x03" + whole[8:20] + whole[44:]]
    parts = [part[:2] + struct.pack(">H", len(part)) + part[4:] for part in parts]
    frames = [ETHERNET + large, ETHERNET + parts[1], ETHERNET + parts[0], bytes(12) + b"\x86\xdd" + six]
    units, tally = read(tmp_path / "a.pcap", a_ms_apart(frames))
    assert [len(unit.data) for unit in units] == [70_000, 12, 3]
    assert [unit.data for unit in units[1:]] == [b"in two parts", b"six"]
    assert units[2].source == ("::1", 28784)
    assert tally.damage == 0


def test_segments_cut_by_a_snap_length_give_what_was_captured(tmp_path: Path) -> None:
    cut = from_device(100, bytes(20) + b"lost")[:-4]
    units, tally = read(tmp_path / "a.pcap", a_ms_apart([from_device(99, flags=SYN), cut, from_device(124, b"next")]))
    assert [unit.data for unit in units] == [bytes(20), b"next"]
    assert (tally.damage, tally.missing_bytes) == (2, 4)
    assert "snap length 0" in tally.first_damage


def test_a_capture_cut_at_any_byte_gives_what_it_holds(tmp_path: Path) -> None:
    frames = [from_device(99, b"abc", SYN), from_device(104, b"ef"), from_device(103, b"d"), from_device(106)]
    whole = pcap_of(a_ms_apart(frames))
    found = []
    for size in range(24, len(whole)):
        (tmp_path / "a.pcap").write_bytes(whole[:size])
        found.append(b"".join(unit.data for unit in read_network(tmp_path / "a.pcap", is_wanted, CaptureTally())))
    assert list(dict.fromkeys(found)) == [b"", b"abc", b"abcef", b"abcdef"]


def test_memory_is_bounded_by_any_traffic(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ports that are scanned, and gaps that nobody fills: old streams and gaps are given up, their bytes delivered."""
    gaps: list[str] = []
    streams = TcpStreams(gaps.append)
    monkeypatch.setattr(tcp, "MAX_HELD_BYTES", 1000)
    out = 0
    for number in range(3 * tcp.MAX_STREAMS):
        pair = ("10.0.0.1", 1), ("10.0.0.2", number)
        for sequence in (0, 10):
            found = streams.add(FIRST_NS, TcpSegment(*pair, sequence, 0, ACK, b"abcde"))
            out += sum(len(one.data) for one in found)
            assert sum(len(stream.held) for stream in streams._streams.values()) <= 200
    assert len(streams._streams) == tcp.MAX_STREAMS
    out += sum(len(one.data) for one in streams.finish())
    assert (out, streams.missing, len(gaps)) == (3 * tcp.MAX_STREAMS * 10, 3 * tcp.MAX_STREAMS * 5, 3 * tcp.MAX_STREAMS)
