"""Fly plans by the virtual aircraft's truth, ten times a second, with defects, for tests of the lines' states."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from swath.daemon.config.tables import PlanConfig
from swath.daemon.processing.flightplan.moments import STEP_NS, STEP_S, Moments, empty_moments
from swath.daemon.processing.flightplan.plan import FlightPlan
from swath.daemon.processing.flightplan.read import read_plan
from swath.daemon.processing.flightplan.strips import StripWatch
from swath.daemon.processing.flightplan.watch import LineWatch
from swath.georef.arrays import FloatArray, StructArray
from swath.sim.flight.trajectory import Trajectory, fly
from swath.sim.plan.plan import Plan, parse_plan
from swath.sim.site import Site

GROUND_M = 450.0
HALF_ANGLE_RAD = math.radians(30.0)
RETURNS = 10_000  # of a moment
HEIGHT_M = GROUND_M + 600.0
WIDTH_M = 2 * 600.0 * math.tan(HALF_ANGLE_RAD)
DENSITY = RETURNS * 10 / (WIDTH_M * 60.0)


@dataclass(frozen=True)
class Defect:
    """A defect of a line.

    Attributes:
        line: its name.
        kind: what is wrong, as in `KINDS`.
        share: where on the line, 0 … 1.
        size: how large, in the kind's own unit.
    """

    line: str
    kind: str
    share: float
    size: float


# what a defect must be called, and whether the line must be flown again for it
KINDS: dict[str, tuple[str, bool | None]] = {
    "off": ("cross_track", True),  # m beside the line
    "high": ("height", True),  # m above the line
    "fast": ("speed", True),  # m/s faster
    "bank": ("bank", True),  # degrees, for 3 s
    "tilt": ("bank", False),  # degrees between one and two limits, for 2 s
    "silent": ("laser_off", True),  # s
    "late": ("late_start", True),  # m
    "early": ("early_end", True),  # m
    "gnss": ("gnss", None),  # s; again from 30 s on
    "time": ("time", True),  # s without time
    "holdover": ("time", False),  # s
    "sparse": ("density", True),  # share of the returns, on a third of the line
    "lost": ("losses", False),  # units
    "water": ("no_returns", False),  # s
}


@dataclass
class Flight:
    """A plan, and the flight that was made of it."""

    plan: FlightPlan
    config: PlanConfig
    track: Trajectory
    names: list[str]
    defects: list[Defect] = field(default_factory=list)


def plan_text(lines: list[dict[str, Any]], **flight: Any) -> str:
    """Return a plan of `swath sim`."""
    head = {"name": "lines", "speed_mps": 60.0, "turbulence": "light"} | flight
    texts = ["[flight]", *(f"{key} = {_toml(value)}" for key, value in head.items())]
    for line in lines:
        texts += ["[[line]]", *(f"{key} = {_toml(value)}" for key, value in line.items())]
    return "\n".join([*texts, "[terrain]", f"height_m = {GROUND_M}", ""])


def _toml(value: Any) -> str:
    return f'"{value}"' if isinstance(value, str) else str(value)


def flown(
    lines: list[dict[str, Any]],
    defects: list[Defect],
    wanted: dict[str, Any],
    really: list[dict[str, Any]] | None = None,
    **flight: Any,
) -> Flight:
    """Plan lines, and fly them with those defects that move the aircraft.

    Args:
        lines: of the plan, as `swath sim` has them.
        defects: of lines.
        wanted: ``[plan.wanted]``.
        really: lines that are flown instead, with the names of planned ones.
        flight: further keys of ``[flight]``.
    """
    moved = [_moved(line, defects, flight.get("speed_mps", 60.0)) for line in really or lines]
    numbered = [line | {"name": f"leg-{number}"} for number, line in enumerate(moved)]
    config = PlanConfig.model_validate({"file": "p.toml", "wanted": wanted})
    plan = read_plan(config, {"p.toml": plan_text(lines, **flight).encode()})
    assert plan is not None
    track = _track(parse_plan(plan_text(numbered, **flight), Path()))
    return Flight(plan, config, track, [line["name"] for line in moved], defects)


def _moved(line: dict[str, Any], defects: list[Defect], speed_mps: float) -> dict[str, Any]:
    mine = {one.kind: one.size for one in defects if one.line == line["name"]}
    moved = dict(line)
    right = np.array([line["to_m"][1] - line["from_m"][1], line["from_m"][0] - line["to_m"][0]], np.float64)
    right *= mine.get("off", 0.0) / float(np.linalg.norm(right))
    for key in ("from_m", "to_m"):
        moved[key] = (np.array(line[key]) + right).tolist()
    moved["height_m"] += mine.get("high", 0.0)
    if "fast" in mine:
        moved["speed_mps"] = speed_mps + mine["fast"]
    return moved


def _track(plan: Plan) -> Trajectory:
    def ground_m(east_m: FloatArray, north_m: FloatArray) -> FloatArray:
        return np.full(np.broadcast(east_m, north_m).shape, GROUND_M)

    return fly(plan, Site.at(*plan.tables.flight.origin_deg), ground_m)


def moments_of(flight: Flight) -> StructArray:
    """Return the truth at 10 Hz: poses, and returns while a line is flown, with the defects that do not move it."""
    track = flight.track
    time_s: FloatArray = np.arange(1.0, int(track.end_s / STEP_S)) * STEP_S
    rows = empty_moments(len(time_s))
    rows["gps_ns"] = 1_465_549_200 * 10**9 + np.arange(len(time_s)) * STEP_NS
    rows["lat_rad"], rows["lon_rad"], rows["height_m"] = track.geodetic(time_s)
    velocity = track.velocity_l(time_s)
    rows["speed_mps"] = np.hypot(velocity[:, 0], velocity[:, 1])
    rows["track_rad"] = np.arctan2(velocity[:, 1], velocity[:, 0])
    rows["roll_rad"] = track.attitude(time_s)[0]
    rows["fix"] = 3
    rows["above_m"] = rows["height_m"] - GROUND_M
    rows["left_m"] = rows["above_m"] * np.tan(-HALF_ANGLE_RAD - rows["roll_rad"])
    rows["right_m"] = rows["above_m"] * np.tan(HALF_ANGLE_RAD - rows["roll_rad"])
    rows["silent"] = 1
    for one in track.lines:
        # the laser is on a little longer, as an operator does it
        on = (time_s >= one.start_s - 1.0) & (time_s <= one.end_s + 1.0)
        rows["returns"][on], rows["silent"][on] = RETURNS, 0
        speed_mps = float(rows["speed_mps"][on].mean())
        for defect in (each for each in flight.defects if each.line == flight.names[one.index]):
            _spoil(rows, time_s, defect, one.start_s, one.end_s, speed_mps)
    return rows


def _spoil(
    rows: StructArray, time_s: FloatArray, defect: Defect, start_s: float, end_s: float, speed_mps: float
) -> None:
    size, at_s = defect.size, start_s + defect.share * (end_s - start_s)

    def within(for_s: float) -> Any:
        first = min(max(at_s - for_s / 2, start_s + 1.0), max(start_s + 1.0, end_s - 1.0 - for_s))
        return (time_s >= first) & (time_s < first + for_s)

    if defect.kind in ("bank", "tilt"):
        mask = within(3.0 if defect.kind == "bank" else 2.0)
        rows["roll_rad"][mask] = math.radians(size) * (1 if defect.share > 0.5 else -1)
    elif defect.kind in ("silent", "late", "early"):
        late = (time_s >= start_s - 2.0) & (time_s < start_s + size / speed_mps)
        early = (time_s > end_s - size / speed_mps) & (time_s <= end_s + 2.0)
        mask = {"silent": within(size), "late": late, "early": early}[defect.kind]
        rows["returns"][mask], rows["silent"][mask] = 0, 1
    elif defect.kind == "gnss":
        rows["fix"][within(size)] = 0 if defect.share > 0.5 else 1
    elif defect.kind in ("time", "holdover"):
        mask = within(size)
        rows["time"][mask] = 2 if defect.kind == "time" else 1
        if defect.kind == "time":
            rows["returns"][mask], rows["untimed"][mask] = 0, 1
    elif defect.kind == "sparse":
        mask = within((end_s - start_s) / 3)
        rows["returns"][mask] = np.round(rows["returns"][mask] * size)
    elif defect.kind == "lost":
        rows["lost"][within(1.0)] = size
    elif defect.kind == "water":
        mask = within(size)
        rows["returns"][mask], rows["empty"][mask], rows["silent"][mask] = 0, 1, 0


def watch(
    flight: Flight,
    rows: StructArray,
    *,
    planned: bool = True,
    step: int = 20,
    seen: Callable[[dict[str, Any]], None] | None = None,
) -> LineWatch | StripWatch:
    """Feed a watch, poses at once and returns 3 s later, as live does; ``step`` poses at a time.

    ``seen`` gets what an operator sees after each step.
    """
    watched = LineWatch(flight.plan, flight.config) if planned else StripWatch(flight.config)
    join = Moments([])
    columns = ("returns", "silent", "empty", "untimed", "left_m", "right_m", "above_m")
    first_ns = int(rows["gps_ns"][0])
    for start in range(0, len(rows), step):
        poses = rows[start : start + step].copy()
        for column in columns:
            poses[column] = empty_moments(1)[column]
        join.add_poses(watched.poses(poses))
        _settle(watched, join.settled(), rows, first_ns, columns)
        if seen is not None:
            seen(watched.plain())
    _settle(watched, join.settled(last=True), rows, first_ns, columns)
    watched.close()
    return watched


def _settle(watched: Any, settled: StructArray, rows: StructArray, first_ns: int, columns: tuple[str, ...]) -> None:
    told = rows[(settled["gps_ns"] - first_ns) // STEP_NS]
    for column in columns:
        settled[column] = told[column]
    watched.moments(settled)


def parallel(count: int, spacing_m: float, length_m: float = 1200.0, **keys: Any) -> list[dict[str, Any]]:
    """Return east–west lines, the next to the north, flown to and fro."""
    lines = []
    for number in range(count):
        ends = [[-length_m / 2, number * spacing_m], [length_m / 2, number * spacing_m]]
        if number % 2:
            ends.reverse()
        one = {"name": str(number + 1), "from_m": ends[0], "to_m": ends[1], "height_m": HEIGHT_M}
        lines.append(one | keys)
    return lines


SPREAD = {
    "off": (28, 60), "high": (70, 150), "fast": (11, 16), "bank": (21, 35), "tilt": (12, 18), "silent": (5, 9),
    "late": (120, 400), "early": (120, 400), "gnss": (5, 45), "time": (3, 10), "holdover": (3, 10),
    "sparse": (0.2, 0.45), "lost": (1, 50), "water": (3, 8),
}  # fmt: skip


def is_grave(defect: Defect) -> bool:
    """Return whether a line with this defect must be flown again."""
    grave = KINDS[defect.kind][1]
    return defect.size >= 30.0 if grave is None else grave


def drawn(rng: np.random.Generator, kinds: list[str], seed: int) -> Flight:
    """Draw a block of parallel lines and a crossing one, flown two apart, with three defects of kinds in turn."""
    length_m, spacing_m, above_m = rng.uniform(2500, 4000), rng.uniform(350, 500), rng.uniform(700, 1100)
    azimuth = rng.uniform(0, math.pi)
    turn = np.array([[math.cos(azimuth), -math.sin(azimuth)], [math.sin(azimuth), math.cos(azimuth)]])
    ends = [((-length_m / 2, (place - 2) * spacing_m), (length_m / 2, (place - 2) * spacing_m)) for place in range(5)]
    ends.append(((0.0, -length_m / 2), (0.0, length_m / 2)))
    lines = []
    for number, place in enumerate([0, 2, 4, 1, 3, 5]):
        begin, end = ends[place] if number % 2 else ends[place][::-1]
        lines.append(
            {
                "name": f"{place + 1}",
                "from_m": (turn @ np.array(begin)).tolist(),
                "to_m": (turn @ np.array(end)).tolist(),
                "height_m": GROUND_M + above_m,
            }
        )
    places = rng.permutation(6)[:3]
    defects = []
    for number, place in enumerate(places.tolist()):
        kind = kinds[(3 * seed + number) % len(kinds)]
        defects.append(Defect(lines[place]["name"], kind, rng.uniform(0.1, 0.9), rng.uniform(*SPREAD[kind])))
    density = RETURNS * 10 / (2 * above_m * math.tan(HALF_ANGLE_RAD) * 60.0)
    turbulence = ["none", "light", "moderate"][seed % 3]
    return flown(lines, defects, {"density_per_m2": 0.8 * density}, seed=seed, turbulence=turbulence)
