"""One scanner at work: pulses leave the moving aircraft, meet the scene, come back, are measured and encoded.

The chain is that of CONVENTIONS' beam, in the direction of the light: s → b → e → site frame, then the scene. A pulse
leaves and returns at its pose of emission, as in ISO/TS 19159-2 Eq. 10.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator

import numpy as np

from swath.georef.arrays import FloatArray, StructArray
from swath.sim.atmosphere import Air
from swath.sim.flight.trajectory import Trajectory
from swath.sim.plan.tables import ScannerTable
from swath.sim.scanners.assembly import Head, Wire
from swath.sim.scanners.mounting import Beams, Mounting
from swath.sim.scanners.ranging import Ranging
from swath.sim.scene.scene import Scene
from swath.sim.shots import Echoes, Pulses, WireUnit
from swath.sim.site import Site
from swath.sim.truth import RETURN_TRUTH_DTYPE

BLOCK_S = 0.25
EARTH_RADIUS_M = 6_371_000.0
LIGHT_MPS = 299_792_458.0


class Scanner:
    """One scanner of the plan.

    Args:
        name, table: of the plan.
        head, ranging, wire: its parts.
        trajectory, scene, site, air: the flight and its surroundings.
        start_gps_ns: of the plan.
    """

    def __init__(
        self,
        name: str,
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
        self._mounting = Mounting(table)
        self._first_number = zlib.crc32(name.encode()) << 31  # gives two scanners different random leaves

    def work(self, stop_s: float) -> Iterator[tuple[list[WireUnit], StructArray]]:
        """Yield everything until a time, block by block: units in order of time, and the truth of their returns."""
        for start_s, end_s, laser_on in self._periods(stop_s):
            if laser_on:
                for block_s in _cuts(start_s, end_s):
                    yield self._block(*block_s)
            else:
                yield self._wire.idle(start_s, end_s), np.empty(0, RETURN_TRUTH_DTYPE)
        yield self._wire.close()

    def _periods(self, stop_s: float) -> Iterator[tuple[float, float, bool]]:
        """Yield consecutive periods as (from, to, laser on)."""
        if not self._table.on_lines_only or self._table.kind in ("vlp16", "os1", "rosette"):
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
        beams = self._mounting.beams(pulses, poses, self._site)
        echoes = self._cast(pulses, beams)
        from_m, to_m = self._heights(beams, echoes)
        measured = self._ranging.measure(pulses, echoes, from_m, to_m, self._drawn(pulses, beams, echoes))
        return self._wire.units(pulses, measured, self._truth(pulses, beams, echoes))

    def _cast(self, pulses: Pulses, beams: Beams) -> Echoes:
        """Return the echoes along the beams; a bent beam is cast twice, because its target determines the bend."""
        straight = self._cast_along(pulses, beams, beams.direction)
        if not self._air.bends:
            return straight
        from_m, to_m = self._heights(beams, straight)
        ground_m = np.where(np.isfinite(to_m[:, -1]), to_m[:, -1], np.nanmean(to_m) if np.isfinite(to_m).any() else 0.0)
        beams.direction[:] = self._air.bend(beams.direction, self._down(beams.origin), from_m, ground_m)
        return self._cast_along(pulses, beams, beams.direction)

    def _drawn(self, pulses: Pulses, beams: Beams, echoes: Echoes) -> FloatArray | None:
        """Return (n, R) how much farther the surface is at a place that is drawn in the footprint; None: none is drawn.

        An echo goes with the nearest one there on the same kind of surface; where there is none, it stays at the axis.
        """
        aside = self._ranging.aside(pulses, beams.direction)
        if aside is None:
            return None
        there = self._cast_along(pulses, beams, aside, line=True)
        apart = there.range_m[:, np.newaxis, :] - echoes.range_m[:, :, np.newaxis]
        apart[(there.surface[:, np.newaxis, :] != echoes.surface[:, :, np.newaxis]) | np.isnan(apart)] = np.inf
        nearest = np.take_along_axis(apart, np.abs(apart).argmin(axis=2)[:, :, np.newaxis], axis=2)[:, :, 0]
        drawn: FloatArray = np.where(np.isfinite(nearest), nearest, 0.0)
        return drawn

    def _cast_along(self, pulses: Pulses, beams: Beams, direction: FloatArray, *, line: bool = False) -> Echoes:
        table = self._table
        return self._scene.cast(
            beams.origin,
            direction,
            pulses.time_s,
            self._first_number + pulses.number,
            0.0 if line else 1e-3 * table.divergence_mrad,
            0.5 * LIGHT_MPS * 1e-9 * table.pulse_ns,
            table.return_slots,
        )

    def _down(self, origin: FloatArray) -> FloatArray:
        """Return (n, 3) unit vectors of the plumb line, to the curvature of a sphere."""
        down = np.stack([-origin[:, 0], -origin[:, 1], np.full(len(origin), -EARTH_RADIUS_M)], axis=1)
        unit: FloatArray = down / np.linalg.norm(down, axis=1, keepdims=True)
        return unit

    def _heights(self, beams: Beams, echoes: Echoes) -> tuple[FloatArray, FloatArray]:
        """Return ellipsoidal heights of the scanner (n,) and of echoes (n, R), for the air; accurate to a decimetre."""
        rho = echoes.range_m
        x = beams.origin[:, :1] + rho * beams.direction[:, :1]
        y = beams.origin[:, 1:2] + rho * beams.direction[:, 1:2]
        z = beams.origin[:, 2:] + rho * beams.direction[:, 2:]
        above = beams.origin[:, 2] + (beams.origin[:, 0] ** 2 + beams.origin[:, 1] ** 2) / (2 * EARTH_RADIUS_M)
        return above, z + (x**2 + y**2) / (2 * EARTH_RADIUS_M)

    def _truth(self, pulses: Pulses, beams: Beams, echoes: Echoes) -> StructArray:
        """Return (n, R) rows of truth; the rows of empty slots have no meaning."""
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


def _cuts(start_s: float, stop_s: float) -> Iterator[tuple[float, float]]:
    """Yield the parts of a time span that is cut at whole multiples of a block."""
    at_s = start_s
    while at_s < stop_s:
        next_s = min(stop_s, (np.floor(at_s / BLOCK_S + 1e-9) + 1) * BLOCK_S)
        yield at_s, float(next_s)
        at_s = float(next_s)
