"""Marks logs that are being written: a writer holds a lock on its file until it closes the file or its process ends."""

from __future__ import annotations

import fcntl
import os
import time
from pathlib import Path

_TRIES, _PAUSE_S = 20, 0.001


def claim(fd: int) -> bool:
    """Lock a file for as long as it stays open; return False if another process holds the lock.

    On a file system without locks this returns True, since no process can check there. A process that only checks holds
    the lock for an instant, so the attempt is repeated for 20 ms at most.
    """
    for _ in range(_TRIES):
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(_PAUSE_S)
        except OSError:
            return True
        else:
            return True
    return False


def stands_at(fd: int, path: Path) -> bool:
    """Return whether a path still names the file that is open as ``fd``."""
    try:
        there, mine = os.stat(path), os.fstat(fd)
    except OSError:
        return False
    return (there.st_dev, there.st_ino) == (mine.st_dev, mine.st_ino)


def is_being_written(path: Path) -> bool:
    """Return whether a process holds the lock on a log."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(fd)
    return False
