"""The clocks of a stream of records: the host's, those of its pulses per second, and one of each device.

A clock's answer depends on its input before the question. Therefore records are only collected as they come;
`StreamClocks.update` processes them at the stream's ticks, in one order: readings of the host's clocks, then edges and
time messages by host time, then the devices' clock samples.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray
from swath.georef.compiled import jit_cached
from swath.georef.records import NamesEdge, PpsEdge, TimeMessage
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

CELL_BITS = 24  # 16.8 ms of device time: within it a device's clock is taken as linear, which is accurate to 2 ns
MAX_CELLS = 1024  # of one request; restarted devices, and turns of the hour, exceed it and are processed row by row
MAX_RATE_OFF = 1e-3  # of device time against GPS time


@jit_cached
def _place(device_ns: Int64Array, first_cell: int, gps_ns: Int64Array, rate: FloatArray, out: Int64Array) -> None:
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
    """A source of edges: leap seconds assumed until a receiver gives them, and the delay that its stamps contain."""

    leap_seconds: int | None = None
    delay_ns: int = 0


@dataclass(frozen=True, slots=True)
class GnssPlan:
    """A receiver that names seconds: its pulse (``pps/main``; None: no pulse), and an override of the named edge."""

    pps: str | None = None
    names_edge: NamesEdge | None = None
    leap_seconds: int | None = None


@dataclass(frozen=True, slots=True)
class DevicePlan:
    """A device with its own clock: the source that shows the host's time (``pps/main``), and the origin of its stamps.

    stamps: their configured origin; AUTO: found if the device does not give it; None: not searched.
    """

    clock: str
    past_utc_hour: bool = False
    stamps: StampScale | None = None


@dataclass(frozen=True, slots=True)
class ClockPlan:
    """The clocks that exist, by source (``pps/main``, ``gnss/rover``, ``scanner/left``).

    Attributes:
        host_minus_monotonic_ns: realtime_ns − monotonic_ns of the session.
    """

    host_minus_monotonic_ns: int
    pps: Mapping[str, PpsPlan] = field(default_factory=dict)
    gnss: Mapping[str, GnssPlan] = field(default_factory=dict)
    devices: Mapping[str, DevicePlan] = field(default_factory=dict)


class HostClocks:
    """The host's clock in GPS time: one `PpsClock` per pulse per second, and one per receiver without a pulse.

    Args:
        plan: the clocks.
        keep_history: whether answers remain possible for all times.
        wall_names: whether a disciplined wall clock may name the seconds of pulses that no receiver names.
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
        # by a receiver: a wall clock only decides between seconds, unless the caller accepts it as the sole source
        self._told: set[PpsClock] = set(self.by_source.values()) if wall_names else set()

    def add_reading(
        self, realtime_ns: int, monotonic_ns: int, monotonic_raw_ns: int, max_error_s: float = math.inf
    ) -> None:
        """Take the host's clocks read side by side; max_error_s of the wall clock, inf: not disciplined."""
        self._readings.append((realtime_ns, monotonic_ns, monotonic_raw_ns, max_error_s))

    def add_edge(self, source: str, edge: PpsEdge) -> None:
        """Take an edge of ``pps/name``."""
        self._spoken.append((edge.host_time_ns, False, source, edge))

    def add_message(self, source: str, message: TimeMessage) -> None:
        """Take a time message of ``gnss/name``."""
        self._spoken.append((message.host_time_ns, True, source, message))

    def update(self) -> None:
        """Process the input since the last call."""
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
        """Give the clocks the wall clock's readings up to a host time; as while recording, it may name a second."""
        readings, host_minus_ns = self._readings, self.timeline.host_minus_monotonic_ns
        while readings and (until_ns is None or readings[0][1] + host_minus_ns <= until_ns):
            realtime_ns, monotonic_ns, raw_ns, max_error_s = readings.popleft()
            if self._beside_wall is not None:
                self._beside_wall.set_wall(realtime_ns - monotonic_ns - host_minus_ns, kept=max_error_s < math.inf)
            for clock in self._told:
                clock.set_wall_clock(raw_ns, realtime_ns, disciplined=math.isfinite(max_error_s), sigma_s=max_error_s)

    def add_coarse(self, source: str, host_ns: Int64Array, gps_ns: Int64Array) -> None:
        """Give GPS times at host times (n,), to about 0.1 s, to the clock of a source without any other time."""
        for raw_ns, at_ns in zip(self.timeline.raw_from_host(host_ns).tolist(), gps_ns.tolist(), strict=True):
            self.by_source[source].add_coarse(raw_ns, at_ns)

    def gps_from_host(self, source: str, host_ns: Int64Array) -> tuple[Int64Array, FloatArray]:
        """Return GPS ns (n,) and sigma ns (n,; inf without time) of host times (n,), by a source's clock."""
        return self.by_source[source].gps_from_host(self.timeline.raw_from_host(host_ns))

    def settle(self) -> list[str]:
        """Adopt the seconds that most messages of the whole log name, after all input; return lines for the user.

        Each receiver whose time is hours or days from the recording computer's clock also has a line.
        """
        lines = [line for clock in dict.fromkeys(self.by_source.values()) for line in clock.settle()]
        return lines + (self._beside_wall.lines() if self._beside_wall is not None else [])

    def tag_error_ns(self, source: str, host_ns: Int64Array, *, utc: bool) -> Int64Array:
        """Return how much (n,) a receiver's tags of one scale were ahead, for tags that arrived at host times (n,)."""
        error_s = self.by_source[source].tag_error_s(source, self.timeline.raw_from_host(host_ns), utc=utc)
        return error_s * 1_000_000_000

    def status(self, source: str, host_ns: int) -> ClockStatus:
        """Return the status of a source's clock at a host time."""
        return self.by_source[source].status(self.timeline.raw_at(host_ns))

    def drain_events(self) -> list[tuple[str, ClockEvent]]:
        """Return the clocks' events since the last call, each with its source."""
        return [(source, event) for source, clock in self.by_source.items() for event in clock.drain_events()]


class StreamClocks:
    """The host's clocks and the devices' own; with ``frozen`` the host's are complete and take no more input.

    stamps: the origins of devices' stamps as far as they were found beforehand.
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
        """Return clocks that know the input so far, and remember the last quarter of an hour of it."""
        return cls(HostClocks(plan))

    def add_reading(
        self, realtime_ns: int, monotonic_ns: int, monotonic_raw_ns: int, max_error_s: float = math.inf
    ) -> None:
        """Take readings as `HostClocks.add_reading` does, unless frozen."""
        if not self.frozen:
            self.host.add_reading(realtime_ns, monotonic_ns, monotonic_raw_ns, max_error_s)

    def add_edge(self, source: str, edge: PpsEdge) -> None:
        """Take an edge as `HostClocks.add_edge` does, unless frozen."""
        if not self.frozen:
            self.host.add_edge(source, edge)

    def add_message(self, source: str, message: TimeMessage) -> None:
        """Take a message as `HostClocks.add_message` does, unless frozen."""
        if not self.frozen:
            self.host.add_message(source, message)

    def add_samples(self, source: str, rows: StructArray) -> None:
        """Take a device's clock samples: `DEVICE_CLOCK_DTYPE` rows in order of arrival."""
        self._samples[source].append(rows)

    def update(self) -> None:
        """Process the input since the last call."""
        if not self.frozen:
            self.host.update()
        for source, pieces in self._samples.items():
            if pieces:
                rows = np.concatenate(pieces)
                self._devices[source].add(rows, self.host.timeline.raw_from_host(rows["host_time_ns"]))
                pieces.clear()

    def place(self, source: str, rows: StructArray, max_sigma_ns: float) -> tuple[BoolArray, Int64Array]:
        """Return which rows (n,) have a sufficiently accurate time, and GPS ns (n,), by device time and host time."""
        if source not in self._devices or not len(rows):
            return np.zeros(len(rows), np.bool_), np.zeros(len(rows), np.int64)
        quick = self._by_cells(source, rows, max_sigma_ns)
        if quick is not None:
            return np.ones(len(rows), np.bool_), quick
        gps_ns, sigma_ns = self.gps_from_device(source, rows["device_time_ns"], rows["host_time_ns"])
        return sigma_ns <= max_sigma_ns, gps_ns

    def gps_from_device(self, source: str, device_ns: Int64Array, host_ns: Int64Array) -> tuple[Int64Array, FloatArray]:
        """Return GPS ns (n,) and sigma ns (n,; inf: unknown) of device times (n,) that arrived at host times (n,)."""
        return self._devices[source].gps_from_device(device_ns, self.host.timeline.raw_from_host(host_ns))

    def _by_cells(self, source: str, rows: StructArray, max_sigma_ns: float) -> Int64Array | None:
        """Return GPS ns (n,), interpolated between edges of cells of device time; None if rows need single requests.

        The edges are converted for the earliest and for the latest arrival: if the answers differ, or are not all good,
        the clock changed in between.
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
        """Return the origin found for a device's stamps; None: not found or not searched."""
        return self._devices[source].stamps

    def refused(self, source: str) -> dict[str, int]:
        """Return counts of input that a device's clock refused, by reason."""
        return self._devices[source].status().refused


@dataclass(frozen=True, slots=True)
class HeadTime:
    """A scanner's own statements about time in a log.

    Attributes:
        messages: number of sentences or packets that it vouches for.
        trouble: why its time cannot be used, and the remedy; empty if it can, or if there is none.
    """

    messages: int = 0
    trouble: str = ""


@dataclass(frozen=True)
class FrozenClocks:
    """The host's clocks after processing a whole log; each stream adds its own devices' clocks.

    It can be pickled. A device's clock lies in the same packets as its returns, so it is not complete before those are
    read; a stream that reads a piece of a log also gets the packets around the piece.

    Attributes:
        host: the host's.
        stamps: origins of devices' stamps, by source, found from the whole log.
        heads: scanners' own statements about time, by source; only for those examined.
        remarks: lines for the user on the dates given to scanners, where a scanner is the clock.
    """

    host: HostClocks
    stamps: Mapping[str, Stamps] = field(default_factory=dict)
    heads: Mapping[str, HeadTime] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()

    def trouble(self, source: str | None) -> str:
        """Return why a scanner's own time cannot be used; empty if it can, or if there is none."""
        head = self.heads.get(source or "")
        return "" if head is None else head.trouble

    def for_stream(self) -> StreamClocks:
        """Return clocks for one stream over any piece of the log."""
        return StreamClocks(self.host, frozen=True, stamps=self.stamps)
