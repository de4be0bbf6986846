"""Common parts of the wires of spinning heads: a clock set by PPS, packets cut out of pulses, the host's stamps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import FloatArray, Int64Array
from swath.sim.clocks import Oscillator, PulsePerSecond, generator
from swath.sim.plan.plan import Plan
from swath.sim.plan.tables import OscillatorTable, ScannerTable
from swath.sim.shots import Measured

Windows = Sequence[tuple[float, float]]

START_UP_S = 30  # from power-on to the plan's start, when a head already turns
PROCESSING_S = 100e-6  # from a packet's last firing to the host
PPS_ABSENT, PPS_SYNCHRONIZING, PPS_LOCKED = range(3)  # as Velodyne's table 9-4 numbers them


class HeadClock:
    """The counter that stamps a head's packets: the pulse sets it each second, else it runs free.

    Two pulses in a row lock it. While locked it shows the true time less ``time_offset``. After a missing pulse it
    continues from there by its oscillator; before any pulse has come it counts from power-on.

    Args:
        tick_hz: of the stamps.
        oscillator: of the head; its ``ticks_at_start`` are such ticks and are added to those of `START_UP_S`.
        pps: pulse wired to it; None: no pulse is wired.
        lost: (from, to) in which it gets no pulse; a window that begins at 0 has no pulse before it either.
        offset_s: time_offset.
        second: second shown at the plan's start while locked; None: it continues to count the seconds since power-on.
    """

    def __init__(
        self,
        tick_hz: int,
        oscillator: OscillatorTable,
        pps: PulsePerSecond | None,
        lost: Windows,
        offset_s: float,
        second: int | None,
    ) -> None:
        self._hz, self._oscillator = tick_hz, Oscillator(tick_hz, oscillator)
        self._pps, self._lost, self._offset_s = pps, tuple(lost), offset_s
        self._at_start = START_UP_S * tick_hz
        counted = START_UP_S + round(oscillator.ticks_at_start / tick_hz)
        self._second = counted if second is None else second
        self._status = np.zeros(0, np.int64)  # of second −1, 0, 1, …
        self._anchor = np.zeros(0, np.int64)  # latest second at which it was locked, −2 if it never was

    def ticks(self, time_s: FloatArray) -> Int64Array:
        """Return (n,) the clock's readings at true times (n,), in whole ticks."""
        time_s = np.asarray(time_s, np.float64)
        free = self._oscillator.ticks(time_s) + self._at_start
        if self._pps is None:
            return free
        status, anchor = self._of(self._pps, time_s)
        locked = status == PPS_LOCKED
        since_s = np.where(locked, 0.0, anchor + 1.0)  # the clock runs free from the first lost pulse on
        held = self._hz * (since_s - self._offset_s) + self._oscillator.phase(time_s) - self._oscillator.phase(since_s)
        shown = np.where(locked, self._hz * (time_s - self._offset_s), held)
        whole = np.floor(shown).astype(np.int64) + self._second * self._hz
        return np.where(locked | (anchor > -2), whole, free)

    def status(self, time_s: FloatArray) -> Int64Array:
        """Return (n,) the pulse's status at true times (n,): `PPS_ABSENT`, `PPS_SYNCHRONIZING` or `PPS_LOCKED`."""
        time_s = np.asarray(time_s, np.float64)
        return np.full(time_s.shape, PPS_ABSENT) if self._pps is None else self._of(self._pps, time_s)[0]

    def _of(self, pps: PulsePerSecond, time_s: FloatArray) -> tuple[Int64Array, Int64Array]:
        """Return status and anchor of the seconds in which times (n,) lie."""
        second = pps.latest(time_s)
        if len(second) and int(second.max()) + 2 > len(self._status):
            self._follow(pps, 2 * int(second.max()) + 64)
        return self._status[second + 1], self._anchor[second + 1]

    def _follow(self, pps: PulsePerSecond, seconds: int) -> None:
        """Compute status and anchor of every second up to this one."""
        edges = pps.edges(np.arange(seconds))
        came = np.ones(seconds + 2, np.bool_)  # of second −2, −1, 0, …
        for start_s, stop_s in self._lost:
            came[2:] &= (edges < start_s) | (edges >= stop_s)
            came[:2] &= start_s > 0.0
        self._status = np.where(came[1:], np.where(came[:-1], PPS_LOCKED, PPS_SYNCHRONIZING), PPS_ABSENT)
        seconds_from = np.arange(-1, seconds)
        self._anchor = np.maximum.accumulate(np.where(self._status == PPS_LOCKED, seconds_from, -2))


class PacketCutter:
    """Cuts the columns of consecutive pulses into whole packets; the remainder waits.

    Args:
        pulses: number of pulses of a packet; packets begin at whole multiples of it.
    """

    def __init__(self, pulses: int) -> None:
        self._pulses = pulses
        self._waiting: list[NDArray[Any]] | None = None

    def take(self, columns: list[NDArray[Any]]) -> list[NDArray[Any]]:
        """Return whole packets of columns (n, …), (k · pulses, …) each; the first column is the pulses' number."""
        number, waiting = columns[0], self._waiting
        if waiting is not None and len(number) and number[0] == waiting[0][0] + len(waiting[0]):
            columns = [np.concatenate(pair) for pair in zip(waiting, columns, strict=True)]
        elif waiting is not None and not len(number):
            columns = waiting
        number = columns[0]
        begin = int(-number[0] % self._pulses) if len(number) else 0
        end = begin + (max(len(number) - begin, 0) // self._pulses) * self._pulses
        # copies: a view would keep the whole block
        self._waiting = [column[end:].copy() for column in columns] if len(number) > end else None
        return [column[begin:end] for column in columns]


class Arrivals:
    """The times at which the host stamps the datagrams of one head: sending plus the network's jitter, in order.

    Args:
        plan: of the flight.
        source: of the head.
    """

    def __init__(self, plan: Plan, source: str) -> None:
        self._mean_s = 1e-6 * plan.tables.host.udp_jitter_us if plan.tables.flight.noise else 0.0
        self._rng = generator(plan.tables.flight.seed, "udp", source)
        self._latest_s = -np.inf

    def times(self, sent_s: FloatArray) -> list[float]:
        """Return (n,) stamps of datagrams in order, whose last firing was at ``sent_s`` (n,)."""
        jitter_s = self._rng.exponential(size=len(sent_s)) * self._mean_s
        arrived = np.maximum.accumulate(np.concatenate([[self._latest_s], sent_s + PROCESSING_S + jitter_s]))
        self._latest_s = float(arrived[-1])
        times_s: list[float] = arrived[1:].tolist()
        return times_s


def counts(measured: Measured, unit_m: float, most: int) -> tuple[Int64Array, Int64Array]:
    """Return ranges (n, R) in whole units and light 0 … 255.

    A range is 0 if there is no return or a packet cannot express it.
    """
    raw = np.rint(measured.range_m / unit_m)
    raw = np.where((raw >= 1) & (raw <= most), raw, 0)
    return raw.astype(np.int64), np.clip(np.rint(measured.intensity), 0, 255).astype(np.int64)


def best_slot(rank: Int64Array) -> Int64Array:
    """Return (n,) the slot of the greatest rank of each pulse, the first of equal ones; −1 if all ranks are −1."""
    return np.where(rank.max(axis=1) >= 0, rank.argmax(axis=1), -1)


def in_slot(values: Int64Array, slot: Int64Array) -> Int64Array:
    """Return (n,) the values (n, R) in these slots (n,); 0 where the slot is −1."""
    return np.where(slot >= 0, values[np.arange(len(values)), slot], 0)


def head_config(table: ScannerTable, transport: str, protocol: str) -> dict[str, Any]:
    """Return the part of ``[scanner.<name>]`` in the recording configuration that all spinning heads have."""
    nominal = table.nominal
    config = {
        "transport": transport,
        "protocol": protocol,
        "model": table.model,
        "serial": table.serial,
        "installation": table.installation,
        "lever_arm_m": [nominal.lever_arm_x_m, nominal.lever_arm_y_m, nominal.lever_arm_z_m],
        "range_min_m": table.range_min_m,
        "range_max_m": table.range_max_m,
        "divergence_mrad": table.divergence_mrad,
    }
    return config | ({"pps": table.pps} if table.pps is not None else {})
