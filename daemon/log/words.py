"""Formats durations, clock states and faults of sources as text, the same on every page and display."""

from __future__ import annotations

import time
from collections.abc import Mapping

FAULTY_SHARE = 0.001  # of the messages; more restarts, incomplete, repeated or late ones degrade a source
DAMAGED_SHARE = 0.01  # bytes between messages may look like one
RESTART_EVERY_S = 60.0
_FAULTS = (("_incomplete", "incomplete"), ("duplicate", "repeated"), ("out_of_order", "out of order"))


def stream_faults(errors: Mapping[str, int], messages: int, seconds: float, damaged: int = 0) -> list[str]:
    """Describe what degrades a source's stream, in a few words each: more than one in a thousand of its messages is
    incomplete, repeated or out of order, or one in a hundred damaged, or its device restarts as often or once a minute.

    Args:
        errors: counts of its parser by code.
        messages: number of its messages.
        seconds: duration of the stream.
        damaged: number of messages whose checksum is wrong.
    """
    least = FAULTY_SHARE * max(messages, 1)
    restarts = sum(count for code, count in errors.items() if code.endswith("restart"))
    found = []
    if restarts and (restarts > least or restarts * RESTART_EVERY_S >= seconds):
        found.append(f"{restarts} restart{'s' if restarts > 1 else ''}")
    if damaged > DAMAGED_SHARE * max(messages, 1) and damaged > 1:  # a stream may begin inside a message
        found.append(f"{damaged} damaged ({100.0 * damaged / max(messages + damaged, 1):.2g} % of its messages)")
    for ending, words in _FAULTS:
        count = sum(number for code, number in errors.items() if code.endswith(ending))
        if count > least:
            found.append(f"{count} {words} ({100.0 * count / max(messages, 1):.2g} % of its messages)")
    return found


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
