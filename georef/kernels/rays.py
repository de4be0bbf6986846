"""Returns to points in e, one pass over the rows (ISO/TS 19159-2 Eq. 10 with CONVENTIONS' parameters).

The trajectory is followed by a moving pointer; what belongs to one of its intervals is computed when the pointer comes
to it. Within the pass everything is numbers: nothing is allocated, and no array is passed on but where an interval
changes, for numba counts references to arrays.
"""

from __future__ import annotations

import math
from typing import Any

from georef.compiled import kept, kernel
from georef.kernels.beam import FIXED_ANGLE, RANGE, beam_of, row_of, turn_of
from georef.kernels.rotations import (
    cross,
    dot,
    matrix_at,
    plus,
    product,
    times,
    transposed_times,
    turn_factors,
    turned_on,
    turned_y,
    vector_at,
)
from georef.kernels.types import Axes, Matrix, Model, Out, Ranging, Three, Track
from georef.points import Fate
from georef.records import Int64Array, StructArray
from georef.trajectory import locate_epoch, slerp

ONE, BY_CHANNEL, FIBRE_BY_CHANNEL, FIBRE_BY_ENCODER = 0, 1, 2, 3
DONE, NO_TIME, OUTSIDE, GAP = (
    int(fate) for fate in (Fate.GEOREFERENCED, Fate.NO_TIME, Fate.OUTSIDE_TRAJECTORY, Fate.TRAJECTORY_GAP)
)
NEAR, FAR, NOT_FINITE = (int(fate) for fate in (Fate.BELOW_RANGE_GATE, Fate.ABOVE_RANGE_GATE, Fate.NOT_FINITE))
TURN = 2.0 * math.pi


@kernel
def ibrc_of(ranging: Ranging, intensity: float) -> float:
    """Linear between the knots, level beyond them."""
    knots, values = ranging.ibrc_intensity, ranging.ibrc_m
    last = len(knots) - 1
    if intensity >= knots[last]:
        return float(values[last])
    if not intensity > knots[0]:
        return float(values[0])
    at = ranging.ibrc_bucket[int((intensity - knots[0]) * ranging.ibrc_buckets_per_unit)]
    while intensity >= knots[at + 1]:
        at += 1
    return float(values[at] + (intensity - knots[at]) * ranging.ibrc_slope[at])


@kernel
def interval_of(track: Track, t: int, guess: int) -> tuple[int, int, float, int, int]:
    """Interval of the trajectory with t: its times, 1 / ns between them, fate, epoch. Outside all one of no length."""
    at = locate_epoch(track.time_ns, t, guess)
    if at < 0:
        return t, t, 0.0, OUTSIDE, guess
    begin, end = track.time_ns[at], track.time_ns[at + 1]
    return begin, end, 1.0 / (end - begin), GAP if end - begin > track.max_gap_ns else DONE, at


@kernel
def way_at(track: Track, t: int, guess: int) -> tuple[int, int, float, int, int, Three, Three]:
    """The interval with t, the position at its epoch, and the way to the next."""
    begin, end, per_ns, fate, at = interval_of(track, t, guess)
    here = vector_at(track.position_e, at)
    return begin, end, per_ns, fate, at, here, plus(vector_at(track.position_e, at + 1), -1.0, here)


@kernel
def turn_at(model: Model, t: int, guess: int) -> tuple[int, int, float, int, int, Matrix, Three, float, Matrix]:
    """The interval with t, and its turn as the boresight's ω and φ see it.

    Returns:
        the interval; rot_e_from_b · outer at its epoch; the rotation vector to the next, outerᵀ φ; φ²; and three
        vectors in e of the lever arm: with a, b of `turn_factors` it is first + a · second + b · third.
    """
    track, mounted = model.track, model.mounted
    begin, end, per_ns, fate, at = interval_of(track, t, guess)
    w, x, y, z = track.q_e_from_b[at, 0], track.q_e_from_b[at, 1], track.q_e_from_b[at, 2], track.q_e_from_b[at, 3]
    rot_e_from_b = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    phi, lever, outer = vector_at(track.rotvec_b, at), vector_at(mounted.lever_arm_b, 0), matrix_at(mounted.outer, 0)
    once = cross(phi, lever)
    arms = times(rot_e_from_b, lever), times(rot_e_from_b, once), times(rot_e_from_b, cross(phi, once))
    turn = product(rot_e_from_b, outer)
    return begin, end, per_ns, fate, at, turn, transposed_times(outer, phi), dot(phi, phi), arms


@kernel
def channel_of(select: int, channels: int, channel: int, encoder_rad: float) -> int:
    """Row of the table; −1 where it has none."""
    if select == ONE:
        return 0
    if select == FIBRE_BY_ENCODER:
        return round(encoder_rad * (channels / TURN)) % channels
    return channel if channel < channels else -1


@kernel
def fate_of(t: int, row: Any, channel: int, known: int, covered: int) -> int:
    """Of a return, before its range is looked at; ``covered`` is what the trajectory says."""
    if t < 0:
        return NO_TIME
    if channel < 0 or not (math.isfinite(row.range_m) and math.isfinite(row.encoder_rad)):
        return NOT_FINITE
    if covered == DONE and not known:
        return OUTSIDE
    return covered


@kernel
def gated(rho: float, minimum_m: float, maximum_m: float, u: Three) -> int:
    """Fate of a return by its range, and whether light comes through to it."""
    if not math.isfinite(u[0]):
        return NOT_FINITE
    if rho < minimum_m:
        return NEAR
    return FAR if rho > maximum_m else DONE


@kernel
def fill(array: Any, k: int, v: Three) -> None:
    """Row k of (n, 3)."""
    array[k, 0], array[k, 1], array[k, 2] = v


@kept
def cast(rows: StructArray, time_ns: Int64Array, model: Model, out: Out) -> None:
    """Fill ``out`` from rows (n,) `RETURN_DTYPE` at GPS times (n,), n > 0; the trajectory has at least two epochs."""
    ranging, scanning, mounted, track = model
    fate_out, time_out, points_e, origin_e, angle_rad, range_m = out
    kind, table, select, angle_scale, angle_offset, latency_s, torsion_s2, rate, acceleration = scanning
    slope, shifted, moves = mounted.slope, mounted.shifted, len(mounted.inner) > 1
    scale, intensive, tabled = ranging.scale, len(ranging.ibrc_m) > 0, len(ranging.delta_m) > 1
    offset_ns, turn_offset_ns = track.offset_ns, track.offset_ns + track.latency_ns
    whole_ns, turn_ns = round(offset_ns), round(turn_offset_ns)
    begin, end, per_ns, fate, at, place, way = way_at(track, time_ns[0] + whole_ns, 0)
    begun, ended, per_turn_ns, turn_fate, turning, turn, phi, phi2, arms = turn_at(model, time_ns[0] + turn_ns, 0)
    inner, shift, known = matrix_at(mounted.inner, 0), vector_at(mounted.shift, 0), mounted.known[0]
    for k in range(len(rows)):
        row, t = rows[k], time_ns[k]
        time_out[k] = t + whole_ns
        if not begin <= t + whole_ns < end:
            begin, end, per_ns, fate, at, place, way = way_at(track, t + whole_ns, at)
        if not begun <= t + turn_ns < ended:
            begun, ended, per_turn_ns, turn_fate, turning, turn, phi, phi2, arms = turn_at(model, t + turn_ns, turning)
        if moves:
            inner, shift, known = matrix_at(mounted.inner, k), vector_at(mounted.shift, k), mounted.known[k]
        channel = channel_of(select, len(table), row.channel, row.encoder_rad)
        fate_out[k] = fate_of(t, row, channel, known, max(fate, turn_fate))
        if fate_out[k] != DONE:
            continue

        beam = row_of(table, channel)
        counted, offset_m = scale * row.range_m, ranging.offset_m + beam[RANGE]
        if intensive:
            offset_m -= ibrc_of(ranging, row.intensity)
        if tabled:
            offset_m += ranging.delta_m[row.return_number, row.mta_zone]
        theta = angle_scale * ((beam[FIXED_ANGLE] if select >= FIBRE_BY_CHANNEL else row.encoder_rad) - angle_offset)
        if len(rate):
            theta += latency_s * rate[k] + torsion_s2 * acceleration[k]
        sx, sy, sz, ux, uy, uz = beam_of(kind, beam, theta)
        u = turned_y(slope * theta, times(inner, (ux, uy, uz)))
        angle_rad[k], range_m[k] = theta, counted + offset_m
        fate_out[k] = gated(counted + offset_m, ranging.minimum_m, ranging.maximum_m, u)

        share, turn_share = (t - begin + offset_ns) * per_ns, (t - begun + turn_offset_ns) * per_turn_ns
        a, b = turn_factors(phi2 * turn_share * turn_share, turn_share)
        u = times(turn, turned_on(phi, a, b, u))  # to e
        origin = plus(plus(place, share, way), 1.0, plus(plus(arms[0], a, arms[1]), b, arms[2]))
        if shifted:  # the beam does not start in the scanner's origin
            start = turned_y(slope * theta, plus(shift, 1.0, times(inner, (sx, sy, sz))))
            origin = plus(origin, 1.0, times(turn, turned_on(phi, a, b, start)))
        origin = plus(origin, offset_m, u)
        fill(origin_e, k, origin)
        fill(points_e, k, plus(origin, counted, u))


@kernel
def with_slope(turn: Three, slope: float, outer: Matrix, arm: Three) -> Three:
    """∂point/∂θ where θ turns φ too, whose axis is Rx(ω) y."""
    return plus(turn, slope, cross((outer[0][1], outer[1][1], outer[2][1]), arm))


@kept
def fill_axes(rows: StructArray, time_ns: Int64Array, model: Model, out: Out, axes: Axes) -> None:
    """Fill ``axes`` for the rows that `cast` georeferenced."""
    _, scanning, mounted, track = model
    fate_out, time_out, _, _, angle_rad, range_m = out
    q_e_from_b, epoch, shares, arm_b, range_axis_b, angle_axis_b, tilt_axis_b = axes
    kind, table, select = scanning.kind, scanning.table, scanning.select
    slope, moves = mounted.slope, len(mounted.inner) > 1
    times_ns, quaternions, rotvec_b = track.time_ns, track.q_e_from_b, track.rotvec_b
    offset_ns, turn_offset_ns = track.offset_ns, track.offset_ns + track.latency_ns
    later_ns, at, turning = round(turn_offset_ns), 0, 0
    begin, end, begun, ended = 0, 0, 0, 0
    lever, outer = vector_at(mounted.lever_arm_b, 0), matrix_at(mounted.outer, 0)
    inner, shift = matrix_at(mounted.inner, 0), vector_at(mounted.shift, 0)
    for k in range(len(rows)):
        if fate_out[k] != DONE:
            continue
        t, theta, rho = time_ns[k], angle_rad[k], range_m[k]
        if not begin <= time_out[k] < end:
            at = locate_epoch(times_ns, time_out[k], at)
            begin, end = times_ns[at], times_ns[at + 1]
        if not begun <= t + later_ns < ended:
            turning = locate_epoch(times_ns, t + later_ns, turning)
            begun, ended = times_ns[turning], times_ns[turning + 1]
        epoch[k], shares[k] = at, (t - begin + offset_ns) / (end - begin)
        w, x, y, z = quaternions[turning, 0], quaternions[turning, 1], quaternions[turning, 2], quaternions[turning, 3]
        rx, ry, rz = rotvec_b[turning, 0], rotvec_b[turning, 1], rotvec_b[turning, 2]
        w, x, y, z = slerp(w, x, y, z, rx, ry, rz, (t - begun + turn_offset_ns) / (ended - begun))
        q_e_from_b[k, 0], q_e_from_b[k, 1], q_e_from_b[k, 2], q_e_from_b[k, 3] = w, x, y, z

        if moves:
            inner, shift = matrix_at(mounted.inner, k), vector_at(mounted.shift, k)
        beam = row_of(table, channel_of(select, len(table), rows[k].channel, rows[k].encoder_rad))
        sx, sy, sz, ux, uy, uz = beam_of(kind, beam, theta)
        ax, ay, az, tx, ty, tz = turn_of(kind, beam, theta, rho)
        start = plus(shift, 1.0, times(inner, (sx, sy, sz)))
        along = times(outer, turned_y(slope * theta, times(inner, (ux, uy, uz))))
        across = times(outer, turned_y(slope * theta, times(inner, (ax, ay, az))))
        tilted = times(outer, turned_y(slope * theta, times(inner, (tx, ty, tz))))
        arm = plus(times(outer, turned_y(slope * theta, start)), rho, along)
        fill(arm_b, k, plus(lever, 1.0, arm))
        fill(range_axis_b, k, along)
        fill(angle_axis_b, k, with_slope(across, slope, outer, arm))
        fill(tilt_axis_b, k, tilted)
