"""Reads the bit rate of a CAN interface by rtnetlink (RTM_GETLINK).

<linux/rtnetlink.h>, <linux/if_link.h>, <linux/can/netlink.h>.
"""

from __future__ import annotations

import socket
import struct
import sys
from collections.abc import Iterator

_NETLINK_ROUTE = 0
_RTM_NEWLINK = 16
_RTM_GETLINK = 18
_NLM_F_REQUEST = 1
_IFLA_LINKINFO = 18
_IFLA_INFO_DATA = 2
_IFLA_CAN_BITTIMING = 1  # struct can_bittiming, bitrate first

_NLMSGHDR = struct.Struct("=IHHII")
_IFINFOMSG = struct.Struct("=BxHiII")
_ATTRIBUTE = struct.Struct("=HH")
_TYPE_MASK = 0x3FFF  # without NLA_F_NESTED and NLA_F_NET_BYTEORDER


def interface_bitrate(channel: str) -> int | None:
    """Return the bits per second of a CAN interface; None where it has none (vcan), is not CAN or cannot be queried."""
    try:
        index = socket.if_nametoindex(channel)
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, _NETLINK_ROUTE) as sock:
            sock.settimeout(1.0)
            request = _IFINFOMSG.pack(socket.AF_UNSPEC, 0, index, 0, 0)
            sock.send(_NLMSGHDR.pack(_NLMSGHDR.size + len(request), _RTM_GETLINK, _NLM_F_REQUEST, 1, 0) + request)
            answer = sock.recv(65536)
    except OSError:
        return None
    return bitrate_of_link(answer)


def bitrate_of_link(message: bytes) -> int | None:
    """Return the bit rate in an RTM_NEWLINK message; None where it is missing or the message is cut."""
    body_at = _NLMSGHDR.size + _IFINFOMSG.size
    if len(message) < body_at or _NLMSGHDR.unpack_from(message)[1] != _RTM_NEWLINK:
        return None
    value: bytes | None = message[body_at:]
    for kind in (_IFLA_LINKINFO, _IFLA_INFO_DATA, _IFLA_CAN_BITTIMING):
        value = None if value is None else dict(_attributes(value)).get(kind)
    if value is None or len(value) < 4:
        return None
    return int.from_bytes(value[:4], sys.byteorder) or None


def _attributes(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield type and value of each attribute; stop where a length does not fit."""
    at = 0
    while at + _ATTRIBUTE.size <= len(data):
        length, kind = _ATTRIBUTE.unpack_from(data, at)
        if length < _ATTRIBUTE.size or at + length > len(data):
            return
        yield kind & _TYPE_MASK, data[at + _ATTRIBUTE.size : at + length]
        at += (length + 3) & ~3
