"""The chain from the scanner's own frame to the site frame: how a head is mounted, and where its beams go.

It is CONVENTIONS' chain in the direction of the light: s → b → e → site frame (ISO/TS 19159-2 Eq. 10).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from swath.georef.arrays import FloatArray
from swath.sim.compiled import jit_cached, jit_inline
from swath.sim.flight.trajectory import Poses
from swath.sim.plan.tables import ScannerTable
from swath.sim.shots import Pulses
from swath.sim.site import Site

Three = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Beams:
    """Axes of beams: their origins and directions in the site frame, and the origins in e for the truth."""

    origin_e: FloatArray
    origin: FloatArray
    direction: FloatArray


class Mounting:
    """Installation matrix, true boresight and true lever arm of a scanner of the plan."""

    def __init__(self, table: ScannerTable) -> None:
        true = table.true
        self._lever_arm_b = np.array([true.lever_arm_x_m, true.lever_arm_y_m, true.lever_arm_z_m])
        kappa = Rotation.from_euler("z", true.kappa_deg, degrees=True).as_matrix()
        self._rot_kappa_installation = kappa @ np.array(table.installation, dtype=np.float64)
        self._phi_rad = float(np.radians(true.phi_deg))
        self._rot_omega = Rotation.from_euler("x", true.omega_deg, degrees=True).as_matrix()

    def beams(self, pulses: Pulses, poses: Poses, site: Site) -> Beams:
        """Return the axes of pulses as they leave, at their poses of emission."""
        origin_e, origin, direction = np.empty((3, len(pulses), 3))
        _axes(
            (pulses.origin_s, pulses.direction_s, pulses.phi_extra_rad),
            (self._rot_kappa_installation, self._phi_rad, self._rot_omega, self._lever_arm_b),
            (poses.position_e, poses.rot_e_from_b),
            (site.origin_e, site.rot_site_from_e),
            (origin_e, origin, direction),
        )
        return Beams(origin_e, origin, direction)


@jit_inline
def _turned(rotation: FloatArray, vector: FloatArray | Three) -> Three:
    """Return a vector (3,) multiplied by a matrix (3, 3), as three numbers."""
    return (
        rotation[0, 0] * vector[0] + rotation[0, 1] * vector[1] + rotation[0, 2] * vector[2],
        rotation[1, 0] * vector[0] + rotation[1, 1] * vector[1] + rotation[1, 2] * vector[2],
        rotation[2, 0] * vector[0] + rotation[2, 1] * vector[1] + rotation[2, 2] * vector[2],
    )


@jit_cached
def _axes(
    pulses: tuple[FloatArray, FloatArray, FloatArray],
    mounting: tuple[FloatArray, float, FloatArray, FloatArray],
    poses: tuple[FloatArray, FloatArray],
    site: tuple[FloatArray, FloatArray],
    out: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    """Transform the pulses one by one: s → b → e → site frame.

    The step s → b applies installation and κ, then φ with each pulse's slope, then ω.
    """
    origin_s, direction_s, phi_extra = pulses
    rot_kappa_installation, phi, rot_omega, lever_arm_b = mounting
    position_e, rot_e_from_b = poses
    site_e, rot_site_from_e = site
    origin_e, origin, direction = out
    for n in range(len(direction_s)):
        cos, sin = np.cos(phi + phi_extra[n]), np.sin(phi + phi_extra[n])
        x, y, z = _turned(rot_kappa_installation, direction_s[n])
        body = _turned(rot_omega, (cos * x + sin * z, y, cos * z - sin * x))
        direction[n, 0], direction[n, 1], direction[n, 2] = _turned(rot_site_from_e, _turned(rot_e_from_b[n], body))
        x, y, z = _turned(rot_kappa_installation, origin_s[n])
        x, y, z = _turned(rot_omega, (cos * x + sin * z, y, cos * z - sin * x))
        arm = _turned(rot_e_from_b[n], (x + lever_arm_b[0], y + lever_arm_b[1], z + lever_arm_b[2]))
        for k in range(3):
            origin_e[n, k] = position_e[n, k] + arm[k]
        there = (origin_e[n, 0] - site_e[0], origin_e[n, 1] - site_e[1], origin_e[n, 2] - site_e[2])
        origin[n, 0], origin[n, 1], origin[n, 2] = _turned(rot_site_from_e, there)
