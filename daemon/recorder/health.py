"""Is the recorder alive, and what would one tell a person about it in a sentence?

The watchdog is fed while the recorder progresses. A silent or absent sensor is an event and a word in the sentence,
never a reason to restart: a restart would only cost the data of the others.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable

from swath.daemon.log.words import duration_text, source_trouble
from swath.daemon.recorder.receivers import Receiver
from swath.daemon.recorder.writer import WriterHealth, Writing

PROGRESS_S = 2.0
OPENING_S = 20.0  # a driver may take its time to open: python-can sleeps 2 s for a serial CAN adapter


def stuck_threads(receivers: Iterable[Receiver], writer: WriterHealth, now_ns: int | None = None) -> list[str]:
    """Names of the threads that have not made progress within `PROGRESS_S`; empty is healthy."""
    now = time.monotonic_ns() if now_ns is None else now_ns
    limit = now - int(PROGRESS_S * 1e9)
    opening_limit = now - int(OPENING_S * 1e9)
    stuck = [
        receiver.source
        for receiver in receivers
        if receiver.came_back_ns < (opening_limit if receiver.opening else limit)
    ]
    # A status a second: the last one may be a second old and its successor have two seconds to reach the disk.
    if writer.status_ns < limit - int(1e9):
        stuck.append("writer")
    return stuck


def a_restart_helps_nobody(stuck: Collection[str], receivers: Iterable[Receiver]) -> bool:
    """Whether all that is stuck is being opened: it has nothing to lose yet, and opens no sooner by a restart."""
    return {receiver.source for receiver in receivers if receiver.opening}.issuperset(stuck)


def sentence(session_id: str, part: int, writer: WriterHealth) -> str:
    """What the operator reads in ``systemctl status``."""
    if writer.state is not Writing.RECORDING:
        return f"NOT RECORDING: {writer.reason}"
    troubles = [text for source, status in writer.statuses.items() if (text := source_trouble(source, status))]
    sources = len(writer.statuses)
    told = "; ".join(troubles) if troubles else f"all {sources} sources are coming in" if sources else "begins"
    room = f"{writer.free_bytes / 1e9:.1f} GB free"
    if writer.bytes_per_s > 0:
        left_s = max(0, writer.free_bytes - writer.reserve_bytes) / writer.bytes_per_s
        room += f" ({duration_text(left_s)})"
    return f"recording {session_id} part {part}: {told}; {room}"
