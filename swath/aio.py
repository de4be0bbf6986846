"""Devices as they send, in asyncio: one device, every device of a configuration, or a recorder's growing log.

Each wire has a thread that waits in the kernel, decodes, and hands whole readings to the loop; the loop is never
blocked, and is woken once for all that has come. A wire that is lost is opened again, as the recorder does it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self, TypeVar, get_args

import numpy as np

from swath.daemon.config import load_config
from swath.daemon.config.config import Config
from swath.daemon.config.load import validate
from swath.daemon.devices.listening import Batch, Clocks, Listening, Status, Times
from swath.daemon.errors import UserError
from swath.daemon.log.host_clock import HostClock
from swath.daemon.log.session import make_session_info
from swath.daemon.processing.records.tables import KINDS, RecordKind, table_of
from swath.daemon.processing.user_errors import as_user_error
from swath.drivers.driver import KINDS as DEVICE_KINDS
from swath.drivers.driver import RAW, all_drivers, probable_protocols
from swath.drivers.listening import BusyError, Overflow
from swath.drivers.parser import DeviceKind, DriverSettingsError
from swath.drivers.transports.base import TransportError
from swath.drivers.transports.spec import parse_transport
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.records import ChunkBatch, Record

__all__ = ["Aircraft", "Device", "Following", "Received", "Status", "follow", "open", "open_config"]

OverflowChoice = Literal["wait", "drop"]
QUEUE_MB = 64.0
NAME = "device"  # in the configuration that `open` makes
_Part = TypeVar("_Part")
_NO_TIMES = Times(np.empty(0, np.int64), np.empty(0))


@dataclass(frozen=True, slots=True)
class Received:
    """A record with its source and GPS time; ``source, record = received`` takes it apart.

    Attributes:
        source: ``kind/name``.
        record: as the driver gives it, a type of `swath.georef.records`.
        gps_ns: (n,) GPS ns since 1980-01-06 of the record's rows, one for a record without rows; −1: unknown. Empty if
            times are not wanted.
        time_sigma_s: (n,) standard deviation of it; 0: the device names the time itself; nan: unknown.
    """

    source: str
    record: Record
    gps_ns: Int64Array
    time_sigma_s: FloatArray

    def __iter__(self) -> Iterator[Any]:
        """Yield source and record."""
        return iter((self.source, self.record))

    @property
    def host_time_ns(self) -> Int64Array:
        """Host times (n,) of arrival of the record's rows, ns since 1970."""
        rows = getattr(self.record, "rows", None)
        return np.array([getattr(self.record, "host_time_ns", 0)]) if rows is None else rows["host_time_ns"]


def _received(batch: Batch) -> Iterator[Received]:
    for source, records in batch.records.items():
        times = batch.times.get(source) or [_NO_TIMES] * len(records)
        for record, time in zip(records, times, strict=True):
            yield Received(source, record, *time)


def _tables(kind: RecordKind, batch: Batch) -> Iterator[tuple[str, StructArray]]:
    for source, records in batch.records.items():
        table = table_of(kind, records, batch.times.get(source, []))
        if len(table):
            yield source, table


def _units(batch: Batch) -> Iterator[tuple[str, int, bytes]]:
    for block in batch.units:
        for time_ns, unit in zip(block.host_time_ns.tolist(), block.units, strict=True):
            yield batch.wire, time_ns, unit.tobytes()


def _reports(batch: Batch) -> Iterator[tuple[str, int, dict[str, Any]]]:
    for time_ns, values in batch.reports:
        yield batch.wire.removeprefix("/status/").removeprefix("/"), time_ns, values


class _Stream:
    """What comes from wires or a log, in order of arrival, for one task at a time."""

    def __init__(self, place: str, listening: Any) -> None:
        self._place, self._listening = Path(place), listening
        self._rests: dict[str, deque[Any]] = {}  # of batches that were not read to their end, by method

    async def _each(self, method: str, parts: Callable[[Batch], Iterable[_Part]]) -> AsyncIterator[_Part]:
        """Yield the parts of batches, one by one; those after a ``break`` come first in the next call."""
        rest = self._rests.setdefault(method, deque())
        while True:
            while rest:
                yield rest.popleft()
            with _errors(self._place):
                batch: Batch | None = await self._listening.take()
            if batch is None:
                return
            rest += parts(batch)

    def _received(self) -> AsyncIterator[Received]:
        return self._each("received", _received)

    def _lists(self) -> AsyncIterator[tuple[str, list[Record]]]:
        return self._each("batches", lambda batch: [found for found in batch.records.items() if found[1]])

    def _tables(self, records: str) -> AsyncIterator[tuple[str, StructArray]]:
        if records not in KINDS:
            raise UserError(f"{self._place}: no records {records!r}; want one of: {', '.join(KINDS)}")
        return self._each(records, partial(_tables, KINDS[records]))

    def _units(self) -> AsyncIterator[tuple[str, int, bytes]]:
        return self._each("units", _units)

    def _blocks(self) -> AsyncIterator[ChunkBatch]:
        return self._each("blocks", lambda batch: batch.units)

    async def __aenter__(self) -> Self:
        """Open the wires or the log."""
        await self._listening.__aenter__()
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the wires or the log, and wait for their threads."""
        await self._listening.__aexit__()


class Device(_Stream):
    """One device on one wire, as `open` gives it; an asynchronous context manager.

    Each record, table or unit comes once, to one task. ``break`` leaves the rest for the next ``async for`` of the same
    method.

    Attributes:
        source: ``gnss/device``, the name in records and tables.
        protocol: as given.
    """

    _listening: Listening

    def __init__(self, listening: Listening, source: str, *, wait: bool) -> None:
        super().__init__("swath.aio.open", listening)
        self.source, self._wait = source, wait
        self.protocol = listening.decoders[source].entry.protocol

    async def __aenter__(self) -> Self:
        """Open the wire, and wait for it.

        Raises:
            SwathError: it cannot be opened, and ``wait`` was not asked for.
        """
        await super().__aenter__()
        if self._wait:
            return self
        try:
            await self._listening.tried()
        except BaseException:
            await super().__aexit__()
            raise
        for listener in self._listening.listeners.values():
            if listener.session.last_error and not listener.session.openings:
                await super().__aexit__()
                raise UserError(listener.session.last_error)
        return self

    @property
    def status(self) -> Status:
        """State and counts: units, bytes, losses, records, errors."""
        return self._listening.status(self.source)

    async def records(self) -> AsyncIterator[Record]:
        """Yield records one by one, as the driver gives them: the types of `swath.georef.records`."""
        async for received in self._received():
            yield received.record

    async def received(self) -> AsyncIterator[Received]:
        """Yield records one by one, each with its GPS time."""
        async for received in self._received():
            yield received

    async def batches(self) -> AsyncIterator[list[Record]]:
        """Yield the records of each reading of the wire as a list; at high rates this costs least."""
        async for _, records in self._lists():
            yield records

    async def tables(self, records: str) -> AsyncIterator[StructArray]:
        """Yield the records of one kind as tables (n,) with GPS time, as `swath.Source` gives them.

        Args:
            records: ``fixes``, ``headings``, ``marks``, ``times``, ``samples``, ``solutions``, ``returns``, ``status``.

        Raises:
            SwathError: there is no such kind.
        """
        async for _, table in self._tables(records):
            yield table

    async def units(self) -> AsyncIterator[tuple[int, bytes]]:
        """Yield raw units (a serial read, a datagram, a CAN frame) with their host times, ns."""
        async for _, time_ns, unit in self._units():
            yield time_ns, unit

    async def blocks(self) -> AsyncIterator[ChunkBatch]:
        """Yield raw units of equal length together: ``units`` (n, length) uint8 and ``host_time_ns`` (n,)."""
        async for block in self._blocks():
            yield block

    async def send(self, data: bytes) -> None:
        """Send one unit: bytes to a port, a datagram, a SocketCAN frame of 16 or 72 bytes.

        Raises:
            SwathError: the device is away, or its wire cannot send.
        """
        why_not = await self._listening.send(self.source, data)
        if why_not:
            raise UserError(why_not)


class _Many(_Stream):
    """Several sources at once."""

    @property
    def sources(self) -> list[str]:
        """Names of the devices: ``gnss/rover``, ``imu/main``, ``scanner/left``."""
        names: list[str] = self._listening.sources
        return names

    def status(self, source: str) -> Status:
        """Return state and counts of a source."""
        found: Status = self._listening.status(source)
        return found

    async def records(self) -> AsyncIterator[Received]:
        """Yield records one by one; ``async for source, record in …`` takes each apart."""
        async for received in self._received():
            yield received

    async def batches(self) -> AsyncIterator[tuple[str, list[Record]]]:
        """Yield the records of a source in each reading of its wire as a list; at high rates this costs least."""
        async for found in self._lists():
            yield found

    async def tables(self, records: str) -> AsyncIterator[tuple[str, StructArray]]:
        """Yield source and table (n,) of the records of one kind, with GPS time, as `swath.Source` gives them.

        Args:
            records: as in `Device.tables`.

        Raises:
            SwathError: there is no such kind.
        """
        async for found in self._tables(records):
            yield found

    async def units(self) -> AsyncIterator[tuple[str, int, bytes]]:
        """Yield wire (``scanner/left/aux`` for a second port), host time, ns, and bytes of each raw unit."""
        async for found in self._units():
            yield found

    async def blocks(self) -> AsyncIterator[ChunkBatch]:
        """Yield raw units of equal length together; ``source`` is the wire."""
        async for block in self._blocks():
            yield block


class Aircraft(_Many):
    """Every device of a configuration, as `open_config` gives it; an asynchronous context manager.

    Each record, table or unit comes once, to one task, which may pass it on. ``break`` leaves the rest for the next
    ``async for`` of the same method.
    """

    _listening: Listening

    def status(self, source: str) -> Status:
        """Return state and counts of a source; of a pulse, ``pps/main``, units are edges.

        Raises:
            SwathError: the configuration has no such source.
        """
        known = dict.fromkeys([*self._listening.decoders, *self._listening.listeners])
        if source not in known:
            raise UserError(f"{self._place}: has no source {source!r}; it has: {', '.join(known) or 'none'}")
        return self._listening.status(source)

    async def send(self, source: str, data: bytes) -> None:
        """Send one unit to a device with a wire of its own.

        Raises:
            SwathError: there is no such wire, the device is away, or its wire cannot send.
        """
        if source not in self._listening.specs:
            known = ", ".join(self._listening.specs) or "none"
            raise UserError(f"{self._place}: has no wire {source!r}; it has: {known}")
        why_not = await self._listening.send(source, data)
        if why_not:
            raise UserError(why_not)


class Following(_Many):
    """A recorder's log as it grows, as `follow` gives it; an asynchronous context manager, and iterable without it."""

    @property
    def session_id(self) -> str:
        """Name of the recording that is read now; empty before the first."""
        name: str = self._listening.session_id
        return name

    async def reports(self) -> AsyncIterator[tuple[str, int, dict[str, Any]]]:
        """Yield what the recorder itself reports: source, host time, ns, and values.

        Of ``events`` the values are those of an event (source, code, severity, text), of a source, as ``scanner/left``,
        its status each second (state, units, losses).
        """
        async for found in self._each("reports", _reports):
            yield found

    async def __aiter__(self) -> AsyncIterator[Received]:
        """Open the log and yield its records one by one, until the loop is left."""
        async with self:
            async for received in self._received():
                yield received


def open(
    transport: str,
    protocol: str,
    *,
    kind: DeviceKind | None = None,
    pps: str | None = None,
    overflow: OverflowChoice = "wait",
    queue_mb: float = QUEUE_MB,
    wait: bool = False,
    times: bool = False,
    **options: Any,
) -> Device:
    """Prepare to open one device; ``async with`` opens it.

    Args:
        transport: as in a configuration: ``serial:/dev/ttyUSB0?baud=921600``, ``udp:0.0.0.0:2368``,
            ``tcp:192.168.3.1:28784``, ``can:socketcan:can0``.
        protocol: ``novatel``; `swath devices` lists them. ``raw``: units only.
        kind: gnss, imu, scanner or corrections, if the protocol is of several kinds on such a wire.
        pps: source of the pulse that is wired to this device: ``/dev/pps0``.
        overflow: if the reader is too slow, ``wait``: the thread waits, and the kernel's buffer may fill, which loses
            units of datagrams and CAN and is counted; ``drop``: the oldest readings go and are counted.
        queue_mb: memory of raw and decoded data that may wait for the reader, of each wire.
        wait: wait for a device that is absent at first, instead of raising an error.
        times: give records GPS times also without ``pps``, by what the device says; both need ``swath[process]``.
        options: other keys of the device's table: ``auxiliary``, ``dbc``, ``geometry``, ``rate_hz``, …

    Raises:
        SwathError: transport, protocol or an option is invalid.
    """
    with _errors(Path("swath.aio.open")):
        kind = kind or _kind_of(protocol, transport)
        table = {"transport": transport, **options, "protocol": protocol}
        if kind == "scanner":
            table = {"installation": np.eye(3).tolist(), **table}
        tables: dict[str, Any] = {"session": {"name": "aio", "directory": "."}, kind: {NAME: table}}
        if pps is not None:
            table["pps"] = "main"
            tables["pps"] = {"main": {"source": pps}}
        config = validate(tables, Path("swath.aio.open"), "")
        listening = _listening(config, overflow, queue_mb, times=times or pps is not None)
        return Device(listening, f"{kind}/{NAME}", wait=wait)


def open_config(
    config: Path | str, *, overflow: OverflowChoice = "wait", queue_mb: float = QUEUE_MB, times: bool = True
) -> Aircraft:
    """Prepare to open every device of a configuration; ``async with`` opens them. Absent devices are waited for.

    Args:
        config: the file.
        overflow, queue_mb: as in `open`.
        times: give records GPS times, by the configured pulses and receivers; needs ``swath[process]``.

    Raises:
        SwathError: the configuration cannot be used; a line for each fault.
    """
    with _errors(Path(config)):
        return Aircraft(str(config), _listening(load_config(config), overflow, queue_mb, times=times))


def follow(
    directory: Path | str, *, tail_s: float = 0.0, overflow: OverflowChoice = "wait", queue_mb: float = QUEUE_MB
) -> Following:
    """Prepare to follow the log that a recorder writes into a directory, from part to part and session to session.

    Records come when the recorder has completed their chunk, 0.25 s after their arrival at the least. A directory in
    which nothing is recorded yet is waited for. Reading waits for its reader: nothing is lost. It needs
    ``swath[process]``.

    Args:
        directory: of the recorder's logs.
        tail_s: how much of an already existing recording is read first, in seconds.
        overflow, queue_mb: as in `open`.

    Raises:
        SwathError: there is no such directory.
    """
    if not Path(directory).is_dir():
        raise UserError(f"{directory}: is not a directory; give that of the recorder's logs")
    return Following(str(directory), _live().DecodedLog(Path(directory), tail_s=tail_s, **_queue(overflow, queue_mb)))


def _listening(config: Config, overflow: str, queue_mb: float, *, times: bool) -> Listening:
    make_clocks = partial(_clocks, config) if times else None
    return Listening(config.devices(), config.pps, make_clocks=make_clocks, **_queue(overflow, queue_mb))


def _queue(overflow: str, queue_mb: float) -> dict[str, Any]:
    if overflow not in get_args(OverflowChoice):
        raise UserError(f"overflow {overflow!r}: want wait or drop")
    if not queue_mb > 0.0:
        raise UserError(f"queue_mb {queue_mb!r}: want a positive number")
    return {"overflow": Overflow(overflow), "queue_bytes": int(queue_mb * (1 << 20))}


def _clocks(config: Config, clock: HostClock) -> Clocks:
    made: Clocks = _live().live_clocks(config, make_session_info(config.session.name, clock))
    return made


def _live() -> Any:
    """Return the module that gives GPS times; it needs numba, which a computer that only listens may lack."""
    import importlib

    try:
        return importlib.import_module("swath.daemon.processing.records.live")
    except ImportError as error:
        text = f"{error.name} is not installed, which GPS times need; pip install 'swath[process]', or times=False"
        raise UserError(text) from error


def _kind_of(protocol: str, transport: str) -> DeviceKind:
    """Return the kind of device that a protocol means on a wire.

    Raises:
        UserError: the protocol is unknown, or of several kinds there.
    """
    if protocol == RAW:
        return "raw"
    every = {kind: drivers[protocol] for kind in DEVICE_KINDS if protocol in (drivers := all_drivers(kind))}
    if not every:
        known = {name: driver for kind in DEVICE_KINDS for name, driver in all_drivers(kind).items()}
        meant = probable_protocols(protocol, known)
        hint = f"did you mean {' or '.join(meant)}?" if meant else "`swath devices` lists them"
        raise UserError(f"unknown protocol {protocol!r}; {hint}")
    try:
        wire = parse_transport(transport).kind
    except ValueError as error:
        raise UserError(str(error)) from error
    fitting = [kind for kind, driver in every.items() if wire in driver.transports] or list(every)
    if len(fitting) > 1:
        choice = " or ".join(f'kind="{kind}"' for kind in fitting)
        raise UserError(f"protocol {protocol!r} is of several kinds; add {choice}")
    return fitting[0]


@contextmanager
def _errors(place: Path) -> Iterator[None]:
    """Raise every expected error as a `SwathError` with the sentence that a command prints."""
    with as_user_error(place, DriverSettingsError, TransportError, BusyError):
        yield
