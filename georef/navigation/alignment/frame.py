"""Express GNSS positions and gravitation in axes that do not turn: those of l at a moment T, held fixed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.gravity import EARTH_RATE_RADPS, gravity_e
from swath.georef.geodesy.rotations import rot_z
from swath.georef.navigation.alignment.blocks import Felt
from swath.georef.timescales.gps_time import SECOND_NS

RATE_IE_E = np.array([0.0, 0.0, EARTH_RATE_RADPS])


class Frame:
    """The axes of l at T, held fixed in inertial space, and the antenna's path.

    Args:
        positions: POSITION rows by time; the last gives the place at T.
        time_ns: T.
    """

    def __init__(self, positions: StructArray, time_ns: int) -> None:
        self.time_ns = time_ns
        self._knots_s = (positions["time_ns"] - time_ns) / SECOND_NS
        self._knots_e = positions["value"]
        self.origin_e: FloatArray = self.position_e(np.array([time_ns]))[0]
        self.rot_e_from_l = _rot_e_from_l(self.origin_e)

    def position_e(self, time_ns: Int64Array) -> FloatArray:
        """Return positions (m, 3) of the antenna, interpolated between the fixes."""
        at_s = (time_ns - self.time_ns) / SECOND_NS
        return np.stack([np.interp(at_s, self._knots_s, self._knots_e[:, axis]) for axis in range(3)], axis=-1)

    def rot_from_e(self, time_ns: Int64Array) -> FloatArray:
        """Return rotations (m, 3, 3) from e of the moment."""
        turned: FloatArray = self.rot_e_from_l.T @ rot_z(EARTH_RATE_RADPS * (time_ns - self.time_ns) / SECOND_NS)
        return turned

    def rot_from_l(self, time_ns: Int64Array) -> FloatArray:
        """Return rotations (m, 3, 3) from l of the moment at the antenna's position then."""
        turned: FloatArray = self.rot_from_e(time_ns) @ _rot_e_from_l(self.position_e(time_ns))
        return turned

    def place(self, rows: StructArray) -> FloatArray:
        """Return (m, 3) POSITION rows, m from the antenna's position at T."""
        there = np.einsum("nij,nj->ni", self.rot_from_e(rows["time_ns"]), rows["value"])
        moved: FloatArray = there - self.rot_e_from_l.T @ self.origin_e
        return moved

    def velocity(self, rows: StructArray) -> FloatArray:
        """Return (m, 3) VELOCITY rows against inertial space, m/s."""
        place_e = self.position_e(rows["time_ns"])
        velocity_e = np.einsum("nij,nj->ni", _rot_e_from_l(place_e), rows["value"]) + np.cross(RATE_IE_E, place_e)
        turned: FloatArray = np.einsum("nij,nj->ni", self.rot_from_e(rows["time_ns"]), velocity_e)
        return turned

    def gravitation(self, felt: Felt) -> Gravitation:
        """Return the integrals of gravitation back from T, over the blocks."""
        place_e = self.position_e(felt.time_ns)
        attraction_e = gravity_e(place_e)
        attraction_e[:, :2] -= EARTH_RATE_RADPS**2 * place_e[:, :2]
        pull = np.einsum("nij,nj->ni", self.rot_from_e(felt.time_ns), attraction_e)
        once = _integral(felt, pull)
        return Gravitation(felt, once, _integral(felt, once))


@dataclass(frozen=True, eq=False)
class Gravitation:
    """The integral ∫_t^T γ (n + 1, 3) and its own integral, at the edges of blocks."""

    felt: Felt
    once: FloatArray
    twice: FloatArray

    def velocity(self, time_ns: Int64Array) -> FloatArray:
        """Return ∫_t^T γ (m, 3), m/s."""
        since_s = (time_ns - self.felt.time_ns[0]) / SECOND_NS
        edges_s = (self.felt.time_ns - self.felt.time_ns[0]) / SECOND_NS
        return np.stack([np.interp(since_s, edges_s, self.once[:, axis]) for axis in range(3)], axis=-1)

    def place(self, time_ns: Int64Array) -> FloatArray:
        """Return the integral of that (m, 3), m: within a block a parabola, as for the sensor integrals."""
        after = np.clip(np.searchsorted(self.felt.time_ns, time_ns), 1, len(self.felt.time_ns) - 1)
        left_s = (self.felt.time_ns[after] - time_ns)[:, None] / SECOND_NS
        moved: FloatArray = self.twice[after] + 0.5 * left_s * (self.velocity(time_ns) + self.once[after])
        return moved


def _integral(felt: Felt, values: FloatArray) -> FloatArray:
    """Return ∫_t^T (n + 1, 3) of values at the edges."""
    parts = 0.5 * (values[1:] + values[:-1]) * np.diff(felt.time_ns)[:, None] / SECOND_NS
    summed = np.zeros_like(values)
    summed[:-1] = np.cumsum(parts[::-1], axis=0)[::-1]
    return summed


def _rot_e_from_l(position_e: FloatArray) -> FloatArray:
    """Return rotations (…, 3, 3) at positions (…, 3)."""
    lat, lon, _ = geodetic_from_e(position_e)
    return rot_e_from_l(lat, lon)
