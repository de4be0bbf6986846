"""Repairs logs that a crash left open: after recording has begun, in another process, one log at a time.

The repair never competes with the recording: it runs at idle CPU and I/O priority and starts on a log only while the
disk keeps the reserve and room for the whole copy. The original is not touched.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

from swath.daemon.log.claim import is_being_written
from swath.daemon.log.events import Events, Severity
from swath.daemon.log.format import LogError
from swath.daemon.log.reader import read_part_head

MCAP_MAGIC = b"\x89MCAP0\r\n"
_LOOK_AGAIN_S = 60.0
_HEAD_BYTES = 4096  # of a part at most: header and session


def unfinished_logs(directory: Path) -> list[Path]:
    """Return the logs of a directory that have neither an end nor a repaired copy, oldest first.

    A file that a crash left at the very beginning of a part is not among them: it holds nothing to repair.
    """
    found: list[tuple[float, Path]] = []
    with contextlib.suppress(FileNotFoundError):  # the directory may be missing
        for path in directory.glob("*.mcap"):
            if path.name.endswith(".recovered.mcap") or path.with_suffix(".recovered.mcap").exists():
                continue
            with contextlib.suppress(OSError):  # moved away meanwhile, or not readable
                if (changed_s := _left_open_since(path)) is not None:
                    found.append((changed_s, path))
    return [path for _, path in sorted(found)]


def _left_open_since(path: Path) -> float | None:
    """Return the time of the last write to a log without an end; None if the log has an end."""
    with path.open("rb") as file:
        stat = os.fstat(file.fileno())
        file.seek(max(0, stat.st_size - len(MCAP_MAGIC)))
        if file.read() == MCAP_MAGIC or (stat.st_size < _HEAD_BYTES and not _has_head(path)):
            return None
        return stat.st_mtime


def _has_head(path: Path) -> bool:
    try:
        read_part_head(path)
    except LogError:
        return False
    return True


async def repair_left_open(
    directory: Path, reserve_bytes: int, is_current: Callable[[Path], bool], events: Events
) -> None:
    """Repair logs that a crash left open; wait while there is no room, and end when nothing is left to do.

    A log that another process is recovering is checked again later; by then that recovery has succeeded or was given
    up.
    """
    tried: set[Path] = set()
    reported: set[str] = set()
    while True:
        candidates = await asyncio.to_thread(unfinished_logs, directory)
        waiting = [path for path in candidates if path not in tried and not is_current(path)]
        if not waiting:
            return
        path = next((path for path in waiting if not _is_being_recovered(path)), None)
        if path is None:
            await _wait(f"{waiting[0].name} is being recovered by another process", reported, events)
            continue
        try:
            room = shutil.disk_usage(directory).free > reserve_bytes + path.stat().st_size
        except OSError:  # moved away meanwhile
            tried.add(path)
            continue
        if not room:
            await _wait(
                f"{path.name} was left open by a crash; the disk has no space to repair it now", reported, events
            )
            continue
        await _repair(path, reserve_bytes, events)
        tried.add(path)


def _is_being_recovered(path: Path) -> bool:
    return is_being_written(path.with_suffix(".recovered.mcap.part"))


async def _wait(text: str, reported: set[str], events: Events) -> None:
    """Post the reason once, then wait before the next check."""
    if text not in reported:
        reported.add(text)
        events.post(Severity.WARNING, "recorder", "repair_waits", text)
    await asyncio.sleep(_LOOK_AGAIN_S)


async def _repair(path: Path, reserve_bytes: int, events: Events) -> None:
    """Repair one log in its own process; exit codes 0 and 4 (damage found, all whole data saved) both leave a repaired
    copy.
    """
    # a child inherits the recorder's real-time priority: it must be idle before its interpreter starts
    command = ["chrt", "--idle", "0"] if shutil.which("chrt") else []
    command += [sys.executable, "-m", "swath.daemon.cli.main", "recover", "--background"]
    command += ["--keep-free-mb", str(reserve_bytes // 1_000_000), str(path)]
    process = await asyncio.create_subprocess_exec(
        *command,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        _, errors = await process.communicate()
    except asyncio.CancelledError:
        process.terminate()
        await process.wait()
        raise
    if process.returncode in (0, 4):
        text = f"{path.name}, left open by a crash, was repaired into a copy beside it"
        events.post(Severity.INFO, "recorder", "log_repaired", text)
        return
    lines = errors.decode(errors="replace").strip().splitlines()
    text = f"{path.name} could not be repaired: {lines[-1] if lines else f'exit status {process.returncode}'}"
    events.post(Severity.WARNING, "recorder", "repair_failed", text)
