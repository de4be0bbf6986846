"""Makes a flight by hand: straight lines over inclined planes, with ranges by intersection.

Its points are computed with SciPy's rotations from the formulas of the conventions, not with georef.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from swath.calib.features import Features, Patch, Plane
from swath.calib.flight import Flight, Head, Swath, Tangent
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.records import RETURN_DTYPE
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import PARAMETERS, Calibration, nominal
from swath.georef.scanner.uncertainty import Noise
from swath.georef.trajectory.trajectory import Trajectory

START_NS = 1_479_297_618_000_000_000
SPEED = 60.0
GROUND_M = 400.0
LINE_S = 12.0
NOISE = Noise(range_m=0.02, angle_rad=np.radians(0.001), time_s=0.0, divergence_rad=0.0)


def exactly_known(calibration: Calibration) -> Calibration:
    """Return a start whose parameters count as measured, so that held ones add nothing to any sigma."""
    held = 1e-9 * np.array([parameter.plausible for parameter in PARAMETERS])
    return replace(calibration, method="control", held_sigmas=held)


@dataclass(frozen=True)
class Line:
    """A line: heading (deg), height above ground (m), and distance to the right of the middle (m)."""

    heading_deg: float
    height_m: float = 800.0
    aside_m: float = 0.0


LINES = (
    Line(0),
    Line(180),
    Line(0, 800, 250),
    Line(0, 800, -250),
    Line(90),
    Line(270),
    Line(0, 1500),
    Line(90, 1500),
)


def roofs(slope_deg: float = 35.0) -> list[tuple[FloatArray, FloatArray]]:
    """Return 25 centres and normals in t: roofs of four aspects, and flat ones."""
    planes = []
    for index, (east, north) in enumerate((e, n) for n in np.linspace(-250, 250, 5) for e in np.linspace(-250, 250, 5)):
        slope = np.radians(slope_deg if index % 5 else 0.0)
        aspect = (index % 4) * np.pi / 2 + 0.3
        normal = np.array([np.sin(slope) * np.cos(aspect), np.sin(slope) * np.sin(aspect), np.cos(slope)])
        planes.append((np.array([east, north, GROUND_M]), normal))
    return planes


@dataclass(frozen=True, eq=False)
class Made:
    """Flight with its features.

    Attributes:
        flight: points placed with the head's start calibration.
        features: planes, with every return's index.
        truth: the scanner's true calibration.
    """

    flight: Flight
    features: Features
    truth: Calibration


def frame() -> Tangent:
    """Return the frame of all flights."""
    return Tangent.at(np.asarray(e_from_geodetic(np.radians(47.2), np.radians(9.0), 450.0)))


def trajectory(lines: Sequence[Line] = LINES, swing_deg: float = 1.0) -> Trajectory:
    """Return lines flown one after the other with gaps between them, at 100 Hz, with rolls and pitches."""
    at, times, positions, quaternions = frame(), [], [], []
    own = np.arange(0.0, LINE_S, 0.01)
    for index, line in enumerate(lines):
        heading = np.radians(line.heading_deg)
        along = np.array([np.sin(heading), np.cos(heading), 0.0])
        right = np.array([np.cos(heading), -np.sin(heading), 0.0])
        middle = right * line.aside_m + [0.0, 0.0, GROUND_M + line.height_m]
        points_t = middle + np.outer((own - LINE_S / 2) * SPEED, along)
        roll = np.radians(swing_deg) * np.sin(own * 2.1 + index)
        pitch = np.radians(swing_deg) * np.cos(own * 1.3 + 2.0 * index)
        times.append(START_NS + index * 60_000_000_000 + np.rint(own * 1e9).astype(np.int64))
        positions.append(at.e_from_t(points_t))
        turned = Rotation.from_euler("ZYX", np.stack([np.full(len(own), heading), pitch, roll], axis=1))
        rot_t_from_ned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
        whole = Rotation.from_matrix(at.rot_t_from_e.T @ rot_t_from_ned @ turned.as_matrix())
        quaternions.append(whole.as_quat()[:, [3, 0, 1, 2]])
    count = sum(len(one) for one in times)
    attitude = np.concatenate(quaternions)
    flips = np.cumprod(np.where((attitude[1:] * attitude[:-1]).sum(axis=1) < 0.0, -1.0, 1.0))
    attitude[1:] *= flips[:, np.newaxis]
    return Trajectory(
        np.concatenate(times),
        np.concatenate(positions),
        attitude,
        np.full((count, 3), np.nan),
        np.tile([0.03, 0.03, 0.05], (count, 1)),
        np.radians(np.tile([0.003, 0.003, 0.007], (count, 1))),
    )


def aimed(
    flown: Trajectory, lines: Sequence[Line], planes: Sequence[tuple[FloatArray, FloatArray]], points: int, seed: int
) -> list[tuple[Int64Array, FloatArray, Int64Array]]:
    """Return for each line times (ns), encoder readings (rad) and planes of returns near the planes' centres.

    The returns are in order of time.
    """
    g, swaths = np.random.default_rng(seed), []
    for index, line in enumerate(lines):
        heading = np.radians(line.heading_deg)
        along = np.array([np.sin(heading), np.cos(heading), 0.0])
        right = np.array([np.cos(heading), -np.sin(heading), 0.0])
        columns: list[tuple[FloatArray, FloatArray, Int64Array]] = []
        for plane, (centre, _) in enumerate(planes):
            target = centre + np.column_stack([g.uniform(-6, 6, (points, 2)), np.zeros(points)])
            own = (target @ along) / SPEED + LINE_S / 2
            angle = np.arctan2(target @ right - line.aside_m, line.height_m)
            seen = (np.abs(angle) < np.radians(30)) & (own > 0.1) & (own < LINE_S - 0.1)
            columns.append((own[seen], angle[seen], np.full(int(seen.sum()), plane)))
        own, angle, plane_of = (np.concatenate(one) for one in zip(*columns, strict=True))
        order = np.argsort(own)
        times = START_NS + index * 60_000_000_000 + np.rint(own[order] * 1e9).astype(np.int64)
        swaths.append((times, angle[order], plane_of[order]))
    return swaths


def ranges(
    true: Trajectory,
    truth: Calibration,
    planes: Sequence[tuple[FloatArray, FloatArray]],
    time_ns: Int64Array,
    encoder_rad: FloatArray,
    plane: Int64Array,
    intensity: FloatArray | None = None,
) -> FloatArray:
    """Return (n,) ranges, m, that a scanner measures to the planes (ISO/TS 19159-2 Eq. 10, 14 solved for ρ)."""
    value, at = truth.value, frame()
    times = time_ns + round(value("time_offset_s") * 1e9)
    where = true.poses(times)
    latency = true.poses(times + round(value("imu_latency_s") * 1e9))
    rot_e_from_b = Rotation.from_quat(latency.q_e_from_b[:, [1, 2, 3, 0]]).as_matrix()
    theta = (1.0 + value("scan_angle_scale")) * (encoder_rad - value("scan_angle_offset_rad"))
    eta = value("scan_plane_tilt_rad")
    u_s = np.stack(
        [np.full(len(theta), -np.sin(eta)), np.sin(theta) * np.cos(eta), np.cos(theta) * np.cos(eta)], axis=1
    )
    angles = np.stack(
        [np.full(len(theta), value("omega_rad")), value("phi_rad") + value("pitch_slope") * theta,
         np.full(len(theta), value("kappa_rad"))], axis=1)  # fmt: skip
    u_b = np.einsum("nij,nj->ni", Rotation.from_euler("XYZ", angles).as_matrix(), u_s @ truth.installation_matrix.T)
    origin_t = at.t_from_e(where.position_e + rot_e_from_b @ truth.lever_arm_b)
    u_t = np.einsum("nij,nj->ni", rot_e_from_b, u_b) @ at.rot_t_from_e.T
    centre = np.array([one[0] for one in planes])[plane]
    normal = np.array([one[1] for one in planes])[plane]
    rho = ((centre - origin_t) * normal).sum(axis=1) / (u_t * normal).sum(axis=1)
    more = np.full(len(theta), value("range_offset_m"))
    if truth.ibrc is not None and intensity is not None:
        more -= np.interp(intensity, *truth.ibrc)
    measured: FloatArray = (rho - more) / (1.0 + value("range_scale"))
    return measured


def made(
    *,
    truth: dict[str, float] | None = None,
    lines: Sequence[Line] = LINES,
    planes: Sequence[tuple[FloatArray, FloatArray]] | None = None,
    points: int = 12,
    seed: int = 3,
    noise: float = 1.0,
    true: Trajectory | None = None,
    ibrc: tuple[FloatArray, FloatArray] | None = None,
) -> Made:
    """Fly the lines over the planes.

    Args:
        truth: true parameters of the scanner, SI; None: a boresight and a range offset.
        lines, planes: lines flown, and planes below them; None: `roofs`.
        points: number of beams aimed at each plane from each line.
        seed: determines aims and noise.
        noise: factor of `NOISE`.
        true: the aircraft's true trajectory; None: the one that it states.
        ibrc: table of the scanner's range corrections by intensity.
    """
    planes = roofs() if planes is None else planes
    flown = trajectory(lines)
    g = np.random.default_rng(seed + 1000)
    wanted = {"omega_rad": 0.0037, "phi_rad": -0.0061, "kappa_rad": 0.0021, "range_offset_m": 0.18}
    start = exactly_known(nominal("left", (0.15, -0.08, 0.42), np.eye(3)))
    right = replace(start.changed(**(wanted if truth is None else truth)), ibrc=ibrc)
    swaths: list[Swath] = []
    patches: list[list[Patch]] = [[] for _ in planes]
    for index, (time_ns, encoder, plane) in enumerate(aimed(flown, lines, planes, points, seed)):
        rows = np.zeros(len(time_ns), RETURN_DTYPE)
        rows["return_number"] = rows["number_of_returns"] = 1
        rows["intensity"] = g.uniform(0.0, 100.0, len(rows))
        shaken = encoder + noise * NOISE.angle_rad * g.normal(size=len(rows))
        rows["range_m"] = ranges(true or flown, right, planes, time_ns, shaken, plane, rows["intensity"])
        rows["range_m"] += noise * NOISE.range_m * g.normal(size=len(rows))
        rows["encoder_rad"] = encoder
        swaths.append(Swath(f"{index:02}", 0, index + 1, 0, rows, time_ns, np.zeros((len(rows), 3))))
        for which in range(len(planes)):
            at = np.flatnonzero(plane == which)
            if len(at):
                patches[which].append(Patch(index, at))
    head = Head("left", start, LineGeometry(), NOISE)
    flight = Flight(frame(), (head,), (flown,), tuple(swaths)).placed({"left": start})
    found = tuple(
        Plane(f"{index}", centre, normal, tuple(mine))
        for index, ((centre, normal), mine) in enumerate(zip(planes, patches, strict=True))
        if mine
    )
    return Made(flight, Features(found), right)
