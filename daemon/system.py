"""Adjusts how the operating system treats this process: thread names, memory and priority."""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

NICE = 10
INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
KEPT_BYTES = 64 << 20  # freed memory that an arena keeps for reuse
LARGEST_KEPT_BYTES = 32 << 20  # the largest threshold that glibc accepts


def name_thread(name: str) -> None:
    """Show this thread under its name in ``top -H`` and /proc; the kernel keeps 15 characters."""
    with contextlib.suppress(OSError):  # a hidden /proc is no reason not to record
        Path(f"/proc/self/task/{threading.get_native_id()}/comm").write_text(name[:15])


def lock_memory() -> None:
    """Lock pages into memory as they are first used, if the unit grants unlimited locked memory (mlockall(2), on
    fault).
    """
    if resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] != resource.RLIM_INFINITY:
        return
    current, future, on_fault = 1, 2, 4
    ctypes.CDLL(None, use_errno=True).mlockall(current | future | on_fault)


def keep_freed_memory() -> None:
    """Make glibc reuse freed memory instead of returning it to the kernel and faulting the pages in again (mallopt(3)).

    Call this before any thread starts. It does nothing with a C library that has no mallopt.
    """
    trim_threshold, mmap_threshold = -1, -3
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(trim_threshold, KEPT_BYTES)
        mallopt(mmap_threshold, LARGEST_KEPT_BYTES)


@contextlib.contextmanager
def held_interrupts() -> Iterator[None]:
    """Hold interrupts back until the end of the block; processes started within hold theirs until they release them.

    For work that must not be half done: files that are given their final names, and worker processes that are starting,
    which an interrupt would leave behind.
    """
    came: list[int] = []
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # the processes inherit it
    before: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        before = {one: handler for one in INTERRUPTS if callable(handler := signal.getsignal(one))}
    for one in before:  # another thread may take the signal, and Python pass it to this one
        signal.signal(one, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    if came:
        signal.raise_signal(came[0])


@contextlib.contextmanager
def ended_in_order() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block as an interrupt does, so that unfinished files are removed.

    `timeout`, a service manager or a closed terminal send them. Where they are ignored, as under nohup, they stay so.
    """
    before: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        of_interrupt = signal.getsignal(signal.SIGINT)
        handler = of_interrupt if callable(of_interrupt) else signal.default_int_handler
        for one in INTERRUPTS:
            if signal.getsignal(one) is signal.SIG_DFL:
                before[one] = signal.signal(one, handler)
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


def lower_priority() -> None:
    """Run at a lower priority than the recorder: nice value `NICE` or higher, and disk access only when the disk is
    idle.

    If that is not permitted, the process continues at its present priority.
    """
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, max(NICE, os.getpriority(os.PRIO_PROCESS, 0)))
    _leave_the_disk_to_others()


def give_way() -> None:
    """Run only when the computer is otherwise idle: idle CPU and I/O priority, where that is permitted."""
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
    """Import psutil on first use, so that the recorder, which never lowers its priority, starts without it."""
    import psutil

    return psutil
