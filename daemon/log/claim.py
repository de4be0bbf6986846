"""Which logs are being written right now: a writer holds a lock on its file until it closes it, or ends in any way."""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path


def claim(fd: int) -> None:
    """Lock a file for as long as it is open. Where a file system has no locks, nobody can ask either."""
    with contextlib.suppress(OSError):
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_being_written(path: Path) -> bool:
    """Whether some process holds the claim on a log."""
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
