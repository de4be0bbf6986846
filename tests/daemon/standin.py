"""Stands in for a flight: four devices whose units come from the drivers' encoders."""

from __future__ import annotations

import heapq
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from swath.daemon.config import Config, load_config
from swath.daemon.errors import ExitCode, UserError
from swath.drivers.gnss.novatel.encoder import encode_log
from swath.drivers.gnss.novatel.layouts import Time
from swath.drivers.imu.dbc.encoder import encode_samples
from swath.drivers.imu.dbc.settings import map_signals
from swath.drivers.scanner.srep.layout import FLAG_LASER_ON, FLAG_PPS_LOCKED, SrepHeader, encode_datagram

AIRCRAFT = Path(__file__).parents[2] / "fixtures/config/aircraft.toml"
WEEK, MONDAY_S = 2423, 86_400 + 9 * 3600 + 18  # 2026-06-15T09:00:00Z in GPS time
START_NS = 1_781_514_000 * 1_000_000_000  # the same as Unix time
PPM, OFFSET_NS = -12.0, 20_000_000
NOT_FLOWN = ("corrections/base", "raw/radar")  # the simulation has no base station and no radar
SOURCES = ("gnss/rover", "imu/main", "pps/main", "scanner/left", "scanner/left/aux")
LATE_S = 3e-5  # delay of a stamp
TICKS = 10_000_000  # of the scanner's counter per second


@dataclass(frozen=True)
class Unit:
    """A unit of a source."""

    time_s: float
    source: str
    data: bytes


@dataclass(frozen=True)
class Clock:
    """A host whose oscillator is slow and whose wall clock is ahead, and stepped."""

    steps: tuple[tuple[float, float], ...] = ()

    def host_ns(self, time_s: float) -> int:
        return START_NS + OFFSET_NS + round(time_s * (1e9 + 1e3 * PPM))

    def monotonic_ns(self, time_s: float) -> int:
        return self.host_ns(time_s) - START_NS

    def realtime_ns(self, time_s: float) -> int:
        return self.host_ns(time_s) + sum(round(1e9 * step_s) for at_s, step_s in self.steps if at_s <= time_s)


class Standin:
    """A flight of so many seconds.

    Args:
        pulled: (source, from, to) when nothing comes and the wire is unplugged.
        silent: the same, but the wire stays plugged in.
    """

    sources = SOURCES

    def __init__(
        self,
        duration_s: float,
        wall_steps: tuple[tuple[float, float], ...] = (),
        pulled: tuple[tuple[str, float, float], ...] = (),
        silent: tuple[tuple[str, float, float], ...] = (),
    ) -> None:
        self.duration_s = duration_s
        self.wall_steps = wall_steps
        self.unplugged = pulled
        self.host_clock = Clock(wall_steps)
        self.returns = 0
        self.truth_finished = False
        self._quiet = pulled + silent

    def units(self) -> Iterator[Unit]:
        """Yield the units in time order."""
        streams = (self._edges(), self._receiver(), self._frames(), self._datagrams(), self._positions())
        for unit in heapq.merge(*streams, key=lambda unit: unit.time_s):
            if not any(unit.source == source and start <= unit.time_s < end for source, start, end in self._quiet):
                yield unit

    def finish_truth(self) -> None:
        self.truth_finished = True

    def _edges(self) -> Iterator[Unit]:
        for second in range(int(self.duration_s)):
            yield Unit(second + 1e-6, "pps/main", b"")

    def _receiver(self) -> Iterator[Unit]:
        """Yield TIME messages, which name the previous edge, cut into two reads."""
        for second in range(int(self.duration_s)):
            body = Time(0, 0.0, 1e-9, -18.0, 2026, 6, 15, 9, second // 60, 1000 * (second % 60), 1)
            frame = encode_log("TIME", body, WEEK, 1000 * (MONDAY_S + second))
            yield Unit(second + 0.10, "gnss/rover", frame[:40])
            yield Unit(second + 0.11, "gnss/rover", frame[40:])

    def _frames(self) -> Iterator[Unit]:
        (settings,) = [one.settings for one in load_config(AIRCRAFT).devices() if one.source == "imu/main"]
        number = np.arange(round(100 * self.duration_s), dtype=np.int64)
        ticks, still = 10_000 * number, np.zeros((len(number), 3))
        frames = encode_samples(map_signals(settings), ticks, still, still, packet_counter=number % 256)
        each = len(frames) // len(ticks)
        for place, frame in enumerate(frames):
            yield Unit(0.01 * (place // each + 1) + 1e-4 * (place % each), "imu/main", frame.tobytes())

    def _datagrams(self) -> Iterator[Unit]:
        """Yield a datagram of twenty pulses each hundredth of a second, with two returns each."""
        for number in range(round(100 * self.duration_s)):
            first = TICKS // 100 * number
            second = first // TICKS
            header = SrepHeader(number, 7, FLAG_LASER_ON | FLAG_PPS_LOCKED, 0, second, TICKS, second * TICKS, first)
            ticks = np.arange(20) * 5000
            data = encode_datagram(header, ticks, 10 * ticks, np.full((20, 2), 5_000_000))
            self.returns += 40
            yield Unit(0.01 * (number + 1) + LATE_S, "scanner/left", data)

    def _positions(self) -> Iterator[Unit]:
        for second in range(int(self.duration_s)):
            yield Unit(second + 0.5, "scanner/left/aux", bytes([second % 256]) * 30)


def make_standin(*arguments: object) -> tuple[Standin, dict[str, bytes]]:
    """Return the stand-in flight and its files, for a process of its own."""
    return Standin(*arguments), {"README.md": b"none"}  # type: ignore[arg-type]


def standin_for(request: object) -> tuple[Standin, dict[str, bytes]]:
    """Replace `swath.daemon.simulate.plans.make_flight_in_time` by a stand-in of one second."""
    return Standin(1.0), {}


def stepping_for(request: object) -> tuple[Standin, dict[str, bytes]]:
    """Return the same stand-in with a wall clock step."""
    return Standin(1.0, ((1.0, 60.0),)), {}


def refuse() -> tuple[Standin, dict[str, bytes]]:
    """Raise the error of a plan that cannot be flown."""
    raise UserError("it cannot be flown", ExitCode.USAGE)


def stumble() -> tuple[Standin, dict[str, bytes]]:
    """Raise an unforeseen error."""
    raise ZeroDivisionError


def vanish() -> tuple[Standin, dict[str, bytes]]:
    """End the process."""
    sys.exit(9)


def aircraft_config(folder: Path, changes: dict[str, str] | None = None) -> Config:
    """Write the fixtures' configuration with its files to a folder, and load it."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("imu.dbc", "left.toml"):
        (folder / name).write_bytes((AIRCRAFT.parent / name).read_bytes())
    text = AIRCRAFT.read_text()
    for before, after in (changes or {}).items():
        assert before in text
        text = text.replace(before, after)
    (folder / "swath.toml").write_text(text)
    return load_config(folder / "swath.toml")
