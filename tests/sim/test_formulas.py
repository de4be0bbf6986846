"""Tests the virtual aircraft's chain from beam to ground by the formula sheet (FORMULAS 2.1 and 5.2).

The derivatives of 5.2 come from differences of the whole chain, whose step is far above rounding, and so small that
curvature does not show in the digits compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from swath.georef.arrays import FloatArray
from swath.sim.flight.trajectory import Poses
from swath.sim.plan.tables import ParameterTable, ScannerTable
from swath.sim.scanners.mirrors import swung_mirror
from swath.sim.scanners.mounting import Mounting
from swath.sim.shots import Pulses
from swath.sim.site import Site, e_from_geodetic, geodetic_from_e, rot_e_from_ned

pytestmark = pytest.mark.xdist_group("kernels")  # the loops that cast rays are compiled once, by one worker


LAT_DEG, LON_DEG, HEIGHT_M = 47.1234567, 8.7, 1512.3
LEVER_ARM_B = (0.15, -0.08, 0.42)
RANGE_M, ANGLE_DEG = 1043.217, 17.5
CABLES_TO_THE_REAR = [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]
SITE = Site.at(LAT_DEG, LON_DEG)
Three = tuple[float, float, float]


def radians(first_deg: float, second_deg: float, third_deg: float) -> Three:
    """Convert three angles to radians."""
    return float(np.radians(first_deg)), float(np.radians(second_deg)), float(np.radians(third_deg))


ATTITUDE = radians(3.0, -2.0, 75.0)
ANGLE = float(np.radians(ANGLE_DEG))


@dataclass(frozen=True)
class Shot:
    """One pulse and everything that it depends on; angles in radians."""

    boresight: Three
    range_m: float = RANGE_M
    angle: float = ANGLE
    tilt: float = 0.0
    attitude: Three = ATTITUDE
    moved_l: Three = (0.0, 0.0, 0.0)

    def ground_e(self) -> FloatArray:
        """Return the ground point (3,), computed with `Mounting`."""
        omega, phi, kappa = np.degrees(self.boresight).tolist()
        x, y, z = LEVER_ARM_B
        true = ParameterTable(
            omega_deg=omega, phi_deg=phi, kappa_deg=kappa, lever_arm_x_m=x, lever_arm_y_m=y, lever_arm_z_m=z
        )
        mounting = Mounting(ScannerTable(true=true, installation=CABLES_TO_THE_REAR))
        rot_e_from_l = rot_e_from_ned(np.radians([LAT_DEG]), np.radians([LON_DEG]))
        roll, pitch, heading = self.attitude
        rot_l_from_b = Rotation.from_euler("ZYX", [heading, pitch, roll]).as_matrix()
        position = e_from_geodetic(np.radians([LAT_DEG]), np.radians([LON_DEG]), np.array([HEIGHT_M]))
        poses = Poses(position + rot_e_from_l @ np.array(self.moved_l), rot_e_from_l @ rot_l_from_b)
        beams = mounting.beams(self.pulse(), poses, SITE)
        ground: FloatArray = SITE.e_from_site(beams.origin + self.range_m * beams.direction)[0]
        return ground

    def pulse(self) -> Pulses:
        """Return the pulse after its reflection by the mirror."""
        one = np.zeros(1)
        direction = swung_mirror(np.array([self.angle]), 0.0, self.tilt)
        whole = np.zeros(1, np.int64)
        return Pulses(whole, one, whole, np.zeros(1, np.uint16), np.zeros((1, 3)), direction, one)


def test_ground_point_matches_formula_sheet_2_1() -> None:
    shot = Shot(radians(0.21, -0.35, 0.12))
    np.testing.assert_allclose(
        shot.ground_e(), [4297745.87263879, 657512.472772624, 4651743.38727272], rtol=0, atol=2e-8
    )
    lat, lon, height = geodetic_from_e(shot.ground_e()[np.newaxis])
    np.testing.assert_allclose(np.degrees([lat[0], lon[0]]), [47.126571079624, 8.6982406228339], rtol=0, atol=1e-12)
    np.testing.assert_allclose(height, 536.88193774557, rtol=0, atol=2e-8)


# Section 5.2: Δρ = 0.12 m, s_ρ = 2e-5, Δθ = 0.02°, s_θ = 3e-4, Δη = 0.01°; ρ' and θ' are the model's
RANGE_SCALE, ANGLE_SCALE = 1 + 2e-5, 1 + 3e-4
AT = Shot(
    boresight=radians(0.05, -0.08, 0.03),
    range_m=RANGE_SCALE * (RANGE_M + 0.12),
    angle=ANGLE_SCALE * float(np.radians(ANGLE_DEG + 0.02)),
    tilt=float(np.radians(0.01)),
)
VELOCITY_L = np.array([58.0, -7.0, 0.6])
RATES = np.radians([2.0, -1.1, 0.7])
ANGLE_RATE = float(np.radians(4200.0))


def turned(part: Three, number: int, by: float) -> Three:
    """Return the shot with one of three angles changed."""
    values = list(part)
    values[number] += by
    return values[0], values[1], values[2]


def later(shot: Shot, by: float, *, moving: bool) -> Shot:
    """Return the shot with its attitude, and if `moving` its position, at a time later by `by` seconds."""
    roll, pitch, heading = (np.array(shot.attitude) + by * RATES).tolist()
    north, east, down = (by * VELOCITY_L).tolist() if moving else (0.0, 0.0, 0.0)
    return replace(shot, attitude=(roll, pitch, heading), moved_l=(north, east, down))


CHANGED: dict[str, Callable[[float], Shot]] = {
    "omega": lambda by: replace(AT, boresight=turned(AT.boresight, 0, by)),
    "phi": lambda by: replace(AT, boresight=turned(AT.boresight, 1, by)),
    "kappa": lambda by: replace(AT, boresight=turned(AT.boresight, 2, by)),
    "range": lambda by: replace(AT, range_m=AT.range_m + RANGE_SCALE * by),
    "angle": lambda by: replace(AT, angle=AT.angle + ANGLE_SCALE * by),
    "tilt": lambda by: replace(AT, tilt=AT.tilt + by),
    "roll": lambda by: replace(AT, attitude=turned(AT.attitude, 0, by)),
    "pitch": lambda by: replace(AT, attitude=turned(AT.attitude, 1, by)),
    "yaw": lambda by: replace(AT, attitude=turned(AT.attitude, 2, by)),
    "time": lambda by: later(AT, by, moving=True),
    "imu_latency": lambda by: later(AT, by, moving=False),
    "encoder_latency": lambda by: replace(AT, angle=AT.angle + ANGLE_RATE * by),
}
COLUMNS = {  # north, east, down: metres a radian, a metre or a second
    "omega": (946.831323, -240.454502, -366.451401),
    "phi": (257.393935, 960.392912, 35.762995),
    "kappa": (80.950827, 303.359701, 11.421014),
    "range": (0.330753947, -0.123485701, 0.935624448),
    "angle": (947.36404, -239.600132, -366.526961),
    "tilt": (269.35039, 1007.28487, 37.725152),
    "roll": (947.233332, -240.55854, -366.553211),
    "pitch": (252.760563, 943.315265, 34.99646),
    "yaw": (128.732765, 345.22128, 0.0),
    "time": (87.784794, -29.289757, -12.867005),
    "imu_latency": (29.784794, -22.289757, -13.467005),
    "encoder_latency": (69424.5838, -17558.3395, -26859.7716),
}


@pytest.mark.parametrize("name", COLUMNS)
def test_derivatives_match_formula_sheet_5_2(name: str) -> None:
    step = {"range": 1.0, "encoder_latency": 1e-6, "time": 1e-2, "imu_latency": 1e-2}.get(name, 1e-4)
    difference = (CHANGED[name](step).ground_e() - CHANGED[name](-step).ground_e()) / (2 * step)
    to_ned = rot_e_from_ned(np.radians([LAT_DEG]), np.radians([LON_DEG]))[0].T
    np.testing.assert_allclose(to_ned @ difference, COLUMNS[name], rtol=3e-8, atol=2e-5)
