"""Reads an MF4 file with asammdf in a process of its own, and prints a JSON object a line.

    python -m swath.drivers.captures.can.mf4_reader FILE

asammdf's compiled code ends its process on some damaged files, its arrays outgrow the memory on others, and it prints
its errors itself. Here that costs one file, and `mf4` says so. The lines:

* ``{"begin_ns": 0, "is_local": true}``: the file's beginning, nanoseconds since 1970, 0: it tells none; always first;
* ``{"errors": 3}``: error frames, which no unit can hold;
* ``{"bad": "…"}``: something that is left out;
* ``{"units": [[after_ns, channel, hex], …]}``: SocketCAN units by time, nanoseconds after the beginning;
* ``{"damage": "…"}``: why the reading ends early;
* ``{"failed": "…"}``: why nothing can be read; ``{"missing": "asammdf"}``: it is not installed.

Source of the names: ASAM MDF Bus Logging, as asammdf 8 and python-can 4.6 (can/io/mf4.py) use them.
"""

from __future__ import annotations

import heapq
import json
import logging
import os
import resource
import signal
import sys
from collections.abc import Iterator
from typing import Any, TextIO

import numpy as np

from swath.drivers.can_frames import CAN_EFF_FLAG, CAN_EFF_MASK, CANFD_BRS, CANFD_ESI, data_frame
from swath.drivers.captures.can.mf4 import SILENCE_S
from swath.georef.arrays import FloatArray

_DATA, _REMOTE, _ERROR = "CAN_DataFrame", "CAN_RemoteFrame", "CAN_ErrorFrame"
_RECORDS_A_READ = 20_000
_UNITS_A_LINE = 1000
_IS_LOCAL = 0x01  # time flags of the header: the start is a local time without a zone
_ELSEWHERE = 1  # a channel whose values, of any length, stand in a block of their own
_LONGEST = 64  # bytes of a frame
_MEMORY = 4 << 30  # bytes; the file itself, which is mapped, is not counted

_Unit = tuple[int, str, bytes]


class _DamageError(Exception):
    """A place after which the file cannot be read."""


class _Teller:
    """Prints the lines."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def tell(self, **words: object) -> None:
        """Print a line; without another, the process ends after a while, wherever it is."""
        signal.alarm(0)  # the reader of the lines may take its time
        self._stream.write(json.dumps(words) + "\n")
        self._stream.flush()
        signal.alarm(SILENCE_S)


def main() -> None:
    """Read the file that the command line names."""
    lines = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # for what asammdf prints
    os.dup2(1, 2)
    logging.disable()
    resource.setrlimit(resource.RLIMIT_DATA, (_MEMORY, _MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    teller = _Teller(lines)
    signal.alarm(SILENCE_S)
    try:
        _read(sys.argv[1], teller)
    except BrokenPipeError:
        pass  # nobody wants more
    os._exit(0)  # what asammdf leaves of a damaged file raises again when it is removed


def _read(path: str, teller: _Teller) -> None:
    try:
        from asammdf import MDF
    except ImportError:
        teller.tell(missing="asammdf")
        return
    try:
        mdf: Any = MDF(path)
    except Exception as error:  # asammdf raises any kind on damaged files
        teller.tell(failed=_words(error))
        return
    header = mdf.header
    teller.tell(begin_ns=int(header.abs_time), is_local=bool(header.time_flags & _IS_LOCAL))
    part: list[_Unit] = []
    damage = ""
    try:
        for unit in _units(mdf, teller):
            part.append(unit)
            if len(part) == _UNITS_A_LINE:
                _tell_units(part, teller)
                part = []
    except _DamageError as error:
        damage = str(error)
    _tell_units(part, teller)
    if damage:
        teller.tell(damage=damage)


def _tell_units(units: list[_Unit], teller: _Teller) -> None:
    teller.tell(units=[[after_ns, channel, frame.hex()] for after_ns, channel, frame in units])


def _words(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]


def _units(mdf: Any, teller: _Teller) -> Iterator[_Unit]:
    streams = []
    for number, group in enumerate(mdf.groups):
        names = {channel.name for channel in group.channels}
        count = group.channel_group.cycles_nr
        for name in (_DATA, _REMOTE):
            if name not in names or not count:
                continue
            if unfit := _unfit(mdf, number):
                teller.tell(bad=f"the records of {name} are damaged: {unfit}")
            else:
                streams.append(_group(mdf, number, name, count, teller))
        if _ERROR in names and count:
            teller.tell(errors=int(count))
    yield from heapq.merge(*streams, key=lambda unit: unit[0])


def _unfit(mdf: Any, number: int) -> str:
    """Return why a group's records cannot be a CAN bus's, or "": asammdf would make arrays of gigabytes of such."""
    group = mdf.groups[number]
    bits = 8 * group.channel_group.samples_byte_nr
    for index, one in enumerate(group.channels):
        if 8 * one.byte_offset + one.bit_offset + one.bit_count > bits:
            return f"{one.name} reaches beyond their {bits // 8} bytes"
        if one.channel_type == _ELSEWHERE:
            try:
                longest = getattr(mdf, "_mdf", mdf).determine_max_vlsd_sample_size(number, index)
            except Exception as error:  # asammdf raises any kind on damaged files
                return _words(error)
            if longest > _LONGEST:
                return f"{one.name} has {longest} bytes in one"
    return ""


def _group(mdf: Any, number: int, name: str, count: int, teller: _Teller) -> Iterator[_Unit]:
    """Yield the units of one group of records, a part of the records at a time."""
    for offset, fields, stamps in _records(mdf, number, name, 0, count):
        ids, lengths = fields["ID"].astype(np.int64), fields["DataLength"].astype(np.int64)
        data = fields["DataBytes"] if name == _DATA else None
        is_extended = _flags(fields, "IDE", len(ids)) | (ids & CAN_EFF_FLAG != 0)
        is_fd, brs, esi = (_flags(fields, one, len(ids)) for one in ("EDL", "BRS", "ESI"))
        for row in range(len(ids)):
            can_id = int(ids[row]) & CAN_EFF_MASK | (CAN_EFF_FLAG if is_extended[row] else 0)
            flags = (CANFD_BRS if brs[row] else 0) | (CANFD_ESI if esi[row] else 0)
            length = int(lengths[row])
            try:
                after_ns = round(float(stamps[row]) * 1e9)
                if data is None:
                    frame = data_frame(can_id, b"", is_fd=False, remote_length=length)
                else:
                    frame = data_frame(can_id, data[row][:length].tobytes(), is_fd=bool(is_fd[row]), flags=flags)
            except (ValueError, OverflowError) as error:
                teller.tell(bad=f"record {offset + row} of {name}: {error}")
                continue
            channel = str(int(fields["BusChannel"][row])) if "BusChannel" in fields else "1"
            yield after_ns, channel, frame


def _records(
    mdf: Any, number: int, name: str, offset: int, count: int
) -> Iterator[tuple[int, dict[str, Any], FloatArray]]:
    """Yield the records of a group from one on: their first number, fields by name, and times (n,) s.

    A part that cannot be read is halved, so that all records before the first bad one are read.

    Raises:
        _DamageError: a record cannot be read, or there are fewer than the file says.
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
            if len(stamps) < size:
                raise _DamageError(f"{name} ends at record {first + len(stamps)}, not {offset + count}")
        elif size == 1 or fields:
            raise _DamageError(f"asammdf cannot read record {first} of {name}: {why}")
        else:
            yield from _records(mdf, number, name, first, size // 2)
            yield from _records(mdf, number, name, first + size // 2, size - size // 2)


def _flags(fields: dict[str, Any], name: str, count: int) -> Any:
    """Return a flag of each record, (count,) bool; all false where the records lack it."""
    return fields[name].astype(np.int64) != 0 if name in fields else np.zeros(count, bool)


if __name__ == "__main__":
    main()
