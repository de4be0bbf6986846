"""Makes files of Livox Viewer from the datagrams of heads, with layouts of its own beside those of the reader."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FileHead:
    """A head in the list of a file; angles in degrees, place in metres."""

    code: str
    number: int
    kind: int
    claimed: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    enabled: int = 1


def beginning(sdk: int, heads: Sequence[FileHead], frame_ms: int = 50, version: bytes | None = None) -> bytes:
    """Return public header, private header and list of heads of a file of SDK 1 or 2."""
    version = version or (b"\1\1\0\0" if sdk == 1 else b"\2\0\0\0")
    data = b"livox_tech".ljust(16, b"\0") + version + bytes.fromhex("67a70eac")
    data += struct.pack("<IB", frame_ms, len(heads))
    for head in heads:
        data += head.code.encode().ljust(16, b"\0") + bytes(16)
        number = struct.pack("<B", head.number) if sdk == 1 else struct.pack("<IB", head.number, 0)
        data += number + struct.pack("<BB6f", head.kind, head.enabled, *head.claimed)
    return data


def lvx1_package(number: int, datagram: bytes) -> bytes:
    """Return a package of SDK 1: the number of the head, then the packet that it sent."""
    return bytes([number]) + datagram


def lvx2_package(number: int, datagram: bytes) -> bytes:
    """Return a package of SDK 2: the fields of a datagram that the file keeps, then the points."""
    counter, frame, data_type, time_type = struct.unpack_from("<HBBB", datagram, 7)
    head = struct.pack("<BIBB", datagram[0], number, 0, time_type) + datagram[28:36]
    head += struct.pack("<HBIB4x", counter, data_type, len(datagram) - 36, frame)
    return head + datagram[36:]


def lvx_file(sdk: int, heads: Sequence[FileHead], frames: Sequence[Sequence[bytes]], frame_ms: int = 50) -> bytes:
    """Return a file of frames of packages."""
    data = beginning(sdk, heads, frame_ms)
    for number, packages in enumerate(frames):
        content = b"".join(packages)
        data += struct.pack("<QQQ", len(data), len(data) + 24 + len(content), number) + content
    return data
