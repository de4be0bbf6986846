"""Makes files and directory entries survive a power cut."""

from __future__ import annotations

import contextlib
import ctypes
import os
from pathlib import Path

_SYNC_FILE_RANGE_WRITE = 2  # <fcntl.h>
_sync_file_range = getattr(ctypes.CDLL(None), "sync_file_range", None)
if _sync_file_range is not None:
    _sync_file_range.argtypes = [ctypes.c_int, ctypes.c_int64, ctypes.c_int64, ctypes.c_uint]


def begin_writing_out(fd: int, offset: int, length: int) -> None:
    """Ask the kernel to start writing bytes to the disk, so that a later fdatasync(2) has little left to wait for.

    This is a hint (sync_file_range(2)): it makes nothing durable, and a refusal does no harm.
    """
    if _sync_file_range is not None:
        _sync_file_range(fd, offset, length, _SYNC_FILE_RANGE_WRITE)


def sync_directory(directory: Path) -> None:
    """Make a directory's entries durable: a new file is lost if its name is lost, even if its content was synced.

    Raises:
        OSError: the directory cannot be opened or synced.
    """
    _sync(directory, os.O_DIRECTORY)


def try_sync_directory(directory: Path) -> None:
    """Sync a directory like `sync_directory`, but ignore errors, because some file systems do not sync directories."""
    with contextlib.suppress(OSError):
        sync_directory(directory)


def sync_file(path: Path) -> None:
    """Make durable what any process has written to a file.

    Raises:
        OSError: it cannot be opened or synced.
    """
    _sync(path)


def sync_tree(folder: Path) -> None:
    """Make all files below a folder and their names durable; raises OSError."""
    for path in folder.rglob("*"):
        if path.is_dir():
            try_sync_directory(path)
        else:
            sync_file(path)
    try_sync_directory(folder)


def _sync(path: Path, flags: int = 0) -> None:
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | flags)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
