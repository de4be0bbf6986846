"""Writes a flight of the virtual aircraft into an ordinary log, as a recorder on board would have written it.

All content follows from the flight: no clock, name or number of this computer is used, so that the same plan gives the
same bytes.
"""

from __future__ import annotations

import heapq
import itertools
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from swath import __version__
from swath.daemon.config import Config
from swath.daemon.exchange.log_maker import MadeLog, Source
from swath.daemon.exchange.routes import Port, Routes
from swath.daemon.log.block_queue import SourceCount
from swath.daemon.log.channels import JsonChannel
from swath.daemon.log.events import Severity
from swath.daemon.log.format import SessionInfo
from swath.daemon.log.host_clock import STA_UNSYNC, ClockDiscipline
from swath.daemon.log.session import session_name
from swath.daemon.log.wires import SILENT_AFTER_S
from swath.daemon.recorder.assembly import make_timekeeper
from swath.daemon.recorder.run import CLOCK_PERIOD_S
from swath.daemon.simulate.flight import Flight, VirtualClock, VirtualUnit
from swath.drivers.captures.base import Address
from swath.drivers.transports.base import UnitBlock

HOST = "virtual"
FIRST_HEAD = 201  # 192.168.1.201, the factory setting of the heads
_NOBODY_KEEPS_IT = ClockDiscipline(0.0, STA_UNSYNC, float("inf"))
_TOLD_EVERY = 2000  # units between two calls of the progress function

_Due = tuple[float, Callable[[float], None]]


def virtual_boot_id(name: str, seed: int) -> str:
    """Return the boot id of the virtual host, derived from the plan's name and seed."""
    return str(uuid.uuid5(uuid.NAMESPACE_URL, f"swath:sim:{name}:{seed}"))


def sim_session_info(name: str, clock: VirtualClock, seed: int) -> SessionInfo:
    """Return the session of a flight that begins at time 0."""
    boot_id, start_ns = virtual_boot_id(name, seed), clock.realtime_ns(0.0)
    return SessionInfo(
        session_id=session_name(name, start_ns, boot_id),
        software=f"swath {__version__}",
        host=HOST,
        boot_id=boot_id,
        realtime_ns=start_ns,
        monotonic_ns=clock.monotonic_ns(0.0),
        origin="simulation",
    )


@dataclass(slots=True)
class _Line:
    """A source as the recorder sees it.

    Attributes:
        peer: sender of its datagrams.
        opened_ns: time when its wire was last opened; no units came before.
        edges: the channel of a PPS source; sequence: the number of its latest edge.
    """

    source: Source
    peer: Address | None
    opened_ns: int
    plugged: bool = True
    heard: bool = False
    reported_silent: bool = False
    edges: JsonChannel | None = None
    sequence: int = 0

    @property
    def since_ns(self) -> int:
        """Time since when no units have come."""
        return self.source.last_ns if self.heard else self.opened_ns


class SimLog(MadeLog):
    """The log of a flight.

    Args:
        config: of the virtual recorder; it contains every source of the flight.
        directory: of the log.
        flight: not flown yet.
        seed: of its plan.

    Raises:
        OSError: the directory cannot be written.
    """

    def __init__(self, config: Config, directory: Path, flight: Flight, seed: int) -> None:
        self._host = flight.host_clock
        super().__init__(config, directory, sim_session_info(config.session.name, self._host, seed), "recorder")
        self._keeper = make_timekeeper(config, self.events, self.clock.offset_ns)
        self._clock_channel = JsonChannel(self.channels, "clock", "/clock", "swath.Clock")
        self._edge_of = {name: pps.edge for name, pps in config.pps.items()}
        self._sample_clock(0.0)
        text = f"session {self.info.session_id}, {len(flight.sources)} sources, {self.info.software}, simulation"
        self.event(Severity.INFO, "session_started", text)
        self._lines: dict[str, _Line] = {}
        heads = 0
        for port in _in_order(Routes.of(config), flight.sources):
            heads += port.kind == "udp" and not port.source.endswith("/aux")
            self._add_line(port, heads)
        self._time_of = {name: self._keeper.units_seen(name) for name in self._lines if name.startswith("gnss/")}
        self._edge_seen = {name: self._keeper.edge_seen(name) for name in self._lines if name.startswith("pps/")}
        self._due = self._schedule(flight)
        self._next = next(self._due)

    # ------------------------------------------------------------------ statuses of a recorder

    def count_of(self, source: Source, now_ns: int) -> SourceCount:
        """Return the account of a source as a receiver gives it."""
        line = self._lines[source.port.source]
        silent = now_ns - line.since_ns > SILENT_AFTER_S * 1e9
        state = "absent" if not line.plugged else "silent" if silent else "receiving"
        if silent and line.plugged and not line.reported_silent:
            line.reported_silent = True
            text = f"no data for {(now_ns - line.since_ns) * 1e-9:.0f} s"
            self.events.post(Severity.WARNING, source.port.source, "silent", text)
        last_ns = source.last_ns if line.heard else None
        return SourceCount(units=source.units, bytes=source.bytes, last_unit_ns=last_ns, state=state)

    def time_status(self, source: str) -> dict[str, object]:
        """Return the time status from the clock models that a recorder uses."""
        return self._keeper.status(source, self.clock.time_ns)

    # ------------------------------------------------------------------ units

    def add(self, unit: VirtualUnit) -> None:
        """Add one unit; raises OSError if the disk refuses a chunk."""
        self.go_on_to(unit.time_s)
        now_ns = self._host.host_ns(unit.time_s)
        self.go_on(now_ns)
        line = self._lines[unit.source]
        if line.reported_silent:
            self._tell_resumed(line, now_ns)
        line.heard = True
        if line.edges is not None:
            self._add_edge(line, line.edges, unit.time_s, now_ns)
            return
        self.add_unit(line.source, line.peer, now_ns, unit.data)
        time_of = self._time_of.get(unit.source)
        if time_of is not None:
            time_of(np.array([now_ns], np.int64), UnitBlock(np.frombuffer(unit.data, np.uint8)[np.newaxis, :]))
            self.lay_told()

    def go_on_to(self, time_s: float) -> None:
        """Do everything that is due until a time of the flight: clock readings, unplugged and replugged wires."""
        while self._next[0] <= time_s:
            due_s, action = self._next
            action(due_s)
            self._next = next(self._due)

    def _tell_resumed(self, line: _Line, now_ns: int) -> None:
        text = f"data again after {(now_ns - line.since_ns) * 1e-9:.1f} s"
        line.reported_silent = False
        self.events.post(Severity.INFO, line.source.port.source, "resumed", text)
        self.lay_told()

    def _add_edge(self, line: _Line, channel: JsonChannel, time_s: float, now_ns: int) -> None:
        name = line.source.port.source
        line.sequence += 1
        value: dict[str, object] = {
            "edge_time_ns": now_ns,
            "sequence": line.sequence,
            "edge": self._edge_of[name.removeprefix("pps/")],
            "realtime_ns": self._host.realtime_ns(time_s),
        }
        block = channel.encode(now_ns, value)
        line.source.count(len(block.data), now_ns)
        self._parts.add(block)
        self._edge_seen[name](now_ns, line.sequence)
        self.lay_told()

    # ------------------------------------------------------------------ scheduled actions

    def _schedule(self, flight: Flight) -> Iterator[_Due]:
        """Return the endless sequence of actions with their times."""
        ticks: Iterator[_Due] = ((number * CLOCK_PERIOD_S, self._sample_clock) for number in itertools.count(1))
        once: list[_Due] = [(at_s, partial(self._wall_step, step_s)) for at_s, step_s in flight.wall_steps]
        for source, from_s, to_s in flight.unplugged:
            once += [(from_s, partial(self._plug, source, False)), (to_s, partial(self._plug, source, True))]
        return heapq.merge(ticks, sorted(once, key=_when), key=_when)

    def _sample_clock(self, time_s: float) -> None:
        now_ns = self._host.host_ns(time_s)
        self.go_on(now_ns)
        monotonic_ns = self._host.monotonic_ns(time_s)
        sample = {
            "realtime_ns": self._host.realtime_ns(time_s),
            "monotonic_ns": monotonic_ns,
            "monotonic_raw_ns": monotonic_ns,
            "frequency_ppm": _NOBODY_KEEPS_IT.frequency_ppm,
            "status": _NOBODY_KEEPS_IT.status,
        }
        self._keeper.clock_sample(sample, _NOBODY_KEEPS_IT)
        self._parts.add(self._clock_channel.encode(now_ns, dict(sample)))
        self.lay_told()

    def _wall_step(self, step_s: float, time_s: float) -> None:
        self._sample_clock(time_s)
        text = f"the wall clock was stepped by {step_s:+.6f} s; log times are not affected"
        self._parts.add(self.events.make(Severity.WARNING, "clock", "wall_clock_stepped", text))

    def _plug(self, source: str, plugged: bool, time_s: float) -> None:
        now_ns = self._host.host_ns(time_s)
        self.go_on(now_ns)
        line = self._lines[source]
        line.plugged, line.opened_ns, line.heard, line.reported_silent = plugged, now_ns, False, False
        if plugged:
            block = self.events.make(Severity.INFO, source, "device_opened", "opened")
        else:
            block = self.events.make(Severity.ERROR, source, "device_lost", "disconnected; waiting for it")
        self._parts.add(block)

    def _add_line(self, port: Port, head: int) -> None:
        source = self.add_source(port)
        peer = (f"192.168.1.{FIRST_HEAD - 1 + head}", port.spec.port) if port.kind == "udp" and port.spec else None
        line = self._lines[port.source] = _Line(source, peer, self.clock.time_ns)
        if port.kind == "pps":
            line.edges = JsonChannel(self.channels, port.source, port.channel.topic, "swath.Pps")
        self._parts.add(self.events.make(Severity.INFO, port.source, "device_opened", "opened"))


def _in_order(routes: Routes, sources: tuple[str, ...]) -> Iterator[Port]:
    """Return the ports of a flight in the order of the configuration: PPS, GNSS, IMU, scanners."""
    return (port for name, port in routes.ports.items() if name in sources)


def _when(due: _Due) -> float:
    return due[0]


@dataclass(frozen=True, slots=True)
class SimReport:
    """The result of a flight."""

    session_id: str
    paths: list[Path]
    seconds: float
    units: dict[str, int]
    returns: int
    bytes: int


Progress = Callable[[float, int, int, int], None]


def fly_into_log(
    config: Config,
    directory: Path,
    flight: Flight,
    seed: int,
    progress: Progress = lambda seconds, units, returns, size: None,
) -> SimReport:
    """Fly a flight into a log, as fast as the computer can.

    Args:
        config, directory, flight, seed: as of `SimLog`.
        progress: called occasionally with the seconds flown, units, returns and bytes so far.

    Raises:
        UserError: a log of this session exists already.
        OSError: it cannot be written; nothing is left of it.
    """
    log = SimLog(config, directory, flight, seed)
    number = 0
    try:
        for number, unit in enumerate(flight.units(), start=1):
            log.add(unit)
            if number % _TOLD_EVERY == 0:
                progress(unit.time_s, number, flight.returns, log.bytes_written())
        log.go_on_to(flight.duration_s)
        log.finish()
    except BaseException:
        log.give_up()
        raise
    size = sum(path.stat().st_size for path in log.paths)
    progress(flight.duration_s, number, flight.returns, size)
    return SimReport(log.info.session_id, log.paths, flight.duration_s, log.units(), flight.returns, size)
