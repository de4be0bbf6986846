"""A trajectory: position and attitude of the body at any time between two of its epochs.

Position is linear in e, attitude the exact slerp of q_e_from_b (Shoemake 1985): a turn of constant rate about one axis,
stored as a rotation vector for each interval, so that q(share) = q0 ⊗ exp(share · rotvec_b / 2). Nothing is
extrapolated, and intervals that are too long are gaps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from swath.georef.arrays import ByteArray, FloatArray, Int64Array
from swath.georef.compiled import jit_cached, jit_inline
from swath.georef.geodesy.earth import e_from_geodetic, geodetic_from_e
from swath.georef.geodesy.quaternions import about, conjugate, product, rotated, rotation_vector, rotations_between
from swath.georef.geodesy.rotations import quaternion_from_rot, rot_l_from_plumb
from swath.georef.points import Fate
from swath.georef.timescales.gps_time import SECOND_NS, week_from_gps

DEFAULT_MAX_GAP_NS = 150_000_000  # 10 Hz with jitter; a missing epoch of 10 Hz may hide 15 mm and 1 mrad
EARTH_RATE_RADPS = 7.292115e-5  # WGS 84
SMALL_HALF_ANGLE_2 = 1e-3  # (63 mrad / 2)²: below, the series of sine and cosine are exact to the last bit

OUTSIDE, GAP = int(Fate.OUTSIDE_TRAJECTORY), int(Fate.TRAJECTORY_GAP)


class TrajectoryError(ValueError):
    """Raised for an invalid trajectory or trajectory file; one line for the user."""


class TrajectoryGapError(TrajectoryError):
    """Raised for a time without a pose: in a gap between two epochs, or before or after all of them.

    Attributes:
        start_ns, end_ns: GPS times between which the requested poses are unknown.
    """

    def __init__(self, start_ns: int, end_ns: int, what: str) -> None:
        self.start_ns, self.end_ns = start_ns, end_ns
        length_s = (end_ns - start_ns) / SECOND_NS
        super().__init__(f"{what}: from {gps_text(start_ns)} to {gps_text(end_ns)} ({length_s:.3f} s)")


def gps_text(gps_ns: int) -> str:
    """Return a GPS time as text: ``GPS week 2445, 561618.000 s``."""
    week, of_week_ns = week_from_gps(int(gps_ns))
    return f"GPS week {week}, {of_week_ns / SECOND_NS:.3f} s"


def gps_span_text(start_ns: int, end_ns: int) -> str:
    """Return a span of GPS time as text: ``GPS week 2445, 561618.000 to 561620.500 s``."""
    (week, start_of_week_ns), (last, _) = week_from_gps(int(start_ns)), week_from_gps(int(end_ns))
    if week != last:
        return f"{gps_text(start_ns)} to {gps_text(end_ns)}"
    end_of_week_ns = start_of_week_ns + int(end_ns) - int(start_ns)
    return f"GPS week {week}, {start_of_week_ns / SECOND_NS:.3f} to {end_of_week_ns / SECOND_NS:.3f} s"


@jit_inline
def locate_epoch(time_ns: Int64Array, t: int, guess: int) -> int:
    """Return the epoch at or before t, 0 … n − 2; −1 if t lies outside.

    A good ``guess``, which may be any number, only saves the search.
    """
    last = len(time_ns) - 1
    if last < 1 or t < time_ns[0] or t > time_ns[last]:
        return -1
    if 0 <= guess < last and time_ns[guess] <= t:
        if t < time_ns[guess + 1]:
            return guess
        if guess + 2 <= last and t < time_ns[guess + 2]:
            return guess + 1
    low, high = 0, last
    while high - low > 1:
        middle = (low + high) >> 1
        if time_ns[middle] <= t:
            low = middle
        else:
            high = middle
    return low


@jit_inline
def slerp(
    w: float, x: float, y: float, z: float, rx: float, ry: float, rz: float, share: float
) -> tuple[float, float, float, float]:
    """Return (w, x, y, z) ⊗ exp(share · (rx, ry, rz) / 2): a quaternion turned by a share of its interval's turn.

    (rx, ry, rz) is the interval's rotvec_b.
    """
    half = 0.5 * share
    angle2 = half * half * (rx * rx + ry * ry + rz * rz)
    if angle2 < SMALL_HALF_ANGLE_2:
        cos = 1.0 - angle2 * (0.5 - angle2 * (1.0 / 24.0 - angle2 / 720.0))
        half *= 1.0 - angle2 * (1.0 / 6.0 - angle2 * (1.0 / 120.0 - angle2 / 5040.0))
    else:
        angle = math.sqrt(angle2)
        cos = math.cos(angle)
        half *= math.sin(angle) / angle
    i, j, k = half * rx, half * ry, half * rz
    return (
        w * cos - x * i - y * j - z * k,
        w * i + x * cos + y * k - z * j,
        w * j - x * k + y * cos + z * i,
        w * k + x * j - y * i + z * cos,
    )


@jit_cached
def _locate(time_ns: Int64Array, max_gap_ns: int, times_ns: Int64Array, epoch: Int64Array, fate: ByteArray) -> None:
    guess = 0
    for i in range(len(times_ns)):
        guess = locate_epoch(time_ns, times_ns[i], guess)
        epoch[i] = guess
        if guess < 0:
            fate[i] = OUTSIDE
        elif time_ns[guess + 1] - time_ns[guess] > max_gap_ns:
            fate[i] = GAP
        else:
            fate[i] = 0


@jit_cached
def _slerp_all(q: FloatArray, rotvec_b: FloatArray, epoch: Int64Array, share: FloatArray, turned: FloatArray) -> None:
    for i in range(len(epoch)):
        at, r = q[epoch[i]], rotvec_b[epoch[i]]
        w, x, y, z = slerp(at[0], at[1], at[2], at[3], r[0], r[1], r[2], share[i])
        turned[i, 0], turned[i, 1], turned[i, 2], turned[i, 3] = w, x, y, z


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of the body at n times.

    Attributes:
        position_e: (n, 3) m.
        q_e_from_b: (n, 4) scalar first.
        velocity_e: (n, 3) m/s relative to the earth.
        rate_eb_b: (n, 3) rad/s, the turn of the body relative to e, in b: that of the whole interval.
        position_sigma_l: (n, 3) m, north, east, down; nan: not given.
        attitude_sigma_rad: (n, 3) roll, pitch, heading; nan: not given.
    """

    position_e: FloatArray
    q_e_from_b: FloatArray
    velocity_e: FloatArray
    rate_eb_b: FloatArray
    position_sigma_l: FloatArray
    attitude_sigma_rad: FloatArray


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Epochs of one trajectory, which may be empty.

    Attributes:
        time_ns: (n,) GPS time, strictly rising.
        position_e: (n, 3) m.
        q_e_from_b: (n, 4) scalar first; nan if the file has positions only.
        velocity_e: (n, 3) m/s relative to the earth; nan: not given, and no near epoch determines it.
        position_sigma_l: (n, 3) m, north, east, down; nan: not given.
        attitude_sigma_rad: (n, 3) roll, pitch, heading; nan: not given.
        max_gap_ns: longer intervals are gaps.
        name: for messages and sidecars.
    """

    time_ns: Int64Array
    position_e: FloatArray
    q_e_from_b: FloatArray
    velocity_e: FloatArray
    position_sigma_l: FloatArray
    attitude_sigma_rad: FloatArray
    max_gap_ns: int = DEFAULT_MAX_GAP_NS
    name: str = ""

    def __post_init__(self) -> None:
        """Refuse times that do not rise, or columns that differ in length, with `TrajectoryError`."""
        for column, shape in _COLUMNS.items():
            if getattr(self, column).shape != (len(self.time_ns), *shape):
                raise TrajectoryError(f"trajectory {self.name}: column {column} differs in length from time_ns")
        steps = np.diff(self.time_ns)
        if (steps <= 0).any():
            back = self.time_ns[int(np.argmax(steps <= 0)) + 1]
            raise TrajectoryError(f"trajectory {self.name}: time does not increase at {gps_text(back)}")

    @classmethod
    def from_geodetic(
        cls,
        time_ns: Int64Array,
        lat_rad: ArrayLike,
        lon_rad: ArrayLike,
        height_m: ArrayLike,
        velocity_l: ArrayLike,
        roll_rad: ArrayLike,
        pitch_rad: ArrayLike,
        heading_rad: ArrayLike,
        *,
        position_sigma_l: ArrayLike | None = None,
        attitude_sigma_rad: ArrayLike | None = None,
        max_gap_ns: int = DEFAULT_MAX_GAP_NS,
        name: str = "",
    ) -> Trajectory:
        """Make a trajectory from columns (n,), velocity and sigmas (n, 3) as files give them; without sigmas: nan."""
        lat, lon = np.asarray(lat_rad, dtype=np.float64), np.asarray(lon_rad, dtype=np.float64)
        q_e_from_l = product(about(2, lon), about(1, -lat - np.pi / 2))
        q_l_from_b = product(product(about(2, heading_rad), about(1, pitch_rad)), about(0, roll_rad))
        unsaid = np.full((len(time_ns), 3), np.nan)
        return cls(
            np.ascontiguousarray(time_ns, dtype=np.int64),
            e_from_geodetic(lat, lon, height_m),
            _sign_continuous(product(q_e_from_l, q_l_from_b)),
            rotated(q_e_from_l, np.asarray(velocity_l, dtype=np.float64)),
            unsaid if position_sigma_l is None else np.array(position_sigma_l, dtype=np.float64),
            unsaid if attitude_sigma_rad is None else np.array(attitude_sigma_rad, dtype=np.float64),
            max_gap_ns,
            name,
        )

    def __len__(self) -> int:
        """Return the number of epochs."""
        return len(self.time_ns)

    @property
    def span(self) -> tuple[int, int]:
        """The GPS time of the first and the last epoch; TrajectoryError without epochs."""
        if not len(self):
            raise TrajectoryError(f"trajectory {self.name}: has no epochs")
        return int(self.time_ns[0]), int(self.time_ns[-1])

    @cached_property
    def rotvec_b(self) -> FloatArray:
        """Rotation vectors (n − 1, 3) of the intervals in b, rad, of the shorter turn: q1 = q0 ⊗ exp(rotvec_b / 2)."""
        return rotations_between(self.q_e_from_b)

    @cached_property
    def has_attitude(self) -> bool:
        """True if all epochs have an attitude."""
        return bool(np.isfinite(self.q_e_from_b).all())

    def poses(self, time_ns: ArrayLike) -> Poses:
        """Return poses at GPS times (n,), preferably in order.

        Raises:
            TrajectoryGapError: a time is outside or in a gap.
        """
        times = np.ascontiguousarray(time_ns, dtype=np.int64)
        epoch, fate = self._located(times)
        if fate.any():
            self._refuse(times, epoch, fate)
        begin, end = self.time_ns[epoch], self.time_ns[epoch + 1]
        length_ns = end - begin
        share = (times - begin) / length_ns
        attitude = np.empty((len(times), 4))
        _slerp_all(self.q_e_from_b, self.rotvec_b, epoch, share, attitude)

        def linear(column: FloatArray) -> FloatArray:
            between: FloatArray = column[epoch] + share[:, np.newaxis] * (column[epoch + 1] - column[epoch])
            return between

        return Poses(
            linear(self.position_e),
            attitude,
            linear(self.velocity_e),
            self.rotvec_b[epoch] * (SECOND_NS / length_ns)[:, np.newaxis],
            linear(self.position_sigma_l),
            linear(self.attitude_sigma_rad),
        )

    def fates(self, time_ns: ArrayLike) -> ByteArray:
        """Return (n,) GEOREFERENCED, OUTSIDE_TRAJECTORY or TRAJECTORY_GAP of GPS times, as `Fate`."""
        return self._located(np.ascontiguousarray(time_ns, dtype=np.int64))[1]

    def gaps(self) -> Int64Array:
        """Return (k, 2) GPS times of the epochs before and after each gap."""
        at = np.flatnonzero(np.diff(self.time_ns) > self.max_gap_ns)
        return np.stack([self.time_ns[at], self.time_ns[at + 1]], axis=1)

    def with_velocities(self) -> Trajectory:
        """Return a trajectory in which positions determine missing velocities: from the epoch before to the next.

        They never span a gap. At an epoch beside a gap, or at the ends, the one adjacent interval is used; an isolated
        epoch stays without velocity.
        """
        unsaid = np.logical_or.reduce(~np.isfinite(self.velocity_e), axis=1)
        if not unsaid.any():
            return self
        near = np.diff(self.time_ns) <= self.max_gap_ns
        before, after = np.r_[False, near], np.r_[near, False]
        rows = np.arange(len(self))
        first, last = rows - before, rows + after
        seconds = np.where(first == last, np.nan, (self.time_ns[last] - self.time_ns[first]) / SECOND_NS)
        moved_e = (self.position_e[last] - self.position_e[first]) / seconds[:, np.newaxis]
        return self._with(velocity_e=np.where(unsaid[:, np.newaxis], moved_e, self.velocity_e))

    def between(self, first_ns: int, last_ns: int) -> Trajectory:
        """Return the epochs that poses from first_ns to last_ns need, as views, with one epoch beyond either end."""
        begin = max(0, int(np.searchsorted(self.time_ns, first_ns, side="right")) - 1)
        end = int(np.searchsorted(self.time_ns, last_ns, side="right")) + 1
        return self._with(**{column: getattr(self, column)[begin:end] for column in _COLUMNS})

    def geodetic(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return latitude, longitude, rad, and ellipsoidal height, m, of the epochs, each (n,)."""
        return geodetic_from_e(self.position_e)

    def attitude(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return roll, pitch and heading (0 … 2π) of the epochs, rad, each (n,) (FORMULAS 1.4)."""
        w, x, y, z = self._q_l_from_b().T
        roll = np.arctan2(2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
        nose_n, nose_e, nose_d = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)
        return roll, np.arctan2(-nose_d, np.hypot(nose_n, nose_e)), np.arctan2(nose_e, nose_n) % (2 * np.pi)

    def velocity_l(self) -> FloatArray:
        """Return velocities (n, 3) north, east, down of the epochs, m/s."""
        return rotated(conjugate(self._q_e_from_l()), self.velocity_e)

    def turn_rates_b(self, relative_to: Literal["e", "l", "i"] = "e") -> FloatArray:
        """Return the body's mean turn rates (n − 1, 3) over the intervals, in b, rad/s.

        They are relative to e, l or inertial space.
        """
        turned = self.rotvec_b
        if relative_to == "l":
            q_l_from_b = self._q_l_from_b()
            turned = rotation_vector(product(conjugate(q_l_from_b[:-1]), q_l_from_b[1:]))
        rate: FloatArray = turned * (SECOND_NS / np.diff(self.time_ns))[:, np.newaxis]
        if relative_to == "i":
            earth = np.broadcast_to(np.array([0.0, 0.0, EARTH_RATE_RADPS]), rate.shape)
            rate = rate + rotated(conjugate(self.q_e_from_b[:-1]), earth)
        return rate

    def at_body(self, offset_b: ArrayLike) -> Trajectory:
        """Return the trajectory of the body's origin from that of a point (antenna, scanner) at offset_b (3,), m in b.

        The velocity loses the point's velocity by the turn over the intervals beside an epoch, except gaps; an isolated
        epoch keeps its own. The sigmas do not change.
        """
        self.require_attitude()
        offset = np.asarray(offset_b, dtype=np.float64)
        near = np.diff(self.time_ns) <= self.max_gap_ns
        counted = np.r_[0, near] + np.r_[near, 0]
        rate = np.zeros((len(self), 3))
        of_intervals = self.turn_rates_b() * near[:, np.newaxis]
        rate[:-1] += of_intervals
        rate[1:] += of_intervals
        rate /= np.maximum(counted, 1)[:, np.newaxis]
        return self._with(
            position_e=self.position_e - rotated(self.q_e_from_b, np.broadcast_to(offset, rate.shape)),
            velocity_e=self.velocity_e - rotated(self.q_e_from_b, np.cross(rate, offset)),
        )

    def with_deflection(self, xi_rad: float, eta_rad: float) -> Trajectory:
        """Turn roll and pitch that refer to the plumb line to the ellipsoid's normal (FORMULAS 1.8)."""
        plumb = quaternion_from_rot(rot_l_from_plumb(self.geodetic()[0], xi_rad, eta_rad))
        turned = product(product(self._q_e_from_l(), plumb), self._q_l_from_b())
        return self._with(q_e_from_b=_sign_continuous(turned))

    def require_attitude(self) -> None:
        """Refuse a trajectory in which an epoch has no attitude, with `TrajectoryError`."""
        if not self.has_attitude:
            raise TrajectoryError(
                f"trajectory {self.name}: has positions but no attitude; georeferencing needs roll, pitch and heading"
            )

    def _located(self, times_ns: Int64Array) -> tuple[Int64Array, ByteArray]:
        epoch, fate = np.empty(len(times_ns), dtype=np.int64), np.empty(len(times_ns), dtype=np.uint8)
        _locate(self.time_ns, self.max_gap_ns, times_ns, epoch, fate)
        return epoch, fate

    def _refuse(self, times_ns: Int64Array, epoch: Int64Array, fate: ByteArray) -> None:
        at = int(np.argmax(fate > 0))
        first_ns, last_ns = self.span
        if fate[at] == GAP:
            begin_ns, end_ns = self.time_ns[epoch[at] : epoch[at] + 2].tolist()
            raise TrajectoryGapError(begin_ns, end_ns, f"gap in trajectory {self.name}")
        if times_ns[at] < first_ns:
            raise TrajectoryGapError(int(times_ns.min()), first_ns, f"before the start of trajectory {self.name}")
        raise TrajectoryGapError(last_ns, int(times_ns.max()), f"after the end of trajectory {self.name}")

    def _q_e_from_l(self) -> FloatArray:
        lat, lon, _ = self.geodetic()
        return product(about(2, lon), about(1, -lat - np.pi / 2))

    def _q_l_from_b(self) -> FloatArray:
        return product(conjugate(self._q_e_from_l()), self.q_e_from_b)

    def _with(self, **columns: Any) -> Trajectory:
        return Trajectory(**{field.name: columns.get(field.name, getattr(self, field.name)) for field in fields(self)})


_COLUMNS: dict[str, tuple[int, ...]] = {
    "time_ns": (),
    "position_e": (3,),
    "q_e_from_b": (4,),
    "velocity_e": (3,),
    "position_sigma_l": (3,),
    "attitude_sigma_rad": (3,),
}


def _sign_continuous(q: FloatArray) -> FloatArray:
    """Return q or −q, whichever is nearer to the one before; both are the same attitude."""
    turned = np.where((q[1:] * q[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    q[1:] *= np.cumprod(turned)[:, np.newaxis]
    return q
