"""Keeps the faults of another package's parser away from the recording and from the other devices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from swath.drivers.parser import DeviceSettings, DriverSettingsError, Parser, StreamParser
from swath.georef.records import (
    AIMED_RETURN_DTYPE,
    DEVICE_CLOCK_DTYPE,
    IMU_DTYPE,
    INS_DTYPE,
    RETURN_DTYPE,
    Chunk,
    ChunkBatch,
    DeviceClockSamples,
    ImuSamples,
    InsSolution,
    Record,
    ScannerReturns,
)

DRIVER_FAULT = "driver_fault"  # counts units whose records are lost
_ROWS: dict[type, tuple[np.dtype[Any], ...]] = {
    DeviceClockSamples: (DEVICE_CLOCK_DTYPE,),
    ImuSamples: (IMU_DTYPE,),
    InsSolution: (INS_DTYPE,),
    ScannerReturns: (RETURN_DTYPE, AIMED_RETURN_DTYPE),
}


class GuardedParser(Parser):
    """Runs the parser of another package: what it raises is counted, and the work goes on with the next units.

    Its other attributes, such as ``beams``, are that parser's.

    Args:
        parser: the other parser.
        source: ``kind/name``.
        package: name and version of its package.
        yields: types of the records that its driver declares.

    Attributes:
        parser: the other parser.
        fault: a line on the first fault; empty: it has none so far.
    """

    def __init__(self, parser: Parser, source: str, package: str, yields: tuple[type, ...]) -> None:
        super().__init__()
        self.parser, self.fault = parser, ""
        self.counters = parser.counters
        self._source, self._package, self._yields = source, package, yields

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the other parser; a copy of this one, not filled yet, has none."""
        if name == "parser" or name.startswith("_"):
            raise AttributeError(name)
        return getattr(self.parser, name)

    @property
    def warnings(self) -> tuple[str, ...]:
        """The parser's warnings."""
        return tuple(self._call(lambda: list(self.parser.warnings), 0, 1, ()))

    def feed(self, chunk: Chunk) -> list[Record]:
        """Take one unit; return its records."""
        return self._records(lambda: self.parser.feed(chunk), len(chunk.data), 1)

    def feed_batch(self, batch: ChunkBatch) -> list[Record]:
        """Take consecutive units; return their records."""
        return self._records(lambda: self.parser.feed_batch(batch), batch.units.size, len(batch.units))

    def feed_batches(self, batches: Sequence[ChunkBatch]) -> list[Record]:
        """Take consecutive batches; return their records."""
        size, count = sum(batch.units.size for batch in batches), sum(len(batch.units) for batch in batches)
        return self._records(lambda: self.parser.feed_batches(batches), size, count)

    def close(self) -> list[Record]:
        """Return the records still held back; after a fault, bytes that were left over count as skipped."""
        records, counters = self._records(self.parser.close, 0, 1), self.counters
        if self.fault and isinstance(self.parser, StreamParser):
            counters.bytes_skipped = counters.bytes - counters.bytes_framed
        return records

    def remarks(self) -> list[str]:
        """Return the parser's lines for the user, and that on its own fault."""
        lines: list[str] = self._call(lambda: list(self.parser.remarks()), 0, 1, [])
        return [*lines, self.fault] if self.fault else lines

    def _records(self, run: Callable[[], list[Record]], size: int, units: int) -> list[Record]:
        found: list[Record] = self._call(lambda: list(run()), size, units, [])
        return [record for record in found if self._is_declared(record)]

    def _call(self, run: Callable[[], Any], size: int, units: int, otherwise: Any) -> Any:
        """Run a method of the parser on units of ``size`` bytes; if it raises, return ``otherwise`` and count them."""
        counters = self.counters
        before = counters.bytes, counters.bytes_framed, counters.bytes_skipped
        try:
            return run()
        except Exception as error:
            counters.bytes = before[0] + size
            packets = not isinstance(self.parser, StreamParser)
            if packets or counters.bytes_framed + counters.bytes_skipped > counters.bytes:
                counters.bytes_framed, counters.bytes_skipped = before[1], before[2] + size * packets
            self._note(f"{type(error).__name__}: {error}", units)
            return otherwise

    def _is_declared(self, record: Record) -> bool:
        """Return whether a record is of a declared type, with the rows that this type has."""
        kind = type(record)
        rows = _ROWS.get(kind)
        if kind in self._yields and (rows is None or any(record.rows.dtype == one for one in rows)):  # type: ignore[union-attr]
            return True
        self._note(f"returned {kind.__name__}, which it does not declare or whose rows are not those of this type", 1)
        return False

    def _note(self, text: str, units: int) -> None:
        self.counters.errors[DRIVER_FAULT] += units
        self.fault = self.fault or (
            f"{self._source}: its driver, package {self._package}, fails on its data and loses records: "
            f"{' '.join(text.split())}; tell the package's makers"
        )


def guarded(
    make: Callable[[DeviceSettings], Parser], package: str, yields: tuple[type, ...]
) -> Callable[[DeviceSettings], Parser]:
    """Return a maker of guarded parsers; whatever another package's maker raises is a `DriverSettingsError`."""

    def made(settings: DeviceSettings) -> Parser:
        try:
            parser = make(settings)
            if not isinstance(parser, Parser):
                raise TypeError(f"made a {type(parser).__name__}, which is no Parser")
            return GuardedParser(parser, settings.source, package, yields)
        except DriverSettingsError:
            raise
        except Exception as error:
            text = f"{type(error).__name__}: {error}"
            raise DriverSettingsError(f"its driver, package {package}, fails: {' '.join(text.split())}") from error

    return made


def guarded_call(
    run: Callable[..., Any], package: str, *, otherwise: Any = None, refuse: bool = False
) -> Callable[..., Any]:
    """Return a function of another package that returns ``otherwise`` if it raises, or refuses the settings."""

    def called(*arguments: Any) -> Any:
        try:
            return run(*arguments)
        except DriverSettingsError:
            raise
        except Exception as error:
            if not refuse:
                return otherwise
            text = f"{type(error).__name__}: {error}"
            raise DriverSettingsError(f"its driver, package {package}, fails: {' '.join(text.split())}") from error

    return called
