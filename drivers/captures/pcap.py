"""Reads pcap and pcapng: the UDP datagrams of a capture, with its stamps to the nanosecond, as a stream.

Layouts: https://datatracker.ietf.org/doc/draft-ietf-opsawg-pcap/ (4, 5) and …/draft-ietf-opsawg-pcapng/ (3, 4).
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from io import BufferedIOBase
from ipaddress import IPv6Address
from pathlib import Path

from swath.drivers.captures.base import (
    LATEST_NS,
    CaptureDamageError,
    CapturedUnit,
    CaptureTally,
    open_capture,
    read_bytes,
    report,
    until_damage,
)
from swath.drivers.transports.base import TransportError

# https://www.tcpdump.org/linktypes.html
_NULL, _ETHERNET, _RAW_IP, _LOOP, _LINUX_SLL, _IPV4_ONLY, _IPV6_ONLY, _LINUX_SLL2 = 0, 1, 101, 108, 113, 228, 229, 276
_RAW_IP_BSD, _RAW_IP_OPENBSD = 12, 14  # the systems' own DLT_RAW, which some software writes unchanged
_RAW = (_RAW_IP, _RAW_IP_BSD, _RAW_IP_OPENBSD, _IPV4_ONLY, _IPV6_ONLY)
_BARE = {**dict.fromkeys(_RAW, 0), _NULL: 4, _LOOP: 4}  # bytes before the IP packet
_IPV4, _IPV6 = 0x0800, 0x86DD
_VLAN_TAGS = (0x8100, 0x88A8, 0x9100)
_UDP, _IPV6_FRAGMENT = 17, 44
# hop by hop, routing, destination: headers of 8 (length + 1) bytes (RFC 8200, 4.3, 4.4, 4.6)
_IPV6_OPTIONS = (0, 43, 60)
_MAX_PENDING = 64  # incomplete datagrams kept; the oldest is discarded first
_MAX_DATAGRAM_BYTES = 65_535
_RECENT = 128  # packets searched for a second copy: twice the fragments of the largest datagram
_COPY_WITHIN_NS = 100_000_000
Datagram = tuple[str, str, bytes]  # source, destination, UDP header and payload

# pcap file header, magic as read little-endian: byte order of the fields, nanoseconds of one fraction
_PCAP_KINDS = {
    0xA1B2C3D4: ("<", 1000),
    0xA1B23C4D: ("<", 1),
    0xD4C3B2A1: (">", 1000),
    0x4D3CB2A1: (">", 1),
}
_FILE_HEADER_BYTES = 24
_MAX_PACKET_BYTES = 262_144  # libpcap's MAXIMUM_SNAPLEN; more means that the file is damaged

_SECTION, _INTERFACE, _OLD_PACKET, _SIMPLE_PACKET, _ENHANCED_PACKET = 0x0A0D0D0A, 1, 2, 3, 6
_BYTE_ORDER_MAGIC = 0x1A2B3C4D
_IF_TSRESOL, _IF_TSOFFSET = 9, 14
_MAX_BLOCK_BYTES = 16 << 20  # blocks of other kinds, such as keys and names, may be larger than packets

Packet = tuple[int, int, bytes]  # time in ns, link type, frame


def is_pcap(head: bytes) -> bool:
    """Return whether a file with these first bytes is a pcap or pcapng file."""
    magic = int.from_bytes(head[:4], "little") if len(head) >= 4 else 0
    return magic == _SECTION or magic in _PCAP_KINDS


def read_pcap(
    path: Path | str, port: int | None = None, tally: CaptureTally | None = None, *, drop_copies: bool = False
) -> Iterator[CapturedUnit]:
    """Read the UDP datagrams of a pcap or pcapng file and join IP fragments; other packets are left out.

    A datagram in fragments has the time of the fragment that completes it.

    Args:
        path: the file, possibly gzipped.
        port: only datagrams to this port.
        tally: counts damaged and left-out packets; where None, damage is raised.
        drop_copies: see `IpPackets`.

    Raises:
        TransportError: the file is not a capture; without tally also: its link layer is unknown, it is cut short, or
            its payloads were cut off.
    """
    return until_damage(_datagrams(Path(path), port, tally, drop_copies), tally)


def _datagrams(path: Path, port: int | None, tally: CaptureTally | None, drop_copies: bool) -> Iterator[CapturedUnit]:
    packets = IpPackets(drop_copies=drop_copies)
    try:
        with open_capture(path) as stream:
            for time_ns, link, frame in _packets(stream, path, tally):
                unit = _unit(packets, time_ns, link, frame, path, tally)
                if unit is not None and (port is None or (unit.destination and unit.destination[1] == port)):
                    yield unit
    finally:
        if tally is not None:
            _tell(packets, path, tally)


def _tell(packets: IpPackets, path: Path, tally: CaptureTally) -> None:
    tally.passed.update({"packets captured twice": packets.copies, "packets without UDP": packets.others})
    missing = packets.incomplete + packets.waiting
    if missing:
        tally.damaged(f"{path}: {missing} datagrams are incomplete, some of their fragments are missing")


def _unit(
    packets: IpPackets, time_ns: int, link: int, frame: bytes, path: Path, tally: CaptureTally | None
) -> CapturedUnit | None:
    cut_before = packets.cut
    try:
        found = packets.add(ip_packet(link, frame), time_ns)
    except UnknownLinkError as error:
        report(tally, f"{path}: {error}")
        return None
    length = 0
    if found is not None and len(found[2]) >= 8:
        from_port, to_port, length = struct.unpack_from(">HHH", found[2])
    if packets.cut > cut_before or (found is not None and length > len(found[2])):
        report(tally, f"{path}: payloads were cut off at capture; capture with snap length 0 (tcpdump -s 0)")
        return None
    if found is None:
        return None
    if length < 8 or not 0 <= time_ns <= LATEST_NS:
        if tally is not None:
            tally.passed["packets that are not datagrams"] += 1
        return None
    source, destination, segment = found
    return CapturedUnit(time_ns, segment[8:length], "udp", (source, from_port), (destination, to_port))


def _packets(stream: BufferedIOBase, path: Path, tally: CaptureTally | None) -> Iterator[Packet]:
    """Yield time, link type and bytes of each packet."""
    head = read_bytes(stream, 4, path)
    magic = struct.unpack("<I", head)[0] if len(head) == 4 else 0
    if magic == _SECTION:
        yield from _PcapngReader(stream, path, tally).packets()
        return
    if magic not in _PCAP_KINDS:
        raise TransportError(f"{path}: neither pcap nor pcapng")
    order, fraction_ns = _PCAP_KINDS[magic]
    rest = read_bytes(stream, _FILE_HEADER_BYTES - 4, path)
    if len(rest) < _FILE_HEADER_BYTES - 4:
        raise CaptureDamageError(f"{path}: ends in its header")
    link = struct.unpack(f"{order}I", rest[-4:])[0] & 0xFFFF  # upper bits: frame check sequence, reserved
    record = struct.Struct(f"{order}IIII")
    at = _FILE_HEADER_BYTES
    while head := read_bytes(stream, record.size, path):
        if len(head) < record.size:
            raise CaptureDamageError(f"{path}: ends in a record header at byte {at}")
        seconds, fraction, captured, _ = record.unpack(head)
        packet = read_bytes(stream, captured, path) if captured <= _MAX_PACKET_BYTES else b""
        if len(packet) < captured:
            raise CaptureDamageError(f"{path}: ends in a packet, or is damaged, at byte {at}")
        yield seconds * 1_000_000_000 + fraction * fraction_ns, link, packet
        at += record.size + captured


@dataclass(frozen=True, slots=True)
class _Interface:
    """The time stamps of an interface description block: ``per_s`` counts a second, starting at ``offset_s``."""

    link: int
    per_s: int = 1_000_000
    offset_s: int = 0

    def time_ns(self, count: int) -> int:
        return self.offset_s * 1_000_000_000 + count * 1_000_000_000 // self.per_s


class _PcapngReader:
    """Reads the packets of a pcapng file whose first block type has been read already."""

    def __init__(self, stream: BufferedIOBase, path: Path, tally: CaptureTally | None) -> None:
        self._stream = stream
        self._path = path
        self._tally = tally
        self._order = "<"
        self._interfaces: list[_Interface] = []
        self._at = 0

    def packets(self) -> Iterator[Packet]:
        """Yield time, link type and bytes of each packet."""
        kind = _SECTION
        while True:
            body = self._block(kind)
            try:
                packet = self._take(kind, body)
            except (struct.error, IndexError) as error:
                raise self._damage("a block with invalid content") from error
            if packet is not None:
                yield packet
            head = read_bytes(self._stream, 4, self._path)
            if not head:
                return
            if len(head) < 4:
                raise self._damage("ends in a block")
            kind = struct.unpack(f"{self._order}I", head)[0]

    def _damage(self, what: str) -> CaptureDamageError:
        return CaptureDamageError(f"{self._path}: damaged pcapng: {what} at byte {self._at}")

    def _read(self, count: int) -> bytes:
        data = read_bytes(self._stream, count, self._path)
        if len(data) < count:
            raise self._damage("ends in a block")
        return data

    def _block(self, kind: int) -> bytes:
        """Return a block's body; a new section's byte order is read before its length, which depends on it."""
        head = self._read(4)
        start = b""
        if kind == _SECTION:
            start = self._read(4)
            self._order = "<" if int.from_bytes(start, "little") == _BYTE_ORDER_MAGIC else ">"
            if struct.unpack(f"{self._order}I", start)[0] != _BYTE_ORDER_MAGIC:
                raise self._damage("a section without byte order")
            self._interfaces = []
        length = struct.unpack(f"{self._order}I", head)[0]
        if length < 12 + len(start) or length % 4 or length > _MAX_BLOCK_BYTES:
            raise self._damage(f"a block of {length} bytes")
        body = start + self._read(length - 12 - len(start))
        if self._read(4) != head:
            raise self._damage("a block whose two lengths differ")
        self._at += length
        return body

    def _take(self, kind: int, body: bytes) -> Packet | None:
        if kind == _INTERFACE:
            self._interfaces.append(self._interface(body))
        elif kind == _ENHANCED_PACKET:
            number, high, low, captured, _ = struct.unpack_from(f"{self._order}IIIII", body)
            return self._packet(number, high, low, captured, body)
        elif kind == _OLD_PACKET:
            number, _, high, low, captured, _ = struct.unpack_from(f"{self._order}HHIIII", body)
            return self._packet(number, high, low, captured, body)
        elif kind == _SIMPLE_PACKET and self._tally is not None:
            self._tally.passed["packets without a time"] += 1
        return None

    def _packet(self, number: int, high: int, low: int, captured: int, body: bytes) -> Packet:
        if captured > len(body) - 20:
            raise self._damage("a packet longer than its block")
        interface = self._interfaces[number]
        return interface.time_ns(high << 32 | low), interface.link, body[20 : 20 + captured]

    def _interface(self, body: bytes) -> _Interface:
        link, per_s, offset_s, at = struct.unpack_from(f"{self._order}H", body)[0], 1_000_000, 0, 8
        while at + 4 <= len(body):
            code, length = struct.unpack_from(f"{self._order}HH", body, at)
            value = body[at + 4 : at + 4 + length]
            if code == _IF_TSRESOL:
                per_s = 2 ** (value[0] & 0x7F) if value[0] & 0x80 else 10 ** value[0]
            elif code == _IF_TSOFFSET:
                offset_s = struct.unpack(f"{self._order}q", value)[0]
            elif code == 0:
                break
            at += 4 + (length + 3) // 4 * 4
        return _Interface(link, per_s, offset_s)


class UnknownLinkError(ValueError):
    """The link layer of a capture is unknown."""


def ip_packet(link: int, frame: bytes) -> bytes:
    """Return the IP packet in a frame, or empty bytes where the frame carries another protocol.

    Raises:
        UnknownLinkError: the link layer is unknown.
    """
    if link in _BARE:
        return frame[_BARE[link] :]
    if link == _ETHERNET:
        kind, at = frame[12:14], 14
    elif link == _LINUX_SLL:
        kind, at = frame[14:16], 16
    elif link == _LINUX_SLL2:
        kind, at = frame[0:2], 20
    else:
        raise UnknownLinkError(f"link type {link} is not known; want Ethernet, Linux cooked or raw IP")
    while int.from_bytes(kind, "big") in _VLAN_TAGS and at + 4 <= len(frame):  # IEEE 802.1Q: tag, then the next type
        kind, at = frame[at + 2 : at + 4], at + 4
    return frame[at:] if int.from_bytes(kind, "big") in (_IPV4, _IPV6) else b""


def _past_options(packet: bytes, following: int, at: int) -> tuple[int, int]:
    """Return the protocol after an IPv6 packet's options and its position, reading only captured bytes."""
    while following in _IPV6_OPTIONS and at + 2 <= len(packet):
        following, at = packet[at], at + 8 * (packet[at + 1] + 1)
    return following, at


@lru_cache(maxsize=4096)
def _ipv4_text(address: bytes) -> str:
    return ".".join(map(str, address))


@dataclass(slots=True)
class _Pending:
    pieces: dict[int, bytes] = field(default_factory=dict)
    total: int | None = None

    def whole(self) -> bytes | None:
        """Return the whole datagram, or None while a fragment is missing."""
        if self.total is None:
            return None
        data = b""
        for offset in sorted(self.pieces):
            if offset > len(data):
                return None
            data = data[:offset] + self.pieces[offset]
        return data if len(data) == self.total else None


class IpPackets:
    """Joins IP packets to UDP datagrams, in any order of their fragments (RFC 791, 3.2; RFC 8200, 4.5).

    Args:
        drop_copies: leave out IPv4 packets that equal a recent one, with the same identification: a frame captured on
            two interfaces. An identification of 0 does not distinguish packets, so such packets stay.

    Attributes:
        copies: packets left out.
        incomplete: datagrams given up because a fragment is missing; those still waited for are not included.
        cut: packets that were not captured to their end.
        others: packets that carry no UDP.
    """

    def __init__(self, *, drop_copies: bool = False) -> None:
        self.copies = self.incomplete = self.cut = self.others = 0
        self._drop_copies = drop_copies
        self._recent: OrderedDict[bytes, int] = OrderedDict()
        self._pending: dict[bytes, _Pending] = {}

    @property
    def waiting(self) -> int:
        """Number of datagrams with a fragment still to come."""
        return len(self._pending)

    def add(self, packet: bytes, time_ns: int = 0) -> Datagram | None:
        """Take one packet; return the datagram that it is or completes."""
        version = packet[0] >> 4 if packet else 0
        if version == 4 and len(packet) >= 20 and packet[9] == _UDP:
            return self._add_v4(packet, time_ns)
        if version == 6 and len(packet) >= 40:
            return self._add_v6(packet)
        self.others += 1
        return None

    def _add_v4(self, packet: bytes, time_ns: int) -> Datagram | None:
        header, total = (packet[0] & 15) * 4, int.from_bytes(packet[2:4], "big")
        total = total or len(packet)  # 0: segmented by the network card
        if header < 20 or total < header:
            self.others += 1
            return None
        if len(packet) < total:
            self.cut += 1
            return None
        if self._drop_copies and self._is_copy(packet, header, total, time_ns):
            self.copies += 1
            return None
        flags = int.from_bytes(packet[6:8], "big")
        offset, more = (flags & 0x1FFF) * 8, bool(flags & 0x2000)
        segment: bytes | None = packet[header:total]
        if offset or more:
            segment = self._piece(packet[4:6] + packet[12:20], offset, packet[header:total], more)
        if segment is None:
            return None
        return _ipv4_text(packet[12:16]), _ipv4_text(packet[16:20]), segment

    def _add_v6(self, packet: bytes) -> Datagram | None:
        following, length = packet[6], int.from_bytes(packet[4:6], "big")
        end = 40 + length if length else len(packet)  # 0: segmented by the network card
        following, at = _past_options(packet, following, 40)
        if following not in (_UDP, _IPV6_FRAGMENT):
            self.others += 1
            return None
        if len(packet) < end:
            self.cut += 1
            return None
        segment: bytes | None = packet[at:end]
        if following == _IPV6_FRAGMENT:
            head = packet[at : at + 8]
            if len(head) < 8 or head[0] != _UDP:
                self.others += 1
                return None
            place = int.from_bytes(head[2:4], "big")
            segment = self._piece(head[4:8] + packet[8:40], place & 0xFFF8, packet[at + 8 : end], bool(place & 1))
        if segment is None:
            return None
        return str(IPv6Address(packet[8:24])), str(IPv6Address(packet[24:40])), segment

    def _is_copy(self, packet: bytes, header: int, total: int, time_ns: int) -> bool:
        if packet[4:6] == b"\0\0":
            return False
        key = packet[4:8] + packet[12:20] + packet[header:total]
        before_ns = self._recent.pop(key, None)
        self._recent[key] = time_ns
        if len(self._recent) > _RECENT:
            self._recent.popitem(last=False)
        return before_ns is not None and abs(time_ns - before_ns) <= _COPY_WITHIN_NS

    def _piece(self, key: bytes, offset: int, data: bytes, more: bool) -> bytes | None:
        if offset + len(data) > _MAX_DATAGRAM_BYTES:
            self.others += 1
            return None
        pending = self._pending.setdefault(key, _Pending())
        pending.pieces[offset] = data
        if not more:
            pending.total = offset + len(data)
        whole = pending.whole()
        if whole is not None:
            del self._pending[key]
        elif len(self._pending) > _MAX_PENDING:
            del self._pending[next(iter(self._pending))]
            self.incomplete += 1
        return whole
