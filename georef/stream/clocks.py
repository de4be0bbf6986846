"""The clocks of a stream of records: the host's, those of its pulses per second, and one of each device.

A clock's answer depends on what it was fed before the question. So records are only collected as they come, and taken
by `StreamClocks.update` at the stream's ticks, in one order: readings of the host's clocks, then edges and time
messages by host time, then what the devices said.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from swath.georef.compiled import jit_cached
from swath.georef.records import Int64Array, NamesEdge, PpsEdge, StructArray, TimeMessage
from swath.georef.timescales import (
    ClockEvent,
    ClockStatus,
    DeviceClock,
    HostTimeline,
    PpsClock,
    Stamps,
    StampScale,
    WallComparison,
)

CELL_BITS = 24  # 16.8 ms of device time: within, a device's clock is taken as linear, which is good to 2 ns
MAX_CELLS = 1024  # of one question; devices that restarted, and hours that turned, are asked row by row
MAX_RATE_OFF = 1e-3  # of device time against GPS time


@jit_cached
def _place(
    device_ns: Int64Array, first_cell: int, gps_ns: Int64Array, rate: NDArray[np.float64], out: Int64Array
) -> None:
    for i in range(len(device_ns)):
        cell = (device_ns[i] >> CELL_BITS) - first_cell
        into = device_ns[i] - ((cell + first_cell) << CELL_BITS)
        out[i] = gps_ns[cell] + np.int64(np.rint(into * rate[cell]))


@jit_cached
def _bounds(device_ns: Int64Array, host_ns: Int64Array) -> tuple[int, int, int, int]:
    least, most, earliest, latest = device_ns[0], device_ns[0], host_ns[0], host_ns[0]
    for i in range(len(device_ns)):
        least, most = min(least, device_ns[i]), max(most, device_ns[i])
        earliest, latest = min(earliest, host_ns[i]), max(latest, host_ns[i])
    return least, most, earliest, latest


@dataclass(frozen=True, slots=True)
class PpsPlan:
    """A source of edges: leap seconds until a receiver says, and the delay that is subtracted from its stamps."""

    leap_seconds: int | None = None
    delay_ns: int = 0


@dataclass(frozen=True, slots=True)
class GnssPlan:
    """A receiver that names seconds: of which pulse (``pps/main``; None: of none), and an override of which edge."""

    pps: str | None = None
    names_edge: NamesEdge | None = None
    leap_seconds: int | None = None


@dataclass(frozen=True, slots=True)
class DevicePlan:
    """A device with a clock of its own: the source that shows the host's time (``pps/main``), how its stamps count.

    stamps: what they are configured to count from; AUTO: found where the device does not say; None: not looked for.
    """

    clock: str
    past_utc_hour: bool = False
    stamps: StampScale | None = None


@dataclass(frozen=True, slots=True)
class ClockPlan:
    """Which clocks there are, by source (``pps/main``, ``gnss/rover``, ``scanner/left``).

    Attributes:
        host_minus_monotonic_ns: realtime_ns − monotonic_ns of the session.
    """

    host_minus_monotonic_ns: int
    pps: Mapping[str, PpsPlan] = field(default_factory=dict)
    gnss: Mapping[str, GnssPlan] = field(default_factory=dict)
    devices: Mapping[str, DevicePlan] = field(default_factory=dict)


class HostClocks:
    """The host's clock in GPS time: one `PpsClock` a pulse per second, and one a receiver that is wired to none.

    Args:
        plan: the clocks.
        keep_history: answers of all times stay possible.
        wall_names: a disciplined wall clock may name the seconds of pulses that no receiver names.
    """

    def __init__(self, plan: ClockPlan, *, keep_history: bool = False, wall_names: bool = False) -> None:
        self.plan = plan
        self.timeline = HostTimeline(plan.host_minus_monotonic_ns, keep_history=keep_history)
        self.by_source: dict[str, PpsClock] = {}
        for source, pps in plan.pps.items():
            self.by_source[source] = PpsClock(
                assumed_leap_seconds=pps.leap_seconds, delay_ns=pps.delay_ns, keep_history=keep_history
            )
        for source, gnss in plan.gnss.items():
            shared = None if gnss.pps is None else self.by_source[gnss.pps]
            self.by_source[source] = shared or PpsClock(
                assumed_leap_seconds=gnss.leap_seconds, keep_history=keep_history
            )
        self._beside_wall = WallComparison("the recording computer's clock", whole_log=True) if keep_history else None
        self._readings: deque[tuple[int, int, int, float]] = deque()
        self._spoken: list[tuple[int, bool, str, PpsEdge | TimeMessage]] = []
        # by a receiver: a wall clock decides between seconds, and is no time alone unless the caller takes it for one
        self._told: set[PpsClock] = set(self.by_source.values()) if wall_names else set()

    def add_reading(
        self, realtime_ns: int, monotonic_ns: int, monotonic_raw_ns: int, max_error_s: float = math.inf
    ) -> None:
        """The host's clocks side by side; max_error_s of the wall clock, inf: nobody keeps it."""
        self._readings.append((realtime_ns, monotonic_ns, monotonic_raw_ns, max_error_s))

    def add_edge(self, source: str, edge: PpsEdge) -> None:
        """An edge of ``pps/name``."""
        self._spoken.append((edge.host_time_ns, False, source, edge))

    def add_message(self, source: str, message: TimeMessage) -> None:
        """A time message of ``gnss/name``."""
        self._spoken.append((message.host_time_ns, True, source, message))

    def update(self) -> None:
        """Take what has come since the last call."""
        for reading in self._readings:
            self.timeline.add(*reading[:3])
        self._spoken.sort(key=lambda said: said[:2])
        for host_ns, _, source, said in self._spoken:
            self._read_wall_clock(host_ns)
            raw_ns = self.timeline.raw_at(host_ns)
            if isinstance(said, PpsEdge):
                self.by_source[source].add_edge(raw_ns, said.sequence)
                continue
            if self._beside_wall is not None:
                self._beside_wall.hear(source, said)
            names = self.plan.gnss[source].names_edge or said.names_edge
            self.by_source[source].add_message(source, replace(said, host_time_ns=raw_ns, names_edge=names))
            self._told.add(self.by_source[source])
        self._spoken.clear()
        self._read_wall_clock(None)

    def _read_wall_clock(self, until_ns: int | None) -> None:
        """Tell the clocks what the wall clock said up to a host time: as while recording, it may name a second."""
        readings, host_minus_ns = self._readings, self.timeline.host_minus_monotonic_ns
        while readings and (until_ns is None or readings[0][1] + host_minus_ns <= until_ns):
            realtime_ns, monotonic_ns, raw_ns, max_error_s = readings.popleft()
            if self._beside_wall is not None:
                self._beside_wall.set_wall(realtime_ns - monotonic_ns - host_minus_ns, kept=max_error_s < math.inf)
            for clock in self._told:
                clock.set_wall_clock(raw_ns, realtime_ns, disciplined=math.isfinite(max_error_s), sigma_s=max_error_s)

    def add_coarse(self, source: str, host_ns: Int64Array, gps_ns: Int64Array) -> None:
        """Tell the clock of a source that nothing else sets what GPS time it was at host times (n,), to some 0.1 s."""
        for raw_ns, at_ns in zip(self.timeline.raw_from_host(host_ns).tolist(), gps_ns.tolist(), strict=True):
            self.by_source[source].add_coarse(raw_ns, at_ns)

    def gps_from_host(self, source: str, host_ns: Int64Array) -> tuple[Int64Array, NDArray[np.float64]]:
        """Return GPS ns (n,) and sigma ns (n,; inf without time) of host times (n,), by the clock that a source
        shows.
        """
        return self.by_source[source].gps_from_host(self.timeline.raw_from_host(host_ns))

    def settle(self) -> list[str]:
        """Take the seconds that most messages of the whole log name, after all has been fed; lines for the user.

        A line also of each receiver whose time is hours or days from the recording computer's clock.
        """
        lines = [line for clock in dict.fromkeys(self.by_source.values()) for line in clock.settle()]
        return lines + (self._beside_wall.lines() if self._beside_wall is not None else [])

    def tag_error_ns(self, source: str, host_ns: Int64Array, *, utc: bool) -> Int64Array:
        """Return by how much (n,) a receiver's tags of one scale were ahead that arrived at host times (n,)."""
        error_s = self.by_source[source].tag_error_s(source, self.timeline.raw_from_host(host_ns), utc=utc)
        return error_s * 1_000_000_000

    def status(self, source: str, host_ns: int) -> ClockStatus:
        """Of the clock that a source shows, at a host time."""
        return self.by_source[source].status(self.timeline.raw_at(host_ns))

    def drain_events(self) -> list[tuple[str, ClockEvent]]:
        """Return what the clocks had to say since the last call, with the source that shows each."""
        return [(source, event) for source, clock in self.by_source.items() for event in clock.drain_events()]


class StreamClocks:
    """The host's clocks and the devices' own; with ``frozen`` the host's are complete and take nothing more.

    stamps: what devices' stamps count from, where that was found beforehand.
    """

    def __init__(self, host: HostClocks, *, frozen: bool = False, stamps: Mapping[str, Stamps] | None = None) -> None:
        self.host = host
        self.frozen = frozen
        known = stamps or {}
        self._devices = {
            source: DeviceClock(
                host.by_source[device.clock],
                past_utc_hour=device.past_utc_hour,
                keep_history=frozen,
                wanted=None if frozen and source not in known else device.stamps,
                stamps=known.get(source),
            )
            for source, device in host.plan.devices.items()
        }
        self._samples: dict[str, list[StructArray]] = {source: [] for source in self._devices}

    @classmethod
    def growing(cls, plan: ClockPlan) -> StreamClocks:
        """Return clocks that know what has been fed so far, and of that the last quarter of an hour."""
        return cls(HostClocks(plan))

    def add_reading(
        self, realtime_ns: int, monotonic_ns: int, monotonic_raw_ns: int, max_error_s: float = math.inf
    ) -> None:
        """See `HostClocks.add_reading`."""
        if not self.frozen:
            self.host.add_reading(realtime_ns, monotonic_ns, monotonic_raw_ns, max_error_s)

    def add_edge(self, source: str, edge: PpsEdge) -> None:
        """See `HostClocks.add_edge`."""
        if not self.frozen:
            self.host.add_edge(source, edge)

    def add_message(self, source: str, message: TimeMessage) -> None:
        """See `HostClocks.add_message`."""
        if not self.frozen:
            self.host.add_message(source, message)

    def add_samples(self, source: str, rows: StructArray) -> None:
        """What a device's clock said: `DEVICE_CLOCK_DTYPE` rows in order of arrival."""
        self._samples[source].append(rows)

    def update(self) -> None:
        """Take what has come since the last call."""
        if not self.frozen:
            self.host.update()
        for source, pieces in self._samples.items():
            if pieces:
                rows = np.concatenate(pieces)
                self._devices[source].add(rows, self.host.timeline.raw_from_host(rows["host_time_ns"]))
                pieces.clear()

    def place(self, source: str, rows: StructArray, max_sigma_ns: float) -> tuple[NDArray[np.bool_], Int64Array]:
        """Return which rows (n,) have a time that is good enough, and GPS ns (n,), by device time and host time."""
        if source not in self._devices or not len(rows):
            return np.zeros(len(rows), np.bool_), np.zeros(len(rows), np.int64)
        quick = self._by_cells(source, rows, max_sigma_ns)
        if quick is not None:
            return np.ones(len(rows), np.bool_), quick
        gps_ns, sigma_ns = self.gps_from_device(source, rows["device_time_ns"], rows["host_time_ns"])
        return sigma_ns <= max_sigma_ns, gps_ns

    def gps_from_device(
        self, source: str, device_ns: Int64Array, host_ns: Int64Array
    ) -> tuple[Int64Array, NDArray[np.float64]]:
        """Return GPS ns (n,) and sigma ns (n,; inf: not known) of device times (n,) that came at host times (n,)."""
        return self._devices[source].gps_from_device(device_ns, self.host.timeline.raw_from_host(host_ns))

    def _by_cells(self, source: str, rows: StructArray, max_sigma_ns: float) -> Int64Array | None:
        """Return GPS ns (n,) between the edges of cells of device time; None where rows must be asked one by one.

        The edges are asked as if they had come first, and as if last: where the answers differ, or are not all good,
        something happened between.
        """
        device_ns, host_ns = rows["device_time_ns"], rows["host_time_ns"]
        least, most, earliest, latest = _bounds(device_ns, host_ns)
        first, last = least >> CELL_BITS, most >> CELL_BITS
        if last - first >= MAX_CELLS:
            return None
        edges = np.arange(first, last + 2, dtype=np.int64) << CELL_BITS
        at_ns = np.repeat(np.array([earliest, latest], dtype=np.int64), len(edges))
        asked_ns, sigma_ns = self.gps_from_device(source, np.tile(edges, 2), at_ns)
        gps_ns, again_ns = np.split(asked_ns, 2)
        rate = np.diff(gps_ns) / float(1 << CELL_BITS)
        if (sigma_ns > max_sigma_ns).any() or (gps_ns != again_ns).any() or (np.abs(rate - 1.0) > MAX_RATE_OFF).any():
            return None
        placed = np.empty(len(rows), np.int64)
        _place(device_ns, first, gps_ns, rate, placed)
        return placed

    def stamps(self, source: str) -> Stamps | None:
        """Return what a device's stamps were found to count from; None: nothing was found or looked for."""
        return self._devices[source].stamps

    def refused(self, source: str) -> dict[str, int]:
        """Return what a device's clock refused, by reason."""
        return self._devices[source].status().refused


@dataclass(frozen=True, slots=True)
class HeadTime:
    """Hold what a scanner itself says of time in a log.

    Attributes:
        messages: sentences or packets that it vouches for.
        trouble: why its time cannot be used, and the remedy; empty: it can, or it says nothing.
    """

    messages: int = 0
    trouble: str = ""


@dataclass(frozen=True)
class FrozenClocks:
    """The host's clocks after all of a log has been fed to them; each stream gets its own devices' clocks beside.

    Pickles. A device's clock lies in the same packets as its returns, so it is not complete before those are read; a
    stream that reads a piece of a log is given the packets around the piece too.

    Attributes:
        host: the host's.
        stamps: what devices' stamps count from, by source, as the whole log shows it.
        heads: what scanners say of time themselves, by source; none that was not asked.
        remarks: lines for the user on the dates that scanners were given, where one is the clock.
    """

    host: HostClocks
    stamps: Mapping[str, Stamps] = field(default_factory=dict)
    heads: Mapping[str, HeadTime] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()

    def trouble(self, source: str | None) -> str:
        """Return why what a scanner says of time cannot be used; empty: it can, or it says nothing."""
        head = self.heads.get(source or "")
        return "" if head is None else head.trouble

    def for_stream(self) -> StreamClocks:
        """Return clocks for one stream over any piece of the log."""
        return StreamClocks(self.host, frozen=True, stamps=self.stamps)
