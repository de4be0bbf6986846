"""Coverage of a plan before any pulse is fired: swaths, density and overlap of its lines, with the wings held level.

Across a line a scanner is a fan of angles θ from nadir (positive to the right), each with its share of the pulses; at
height H above ground a pulse meets the ground H tan θ beside the line. A line scanner's fan is its scan; a spinning
head's (spin axis along the flight) is the whole turn, cut where the ground is farther away than it can measure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.sim.flight.envelope import Ground
from swath.sim.flight.trajectory import Trajectory, fly
from swath.sim.flight.turbulence import ANGLE_RMS_DEG, INTENSITY
from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import Plan
from swath.sim.plan.tables import ScannerTable
from swath.sim.scanners import mirrors
from swath.sim.scene.scene import Scene, build_scene
from swath.sim.scene.terrain import MARGIN_M
from swath.sim.site import Site

NEIGHBOUR_DEG = 20.0  # lines whose directions, or opposites, differ by less are neighbours
OS1_BEAMS, OS1_COLUMNS = 64, 1024
VLP16_PULSE_HZ = 16 / 55.296e-6  # sixteen beams each 55.296 µs: VLP-16 User Manual, 63-9243, 9.4
FLATTEST_RAD = math.radians(75.0)  # flatter beams reach too far to need ground there

LOG_MESSAGE_BYTES = 80  # overhead of a message in the log, with its part of the indexes
IMU_SAMPLE_BYTES = 200
GNSS_BYTES_PER_S = 12_000


@dataclass(frozen=True, slots=True)
class Fan:
    """The spread of one scanner's pulses across the line of flight.

    Attributes:
        centre_rad: centre of the fan, from nadir.
        half_angle_rad: to either side.
        range_max_m: greatest range that is measured.
        rate_hz: pulses a second in the whole fan.
        sine: True if the mirror swings as a sine, so that pulses are dense at the edges; else all angles get the same
            density.
    """

    centre_rad: float
    half_angle_rad: float
    range_max_m: float
    rate_hz: float
    sine: bool

    def limits(self, above_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (n,) the smallest and the largest angle from nadir that is measured at heights above ground (n,)."""
        reach = np.arccos(np.clip(above_m / self.range_max_m, 0.0, 1.0))
        first = np.maximum(self.centre_rad - self.half_angle_rad, -reach)
        return first, np.minimum(self.centre_rad + self.half_angle_rad, reach)

    def share(self, angle_rad: FloatArray) -> FloatArray:
        """Return (n,) the share of the pulses at angles below these, 0 … 1."""
        part = np.clip((angle_rad - self.centre_rad) / self.half_angle_rad, -1.0, 1.0)
        shares: FloatArray = 0.5 + (np.arcsin(part) / np.pi if self.sine else 0.5 * part)
        return shares


def fan_of(table: ScannerTable) -> Fan:
    """Return the fan of a scanner of the plan."""
    if table.kind in ("vlp16", "os1"):
        return Fan(0.0, math.pi, table.range_max_m, pulse_rate_hz(table), False)
    installation, axis = np.array(table.installation), 0 if table.kind == "rosette" else 2
    centre = math.atan2(installation[1, axis], installation[2, axis])
    sine = table.kind == "nutating" or (table.kind == "oscillating" and table.motion == "sine")
    return Fan(centre, _half_angle_rad(table), table.range_max_m, pulse_rate_hz(table), sine)


def pulse_rate_hz(table: ScannerTable) -> float:
    """Return the pulses per second that leave while the laser is on.

    The pulses that a polygon or monogon fires beyond its scan are lost.
    """
    if table.kind == "vlp16":
        return VLP16_PULSE_HZ
    if table.kind == "os1":
        return OS1_BEAMS * OS1_COLUMNS * table.scan_hz
    used = {"polygon": table.half_angle_deg * table.facets / 360.0, "monogon": table.half_angle_deg / 180.0}
    return table.prf_hz * min(used.get(table.kind, 1.0), 1.0)


def _half_angle_rad(table: ScannerTable) -> float:
    """Return the half angle of the scan; of a circular or rosette pattern, the angle that it reaches to the side."""
    if table.kind not in ("nutating", "risley"):
        return math.radians(table.half_angle_deg)
    turn = np.linspace(0.0, 2 * np.pi, 721)
    if table.kind == "nutating":
        beams = mirrors.nutating(turn, math.radians(table.nutation_deg))
    else:
        first, second = np.radians(table.wedge_deg)
        beams = mirrors.risley(turn, turn, (first, second), table.refractive_index)
    return float(np.arctan2(np.abs(beams[:, 1]), beams[:, 2]).max())


@dataclass(frozen=True)
class Strip:
    """The swath of one line.

    Attributes:
        name: of the line.
        start_s, end_s: times at which the line begins and ends.
        from_m: (2,) east, north of its beginning.
        ahead: (2,) unit vector along it; the right hand is (ahead[1], −ahead[0]).
        length_m, speed_mps, height_m: of the line, ellipsoidal height.
        fans: of the scanners.
    """

    name: str
    start_s: float
    end_s: float
    from_m: FloatArray
    ahead: FloatArray
    length_m: float
    speed_mps: float
    height_m: float
    fans: tuple[Fan, ...]

    @property
    def end_m(self) -> FloatArray:
        """(2,) east, north of the line's end."""
        end: FloatArray = self.from_m + self.length_m * self.ahead
        return end

    def beside(self, east_m: FloatArray, north_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the distances along the line and to its right of points (n,)."""
        east_m, north_m = east_m - self.from_m[0], north_m - self.from_m[1]
        return east_m * self.ahead[0] + north_m * self.ahead[1], east_m * self.ahead[1] - north_m * self.ahead[0]

    def point(self, along_m: FloatArray, right_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return east and north of the points at these distances along the line and to its right."""
        east_m = self.from_m[0] + along_m * self.ahead[0] + right_m * self.ahead[1]
        return east_m, self.from_m[1] + along_m * self.ahead[1] - right_m * self.ahead[0]

    def covers(self, east_m: FloatArray, north_m: FloatArray, ground_m: FloatArray) -> BoolArray:
        """Return (n,) True where ground at these heights is within the swath."""
        along_m, right_m = self.beside(east_m, north_m)
        above_m = self.height_m - ground_m
        angle_rad = np.arctan2(right_m, above_m)
        seen = np.zeros(angle_rad.shape, np.bool_)
        for fan in self.fans:
            first, last = fan.limits(above_m)
            seen |= (first <= angle_rad) & (angle_rad <= last)
        return seen & (along_m >= 0.0) & (along_m <= self.length_m) & (above_m > 0.0)

    def density(self, east_m: FloatArray, north_m: FloatArray, ground_m: FloatArray, cell_m: float) -> FloatArray:
        """Return (n,) pulses per square metre of ground, averaged over a cell's width across the line."""
        _, right_m = self.beside(east_m, north_m)
        above_m = self.height_m - ground_m
        inner, outer = (np.arctan2(right_m + side * cell_m / 2, above_m) for side in (-1.0, 1.0))
        per_m2 = np.zeros(inner.shape)
        for fan in self.fans:
            first, last = fan.limits(above_m)
            share = fan.share(np.clip(outer, first, last)) - fan.share(np.clip(inner, first, last))
            per_m2 += fan.rate_hz * share / (self.speed_mps * cell_m)
        return np.where(self.covers(east_m, north_m, ground_m), per_m2, 0.0)

    def width_m(self, above_m: float) -> tuple[float, float]:
        """Return the swath's two edges at a height above flat ground, as distances to the right of the line."""
        limits = [fan.limits(np.array([above_m])) for fan in self.fans]
        first = min(float(low[0]) for low, _ in limits)
        return above_m * math.tan(first), above_m * math.tan(max(float(high[0]) for _, high in limits))


def strip_of(plan: Plan, index: int, start_s: float, end_s: float) -> Strip:
    """Return the swath of a line of the plan."""
    table = plan.tables.line[index]
    start_m, end_m = np.array(table.from_m), np.array(table.to_m)
    length_m = float(np.linalg.norm(end_m - start_m))
    speed_mps = table.speed_mps or plan.tables.flight.speed_mps
    fans = tuple(fan_of(scanner) for scanner in plan.tables.scanner.values())
    ahead = (end_m - start_m) / length_m
    return Strip(table.name, start_s, end_s, start_m, ahead, length_m, speed_mps, table.height_m, fans)


def corners(plan: Plan) -> FloatArray:
    """Return (k, 2) east and north of the ground that must exist: around every line, as wide as its scanners see.

    The ground extends `swath.sim.scene.terrain.MARGIN_M` farther in any case, which is enough for a wing that dips a
    little; corners lie outside the swath only where that is not enough.
    """
    terrain, found = plan.tables.terrain, []
    for index in range(len(plan.tables.line)):
        strip = strip_of(plan, index, 0.0, 0.0)
        far_m = max(math.hypot(*strip.from_m), math.hypot(*strip.end_m))
        lowest_m = terrain.height_m - terrain.relief_m - 0.01 * terrain.slope_percent * far_m
        above_m = max(strip.height_m - lowest_m, 1.0)
        left_m, right_m = strip.width_m(above_m)
        flat = min(math.atan2(max(-left_m, right_m), above_m), FLATTEST_RAD)
        more_m = max(above_m / math.cos(flat) ** 2 * _tilt_rad(plan) - 0.8 * MARGIN_M, 0.0)
        ends = np.array([-more_m, -more_m, strip.length_m + more_m, strip.length_m + more_m])
        sides = np.array([left_m - more_m, right_m + more_m, left_m - more_m, right_m + more_m])
        found.append(np.stack(strip.point(ends, sides), axis=-1))
    if plan.tables.ground is not None:
        found.append(np.array([plan.tables.ground.runway_m]))
    return np.concatenate(found)


def _tilt_rad(plan: Plan) -> float:
    """Return the largest angle of beams from the directions given by level wings and the installation."""
    trues = [scanner.true for scanner in plan.tables.scanner.values()]
    mounted_deg = max((math.hypot(true.omega_deg, true.phi_deg, true.kappa_deg) for true in trues), default=0.0)
    flight = plan.tables.flight
    shaken_deg = 4.0 * INTENSITY[flight.turbulence] * max(ANGLE_RMS_DEG.values())
    return math.radians(mounted_deg + shaken_deg + abs(flight.pitch_deg))


def control_points(plan: Plan, scene: Scene) -> FloatArray:
    """Return (k, 3) the plan's ground control points in the site frame, at places that some line sees.

    Raises:
        PlanError: ``control.points``: there is no room for so many.
    """
    strips = [strip_of(plan, index, 0.0, 0.0) for index in range(len(plan.tables.line))]

    def seen(east_m: FloatArray, north_m: FloatArray) -> BoolArray:
        ground_m = scene.ground_m(east_m, north_m)
        covered = np.zeros(ground_m.shape, np.bool_)
        for strip in strips:
            covered |= strip.covers(east_m, north_m, ground_m)
        return covered

    return scene.control_points(plan.tables.control.points, plan.tables.flight.seed, seen)


def refuse_ranges(plan: Plan, ground_m: Ground) -> None:
    """Refuse the first line from which a scanner can measure no ground straight below it, with `PlanError`."""
    for index in range(len(plan.tables.line)):
        strip = strip_of(plan, index, 0.0, 0.0)
        along_m = np.linspace(0.0, strip.length_m, 200)
        above_m = strip.height_m - ground_m(*strip.point(along_m, np.zeros(200)))
        for name, scanner in plan.tables.scanner.items():
            far, near = above_m > scanner.range_max_m, above_m < scanner.range_min_m
            if far.all() or near.all():
                bound = f"to {scanner.range_max_m:g} m" if far.all() else f"from {scanner.range_min_m:g} m on"
                raise PlanError(
                    f"line[{index}].height_m",
                    f"{above_m.mean():.0f} m above ground, but scanner.{name} measures {bound}; set a height, or a "
                    f"range_{'max' if far.all() else 'min'}_m, that meets the ground",
                )


class Survey:
    """A plan flown over its ground; the summary and the picture are made from it.

    Args:
        plan: of the flight.

    Raises:
        PlanError: the plan cannot be flown.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.site = Site.at(*plan.tables.flight.origin_deg)
        self.scene: Scene = build_scene(plan, self.site, corners(plan))
        self.trajectory: Trajectory = fly(plan, self.site, self.scene.ground_m)
        refuse_ranges(plan, self.scene.ground_m)
        self.strips = tuple(strip_of(plan, line.index, line.start_s, line.end_s) for line in self.trajectory.lines)

    def stations(self, strip: Strip, count: int = 200) -> tuple[FloatArray, FloatArray]:
        """Return distances along a line, and the line's heights above ground there."""
        along_m = np.linspace(0.0, strip.length_m, count)
        return along_m, strip.height_m - self.scene.ground_m(*strip.point(along_m, np.zeros(count)))

    def edges(self, strip: Strip, count: int = 60) -> FloatArray:
        """Return (2·count, 2) east and north around a swath on the real ground.

        Each edge is found by iteration with the ground height at the last estimate.
        """
        along_m = np.linspace(0.0, strip.length_m, count)
        sides = []
        for side in (0, 1):
            right_m = np.zeros(count)
            for _ in range(4):
                above_m = strip.height_m - self.scene.ground_m(*strip.point(along_m, right_m))
                limits = [fan.limits(above_m)[side] for fan in strip.fans]
                right_m = above_m * np.tan(np.max(limits, axis=0) if side else np.min(limits, axis=0))
            sides.append(np.stack(strip.point(along_m, right_m), axis=-1))
        return np.concatenate([sides[0], sides[1][::-1]])


@dataclass(frozen=True, slots=True)
class Grid:
    """A map of the coverage; rows go from south to north.

    Attributes:
        east_m: (nx,) centres of cells.
        north_m: (ny,) centres of cells.
        cell_m: size of a cell.
        density: (ny, nx) pulses per square metre, of all lines.
        lines: (ny, nx) number of lines that cover the cell.
    """

    east_m: FloatArray
    north_m: FloatArray
    cell_m: float
    density: FloatArray
    lines: Int64Array


def grid_of(survey: Survey, cells: int = 90_000) -> Grid:
    """Return density and overlap over all swaths, on about this many square cells."""
    outline = np.concatenate([survey.edges(strip) for strip in survey.strips])
    low, high = outline.min(axis=0), outline.max(axis=0)
    cell_m = math.sqrt(float(np.prod(high - low)) / cells)
    east_m = np.arange(low[0] - cell_m, high[0] + 2 * cell_m, cell_m)
    north_m = np.arange(low[1] - cell_m, high[1] + 2 * cell_m, cell_m)
    east, north = (axis.ravel() for axis in np.meshgrid(east_m, north_m))
    ground_m = survey.scene.ground_m(east, north)
    density, lines = np.zeros(east.shape), np.zeros(east.shape, np.int64)
    for strip in survey.strips:
        density += strip.density(east, north, ground_m, cell_m)
        lines += strip.covers(east, north, ground_m)
    shape = (len(north_m), len(east_m))
    return Grid(east_m, north_m, cell_m, density.reshape(shape), lines.reshape(shape))


def plan_summary(plan: Plan) -> list[dict[str, Any]]:
    """Return one row for each line, then one named ``total``; see `summary_of`. Raises PlanError."""
    return summary_of(Survey(plan))


def summary_of(survey: Survey) -> list[dict[str, Any]]:
    """Return the coverage of a plan as rows.

    Rows of lines: ``name``, ``length_m``, ``seconds``, ``height_min_m`` and ``height_mean_m`` above ground, ``swath_m``
    (2 H tan of the half angle on flat ground, H the mean), ``density_per_m2`` (pulses a second within the swath over
    speed times swath) and ``overlap_percent`` (share of the swath that is also covered by the neighbour which covers
    most of it; 0 without a neighbour). Last row: ``name`` total, ``seconds`` in the air and on the ground, ``line_s``,
    ``pulses`` and ``log_bytes`` expected.
    """
    rows = [_row(survey, strip) for strip in survey.strips]
    plan, end_s = survey.plan, survey.trajectory.end_s
    line_s = sum(strip.end_s - strip.start_s for strip in survey.strips)
    counts = {
        name: pulse_rate_hz(table) * (end_s if _always_on(table) else line_s)
        for name, table in plan.tables.scanner.items()
    }
    log_bytes = sum(_pulse_bytes(plan.tables.scanner[name]) * count for name, count in counts.items())
    log_bytes += end_s * sum(IMU_SAMPLE_BYTES * table.rate_hz for table in plan.tables.imu.values())
    log_bytes += end_s * GNSS_BYTES_PER_S * len(plan.tables.gnss)
    total = {"name": "total", "seconds": end_s, "line_s": line_s}
    return [*rows, total | {"pulses": round(sum(counts.values())), "log_bytes": round(log_bytes)}]


def _row(survey: Survey, strip: Strip) -> dict[str, Any]:
    _, above_m = survey.stations(strip)
    mean_m = float(above_m.mean())
    left_m, right_m = strip.width_m(mean_m)
    per_s = 0.0
    for fan in strip.fans:
        first, last = fan.limits(np.array([mean_m]))
        per_s += fan.rate_hz * float((fan.share(last) - fan.share(first))[0])
    return {
        "name": strip.name,
        "length_m": strip.length_m,
        "seconds": strip.end_s - strip.start_s,
        "height_min_m": float(above_m.min()),
        "height_mean_m": mean_m,
        "swath_m": right_m - left_m,
        "density_per_m2": per_s / (strip.speed_mps * (right_m - left_m)),
        "overlap_percent": _overlap_percent(survey, strip),
    }


def _overlap_percent(survey: Survey, strip: Strip) -> float:
    """Return the percentage of points, spread evenly over the swath, that the best neighbour covers."""
    along_m, above_m = survey.stations(strip)
    left_m, right_m = strip.width_m(float(above_m.mean()))
    across_m = left_m + (right_m - left_m) * (np.arange(400) + 0.5) / 400
    east_m, north_m = strip.point(*(axis.ravel() for axis in np.meshgrid(along_m, across_m)))
    ground_m = survey.scene.ground_m(east_m, north_m)
    least = math.cos(math.radians(NEIGHBOUR_DEG))
    shares = [
        other.covers(east_m, north_m, ground_m).mean()
        for other in survey.strips
        if other is not strip and abs(float(other.ahead @ strip.ahead)) > least
    ]
    return 100.0 * float(max(shares, default=0.0))


def _always_on(table: ScannerTable) -> bool:
    return not table.on_lines_only or table.kind in ("vlp16", "os1", "rosette")


def _pulse_bytes(table: ScannerTable) -> float:
    """Return the bytes of the log per pulse: the pulse's part of a datagram.

    Datagrams are those of SREP/1, VLP-16's data packet, Ouster's RNG19_RFL8_SIG16_NIR16 and Livox' points of type 1.
    """
    if table.kind == "vlp16":
        return (1206 + LOG_MESSAGE_BYTES) / (192 if table.dual_return else 384)
    if table.kind == "os1":
        column = 12 + (16 if table.dual_return else 12) * OS1_BEAMS
        return (64 + 16 * column + LOG_MESSAGE_BYTES) / (16 * OS1_BEAMS)
    if table.kind == "rosette":
        return 14 + (36 + LOG_MESSAGE_BYTES) / 96
    return 8 + 8 * table.return_slots + (52 + LOG_MESSAGE_BYTES) / table.pulses_per_datagram
