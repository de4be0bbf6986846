"""One scanner at work: pulses leave the moving aircraft, meet the scene, come back, are measured and told.

The chain is that of CONVENTIONS' beam, in the direction of the light: s → b → e → site frame, then the scene. A pulse
leaves and returns at its pose of emission, as ISO/TS 19159-2 Eq. 10 has it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numba
import numpy as np
from scipy.spatial.transform import Rotation

from sim.atmosphere import Air
from sim.flight import Poses, Trajectory
from sim.plan_tables import ScannerTable
from sim.scanners.assembly import Head, Wire
from sim.scanners.ranging import Ranging
from sim.scene import Scene
from sim.shots import Echoes, FloatArray, Pulses, WireUnit
from sim.site import Site
from sim.truth import RETURN_TRUTH_DTYPE, StructArray

BLOCK_S = 0.25
EARTH_RADIUS_M = 6_371_000.0
LIGHT_MPS = 299_792_458.0


@dataclass(frozen=True, slots=True)
class Beams:
    """Axes of beams in the site frame, where they start, and the same in e for the truth."""

    origin_e: FloatArray
    origin: FloatArray
    direction: FloatArray


class Scanner:
    """One scanner of the plan.

    Args:
        table: of the plan.
        head, ranging, wire: its parts.
        trajectory, scene, site, air: what it flies through.
        start_gps_ns: of the plan.
    """

    def __init__(
        self,
        table: ScannerTable,
        head: Head,
        ranging: Ranging,
        wire: Wire,
        trajectory: Trajectory,
        scene: Scene,
        site: Site,
        air: Air,
        start_gps_ns: int,
    ) -> None:
        self._table, self._head, self._ranging, self._wire = table, head, ranging, wire
        self._trajectory, self._scene, self._site, self._air = trajectory, scene, site, air
        self._start_gps_ns = start_gps_ns
        true = table.true
        self._lever_arm_b = np.array([true.lever_arm_x_m, true.lever_arm_y_m, true.lever_arm_z_m])
        kappa = Rotation.from_euler("z", true.kappa_deg, degrees=True).as_matrix()
        self._rot_kappa_installation = kappa @ np.array(table.installation, dtype=np.float64)
        self._phi_rad = float(np.radians(true.phi_deg))
        self._rot_omega = Rotation.from_euler("x", true.omega_deg, degrees=True).as_matrix()

    def work(self, stop_s: float) -> Iterator[tuple[list[WireUnit], StructArray]]:
        """Everything until a time, block by block: units in order of time, truth of the returns in them."""
        for start_s, end_s, laser_on in self._periods(stop_s):
            if laser_on:
                for block_s in _cuts(start_s, end_s):
                    yield self._block(*block_s)
            else:
                yield self._wire.idle(start_s, end_s), np.empty(0, RETURN_TRUTH_DTYPE)
        yield self._wire.close()

    def _periods(self, stop_s: float) -> Iterator[tuple[float, float, bool]]:
        """(from, to, laser on), one behind the other."""
        if not self._table.on_lines_only or self._table.kind in ("vlp16", "os1"):
            yield 0.0, stop_s, True
            return
        at_s = 0.0
        for line in self._trajectory.lines:
            start_s, end_s = min(line.start_s, stop_s), min(line.end_s, stop_s)
            yield at_s, start_s, False
            yield start_s, end_s, True
            at_s = end_s
        yield at_s, stop_s, False

    def _block(self, start_s: float, stop_s: float) -> tuple[list[WireUnit], StructArray]:
        pulses = self._head.pulses(start_s, stop_s)
        poses = self._trajectory.poses(pulses.time_s)
        beams = self.beams(pulses, poses)
        echoes = self._cast(pulses, beams)
        from_m, to_m = self._heights(beams, echoes)
        measured = self._ranging.measure(pulses, echoes, from_m, to_m)
        return self._wire.units(pulses, measured, self._truth(pulses, beams, echoes))

    def beams(self, pulses: Pulses, poses: Poses) -> Beams:
        """Axes of pulses as they leave (ISO/TS 19159-2 Eq. 10)."""
        origin_e, origin, direction = np.empty((3, len(pulses), 3))
        _axes(
            (pulses.origin_s, pulses.direction_s, pulses.phi_extra_rad),
            (self._rot_kappa_installation, self._phi_rad, self._rot_omega, self._lever_arm_b),
            (poses.position_e, poses.rot_e_from_b),
            (self._site.origin_e, self._site.rot_site_from_e),
            (origin_e, origin, direction),
        )
        return Beams(origin_e, origin, direction)

    def _cast(self, pulses: Pulses, beams: Beams) -> Echoes:
        """Echoes along the beams; a bent beam is cast twice, since what it meets says how much it bends."""
        straight = self._cast_along(pulses, beams, beams.direction)
        if not self._air.bends:
            return straight
        from_m, to_m = self._heights(beams, straight)
        ground_m = np.where(np.isfinite(to_m[:, -1]), to_m[:, -1], np.nanmean(to_m) if np.isfinite(to_m).any() else 0.0)
        beams.direction[:] = self._air.bend(beams.direction, self._down(beams.origin), from_m, ground_m)
        return self._cast_along(pulses, beams, beams.direction)

    def _cast_along(self, pulses: Pulses, beams: Beams, direction: FloatArray) -> Echoes:
        table = self._table
        return self._scene.cast(
            beams.origin,
            direction,
            pulses.time_s,
            pulses.number,
            1e-3 * table.divergence_mrad,
            0.5 * LIGHT_MPS * 1e-9 * table.pulse_ns,
            table.return_slots,
        )

    def _down(self, origin: FloatArray) -> FloatArray:
        """(n, 3) the plumb line, to the curvature of a sphere."""
        down = np.stack([-origin[:, 0], -origin[:, 1], np.full(len(origin), -EARTH_RADIUS_M)], axis=1)
        unit: FloatArray = down / np.linalg.norm(down, axis=1, keepdims=True)
        return unit

    def _heights(self, beams: Beams, echoes: Echoes) -> tuple[FloatArray, FloatArray]:
        """Heights above the ellipsoid of the scanner (n,) and of echoes (n, R), for the air: good to a decimetre."""
        rho = echoes.range_m
        x = beams.origin[:, :1] + rho * beams.direction[:, :1]
        y = beams.origin[:, 1:2] + rho * beams.direction[:, 1:2]
        z = beams.origin[:, 2:] + rho * beams.direction[:, 2:]
        above = beams.origin[:, 2] + (beams.origin[:, 0] ** 2 + beams.origin[:, 1] ** 2) / (2 * EARTH_RADIUS_M)
        return above, z + (x**2 + y**2) / (2 * EARTH_RADIUS_M)

    def _truth(self, pulses: Pulses, beams: Beams, echoes: Echoes) -> StructArray:
        """(n, R) rows; those of empty slots mean nothing."""
        rows = np.zeros(echoes.range_m.shape, RETURN_TRUTH_DTYPE)
        directions_e = beams.direction @ self._site.rot_site_from_e
        points_e = beams.origin_e[:, np.newaxis] + echoes.range_m[:, :, np.newaxis] * directions_e[:, np.newaxis]
        rows["gps_ns"] = (self._start_gps_ns + np.rint(1e9 * pulses.time_s).astype(np.int64))[:, np.newaxis]
        rows["point_e"] = points_e
        rows["range_m"] = echoes.range_m
        rows["pulse"] = pulses.number[:, np.newaxis]
        rows["incidence_rad"] = echoes.incidence_rad
        rows["strip"] = self._trajectory.line_at(pulses.time_s)[:, np.newaxis]
        rows["channel"] = pulses.channel[:, np.newaxis]
        rows["return_number"] = np.arange(1, echoes.range_m.shape[1] + 1)
        rows["surface"] = echoes.surface
        return rows


@numba.njit(cache=True)
def _turned(rotation, vector):  # type: ignore[no-untyped-def]
    """A vector (3,) by a matrix (3, 3), as three numbers."""
    return (
        rotation[0, 0] * vector[0] + rotation[0, 1] * vector[1] + rotation[0, 2] * vector[2],
        rotation[1, 0] * vector[0] + rotation[1, 1] * vector[1] + rotation[1, 2] * vector[2],
        rotation[2, 0] * vector[0] + rotation[2, 1] * vector[1] + rotation[2, 2] * vector[2],
    )


@numba.njit(cache=True)
def _axes(pulses, mounting, poses, site, out):  # type: ignore[no-untyped-def]
    """s → b (installation and κ, then φ with each pulse's slope, then ω) → e → site frame, pulse by pulse."""
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


def _cuts(start_s: float, stop_s: float) -> Iterator[tuple[float, float]]:
    """The time between, cut at whole multiples of a block."""
    at_s = start_s
    while at_s < stop_s:
        next_s = min(stop_s, (np.floor(at_s / BLOCK_S + 1e-9) + 1) * BLOCK_S)
        yield at_s, float(next_s)
        at_s = float(next_s)
