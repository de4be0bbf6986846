"""A head that draws a rosette with two prisms and reports x, y and z: a Livox Mid-360's packets with another pattern.

The pattern is that of two thin prisms, whose deflections add: with the angles a and b of the prisms about x the ray is
(1, r (cos a + cos b), r (sin a + sin b)), 2 r = tan of half the field of view. Frame and packets are the maker's: x
forward, y left, z up; Livox LiDAR Communication Protocol - Mid360, Point Cloud & IMU Data Protocol. With a pulse wired
to it, the head stamps UTC, as GPRMC gives it; without one, nanoseconds since power-on.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from swath.drivers.scanner.livox.layout import GPS_2, NO_SYNC, POINTS_2, encode_packet_2
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.sim.clocks import Oscillator, PulsePerSecond, generator
from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import Plan
from swath.sim.plan.tables import ScannerTable
from swath.sim.scanners.ranging import gauss
from swath.sim.scanners.spinning_wire import (
    PPS_LOCKED,
    Arrivals,
    HeadClock,
    PacketCutter,
    Windows,
    best_slot,
    head_config,
    in_slot,
)
from swath.sim.shots import Measured, Pulses, WireUnit
from swath.sim.truth import RETURN_TRUTH_DTYPE

HEAD_HZ = 1_000_000_000
PULSES = 96  # of a packet
LINES = 4  # lasers that fire in turn
CARTESIAN = 1  # type of the points
LONGEST_SPAN_NS = 65_535 * 100
GPS_EPOCH_UNIX_S = 315_964_800
NOT_OF_ROSETTES = (
    *("scan_angle_offset_deg", "scan_angle_scale_ppm", "scan_plane_tilt_deg"),
    *("encoder_latency_us", "torsion_us2", "pitch_slope_ppm"),
)


class RosetteHead:
    """The pulses of the head, which follow its own oscillator; it also turns the prisms.

    Args:
        table: of the plan.
        name: of the scanner.

    Raises:
        PlanError: the plan asks for a pulse rate or errors that such a head does not have.
    """

    def __init__(self, table: ScannerTable, name: str) -> None:
        least_hz = (PULSES - 1) * HEAD_HZ / LONGEST_SPAN_NS
        if table.prf_hz < least_hz:
            text = f"got {table.prf_hz:g}, want at least {math.ceil(least_hz)} for the packets of a rosette"
            raise PlanError(f"scanner.{name}.prf_hz", text)
        for key in NOT_OF_ROSETTES:
            if getattr(table.true, key) != 0.0:
                text = f"got {getattr(table.true, key):g}, want 0: a head that reports x, y and z has no such error"
                raise PlanError(f"scanner.{name}.true.{key}", text)
        self._oscillator = Oscillator(HEAD_HZ, table.oscillator)
        self._spacing_ns = HEAD_HZ / table.prf_hz
        self._turns_per_ns = table.scan_hz / HEAD_HZ
        self._ratio, self._radius = table.prism_ratio, 0.5 * math.tan(math.radians(table.half_angle_deg))

    def pulses(self, start_s: float, stop_s: float) -> Pulses:
        """Return every pulse with start_s <= time_s < stop_s, in order."""
        phase = self._oscillator.phase(np.array([start_s, stop_s]))
        first, last = np.floor(phase / self._spacing_ns).astype(np.int64)
        number = np.arange(max(first - 1, 0), max(last + 2, 0))
        head_ns = self._spacing_ns * number.astype(np.float64)
        time_s = self._oscillator.time_of(head_ns)
        there = (time_s >= start_s) & (time_s < stop_s)
        number, time_s, head_ns = number[there], time_s[there], head_ns[there]
        return Pulses(
            number=number,
            time_s=time_s,
            encoder=np.zeros(len(number), np.int64),
            channel=(number % PULSES % LINES).astype(np.uint16),
            origin_s=np.zeros((len(number), 3)),
            direction_s=self._directions(2 * np.pi * np.mod(self._turns_per_ns * head_ns, 1e6)),
            phi_extra_rad=np.zeros(len(number)),
        )

    def _directions(self, first_rad: FloatArray) -> FloatArray:
        """Return (n, 3) directions from the angles of the first prism, not reduced to one turn."""
        second_rad = self._ratio * first_rad
        left = self._radius * (np.cos(first_rad) + np.cos(second_rad))
        up = self._radius * (np.sin(first_rad) + np.sin(second_rad))
        ray = np.stack([np.ones_like(left), left, up], axis=1)
        directions: FloatArray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
        return directions


class RosetteWire:
    """Makes the packets of one head, with the strongest return of each pulse.

    Args:
        plan: of the flight.
        name: of the scanner.
        pps: pulse wired to it; None: no pulse is wired.
        lost_pps: (from, to) in which the head gets no pulse.
    """

    def __init__(self, plan: Plan, name: str, pps: PulsePerSecond | None, lost_pps: Windows = ()) -> None:
        table, flight = plan.tables.scanner[name], plan.tables.flight
        self._source = f"scanner/{name}"
        second = plan.start_gps_ns // HEAD_HZ - plan.leap_seconds + GPS_EPOCH_UNIX_S
        offset_s = 1e-6 * table.true.time_offset_us
        self._clock = HeadClock(HEAD_HZ, table.oscillator, pps, lost_pps, offset_s, second)
        self._free = HeadClock(HEAD_HZ, table.oscillator, None, (), offset_s, None)
        self._sigma_rad = math.radians(table.direction_sigma_deg) if flight.noise else 0.0
        self._key = generator(flight.seed, "direction", name).integers(2**64, dtype=np.uint64)
        self._cutter = PacketCutter(PULSES)
        self._arrivals = Arrivals(plan, self._source)

    def units(self, pulses: Pulses, measured: Measured, truth: StructArray) -> tuple[list[WireUnit], StructArray]:
        """Return the packets that are complete, and the truth of their returns.

        Args:
            pulses: of `RosetteHead`, consecutive.
            measured: of the pulses, (n, R).
            truth: `RETURN_TRUTH_DTYPE` (n, R), same slots.
        """
        columns = [pulses.number, pulses.time_s, pulses.direction_s, measured.range_m, measured.intensity, truth]
        number, time_s, direction_s, range_m, light, truth = self._cutter.take(columns)
        if not len(number):
            return [], np.empty(0, RETURN_TRUTH_DTYPE)
        slot = best_slot(np.where(range_m > 0.0, light, -1).astype(np.int64))
        pulse = np.arange(len(number))
        reported_m = np.where(slot >= 0, range_m[pulse, slot], 0.0)
        xyz_mm = np.rint(1e3 * reported_m[:, np.newaxis] * self._reported(number, direction_s)).astype(np.int64)
        points = np.zeros(len(number), dtype=POINTS_2[CARTESIAN].dtype)
        for axis, key in enumerate("xyz"):
            points[key] = xyz_mm[:, axis]
        points["reflectivity"] = np.clip(np.rint(in_slot(light.astype(np.int64), slot)), 0, 255)
        there = (slot >= 0) & xyz_mm.any(axis=1)
        rows = truth[there, slot[there]]
        rows["return_number"] = 1
        return self._packets(number, time_s, points), rows

    def idle(self, start_s: float, stop_s: float) -> list[WireUnit]:
        """Return an empty list; a head that does not fire sends nothing."""
        return []

    def close(self) -> tuple[list[WireUnit], StructArray]:
        """Return no packets; a packet that is not full is not sent."""
        return [], np.empty(0, RETURN_TRUTH_DTYPE)

    def _reported(self, number: Int64Array, direction_s: FloatArray) -> FloatArray:
        """Return directions (n, 3) with the errors of the two angles that the head measures."""
        if self._sigma_rad == 0.0:
            return direction_s
        azimuth = np.arctan2(direction_s[:, 1], direction_s[:, 0]) + self._sigma_rad * gauss(self._key, number, 0)
        elevation = np.arcsin(direction_s[:, 2]) + self._sigma_rad * gauss(self._key, number, 1)
        flat = np.cos(elevation)
        return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)

    def _packets(self, number: Int64Array, time_s: FloatArray, points: StructArray) -> list[WireUnit]:
        fired_s = time_s.reshape(-1, PULSES)
        ends = fired_s[:, [0, -1]].reshape(-1)
        locked = self._clock.status(fired_s[:, 0]) == PPS_LOCKED
        stamps = np.where(
            locked[:, np.newaxis], self._clock.ticks(ends).reshape(-1, 2), self._free.ticks(ends).reshape(-1, 2)
        )
        arrived_s = self._arrivals.times(fired_s[:, -1])
        table, counts = points.reshape(-1, PULSES), (number[::PULSES] // PULSES).tolist()
        units = []
        for at, (first_ns, last_ns) in enumerate(stamps.tolist()):
            data = encode_packet_2(
                CARTESIAN,
                GPS_2 if locked[at] else NO_SYNC,
                first_ns,
                table[at],
                span_100ns=round((last_ns - first_ns) / 100),
                count=counts[at],
            )
            units.append(WireUnit(arrived_s[at], self._source, data))
        return units


def config_table(table: ScannerTable, transport: str) -> dict[str, Any]:
    """Return ``[scanner.<name>]`` of the configuration that records this head.

    Args:
        table: of the plan.
        transport: URI at which its packets arrive.
    """
    config = head_config(table, transport, "livox-mid360")
    return config | ({"angle_sigma_deg": table.direction_sigma_deg} if table.direction_sigma_deg else {})
