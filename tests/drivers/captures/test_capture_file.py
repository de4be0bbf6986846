"""Tests capture files: real recordings of each kind, and files that are cut, damaged or of another kind."""

from __future__ import annotations

import gzip
import struct
import tempfile
from collections import Counter
from pathlib import Path

import can
import dpkt
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swath.drivers.can_frames import decode_can_frames
from swath.drivers.captures.opening import (
    BareTime,
    CapturedUnit,
    CaptureTally,
    candump_line,
    held_by_line,
    read_bare,
    read_candump,
    read_pcap,
    read_serial,
)
from swath.drivers.captures.pcap.ip import UDP, IpPackets
from swath.drivers.captures.pcap.links import ip_packet
from swath.drivers.transports.base import TransportError

FIXTURES = Path(__file__).parents[3] / "fixtures"
VELODYNE = FIXTURES / "velodyne" / "mrpt_vlp16_gps.pcap.gz"
CANDUMP = FIXTURES / "canmod-gps" / "2F6913DB_00000004_00000001_candump.log.gz"
SPAN = FIXTURES / "novatel" / "propak6-basic-fix.gps.gz"

# --- pcap -----------------------------------------------------------------------------------------------------------


def test_every_datagram_of_a_real_pcap_is_read() -> None:
    units = list(read_pcap(VELODYNE))
    ports = Counter((unit.destination[1] if unit.destination else 0, len(unit.data)) for unit in units)
    assert ports == {(2368, 1206): 293, (8308, 512): 57}
    assert units[0].source == ("10.0.0.100", 2368)
    assert [unit.time_ns for unit in units] == sorted(unit.time_ns for unit in units)
    assert len(list(read_pcap(VELODYNE, port=8308))) == 57


def test_payloads_and_times_match_dpkt() -> None:
    units = list(read_pcap(VELODYNE))
    with gzip.open(VELODYNE) as stream:
        theirs = [
            (round(seconds * 1e6) * 1000, bytes(dpkt.ethernet.Ethernet(frame).data.data.data))
            for seconds, frame in dpkt.pcap.Reader(stream)
        ]
    assert [(unit.time_ns, unit.data) for unit in units] == theirs


def test_reassembled_fragments_of_a_real_capture_match_dpkt() -> None:
    """Two heads on one port send datagrams in up to a dozen pieces; the oracle joins dpkt's fragments by offset."""
    pieces: dict[tuple[bytes, int], dict[int, bytes]] = {}
    with gzip.open(FIXTURES / "captures" / "same_ports.pcap.gz") as stream:
        for _, frame in dpkt.pcap.Reader(stream):
            ip = dpkt.ethernet.Ethernet(frame).data
            pieces.setdefault((ip.src, ip.id), {})[ip.offset] = bytes(ip.data)
    theirs = sorted(b"".join(found[at] for at in sorted(found))[8:] for found in pieces.values())
    units = list(read_pcap(FIXTURES / "captures" / "same_ports.pcap.gz", drop_copies=True))
    assert sorted(unit.data for unit in units) == theirs
    assert sorted(len(unit.data) for unit in units) == [48, 48, 12608, 16640]
    assert len({unit.source for unit in units}) == 4  # each head sends from two ports


def udp_packet(payload: bytes, to_port: int = 2368) -> bytes:
    udp = dpkt.udp.UDP(sport=4000, dport=to_port, data=payload, ulen=8 + len(payload))
    ip = dpkt.ip.IP(src=b"\x0a\0\0\1", dst=b"\x0a\0\0\2", p=dpkt.ip.IP_PROTO_UDP, id=77, data=bytes(udp))
    ip.len = 28 + len(payload)
    return bytes(ip)


def fragments(packet: bytes, size: int) -> list[bytes]:
    """Return an IPv4 packet in pieces of ``size`` bytes, cut as in RFC 791."""
    header, data = packet[:20], packet[20:]
    pieces = []
    for at in range(0, len(data), size):
        part = data[at : at + size]
        flags = at // 8 | (0x2000 if at + size < len(data) else 0)
        pieces.append(
            header[:2] + struct.pack(">H", 20 + len(part)) + header[4:6] + struct.pack(">H", flags) + header[8:] + part
        )
    return pieces


def write_pcap(path: Path, frames: list[bytes], link: int = 1, order: str = "<", nano: bool = False) -> Path:
    magic = 0xA1B23C4D if nano else 0xA1B2C3D4
    data = struct.pack(f"{order}IHHiIII", magic, 2, 4, 0, 0, 262144, link)
    for at, frame in enumerate(frames):
        data += struct.pack(f"{order}IIII", 1_700_000_000 + at, 123_456, len(frame), len(frame)) + frame
    path.write_bytes(data)
    return path


ETHERNET = bytes(12) + b"\x08\x00"
VLAN = bytes(12) + b"\x81\x00\x00\x05\x08\x00"
TWO_TAGS = bytes(12) + b"\x88\xa8\x00\x05\x81\x00\x00\x06\x08\x00"
SLL = bytes(14) + b"\x08\x00"
SLL_VLAN = bytes(14) + b"\x81\x00\x00\x05\x08\x00"
SLL2 = b"\x08\x00" + bytes(18)
SLL2_VLAN = b"\x81\x00" + bytes(18) + b"\x00\x05\x08\x00"
LINKS = [
    (0, bytes(4)), (1, ETHERNET), (1, VLAN), (1, TWO_TAGS), (12, b""), (14, b""), (101, b""), (108, bytes(4)),
    (113, SLL), (113, SLL_VLAN), (228, b""), (276, SLL2), (276, SLL2_VLAN),
]  # fmt: skip


@pytest.mark.parametrize(("link", "head"), LINKS, ids=str)
@pytest.mark.parametrize("order", ["<", ">"])
def test_each_link_layer_and_byte_order_is_read(tmp_path: Path, link: int, head: bytes, order: str) -> None:
    frame = head + udp_packet(b"scan") + b"padding"
    [unit] = read_pcap(write_pcap(tmp_path / "one.pcap", [frame], link, order))
    assert unit == CapturedUnit(1_700_000_000_123_456_000, b"scan", "udp", ("10.0.0.1", 4000), ("10.0.0.2", 2368))


def test_frame_check_sequence_bits_are_not_part_of_the_link_type(tmp_path: Path) -> None:
    """By draft-ietf-opsawg-pcap the link type is in the low 16 bits; the FCS length (here 2) and its flag are above."""
    [unit] = read_pcap(write_pcap(tmp_path / "fcs.pcap", [ETHERNET + udp_packet(b"scan") + bytes(4)], 0x2400_0001))
    assert unit.data == b"scan"


def test_nanosecond_timestamps_are_read_exactly(tmp_path: Path) -> None:
    [unit] = read_pcap(write_pcap(tmp_path / "one.pcap", [ETHERNET + udp_packet(b"")], nano=True))
    assert unit.time_ns == 1_700_000_000_000_123_456


def test_ipv6_datagrams_are_read(tmp_path: Path) -> None:
    segment = struct.pack(">HHHH", 1, 2368, 12, 0) + b"scan"
    packet = struct.pack(">IHBB", 6 << 28, len(segment), 17, 64) + bytes(15) + b"\1" + bytes(15) + b"\2" + segment
    [unit] = read_pcap(write_pcap(tmp_path / "six.pcap", [bytes(12) + b"\x86\xdd" + packet]))
    assert (unit.source, unit.destination, unit.data) == (("::1", 1), ("::2", 2368), b"scan")


def ipv6_with_options(following: int, rest: bytes, cut: int = 0) -> bytes:
    """Return a packet with hop-by-hop, routing and destination options (RFC 8200, 4.3, 4.4, 4.6) before the rest."""
    options = bytes([43, 0, 1, 4, 0, 0, 0, 0]) + bytes([60, 2]) + bytes(22) + bytes([following, 1]) + bytes(14)
    head = struct.pack(">IHBB", 6 << 28, len(options + rest), 0, 64) + bytes(15) + b"\1" + bytes(15) + b"\2"
    return (head + options + rest)[: cut or None]


def test_ipv6_datagrams_after_extension_headers_are_read() -> None:
    segment = struct.pack(">HHHH", 1, 2368, 12, 0) + b"scan"
    packet = ipv6_with_options(17, segment)
    assert dpkt.ip6.IP6(packet).data.data == b"scan"
    packets = IpPackets()
    assert packets.add(packet) == (UDP, "::1", "::2", segment)
    fragment = struct.pack(">BBHI", 17, 0, 0, 99)
    assert packets.add(ipv6_with_options(44, fragment + segment)) == (UDP, "::1", "::2", segment)
    assert packets.add(ipv6_with_options(58, segment)) is None
    assert (packets.others, packets.cut) == (1, 0)
    assert packets.add(ipv6_with_options(17, segment, cut=90)) is None
    assert (packets.others, packets.cut) == (1, 1)
    for cut in range(40, 88):
        assert packets.add(ipv6_with_options(17, segment, cut=cut)) is None


def test_fragments_are_put_together_in_any_order(tmp_path: Path) -> None:
    payload = np.random.default_rng(1).bytes(8448)
    pieces = fragments(udp_packet(payload), 1480)
    assert len(pieces) == 6
    shuffled = [pieces[i] for i in (3, 0, 5, 5, 1, 4, 2)]
    frames = [ETHERNET + piece for piece in [*shuffled, udp_packet(b"next")]]
    units = list(read_pcap(write_pcap(tmp_path / "cut.pcap", frames)))
    assert [unit.data for unit in units] == [payload, b"next"]
    assert units[0].time_ns // 10**9 == 1_700_000_006  # the time of the last fragment
    lost = [ETHERNET + piece for piece in pieces[1:]]
    assert list(read_pcap(write_pcap(tmp_path / "lost.pcap", lost))) == []


def ipv6_fragments(segment: bytes, size: int) -> list[bytes]:
    """Return an IPv6 datagram in pieces with fragment headers (RFC 8200, 4.5)."""
    addresses = bytes(15) + b"\1" + bytes(15) + b"\2"
    pieces = []
    for at in range(0, len(segment), size):
        part = segment[at : at + size]
        head = struct.pack(">BBHI", 17, 0, at | (at + size < len(segment)), 99)
        pieces.append(struct.pack(">IHBB", 6 << 28, 8 + len(part), 44, 64) + addresses + head + part)
    return pieces


def test_ipv6_fragments_are_reassembled(tmp_path: Path) -> None:
    payload = np.random.default_rng(2).bytes(5000)
    segment = struct.pack(">HHHH", 1, 2368, 8 + len(payload), 0) + payload
    pieces = ipv6_fragments(segment, 1448)
    frames = [bytes(12) + b"\x86\xdd" + pieces[i] for i in (2, 0, 3, 1)]
    [unit] = read_pcap(write_pcap(tmp_path / "six.pcap", frames))
    assert unit.data == payload


def test_a_frame_captured_on_two_interfaces_counts_once_if_it_has_an_identification(tmp_path: Path) -> None:
    """A copy has the same identification and bytes; without an identification copies cannot be recognised."""
    big = fragments(udp_packet(bytes(3000)), 1480)
    anonymous = udp_packet(b"none")[:4] + b"\0\0" + udp_packet(b"none")[6:]
    frames = [ETHERNET + packet for packet in (udp_packet(b"a"), udp_packet(b"a"), anonymous, anonymous, *big, *big)]
    path = tmp_path / "twice.pcap"
    data = bytearray(write_pcap(path, frames).read_bytes())
    at = 24
    while at < len(data):  # all within a tenth of a second
        data[at : at + 4] = struct.pack("<I", 1_700_000_000)
        at += 16 + struct.unpack_from("<I", data, at + 8)[0]
    path.write_bytes(data)
    tally = CaptureTally()
    assert [unit.data for unit in read_pcap(path, tally=tally, drop_copies=True)] == [
        b"a",
        b"none",
        b"none",
        bytes(3000),
    ]
    assert tally.passed["packets captured twice"] == 1 + len(big)
    assert tally.damage == 0
    assert [unit.data for unit in read_pcap(path)].count(b"a") == 2
    apart = write_pcap(tmp_path / "apart.pcap", [ETHERNET + udp_packet(b"a")] * 2)  # a second between them
    assert len(list(read_pcap(apart, drop_copies=True))) == 2


@given(
    st.sampled_from([0, 1, 101, 108, 113, 228, 229, 276]),
    st.lists(
        st.tuples(st.sampled_from([b"", b"\x45", b"\x40", b"\x4f", b"\x60"]), st.binary(max_size=90)), max_size=20
    ),
)
def test_every_packet_is_a_datagram_or_is_counted(link: int, parts: list[tuple[bytes, bytes]]) -> None:
    packets = IpPackets(drop_copies=True)
    heads = {0: bytes(4), 1: ETHERNET, 108: bytes(4), 113: SLL, 276: SLL2}
    found = 0
    for start, rest in parts:
        udp = bytearray(start + rest)
        udp[9:10] = udp[9:10] and b"\x11"  # the protocol is UDP, so that most packets reach its parser
        packet = ip_packet(link, heads.get(link, b"") + bytes(udp))
        assert packet == udp
        found += packets.add(packet) is not None
    assert found + packets.others + packets.cut + packets.copies <= len(parts)


def test_packets_of_other_protocols_are_ignored(tmp_path: Path) -> None:
    arp = bytes(12) + b"\x08\x06" + bytes(28)
    tcp = bytearray(udp_packet(b"no"))
    tcp[9] = 6
    frames = [arp, ETHERNET + bytes(tcp), b"", b"\1\2", ETHERNET, ETHERNET + udp_packet(b"yes")]
    assert [unit.data for unit in read_pcap(write_pcap(tmp_path / "mixed.pcap", frames))] == [b"yes"]


def test_pcapng_is_read_and_a_truncated_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "one.pcapng"
    with path.open("wb") as stream:
        writer = dpkt.pcapng.Writer(stream)
        writer.writepkt(ETHERNET + udp_packet(b"scan"), ts=1_700_000_000.25)
    [unit] = read_pcap(path)
    assert (unit.time_ns, unit.data) == (1_700_000_000_250_000_000, b"scan")
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(TransportError, match=r"one.pcapng: damaged pcapng"):
        list(read_pcap(path))


def pcapng_block(kind: int, body: bytes, order: str = "<") -> bytes:
    """Return a block of pcapng, padded."""
    body += bytes(-len(body) % 4)
    length = struct.pack(f"{order}I", 12 + len(body))
    return struct.pack(f"{order}I", kind) + length + body + length


def pcapng_section(order: str, resolution: bytes, offset_s: int, counts: list[int]) -> bytes:
    """Return a section with one interface and a packet for each count of its clock."""
    options = struct.pack(f"{order}HHB3x", 9, 1, resolution[0]) + struct.pack(f"{order}HHqHH", 14, 8, offset_s, 0, 0)
    data = pcapng_block(0x0A0D0D0A, struct.pack(f"{order}IHHq", 0x1A2B3C4D, 1, 0, -1), order)
    data += pcapng_block(1, struct.pack(f"{order}HHI", 1, 0, 0) + options, order)
    frame = ETHERNET + udp_packet(b"scan")
    for count in counts:
        head = struct.pack(f"{order}IIIII", 0, count >> 32, count & 0xFFFFFFFF, len(frame), len(frame))
        data += pcapng_block(6, head + frame, order)
        data += pcapng_block(0x0BAD, b"what nobody knows", order)
    return data


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("resolution", "offset_s", "count", "time_ns"),
    [
        (b"\x09", 0, 1_700_000_000_123_456_789, 1_700_000_000_123_456_789),
        (b"\x06", 0, 1_700_000_000_123_456, 1_700_000_000_123_456_000),
        (b"\x09", 1_700_000_000, 5, 1_700_000_000_000_000_005),
        (b"\x8a", 0, 1_700_000_000 * 1024 + 1, 1_700_000_000_000_976_562),  # 2^-10 s
        (b"\x00", 0, 1_700_000_000, 1_700_000_000_000_000_000),
    ],
)
def test_pcapng_timestamps_are_read_exactly(
    tmp_path: Path, order: str, resolution: bytes, offset_s: int, count: int, time_ns: int
) -> None:
    path = tmp_path / "one.pcapng"
    path.write_bytes(pcapng_section(order, resolution, offset_s, [count, count]) * 2)
    assert [unit.time_ns for unit in read_pcap(path)] == [time_ns] * 4


def test_truncated_and_damaged_pcapng_raise_only_transport_errors(tmp_path: Path) -> None:
    whole = pcapng_section("<", b"\x09", 0, [1, 2, 3])
    path = tmp_path / "cut.pcapng"
    rng = np.random.default_rng(3)
    for size in range(len(whole)):
        tally = CaptureTally()
        path.write_bytes(whole[:size])
        if size < 4:
            with pytest.raises(TransportError, match="neither pcap nor pcapng"):
                list(read_pcap(path, tally=tally))
            continue
        assert len(list(read_pcap(path, tally=tally))) <= 3
        damaged = bytearray(whole)
        damaged[max(4, size)] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        assert len(list(read_pcap(path, tally=CaptureTally()))) <= 3


def test_a_reader_with_a_tally_continues_after_damage(tmp_path: Path) -> None:
    whole, cut = ETHERNET + udp_packet(b"scan"), (ETHERNET + udp_packet(b"scan"))[:-2]
    lost = ETHERNET + fragments(udp_packet(bytes(3000)), 1480)[0]
    path = write_pcap(tmp_path / "some.pcap", [whole, cut, bytes(12) + b"\x08\x06", lost, whole])
    path.write_bytes(path.read_bytes() + b"garbage that is no record header, and a length far beyond everything")
    tally = CaptureTally()
    assert [unit.data for unit in read_pcap(path, tally=tally)] == [b"scan", b"scan"]
    assert tally.damage == 3  # a truncated packet, garbage, and a datagram without its other fragments
    assert "snap length" in tally.first_damage
    assert tally.passed["packets without UDP"] == 1


def test_bad_pcap_files_are_refused_in_one_line(tmp_path: Path) -> None:
    good = write_pcap(tmp_path / "good.pcap", [ETHERNET + udp_packet(b"scan")] * 2)
    data = good.read_bytes()
    cases = {
        "empty": (b"", "neither pcap nor pcapng"),
        "text": (b"$GPGGA,1,2,3", "neither pcap nor pcapng"),
        "head": (data[:20], "ends in its header"),
        "record": (data[:30], "ends in a record header at byte 24"),
        "packet": (data[:-3], "at byte 86"),
        "length": (data[:32] + b"\xff\xff\xff\xff" + data[36:], "is damaged, at byte 24"),
        "link": (data[:20] + b"\x93\0\0\0" + data[24:], "link type 147 is not known; want Ethernet"),
        "usb": (data[:20] + b"\xdc\0\0\0" + data[24:], r"link type 220 \(USB of Linux\) is not known; want Ethernet"),
        "gzip": (gzip.compress(data)[:-12], "cannot be read further"),
    }
    for name, (content, text) in cases.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(TransportError, match=text) as error:
            list(read_pcap(path))
        assert name in str(error.value)
        assert "\n" not in str(error.value)
    short = write_pcap(tmp_path / "snap.pcap", [(ETHERNET + udp_packet(b"scan"))[:-2]])
    with pytest.raises(TransportError, match="snap length"):
        list(read_pcap(short))
    with pytest.raises(TransportError, match="No such file"):
        list(read_pcap(tmp_path / "absent.pcap"))
    reader = read_pcap(tmp_path / "packet")
    assert next(reader).data == b"scan"  # what came before the bad place is given


# --- candump --------------------------------------------------------------------------------------------------------


def test_real_candump_log_matches_python_can(tmp_path: Path) -> None:
    units = list(read_candump(CANDUMP))
    assert len(units) == 5588
    text = tmp_path / "frames.log"
    text.write_bytes(gzip.decompress(CANDUMP.read_bytes()))
    with can.CanutilsLogReader(str(text)) as reader:
        theirs = list(reader)
    frames = decode_can_frames(np.frombuffer(b"".join(unit.data for unit in units), dtype=np.uint8).reshape(-1, 16))
    assert frames is not None
    assert [m.arbitration_id | (m.is_extended_id << 31) for m in theirs] == frames["can_id"].tolist()
    assert [bytes(m.data) for m in theirs] == [row["data"][: row["length"]].tobytes() for row in frames]
    assert [m.channel for m in theirs] == [unit.channel for unit in units]
    assert max(abs(m.timestamp - unit.time_ns / 1e9) for m, unit in zip(theirs, units, strict=True)) < 1e-6
    assert len(list(read_candump(CANDUMP, channel="can1"))) == 221


@pytest.mark.parametrize(
    ("text", "frame"),
    [
        ("123#", "23010000" "00000000" + 16 * "0"),
        ("7FF#DEADBEEF", "ff070000" "04000000" "deadbeef00000000"),
        ("00000123#01", "23010080" "01000000" "0100000000000000"),
        ("1FFFFFFF#11.22.33", "ffffff9f" "03000000" "1122330000000000"),
        ("123#R", "23010040" "00000000" + 16 * "0"),
        ("123#R8", "23010040" "08000000" + 16 * "0"),
        ("20000004#0001000000000000", "04000020" "08000000" "0001000000000000"),
        ("123#1122334455667788_F", "23010000" "0800000f" "1122334455667788"),
        ("123##1AABB", "23010000" "02050000" "aabb" + 124 * "0"),
        ("123##0" + 64 * "5A", "23010000" "40040000" + 64 * "5a"),
    ],
)  # fmt: skip
def test_every_kind_of_candump_frame_is_read(tmp_path: Path, text: str, frame: str) -> None:
    path = tmp_path / "one.log"
    path.write_text(f"\n(1469439874.299591) vcan0 {text}\n(1469439874.299592) vcan0 {text} R\r\n")
    units = list(read_candump(path))
    assert [unit.data.hex() for unit in units] == [frame, frame]
    assert [unit.time_ns for unit in units] == [1469439874299591000, 1469439874299592000]


@pytest.mark.parametrize(
    "line",
    [
        "vcan0 123#00",
        "(1.0) vcan0 12#00",
        "(1.0) vcan0 123#0",
        "(1.0) vcan0 123#zz",
        "(1.0) vcan0 123#001122334455667788",
        "(1.0) vcan0 123#R9",
        "(1.0) vcan0 123##",
        "(1.0) vcan0 123##0" + "00" * 9,
        " vcan0  123   [2]  00 11",
    ],
)
def test_candump_lines_without_a_frame_are_refused_with_their_line_number(tmp_path: Path, line: str) -> None:
    path = tmp_path / "bad.log"
    path.write_text(f"(1.0) vcan0 123#00\n{line}\n")
    reader = read_candump(path)
    assert next(reader).channel == "vcan0"
    with pytest.raises(TransportError, match=r"bad.log: line 2 is not a frame of candump: \S"):
        next(reader)


def test_bad_lines_are_counted_and_the_rest_is_read(tmp_path: Path) -> None:
    path = tmp_path / "mixed.log"
    lines = [
        "(1.000001) can0 123#00",
        "DROPCOUNT: dropped 7 CAN frames on 'can0' socket (total drops 7)",
        "x" * 100_000,
        "(1.000002) can0 zz#00",
        "(99999999999.0) can0 123#00",
        "(1.000003) can0 123#01",
    ]
    path.write_text("\n".join(lines))
    tally = CaptureTally()
    assert [unit.time_ns for unit in read_candump(path, tally=tally)] == [1_000_001_000, 1_000_003_000]
    assert tally.damage == 3
    assert "line 3 is longer than 4096 bytes" in tally.first_damage
    assert tally.passed["frames that candump missed"] == 7
    packed = tmp_path / "cut.log.gz"
    packed.write_bytes(gzip.compress(b"(1.000001) can0 123#00\n(1.000003) can0 123#01\n")[:-9])
    tally = CaptureTally()
    list(read_candump(packed, tally=tally))
    assert tally.damage == 1
    assert "cannot be read further" in tally.first_damage


def test_real_candump_frames_are_written_back_byte_for_byte(tmp_path: Path) -> None:
    """The lines of the recording follow the rules of candump's makers."""
    lines = gzip.decompress(CANDUMP.read_bytes()).decode().splitlines()
    ours = [candump_line(unit.time_ns, unit.channel, unit.data) for unit in read_candump(CANDUMP)]
    assert [str(line).strip() for line in ours] == lines


@pytest.mark.parametrize(
    "text",
    ["123#", "7FF#DEADBEEF", "00000123#01", "123#R", "123#R8", "20000004#0001000000000000", "123#1122334455667788_F",
     "123##1AABB", "123##0" + 64 * "5A", "123##5" + 12 * "00"],
)  # fmt: skip
def test_every_kind_of_candump_frame_is_written_back_unchanged(tmp_path: Path, text: str) -> None:
    path = tmp_path / "one.log"
    path.write_text(f"(1469439874.299591) vcan0 {text}\n")
    [unit] = read_candump(path)
    line = candump_line(unit.time_ns, "vcan0", unit.data)
    assert line is not None
    assert held_by_line(unit.data)
    path.write_text(line)
    assert list(read_candump(path)) == [unit]


@given(st.binary(min_size=16, max_size=16) | st.binary(min_size=72, max_size=72) | st.binary(max_size=20))
def test_a_line_recognised_as_a_candump_frame_can_be_read(frame: bytes) -> None:
    line = candump_line(1_000, "can0", frame)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "one.log"
        path.write_text(line or "")
        found = [unit.data for unit in read_candump(path)]
    assert held_by_line(frame) == (found == [frame])
    assert len(found) == (line is not None)


# --- serial ---------------------------------------------------------------------------------------------------------


def test_real_serial_recording_is_read_completely() -> None:
    units = list(read_serial(SPAN))
    assert len(units) == 10051
    assert b"".join(unit.data for unit in units) == gzip.decompress(SPAN.read_bytes())
    assert units[0].time_ns == 1414089843747695000
    assert units[-1].time_ns - units[0].time_ns == pytest.approx(198.7e9, rel=1e-3)


@pytest.mark.parametrize(
    ("table", "text"),
    [
        ("arrival_unix_s,offset,length\n1.5,0,6\n", "bytes 0.6 are not in port.bin"),
        ("arrival_unix_s,offset,length\n1.5,-1,2\n", "are not in port.bin"),
        ("arrival_unix_s,offset,length\n1.5,3,-2\n", "are not in port.bin"),
        ("arrival_unix_s,offset,length\nx,0,1\n", "line 2: want arrival_unix_s"),
        ("arrival_unix_s,offset,length\n1.5,0\n", "line 2: want arrival_unix_s"),
        ("time,offset,length\n1.5,0,1\n", "line 2: want arrival_unix_s"),
    ],
)
def test_bad_tables_are_refused_in_one_line(tmp_path: Path, table: str, text: str) -> None:
    (tmp_path / "port.bin").write_bytes(b"bytes")
    (tmp_path / "port.chunks.csv").write_text(table)
    with pytest.raises(TransportError, match=text):
        list(read_serial(tmp_path / "port.bin"))


def test_error_names_a_missing_table(tmp_path: Path) -> None:
    (tmp_path / "port.bin").write_bytes(b"bytes")
    with pytest.raises(TransportError, match=r"port\.chunks\.csv\[\.gz\] beside it"):
        list(read_serial(tmp_path / "port.bin"))
    other = tmp_path / "times.csv"
    other.write_text("arrival_unix_s,offset,length\n1.25,0,2\n1.5,2,3\n")
    units = list(read_serial(tmp_path / "port.bin", other))
    assert [(unit.time_ns, unit.data) for unit in units] == [(1_250_000_000, b"by"), (1_500_000_000, b"tes")]


def test_bytes_without_times_are_delivered_at_the_given_rate(tmp_path: Path) -> None:
    (tmp_path / "port.bin").write_bytes(bytes(1000))
    units = list(read_bare(tmp_path / "port.bin", BareTime(10**18, 115_200, 10)))
    assert [len(unit.data) for unit in units] == [512, 488]
    assert [unit.time_ns - 10**18 for unit in units] == [round(512 * 10 / 115_200 * 1e9), round(1e4 / 115_200 * 1e9)]
    at_once = list(read_bare(tmp_path / "port.bin", BareTime(10**18)))
    assert {unit.time_ns for unit in at_once} == {10**18}
    assert b"".join(unit.data for unit in at_once) == bytes(1000)


@pytest.mark.parametrize("length", ["99999999999999", "-3", "6"])
def test_a_table_with_an_absurd_length_allocates_no_memory(tmp_path: Path, length: str) -> None:
    (tmp_path / "port.bin").write_bytes(b"bytes")
    (tmp_path / "port.chunks.csv").write_text(f"arrival_unix_s,offset,length\n1.5,0,2\n1.5,2,{length}\n")
    tally = CaptureTally()
    assert [unit.data for unit in read_serial(tmp_path / "port.bin", tally=tally)] == [b"by"]
    assert "line 3" in tally.first_damage
