"""Makes the worked adjustment of FORMULAS 6.5: 25 planes, 8 lines, 1522 points, each with its own pose.

The random draws are repeated in the same order; the geometry is written independently, for all points at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from swath.calib.features import Features, Patch, Plane
from swath.calib.flight import Flight, Head, Swath
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.records import RETURN_DTYPE
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import nominal
from swath.georef.scanner.uncertainty import Noise
from swath.georef.trajectory.trajectory import Trajectory
from tests.calib.roofs import START_NS, exactly_known, frame

ARM = np.array([0.15, -0.08, 0.42])
SIGMAS = np.array([0.03, 0.03, 0.05, *np.radians([0.003, 0.003, 0.007]), 0.02, np.radians(0.001)])
LINES = [(0, 800, 0), (np.pi, 800, 0), (0, 800, 250), (0, 800, -250), (np.pi / 2, 800, 0), (3 * np.pi / 2, 800, 0)]
LINES += [(0, 1500, 0), (np.pi / 2, 1500, 0)]
TRUTH = (np.radians(0.21), np.radians(-0.35), np.radians(0.12), 0.18)
ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def planes_ned() -> list[tuple[FloatArray, FloatArray]]:
    """Return the planes' centres and normals, north, east, down."""
    found, grid = [], np.linspace(-250, 250, 5)
    for index, (north, east) in enumerate((n, e) for n in grid for e in grid):
        aspect, slope = index % 4 * np.pi / 2 + 0.3, np.radians(35)
        leaning = np.array([np.sin(slope) * np.cos(aspect), np.sin(slope) * np.sin(aspect), -np.cos(slope)])
        found.append((np.array([north, east, 0.0]), leaning if index % 5 else np.array([0.0, 0.0, -1.0])))
    return found


def _shot(
    line: tuple[float, float, float], roll: float, pitch: float, target: FloatArray, normal: FloatArray
) -> FloatArray | None:
    """Return position (3), roll, pitch, heading, range, angle of a beam that meets a plane close to a target.

    None means that the target is outside the scan.
    """
    heading, height, aside = line
    along = np.array([np.cos(heading), np.sin(heading), 0.0])
    across = np.array([-np.sin(heading), np.cos(heading), 0.0])
    rot_n_from_b = Rotation.from_euler("ZYX", [heading, pitch, roll]).as_matrix()
    omega, phi, kappa, offset = TRUTH
    rot = rot_n_from_b @ Rotation.from_euler("XYZ", [omega, phi, kappa]).as_matrix()
    at = along * (target @ along) + across * aside
    at[2] = -height
    angle, way = float(np.arctan2(target @ across - aside, height)), 0.0
    for _ in range(12):
        start = at + along * way + rot_n_from_b @ ARM
        beam = rot @ np.array([0.0, np.sin(angle), np.cos(angle)])
        body, length = at + along * way, float(normal @ (target - start) / (normal @ beam))
        miss = start + length * beam - target
        way -= float(miss @ along)
        angle -= float(miss @ across) * np.cos(angle) ** 2 / height
    if abs(angle) > np.radians(30):
        return None
    return np.array([*body, roll, pitch, heading, length - offset, angle])


@dataclass(frozen=True, eq=False)
class Printed:
    """Observations (n, 8) as measured: position, roll, pitch, heading, range, angle; planes and lines (n,)."""

    observed: FloatArray
    plane: Int64Array
    line: Int64Array

    def flight(self) -> tuple[Flight, Features]:
        """Return a flight with an epoch of the trajectory for each return and a swath for each line."""
        at, count = frame(), len(self.observed)
        times = START_NS + 1_000_000 * np.arange(count + 1)
        position_t = self.observed[:, :3] @ ENU_FROM_NED.T
        rot = Rotation.from_euler("ZYX", self.observed[:, [5, 4, 3]]).as_matrix()
        q = Rotation.from_matrix(at.rot_t_from_e.T @ ENU_FROM_NED @ rot).as_quat()[:, [3, 0, 1, 2]]
        more = np.concatenate([np.arange(count), [count - 1]])
        sigmas = np.tile(SIGMAS[:6], (count + 1, 1))
        flown = Trajectory(
            times,
            at.e_from_t(position_t)[more],
            q[more],
            np.full((count + 1, 3), np.nan),
            sigmas[:, :3].copy(),
            sigmas[:, 3:].copy(),
        )
        rows = np.zeros(count, RETURN_DTYPE)
        rows["range_m"], rows["encoder_rad"] = self.observed[:, 6], self.observed[:, 7]
        swaths, planes = [], planes_ned()
        patches: list[list[Patch]] = [[] for _ in planes]
        for line in range(len(LINES)):
            mine = np.flatnonzero(self.line == line)
            swaths.append(Swath(f"{line}", 0, line + 1, 0, rows[mine], times[mine], np.zeros((len(mine), 3))))
            for index in range(len(planes)):
                on = np.flatnonzero(self.plane[mine] == index)
                if len(on):
                    patches[index].append(Patch(line, on))
        head = Head(
            "left",
            exactly_known(nominal("left", ARM, np.eye(3))),
            LineGeometry(),
            Noise(0.02, float(SIGMAS[7]), 0.0, 0.0),
        )
        found = tuple(
            Plane(f"{index}", ENU_FROM_NED @ centre, ENU_FROM_NED @ normal, tuple(patches[index]))
            for index, (centre, normal) in enumerate(planes)
        )
        flight = Flight(at, (head,), (flown,), tuple(swaths))
        return flight.placed({"left": head.start}), Features(found)

    def with_blunder(self) -> Printed:
        """Add a blunder of 0.6 m to the range of point 137."""
        observed = self.observed.copy()
        observed[137, 6] += 0.6
        return replace(self, observed=observed)


def printed() -> Printed:
    """Return all observations of the printed example."""
    aims, noise = np.random.default_rng(11), np.random.default_rng(5)
    shots, plane_of, line_of = [], [], []
    for index, (centre, normal) in enumerate(planes_ned()):
        first = np.cross(normal, [1.0, 0.0, 0.0])
        first /= np.linalg.norm(first)
        second = np.cross(normal, first)
        for number, line in enumerate(LINES):
            for _ in range(8):
                target = centre + first * aims.uniform(-6, 6) + second * aims.uniform(-6, 6)
                roll, pitch = aims.normal(0, np.radians(1)), aims.normal(0, np.radians(1))
                shot = _shot(line, roll, pitch, target, normal)
                if shot is not None:
                    shots.append(shot)
                    plane_of.append(index)
                    line_of.append(number)
    exact = np.array(shots)
    return Printed(exact + noise.normal(size=exact.shape) * SIGMAS, np.array(plane_of), np.array(line_of))
