"""Joins IP packets to UDP datagrams and TCP segments, in any order of their fragments (RFC 791, 3.2; RFC 8200, 4.5)."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from functools import lru_cache
from ipaddress import IPv6Address

TCP, UDP = 6, 17
_IPV6_FRAGMENT = 44
# hop by hop, routing, destination: headers of 8 (length + 1) bytes (RFC 8200, 4.3, 4.4, 4.6)
_IPV6_OPTIONS = (0, 43, 60)
_MAX_PENDING = 64  # incomplete packets kept; the oldest is discarded first
_MAX_PACKET_BYTES = 65_535
_RECENT = 128  # packets searched for a second copy: twice the fragments of the largest datagram
_COPY_WITHIN_NS = 100_000_000
Segment = tuple[int, str, str, bytes]  # protocol, source, destination, header of the protocol and payload


def _past_options(packet: bytes, following: int, at: int) -> tuple[int, int]:
    """Return the protocol after an IPv6 packet's options and its position, reading only captured bytes."""
    while following in _IPV6_OPTIONS and at + 2 <= len(packet):
        following, at = packet[at], at + 8 * (packet[at + 1] + 1)
    return following, at


@lru_cache(maxsize=4096)
def _ipv4_text(address: bytes) -> str:
    return ".".join(map(str, address))


@lru_cache(maxsize=4096)
def _ipv6_text(address: bytes) -> str:
    return str(IPv6Address(address))


@dataclass(slots=True)
class _Pending:
    pieces: dict[int, bytes] = field(default_factory=dict)
    total: int | None = None

    def whole(self) -> bytes | None:
        """Return the whole content, or None while a fragment is missing."""
        if self.total is None:
            return None
        data = b""
        for offset in sorted(self.pieces):
            if offset > len(data):
                return None
            data = data[:offset] + self.pieces[offset]
        return data if len(data) == self.total else None


class IpPackets:
    """Joins IP packets of the wanted protocols.

    Args:
        drop_copies: leave out IPv4 datagrams of UDP that equal a recent one, with the same identification: a frame
            captured on two interfaces. An identification of 0 does not distinguish packets, so such packets stay.
        protocols: the protocols above IP that are wanted, of `UDP` and `TCP`.

    Attributes:
        copies: packets left out.
        incomplete: packets given up because a fragment is missing; those still waited for are not included.
        cut: packets that were not captured to their end; a segment of TCP is returned as far as it was.
        others: packets that carry no wanted protocol.
    """

    def __init__(self, *, drop_copies: bool = False, protocols: tuple[int, ...] = (UDP,)) -> None:
        self.copies = self.incomplete = self.cut = self.others = 0
        self._drop_copies = drop_copies
        self._protocols = protocols
        self._recent: OrderedDict[bytes, int] = OrderedDict()
        self._pending: dict[bytes, _Pending] = {}

    @property
    def waiting(self) -> int:
        """Number of packets with a fragment still to come."""
        return len(self._pending)

    def add(self, packet: bytes, time_ns: int = 0) -> Segment | None:
        """Take one packet; return the datagram or segment that it is or completes."""
        version = packet[0] >> 4 if packet else 0
        if version == 4 and len(packet) >= 20 and packet[9] in self._protocols:
            return self._add_v4(packet, time_ns)
        if version == 6 and len(packet) >= 40:
            return self._add_v6(packet)
        self.others += 1
        return None

    def _add_v4(self, packet: bytes, time_ns: int) -> Segment | None:
        header, total, protocol = (packet[0] & 15) * 4, int.from_bytes(packet[2:4], "big"), packet[9]
        total = total or len(packet)  # 0: segmented by the network card
        if header < 20 or total < header:
            self.others += 1
            return None
        flags = int.from_bytes(packet[6:8], "big")
        offset, more = (flags & 0x1FFF) * 8, bool(flags & 0x2000)
        if len(packet) < total:
            self.cut += 1
            if protocol != TCP or offset or more:
                return None
        if self._drop_copies and protocol == UDP and self._is_copy(packet, header, total, time_ns):
            self.copies += 1
            return None
        segment: bytes | None = packet[header:total]
        if offset or more:
            key = packet[4:6] + packet[12:20] + packet[9:10]
            segment = self._piece(key, offset, packet[header:total], more)
        if segment is None:
            return None
        return protocol, _ipv4_text(packet[12:16]), _ipv4_text(packet[16:20]), segment

    def _add_v6(self, packet: bytes) -> Segment | None:
        following, length = packet[6], int.from_bytes(packet[4:6], "big")
        end = 40 + length if length else len(packet)  # 0: segmented by the network card
        protocol, at = _past_options(packet, following, 40)
        if protocol not in (*self._protocols, _IPV6_FRAGMENT):
            self.others += 1
            return None
        if len(packet) < end:
            self.cut += 1
            if protocol != TCP:
                return None
        segment: bytes | None = packet[at:end]
        if protocol == _IPV6_FRAGMENT:
            head = packet[at : at + 8]
            if len(head) < 8 or head[0] not in self._protocols:
                self.others += 1
                return None
            place, protocol = int.from_bytes(head[2:4], "big"), head[0]
            key = head[4:8] + packet[8:40] + head[:1]
            segment = self._piece(key, place & 0xFFF8, packet[at + 8 : end], bool(place & 1))
        if segment is None:
            return None
        return protocol, _ipv6_text(packet[8:24]), _ipv6_text(packet[24:40]), segment

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
        if offset + len(data) > _MAX_PACKET_BYTES:
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
