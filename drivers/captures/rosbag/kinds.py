"""Finds out what kind of bag of ROS a file is, by its first bytes, and opens its files with bounds."""

from __future__ import annotations

import struct
from io import BufferedReader, FileIO
from pathlib import Path, PosixPath
from typing import Any

METADATA = "metadata.yaml"
SQLITE, ROS1, MCAP = b"SQLite format 3\0", b"#ROSBAG V", b"\x89MCAP0\r\n"
HEAD_BYTES = 64  # enough for the profile of an MCAP file


def bag_kind(path: Path, head: bytes) -> str:
    """Return what kind of bag a folder, or a file with these first bytes, is: "ROS 1" or "ROS 2"; "" if it is none."""
    if path.is_dir():
        return "ROS 2" if (path / METADATA).is_file() else ""
    if head.startswith(ROS1):
        return "ROS 1"
    if head.startswith(MCAP):
        return "ROS 2" if _mcap_profile(head) == b"ros2" else ""
    return "ROS 2" if head.startswith(SQLITE) else ""


def _mcap_profile(head: bytes) -> bytes:
    """Return the profile in an MCAP file's header record: opcode 1, length of the record, the profile's length."""
    start = len(MCAP) + 9
    if len(head) < start + 4:
        return b""
    return head[start + 4 : start + 4 + struct.unpack_from("<I", head, start)[0]]


class BoundedPath(PosixPath):
    """A path whose files, read as bytes, ask for no more memory than they hold, whatever a damaged length says."""

    def open(self, mode: str = "r", *arguments: Any, **options: Any) -> Any:
        """Open the file."""
        return _BoundedReader(self) if mode == "rb" else super().open(mode, *arguments, **options)


class _BoundedReader(BufferedReader):
    def __init__(self, path: Path) -> None:
        super().__init__(FileIO(path))
        self._size = path.stat().st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """Return the next bytes, at most those that the file has."""
        rest = max(0, self._size - self.tell())
        return super().read(rest if size is None or size < 0 else min(size, rest))
