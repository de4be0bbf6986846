"""The aircraft's limits, from the keys of ``[flight]``, and checks that refuse lines beyond them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from swath.georef.arrays import FloatArray
from swath.sim.flight.route import Turning
from swath.sim.flight.smoothing import PEAK, SPLINE_REACH, STEP_S
from swath.sim.plan.errors import PlanError
from swath.sim.plan.tables import FlightTable, LineTable, Tables

Ground = Callable[[FloatArray, FloatArray], FloatArray]

GRAVITY_MPS2 = 9.80665
ROLL_RATE_RADPS = math.radians(12.0)
PULL_UP_MPS2 = 1.5  # vertical acceleration into a climb and out of it
SPEED_UP_MPS2 = 1.0  # acceleration in the air
STEEPEST = 0.35  # rate of climb divided by speed
SMOOTHING_LEAST_S = 1.0

RADIUS_MOST_M = 20_000.0
DISTANCE_MOST_M = 100_000.0  # largest distance of anything from the origin
LINE_LEAST_S = 1.0
CLEARANCE_M = 15.0
CLIMB_MOST_S = 1800.0
_GROUND_STEP_M = 5.0
_MARGIN = 0.97  # crabbing and accelerating with the nose up take a little of the lift


@dataclass(frozen=True, slots=True)
class Envelope:
    """Limits of the aircraft.

    Attributes:
        flight: the plan's table.
        smoothing_s: half the time that a turn takes to begin.
        climb_smoothing_s: half the time that a climb takes to begin.
    """

    flight: FlightTable
    smoothing_s: float
    climb_smoothing_s: float

    @classmethod
    def of(cls, tables: Tables) -> Envelope:
        """Derive the limits from a plan's tables.

        Raises:
            PlanError: the leads are too short to roll into a turn, or the wind is too strong.
        """
        flight = tables.flight
        refuse_wind(tables)
        if len(tables.line) == 1 and tables.ground is None:
            return cls(flight, 0.0, 0.0)
        roll_s = math.tan(math.radians(flight.bank_max_deg)) * PEAK / ROLL_RATE_RADPS
        room_s = flight.lead_s - SPLINE_REACH * STEP_S
        least_s = max(roll_s, SMOOTHING_LEAST_S)
        if room_s < least_s:
            least_lead_s = math.ceil(10.0 * (least_s + SPLINE_REACH * STEP_S)) / 10.0
            raise PlanError(
                "flight.lead_s",
                f"{flight.lead_s:g} s is too short to roll out of a bank of {flight.bank_max_deg:g}° at "
                f"{math.degrees(ROLL_RATE_RADPS):.0f}°/s; set at least {least_lead_s:g} s",
            )
        smoothing_s = min(room_s, max(2.0 * roll_s, SMOOTHING_LEAST_S))
        return cls(flight, smoothing_s, max(smoothing_s, flight.climb_max_mps * PEAK / PULL_UP_MPS2))

    @property
    def wait_s(self) -> float:
        """Level flight before and after a change of height, so that its smoothing ends with that of the turn."""
        return self.climb_smoothing_s - self.smoothing_s

    def climb_mps(self, speed_mps: float) -> float:
        """Return the fastest climb at this speed."""
        return min(self.flight.climb_max_mps, STEEPEST * speed_mps)

    def turning(self, speed_mps: float, climb_mps: float) -> Turning:
        """Return how tightly the aircraft can turn at this speed while it climbs at this rate.

        The wings' lift across the path carries the turn: v² / R = tan(bank) · lift. The lift is g less the acceleration
        that leads into the climb.

        Raises:
            PlanError: the plan's radius is tighter than that, or the bank allows no turn of reasonable size.
        """
        flight, speed_squared = self.flight, speed_mps**2
        pitch = math.radians(abs(flight.pitch_deg)) + math.atan2(climb_mps, speed_mps)
        unloading_mps2 = climb_mps * PEAK / self.climb_smoothing_s
        lift_mps2 = _MARGIN * math.cos(pitch) * (GRAVITY_MPS2 - unloading_mps2)
        tightest_m = speed_squared / (lift_mps2 * math.tan(math.radians(flight.bank_max_deg)))
        radius_m = tightest_m if flight.turn_radius_m is None else flight.turn_radius_m
        bank = f"flight.bank_max_deg of {flight.bank_max_deg:g}° at {speed_mps:g} m/s"
        if radius_m < tightest_m:
            raise PlanError(
                "flight.turn_radius_m", f"{radius_m:g} m is tighter than {bank} allows; set {tightest_m:.0f} m or more"
            )
        if radius_m > RADIUS_MOST_M:
            key = "flight.bank_max_deg" if flight.turn_radius_m is None else "flight.turn_radius_m"
            raise PlanError(
                key, f"turns of {1e-3 * radius_m:.0f} km radius; set a bank and a speed that keep it below 20 km"
            )
        reversal = ROLL_RATE_RADPS * self.smoothing_s / (2.0 * PEAK)  # tan of the bank that it can roll through twice
        return Turning(
            radius_m, max(radius_m, speed_squared / (lift_mps2 * reversal)), 2.0 * self.smoothing_s * speed_mps
        )


def speed_mps(flight: FlightTable, line: LineTable) -> float:
    """Return the speed of a line over the ground."""
    return flight.speed_mps if line.speed_mps is None else line.speed_mps


def refuse_wind(tables: Tables) -> None:
    """Refuse a wind above half the speed of the slowest line with `PlanError`."""
    wind_mps = math.hypot(*tables.flight.wind_mps)
    slowest_mps = min(speed_mps(tables.flight, line) for line in tables.line)
    if wind_mps > 0.5 * slowest_mps:
        raise PlanError(
            "flight.wind_mps",
            f"{wind_mps:.1f} m/s is more than half the speed of the slowest line, {slowest_mps:g} m/s; set less",
        )


def refuse_far(key: str, point_m: list[float]) -> None:
    """Refuse a point that is not on the site with `PlanError`."""
    distance_m = math.hypot(*point_m)
    if distance_m > DISTANCE_MOST_M:
        raise PlanError(
            key,
            f"{1e-3 * distance_m:.0f} km from flight.origin_deg; give metres east and north of it, at most "
            f"{1e-3 * DISTANCE_MOST_M:.0f} km away",
        )


def refuse_lines(tables: Tables, ground_m: Ground) -> None:
    """Refuse the first line that cannot be flown even alone with `PlanError`."""
    names: dict[str, int] = {}
    for i, line in enumerate(tables.line):
        key = f"line[{i}]"
        if line.name in names:
            raise PlanError(
                f"{key}.name", f"{line.name!r} is also the name of line[{names[line.name]}]; choose another"
            )
        names[line.name] = i
        refuse_far(f"{key}.from_m", line.from_m)
        refuse_far(f"{key}.to_m", line.to_m)
        length_m = math.dist(line.from_m, line.to_m)
        least_m = LINE_LEAST_S * speed_mps(tables.flight, line)
        if length_m < least_m:
            raise PlanError(
                f"{key}.to_m",
                f"a line of {length_m:.1f} m; make it at least {least_m:.0f} m long, one second of flight",
            )
        _refuse_low(f"{key}.height_m", line, length_m, ground_m)


def _refuse_low(key: str, line: LineTable, length_m: float, ground_m: Ground) -> None:
    share = np.linspace(0.0, 1.0, 1 + math.ceil(length_m / _GROUND_STEP_M))
    east_m = line.from_m[0] + share * (line.to_m[0] - line.from_m[0])
    north_m = line.from_m[1] + share * (line.to_m[1] - line.from_m[1])
    terrain_m = ground_m(east_m, north_m)
    worst = int(np.argmax(terrain_m))
    above_m = line.height_m - float(terrain_m[worst])
    if above_m < CLEARANCE_M:
        where = f"{share[worst] * length_m:.0f} m from its start (east {east_m[worst]:.0f}, north {north_m[worst]:.0f})"
        what = f"{-above_m:.1f} m below" if above_m < 0.0 else f"only {above_m:.1f} m above"
        want_m = math.ceil(terrain_m[worst] + CLEARANCE_M)
        raise PlanError(key, f"{line.height_m:g} m is {what} the terrain {where}; plan at least {want_m} m")
