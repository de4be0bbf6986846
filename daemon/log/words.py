"""Formats durations, clock states and faults of sources as text, the same on every page and display."""

from __future__ import annotations

import time
from collections.abc import Mapping


def duration_text(seconds: float) -> str:
    """Format a duration as ``3 h 05 min``, ``12 min`` or ``40 s``."""
    if seconds >= 3600:
        return f"{int(seconds // 3600)} h {int(seconds % 3600 // 60):02d} min"
    return f"{int(seconds // 60)} min" if seconds >= 60 else f"{int(seconds)} s"


def clock_text(time_ns: object) -> str:
    """Format a host time as UTC, ``10:15:03``; return "?" for any other value that a log may hold."""
    if isinstance(time_ns, int) and 0 <= time_ns < 1 << 63:
        return time.strftime("%H:%M:%S", time.gmtime(time_ns // 1_000_000_000))
    return "?"


def source_trouble(source: str, status: Mapping[str, object]) -> str:
    """Describe the fault of a source by its status, in a few words; return an empty text when all is well."""
    lost = sum(int(str(status[key])) for key in ("lost_kernel", "lost_queue", "lost_write"))
    words = []
    if status["state"] == "silent":
        age_s = status["last_unit_age_s"]
        words.append("no data yet" if age_s is None else f"silent for {age_s:.0f} s")
    elif status["state"] != "receiving":
        words.append(str(status["state"]))
    if lost:
        words.append(f"{lost} units lost")
    if status.get("time_state") not in (None, "LOCKED"):
        words.append(f"time {status['time_state']}")
    return f"{source} " + ", ".join(words) if words else ""
