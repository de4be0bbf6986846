"""Makes network captures for tests, with dpkt's headers."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import dpkt

FIN, SYN, RST, PUSH, ACK = 0x01, 0x02, 0x04, 0x08, 0x10
ETHERNET = bytes(12) + b"\x08\x00"
FIRST_NS = 1_700_000_000_000_000_000
Timed = tuple[int, bytes]  # nanoseconds since 1970, frame


@dataclass(frozen=True)
class Side:
    """One end of a connection."""

    host: str
    port: int


DEVICE, COMPUTER = Side("192.168.3.1", 28784), Side("192.168.3.10", 40123)


def tcp_packet(
    source: Side, destination: Side, sequence: int, data: bytes = b"", flags: int = ACK, acknowledged: int = 0
) -> bytes:
    """Return an IPv4 packet."""
    segment = dpkt.tcp.TCP(
        sport=source.port, dport=destination.port, seq=sequence % 2**32, ack=acknowledged % 2**32, flags=flags,
        win=65_535, data=data,
    )  # fmt: skip
    addresses = [bytes(map(int, side.host.split("."))) for side in (source, destination)]
    packet = dpkt.ip.IP(src=addresses[0], dst=addresses[1], p=dpkt.ip.IP_PROTO_TCP, id=1, data=segment)
    packet.len = len(packet)
    return bytes(packet)


def from_device(sequence: int, data: bytes = b"", flags: int = ACK) -> bytes:
    """Return a frame that the device sends."""
    return ETHERNET + tcp_packet(DEVICE, COMPUTER, sequence, data, flags)


def acknowledging(acknowledged: int, flags: int = ACK, data: bytes = b"") -> bytes:
    """Return a frame by which the computer acknowledges the bytes before a sequence number."""
    return ETHERNET + tcp_packet(COMPUTER, DEVICE, 5000, data, flags, acknowledged)


def pcap_of(frames: Iterable[Timed], link: int = 1, order: str = "<") -> bytes:
    """Return a pcap file with stamps in nanoseconds."""
    data = struct.pack(f"{order}IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 262_144, link)
    for time_ns, frame in frames:
        data += struct.pack(f"{order}IIII", *divmod(time_ns, 10**9), len(frame), len(frame)) + frame
    return data


def a_ms_apart(frames: Iterable[bytes], first_ns: int = FIRST_NS) -> list[Timed]:
    """Return frames with stamps a millisecond apart."""
    return [(first_ns + number * 1_000_000, frame) for number, frame in enumerate(frames)]


def write_frames(path: Path, frames: Iterable[bytes], link: int = 1, order: str = "<") -> Path:
    """Write frames a millisecond apart into a file."""
    path.write_bytes(pcap_of(a_ms_apart(frames), link, order))
    return path
