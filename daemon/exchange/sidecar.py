"""Stores what a device's own format cannot hold of a log, in a file beside an exported one: ``FILE.swath.csv.gz``.

It is gzipped CSV with a row for every unit that the exported file does not describe completely:

    unit      its number in the file, from 0
    time_ns   its log time
    length    its number of bytes
    native    1 if the file has an entry for it (bytes, line, packet), 0 if not
    data      the unit in hexadecimal if the entry has other bytes; else empty
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from io import BufferedIOBase
from pathlib import Path
from types import TracebackType

from swath.drivers.captures.base import LATEST_NS, CaptureDamageError, CapturedUnit, open_capture, read_bytes

SUFFIX = ".swath.csv.gz"
_HEADER = "unit,time_ns,length,native,data"
_NATIVE = {"0": False, "1": True}
_MAX_UNIT_BYTES = 16 << 20  # a chunk of the recorder closes at 1 MiB
_MAX_LINE_BYTES = 2 * _MAX_UNIT_BYTES + 100


def sidecar_of(path: Path) -> Path:
    """Return the path of a file's sidecar, whether it exists or not."""
    return path.with_name(path.name + SUFFIX)


@dataclass(frozen=True, slots=True)
class SidecarRow:
    """One row of a sidecar: the facts about one unit that the exported file lacks; see the module's columns."""

    unit: int
    time_ns: int
    length: int
    native: bool
    data: bytes | None


class SidecarWriter:
    """Writes the sidecar of a file; without rows it creates no file."""

    def __init__(self, path: Path) -> None:
        self._path = sidecar_of(path)
        self._stream: gzip.GzipFile | None = None

    def add(self, unit: int, time_ns: int, length: int, *, native: bool = True, data: bytes | None = None) -> None:
        """Write one row, in the order of the units."""
        if self._stream is None:
            self._stream = gzip.GzipFile(self._path, "xb", mtime=0)
            self._stream.write(_HEADER.encode() + b"\n")
        text = "" if data is None else data.hex()
        self._stream.write(f"{unit},{time_ns},{length},{native:d},{text}\n".encode())

    def close(self) -> None:
        """Finish the file."""
        if self._stream is not None:
            self._stream.close()

    def __enter__(self) -> SidecarWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read_sidecar(path: Path) -> Iterator[SidecarRow]:
    """Yield the rows of a file's sidecar; yield nothing if there is no sidecar.

    Raises:
        CaptureDamageError: it is not a sidecar, or ends early.
    """
    sidecar = sidecar_of(path)
    if not sidecar.exists():
        return
    number, unit_before = 0, -1
    with open_capture(sidecar) as stream:
        while line := _line(stream, sidecar):
            number += 1
            if number == 1 and line.strip() == _HEADER:
                continue
            row = _row(line)
            if row is None or row.unit <= unit_before or not line.endswith("\n"):
                raise CaptureDamageError(f"{sidecar}: line {number}: want {_HEADER}")
            unit_before = row.unit
            yield row


def _line(stream: BufferedIOBase, sidecar: Path) -> str:
    try:
        return stream.readline(_MAX_LINE_BYTES).decode("ascii", "replace")
    except (EOFError, OSError, zlib.error) as error:
        raise CaptureDamageError(f"{sidecar}: cannot be read further: {error}") from error


def _row(line: str) -> SidecarRow | None:
    try:
        unit, time_ns, length, native, text = line.rstrip("\n").split(",")
        data = bytes.fromhex(text) if text or native == "0" else None
        row = SidecarRow(int(unit), int(time_ns), int(length), _NATIVE[native], data)
    except (ValueError, KeyError):
        return None
    fits = row.data is None or len(row.data) == row.length
    return row if fits and 0 <= row.length <= _MAX_UNIT_BYTES and 0 <= row.time_ns <= LATEST_NS else None


def complete(units: Iterator[CapturedUnit], path: Path, within_ns: int | None = None) -> Iterator[CapturedUnit]:
    """Return the units of a file that has one entry for each unit, completed by its sidecar.

    Args:
        units: as the file has them.
        path: the file.
        within_ns: maximum difference between the file's own stamps and the true ones; None allows any.

    Raises:
        CaptureDamageError: the sidecar does not belong to this file.
    """
    return _completed(units, path, within_ns) if sidecar_of(path).exists() else units


def _completed(units: Iterator[CapturedUnit], path: Path, within_ns: int | None) -> Iterator[CapturedUnit]:
    rows = read_sidecar(path)
    row = next(rows, None)
    number, channel = 0, ""
    while True:
        while row is not None and row.unit == number and not row.native:
            assert row.data is not None
            yield CapturedUnit(row.time_ns, row.data, channel)
            row, number = next(rows, None), number + 1
        unit = next(units, None)
        if unit is None:
            if row is not None:
                raise CaptureDamageError(
                    f"{sidecar_of(path)}: names unit {row.unit}, but the file beside it ends before"
                )
            return
        if row is not None and row.unit == number:
            near = within_ns is None or abs(row.time_ns - unit.time_ns) < within_ns
            if not near or (row.data is None and len(unit.data) != row.length):
                raise CaptureDamageError(f"{sidecar_of(path)}: unit {number} differs from the file beside it")
            unit = replace(unit, time_ns=row.time_ns, data=unit.data if row.data is None else row.data)
            row = next(rows, None)
        yield unit
        number, channel = number + 1, unit.channel


def cut_by_sidecar(path: Path) -> Iterator[CapturedUnit]:
    """Yield the units of a file of bytes without bounds, whose sidecar has a row for each.

    Raises:
        CaptureDamageError: the sidecar does not belong to this file.
    """
    with open_capture(path) as stream:
        for row in read_sidecar(path):
            data = row.data if row.data is not None else read_bytes(stream, row.length, path)
            if len(data) < row.length:
                raise CaptureDamageError(
                    f"{sidecar_of(path)}: names unit {row.unit}, but the file beside it ends before"
                )
            yield CapturedUnit(row.time_ns, data, "serial")
        if read_bytes(stream, 1, path):
            raise CaptureDamageError(f"{sidecar_of(path)}: ends before the file beside it")
