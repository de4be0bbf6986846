"""Reads the CAN frames of MF4 files (ASAM MDF 4, bus logging) with asammdf, also where the logger did not finish one.

Source of the names: ASAM MDF Bus Logging, as asammdf 8 and python-can 4.6 (can/io/mf4.py) use them.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import gc
import heapq
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from asammdf import MDF

from swath.drivers.can_frames import CAN_EFF_FLAG, CAN_EFF_MASK, CANFD_BRS, CANFD_ESI, data_frame
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
from swath.drivers.transports.base import TransportError
from swath.georef.arrays import FloatArray

_DATA, _REMOTE, _ERROR = "CAN_DataFrame", "CAN_RemoteFrame", "CAN_ErrorFrame"
_RECORDS_A_READ = 20_000
_IS_LOCAL = 0x01  # time flags of the header: the start is a local time without a zone
_UNIX = local_time(1970, 1, 1)


def mf4_time(path: Path) -> FileTime:
    """Return whether a file tells the time of its beginning in UTC or as a local time."""
    with _opened(path) as mdf:
        if not mdf.header.abs_time:
            return FileTime.SINCE_BEGIN
        return FileTime.LOCAL if mdf.header.time_flags & _IS_LOCAL else FileTime.UTC


def read_mf4(path: Path | str, clock: FileClock, tally: CaptureTally | None = None) -> Iterator[CapturedUnit]:
    """Read the frames of a file as SocketCAN units of 16 or 72 bytes, by time; a bus has its number as its name.

    Args:
        path: the file, possibly gzipped; it is then unpacked into the folder of temporary files.
        clock: the zone of the file's start where it has none, or the beginning of its times.
        tally: counts frames that no unit can hold, and error frames; where None, the former raise.

    Raises:
        TransportError: asammdf cannot read the file, or the file does not tell when it begins.
    """
    return until_damage(_units(Path(path), clock, tally), tally)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a file with asammdf, whose errors become `TransportError`."""
    with contextlib.ExitStack() as stack:
        plain = path
        with open_capture(path) as stream:
            if stream.__class__.__name__ == "GzipFile":
                folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="swath-mf4-"))
                plain = Path(folder, "unpacked.mf4")
                try:
                    with plain.open("wb") as copy:
                        shutil.copyfileobj(stream, copy)
                except (EOFError, OSError) as error:
                    raise TransportError(f"{path}: cannot be unpacked: {error}") from error
        mdf, why = _loaded(plain)
        if mdf is None:
            raise TransportError(f"{path}: asammdf cannot read it: {why}")
        stack.callback(mdf.close)
        yield mdf


def _loaded(path: Path) -> tuple[Any, str]:
    """Return asammdf's object of a file; None, and the reason, where it has none.

    What asammdf leaves of a file that it cannot read raises again when it is removed. It is removed here, while no such
    error is printed.
    """
    hook, why = sys.unraisablehook, ""
    sys.unraisablehook = _ignore
    try:
        try:
            return MDF(path), ""
        except Exception as error:  # asammdf raises any kind on damaged files
            why = _words(error)
        gc.collect()
    finally:
        sys.unraisablehook = hook
    return None, why


def _ignore(_: object) -> None:
    """Print nothing about an error that nobody can catch."""


def _words(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]


def _units(path: Path, clock: FileClock, tally: CaptureTally | None) -> Iterator[CapturedUnit]:
    with _opened(path) as mdf:
        header = mdf.header
        start_ns = clock.start_ns
        if start_ns is None and header.abs_time and not header.time_flags & _IS_LOCAL:
            start_ns = int(header.abs_time)
        if start_ns is None:
            told = _UNIX + dt.timedelta(microseconds=header.abs_time // 1000) if header.abs_time else None
            start_ns = clock.begin(told, path)
        streams = []
        for number, group in enumerate(mdf.groups):
            names = {channel.name for channel in group.channels}
            count = group.channel_group.cycles_nr
            for name in (_DATA, _REMOTE):
                if name in names and count:
                    streams.append(_group(mdf, number, name, count, start_ns, path, tally))
            if _ERROR in names and count and tally is not None:
                tally.passed["error frames"] += count
        yield from heapq.merge(*streams, key=lambda unit: unit.time_ns)


def _group(
    mdf: Any, number: int, name: str, count: int, start_ns: int, path: Path, tally: CaptureTally | None
) -> Iterator[CapturedUnit]:
    """Yield the units of one group of records, a part of the records at a time."""
    for offset, fields, stamps in _records(mdf, number, name, 0, count, path):
        ids, lengths = fields["ID"].astype(np.int64), fields["DataLength"].astype(np.int64)
        data = fields["DataBytes"] if name == _DATA else None
        is_extended = _flags(fields, "IDE", len(ids)) | (ids & CAN_EFF_FLAG != 0)
        is_fd, brs, esi = (_flags(fields, one, len(ids)) for one in ("EDL", "BRS", "ESI"))
        for row in range(len(ids)):
            can_id = int(ids[row]) & CAN_EFF_MASK | (CAN_EFF_FLAG if is_extended[row] else 0)
            flags = (CANFD_BRS if brs[row] else 0) | (CANFD_ESI if esi[row] else 0)
            length = int(lengths[row])
            try:
                time_ns = start_ns + round(float(stamps[row]) * 1e9)
                if data is None:
                    frame = data_frame(can_id, b"", is_fd=False, remote_length=length)
                else:
                    frame = data_frame(can_id, data[row][:length].tobytes(), is_fd=bool(is_fd[row]), flags=flags)
            except (ValueError, OverflowError) as error:
                report(tally, f"{path}: record {offset + row} of {name}: {error}")
                continue
            if 0 <= time_ns <= LATEST_NS:
                channel = str(int(fields["BusChannel"][row])) if "BusChannel" in fields else "1"
                yield CapturedUnit(time_ns, frame, channel)


def _records(
    mdf: Any, number: int, name: str, offset: int, count: int, path: Path
) -> Iterator[tuple[int, dict[str, Any], FloatArray]]:
    """Yield the records of a group from one on: their first number, fields by name, and times (n,) s.

    A part that cannot be read is halved, so that all records before the first bad one are read.

    Raises:
        CaptureDamageError: a record cannot be read.
    """
    needed = {"ID", "DataLength", "DataBytes"} if name == _DATA else {"ID", "DataLength"}
    for first in range(offset, offset + count, _RECORDS_A_READ):
        size = min(_RECORDS_A_READ, offset + count - first)
        try:
            signal = mdf.get(name, number, raw=True, record_offset=first, record_count=size)
            fields = {one.rpartition(".")[2]: signal.samples[one] for one in signal.samples.dtype.names or ()}
            stamps = np.asarray(signal.timestamps, np.float64)
            why = "" if needed <= fields.keys() else f"its records have no {', '.join(sorted(needed - fields.keys()))}"
        except Exception as error:  # asammdf raises any kind on damaged files
            fields, stamps, why = {}, np.zeros(0), _words(error)
        if not why:
            yield first, fields, stamps
        elif size == 1 or fields:
            raise CaptureDamageError(f"{path}: asammdf cannot read record {first} of {name}: {why}")
        else:
            yield from _records(mdf, number, name, first, size // 2, path)
            yield from _records(mdf, number, name, first + size // 2, size - size // 2, path)


def _flags(fields: dict[str, Any], name: str, count: int) -> Any:
    """Return a flag of each record, (count,) bool; all false where the records lack it."""
    return fields[name].astype(np.int64) != 0 if name in fields else np.zeros(count, bool)
