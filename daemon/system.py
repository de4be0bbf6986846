"""This process as the operating system sees it: its threads' names, its memory, its priority."""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import threading
from pathlib import Path
from typing import Any

NICE = 10
KEPT_BYTES = 64 << 20  # freed memory that an arena keeps
LARGEST_KEPT_BYTES = 32 << 20  # glibc's own largest


def name_thread(name: str) -> None:
    """Show this thread under its name in ``top -H`` and /proc; the kernel keeps 15 characters."""
    with contextlib.suppress(OSError):  # a hidden /proc is no reason not to record
        Path(f"/proc/self/task/{threading.get_native_id()}/comm").write_text(name[:15])


def lock_memory() -> None:
    """Keep pages that are in use in memory, where the unit grants it without limit (mlockall(2), on fault)."""
    if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] != resource.RLIM_INFINITY:
        return
    current, future, on_fault = 1, 2, 4
    ctypes.CDLL(None, use_errno=True).mlockall(current | future | on_fault)


def keep_freed_memory() -> None:
    """Have glibc use freed memory again instead of giving it back page by page, to be faulted in anew (mallopt(3)).

    Set before threads start. Another C library has no such call, and does without.
    """
    trim_threshold, mmap_threshold = -1, -3
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(trim_threshold, KEPT_BYTES)
        mallopt(mmap_threshold, LARGEST_KEPT_BYTES)


def lower_priority() -> None:
    """Run after the recorder: at `NICE` or lower, and on the disk when no other process wants it.

    Where that is not permitted, the process goes on as it is.
    """
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, max(NICE, os.getpriority(os.PRIO_PROCESS, 0)))
    _leave_the_disk_to_others()


def give_way() -> None:
    """Run only when nothing else on the computer wants to: idle CPU and I/O priority, where that is permitted."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.nice(19)
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    _leave_the_disk_to_others()


def _leave_the_disk_to_others() -> None:
    psutil: Any = _psutil()
    with contextlib.suppress(psutil.Error, OSError):
        psutil.Process().ionice(psutil.IOPRIO_CLASS_IDLE)


def _psutil() -> Any:
    """Import psutil here: the recorder, which asks for no lower priority, starts without it."""
    import psutil

    return psutil
