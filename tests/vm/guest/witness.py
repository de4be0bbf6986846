"""Records what the kernel has declared durable: after each fdatasync of the writer, the size of the log.

    witness.py LOGS FILE

A line of FILE is ``<CLOCK_MONOTONIC in ns at the sync's begin> <at its end> <bytes> <log>``: the log had these bytes
before the sync began, so its end makes them durable. FILE.begun has the beginning of each sync, also of one that the
power cut interrupted. The kernel's tracing is the witness, not the recorder. The kernel's command line turns it on,
because turning it on later rewrites running code, which the emulator sometimes misses.
"""

from __future__ import annotations

import os
import re
import sys
import time
from pathlib import Path

TRACING = Path("/sys/kernel/tracing")
_LINE = re.compile(r"(?P<task>\S.*)-\d+\s+\[\d+\].*? (?P<time>\d+\.\d+): sys_fdatasync(?P<end> ->)?")


def begin() -> int:
    """Begin to trace the threads called writer only, and return the pipe."""
    if not (TRACING / "trace_pipe").exists():
        os.system(f"mount -t tracefs nodev {TRACING}")
    for event in ("sys_enter_fdatasync", "sys_exit_fdatasync"):
        (TRACING / f"events/syscalls/{event}/filter").write_text('comm == "writer"')
    (TRACING / "trace_clock").write_text("mono")  # this also empties the buffer of earlier events
    return os.open(TRACING / "trace_pipe", os.O_RDONLY | os.O_NONBLOCK)


def newest(logs: Path) -> Path | None:
    """Return the newest log."""
    made = [path for path in logs.glob("*.mcap") if not path.name.endswith(".recovered.mcap")]
    return max(made, key=lambda path: path.stat().st_mtime_ns, default=None)


def written(path: str) -> int:
    """Open an empty file for writing."""
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)


def main() -> None:
    """Watch until the power is cut."""
    logs, told, begun = Path(sys.argv[1]), written(sys.argv[2]), written(sys.argv[2] + ".begun")
    pipe = begin()
    sizes: list[tuple[int, int, str]] = []
    began_ns, rest = 0, ""
    while True:
        log = newest(logs)
        if log is not None:
            size = log.stat().st_size
            sizes.append((time.monotonic_ns(), size, log.name))
        del sizes[:-600]
        try:
            rest += os.read(pipe, 65536).decode(errors="replace")
        except BlockingIOError:
            time.sleep(0.02)
        *lines, rest = rest.split("\n")
        for line in lines:
            found = _LINE.search(line)
            if found is None:
                continue
            at_ns = round(float(found["time"]) * 1e9)
            if not found["end"]:
                began_ns = at_ns
                os.write(begun, f"{began_ns}\n".encode())
                continue
            known = [(size, name) for stat_ns, size, name in sizes if stat_ns < began_ns]
            if known:
                os.write(told, f"{began_ns} {at_ns} {known[-1][0]} {known[-1][1]}\n".encode())


if __name__ == "__main__":
    main()
