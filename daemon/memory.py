"""How a process of ours keeps its memory."""

from __future__ import annotations

import ctypes
import resource

KEPT_BYTES = 64 << 20  # freed memory that an arena keeps
LARGEST_KEPT_BYTES = 32 << 20  # glibc's own largest


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
