"""Reads the containers pcap and pcapng: packets with their stamps to the nanosecond, as a stream.

Layouts: https://datatracker.ietf.org/doc/draft-ietf-opsawg-pcap/ (4, 5) and …/draft-ietf-opsawg-pcapng/ (3, 4).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path

from swath.drivers.captures.base import CaptureDamageError, CaptureTally, read_bytes
from swath.drivers.transports.base import TransportError

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
_IF_NAME, _IF_TSRESOL, _IF_TSOFFSET = 2, 9, 14
_MAX_BLOCK_BYTES = 16 << 20  # blocks of other kinds, such as keys and names, may be larger than packets
_MAX_NAME_BYTES = 64  # of an interface; Linux has 15


@dataclass(frozen=True, slots=True)
class Interface:
    """An interface of a capture: its link layer, and how it counts time.

    Attributes:
        link: link-layer type, as https://www.tcpdump.org/linktypes.html numbers them.
        order: byte order of the computer that captured, "<" or ">".
        name: the interface's name, "" where the file does not tell it.
        per_s: counts of time a second, starting at ``offset_s``.
    """

    link: int
    order: str
    name: str = ""
    per_s: int = 1_000_000
    offset_s: int = 0

    def time_ns(self, count: int) -> int:
        """Return nanoseconds since 1970 of a count."""
        return self.offset_s * 1_000_000_000 + count * 1_000_000_000 // self.per_s


# nanoseconds since 1970, interface, bytes as captured, size on the wire; a bare tuple, because a named one would cost a
# quarter of the reading
Packet = tuple[int, Interface, bytes, int]


def is_pcap(head: bytes) -> bool:
    """Return whether a file with these first bytes is a pcap or pcapng file."""
    magic = int.from_bytes(head[:4], "little") if len(head) >= 4 else 0
    return magic == _SECTION or magic in _PCAP_KINDS


def read_packets(stream: BufferedIOBase, path: Path, tally: CaptureTally | None) -> Iterator[Packet]:
    """Yield the packets of an open file of either kind.

    Raises:
        TransportError: it is neither.
        CaptureDamageError: it is damaged from here on.
    """
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
    interface, record = Interface(link, order), struct.Struct(f"{order}IIII")
    at = _FILE_HEADER_BYTES
    while head := read_bytes(stream, record.size, path):
        if len(head) < record.size:
            raise CaptureDamageError(f"{path}: ends in a record header at byte {at}")
        seconds, fraction, captured, length = record.unpack(head)
        frame = read_bytes(stream, captured, path) if captured <= _MAX_PACKET_BYTES else b""
        if len(frame) < captured:
            raise CaptureDamageError(f"{path}: ends in a packet, or is damaged, at byte {at}")
        yield seconds * 1_000_000_000 + fraction * fraction_ns, interface, frame, length
        at += record.size + captured


class _PcapngReader:
    """Reads the packets of a pcapng file whose first block type has been read already."""

    def __init__(self, stream: BufferedIOBase, path: Path, tally: CaptureTally | None) -> None:
        self._stream = stream
        self._path = path
        self._tally = tally
        self._order = "<"
        self._interfaces: list[Interface] = []
        self._at = 0

    def packets(self) -> Iterator[Packet]:
        """Yield the packets of all sections."""
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
            number, high, low, captured, length = struct.unpack_from(f"{self._order}IIIII", body)
            return self._packet(number, high << 32 | low, captured, length, body)
        elif kind == _OLD_PACKET:
            number, _, high, low, captured, length = struct.unpack_from(f"{self._order}HHIIII", body)
            return self._packet(number, high << 32 | low, captured, length, body)
        elif kind == _SIMPLE_PACKET and self._tally is not None:
            self._tally.passed["packets without a time"] += 1
        return None

    def _packet(self, number: int, count: int, captured: int, length: int, body: bytes) -> Packet:
        if captured > len(body) - 20:
            raise self._damage("a packet longer than its block")
        interface = self._interfaces[number]
        return interface.time_ns(count), interface, body[20 : 20 + captured], length

    def _interface(self, body: bytes) -> Interface:
        link, per_s, offset_s, at, name = struct.unpack_from(f"{self._order}H", body)[0], 1_000_000, 0, 8, ""
        while at + 4 <= len(body):
            code, length = struct.unpack_from(f"{self._order}HH", body, at)
            value = body[at + 4 : at + 4 + length]
            if code == _IF_TSRESOL:
                per_s = 2 ** (value[0] & 0x7F) if value[0] & 0x80 else 10 ** value[0]
            elif code == _IF_TSOFFSET:
                offset_s = struct.unpack(f"{self._order}q", value)[0]
            elif code == _IF_NAME:
                name = value[:_MAX_NAME_BYTES].decode("utf-8", "replace").rstrip("\0")
            elif code == 0:
                break
            at += 4 + (length + 3) // 4 * 4
        return Interface(link, self._order, name, per_s, offset_s)
