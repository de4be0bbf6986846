"""The legs of a flight: from the runway or the air to the first line, its lines, and the turns between them."""

from __future__ import annotations

import math

import numpy as np

from swath.sim.flight.envelope import CLIMB_MOST_S, SPEED_UP_MPS2, Envelope, Ground, refuse_far, speed_mps
from swath.sim.flight.route import Arc, Leg, Pose, Route, way_of_length
from swath.sim.flight.smoothing import SPLINE_REACH, STEP_S
from swath.sim.plan.errors import PlanError
from swath.sim.plan.tables import GroundStart, LineTable, Tables

BEFORE_S = 8.0  # flight before the first lead when the flight starts in the air

GEAR_M = 1.5  # the body's origin above the runway
TAXI_MPS = 8.0
TAXI_MPS2 = 1.0
RUN_MPS2 = 2.5
LIFT_OFF_SHARE = 0.8  # lift-off speed divided by the first line's speed
CLIMB_OUT_M = 100.0  # straight climb above the runway
RUNWAY_OFF_M = 10.0  # largest difference between the plan's runway height and the terrain


def route_of(tables: Tables, envelope: Envelope, ground_m: Ground) -> Route:
    """Return the route of the flight, before smoothing.

    Raises:
        PlanError: the aircraft cannot get from one line to the next, or from the runway to the first.
    """
    legs: list[Leg] = []
    if tables.ground is not None:
        legs += take_off(tables, tables.ground, envelope, ground_m)
    for i in range(len(tables.line)):
        lead = lines_legs(tables, i, envelope, before_s=0.0 if legs else BEFORE_S)
        if legs:
            legs += transit(legs[-1], lead[0], envelope, f"line[{i}].height_m")
        legs += lead
    return Route(legs)


def lines_legs(tables: Tables, index: int, envelope: Envelope, before_s: float) -> list[Leg]:
    """Return the legs of one line: lead, line and lead."""
    line = tables.line[index]
    speed, lead_s = speed_mps(tables.flight, line), tables.flight.lead_s
    start = _start_of(line)
    lead_m, before_m = lead_s * speed, before_s * speed
    straights = [
        (start.ahead(-lead_m - before_m), lead_m + before_m, -1),
        (start, math.dist(line.from_m, line.to_m), index),
        (_pose(line.to_m, start.course_rad), lead_m, -1),
    ]
    heights = line.height_m, line.height_m
    return [
        Leg.over((Arc(pose, length, 0.0),), (speed, speed), heights, number)
        for pose, length, number in straights
        if length > 0.0
    ]


def _start_of(line: LineTable) -> Pose:
    east_m, north_m = line.to_m[0] - line.from_m[0], line.to_m[1] - line.from_m[1]
    return _pose(line.from_m, math.atan2(east_m, north_m))


def _pose(point_m: list[float], course_rad: float) -> Pose:
    return Pose(point_m[0], point_m[1], course_rad)


def transit(before: Leg, behind: Leg, envelope: Envelope, key: str) -> list[Leg]:
    """Return the legs from the end of one leg to the start of another, both straight and level; empty if they meet.

    The way is as long as the change of speed and of height needs. A climb unloads the wings: the rate of climb limits
    how tightly the aircraft may turn, and the length of the turn sets the rate at which it must climb. The rate is
    therefore first guessed as zero, then as the rate that this way needs, then as the fastest.
    """
    speeds = before.speeds_mps[1], behind.speeds_mps[0]
    heights = before.heights_m[1], behind.heights_m[0]
    rise_m, fastest_mps = abs(heights[1] - heights[0]), envelope.climb_mps(min(speeds))
    _refuse_climb(key, rise_m, fastest_mps)
    wait_s = envelope.wait_s if rise_m else 0.0
    least_s = max(rise_m / fastest_mps + 2.0 * wait_s, abs(speeds[1] - speeds[0]) / SPEED_UP_MPS2)
    guess_mps = needed_mps = 0.0
    for _ in range(3):
        turning = envelope.turning(max(speeds), guess_mps)
        way = way_of_length(before.end, behind.way[0].start, turning, 0.5 * sum(speeds) * least_s)
        if not way:
            return []
        leg = Leg.over(way, speeds, heights)
        needed_mps = rise_m / (leg.duration_s - 2.0 * wait_s)
        if needed_mps <= guess_mps:
            break
        guess_mps = fastest_mps if guess_mps else needed_mps
    return [Leg(leg.way, leg.duration_s, speeds, heights, wait_s)]


def _refuse_climb(key: str, rise_m: float, climb_mps: float) -> None:
    if rise_m > CLIMB_MOST_S * climb_mps:
        raise PlanError(
            key,
            f"{rise_m:.0f} m of climb to this line takes {rise_m / climb_mps / 60.0:.0f} min at {climb_mps:g} m/s; "
            f"plan at most {CLIMB_MOST_S * climb_mps:.0f} m, or a larger flight.climb_max_mps",
        )


def take_off(tables: Tables, start: GroundStart, envelope: Envelope, ground_m: Ground) -> list[Leg]:
    """Return the legs of a start on the ground, from standing still to level flight at the first line's speed.

    The aircraft stands, taxis, makes its take-off run and climbs straight on.

    Raises:
        PlanError: the runway is not on the site's ground.
    """
    refuse_far("ground.runway_m", start.runway_m)
    height_m = _runway_height_m(start, ground_m) + GEAR_M
    cruise_mps = speed_mps(tables.flight, tables.line[0])
    lift_off_mps, climb_mps = LIFT_OFF_SHARE * cruise_mps, envelope.climb_mps(LIFT_OFF_SHARE * cruise_mps)
    taxi_mps = min(TAXI_MPS, lift_off_mps, math.sqrt(2.0 * TAXI_MPS2 * start.taxi_m))
    rolling_m = taxi_mps**2 / (2.0 * TAXI_MPS2)
    climb_s = max(CLIMB_OUT_M / climb_mps, (cruise_mps - lift_off_mps) / SPEED_UP_MPS2)
    on_ground, out = (height_m, height_m), height_m + climb_mps * climb_s
    steps = [  # length, speed at its end, heights
        (rolling_m, taxi_mps, on_ground),
        (start.taxi_m - rolling_m, taxi_mps, on_ground),
        ((lift_off_mps**2 - taxi_mps**2) / (2.0 * RUN_MPS2), lift_off_mps, on_ground),
        (0.5 * (lift_off_mps + cruise_mps) * climb_s, cruise_mps, (height_m, out)),
        (cruise_mps * (envelope.climb_smoothing_s + envelope.smoothing_s), cruise_mps, (out, out)),
    ]
    pose = _pose(start.runway_m, math.radians(start.heading_deg)).ahead(-start.taxi_m)
    still_s = start.static_s + envelope.climb_smoothing_s + (SPLINE_REACH + 1) * STEP_S
    legs = [Leg((Arc(pose, 0.0, 0.0),), still_s, (0.0, 0.0), on_ground, airborne=False)]
    for length, speed, heights in steps:
        if length > 0.0:
            speeds = legs[-1].speeds_mps[1], speed
            leg = Leg.over((Arc(legs[-1].end, length, 0.0),), speeds, heights)
            legs.append(Leg(leg.way, leg.duration_s, speeds, heights, airborne=heights != on_ground))
    return legs


def _runway_height_m(start: GroundStart, ground_m: Ground) -> float:
    terrain_m = float(ground_m(np.array([start.runway_m[0]]), np.array([start.runway_m[1]]))[0])
    if start.height_m is None:
        return terrain_m
    if abs(start.height_m - terrain_m) > RUNWAY_OFF_M:
        raise PlanError(
            "ground.height_m",
            f"{start.height_m:g} m differs from the terrain's height, {terrain_m:.1f} m; give a height within "
            f"{RUNWAY_OFF_M:g} m of it",
        )
    return start.height_m
