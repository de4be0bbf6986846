"""The smoother: estimate each moment from all observations, later ones included (Rauch, Tung, Striebel 1965).

It has the adjoint form of Bryson and Frazier (Bierman 1973, "Fixed interval smoothing with discrete measurements"),
which gives the same estimate and covariance without inverting a covariance, so that perfectly known states do no harm.
From the last node back, with the components taken and the transitions between nodes:

    λ ← (1 − K h)ᵀ λ + hᵀ ν / s        Λ ← (1 − K h)ᵀ Λ (1 − K h) + hᵀ h / s        over an observed component
    λ ← Φᵀ λ                            Λ ← Φᵀ Λ Φ                                    over the way between nodes

    smoothed error of the filter's state: P λ        smoothed covariance: P − P Λ P

If the filter did not begin at the mean of the prior knowledge (`solve` begins again from the smoothed attitude), its
errors have a mean from the start on: m ← Φ m, m ← (1 − K h) m. An innovation ν then counts as ν − h m, and the smoothed
error is m + P λ: the same as for a filter that began at the mean, but linear about the better state.

At a node the error is added to the filter's state by the exponential. Between two nodes the filter's own path is bent
so that it leaves from one smoothed state and arrives at the next: attitude and velocity linearly, position by the cubic
that has these velocities at its ends.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.compiled import jit_cached, jit_inline
from swath.georef.geodesy.vectors import dot, rot_of
from swath.georef.navigation.filter.error_model import (
    E_ACCEL_LEAN,
    E_ATTITUDE,
    E_GYRO_LEAN,
    E_POSITION,
    E_SENSORS,
    MOVED,
    Layout,
    inject,
    turned_on_by,
)
from swath.georef.navigation.filter.filter import PIECE, FilterRun
from swath.georef.navigation.filter.level import attitude_rows, in_level, level_axes
from swath.georef.navigation.filter.loop import level_sigmas
from swath.georef.navigation.filter.strapdown import (
    ACCEL_BIAS,
    ACCEL_LEAN,
    ACCEL_SCALE,
    ATTITUDE,
    GYRO_BIAS,
    GYRO_LEAN,
    GYRO_SCALE,
    LEVER_ARM,
    STATE_SIZE,
    TIME_OFFSET,
    VELOCITY,
    copy_into,
    put,
    three,
)
from swath.georef.navigation.filter.types import Nodes, Path
from swath.georef.navigation.inputs import Solution

SECOND = 1e-9  # seconds in a nanosecond


@dataclass(frozen=True, eq=False)
class SmoothedNodes:
    """The smoothed results at m nodes.

    Attributes:
        time_ns: (m,).
        state: (m, STATE_SIZE) by the columns of `strapdown`.
        sigma: (m, 9) of position and velocity north, east, down, of roll, pitch, heading.
        sensor_sigma: (m, n − 9) of the other errors, in the order of `error_model`.
        leave, arrive: (m, 9) smoothed − filtered position, velocity and attitude in e, with and without the node's
            observations.
        separation, separation_sigma: (m, 9) filtered − smoothed, and its sigma; filtered with its errors' mean.
    """

    time_ns: Int64Array
    state: FloatArray
    sigma: FloatArray
    sensor_sigma: FloatArray
    leave: FloatArray
    arrive: FloatArray
    separation: FloatArray
    separation_sigma: FloatArray


def smooth(run: FilterRun) -> Solution:
    """Smooth a whole run."""
    return solution_of(run, smooth_nodes(run))


def forward(run: FilterRun) -> Solution:
    """Return the filter's own solution: each epoch from the observations up to it."""
    return solution_of(run, None)


def smooth_nodes(run: FilterRun, mean: FloatArray | None = None) -> SmoothedNodes:
    """Smooth the nodes of a run.

    Args:
        run: of the filter.
        mean: (n,) of the errors at the start, true − the run's start; None: 0.
    """
    n, m = run.layout.size, sum(len(block.time_ns) for block in run.nodes)
    out = SmoothedNodes(
        np.concatenate([block.time_ns for block in run.nodes]),
        np.empty((m, STATE_SIZE)),
        np.empty((m, 9)),
        np.empty((m, n - MOVED)),
        np.empty((m, 9)),
        np.empty((m, 9)),
        np.empty((m, 9)),
        np.empty((m, 9)),
    )
    means, felt = _means(run, mean)
    adjoint, information = np.zeros(n), np.zeros((n, n))
    end = m
    for block, of_components in zip(reversed(run.nodes), reversed(felt), strict=True):
        part = slice(end - len(block.time_ns), end)
        _backward(
            block,
            run.layout,
            means[part],
            of_components,
            adjoint,
            information,
            out.state[part],
            out.sigma[part],
            out.sensor_sigma[part],
            out.leave[part],
            out.arrive[part],
            out.separation[part],
            out.separation_sigma[part],
        )
        run.storage.rest()
        end = part.start
    return out


def _means(run: FilterRun, mean: FloatArray | None) -> tuple[FloatArray, list[FloatArray]]:
    """Return means (m, n) of errors at nodes, without rows if None; by block, (k,) their effect on innovations."""
    if mean is None:
        return np.zeros((0, 0)), [np.zeros(0) for _ in run.nodes]
    means = run.storage.empty((sum(len(block.time_ns) for block in run.nodes), run.layout.size), np.float64)
    going, felt, begin = mean.copy(), [], 0
    for block in run.nodes:
        felt.append(np.empty(len(block.h)))
        _forward(block, going, means[begin : begin + len(block.time_ns)], felt[-1])
        begin += len(block.time_ns)
    return means, felt


@jit_cached
def _forward(nodes: Nodes, mean: FloatArray, means: FloatArray, felt: FloatArray) -> None:
    """Carry the errors' mean (n,), which is changed, over a block of nodes.

    Args:
        nodes: the block.
        mean: (n,) changed.
        means: (c, n) is filled, with the nodes' observations.
        felt: (k,) is filled: the amount by which each component's innovation over its variance is reduced.
    """
    n, core = len(mean), nodes.top.shape[2]
    moved = np.empty(MOVED)
    for k in range(len(nodes.time_ns)):
        for i in range(MOVED):
            value = 0.0
            for j in range(core):
                value += nodes.top[k, i, j] * mean[j]
            moved[i] = value
        for i in range(n):
            mean[i] = moved[i] if i < MOVED else mean[i] * nodes.decay[k, i]
        end = nodes.first[k + 1] if k + 1 < len(nodes.time_ns) else len(nodes.h)
        for i in range(nodes.first[k], end):
            along = 0.0
            for j in range(n):
                along += nodes.h[i, j] * mean[j]
            felt[i] = along * nodes.weighed[i, 1]
            for j in range(n):
                mean[j] -= nodes.gain[i, j] * along
        copy_into(means[k], mean)


@jit_inline
def _unpack(packed: FloatArray, p: FloatArray) -> None:
    """Expand a lower triangle, stored by rows, to (n, n)."""
    at = 0
    for i in range(len(p)):
        for j in range(i + 1):
            p[i, j] = p[j, i] = packed[at]
            at += 1


@jit_inline
def _product(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Compute out ← a b, (n, n)."""
    n = len(a)
    for i in range(n):
        out[i, :] = 0.0
        for k in range(n):
            factor = a[i, k]
            if factor != 0.0:
                for j in range(n):
                    out[i, j] += factor * b[k, j]


@jit_inline
def _over_component(
    adjoint: FloatArray, information: FloatArray, h: FloatArray, gain: FloatArray, innovation: float, inverse: float
) -> None:
    """Carry λ and Λ back over an observed component.

    Args:
        adjoint, information: λ (n,) and Λ (n, n), which are changed.
        h, gain: (n,) of the component.
        innovation, inverse: its innovation and 1, each over its variance.
    """
    n = len(adjoint)
    along, through = 0.0, 0.0
    seen = np.empty(n)
    for i in range(n):
        along += gain[i] * adjoint[i]
        value = 0.0
        for j in range(n):
            value += information[i, j] * gain[j]
        seen[i] = value
    for i in range(n):
        through += gain[i] * seen[i]
    for i in range(n):
        adjoint[i] += h[i] * (innovation - along)
        for j in range(n):
            information[i, j] += h[i] * h[j] * (through + inverse) - h[i] * seen[j] - seen[i] * h[j]


@jit_inline
def _over_way(
    adjoint: FloatArray, information: FloatArray, top: FloatArray, decay: FloatArray, work: FloatArray
) -> None:
    """Carry λ and Λ from a node back to the one before: Φᵀ λ, Φᵀ Λ Φ."""
    n, core = len(adjoint), top.shape[1]
    for i in range(n):
        for j in range(n):
            work[i, j] = 0.0 if j < MOVED else information[i, j] * decay[j]
        for k in range(MOVED):
            factor = information[i, k]
            for j in range(core):
                work[i, j] += factor * top[k, j]
    for i in range(n):
        for j in range(n):
            information[i, j] = 0.0 if i < MOVED else work[i, j] * decay[i]
    for k in range(MOVED):
        for i in range(core):
            factor = top[k, i]
            if factor != 0.0:
                for j in range(n):
                    information[i, j] += factor * work[k, j]
    for i in range(n):
        for j in range(i):
            information[i, j] = information[j, i] = 0.5 * (information[i, j] + information[j, i])
    back = work[0]
    for j in range(n):
        back[j] = 0.0 if j < MOVED else adjoint[j] * decay[j]
    for k in range(MOVED):
        for j in range(core):
            back[j] += top[k, j] * adjoint[k]
    copy_into(adjoint, back)


@jit_inline
def difference(x: FloatArray, from_x: FloatArray, out: FloatArray) -> None:
    """Compute out (9,) ← x ⊟ from_x, the error to add to from_x to get x."""
    for i in range(6):
        out[i] = x[i] - from_x[i]
    a, b, c, d = x[ATTITUDE], x[ATTITUDE + 1], x[ATTITUDE + 2], x[ATTITUDE + 3]
    w, u, v, t = from_x[ATTITUDE], -from_x[ATTITUDE + 1], -from_x[ATTITUDE + 2], -from_x[ATTITUDE + 3]
    scalar = a * w - b * u - c * v - d * t
    i, j, k = a * u + b * w + c * t - d * v, a * v - b * t + c * w + d * u, a * t + b * v - c * u + d * w
    sine = math.sqrt(i * i + j * j + k * k)
    factor = 2.0
    if sine > 0.0:
        factor = 2.0 * math.atan2(sine, abs(scalar)) / sine
    if scalar < 0.0:
        factor = -factor
    put(out, E_ATTITUDE, (factor * i, factor * j, factor * k))


@jit_inline
def _separate(x: FloatArray, error: FloatArray, out: FloatArray) -> None:
    """Compute out (9,) ← −error north, east, down, and of roll, pitch, heading."""
    axes = level_axes(x)
    _, by = attitude_rows(axes, rot_of(x[ATTITUDE], x[ATTITUDE + 1], x[ATTITUDE + 2], x[ATTITUDE + 3]))
    position, velocity = in_level(axes, three(error, 0)), in_level(axes, three(error, 3))
    for i in range(3):
        out[i], out[3 + i] = -position[i], -velocity[i]
        out[6 + i] = -(by[i][0] * error[6] + by[i][1] * error[7] + by[i][2] * error[8])


@jit_inline
def _position_sigmas_in_gnss_time(x: FloatArray, p: FloatArray, late: int, sigma: FloatArray) -> None:
    """Compute sigma (3,) of r + v τ, north, east, down, with τ the time offset, at ``late`` among the errors.

    GNSS observes this sum, so that it is known better than r at a moment of the inertial unit's time. The change of
    speed and attitude within τ's sigma is ignored: in a flight with turns that is well below a millisecond.
    """
    axes = level_axes(x)
    for i in range(3):
        speed = dot(axes[i], three(x, VELOCITY))
        shared = dot(axes[i], (p[late, E_POSITION], p[late, E_POSITION + 1], p[late, E_POSITION + 2]))
        variance = sigma[i] * sigma[i] + speed * (2.0 * shared + speed * p[late, late])
        sigma[i] = math.sqrt(max(variance, 0.0))


@jit_cached
def _backward(
    nodes: Nodes, layout: Layout, means: FloatArray, felt: FloatArray, adjoint: FloatArray, information: FloatArray,
    state: FloatArray, sigma: FloatArray, sensor_sigma: FloatArray, leave: FloatArray, arrive: FloatArray,
    separation: FloatArray, separation_sigma: FloatArray,
) -> None:  # fmt: skip
    n = len(adjoint)
    p, once, twice = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    error, whole, end = np.empty(n), np.empty(n), len(nodes.h)
    for k in range(len(nodes.time_ns) - 1, -1, -1):
        _unpack(nodes.covariance[k], p)
        for i in range(n):
            value = 0.0
            for j in range(n):
                value += p[i, j] * adjoint[j]
            error[i] = value
            whole[i] = value + (means[k, i] if len(means) > 0 else 0.0)
        copy_into(state[k], nodes.after[k])
        inject(state[k], whole, layout)
        copy_into(leave[k], whole)
        difference(state[k], nodes.before[k], arrive[k])
        _separate(state[k], error, separation[k])
        _product(information, p, once)
        _product(p, once, twice)
        level_sigmas(state[k], twice, separation_sigma[k])
        for i in range(n):
            for j in range(n):
                p[i, j] -= twice[i, j]
        level_sigmas(state[k], p, sigma[k])
        if layout.time_offset >= 0:
            _position_sigmas_in_gnss_time(state[k], p, layout.time_offset, sigma[k])
        for i in range(MOVED, n):
            sensor_sigma[k, i - MOVED] = math.sqrt(max(p[i, i], 0.0))
        for i in range(end - 1, nodes.first[k] - 1, -1):
            innovation = nodes.weighed[i, 0] - (felt[i] if len(felt) > 0 else 0.0)
            _over_component(adjoint, information, nodes.h[i], nodes.gain[i], innovation, nodes.weighed[i, 1])
        end = nodes.first[k]
        _over_way(adjoint, information, nodes.top[k], nodes.decay[k], once)


@jit_cached
def _bend(
    path: Path, node_ns: Int64Array, leave: FloatArray, arrive: FloatArray, node_sigma: FloatArray,
    position_e: FloatArray, velocity_e: FloatArray, q: FloatArray, sigma: FloatArray,
) -> None:  # fmt: skip
    """Correct samples of the filter's path (n,) by the smoothed corrections at nodes (m,), and interpolate sigmas."""
    k, last, x = 0, len(node_ns) - 1, np.empty(10)
    for i in range(len(path.time_ns)):
        t = path.time_ns[i]
        while k < last and node_ns[k + 1] <= t:
            k += 1
        after = min(k + 1, last)
        span_s = SECOND * (node_ns[after] - node_ns[k])
        s = SECOND * (t - node_ns[k]) / span_s if span_s > 0.0 else 0.0
        copy_into(x, path.states[i])
        a, b = leave[k], arrive[after]
        if after == k:
            b = leave[k]
        rise, first, second = s * s * (3.0 - 2.0 * s), s * (1.0 - s) * (1.0 - s), s * s * (s - 1.0)
        for j in range(3):
            position_e[i, j] = x[j] + a[j] + rise * (b[j] - a[j]) + span_s * (first * a[3 + j] + second * b[3 + j])
            velocity_e[i, j] = x[3 + j] + a[3 + j] + s * (b[3 + j] - a[3 + j])
        turned_on_by(x, (a[6] + s * (b[6] - a[6]), a[7] + s * (b[7] - a[7]), a[8] + s * (b[8] - a[8])))
        for j in range(4):
            q[i, j] = x[ATTITUDE + j]
        for j in range(9):
            low, high = node_sigma[k, j], node_sigma[after, j]
            sigma[i, j] = math.sqrt(low * low + s * (high * high - low * low))


def _write(
    path: Path, smoothed: SmoothedNodes | None, position_e: FloatArray, velocity_e: FloatArray, q: FloatArray,
    sigma: FloatArray,
) -> None:  # fmt: skip
    """Fill a solution's rows with the path, bent or unchanged."""
    if smoothed is not None:
        nodes = smoothed.time_ns, smoothed.leave, smoothed.arrive, smoothed.sigma
        _bend(path, *nodes, position_e, velocity_e, q, sigma)
        return
    position_e[:], velocity_e[:], q[:] = path.states[:, :3], path.states[:, 3:6], path.states[:, 6:]
    sigma[:] = path.sigma


def solution_of(run: FilterRun, smoothed: SmoothedNodes | None, first: int = 0, last: int | None = None) -> Solution:
    """Return the solution at path rows first to last − 1: smoothed, or the filter's own if ``smoothed`` is None."""
    path = Path._make(column[first:last] for column in run.path)
    position_e, velocity_e, q, sigma = (run.storage.empty((len(path.time_ns), k), np.float64) for k in (3, 3, 4, 9))
    for begin in range(0, len(path.time_ns), PIECE):
        part = slice(begin, begin + PIECE)
        out = position_e[part], velocity_e[part], q[part], sigma[part]
        _write(Path._make(column[part] for column in path), smoothed, *out)
        run.storage.rest()
    if smoothed is None:
        time_ns = np.concatenate([block.time_ns for block in run.nodes])
        state = np.concatenate([block.after for block in run.nodes])
        sensor_sigma = np.concatenate([_sensor_sigmas(block.covariance, run.layout.size) for block in run.nodes])
        separation = separation_sigma = np.zeros((0, 9))
    else:
        time_ns, state, sensor_sigma = smoothed.time_ns, smoothed.state, smoothed.sensor_sigma
        separation, separation_sigma = smoothed.separation, smoothed.separation_sigma
    lever, offset = run.layout.lever_arm - MOVED, run.layout.time_offset - MOVED
    none = np.zeros((len(time_ns), 3))
    leans = len(time_ns) if run.layout.lean >= 0 else 0  # number of rows with misalignments
    gyro_lean, accel_lean = E_GYRO_LEAN - MOVED, E_ACCEL_LEAN - MOVED
    return Solution(
        time_ns=path.time_ns,
        position_e=position_e,
        velocity_e=velocity_e,
        q_e_from_b=q,
        position_sigma_l=sigma[:, :3],
        velocity_sigma_l=sigma[:, 3:6],
        attitude_sigma_rad=sigma[:, 6:],
        bridged=path.bridged,
        node_time_ns=time_ns,
        gyro_bias=state[:, GYRO_BIAS : GYRO_BIAS + 3],
        accel_bias=state[:, ACCEL_BIAS : ACCEL_BIAS + 3],
        gyro_scale=state[:, GYRO_SCALE : GYRO_SCALE + 3],
        accel_scale=state[:, ACCEL_SCALE : ACCEL_SCALE + 3],
        gyro_bias_sigma=sensor_sigma[:, :3],
        accel_bias_sigma=sensor_sigma[:, 3:6],
        gyro_scale_sigma=sensor_sigma[:, 6:9],
        accel_scale_sigma=sensor_sigma[:, 9:12],
        lever_arm_b=state[:, LEVER_ARM : LEVER_ARM + 3],
        lever_arm_sigma=sensor_sigma[:, lever : lever + 3] if lever >= 0 else none,
        time_offset_s=state[:, TIME_OFFSET],
        time_offset_sigma_s=sensor_sigma[:, offset] if offset >= 0 else none[:, 0],
        innovations=run.innovations,
        counts=run.counts,
        separation=separation,
        separation_sigma=separation_sigma,
        gyro_misalignment=state[:leans, GYRO_LEAN : GYRO_LEAN + 3],
        accel_misalignment=state[:leans, ACCEL_LEAN : ACCEL_LEAN + 3],
        gyro_misalignment_sigma=sensor_sigma[:leans, gyro_lean : gyro_lean + 3] if leans else none[:0],
        accel_misalignment_sigma=sensor_sigma[:leans, accel_lean : accel_lean + 3] if leans else none[:0],
    )


def _sensor_sigmas(packed: FloatArray, size: int) -> FloatArray:
    """Return sigmas (m, size − 9) from covariances packed by rows."""
    diagonal = [i * (i + 1) // 2 + i for i in range(E_SENSORS, size)]
    sigmas: FloatArray = np.sqrt(np.maximum(packed[:, diagonal], 0.0))
    return sigmas
