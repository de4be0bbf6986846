"""Readers of recordings others made: pcap and pcapng, ``candump -L`` text, serial bytes with arrival times.

Each gives the units that went over the wire, with the recorder's time, in the file's order; gzip is seen by its
magic. For replaying, demonstrations and tests. A file that is not what it should be raises `TransportError` with
one line, after the units before the bad place were given.
"""

from __future__ import annotations

import csv
import gzip
import io
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from ipaddress import IPv6Address
from pathlib import Path
from typing import BinaryIO

import dpkt

from drivers.core.can_frames import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, CANFD_FDF, CANFD_LENGTHS
from drivers.transports.base import TransportError

Address = tuple[str, int]


@dataclass(frozen=True, slots=True)
class CapturedUnit:
    """One unit as it was recorded.

    Attributes:
        time_ns: the recorder's wall clock, nanoseconds since 1970.
        data: a datagram's payload, a SocketCAN frame of 16 or 72 bytes, or the bytes of one serial read.
        channel: the CAN interface's name; ``udp`` or ``serial``.
        source, destination: address and port of a datagram.
    """

    time_ns: int
    data: bytes
    channel: str
    source: Address | None = None
    destination: Address | None = None


def _open(path: Path) -> BinaryIO:
    """The file's content as a stream, decompressed where it begins as gzip does."""
    try:
        plain = path.open("rb")
    except OSError as error:
        raise TransportError(f"{path}: {error.strerror}") from error
    if plain.peek(2)[:2] != b"\x1f\x8b":
        return plain
    plain.close()
    return gzip.open(path, "rb")  # type: ignore[return-value]


def _read(stream: BinaryIO, count: int, path: Path) -> bytes:
    """Up to ``count`` bytes, fewer at the end of the file only."""
    try:
        return stream.read(count)
    except (EOFError, OSError, zlib.error) as error:
        raise TransportError(f"{path}: cannot be read on: {error}") from error


# --- pcap -----------------------------------------------------------------------------------------------------------

# libpcap file header, magic as read little-endian: byte order of what follows, nanoseconds of one fraction
_PCAP_KINDS = {
    0xA1B2C3D4: ("<", 1000),
    0xA1B23C4D: ("<", 1),
    0xD4C3B2A1: (">", 1000),
    0x4D3CB2A1: (">", 1),
}
_PCAPNG_MAGIC = 0x0A0D0D0A
_FILE_HEADER_BYTES = 24
_MAX_PACKET_BYTES = 262_144  # libpcap's MAXIMUM_SNAPLEN; more means that the file is damaged

_ETHERNET, _RAW_IP, _LINUX_SLL, _LINUX_SLL2 = 1, 101, 113, 276  # https://www.tcpdump.org/linktypes.html
_IPV4, _IPV6 = 0x0800, 0x86DD
_VLAN_TAGS = (0x8100, 0x88A8)
_UDP = 17
_MAX_PENDING = 64  # datagrams whose fragments are waited for; the oldest goes first


def read_pcap(path: Path | str, port: int | None = None) -> Iterator[CapturedUnit]:
    """UDP datagrams of a pcap or pcapng file, IPv4 fragments put together; other packets are passed over.

    Args:
        path: the file, possibly gzipped.
        port: only datagrams to this port.

    Raises:
        TransportError: no capture, of an unknown link layer, cut short, or recorded with payloads cut off.
    """
    path = Path(path)
    fragments = _Fragments()
    with _open(path) as stream:
        for time_ns, link, packet in _packets(stream, path):
            found = fragments.add(_ip_packet(link, packet, path))
            if found is None:
                continue
            source, destination, segment = found
            if len(segment) < 8:
                continue
            from_port, to_port, length = struct.unpack_from(">HHH", segment)
            if port is not None and to_port != port:
                continue
            if length > len(segment):
                raise TransportError(f"{path}: payloads were cut off when recording; record with snap length 0")
            data = segment[8:length]
            yield CapturedUnit(time_ns, data, "udp", (source, from_port), (destination, to_port))


def _packets(stream: BinaryIO, path: Path) -> Iterator[tuple[int, int, bytes]]:
    """Time, link type and bytes of each packet."""
    head = _read(stream, 4, path)
    magic = struct.unpack("<I", head)[0] if len(head) == 4 else 0
    if magic == _PCAPNG_MAGIC:
        yield from _pcapng_packets(head + _read(stream, -1, path), path)
        return
    if magic not in _PCAP_KINDS:
        raise TransportError(f"{path}: neither pcap nor pcapng")
    order, fraction_ns = _PCAP_KINDS[magic]
    rest = _read(stream, _FILE_HEADER_BYTES - 4, path)
    if len(rest) < _FILE_HEADER_BYTES - 4:
        raise TransportError(f"{path}: ends in its header")
    link = struct.unpack(f"{order}I", rest[-4:])[0] & 0x0FFF_FFFF
    record = struct.Struct(f"{order}IIII")
    at = _FILE_HEADER_BYTES
    while head := _read(stream, record.size, path):
        if len(head) < record.size:
            raise TransportError(f"{path}: ends in a record header at byte {at}")
        seconds, fraction, captured, _ = record.unpack(head)
        packet = _read(stream, captured, path) if captured <= _MAX_PACKET_BYTES else b""
        if len(packet) < captured:
            raise TransportError(f"{path}: ends in a packet, or is damaged, at byte {at}")
        yield seconds * 1_000_000_000 + fraction * fraction_ns, link, packet
        at += record.size + captured


def _pcapng_packets(data: bytes, path: Path) -> Iterator[tuple[int, int, bytes]]:
    """The same of a pcapng file; dpkt gives its times as floats, good to 0.25 µs."""
    try:
        reader = dpkt.pcapng.Reader(io.BytesIO(data))
        link = int(reader.datalink())
        for seconds, packet in reader:
            yield round(seconds * 1_000_000) * 1000, link, bytes(packet)
    except (dpkt.Error, ValueError, struct.error) as error:
        raise TransportError(f"{path}: damaged pcapng: {error}") from error


def _ip_packet(link: int, packet: bytes, path: Path) -> bytes:
    """The IP packet in a frame; nothing where it carries another protocol."""
    if link == _RAW_IP:
        return packet
    if link == _LINUX_SLL:
        kind, at = packet[14:16], 16
    elif link == _LINUX_SLL2:
        kind, at = packet[0:2], 20
    elif link == _ETHERNET:
        at = 14
        while int.from_bytes(packet[at - 2 : at], "big") in _VLAN_TAGS and at < len(packet):
            at += 4
        kind = packet[at - 2 : at]
    else:
        raise TransportError(f"{path}: link type {link} is not known; want Ethernet, Linux cooked or raw IP")
    return packet[at:] if int.from_bytes(kind, "big") in (_IPV4, _IPV6) else b""


@dataclass(slots=True)
class _Pending:
    pieces: dict[int, bytes] = field(default_factory=dict)
    total: int | None = None

    def whole(self) -> bytes | None:
        """All of it, once nothing is missing."""
        if self.total is None:
            return None
        data = b""
        for offset in sorted(self.pieces):
            if offset > len(data):
                return None
            data = data[:offset] + self.pieces[offset]
        return data if len(data) == self.total else None


class _Fragments:
    """UDP segments out of IP packets; IPv4 fragments (RFC 791, 3.2) are put together, whatever their order."""

    def __init__(self) -> None:
        self._pending: dict[bytes, _Pending] = {}

    def add(self, packet: bytes) -> tuple[str, str, bytes] | None:
        """Source, destination and UDP segment that this packet is or completes."""
        version = packet[0] >> 4 if packet else 0
        if version == 6 and len(packet) >= 40 and packet[6] == _UDP:
            return str(IPv6Address(packet[8:24])), str(IPv6Address(packet[24:40])), packet[40:]
        if version != 4 or len(packet) < 20 or packet[9] != _UDP:
            return None
        header, total = (packet[0] & 15) * 4, int.from_bytes(packet[2:4], "big")
        flags = int.from_bytes(packet[6:8], "big")
        offset, more = (flags & 0x1FFF) * 8, bool(flags & 0x2000)
        segment: bytes | None = packet[header : total or len(packet)]  # 0: segmented by the network card
        if offset or more:
            segment = self._piece(packet[4:6] + packet[12:20], offset, segment or b"", more)
        if segment is None:
            return None
        return ".".join(map(str, packet[12:16])), ".".join(map(str, packet[16:20])), segment

    def _piece(self, key: bytes, offset: int, data: bytes, more: bool) -> bytes | None:
        pending = self._pending.setdefault(key, _Pending())
        pending.pieces[offset] = data
        if not more:
            pending.total = offset + len(data)
        whole = pending.whole()
        if whole is not None:
            del self._pending[key]
        elif len(self._pending) > _MAX_PENDING:
            del self._pending[next(iter(self._pending))]
        return whole


# --- candump -L -----------------------------------------------------------------------------------------------------

_LINE = re.compile(r"\((\d+)\.(\d{1,9})\)\s+(\S+)\s+([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#(\S*)(?:\s+[RT])?")
_CLASSIC_FRAME = struct.Struct("<IBBBB8s")
_FD_FRAME = struct.Struct("<IBBxx64s")


def read_candump(path: Path | str, channel: str | None = None) -> Iterator[CapturedUnit]:
    """Frames of a log as ``candump -L`` of can-utils writes it, as SocketCAN units of 16 or 72 bytes.

    Args:
        path: the file, possibly gzipped.
        channel: only frames of this interface.

    Raises:
        TransportError: a line is no frame; the text names it.
    """
    path = Path(path)
    with _open(path) as stream:
        number = 0
        while line := _read_line(stream, path):
            number += 1
            text = line.decode("ascii", "replace").strip()
            if not text:
                continue
            match = _LINE.fullmatch(text)
            frame = _frame(match[4], match[5]) if match else None
            if match is None or frame is None:
                raise TransportError(f"{path}: line {number} is no frame of candump -L: {text[:60]}")
            if channel is None or match[3] == channel:
                yield CapturedUnit(int(match[1]) * 1_000_000_000 + int(match[2].ljust(9, "0")), frame, match[3])


def _read_line(stream: BinaryIO, path: Path) -> bytes:
    try:
        return stream.readline()
    except (EOFError, OSError, zlib.error) as error:
        raise TransportError(f"{path}: cannot be read on: {error}") from error


def _frame(identifier: str, content: str) -> bytes | None:
    """One frame of its texts before and after ``#``; None where they make none."""
    can_id = int(identifier, 16)
    if len(identifier) == 8 and not can_id & CAN_ERR_FLAG:
        can_id |= CAN_EFF_FLAG
    if content.startswith("#"):
        return _fd_frame(can_id, content[1:])
    if content.startswith("R"):
        length = content[1:2] or "0"
        return _CLASSIC_FRAME.pack(can_id | CAN_RTR_FLAG, int(length), 0, 0, 0, b"") if length in "012345678" else None
    content, _, raw_length = content.partition("_")  # the data length code of 8 bytes may be 9 to F
    data = _bytes(content)
    if data is None or len(data) > 8:
        return None
    return _CLASSIC_FRAME.pack(can_id, len(data), 0, 0, int(raw_length, 16) if raw_length else 0, data)


def _fd_frame(can_id: int, content: str) -> bytes | None:
    """``##<flags><data>``: one hexadecimal digit of flags, then the data."""
    flags, data = _bytes("0" + content[:1]), _bytes(content[1:])
    if not flags or data is None or len(data) not in CANFD_LENGTHS:
        return None
    return _FD_FRAME.pack(can_id, len(data), flags[0] | CANFD_FDF, data)


def _bytes(text: str) -> bytes | None:
    try:
        return bytes.fromhex(text.replace(".", ""))
    except ValueError:
        return None


# --- serial bytes ---------------------------------------------------------------------------------------------------


def read_serial(path: Path | str, chunks: Path | str | None = None) -> Iterator[CapturedUnit]:
    """Reads of a serial port or a TCP stream: the bytes, and a table of when which of them arrived.

    Args:
        path: the bytes, possibly gzipped.
        chunks: CSV with the columns ``arrival_unix_s,offset,length``; by default the file beside it that is named
            ``<stem>.chunks.csv`` or ``<stem>.chunks.csv.gz``.

    Raises:
        TransportError: a file is absent, or the table does not fit the bytes.
    """
    path = Path(path)
    table = Path(chunks) if chunks is not None else _chunk_table(path)
    with _open(path) as stream:
        data = _read(stream, -1, path)
    with _open(table) as stream:
        text = _read(stream, -1, table).decode("ascii", "replace")
    for number, row in enumerate(csv.DictReader(io.StringIO(text)), start=2):
        try:
            seconds, _, fraction = row["arrival_unix_s"].partition(".")
            time_ns = int(seconds) * 1_000_000_000 + int(fraction[:9].ljust(9, "0"))
            offset, length = int(row["offset"]), int(row["length"])
        except (KeyError, ValueError, AttributeError, TypeError) as error:
            raise TransportError(f"{table}: line {number}: want arrival_unix_s,offset,length") from error
        if not 0 <= offset <= offset + length <= len(data):
            raise TransportError(f"{table}: line {number}: bytes {offset}+{length} are not in {path.name}")
        yield CapturedUnit(time_ns, data[offset : offset + length], "serial")


def _chunk_table(path: Path) -> Path:
    bare = path.with_suffix("") if path.suffix == ".gz" else path
    for suffix in (".chunks.csv", ".chunks.csv.gz"):
        table = bare.with_suffix(suffix)
        if table.exists():
            return table
    raise TransportError(f"{path}: no table of arrival times {bare.with_suffix('.chunks.csv').name}[.gz] beside it")
