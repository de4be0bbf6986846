"""Replaces files at once: who reads one sees the old or the new content, never a part.

A plain rename over a file makes ext4 write the new one to the disk first (auto_da_alloc), which costs more than all
else here and keeps the recorder's disk busy. Files that are replaced every second are exchanged instead: they reach
the disk within half a minute, as any other file, and a power cut may leave an empty one.
"""

from __future__ import annotations

import ctypes
import errno
import os
from collections.abc import Callable
from pathlib import Path

_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # renameat2(2)
_NOT_THERE = (errno.ENOENT, errno.EINVAL, errno.ENOSYS)  # no file yet; a file system or kernel that cannot exchange
_renameat2: Callable[..., int] | None = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)


def replace_file(path: Path, data: bytes) -> None:
    """Replace a file's content at once; after a power cut too the file is the old or the new one.

    Raises:
        OSError: the file cannot be written.
    """
    new = path.with_name(path.name + ".new")
    new.write_bytes(data)
    new.replace(path)


def exchange_file(folder: Path, name: str, data: bytes | bytearray) -> None:
    """Replace a file of a folder at once, for one that is soon replaced again; it need not survive a power cut.

    Raises:
        OSError: the file cannot be written.
    """
    path = f"{folder}/{name}"
    new = f"{path}.new"
    fd = os.open(new, _FLAGS, 0o666)
    try:
        left = memoryview(data)
        while left:
            left = left[os.write(fd, left) :]
    finally:
        os.close(fd)
    if _renameat2 is None:
        os.replace(new, path)
    elif _renameat2(_AT_FDCWD, os.fsencode(new), _AT_FDCWD, os.fsencode(path), _RENAME_EXCHANGE) == 0:
        os.unlink(new)
    elif (number := ctypes.get_errno()) in _NOT_THERE:
        os.replace(new, path)
    else:
        raise OSError(number, os.strerror(number), path)
