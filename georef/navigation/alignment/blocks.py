"""Sum inertial samples in short blocks, and integrate them back from a moment, for alignment to compare with GNSS.

All results are in the axes that the body had at the moment T, held fixed in inertial space. There the attitude of an
earlier time t is D(t), and the accelerometers' integral since then is α(t) = ∫_t^T D f; only the attitude at T itself
and the velocity and position at T are unknown (optimisation-based alignment; Wu and Pan, Velocity/position integration
formula part I, IEEE Trans. AES 49, 2013).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.geodesy import quaternions
from swath.georef.geodesy.rotations import rot_from_quaternion, skew
from swath.georef.navigation.inputs import Inertial
from swath.georef.timescales.gps_time import SECOND_NS

BLOCK_NS = 50_000_000  # rate and force are taken as constant within a block
_APART_NS = 0.5 * SECOND_NS  # times the interval: samples farther apart leave a gap


@dataclass(frozen=True, eq=False)
class Felt:
    """Integrals from each of n + 1 edges of blocks to the last of them, T, in the axes b had at T.

    Errors of the sensors are six each: biases, then scale factors. A sensor measures (1 + scale) · truth + bias.

    Attributes:
        time_ns: (n + 1,) edges.
        before_s: (n + 1,) T − t.
        turn: (n + 1, 4) D, quaternions of rot_T_from_b.
        angle_b: (n, 3) angle turned in each block, b at its start.
        rate_b: (n, 3) mean rate against inertial space, rad/s.
        force_b: (n, 3) mean specific force, m/s².
        alpha: (n + 1, 3) ∫ D f, m/s.
        alpha_sum: (n + 1, 3) ∫ alpha, m.
        tilt_by_gyro: (n + 1, 3, 6) ∂ D by the gyroscopes' errors: D true = exp([tilt]×) D.
        alpha_by_gyro, alpha_by_accel: (n + 1, 3, 6) ∂ alpha: true − computed.
        sum_by_gyro, sum_by_accel: (n + 1, 3, 6) ∂ alpha_sum.
    """

    time_ns: Int64Array
    before_s: FloatArray
    turn: FloatArray
    angle_b: FloatArray
    rate_b: FloatArray
    force_b: FloatArray
    alpha: FloatArray
    alpha_sum: FloatArray
    tilt_by_gyro: FloatArray
    alpha_by_gyro: FloatArray
    alpha_by_accel: FloatArray
    sum_by_gyro: FloatArray
    sum_by_accel: FloatArray

    def pushed(self, gyro: FloatArray) -> FloatArray:
        """Return ∫ D f from each edge to the last, (n + 1, 3), with gyroscopes multiplied by a matrix (3, 3)."""
        forward = _prefix(np.concatenate([[[1.0, 0.0, 0.0, 0.0]], _turned_by(self.angle_b @ gyro.T)]))
        rot = rot_from_quaternion(quaternions.product(quaternions.conjugate(forward[-1]), forward[:-1]))
        push = self.force_b * (np.diff(self.time_ns) / SECOND_NS)[:, None]
        return _back(np.einsum("nij,nj->ni", rot, push))

    def at(self, time_ns: Int64Array) -> FeltAt:
        """Interpolate the integrals at times (m,) within the edges."""
        after = np.clip(np.searchsorted(self.time_ns, time_ns), 1, len(self.time_ns) - 1)
        left_s = (self.time_ns[after] - time_ns) / SECOND_NS
        length_s = (self.time_ns[after] - self.time_ns[after - 1]) / SECOND_NS
        share = left_s / length_s

        def linear(values: FloatArray) -> FloatArray:
            part = share.reshape(-1, *[1] * (values.ndim - 1))
            mixed: FloatArray = (1.0 - part) * values[after] + part * values[after - 1]
            return mixed

        alpha = linear(self.alpha)
        turn = quaternions.product(self.turn[after - 1], _turned_by((1.0 - share)[:, None] * self.angle_b[after - 1]))
        middle_ns = self.time_ns[:-1] + np.diff(self.time_ns) // 2 - self.time_ns[0]
        since_ns = time_ns - self.time_ns[0]
        rate = np.stack([np.interp(since_ns, middle_ns, self.rate_b[:, axis]) for axis in range(3)], axis=-1)
        return FeltAt(
            (self.time_ns[-1] - time_ns) / SECOND_NS,
            rot_from_quaternion(turn),
            rate,
            alpha,
            self.alpha_sum[after] + 0.5 * left_s[:, None] * (alpha + self.alpha[after]),
            linear(self.tilt_by_gyro),
            linear(self.alpha_by_gyro),
            linear(self.alpha_by_accel),
            linear(self.sum_by_gyro),
            linear(self.sum_by_accel),
        )


@dataclass(frozen=True, eq=False)
class FeltAt:
    """`Felt` at m moments; `rot` (m, 3, 3) is D, `rate_b` (m, 3) is in b of the moment."""

    before_s: FloatArray
    rot: FloatArray
    rate_b: FloatArray
    alpha: FloatArray
    alpha_sum: FloatArray
    tilt_by_gyro: FloatArray
    alpha_by_gyro: FloatArray
    alpha_by_accel: FloatArray
    sum_by_gyro: FloatArray
    sum_by_accel: FloatArray


class Blocks:
    """Samples summed over a fixed grid of GPS time; no number depends on their division into batches.

    Attributes:
        covered_ns: end of the last complete block; None before the first.
    """

    def __init__(self) -> None:
        self.covered_ns: int | None = None
        self._rest: Inertial | None = None  # samples of the incomplete block
        self._ends_ns = np.zeros(0, np.int64)
        self._lengths_s = np.zeros(0)
        self._begins_anew = np.zeros(0, np.bool_)
        self._angle_b = np.zeros((0, 3))
        self._velocity_b = np.zeros((0, 3))

    def feed(self, inertial: Inertial) -> None:
        """Take the next samples, which must be later than all before."""
        joined = inertial if self._rest is None else _joined(self._rest, inertial)
        if not len(joined):
            return
        number = (joined.time_ns - 1) // BLOCK_NS
        begins_ns = joined.time_ns - np.rint(joined.interval_s * SECOND_NS).astype(np.int64)
        apart = begins_ns[1:] - joined.time_ns[:-1] > _APART_NS * joined.interval_s[1:]
        first = np.flatnonzero(np.concatenate([[True], (np.diff(number) > 0) | apart]))
        whole = int(first[-1])
        self._rest = joined.between(whole, len(joined))
        if whole:
            self._sum(joined.between(0, whole), first[:-1], begins_ns[first[:-1]])

    def forget_before(self, time_ns: int) -> None:
        """Drop blocks that end before a time."""
        first = int(np.searchsorted(self._ends_ns, time_ns))
        for name in ("_ends_ns", "_lengths_s", "_begins_anew", "_angle_b", "_velocity_b"):
            setattr(self, name, getattr(self, name)[first:])

    def felt(self, begin_ns: int, end_ns: int) -> Felt | None:
        """Return integrals back from `end_ns` over gapless blocks, from the first that begins at `begin_ns` or later.

        Returns:
            None if no block holds `end_ns`.
        """
        last = int(np.searchsorted(self._ends_ns, end_ns))
        if last >= len(self._ends_ns):
            return None
        first = max(int(np.searchsorted(self._ends_ns, begin_ns, side="right")), 0)
        broken = np.flatnonzero(self._begins_anew[: last + 1])
        first = min(max(first, int(broken[-1]) if len(broken) else 0), last)
        lengths_ns = np.rint(self._lengths_s[first : last + 1] * SECOND_NS).astype(np.int64)
        starts_ns = np.concatenate([[self._ends_ns[first] - lengths_ns[0]], self._ends_ns[first:last]])
        share = (end_ns - starts_ns[-1]) / (self._ends_ns[last] - starts_ns[-1])
        if share <= 0.0:
            return None
        shares = np.ones(last + 1 - first)
        shares[-1] = share
        edges_ns = np.concatenate([starts_ns, [end_ns]])
        parts = (self._angle_b[first : last + 1], self._velocity_b[first : last + 1])
        return _integrals(edges_ns, parts[0] * shares[:, None], parts[1] * shares[:, None])

    def _sum(self, samples: Inertial, first: NDArray[np.intp], begins_ns: Int64Array) -> None:
        """Add complete blocks: total turn with coning, force in the axes of the block's start with sculling."""
        counts = np.diff(first, append=len(samples))
        angle, velocity, coning = np.zeros((3, len(first), 3))
        for k in range(int(counts.max())):  # the k-th sample of every block that has one
            block = np.flatnonzero(counts > k)
            turned, pushed = samples.angle_b[first[block] + k], samples.velocity_b[first[block] + k]
            middle = angle[block] + 0.5 * turned
            once = np.cross(middle, pushed)
            velocity[block] += pushed + once + 0.5 * np.cross(middle, once)
            coning[block] += 0.5 * np.cross(angle[block], turned)
            angle[block] += turned
        ends_ns = samples.time_ns[first + counts - 1]
        before_ns = np.concatenate([[self.covered_ns or 0], ends_ns[:-1]])
        broken = begins_ns - before_ns > _APART_NS * samples.interval_s[first]
        self._ends_ns = np.concatenate([self._ends_ns, ends_ns])
        self._lengths_s = np.concatenate([self._lengths_s, (ends_ns - begins_ns) / SECOND_NS])
        self._begins_anew = np.concatenate([self._begins_anew, broken])
        self._angle_b = np.concatenate([self._angle_b, angle + coning])
        self._velocity_b = np.concatenate([self._velocity_b, velocity])
        self.covered_ns = int(ends_ns[-1])


def _integrals(edges_ns: Int64Array, angle_b: FloatArray, velocity_b: FloatArray) -> Felt:
    """Return the `Felt` of blocks between edges."""
    length_s = np.diff(edges_ns) / SECOND_NS
    step = length_s[:, None]
    rate, force = angle_b / step, velocity_b / step
    forward = _prefix(np.concatenate([[[1.0, 0.0, 0.0, 0.0]], _turned_by(angle_b)]))
    turn = quaternions.product(quaternions.conjugate(forward[-1]), forward)
    rot = rot_from_quaternion(turn)
    middle = rot_from_quaternion(quaternions.product(turn[:-1], _turned_by(0.5 * angle_b)))
    gyro = np.concatenate([middle, middle * rate[:, None, :]], axis=2) * step[:, :, None]
    accel = np.concatenate([middle, middle * force[:, None, :]], axis=2) * step[:, :, None]
    push = np.einsum("nij,nj->ni", rot[:-1], velocity_b)
    tilt = _back(gyro)
    alpha = _back(push)
    # ∫ φ × (D f) with φ = tilt · errors: −[D f]× tilt, at each block's middle.
    alpha_by_gyro = _back(-skew(push) @ (0.5 * (tilt[1:] + tilt[:-1])))
    alpha_by_accel = _back(-accel)

    def summed(values: FloatArray) -> FloatArray:
        weights = length_s.reshape(-1, *[1] * (values.ndim - 1))
        return _back(0.5 * weights * (values[1:] + values[:-1]))

    return Felt(
        edges_ns,
        (edges_ns[-1] - edges_ns) / SECOND_NS,
        turn,
        angle_b,
        rate,
        force,
        alpha,
        summed(alpha),
        tilt,
        alpha_by_gyro,
        alpha_by_accel,
        summed(alpha_by_gyro),
        summed(alpha_by_accel),
    )


def _back(parts: FloatArray) -> FloatArray:
    """Return sums from each edge (n + 1) to the last, of parts (n, …)."""
    sums = np.zeros((len(parts) + 1, *parts.shape[1:]))
    sums[:-1] = np.cumsum(parts[::-1], axis=0)[::-1]
    return sums


def _prefix(q: FloatArray) -> FloatArray:
    """Return (n, 4) products q_0 ⊗ … ⊗ q_k of (n, 4), by doubling."""
    product, reach = q.copy(), 1
    while reach < len(product):
        product[reach:] = quaternions.product(product[:-reach], product[reach:])
        reach *= 2
    unit: FloatArray = product / np.linalg.norm(product, axis=-1, keepdims=True)
    return unit


def _turned_by(vector: FloatArray) -> FloatArray:
    """Return quaternions (n, 4) of rotation vectors (n, 3)."""
    half = 0.5 * np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * vector], axis=-1)


def _joined(a: Inertial, b: Inertial) -> Inertial:
    """Return the samples of both, one after the other."""
    return Inertial(
        np.concatenate([a.time_ns, b.time_ns]),
        np.concatenate([a.interval_s, b.interval_s]),
        np.concatenate([a.angle_b, b.angle_b]),
        np.concatenate([a.velocity_b, b.velocity_b]),
        np.concatenate([a.bridged, b.bridged]),
    )
