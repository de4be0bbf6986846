"""UDP datagrams out of captured frames: link layers, VLAN tags, IP fragments, packets that were captured twice."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from functools import lru_cache
from ipaddress import IPv6Address

# https://www.tcpdump.org/linktypes.html
_NULL, _ETHERNET, _RAW_IP, _LOOP, _LINUX_SLL, _IPV4_ONLY, _IPV6_ONLY, _LINUX_SLL2 = 0, 1, 101, 108, 113, 228, 229, 276
_RAW_IP_BSD, _RAW_IP_OPENBSD = 12, 14  # DLT_RAW of the systems themselves, which some software writes as it is
_RAW = (_RAW_IP, _RAW_IP_BSD, _RAW_IP_OPENBSD, _IPV4_ONLY, _IPV6_ONLY)
_BARE = {**dict.fromkeys(_RAW, 0), _NULL: 4, _LOOP: 4}  # bytes before the IP packet
_IPV4, _IPV6 = 0x0800, 0x86DD
_VLAN_TAGS = (0x8100, 0x88A8, 0x9100)
_UDP, _IPV6_FRAGMENT = 17, 44
# hop by hop, routing, destination: headers of 8 (length + 1) bytes (RFC 8200, 4.3, 4.4, 4.6)
_IPV6_OPTIONS = (0, 43, 60)
_MAX_PENDING = 64  # datagrams whose fragments are waited for; the oldest goes first
_MAX_DATAGRAM_BYTES = 65_535
_RECENT = 128  # packets among which a second copy is looked for: two times the fragments of the largest datagram
_COPY_WITHIN_NS = 100_000_000

Datagram = tuple[str, str, bytes]  # source, destination, UDP header and payload


class UnknownLinkError(ValueError):
    """A link layer that is not known here."""


def ip_packet(link: int, frame: bytes) -> bytes:
    """The IP packet in a frame; nothing where it carries another protocol.

    Raises:
        UnknownLinkError: the link layer is not known.
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
    while int.from_bytes(kind, "big") in _VLAN_TAGS and at + 4 <= len(frame):  # IEEE 802.1Q: tag, then what follows
        kind, at = frame[at + 2 : at + 4], at + 4
    return frame[at:] if int.from_bytes(kind, "big") in (_IPV4, _IPV6) else b""


def _past_options(packet: bytes, following: int, at: int) -> tuple[int, int]:
    """Return what follows an IPv6 packet's options, and where; no more than the packet was captured to."""
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
        """All of it, once nothing is missing."""
        if self.total is None:
            return None
        data = b""
        for offset in sorted(self.pieces):
            if offset > len(data):
                return None
            data = data[:offset] + self.pieces[offset]
        return data if len(data) == self.total else None


class IpPackets:
    """Puts IP packets together to UDP datagrams, whatever the order of their fragments (RFC 791, 3.2; RFC 8200, 4.5).

    Args:
        drop_copies: leave out IPv4 packets that are the same as one shortly before, with the same identification: a
            frame that was captured on two interfaces. An identification of 0 tells nothing, such packets stay.

    Attributes:
        copies: packets left out.
        incomplete: datagrams of which a fragment is missing; those still waited for are not among them.
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
        """Datagrams of which a fragment has not come yet."""
        return len(self._pending)

    def add(self, packet: bytes, time_ns: int = 0) -> Datagram | None:
        """The datagram that a packet is or completes."""
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
