"""Logs: their sources, and the sources' records as NumPy tables with GPS time.

A log is one flight or several: files, folders, recovered logs, and logs that are still being written, of which the part
written so far is read. Nothing is read before it is asked for.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np

from swath.daemon.config import load_config
from swath.daemon.errors import UserError
from swath.daemon.log.reader import Session, open_logs
from swath.daemon.processing.records.capture import CapturedScanner
from swath.daemon.processing.records.read import EVER, LogRecords
from swath.daemon.processing.records.tables import KINDS, flat_columns
from swath.daemon.processing.user_errors import as_user_error
from swath.drivers.parser import DriverSettingsError
from swath.drivers.transports.base import TransportError
from swath.georef.arrays import FloatArray, StructArray
from swath.georef.records import Record
from swath.georef.timescales.gps_time import gps_ns_from_datetime

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    import xarray as xr

    from swath.daemon.config.config import Config

__all__ = ["Capture", "Log", "Source", "gps_ns", "open", "read_pcap"]

Time = int | dt.datetime | None
_USUAL = {"gnss": "fixes", "imu": "samples", "scanner": "returns"}
_Read = TypeVar("_Read")


def gps_ns(time: int | dt.datetime) -> int:
    """Return a time as GPS nanoseconds since 1980-01-06; an integer is taken as such already.

    Raises:
        SwathError: a `datetime` without a time zone.
    """
    if isinstance(time, int):
        return time
    if time.tzinfo is None:
        raise UserError(f"{time}: has no time zone; add tzinfo=datetime.UTC, or give GPS nanoseconds")
    return gps_ns_from_datetime(time)


def open(*paths: Path | str, config: Path | str | None = None) -> Log:
    """Open logs: files, folders, or several of both; parts and sessions come in order of time.

    Args:
        paths: files ``*.mcap`` and folders of them.
        config: configuration to use instead of the one stored in each log.

    Raises:
        SwathError: a file is not a log, there are no logs, or a configuration cannot be used.
    """
    with _errors(Path(paths[0]) if paths else Path()):
        if not paths:
            raise UserError("swath.open: no path is given; name a log or a folder of logs")
        loaded = None if config is None else load_config(config)
        files = [Path(path) for path in paths]
        passed_over: list[str] = []
        sessions = open_logs(files, passed_over)
        return Log(files, [LogRecords.of_session(session, loaded) for session in sessions], loaded, passed_over)


class Log:
    """One flight or several, as `open` gives it; a context manager.

    Attributes:
        paths: as given.
        warnings: lines on files that were passed over.
    """

    def __init__(
        self, paths: Sequence[Path], sessions: Sequence[LogRecords], config: Config | None, warnings: list[str]
    ) -> None:
        self.paths, self.warnings = list(paths), warnings
        self._opened: list[LogRecords] | None = list(sessions)
        self._config = config

    @property
    def _sessions(self) -> list[LogRecords]:
        if self._opened is None:
            raise UserError(f"{self.paths[0]}: this log was closed at the end of its with block; open it again")
        return self._opened

    def __enter__(self) -> Self:
        """Return the log."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the log: what was read is forgotten."""
        self._opened = None

    def __repr__(self) -> str:
        """Return the paths and sources."""
        what = "closed" if self._opened is None else ", ".join(self.sources)
        return f"<swath.Log {', '.join(map(str, self.paths))}: {what}>"

    def __iter__(self) -> Iterator[Source]:
        """Yield the sources."""
        return (self[name] for name in self.sources)

    def __getitem__(self, name: str) -> Source:
        """Return a source by its name, ``gnss/rover``.

        Raises:
            SwathError: the configuration has no such source.
        """
        if name not in self.sources:
            raise UserError(f"{self.paths[0]}: has no source {name!r}; it has: {', '.join(self.sources) or 'none'}")
        return Source(name, [session for session in self._sessions if name in session.sources])

    @property
    def sources(self) -> list[str]:
        """Names of the configured devices: ``gnss/rover``, ``imu/main``, ``scanner/left``."""
        return list(dict.fromkeys(name for session in self._sessions for name in session.sources))

    @property
    def sessions(self) -> list[str]:
        """Names of the recordings, in order of time."""
        return [session.session.session_id for session in self._sessions]

    @property
    def recordings(self) -> list[Session]:
        """The recordings as `swath.daemon.log.reader` gives them."""
        return [session.session for session in self._sessions]

    @property
    def config(self) -> Config | None:
        """The configuration to be used instead of the logs' own; None: the logs' own."""
        return self._config

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """GPS ns of the first and the last message; None: GPS time is not known."""
        with _errors(self.paths[0]):
            spans = [span for session in self._sessions if (span := session.span()) is not None]
        return (min(first for first, _ in spans), max(last for _, last in spans)) if spans else None

    def to_pandas(
        self, name: str, records: str | None = None, *, start: Time = None, stop: Time = None
    ) -> pd.DataFrame:
        """Return a source's records as a pandas data frame indexed by GPS time, ns; needs ``swath[frames]``.

        Args:
            name: of the source.
            records: ``fixes``, ``headings``, ``marks``, ``times``, ``samples``, ``solutions``, ``returns``; None: the
                usual ones of its kind. Columns are flat, with units in their names.
            start, stop: as in `Source.fixes`.

        Raises:
            SwathError: as in `Source.fixes`, or pandas is not installed.
        """
        pandas = _extra("pandas")
        columns = self._columns(name, records, start, stop)
        frame: pd.DataFrame = pandas.DataFrame(columns).set_index("gps_ns")
        return frame

    def to_xarray(self, name: str, records: str | None = None, *, start: Time = None, stop: Time = None) -> xr.Dataset:
        """Return a source's records as an xarray data set along ``gps_ns``; arguments as in `to_pandas`."""
        xarray = _extra("xarray")
        columns = self._columns(name, records, start, stop)
        times = columns.pop("gps_ns")
        data = {key: ("gps_ns", column) for key, column in columns.items()}
        said = {"source": name, "time": "GPS ns since 1980-01-06"}
        dataset: xr.Dataset = xarray.Dataset(data, coords={"gps_ns": times}, attrs=said)
        return dataset

    def to_arrow(self, name: str, records: str | None = None, *, start: Time = None, stop: Time = None) -> pa.Table:
        """Return a source's records as an Arrow table; arguments as in `to_pandas`."""
        arrow = _extra("pyarrow")
        columns = self._columns(name, records, start, stop)
        return arrow.table({key: arrow.array(column) for key, column in columns.items()})

    def _columns(self, name: str, records: str | None, start: Time, stop: Time) -> dict[str, Any]:
        source = self[name]
        table = source.table(records or _USUAL.get(source.kind, "status"), start, stop)
        # data frames want the byte order and the layout of plain arrays
        return {key: np.ascontiguousarray(column) for key, column in flat_columns(table).items() if key != "values"}


class Source:
    """A device of a log: its records as tables, all or a slice of time.

    A table is a NumPy structured array in order of arrival. Each row begins with ``gps_ns`` (GPS nanoseconds since
    1980-01-06, −1: unknown), ``time_sigma_s`` (its standard deviation; 0: the device names the time itself; nan:
    unknown) and ``host_time_ns`` (arrival at the recorder). Units are SI, angles radians; frames are those of
    docs/conventions.md, named in the fields: ``_b`` body, ``_l`` north-east-down.
    """

    def __init__(self, name: str, sessions: Sequence[LogRecords]) -> None:
        self.name, self._sessions = name, sessions

    def __repr__(self) -> str:
        """Return name and protocol."""
        return f"<swath.Source {self.name}: {self.protocol}>"

    @property
    def kind(self) -> str:
        """Kind of the device: gnss, imu, scanner, corrections or raw."""
        return self._sessions[0].sources[self.name]

    @property
    def protocol(self) -> str:
        """Protocol of the device, as in the configuration."""
        return self._sessions[0].protocol(self.name)

    @property
    def errors(self) -> dict[str, int]:
        """Counts of what could not be decoded when the source was read last, by error code."""
        found: dict[str, int] = {}
        for session in self._sessions:
            counters = session.counters.get(self.name)
            for code, count in (counters.errors if counters is not None else {}).items():
                found[code] = found.get(code, 0) + count
        return found

    def fixes(self, start: Time = None, stop: Time = None) -> StructArray:
        """Return the positions and velocities (n,) of a receiver: latitude, longitude, ellipsoidal height, covariances.

        Args:
            start, stop: GPS nanoseconds, or a `datetime` with a time zone: start ≤ time < stop. None: the log's begin
                or end; without both, records whose time is unknown come too. Of a slice, only its chunks are read.

        Raises:
            SwathError: the log cannot be read, or does not know GPS time and a slice is wanted.
        """
        return self.table("fixes", start, stop)

    def headings(self, start: Time = None, stop: Time = None) -> StructArray:
        """Return the headings (n,) of a second antenna or a compass; arguments as in `fixes`."""
        return self.table("headings", start, stop)

    def marks(self, start: Time = None, stop: Time = None) -> StructArray:
        """Return the event marks (n,) that a receiver stamped; arguments as in `fixes`."""
        return self.table("marks", start, stop)

    def times(self, start: Time = None, stop: Time = None) -> StructArray:
        """Return the messages (n,) that name the second of an edge; arguments as in `fixes`."""
        return self.table("times", start, stop)

    def samples(self, start: Time = None, stop: Time = None) -> StructArray:
        """Return the samples (n,) of an IMU, along its own axes: specific force, m/s², angular rate, rad/s.

        Arguments as in `fixes`. Without a slice, times are those with which `swath trajectory` navigates.
        """
        return self.table("samples", start, stop)

    def solutions(self, start: Time = None, stop: Time = None) -> StructArray:
        """Return the positions and attitudes (n,) that a device's own INS computed; arguments as in `fixes`."""
        return self.table("solutions", start, stop)

    def status(self, start: Time = None, stop: Time = None) -> StructArray:
        """Return the device's reports (n,) on its health, each a dict in ``values``; arguments as in `fixes`."""
        return self.table("status", start, stop)

    def returns(self, start: Time = None, stop: Time = None) -> Iterator[StructArray]:
        """Yield a scanner's returns in tables of some ten thousand rows, as measured; memory is bounded.

        Arguments as in `fixes`.
        """
        begin, end = _span(start, stop)
        for session in self._sessions:
            yield from self._each(session, session.returns(self.name, begin, end))

    def table(self, records: str, start: Time = None, stop: Time = None) -> StructArray:
        """Return a table (n,) of the records of one kind: ``fixes``, …, ``returns``; arguments as in `fixes`.

        Raises:
            SwathError: there is no such kind, or as in `fixes`.
        """
        if records not in KINDS:
            raise UserError(f"{self.name}: no records {records!r}; want one of: {', '.join(KINDS)}")
        begin, end = _span(start, stop)
        found = [
            self._read(session, partial(session.table, self.name, records, begin, end)) for session in self._sessions
        ]
        return found[0] if len(found) == 1 else np.concatenate(found)

    def records(self) -> Iterator[Record]:
        """Yield all records as the driver's parser gives them: the types of `swath.georef.records`, in order."""
        for session in self._sessions:
            for piece in self._each(session, session.records(self.name)):
                yield from piece

    def units(self) -> Iterator[tuple[int, bytes]]:
        """Yield the raw units of the wire (a serial read, a datagram, a CAN frame) with their host times, ns."""
        for session in self._sessions:
            yield from self._each(session, session.units(self.name, EVER))

    def _read(self, session: LogRecords, read: Callable[[], _Read]) -> _Read:
        with _errors(session.session.parts[0].path):
            return read()

    def _each(self, session: LogRecords, pieces: Iterator[_Read]) -> Iterator[_Read]:
        with _errors(session.session.parts[0].path):
            yield from pieces


def read_pcap(path: Path | str, protocol: str, *, port: int | None = None, **options: Any) -> Capture:
    """Open a scanner's datagrams in a pcap or pcapng file, possibly gzipped.

    Args:
        path: the file.
        protocol: of the scanner, ``velodyne-vlp16``; `swath devices` lists them.
        port: UDP port of its returns; None: the one that most bytes went to.
        options: other keys of ``[scanner.<name>]`` of a configuration: ``geometry``, ``mirror_factor``, …

    Raises:
        SwathError: the file cannot be read, or the protocol or an option is unknown.
    """
    with _errors(Path(path)):
        return Capture(CapturedScanner(Path(path), protocol, port, options))


class Capture:
    """A scanner's returns in a network capture, as `read_pcap` opens it.

    Times are the head's own (``device_time_ns``) and those of the capture (``host_time_ns``). To have GPS times,
    import the capture into a log with `swath import`, together with what names the seconds.
    """

    def __init__(self, captured: CapturedScanner) -> None:
        self._captured = captured

    @property
    def errors(self) -> dict[str, int]:
        """Counts of what could not be decoded in the last reading, by error code."""
        return self._captured.errors

    def returns(self) -> Iterator[StructArray]:
        """Yield the returns in tables, as `Source.returns` does; ``gps_ns`` is unknown.

        Raises:
            SwathError: the file cannot be read.
        """
        with _errors(self._captured.path):
            yield from self._captured.returns()

    def xyz(self) -> FloatArray:
        """Return the places (n, 3) of all returns in the scanner's own frame, m: right, forward, up of spinning heads.

        Raises:
            SwathError: the file cannot be read, or the geometry of the beams is not known.
        """
        with _errors(self._captured.path):
            pieces = [places for places, _ in self._captured.places()]
        return np.concatenate(pieces) if pieces else np.empty((0, 3))


def _span(start: Time, stop: Time) -> tuple[int | None, int | None]:
    return None if start is None else gps_ns(start), None if stop is None else gps_ns(stop)


@contextmanager
def _errors(place: Path) -> Iterator[None]:
    """Raise every expected error as a `SwathError` with the sentence that a command prints."""
    with as_user_error(place, DriverSettingsError, TransportError):
        yield


def _extra(module: str) -> Any:
    """Return a module of the extra ``frames``."""
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise UserError(f"{module} is not installed; pip install 'swath[frames]'") from error
