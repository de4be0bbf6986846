"""Run the filter over samples, compiled: strapdown, covariance steps, observations at their own times, nodes.

Steps end with the first sample at or after whole multiples of their length in GPS time, and at observations, so that
the result does not depend on the division of the input.
"""

from __future__ import annotations

import math

import numpy as np

from swath.georef.arrays import FloatArray
from swath.georef.compiled import jit_cached, jit_inline
from swath.georef.geodesy.vectors import rot_of
from swath.georef.navigation.bridging import UNKNOWN_FORCE_MPS2, UNKNOWN_RATE_RADPS
from swath.georef.navigation.filter.error_model import (
    E_ATTITUDE,
    E_POSITION,
    E_VELOCITY,
    MOVED,
    accumulate,
    add_noise,
    begin_accumulation,
    decays,
    fade,
    inject,
    propagate,
    transition,
)
from swath.georef.navigation.filter.gate import drifted, judge, leapt, noise_factor, settling, still_away
from swath.georef.navigation.filter.kalman import factorise, innovation_covariance, take_component, whiten, whiten_rows
from swath.georef.navigation.filter.level import attitude_rows, level_axes
from swath.georef.navigation.filter.measurements import predict
from swath.georef.navigation.filter.strapdown import (
    ATTITUDE,
    SUM_TIME,
    SUMS_SIZE,
    Samples,
    advance_part,
    coning_and_sculling,
    copy_into,
    keep_before,
    row,
)
from swath.georef.navigation.filter.types import (
    CHI2,
    GAPS,
    INFLATION,
    KINDS,
    LOG_DET,
    NEXT_NODE,
    NEXT_STEP,
    NODE,
    NORMALISED,
    NOW,
    NU,
    OUT,
    SCALAR,
    SIGMA,
    STARTED,
    Model,
    Nodes,
    Path,
    Rows,
    Running,
    Told,
)
from swath.georef.navigation.inputs import Fate
from swath.georef.scanner.kernels.types import Three

_INFLATED, _REJECTED, _UNUSABLE = int(Fate.INFLATED), int(Fate.REJECTED), int(Fate.UNUSABLE)
GAP_FACTOR = 1.5  # intervals: a sample that comes later than this leaves a gap


@jit_inline
def quadratic(p: FloatArray, first: int, v: Three) -> float:
    """Return vᵀ P v of the 3×3 block that begins at ``first``."""
    value: float = (
        p[first, first] * v[0] * v[0]
        + p[first + 1, first + 1] * v[1] * v[1]
        + p[first + 2, first + 2] * v[2] * v[2]
        + 2.0
        * (
            p[first + 1, first] * v[0] * v[1]
            + p[first + 2, first] * v[0] * v[2]
            + p[first + 2, first + 1] * v[1] * v[2]
        )
    )
    return value


@jit_cached
def level_sigmas(x: FloatArray, p: FloatArray, sigma: FloatArray) -> None:
    """Compute sigmas (9,) of position and velocity north, east, down, of roll, pitch, heading.

    P's lower triangle is used.
    """
    axes = level_axes(x)
    rot = rot_of(x[ATTITUDE], x[ATTITUDE + 1], x[ATTITUDE + 2], x[ATTITUDE + 3])
    _, by = attitude_rows(axes, rot)
    for i in range(3):
        sigma[i] = math.sqrt(max(quadratic(p, E_POSITION, axes[i]), 0.0))
        sigma[3 + i] = math.sqrt(max(quadratic(p, E_VELOCITY, axes[i]), 0.0))
        sigma[6 + i] = math.sqrt(max(quadratic(p, E_ATTITUDE, by[i]), 0.0))


@jit_cached
def end_step(run: Running, model: Model) -> None:
    """Propagate the covariance to the present, and let the estimates of decaying errors decay."""
    if run.sums[SUM_TIME] <= 0.0:
        return
    transition(run.sums, run.x, run.top)
    decays(model.drive, run.sums[SUM_TIME], run.decay)
    fade(run.x, run.decay, model.layout)
    propagate(run.p, run.top, run.decay, run.work)
    add_noise(run.p, run.sums, model.drive, run.decay, run.bridge)
    accumulate(run.total, run.total_decay, run.top, run.decay, run.work)
    run.sums[: SUM_TIME + 1] = 0.0
    run.sums[SUMS_SIZE:] = 0.0
    run.bridge[:, :] = 0.0


@jit_cached
def write_node(run: Running, nodes: Nodes, before: FloatArray, first: int) -> None:
    """Store a node for the smoother, and begin the transition to the next one."""
    k = run.clock[NODE]
    nodes.time_ns[k] = run.clock[NOW]
    copy_into(nodes.before[k], before)
    copy_into(nodes.after[k], run.x)
    at = 0
    for i in range(len(run.p)):
        for j in range(i + 1):
            nodes.covariance[k, at] = run.p[i, j]
            at += 1
    for i in range(MOVED):
        copy_into(nodes.top[k, i], run.total[i])
    copy_into(nodes.decay[k], run.total_decay)
    nodes.first[k] = first
    run.clock[NODE] = k + 1
    begin_accumulation(run.total, run.total_decay)


@jit_inline
def tell(told: Told, r: int, nu: FloatArray, s: FloatArray, m: int, white: FloatArray) -> float:
    """Write innovation, sigma, normalised innovation and χ²; return χ². s becomes its Cholesky factor."""
    for i in range(3):
        told.figures[r, NU + i] = nu[i] if i < m else np.nan
        told.figures[r, SIGMA + i] = math.sqrt(s[i, i]) if i < m else np.nan
        told.figures[r, NORMALISED + i] = np.nan
    chi2 = chi2_of(nu, s, m, white)
    for i in range(m):
        told.figures[r, NORMALISED + i] = white[i]
    told.figures[r, CHI2] = chi2
    log_det = 0.0
    for i in range(m):
        log_det += 2.0 * math.log(s[i, i])
    told.figures[r, LOG_DET] = log_det
    return chi2


@jit_inline
def chi2_of(nu: FloatArray, s: FloatArray, m: int, white: FloatArray) -> float:
    """Return νᵀ S⁻¹ ν; ``white`` becomes L⁻¹ ν, s its factor L. The result is infinite if S is not positive."""
    for i in range(m):
        white[i] = nu[i]
    if not factorise(s, m):
        return math.inf
    whiten(s, white, m)
    chi2 = 0.0
    for i in range(m):
        chi2 += white[i] * white[i]
    return chi2


@jit_inline
def multiply(matrix: FloatArray, factor: float) -> None:
    """Multiply a matrix (3, 3) by a number."""
    for i in range(3):
        for j in range(3):
            matrix[i, j] *= factor


@jit_cached
def observe(run: Running, model: Model, rows: Rows, r: int, nodes: Nodes, told: Told) -> None:
    """Take observation r at the state's time, or record why it is not taken."""
    nu, noise, s = run.small[0], run.small[1:4], run.small[4:7]
    kind = int(rows.what[r, 0])
    told.figures[r, INFLATION] = 1.0
    m = 0
    if kind < KINDS:
        m = predict(run.x, run.sums, model.rules, model.layout, rows.what[r], rows.figures[r], nu, run.rows, noise)
    told.dimension[r] = m
    if m == 0:
        told.fate[r] = _UNUSABLE
        for i in range(INFLATION):
            told.figures[r, i] = np.nan
        return
    innovation_covariance(run.p, run.rows, noise, m, s)
    lost = drifted(kind, s, noise, m)
    chi2 = tell(told, r, nu, s, m, run.small[7])
    if still_away(run, model, kind, chi2, m):
        told.fate[r] = _REJECTED
        return
    settles = settling(run, model, kind, lost, chi2, m)
    if leapt(run, model, kind, settles, chi2, m):
        told.fate[r] = _REJECTED
        return
    factor = 1.0
    if not settles:
        factor = noise_factor(run, kind, run.small[7], chi2, m, model.rules.gate[m] * model.rules.reject)
    if factor == 0.0:
        settles, factor = True, 1.0
    if factor > 1.0:
        multiply(noise, factor)
        innovation_covariance(run.p, run.rows, noise, m, s)
        chi2 = chi2_of(nu, s, m, run.small[7])
    fate = judge(run, model, kind, settles, chi2, m)
    if fate == _INFLATED:
        excess = chi2 / model.rules.gate[m]
        multiply(noise, excess)
        factor *= excess
    told.figures[r, INFLATION] = math.sqrt(factor)
    told.fate[r] = fate
    if fate == _REJECTED:
        return
    if not factorise(noise, m):
        told.fate[r] = _UNUSABLE
        return
    take(run, model, nodes, m)


@jit_inline
def take(run: Running, model: Model, nodes: Nodes, m: int) -> None:
    """Whiten and take the components one by one, then correct the state."""
    nu, factor = run.small[0], run.small[1:4]
    whiten(factor, nu, m)
    whiten_rows(factor, run.rows, m)
    run.error[:] = 0.0
    for i in range(m):
        k = run.clock[SCALAR]
        weighed = take_component(run.p, run.rows[i], nu[i], run.error, run.gain)
        nodes.weighed[k, 0], nodes.weighed[k, 1] = weighed
        copy_into(nodes.h[k], run.rows[i])
        copy_into(nodes.gain[k], run.gain)
        run.clock[SCALAR] = k + 1
    inject(run.x, run.error, model.layout)


@jit_inline
def bridge_over(run: Running, made_up: FloatArray, gap_s: float) -> None:
    """Add a made-up sample's variances, (6,) by axis of b, to the step; for an unbridged gap add the assumed ones."""
    unseen_turn, unseen_push = (UNKNOWN_RATE_RADPS * gap_s) ** 2, (UNKNOWN_FORCE_MPS2 * gap_s) ** 2
    x = run.x
    rot = rot_of(x[ATTITUDE], x[ATTITUDE + 1], x[ATTITUDE + 2], x[ATTITUDE + 3])
    for i in range(3):
        for j in range(3):
            for axis in range(3):
                share = rot[i][axis] * rot[j][axis]
                run.bridge[i, j] += share * (made_up[axis] + unseen_turn)
                run.bridge[3 + i, j] += share * (made_up[3 + axis] + unseen_push)


@jit_inline
def share_of(samples: Samples, i: int, now_ns: int, first: bool) -> float:
    """Return the factor on a sample's increments for the time from now to its end.

    It is 1, except for the sample in which the start lies (less), and where samples are missing without bridging (more:
    the gap takes the present sample's rates).
    """
    span_s: float = 1e-9 * (samples.time_ns[i] - now_ns)
    interval_s: float = samples.interval_s[i]
    if not interval_s > 0.0:
        return 1.0
    if (first and span_s < interval_s) or span_s > GAP_FACTOR * interval_s:
        share: float = span_s / interval_s
        return share
    return 1.0


@jit_cached
def advance(
    samples: Samples, first: int, last: int, rows: Rows, next_row: int, run: Running, model: Model,
    path: Path, nodes: Nodes, told: Told,
) -> int:  # fmt: skip
    """Run over samples first to last − 1 and the observations up to the end of the last.

    The outputs must have room: one path row per sample; one node per row and per `node_ns`, and one more; three
    components per row.

    Returns:
        The first row that is still to come.
    """
    clock, x = run.clock, run.x
    before = np.empty(10)
    for i in range(first, last):
        end_ns, begin_ns = samples.time_ns[i], clock[NOW]
        if end_ns <= begin_ns:
            keep_before(run.before, row(samples.angle_b, i), row(samples.velocity_b, i), samples.interval_s[i])
            continue
        span_s = 1e-9 * (end_ns - begin_ns)
        share = share_of(samples, i, begin_ns, clock[STARTED] == 0)
        clock[STARTED] = 1
        a, b = row(samples.angle_b, i), row(samples.velocity_b, i)
        angle, velocity = (share * a[0], share * a[1], share * a[2]), (share * b[0], share * b[1], share * b[2])
        gap = share > 1.0
        clock[GAPS] += gap
        coned, sculled = coning_and_sculling(run.before, angle, velocity, span_s)
        if samples.bridged[i] or gap:
            bridge_over(run, samples.made_up[i], span_s if gap else 0.0)
        while next_row < len(rows.time_ns) and rows.time_ns[next_row] <= end_ns:
            at_ns = rows.time_ns[next_row]
            advance_share(x, run.sums, coned, sculled, 1e-9 * (at_ns - clock[NOW]), span_s)
            clock[NOW] = at_ns
            end_step(run, model)
            copy_into(before, x)
            component = clock[SCALAR]
            while next_row < len(rows.time_ns) and rows.time_ns[next_row] == at_ns:
                observe(run, model, rows, next_row, nodes, told)
                next_row += 1
            write_node(run, nodes, before, component)
            level_sigmas(x, run.p, run.sigma)
        advance_share(x, run.sums, coned, sculled, 1e-9 * (end_ns - clock[NOW]), span_s)
        clock[NOW] = end_ns
        keep_before(run.before, angle, velocity, span_s)
        end_sample(run, model, nodes)
        write_path(run, path, samples.bridged[i] or gap)
    return next_row


@jit_inline
def end_sample(run: Running, model: Model, nodes: Nodes) -> None:
    """End a step and set a node where they are due."""
    now_ns = run.clock[NOW]
    if now_ns >= run.clock[NEXT_STEP] or now_ns >= run.clock[NEXT_NODE]:
        end_step(run, model)
        level_sigmas(run.x, run.p, run.sigma)
        run.clock[NEXT_STEP] = (now_ns // model.step_ns + 1) * model.step_ns
    if now_ns >= run.clock[NEXT_NODE]:
        write_node(run, nodes, run.x, run.clock[SCALAR])
        run.clock[NEXT_NODE] = (now_ns // model.node_ns + 1) * model.node_ns


@jit_inline
def write_path(run: Running, path: Path, bridged: bool) -> None:
    """Write the state and its sigmas at the end of a sample."""
    out = run.clock[OUT]
    path.time_ns[out] = run.clock[NOW]
    path.bridged[out] = bridged
    for j in range(10):
        path.states[out, j] = run.x[j]
    for j in range(9):
        path.sigma[out, j] = run.sigma[j]
    run.clock[OUT] = out + 1


@jit_inline
def advance_share(x: FloatArray, sums: FloatArray, angle: Three, velocity: Three, part_s: float, span_s: float) -> None:
    """Advance over a part of a sample, with its share of the increments."""
    if part_s <= 0.0:
        return
    if part_s == span_s:
        advance_part(x, sums, angle, velocity, span_s)
        return
    f = part_s / span_s
    advance_part(
        x,
        sums,
        (f * angle[0], f * angle[1], f * angle[2]),
        (f * velocity[0], f * velocity[1], f * velocity[2]),
        part_s,
    )
