"""Simulates an oscillator, receiver and wire: PPS edges and time messages as a host sees them, and the truth.

It shares no code with swath.georef.timescales: it counts seconds with the standard library's calendar, and integrates
the frequency of the host's clock. One seed determines everything random.

The oscillator has a constant 23 ppm, a random walk of frequency (2e-9 per √s by default), and on request temperature
ramps of ± 0.5 ppm/min that last 1 to 5 min, with 1 to 7 min between them.

The edges have stamps with normal noise; some are outliers 300 µs (normal) off, some are missing, and some are spurious
and anywhere in the second.

The messages have a delay with jitter, and some stall for up to 1.5 s. They stay in order, so a stalled one holds back
the next.
"""

from __future__ import annotations

import bisect
import datetime as dt
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from swath.georef.arrays import FloatArray
from swath.georef.records import NamesEdge, TimeMessage, TimeScale, TimeTag

NS = 1_000_000_000
HOST_START_NS = 7_123_456_789_012
EPOCH = dt.datetime(1980, 1, 6, tzinfo=dt.UTC)


def gps_second(moment: dt.datetime, leap: int) -> int:
    """Return the GPS second of a UTC moment."""
    return int((moment - EPOCH).total_seconds()) + leap


@dataclass
class Oscillator:
    """The host's clock: host time at every true second, interpolated linearly in between."""

    seconds: int
    seed: int = 0
    drift_ppm: float = 23.0
    wander: float = 2e-9
    ramps: bool = False

    def host_seconds(self) -> FloatArray:
        """Return (seconds + 1,) host ns since the start at true seconds 0, 1, …"""
        random = np.random.default_rng(self.seed)
        frequency = self.drift_ppm * 1e3 + np.cumsum(random.normal(0.0, self.wander * NS, self.seconds))
        if self.ramps:
            frequency = frequency + np.cumsum(self._ramp_rates(random))
        phase = np.concatenate(([0.0], np.cumsum(frequency)))
        return np.asarray(phase + np.arange(self.seconds + 1) * float(NS), dtype=np.float64)

    def _ramp_rates(self, random: np.random.Generator) -> FloatArray:
        rates = np.zeros(self.seconds)
        at = 0
        while at < self.seconds:
            calm, length = int(random.uniform(60, 420)), int(random.uniform(60, 300))
            rates[at + calm : at + calm + length] = random.choice([-1.0, 1.0]) * 500.0 / 60.0
            at += calm + length
        return rates


@dataclass
class Edges:
    """How the simulated host sees the PPS edges.

    `late_s` delays all edges, as inverted polarity does, which marks the other end of the pulse.
    """

    noise_ns: float = 1500.0
    outliers: float = 0.01
    missing: float = 0.02
    spurious: float = 0.01
    late_s: Callable[[int], float] = lambda second: 0.0
    silent: Callable[[int], bool] = lambda second: False


@dataclass
class Sender:
    """One kind of message of one source, sent once a second.

    `error_s` gives by how many seconds its clock is off at a true second; `tag_of` gives its time tag of a GPS second,
    or None if the message has no time tag.
    """

    name: str
    tag_of: Callable[[int], TimeTag | None]
    source: str = "gnss/rover"
    delay_s: float = 0.2
    jitter_s: float = 0.01
    stalls: float = 0.0
    names_edge: NamesEdge = NamesEdge.PREVIOUS
    bound: bool = False
    valid: Callable[[int], bool] = lambda second: True
    silent: Callable[[int], bool] = lambda second: False
    error_s: Callable[[int], int] = lambda second: 0


@dataclass
class Simulation:
    """One run: iterate over it for its edges and messages in order of host time."""

    start_gps_s: int
    oscillator: Oscillator
    edges: Edges = field(default_factory=Edges)
    senders: list[Sender] = field(default_factory=list)
    seed: int = 1

    def __post_init__(self) -> None:
        self._host: list[float] = self.oscillator.host_seconds().tolist()

    @property
    def seconds(self) -> int:
        """Length of the run."""
        return self.oscillator.seconds

    def host_ns(self, true_s: float) -> int:
        """Return the host time at a true second since the start."""
        whole = min(int(true_s), self.seconds - 1)
        part = true_s - whole
        return HOST_START_NS + round(self._host[whole] * (1.0 - part) + self._host[whole + 1] * part)

    def true_gps_ns(self, host_ns: int) -> int:
        """Return the true GPS time of a host time."""
        since = float(host_ns - HOST_START_NS)
        whole = min(max(bisect.bisect_right(self._host, since) - 1, 0), self.seconds - 1)
        part = (since - self._host[whole]) / (self._host[whole + 1] - self._host[whole])
        return (self.start_gps_s + whole) * NS + round(part * NS)

    def __iter__(self) -> Iterator[tuple[int, str, str, TimeMessage | None]]:
        """Yield (host ns, "edge" or "message", source, message) in order of host time."""
        found: list[tuple[int, str, str, TimeMessage | None]] = []
        random = np.random.default_rng(self.seed)
        arrivals = {id(sender): 0 for sender in self.senders}
        for second in range(self.seconds - 2):
            self._edges_of(second, random, found)
            for sender in self.senders:
                event = self._message_of(sender, second, random, arrivals)
                if event is not None:
                    found.append(event)
            if second % 64 == 63:
                yield from self._due(found, self.host_ns(second - 3))
        yield from sorted(found, key=lambda event: event[0])

    @staticmethod
    def _due(
        found: list[tuple[int, str, str, TimeMessage | None]], until_ns: int
    ) -> list[tuple[int, str, str, TimeMessage | None]]:
        found.sort(key=lambda event: event[0])
        count = sum(1 for event in found if event[0] <= until_ns)
        due = found[:count]
        del found[:count]
        return due

    def _edges_of(
        self, second: int, random: np.random.Generator, found: list[tuple[int, str, str, TimeMessage | None]]
    ) -> None:
        draw, noise, place = random.random(3), random.normal(0.0, 1.0), random.random()
        if self.edges.silent(second):
            return
        if draw[0] >= self.edges.missing:
            scale = 300e3 if draw[1] < self.edges.outliers else self.edges.noise_ns
            found.append(
                (self.host_ns(second + self.edges.late_s(second)) + round(noise * scale), "edge", "pps/main", None)
            )
        if draw[2] < self.edges.spurious:
            found.append((self.host_ns(second + place), "edge", "pps/main", None))

    def _message_of(
        self, sender: Sender, second: int, random: np.random.Generator, arrivals: dict[int, int]
    ) -> tuple[int, str, str, TimeMessage | None] | None:
        draw, stall, jitter = random.random(), random.random(), random.normal(0.0, 1.0)
        if sender.silent(second):
            return None
        delay = max(0.005, sender.delay_s + sender.jitter_s * jitter)
        if draw < sender.stalls:
            delay = delay + stall * max(0.0, 1.5 - delay)
        arrival = max(self.host_ns(second + delay), arrivals[id(sender)] + 1_000_000)
        arrivals[id(sender)] = arrival
        named = self.start_gps_s + second + sender.error_s(second) + (sender.names_edge is NamesEdge.NEXT)
        tag = sender.tag_of(named)
        if tag is None:
            return None
        message = TimeMessage(arrival, tag, sender.names_edge, sender.bound, sender.valid(second), message=sender.name)
        return arrival, "message", sender.source, message


def week_tag(modulus: int | None = None, leap: int | None = None) -> Callable[[int], TimeTag]:
    """Return a function that tags GPS seconds with week and time of week.

    With `modulus`, the week number has rolled over; 1024 is what old firmware sends.
    """

    def tag(second: int) -> TimeTag:
        week = second // 604_800
        return TimeTag(TimeScale.GPS, second % 604_800 * NS, week % modulus if modulus else week, None, leap)

    return tag


def utc_tag(
    leap: int, leap_event_s: int | None = None, *, said: bool = False, dated: bool = True
) -> Callable[[int], TimeTag]:
    """Return a function that tags GPS seconds with UTC date and time of day.

    `leap_event_s` is the GPS second that is 23:59:60; afterwards the number of leap seconds is larger by one.
    """

    def tag(second: int) -> TimeTag:
        count = leap if leap_event_s is None or second <= leap_event_s else leap + 1
        in_leap = second == leap_event_s
        moment = EPOCH + dt.timedelta(seconds=second - count - in_leap)
        of_day = moment.hour * 3600 + moment.minute * 60 + moment.second + in_leap
        date = moment.date() if dated else None
        return TimeTag(TimeScale.UTC, of_day * NS, None, date, count if said else None)

    return tag
