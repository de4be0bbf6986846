"""Predict before take-off which parameters a planned flight would determine, their sigmas, and which it would hold.

Simulated returns lie where each line's scan would meet the flat pieces of the terrain. They pass through the rows and
normal equations of the adjustment like measured ones, with the expected errors of the trajectory; only their
misclosures are missing, which sigmas do not need.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from swath.calib import adjust as adjustment
from swath.calib.adjust import AS_USUAL
from swath.calib.equations.solve import Settings
from swath.calib.equations.trajectory_prior import TrajectoryPrior
from swath.calib.features import ControlPoint, Features, Patch, Plane
from swath.calib.flight import Flight, FlightError, Head, Swath, Tangent
from swath.calib.outcome import FixedParameter
from swath.calib.parameters import ParameterOptions
from swath.calib.planes.cells import CELL_SHORT_M, CELL_SIZES_M
from swath.calib.planes.fit import PlaneSettings
from swath.calib.planes.returns import RIM_M
from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.georef.geodesy.rotations import boresight, rot_from_quaternion
from swath.georef.records import RETURN_DTYPE
from swath.georef.scanner.calibration import Calibration
from swath.georef.timescales import SECOND_NS
from swath.georef.trajectory.trajectory import Trajectory

LEAST_POINTS = 10  # returns on a patch, for it to be found in a flight (FORMULAS 6.6)
LEAST_MADE, MOST_MADE = 4, 24  # simulated returns of a patch; each stands for several real ones
STEEPEST_COS = 0.17  # of the incidence: at more than 80° no echo returns
_COARSE_NS = SECOND_NS // 2
_STEPS = 20
_PLANES = PlaneSettings()
_LINES_A_CELL = 1.5  # width of a cell in distances between scan lines; most cells then contain several lines


@dataclass(frozen=True, eq=False)
class Surface:
    """A flat piece of the terrain, such as a roof's side.

    Attributes:
        name, kind: as of `swath.calib.features.Plane`.
        normal_t: (3,) unit, outwards.
        points_t: (m, 3) spread evenly over it.
        area_m2: seen from above.
        control: surveyed points on it, in t.
    """

    name: str
    normal_t: FloatArray
    points_t: FloatArray
    area_m2: float
    kind: str = "roof"
    control: tuple[ControlPoint, ...] = ()

    def taken_m2(self, cell_m: float) -> float:
        """Return the area whose returns are used: of a roof, whole search cells clear of its rims."""
        inner_m = max(float(np.sqrt(self.area_m2)) - max(cell_m, 2.0 * RIM_M), 0.0)
        return inner_m**2 if self.kind == "roof" else self.area_m2


@dataclass(frozen=True, slots=True)
class Line:
    """A flight line: its trajectory, its number, and its begin and end (GPS time)."""

    name: str
    trajectory_index: int
    strip: int
    begin_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True)
class Scan:
    """The scan pattern of a line scanner.

    Attributes:
        half_angle_rad: from the middle.
        rate_hz: pulses per second within the scan.
        scan_hz: oscillations, or turns, per second; 0: not known.
        motion: ``sine``, ``triangle`` or ``turning``.
        facets: scan lines per turn.
    """

    half_angle_rad: float
    rate_hz: float
    scan_hz: float = 0.0
    motion: str = "turning"
    facets: int = 1

    def apart_m(self, per_m2: float, speed_mps: float) -> float:
        """Return the distance between lines, or between pulses of a line, whichever is larger, in metres.

        Args:
            per_m2: density of pulses on the ground.
            speed_mps: speed over ground.
        """
        lines_hz = self.scan_hz * (self.facets if self.motion == "turning" else 2)
        along_m = speed_mps / lines_hz if lines_hz else per_m2**-0.5
        return max(along_m, 1.0 / (per_m2 * along_m))

    def encoder_motion(self, angle_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return rate and acceleration (n,) of the encoder at angles; returns alternate in direction."""
        back = np.where(np.arange(len(angle_rad)) % 2, -1.0, 1.0)
        turns = 2.0 * np.pi * self.scan_hz
        if self.motion == "sine":
            square = np.maximum(self.half_angle_rad**2 - angle_rad**2, 0.0)
            return back * turns * np.sqrt(square), -(turns**2) * angle_rad
        if self.motion == "triangle":
            return back * 4.0 * self.scan_hz * self.half_angle_rad, np.zeros_like(angle_rad)
        return np.full_like(angle_rad, turns), np.zeros_like(angle_rad)


@dataclass(frozen=True, eq=False)
class Predicted:
    """The prediction of what a flight would determine.

    Attributes:
        names: (u,) of the parameters that it would estimate, as ``left.omega_rad``.
        sigmas: (u,) SI.
        correlation: (u, u).
        held: parameters that it would not determine, and which lines would.
        planes, returns: numbers on which the prediction is based.
    """

    names: tuple[str, ...]
    sigmas: FloatArray
    correlation: FloatArray
    held: tuple[FixedParameter, ...]
    planes: int
    returns: int


def planned(
    frame: Tangent,
    heads: Sequence[Head],
    scans: Sequence[Scan],
    trajectories: Sequence[Trajectory],
    lines: Sequence[Line],
    surfaces: Sequence[Surface],
    most_returns: int,
) -> tuple[Flight, Features]:
    """Return the flight as it would be read, and its planes.

    Args:
        frame: the frame t.
        heads: line scanners; their starting calibration gives the direction in which they look.
        scans: scan pattern of each head.
        trajectories: planned, with the sigmas that are expected of them.
        lines: flight lines of the plan.
        surfaces: flat pieces of the terrain.
        most_returns: greatest number of returns of a strip on a surface that the adjustment would use.

    Raises:
        FlightError: no surface is seen by two swaths.
    """
    swaths: list[Swath] = []
    patches: list[list[Patch]] = [[] for _ in surfaces]
    several = len(heads) > 1
    for line in lines:
        for number, (head, scan) in enumerate(zip(heads, scans, strict=True)):
            shots, expected = _shots(frame, head, scan, trajectories[line.trajectory_index], line, surfaces)
            if not len(shots.time_ns):
                continue
            for surface in np.unique(shots.surface).tolist():
                at = np.flatnonzero(shots.surface == surface)
                each = max(min(float(expected[surface]), most_returns) / len(at), 1.0)
                patches[surface].append(Patch(len(swaths), at, each))
            name = f"{head.name} {line.name}" if several else line.name
            swaths.append(_swath(name, number, line, head.start, scan, shots))
    planes = tuple(
        Plane(
            surface.name,
            surface.points_t.mean(axis=0),
            surface.normal_t,
            tuple(mine),
            control=surface.control,
            kind=surface.kind,
        )
        for surface, mine in zip(surfaces, patches, strict=True)
        if len(mine) > 1 or (mine and surface.control)
    )
    if not planes:
        raise FlightError("no two lines see the same roof or ground; plan lines that overlap over buildings")
    return Flight(frame, tuple(heads), tuple(trajectories), tuple(swaths)), Features(planes)


def search_cell_m(scan: Scan, per_m2: FloatArray, speed_mps: float) -> float:
    """Return the cell size, in metres, that `swath.calib.planes.cells.cell_size` would choose for such a line."""
    if not len(per_m2):
        return _PLANES.cell_m
    middling = float(np.median(per_m2))
    wanted = max(_PLANES.cell_m, float(np.sqrt(_PLANES.cell_points / middling)) - CELL_SHORT_M)
    wanted = max(wanted, _LINES_A_CELL * scan.apart_m(middling, speed_mps))
    return next((size for size in CELL_SIZES_M if size >= wanted), CELL_SIZES_M[-1])


def predict(
    flight: Flight,
    features: Features,
    options: ParameterOptions,
    prior: TrajectoryPrior | None,
    settings: Settings = AS_USUAL,
) -> Predicted:
    """Predict sigmas and held parameters with the adjustment's own equations.

    Args:
        flight, features: planned or flown.
        options: which parameters to estimate.
        prior: prior of the trajectory's errors.
        settings: settings of the adjustment, with its rules for which parameters count as determined.

    Raises:
        ParameterError, NormalError: see `swath.calib.adjust.predict`.
    """
    left, covariance = adjustment.predict(flight, features, options, prior, settings)
    sigmas = np.sqrt(np.diag(covariance))
    planes = [plane for plane in features.planes if plane.points]
    returns = sum(plane.points for plane in planes)
    return Predicted(left.names, sigmas, covariance / np.outer(sigmas, sigmas), left.held, len(planes), returns)


@dataclass(frozen=True, eq=False)
class _Shots:
    """Returns of one line in order of time: (n,) surface, GPS time, ρ, θ, and points (n, 3) on the surface."""

    surface: Int64Array
    time_ns: Int64Array
    range_m: FloatArray
    angle_rad: FloatArray
    points_t: FloatArray

    def at(self, chosen: BoolArray | Int64Array) -> _Shots:
        """Select some of the returns."""
        return _Shots(
            self.surface[chosen],
            self.time_ns[chosen],
            self.range_m[chosen],
            self.angle_rad[chosen],
            self.points_t[chosen],
        )


def _shots(
    frame: Tangent, head: Head, scan: Scan, trajectory: Trajectory, line: Line, surfaces: Sequence[Surface]
) -> tuple[_Shots, FloatArray]:
    """Return where and when a line's scan meets the surfaces' points, and the expected number of returns by surface."""
    surface = np.concatenate([np.full(len(one.points_t), index) for index, one in enumerate(surfaces)])
    points_t = np.concatenate([one.points_t for one in surfaces])
    points_e = frame.e_from_t(points_t)
    time_ns, crossed = _crossings(trajectory, head.start, points_e, line)
    beam_s, beam_e = _beams(trajectory, head.start, points_e, time_ns)
    range_m, angle = np.linalg.norm(beam_s, axis=1), np.arctan2(beam_s[:, 1], beam_s[:, 2])
    normals_t = np.stack([one.normal_t for one in surfaces])[surface]
    towards = np.einsum("na,na->n", normals_t, beam_e @ frame.rot_t_from_e.T) / range_m
    low_m, high_m = head.range_gate
    met = crossed & (np.abs(angle) <= scan.half_angle_rad) & (towards < -STEEPEST_COS)
    met &= (range_m >= low_m) & (range_m <= high_m)
    shots = _Shots(surface, time_ns, range_m, angle, points_t).at(met)
    speed_mps = _speed(trajectory, line)
    per_m2 = _density(scan, speed_mps, shots)
    kept, expected = _thinned(shots, surface, surfaces, per_m2, search_cell_m(scan, per_m2, speed_mps))
    shots = shots.at(kept)
    return shots.at(np.argsort(shots.time_ns, kind="stable")), expected


def _crossings(
    trajectory: Trajectory, calibration: Calibration, points_e: FloatArray, line: Line
) -> tuple[Int64Array, BoolArray]:
    """Find the times at which points (n, 3) pass through the plane of the scan, and whether they do.

    The search uses a coarse grid, then false position (the Illinois rule, Dowell and Jarratt 1971).
    """
    count = int((line.end_ns - line.begin_ns) // _COARSE_NS) + 2
    grid = line.begin_ns + np.rint(np.linspace(0, line.end_ns - line.begin_ns, count)).astype(np.int64)
    origin_e, ahead_e = _plane_of_scan(trajectory, calibration, grid)
    # a scanner that looks back has its axis against the flight direction
    forward = -1.0 if ahead_e.mean(axis=0) @ (origin_e[-1] - origin_e[0]) < 0.0 else 1.0
    ahead_e *= forward
    ahead = points_e @ ahead_e.T - np.sum(origin_e * ahead_e, axis=1)
    passed = (ahead[:, :-1] > 0.0) & (ahead[:, 1:] <= 0.0)
    crossed = np.asarray(passed.any(axis=1), dtype=np.bool_)
    at, step = np.flatnonzero(crossed), passed.argmax(axis=1)[crossed]
    low, high = np.zeros(len(at)), (grid[step + 1] - grid[step]).astype(np.float64)
    before, behind, since = ahead[at, step], ahead[at, step + 1], high
    for _ in range(_STEPS):
        since = low + (high - low) * before / (before - behind)
        origin_e, ahead_e = _plane_of_scan(trajectory, calibration, grid[step] + np.rint(since).astype(np.int64))
        found = forward * np.sum((points_e[at] - origin_e) * ahead_e, axis=1)
        front = found > 0.0
        before, behind = np.where(front, found, 0.5 * before), np.where(front, 0.5 * behind, found)
        low, high = np.where(front, since, low), np.where(front, high, since)
    time_ns = np.full(len(points_e), line.begin_ns, dtype=np.int64)
    time_ns[at] = grid[step] + np.rint(since).astype(np.int64)
    return time_ns, crossed


def _plane_of_scan(
    trajectory: Trajectory, calibration: Calibration, time_ns: Int64Array
) -> tuple[FloatArray, FloatArray]:
    """Return the scanner's positions (n, 3) in e and the axes of its scan rotation, at times (n,)."""
    origin_e, rot_e_from_s = _scanner(trajectory, calibration, time_ns)
    return origin_e, rot_e_from_s[:, :, 0]


def _scanner(trajectory: Trajectory, calibration: Calibration, time_ns: Int64Array) -> tuple[FloatArray, FloatArray]:
    """Return positions (n, 3) of the scanner and rotations (n, 3, 3) from s to e, at times of its stamps."""
    value = calibration.value
    offset_ns = round(value("time_offset_s") * SECOND_NS)
    poses = trajectory.poses(np.clip(time_ns + offset_ns, *trajectory.span))
    rot_e_from_b = rot_from_quaternion(poses.q_e_from_b)
    angles = boresight(value("omega_rad"), value("phi_rad"), value("kappa_rad"))
    origin_e = poses.position_e + rot_e_from_b @ calibration.lever_arm_b
    return origin_e, rot_e_from_b @ (angles @ calibration.installation_matrix)


def _beams(
    trajectory: Trajectory, calibration: Calibration, points_e: FloatArray, time_ns: Int64Array
) -> tuple[FloatArray, FloatArray]:
    """Return vectors (n, 3) from the scanner to points at given times, in s and in e."""
    origin_e, rot_e_from_s = _scanner(trajectory, calibration, time_ns)
    beam_e = points_e - origin_e
    return np.einsum("nij,ni->nj", rot_e_from_s, beam_e), beam_e


def _speed(trajectory: Trajectory, line: Line) -> float:
    """Return the speed along a line in metres per second."""
    ends = trajectory.poses(np.array([line.begin_ns, line.end_ns], dtype=np.int64)).position_e
    return float(np.linalg.norm(ends[1] - ends[0])) / ((line.end_ns - line.begin_ns) / SECOND_NS)


def _density(scan: Scan, speed_mps: float, shots: _Shots) -> FloatArray:
    """Return the density (n,) of pulses per square metre of ground at shots, taken as even over the swath's width."""
    width_m = 2.0 * shots.range_m * np.cos(shots.angle_rad) * np.tan(scan.half_angle_rad)
    per_m2: FloatArray = scan.rate_hz / (speed_mps * width_m)
    return per_m2


def _thinned(
    shots: _Shots, surface: Int64Array, surfaces: Sequence[Surface], per_m2: FloatArray, cell_m: float
) -> tuple[BoolArray, FloatArray]:
    """Return a mask of the shots to keep, and the expected number of real returns by surface.

    At most `MOST_MADE` shots of a surface are kept; surfaces that are hardly seen lose all their shots.
    """
    keep = np.zeros(len(shots.surface), dtype=np.bool_)
    expected = np.zeros(len(surfaces))
    asked = np.bincount(surface, minlength=len(surfaces))
    for index in np.unique(shots.surface).tolist():
        at = np.flatnonzero(shots.surface == index)
        share = len(at) / asked[index]
        expected[index] = per_m2[at].mean() * surfaces[index].taken_m2(cell_m) * share
        if expected[index] >= LEAST_POINTS and len(at) >= LEAST_MADE:
            wanted = int(min(expected[index], MOST_MADE, len(at)))
            keep[at[np.linspace(0, len(at) - 1, wanted).astype(np.int64)]] = True
    return keep, expected


def _swath(name: str, head: int, line: Line, calibration: Calibration, scan: Scan, shots: _Shots) -> Swath:
    """Build a swath of raw readings that give these ranges and angles."""
    value = calibration.value
    rows = np.zeros(len(shots.time_ns), RETURN_DTYPE)
    rows["range_m"] = (shots.range_m - value("range_offset_m")) / (1.0 + value("range_scale"))
    rows["encoder_rad"] = shots.angle_rad / (1.0 + value("scan_angle_scale")) + value("scan_angle_offset_rad")
    rows["return_number"] = rows["number_of_returns"] = 1
    rate, acceleration = scan.encoder_motion(shots.angle_rad)
    return Swath(name, head, line.strip, line.trajectory_index, rows, shots.time_ns, shots.points_t, rate, acceleration)
