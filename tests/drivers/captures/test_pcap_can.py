"""Tests frames of CAN buses in network captures; the packets follow the layouts at tcpdump.org byte by byte."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from swath.drivers.can_frames import encode_can_frame
from swath.drivers.captures.base import CaptureTally
from swath.drivers.captures.opening import CapturedUnit, read_network, read_pcap
from swath.drivers.transports.base import TransportError
from tests.drivers.captures.network import FIRST_NS, pcap_of, write_frames

SOCKETCAN, SLL, SLL2 = 227, 113, 276
CLASSIC = bytes.fromhex("98fea5d3 08 00 00 00 0102030405060708")
SHORT = bytes.fromhex("00000123 02 00 00 00 aabb")  # its padding is left out
LONG_CODE = bytes.fromhex("00000123 08 00 00 0f 1122334455667788")  # data length code 15 of 8 bytes
REMOTE = bytes.fromhex("40000123 04 00 00 00")
ERROR = bytes.fromhex("20000004 08 00 00 00 0001000000000000")
FD = bytes.fromhex("00000123 0c 05 00 00") + bytes(range(12))
FD_BY_SIZE = bytes.fromhex("00000123 03 00 00 00") + b"abc" + bytes(61)
UNITS = {
    CLASSIC: encode_can_frame(0x18FEA5D3, bytes(range(1, 9)), extended=True),
    SHORT: encode_can_frame(0x123, b"\xaa\xbb"),
    LONG_CODE: bytes.fromhex("23010000 08 00 00 0f 1122334455667788"),
    REMOTE: bytes.fromhex("23010040 04 00 00 00") + bytes(8),
    ERROR: bytes.fromhex("04000020 08 00 00 00 0001000000000000"),
    FD: bytes.fromhex("23010000 0c 05 00 00") + bytes(range(12)) + bytes(52),
    FD_BY_SIZE: encode_can_frame(0x123, b"abc", fd=True),
}


def read(path: Path, tally: CaptureTally | None = None) -> list[CapturedUnit]:
    return list(read_network(path, lambda source, destination: False, tally))


def test_every_kind_of_frame_of_socketcan_is_read(tmp_path: Path) -> None:
    path = write_frames(tmp_path / "can.pcap", UNITS, SOCKETCAN)
    assert [(unit.time_ns, unit.data, unit.channel) for unit in read(path)] == [
        (FIRST_NS + number * 1_000_000, unit, "") for number, unit in enumerate(UNITS.values())
    ]
    with pytest.raises(TransportError, match="link type 227"):  # a capture of datagrams is wanted here
        list(read_pcap(path))


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("link", [SLL, SLL2])
def test_cooked_frames_have_the_byte_order_of_the_computer_that_captured(tmp_path: Path, link: int, order: str) -> None:
    frames = []
    for packet in UNITS:
        protocol = 0x000D if packet in (FD, FD_BY_SIZE) else 0x000C
        cooked = struct.pack(f"{order}I", *struct.unpack(">I", packet[:4])) + packet[4:]
        head = struct.pack(">HHH8xH", 1, 280, 0, protocol)
        frames.append((head if link == SLL else struct.pack(">HHIHBB8x", protocol, 0, 3, 280, 1, 0)) + cooked)
    units = read(write_frames(tmp_path / "can.pcap", frames, link, order))
    assert [unit.data for unit in units] == list(UNITS.values())
    assert {unit.channel for unit in units} == {"" if link == SLL else "if3"}


def test_names_of_interfaces_are_read_from_pcapng(tmp_path: Path) -> None:
    def block(kind: int, body: bytes) -> bytes:
        body += bytes(-len(body) % 4)
        return struct.pack("<II", kind, 12 + len(body)) + body + struct.pack("<I", 12 + len(body))

    data = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    for name in (b"can0", b"vcan12"):
        option = struct.pack("<HH", 2, len(name)) + name + bytes(-len(name) % 4)
        data += block(1, struct.pack("<HHI", SOCKETCAN, 0, 0) + option + bytes(4))
    for number in (1, 0):
        data += block(6, struct.pack("<IIIII", number, 0, 5, len(CLASSIC), len(CLASSIC)) + CLASSIC)
    (tmp_path / "a.pcapng").write_bytes(data)
    assert [(unit.channel, unit.time_ns) for unit in read(tmp_path / "a.pcapng")] == [("vcan12", 5000), ("can0", 5000)]


def test_packets_that_no_unit_can_hold_are_counted(tmp_path: Path) -> None:
    xl = bytes.fromhex("00000100 80 03 0100 00000000 ff")
    frames = [xl, b"1234567", bytes.fromhex("00000123 09 00 00 00") + bytes(9), CLASSIC[:-1], CLASSIC]
    tally = CaptureTally()
    units = read(write_frames(tmp_path / "can.pcap", frames, SOCKETCAN), tally)
    assert [unit.data for unit in units] == [UNITS[CLASSIC]]
    assert {what: count for what, count in tally.passed.items() if count} == {
        "CAN XL frames": 1, "packets that are not CAN frames": 2,
    }  # fmt: skip
    assert (tally.damage, "snap length 0" in tally.first_damage) == (1, True)


def test_a_file_cut_anywhere_raises_only_transport_errors(tmp_path: Path) -> None:
    whole = pcap_of([(FIRST_NS, CLASSIC), (FIRST_NS, FD)], SOCKETCAN)
    for size in range(24, len(whole)):
        (tmp_path / "can.pcap").write_bytes(whole[:size])
        tally = CaptureTally()
        assert len(read(tmp_path / "can.pcap", tally)) == (size >= 24 + 16 + len(CLASSIC))
        assert tally.damage == (size not in (24, 24 + 16 + len(CLASSIC)))
