"""Threads as people see them."""

from __future__ import annotations

import contextlib
import threading
from pathlib import Path


def name_thread(name: str) -> None:
    """Show this thread under its name in ``top -H`` and /proc; the kernel keeps 15 characters."""
    with contextlib.suppress(OSError):  # a hidden /proc is no reason not to record
        Path(f"/proc/self/task/{threading.get_native_id()}/comm").write_text(name[:15])
