"""Makes straight strips over a scene of the virtual aircraft, without a log, with their truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from swath.calib.flight import Flight, Head, Swath, Tangent
from swath.georef.arrays import BoolArray, ByteArray, FloatArray, Int64Array, StructArray
from swath.georef.records import RETURN_DTYPE
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import Calibration, nominal
from swath.georef.scanner.uncertainty import Noise
from swath.georef.trajectory.trajectory import Trajectory
from swath.sim.plan.plan import parse_plan
from swath.sim.scene.scene import Scene, build_scene
from swath.sim.shots import CAR, ROOF, WALL
from swath.sim.site import Site, geodetic_from_e, rot_e_from_ned

Line = tuple[float, float, float, float, float]
"""East and north from, east and north to, height."""

ORIGIN_DEG = (47.182, 9.005)
START_NS = 1_479_297_618_000_000_000
LINES: tuple[Line, ...] = (
    (-260, 0, 260, 0, 850),
    (260, 60, -260, 60, 850),
    (0, 260, 0, -260, 850),
    (120, -260, 120, 260, 850),
)
VILLAGE = """
height_m = 450.0
relief_m = 8.0
wavelength_m = 700.0
[[terrain.village]]
center_m = [0.0, 0.0]
size_m = [260.0, 240.0]
heading_deg = 25.0
houses = 40
"""
TRUE = {"omega_rad": 0.00436, "phi_rad": -0.00698, "kappa_rad": 0.01047, "range_offset_m": 0.12}
SPEED_MPS, HALF_ANGLE_RAD, SCAN_HZ, POSE_S = 50.0, np.radians(30.0), 50.0, 0.01


@dataclass(frozen=True, eq=False)
class Cast:
    """Flight over a scene with its truth.

    Attributes:
        flight: the flight, placed with the nominal calibration.
        truth: the true calibration.
        scene: the scene that was scanned.
        surface: for each swath (n,) kind of surface as in `swath.sim.shots`, one row per return.
        true_t: for each swath (n, 3), m, in t, without noise.
        planes: (p, 5) normal_t, its product with points of the plane in t, surface: all roofs, walls and cars' sides.
    """

    flight: Flight
    truth: Calibration
    scene: Scene
    surface: tuple[ByteArray, ...]
    true_t: tuple[FloatArray, ...]
    planes: FloatArray

    def at_truth(self) -> Flight:
        """Return the flight with its points placed by the true calibration."""
        return self.flight.placed({"left": self.truth})

    def faces(self, swath: int, at: Int64Array, within_m: float = 1e-3) -> BoolArray:
        """Return (k, planes) True where a true point lies on a plane of the scene."""
        distance = self.true_t[swath][at] @ self.planes[:, :3].T - self.planes[:, 3]
        on: BoolArray = np.abs(distance) < within_m
        return on


def cast_flight(
    terrain: str = VILLAGE,
    lines: Sequence[Line] = LINES,
    *,
    prf_hz: float = 60_000.0,
    true: dict[str, float] | None = None,
    seed: int = 1,
    range_sigma_m: float = 0.02,
    angle_sigma_rad: float = 2e-5,
    half_angle_rad: float = HALF_ANGLE_RAD,
    speed_mps: float = SPEED_MPS,
) -> Cast:
    """Fly lines with gusts over a terrain (keys of the plan's ``[terrain]``).

    Args:
        terrain: keys and tables of ``[terrain]``.
        lines: the lines to be flown.
        prf_hz: pulse rate.
        true: true parameters by names of `swath.georef.scanner.calibration.PARAMETERS`; None: `TRUE`.
        seed: determines noise and gusts.
        range_sigma_m, angle_sigma_rad: noise of a return.
        half_angle_rad: half of the scan's width.
        speed_mps: speed over the ground.
    """
    draws = np.random.default_rng(seed)
    plan = parse_plan(_plan(terrain, lines), Path())
    site = Site.at(*ORIGIN_DEG)
    corners = _corners(lines, half_angle_rad)
    scene = build_scene(plan, site, corners)
    truth = nominal("left", np.zeros(3), np.eye(3)).changed(**(TRUE if true is None else true))
    tracks = [_track(line, site, index, draws, speed_mps) for index, line in enumerate(lines)]
    time_ns, *columns = (np.concatenate(parts) for parts in zip(*tracks, strict=True))
    trajectory = Trajectory(time_ns, columns[0], columns[1], columns[2], columns[3], columns[4])
    frame = Tangent.at(site.e_from_site(np.zeros((1, 3)))[0])
    head = Head("left", nominal("left", np.zeros(3), np.eye(3)), LineGeometry(), Noise(range_sigma_m, angle_sigma_rad))
    swaths, surfaces, points = [], [], []
    for index, track in enumerate(tracks):
        rows, time_ns, surface, true_e = _shoot(scene, track, truth, prf_hz, half_angle_rad)
        rows["range_m"] += range_sigma_m * draws.standard_normal(len(rows))
        rows["encoder_rad"] += angle_sigma_rad * draws.standard_normal(len(rows))
        swaths.append(Swath(f"{index:02d}", 0, index, 0, rows, time_ns, np.zeros((len(rows), 3))))
        surfaces.append(surface)
        points.append(frame.t_from_e(true_e))
    flight = Flight(frame, (head,), (trajectory,), tuple(swaths)).placed({"left": head.start})
    return Cast(flight, truth, scene, tuple(surfaces), tuple(points), _planes(scene, site, frame))


def _plan(terrain: str, lines: Sequence[Line]) -> str:
    text = f'[flight]\nname = "cast"\norigin_deg = {list(ORIGIN_DEG)}\n[terrain]\n{terrain}\n'
    text += "[gnss.rover]\n[imu.main]\n[scanner.left]\nrange_max_m = 2000.0\ndivergence_mrad = 0.3\n"
    for index, (x0, y0, x1, y1, height) in enumerate(lines):
        text += f'[[line]]\nname = "{index}"\nfrom_m = [{x0}, {y0}]\nto_m = [{x1}, {y1}]\nheight_m = {height}\n'
    return text


def _corners(lines: Sequence[Line], half_angle_rad: float) -> FloatArray:
    """Return the corners of the area of all lines, widened by the scanner's range."""
    ends = np.array([[line[0:2], line[2:4]] for line in lines]).reshape(-1, 2)
    reach = 1.1 * np.tan(half_angle_rad) * max(line[4] - 380.0 for line in lines)
    low, high = ends.min(axis=0) - reach, ends.max(axis=0) + reach
    return np.array([low, [high[0], low[1]], high, [low[0], high[1]]])


def _track(
    line: Line, site: Site, index: int, draws: np.random.Generator, speed_mps: float
) -> tuple[NDArray[Any], ...]:
    """Return the columns of a trajectory along a line, with slow gusts."""
    begin, end = np.array(line[:2]), np.array(line[2:4])
    length = float(np.linalg.norm(end - begin))
    second = np.arange(0.0, length / speed_mps, POSE_S)
    place = begin + (end - begin) * (speed_mps / length) * second[:, np.newaxis]
    place_site = site.site_from_ground(place[:, 0], place[:, 1], line[4] + 2.0 * np.sin(0.4 * second))
    position_e = site.e_from_site(place_site)
    lat, lon, _ = geodetic_from_e(position_e)
    heading = np.arctan2(*(end - begin))
    sway = [
        np.radians(size) * np.sin(rate * second + phase)
        for size, rate, phase in zip((1.5, 1.0, 1.0), (0.9, 0.7, 0.5), draws.uniform(0, 6.28, 3), strict=True)
    ]
    angles = np.stack([heading + sway[2], 0.02 + sway[1], sway[0]], axis=1)
    rot_e_from_b = rot_e_from_ned(lat, lon) @ Rotation.from_euler("ZYX", angles).as_matrix()
    q = Rotation.from_matrix(rot_e_from_b).as_quat()[:, [3, 0, 1, 2]]
    q[1:] *= np.cumprod(np.sign((q[1:] * q[:-1]).sum(axis=1)))[:, np.newaxis]
    time_ns = START_NS + index * 100_000_000_000 + np.rint(1e9 * second).astype(np.int64)
    velocity_e = np.gradient(position_e, POSE_S, axis=0)
    sigmas = np.full(position_e.shape, 0.02), np.full(position_e.shape, np.radians(0.003))
    return time_ns, position_e, q, velocity_e, *sigmas


def _shoot(
    scene: Scene,
    track: tuple[NDArray[Any], ...],
    truth: Calibration,
    prf_hz: float,
    half_angle_rad: float,
) -> tuple[StructArray, Int64Array, ByteArray, FloatArray]:
    """Return rows, times, surfaces, and points (n, 3), m, in e, of all pulses along a track swept by a polygon."""
    time_ns, position_e, q = track[0].astype(np.int64), track[1], track[2]
    span_s = 1e-9 * float(time_ns[-1] - time_ns[0])
    second = np.arange(0.0, span_s - POSE_S, 1.0 / prf_hz)
    angle = half_angle_rad * (2.0 * (SCAN_HZ * second % 1.0) - 1.0)
    at = np.minimum((second / POSE_S).astype(np.int64), len(position_e) - 2)
    share = (second / POSE_S - at)[:, np.newaxis]
    place_e = position_e[at] + share * (position_e[at + 1] - position_e[at])
    turn = Rotation.from_quat(q[:, [1, 2, 3, 0]])
    turned = turn[at] * Rotation.from_rotvec(share * (turn[at].inv() * turn[at + 1]).as_rotvec())
    angles = [truth.value(name) for name in ("omega_rad", "phi_rad", "kappa_rad")]
    beam_s = np.stack([np.zeros(len(angle)), np.sin(angle), np.cos(angle)], axis=1)
    beam_e = turned.apply(Rotation.from_euler("XYZ", angles).apply(beam_s))
    site = scene.site
    echoes = scene.cast(
        site.site_from_e(place_e), beam_e @ site.rot_site_from_e.T, second, np.arange(len(angle)), 3e-4, 0.6, 4
    )
    pulse, slot = np.nonzero(np.isfinite(echoes.range_m))
    rows = np.zeros(len(pulse), RETURN_DTYPE)
    true_range = echoes.range_m[pulse, slot]
    rows["range_m"], rows["encoder_rad"] = true_range - truth.value("range_offset_m"), angle[pulse]
    rows["return_number"] = slot + 1
    rows["number_of_returns"] = np.isfinite(echoes.range_m).sum(axis=1)[pulse]
    rows["pulse_id"], rows["intensity"] = pulse, 1000.0 * echoes.reflectance[pulse, slot]
    points_e = place_e[pulse] + true_range[:, np.newaxis] * beam_e[pulse]
    stamps = time_ns[0] + np.rint(1e9 * second[pulse]).astype(np.int64)
    return rows, stamps, echoes.surface[pulse, slot], points_e


def _planes(scene: Scene, site: Site, frame: Tangent) -> FloatArray:
    """Return the planes of all solids, in t."""
    table = scene.arrays.rows
    table = table[: 6 * (len(table) // 6)].reshape(-1, 6)
    real = np.isin(table[:, 4], (ROOF, WALL, CAR)) & (np.abs(np.linalg.norm(table[:, :3], axis=1) - 1.0) < 1e-9)
    table = table[: len(table) if real.all() else int(np.argmin(real))]
    normal_t = table[:, :3] @ site.rot_site_from_e @ frame.rot_t_from_e.T
    on_it = frame.t_from_e(site.e_from_site(table[:, :3] * table[:, 3:4]))
    return np.column_stack([normal_t, (normal_t * on_it).sum(axis=1), table[:, 4]])
