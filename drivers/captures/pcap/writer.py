"""Builds Ethernet frames of a pcap file from datagrams, with new headers, a batch at a time.

Layouts: draft-ietf-opsawg-pcap (4, 5), RFC 791 (3.1), RFC 8200 (3), RFC 768, RFC 1071.
"""

from __future__ import annotations

import struct
from ipaddress import IPv4Address, IPv6Address, ip_address

import numpy as np

from swath.drivers.captures.base import Address
from swath.georef.arrays import Int64Array
from swath.georef.records import ByteRows

NOBODY: Address = ("0.0.0.0", 0)  # stands for a sender that the log does not name
FILE_HEADER = struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 262_144, 1)  # stamps in nanoseconds, Ethernet
LATEST_PCAP_NS = 2**32 * 1_000_000_000 - 1
_RECORD = np.dtype([("seconds", "<u4"), ("nanoseconds", "<u4"), ("captured", "<u4"), ("length", "<u4")])
_ETHERNET_BYTES, _IPV4_BYTES, _IPV6_BYTES, _UDP_BYTES = 14, 20, 40, 8
_TTL, _UDP = 64, 17
_MAX_IDENTIFICATION = 65_535  # 0 distinguishes no packets and is left out


def largest_payload(source: Address, destination: Address) -> int:
    """Return the most bytes that a datagram between two addresses can carry."""
    return 65_535 - _UDP_BYTES - (_IPV4_BYTES if _are_ipv4(source, destination) else 0)


def is_address(text: str) -> bool:
    """Return whether a text is an IPv4 or IPv6 address."""
    try:
        ip_address(text)
    except ValueError:
        return False
    return True


def pcap_frames(
    times_ns: Int64Array, first_number: int, source: Address, destination: Address, payloads: ByteRows
) -> ByteRows:
    """Return packet records in the form that follows `FILE_HEADER` in a file.

    Args:
        times_ns: (n,) since 1970, from 0 to `LATEST_PCAP_NS`.
        first_number: number of the first packet in the file; IP identifications are derived from it.
        source, destination: addresses and ports.
        payloads: (n, length) uint8; no longer than `largest_payload`.

    Returns:
        (n, bytes a record) uint8.
    """
    count, length = payloads.shape
    head = _frame_head(source, destination, length)
    rows = np.empty((count, _RECORD.itemsize + len(head) + length), np.uint8)
    record = np.zeros(count, _RECORD)
    record["seconds"], record["nanoseconds"] = np.divmod(times_ns, 1_000_000_000)
    record["captured"] = record["length"] = len(head) + length
    rows[:, : _RECORD.itemsize] = record.view(np.uint8).reshape(count, -1)
    frames = rows[:, _RECORD.itemsize :]
    frames[:, : len(head)] = np.frombuffer(head, np.uint8)
    frames[:, len(head) :] = payloads
    packets = frames[:, _ETHERNET_BYTES:]
    if _are_ipv4(source, destination):
        numbers = (first_number + np.arange(count, dtype=np.int64)) % _MAX_IDENTIFICATION + 1
        _put_u16(packets, 4, numbers)
        _put_u16(packets, 10, _checksum(packets[:, :_IPV4_BYTES]))
    else:
        _put_u16(packets, 46, _udp6_checksum(packets))
    return rows


def _are_ipv4(source: Address, destination: Address) -> bool:
    return all(ip_address(host).version == 4 for host, _ in (source, destination))


def _frame_head(source: Address, destination: Address, length: int) -> bytes:
    """Return Ethernet, IP and UDP headers; identification and checksums are 0."""
    udp = struct.pack(">HHHH", source[1], destination[1], _UDP_BYTES + length, 0)
    if _are_ipv4(source, destination):
        total = _IPV4_BYTES + _UDP_BYTES + length
        ip = struct.pack(">BBHHHBBH", 0x45, 0, total, 0, 0, _TTL, _UDP, 0)
        ip += IPv4Address(source[0]).packed + IPv4Address(destination[0]).packed
        return bytes(12) + b"\x08\x00" + ip + udp
    ip = struct.pack(">IHBB", 6 << 28, _UDP_BYTES + length, _UDP, _TTL)
    return bytes(12) + b"\x86\xdd" + ip + _as_ipv6(source[0]) + _as_ipv6(destination[0]) + udp


def _as_ipv6(host: str) -> bytes:
    """Return an address in 16 bytes; an IPv4 address becomes the mapped IPv6 address (RFC 4291, 2.5.5.2)."""
    address = ip_address(host)
    return bytes(10) + b"\xff\xff" + address.packed if address.version == 4 else IPv6Address(address).packed


def _put_u16(rows: ByteRows, at: int, values: Int64Array) -> None:
    rows[:, at] = values >> 8
    rows[:, at + 1] = values & 0xFF


def _sum16(rows: ByteRows) -> Int64Array:
    """Return the one's complement sums of rows, 16 bits at a time; an odd last byte is padded with 0."""
    high = rows[:, 0::2].sum(axis=1, dtype=np.int64)
    total: Int64Array = (high << 8) + rows[:, 1::2].sum(axis=1, dtype=np.int64)
    for _ in range(3):
        total = (total & 0xFFFF) + (total >> 16)
    return total


def _checksum(rows: ByteRows) -> Int64Array:
    return ~_sum16(rows) & 0xFFFF


def _udp6_checksum(packets: ByteRows) -> Int64Array:
    """Compute the checksum over addresses, length, protocol and datagram (RFC 8200, 8.1); 0 is sent as FFFF."""
    length = packets.shape[1] - _IPV6_BYTES
    total = _sum16(packets[:, 8:]) + length + _UDP
    for _ in range(2):
        total = (total & 0xFFFF) + (total >> 16)
    checksum = ~total & 0xFFFF
    return np.where(checksum == 0, 0xFFFF, checksum)
