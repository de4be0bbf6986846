"""Finds the IP packet or the CAN frame in a captured frame of a link layer.

Sources: https://www.tcpdump.org/linktypes.html, LINKTYPE_CAN_SOCKETCAN, LINKTYPE_LINUX_SLL and LINKTYPE_LINUX_SLL2.
"""

from __future__ import annotations

import struct

from swath.drivers.can_frames import CANFD_FDF, CANFD_FRAME_BYTES
from swath.drivers.captures.pcap.files import Packet

_NULL, _ETHERNET, _RAW_IP, _LOOP, _LINUX_SLL, _IPV4_ONLY, _IPV6_ONLY, _LINUX_SLL2 = 0, 1, 101, 108, 113, 228, 229, 276
_RAW_IP_BSD, _RAW_IP_OPENBSD = 12, 14  # the systems' own DLT_RAW, which some software writes unchanged
_RAW = (_RAW_IP, _RAW_IP_BSD, _RAW_IP_OPENBSD, _IPV4_ONLY, _IPV6_ONLY)
_BARE = {**dict.fromkeys(_RAW, 0), _NULL: 4, _LOOP: 4}  # bytes before the IP packet
_SOCKETCAN = 227
CAN_LINKS = (_SOCKETCAN, _LINUX_SLL, _LINUX_SLL2)  # those that may carry frames of a CAN bus
_OTHER_LINKS = {  # by which a user may capture by mistake
    9: "PPP",
    50: "PPP",
    105: "IEEE 802.11",
    127: "IEEE 802.11 with radiotap",
    187: "Bluetooth HCI",
    189: "USB of Linux",
    190: "CAN 2.0B, without a layout",
    201: "Bluetooth HCI",
    220: "USB of Linux",
    249: "USBPcap",
    253: "Linux Netlink",
}
_IPV4, _IPV6 = 0x0800, 0x86DD
_VLAN_TAGS = (0x8100, 0x88A8, 0x9100)
_ARPHRD_CAN = 280  # linux/if_arp.h
_COOKED_CAN = {0x000C: "classic", 0x000D: "FD", 0x000E: "XL"}
_XL_FLAG = 0x80  # in the fifth byte
_HEAD_BYTES = 8
# largest payload, and the unit's layout in the log, little-endian: identifier, length, flags, two more bytes, data
_LAYOUTS = {"classic": (8, struct.Struct("<IBBBB8s")), "FD": (64, struct.Struct("<IBBBB64s"))}
_REMOTE = 0x4000_0000


class UnknownLinkError(ValueError):
    """The link layer of a capture is unknown."""


class NoFrameError(ValueError):
    """A packet of a CAN bus is not a frame that a unit can hold; the text is the kind of it, for a count."""


class CutFrameError(ValueError):
    """A CAN frame was not captured to its end."""


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
        name = f" ({_OTHER_LINKS[link]})" if link in _OTHER_LINKS else ""
        raise UnknownLinkError(
            f"link type {link}{name} is not known; want Ethernet (1), raw IP (101), Linux cooked (113, 276) or "
            "SocketCAN (227)"
        )
    while int.from_bytes(kind, "big") in _VLAN_TAGS and at + 4 <= len(frame):  # IEEE 802.1Q: tag, then the next type
        kind, at = frame[at + 2 : at + 4], at + 4
    return frame[at:] if int.from_bytes(kind, "big") in (_IPV4, _IPV6) else b""


def is_can(packet: Packet) -> bool:
    """Return whether a packet comes from a CAN bus."""
    link, frame = packet[1].link, packet[2]
    if link == _LINUX_SLL:
        return int.from_bytes(frame[2:4], "big") == _ARPHRD_CAN
    if link == _LINUX_SLL2:
        return int.from_bytes(frame[8:10], "big") == _ARPHRD_CAN
    return link == _SOCKETCAN


def can_channel(packet: Packet) -> str:
    """Return the name of the interface of a packet of a CAN bus; ``if3`` where only its number is known, else ""."""
    _, interface, frame, _ = packet
    name = interface.name if interface.name != "any" else ""
    if not name and interface.link == _LINUX_SLL2:
        return f"if{int.from_bytes(frame[4:8], 'big')}"
    return name


def can_frame(packet: Packet) -> bytes:
    """Return the frame of a packet from a CAN bus as a unit of 16 or 72 bytes.

    SocketCAN's own link type has the identifier big-endian; the cooked ones as the computer that captured had it.

    Raises:
        NoFrameError: it is a CAN XL frame, or none.
        CutFrameError: it was not captured to its end.
    """
    _, interface, data, length = packet
    link, order = interface.link, interface.order
    if link == _SOCKETCAN:
        kind, order = _kind_of(data, length), ">"
    else:
        start, kind_at = (16, 14) if link == _LINUX_SLL else (20, 0)
        kind = _COOKED_CAN.get(int.from_bytes(data[kind_at : kind_at + 2], "big"), "")
        data, length = data[start:], length - start
    if kind == "XL":
        raise NoFrameError("CAN XL frames")
    if not kind or length < _HEAD_BYTES:
        raise NoFrameError("packets that are not CAN frames")
    if len(data) < _HEAD_BYTES:
        raise CutFrameError
    most, layout = _LAYOUTS[kind]
    can_id, size, flags, *others = struct.unpack_from(f"{order}IBBBB", data)
    if size > most:
        raise NoFrameError("packets that are not CAN frames")
    if not can_id & _REMOTE and len(data) < _HEAD_BYTES + size:
        raise CutFrameError
    flags |= CANFD_FDF if kind == "FD" else 0
    return layout.pack(can_id, size, flags, *others, data[_HEAD_BYTES:])


def _kind_of(data: bytes, length: int) -> str:
    """Return the kind of a frame of SocketCAN's link type, by its flags."""
    if len(data) < 6:
        return "classic"  # its end is reported by the caller
    if data[4] & _XL_FLAG:
        return "XL"
    return "FD" if length == CANFD_FRAME_BYTES or data[5] & CANFD_FDF else "classic"
