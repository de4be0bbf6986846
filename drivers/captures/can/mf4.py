"""Reads the CAN frames of MF4 files (ASAM MDF 4, bus logging), also where the logger did not finish one.

asammdf reads them, in a process of its own: `mf4_reader`.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import json
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

from swath.drivers.captures.base import (
    LATEST_NS,
    CaptureDamageError,
    CapturedUnit,
    CaptureTally,
    open_capture,
    report,
    until_damage,
)
from swath.drivers.captures.can.clock import FileClock, FileTime, local_time
from swath.drivers.extras import how_to_install
from swath.drivers.transports.base import TransportError

SILENCE_S = 300  # seconds that the reader may work on a part; most take milliseconds
_READER = "swath.drivers.captures.can.mf4_reader"
_UNIX = local_time(1970, 1, 1)


def mf4_time(path: Path) -> FileTime:
    """Return whether a file tells the time of its beginning in UTC or as a local time.

    Raises:
        TransportError: as `read_mf4`.
    """
    with contextlib.closing(_lines(path)) as lines:
        begin = next(lines)
    if not begin["begin_ns"]:
        return FileTime.SINCE_BEGIN
    return FileTime.LOCAL if begin["is_local"] else FileTime.UTC


def read_mf4(path: Path | str, clock: FileClock, tally: CaptureTally | None = None) -> Iterator[CapturedUnit]:
    """Read the frames of a file as SocketCAN units of 16 or 72 bytes, by time; a bus has its number as its name.

    Args:
        path: the file, possibly gzipped; it is then unpacked into the folder of temporary files.
        clock: the zone of the file's start where it has none, or the beginning of its times.
        tally: counts frames that no unit can hold, and error frames; where None, the former raise.

    Raises:
        TransportError: asammdf is not installed or cannot read the file, or the file does not tell when it begins.
    """
    return until_damage(_units(Path(path), clock, tally), tally)


def _units(path: Path, clock: FileClock, tally: CaptureTally | None) -> Iterator[CapturedUnit]:
    with contextlib.closing(_lines(path)) as lines:
        start_ns = _start(next(lines), clock, path)
        for line in lines:
            if "bad" in line:
                report(tally, f"{path}: {line['bad']}")
            if "errors" in line and tally is not None:
                tally.passed["error frames"] += line["errors"]
            for after_ns, channel, frame in line.get("units", ()):
                time_ns = start_ns + after_ns
                if 0 <= time_ns <= LATEST_NS:
                    yield CapturedUnit(time_ns, bytes.fromhex(frame), channel)


def _start(begin: dict[str, Any], clock: FileClock, path: Path) -> int:
    """Return the time at which the file's times are 0, nanoseconds since 1970."""
    told_ns = int(begin["begin_ns"])
    if clock.start_ns is None and told_ns and not begin["is_local"]:
        return told_ns
    return clock.begin(_UNIX + dt.timedelta(microseconds=told_ns // 1000) if told_ns else None, path)


@contextlib.contextmanager
def _unpacked(path: Path) -> Iterator[Path]:
    """Make a file that asammdf can open of one that is gzipped."""
    with open_capture(path) as stream, contextlib.ExitStack() as stack:
        if stream.__class__.__name__ != "GzipFile":
            yield path
            return
        plain = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="swath-mf4-")), "unpacked.mf4")
        try:
            with plain.open("wb") as copy:
                shutil.copyfileobj(stream, copy)
        except (EOFError, OSError) as error:
            raise TransportError(f"{path}: cannot be unpacked: {error}") from error
        yield plain


def _lines(path: Path) -> Generator[dict[str, Any]]:
    """Yield what the reader's process says of a file, its beginning first.

    Raises:
        TransportError: asammdf is not installed, or cannot read the file.
        CaptureDamageError: the file cannot be read further.
    """
    with _unpacked(path) as plain:
        command = [sys.executable, "-m", _READER, str(plain)]
        with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            said, ending = 0, ""
            try:
                for line in process.stdout:
                    told = json.loads(line)
                    if "missing" in told:
                        how = how_to_install("import")
                        raise TransportError(f"{path}: MF4 files need asammdf, which is not installed: {how}")
                    if "failed" in told:
                        raise TransportError(f"{path}: asammdf cannot read it: {told['failed']}")
                    if "damage" in told:
                        raise CaptureDamageError(f"{path}: {told['damage']}")
                    said += 1
                    yield told
                if process.wait():
                    ending = _fate(process.returncode)
            finally:
                process.kill()
    if ending and not said:
        raise TransportError(f"{path}: asammdf cannot read it: {ending}")
    if ending:
        raise CaptureDamageError(f"{path}: asammdf cannot read it further: {ending}")


def _fate(status: int) -> str:
    if status == -signal.SIGALRM:
        return f"no answer within {SILENCE_S} s"
    return f"it was ended by {signal.Signals(-status).name}" if status < 0 else f"exit code {status}"
