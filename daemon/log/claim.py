"""Which logs are being written right now: a writer holds a lock on its file until it closes it, or ends in any way."""

from __future__ import annotations

import fcntl
import os
import time
from pathlib import Path

_TRIES, _PAUSE_S = 20, 0.001


def claim(fd: int) -> bool:
    """Lock a file for as long as it is open; False where somebody else holds it.

    Where a file system has no locks, nobody can ask either. Somebody who asks at this moment holds it for an instant
    himself, so it is tried again, for 20 ms at most.
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
    """Return whether a path names the very file that is open."""
    try:
        there, mine = os.stat(path), os.fstat(fd)
    except OSError:
        return False
    return (there.st_dev, there.st_ino) == (mine.st_dev, mine.st_ino)


def is_being_written(path: Path) -> bool:
    """Return whether some process holds the claim on a log."""
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
