"""Makes flights over ground given by a formula, with SciPy's rotations and bisection, without the simulator."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from swath.calib.flight import Flight, Head, Swath, Tangent
from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray
from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.records import RETURN_DTYPE
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import Calibration, nominal
from swath.georef.scanner.uncertainty import Noise
from swath.georef.trajectory.trajectory import Trajectory

Surface = Callable[[FloatArray, FloatArray], FloatArray]

BETWEEN_NS = 1_000_000_000_000
STEPS = 28  # of the search along the beam
START_NS = 1_400_000_000_000_000_000
T_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # t from north, east, down


@dataclass(frozen=True)
class Line:
    """A straight level line: its beginning, heading, length, height in t, and speed."""

    x: float
    y: float
    heading_deg: float
    length_m: float
    height_m: float
    speed_mps: float = 50.0


@dataclass(frozen=True)
class Scanner:
    """Line scanner of these flights, whose scan angle is a triangle wave."""

    prf_hz: float = 20_000.0
    scan_hz: float = 40.0
    half_angle_deg: float = 25.0
    range_noise_m: float = 0.02


def gables(
    count: int = 10, spacing_m: float = 24.0, size_m: float = 12.0, pitch_deg: float = 40.0, seed: int = 3
) -> Surface:
    """Return a surface with a house in each square of a grid about the origin, slightly off its centre.

    Ridges run north or east.
    """
    rng = np.random.default_rng(seed)
    off = rng.uniform(-0.45, 0.45, (count, count, 2)) * (spacing_m - size_m)
    turned = rng.integers(0, 2, (count, count)).astype(np.bool_)
    slope, half = np.tan(np.radians(pitch_deg)), 0.5 * size_m

    def height(x: FloatArray, y: FloatArray) -> FloatArray:
        column, row = np.floor(x / spacing_m).astype(np.int64), np.floor(y / spacing_m).astype(np.int64)
        i, j = column + count // 2, row + count // 2
        built = (i >= 0) & (i < count) & (j >= 0) & (j < count)
        i, j = np.where(built, i, 0), np.where(built, j, 0)
        dx = np.abs(x - (column + 0.5) * spacing_m - off[i, j, 0])
        dy = np.abs(y - (row + 0.5) * spacing_m - off[i, j, 1])
        roof = 4.0 + slope * (half - np.where(turned[i, j], dy, dx))
        return np.where(built & (dx < half) & (dy < half), roof, 0.0)

    return height


def fly(
    lines: Sequence[Line],
    ground: Surface,
    *,
    true: Mapping[str, float] | None = None,
    installation: FloatArray | None = None,
    scanner: Scanner = Scanner(),
    errors: FloatArray | None = None,
    sigmas: tuple[float, float] = (0.02, 5e-5),
    intensity: Surface | None = None,
    seed: int = 1,
    lowest_m: float = -3.0,
    highest_m: float = 11.0,
) -> Flight:
    """Return a flight with nominal calibration over ground z = f(x, y) in t; ``true`` is what the scanner really is.

    Args:
        errors: (lines, 6) of the trajectory given: east, north, up m; small turns about north, east, down of b, rad.
        sigmas: the given trajectory's, m and rad.
    """
    frame = Tangent.at(e_from_geodetic(np.radians(47.2), np.radians(9.0), 0.0))
    matrix = np.eye(3) if installation is None else installation
    start = nominal("left", (0.0, 0.0, 0.0), matrix)
    truth = start.changed(**(true or {}))
    rng = np.random.default_rng(seed)
    wrong = np.zeros((len(lines), 6)) if errors is None else errors
    trajectories, swaths = [], []
    for number, line in enumerate(lines):
        begin_ns = START_NS + number * BETWEEN_NS
        trajectories.append(_told(line, begin_ns, frame, wrong[number], sigmas))
        rows, time_ns = _scan(line, begin_ns, ground, truth, scanner, rng, intensity, (lowest_m, highest_m))
        swaths.append(Swath(f"{number + 1:02d}", 0, number + 1, number, rows, time_ns, np.zeros((len(rows), 3))))
    head = Head("left", start, LineGeometry(), Noise(range_m=scanner.range_noise_m))
    return Flight(frame, (head,), tuple(trajectories), tuple(swaths)).placed({"left": start})


def retold(
    flight: Flight, lines: Sequence[Line], errors: FloatArray, sigmas: tuple[float, float] = (0.02, 5e-5)
) -> Flight:
    """Return the same flight with other trajectory errors (lines, 6) in its stated trajectory."""
    begins = [START_NS + number * BETWEEN_NS for number in range(len(lines))]
    told = [
        _told(line, begin, flight.frame, one, sigmas) for line, begin, one in zip(lines, begins, errors, strict=True)
    ]
    return replace(flight, trajectories=tuple(told)).placed(flight.starts())


def truth_of(flight: Flight, **true: float) -> Calibration:
    """Return the calibration that a flight was simulated with."""
    return flight.heads[0].start.changed(**true)


def _told(line: Line, begin_ns: int, frame: Tangent, wrong: FloatArray, sigmas: tuple[float, float]) -> Trajectory:
    seconds = np.arange(-0.5, line.length_m / line.speed_mps + 0.55, 0.1)
    position_t = _position(line, seconds) + wrong[:3]
    rot_t_from_b = _rot_t_from_b(line)
    turned = T_FROM_NED @ Rotation.from_rotvec(wrong[3:]).as_matrix() @ T_FROM_NED @ rot_t_from_b
    x, y, z, w = Rotation.from_matrix(frame.rot_t_from_e.T @ turned).as_quat()
    count = len(seconds)
    return Trajectory(
        begin_ns + np.round(seconds * 1e9).astype(np.int64),
        frame.e_from_t(position_t),
        np.tile([w, x, y, z], (count, 1)),
        np.full((count, 3), np.nan),
        np.full((count, 3), sigmas[0]),
        np.full((count, 3), sigmas[1]),
    )


def _position(line: Line, seconds: FloatArray) -> FloatArray:
    heading = np.radians(line.heading_deg)
    away = line.speed_mps * seconds
    east, north = line.x + away * np.sin(heading), line.y + away * np.cos(heading)
    return np.stack([east, north, np.full(len(seconds), line.height_m)], axis=1)


def _rot_t_from_b(line: Line) -> FloatArray:
    level: FloatArray = Rotation.from_euler("z", line.heading_deg, degrees=True).as_matrix()
    return T_FROM_NED @ level


def _scan(
    line: Line,
    begin_ns: int,
    ground: Surface,
    truth: Calibration,
    scanner: Scanner,
    rng: np.random.Generator,
    intensity: Surface | None,
    limits_m: tuple[float, float],
) -> tuple[StructArray, Int64Array]:
    count = int(line.length_m / line.speed_mps * scanner.prf_hz)
    seconds = np.arange(count) / scanner.prf_hz
    phase = (seconds * scanner.scan_hz + rng.uniform()) % 1.0
    theta = np.radians(scanner.half_angle_deg) * (4.0 * np.abs(phase - 0.5) - 1.0)
    value = truth.value
    angle = theta - value("scan_angle_offset_rad")
    beam_s = np.stack([np.zeros(count), np.sin(angle), np.cos(angle)], axis=1) @ truth.installation_matrix.T
    phi = value("phi_rad") + value("pitch_slope") * angle
    angles = np.stack([np.full(count, value("omega_rad")), phi, np.full(count, value("kappa_rad"))], axis=1)
    beam_t = Rotation.from_euler("XYZ", angles).apply(beam_s) @ _rot_t_from_b(line).T
    from_t = _position(line, seconds)
    range_m = _met(from_t, beam_t, ground, limits_m)
    rows = np.zeros(count, RETURN_DTYPE)
    rows["range_m"] = range_m - value("range_offset_m") + rng.normal(0.0, scanner.range_noise_m, count)
    rows["encoder_rad"] = theta
    rows["return_number"] = rows["number_of_returns"] = 1
    rows["pulse_id"] = np.arange(count)
    if intensity is not None:
        points = from_t + range_m[:, np.newaxis] * beam_t
        rows["intensity"] = intensity(points[:, 0], points[:, 1])
    return rows, begin_ns + np.round(seconds * 1e9).astype(np.int64)


def _met(from_t: FloatArray, beam_t: FloatArray, ground: Surface, limits_m: tuple[float, float]) -> FloatArray:
    """Return where beams meet the ground, m along the beam: marched down between two heights, then bisected."""
    low_m, high_m = limits_m

    def above(distance: FloatArray) -> FloatArray:
        points = from_t + distance[:, np.newaxis] * beam_t
        height: FloatArray = points[:, 2] - ground(points[:, 0], points[:, 1])
        return height

    near = (high_m - from_t[:, 2]) / beam_t[:, 2]
    step = (low_m - high_m) / beam_t[:, 2] / STEPS
    found = np.zeros(len(near), np.bool_)
    for _ in range(STEPS):
        met = ~found & (above(near + step) <= 0.0)
        found |= met
        near = np.where(found, near, near + step)
        if found.all():
            break
    far = near + step
    for _ in range(20):
        middle = 0.5 * (near + far)
        under = above(middle) <= 0.0
        far, near = np.where(under, middle, far), np.where(under, near, middle)
    return 0.5 * (near + far)


def only(flight: Flight, keep: Callable[[FloatArray], BoolArray]) -> Flight:
    """Keep only the returns whose points (n, 3) are wanted."""
    swaths = []
    for swath in flight.swaths:
        at = np.flatnonzero(keep(swath.points_t))
        swaths.append(replace(swath, rows=swath.rows[at], time_ns=swath.time_ns[at], points_t=swath.points_t[at]))
    return replace(flight, swaths=tuple(swaths))
