"""Compute points in e from returns, in one pass over the rows (ISO/TS 19159-2 Eq. 10 with CONVENTIONS' parameters).

A moving pointer follows the trajectory; quantities of one of its intervals are computed when the pointer reaches it.
Returns are processed in blocks, none of them longer than an interval, so that all of a block's returns share the pose's
constants.
"""

from __future__ import annotations

import math
from typing import Any

from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.compiled import jit_cached, jit_inline, whole
from swath.georef.geodesy.earth import E2
from swath.georef.geodesy.vectors import (
    angle_of,
    cross,
    dot,
    matrix_at,
    plus,
    product,
    rot_at,
    times,
    transposed_times,
    turned_on,
    unit,
    vector_at,
)
from swath.georef.points import Fate
from swath.georef.scanner.kernels.axes import fill_axes, fill_covariance, take_readings, through_mount, turn_axes
from swath.georef.scanner.kernels.beam import FIBRE_BY_CHANNEL, FIBRE_BY_ENCODER, FIXED_ANGLE, ONE, RANGE, SPINNING
from swath.georef.scanner.kernels.block import (
    ACROSS,
    ALONG,
    BEAM,
    BLOCK,
    COUNTED,
    HEAD,
    HEAD_START,
    MORE,
    RHO,
    SHARE,
    START,
    THETA,
    TILT,
    TURN_SHARE,
    A,
    B,
    aim,
    clear,
    factors,
    give,
    lean,
    lift,
    new_block,
    put,
    three,
)
from swath.georef.scanner.kernels.covariance import (
    Doubt,
    interval_at,
)
from swath.georef.scanner.kernels.types import Axes, Matrix, Model, Out, Ranging, Scanning, Three, Track
from swath.georef.trajectory.trajectory import locate_epoch

DONE, NO_TIME, OUTSIDE, GAP = (
    int(fate) for fate in (Fate.GEOREFERENCED, Fate.NO_TIME, Fate.OUTSIDE_TRAJECTORY, Fate.TRAJECTORY_GAP)
)
NEAR, FAR, NOT_FINITE = (int(fate) for fate in (Fate.BELOW_RANGE_GATE, Fate.ABOVE_RANGE_GATE, Fate.NOT_FINITE))
TURN = 2.0 * math.pi
MINOR_2 = 1.0 - E2  # b² / a²
ORIGIN, POINT = ACROSS, TILT  # rows of a block that are free again once the axes are computed
FIRST = whole(0)


@jit_inline
def ibrc_of(ranging: Ranging, intensity: float) -> float:
    """Return the correction by intensity, linear between the knots, constant beyond them."""
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


@jit_inline
def interval_of(track: Track, t: int, guess: int) -> tuple[int, int, float, int, int]:
    """Return the trajectory's interval with t: its times, 1 / ns between them, fate, epoch.

    For a time outside the trajectory the interval has no length.
    """
    at = locate_epoch(track.time_ns, t, guess)
    if at < 0:
        return t, t, 0.0, OUTSIDE, guess
    begin, end = track.time_ns[at], track.time_ns[at + 1]
    return begin, end, 1.0 / (end - begin), GAP if end - begin > track.max_gap_ns else DONE, at


@jit_inline
def way_at(track: Track, t: int, guess: int) -> tuple[int, int, float, int, int, Three, Three]:
    """Return the interval with t, the position at its epoch, and the vector to the next."""
    begin, end, per_ns, fate, at = interval_of(track, t, guess)
    here = vector_at(track.position_e, at)
    return begin, end, per_ns, fate, at, here, plus(vector_at(track.position_e, at + 1), -1.0, here)


@jit_inline
def level_at(track: Track, at: int) -> tuple[Three, Three]:
    """Return down, and the horizontal direction to the right of the nose, in e at an epoch."""
    x, y, z = vector_at(track.position_e, at)
    down = unit((-x, -y, -z / MINOR_2))  # along the ellipsoid's normal, to 2 µrad at 3 km
    rot_e_from_b = rot_at(track.q_e_from_b, at)
    return down, unit(cross(down, (rot_e_from_b[0][0], rot_e_from_b[1][0], rot_e_from_b[2][0])))


@jit_inline
def turn_at(model: Model, t: int, guess: int) -> tuple[int, int, float, int, int, Matrix, Three, float, Matrix]:
    """Return the interval with t, and its turn in the axes of the boresight's ω and φ.

    Returns:
        the interval; rot_e_from_b · outer at its epoch; the rotation vector to the next, outerᵀ φ; φ²; and three
        vectors in e of the lever arm: with a, b of `turn_factors` it is first + a · second + b · third.
    """
    track, mounted = model.track, model.mounted
    begin, end, per_ns, fate, at = interval_of(track, t, guess)
    rot_e_from_b = rot_at(track.q_e_from_b, at)
    phi, lever, outer = vector_at(track.rotvec_b, at), vector_at(mounted.lever_arm_b, 0), matrix_at(mounted.outer, 0)
    once = cross(phi, lever)
    arms = times(rot_e_from_b, lever), times(rot_e_from_b, once), times(rot_e_from_b, cross(phi, once))
    turn = product(rot_e_from_b, outer)
    return begin, end, per_ns, fate, at, turn, transposed_times(outer, phi), dot(phi, phi), arms


@jit_inline
def channel_of(select: int, channels: int, channel: int, encoder_rad: float) -> int:
    """Return the row of the table; −1 if it has none."""
    if select == ONE:
        return 0
    if select == FIBRE_BY_ENCODER:
        return round(encoder_rad * (channels / TURN)) % channels
    return channel if channel < channels else -1


@jit_inline
def judge(
    part: Any, times_ns: Int64Array, fate: Any, known: Any, scanning: Scanning, elevation: Any, covered: int
) -> None:
    """Set fates before ranges are checked; ``covered`` is the trajectory's fate, ``known`` (1,) or (n,) the mount's."""
    select, channels, moves = scanning.select, len(scanning.table), len(known) > 1
    for i in range(len(part)):
        row = part[i]
        lost = covered == DONE and not known[i if moves else 0]
        verdict = OUTSIDE if lost else covered
        channel = channel_of(select, channels, row.channel, row.encoder_rad)
        if channel < 0 or not (math.isfinite(row.range_m) and math.isfinite(row.encoder_rad)):
            verdict = NOT_FINITE
        fate[i] = NO_TIME if times_ns[i] < 0 else verdict
    for i in range(len(elevation)):
        if fate[i] != NO_TIME and not math.isfinite(elevation[i]):
            fate[i] = NOT_FINITE


@jit_inline
def take_table(block: FloatArray, part: Any, scanning: Scanning) -> None:
    """Copy the table's row of each return; for returns without one the first."""
    table, select = scanning.table, scanning.select
    for i in range(len(part)):
        channel = max(channel_of(select, len(table), part[i].channel, part[i].encoder_rad), 0)
        for column in range(8):
            block[BEAM + column, i] = table[channel, column]


@jit_inline
def take(block: FloatArray, part: Any, ranging: Ranging, scanning: Scanning, rate: Any, acceleration: Any) -> None:
    """Compute ranges and scan angles."""
    n = len(part)
    scale, offset_m = ranging.scale, ranging.offset_m
    for i in range(n):
        block[COUNTED, i] = scale * part[i].range_m
        block[THETA, i] = part[i].encoder_rad
        block[MORE, i] = offset_m + block[BEAM + RANGE, i]
    if len(ranging.ibrc_m):
        for i in range(n):
            block[MORE, i] -= ibrc_of(ranging, part[i].intensity)
    if len(ranging.delta_m) > 1:
        for i in range(n):
            block[MORE, i] += ranging.delta_m[part[i].return_number, part[i].mta_zone]
    if scanning.select >= FIBRE_BY_CHANNEL:
        for i in range(n):
            block[THETA, i] = block[BEAM + FIXED_ANGLE, i]
    scale, offset, latency, torsion = scanning.scale, scanning.offset_rad, scanning.latency_s, scanning.torsion_s2
    for i in range(n):
        block[RHO, i] = block[COUNTED, i] + block[MORE, i]
        block[THETA, i] = scale * (block[THETA, i] - offset)
    if len(rate):
        for i in range(n):
            block[THETA, i] += latency * rate[i] + torsion * acceleration[i]


@jit_inline
def gate(block: FloatArray, fate: Any, minimum_m: float, maximum_m: float) -> None:
    """Set fates by range, and where no light passes."""
    for i in range(len(fate)):
        if fate[i] == DONE:
            rho = block[RHO, i]
            verdict = NEAR if rho < minimum_m else DONE
            verdict = FAR if rho > maximum_m else verdict
            fate[i] = verdict if math.isfinite(block[ALONG, i]) else NOT_FINITE


@jit_inline
def to_e(
    block: FloatArray,
    n: int,
    way: tuple[Three, Three],
    turned: tuple[Matrix, Three],
    arms: tuple[Three, Three, Three],
    shifted: bool,
) -> None:
    """Convert beams from the axes of ω and φ to e: rows ORIGIN and POINT."""
    turn, phi = turned
    for i in range(n):
        a, b = block[A, i], block[B, i]
        origin = plus(way[0], block[SHARE, i], way[1])
        put(block, ORIGIN, i, plus(origin, 1.0, plus(plus(arms[0], a, arms[1]), b, arms[2])))
    if shifted:  # the beam does not start at the scanner's origin
        for i in range(n):
            start = times(turn, turned_on(phi, block[A, i], block[B, i], three(block, START, i)))
            put(block, ORIGIN, i, plus(three(block, ORIGIN, i), 1.0, start))
    for i in range(n):
        u = times(turn, turned_on(phi, block[A, i], block[B, i], three(block, ALONG, i)))
        origin = plus(three(block, ORIGIN, i), block[MORE, i], u)
        put(block, ORIGIN, i, origin)
        put(block, POINT, i, plus(origin, block[COUNTED, i], u))


@jit_inline
def shares(block: FloatArray, row: int, stamps: Any, begin: int, offset_ns: float, per_ns: float) -> None:
    """Compute the positions of returns in an interval that begins at ``begin``."""
    for i in range(len(stamps)):
        passed = stamps[i] - begin
        block[row, i] = (passed + offset_ns) * per_ns


@jit_inline
def beams(block: FloatArray, k: int, part: Any, model: Model, rate: Any, acceleration: Any, elevation: Any) -> None:
    """Compute ranges, scan angles, and the beams in the axes of ω and φ; ``part`` are the rows from k on."""
    ranging, scanning, mounted, _ = model
    n, kind = len(part), scanning.kind
    if scanning.select != ONE:
        take_table(block, part, scanning)
    if len(elevation):
        lift(block, elevation)
    take(block, part, ranging, scanning, rate, acceleration)
    aim(block, n, kind)
    lean(block, n, mounted.slope)
    through_mount(block, n, k, mounted, HEAD, ALONG, 0.0)
    if mounted.shifted:
        if kind != SPINNING:
            clear(block, HEAD_START)
        through_mount(block, n, k, mounted, HEAD_START, START, 1.0)


@jit_inline
def hand_out(block: FloatArray, n: int, here: Any, level: tuple[Three, Three], out: Out) -> None:
    """Copy a block's results to ``out``; ``level`` is down and to the right."""
    give(block, n, ORIGIN, out.origin_e[here])
    give(block, n, POINT, out.points_e[here])
    angles, ranges = out.angle_rad[here], out.range_m[here]
    for i in range(n):
        angles[i], ranges[i] = block[THETA, i], block[RHO, i]
    down, right = level
    off_nadir = out.off_nadir_rad[here]
    for i in range(n):
        beam = plus(three(block, POINT, i), -1.0, three(block, ORIGIN, i))
        off_nadir[i] = angle_of(dot(beam, right), dot(beam, down))


@jit_cached
def cast(
    rows: StructArray, time_ns: Int64Array, model: Model, out: Out, axes: Axes | None, doubt: Doubt | None
) -> None:
    """Fill ``out`` from rows (n,) `RETURN_DTYPE` at GPS times (n,), and ``axes`` and ``doubt`` if given.

    The trajectory has at least two epochs, n > 0.
    """
    ranging, scanning, mounted, track = model
    rate, acceleration, elevation = scanning.rate, scanning.acceleration, scanning.elevation
    moves = len(mounted.inner) > 1
    offset_ns, turn_offset_ns = track.offset_ns, track.offset_ns + track.latency_ns
    whole_ns, turn_ns = round(offset_ns), round(turn_offset_ns)
    begin, end, per_ns, fate, at, place, way = way_at(track, time_ns[0] + whole_ns, FIRST)
    begun, ended, per_turn_ns, turn_fate, turning, turn, phi, phi2, arms = turn_at(model, time_ns[0] + turn_ns, FIRST)
    level = level_at(track, turning)
    block = new_block()
    with_axes = axes is not None
    if doubt is not None:
        interval, doubted = interval_at(doubt.flown, at), at
    if scanning.select == ONE:
        for column in range(8):
            for i in range(BLOCK):
                block[BEAM + column, i] = scanning.table[0, column]
    k = FIRST
    while k < len(rows):
        t = time_ns[k]
        if not begin <= t + whole_ns < end:
            begin, end, per_ns, fate, at, place, way = way_at(track, t + whole_ns, at)
        if not begun <= t + turn_ns < ended:
            begun, ended, per_turn_ns, turn_fate, turning, turn, phi, phi2, arms = turn_at(model, t + turn_ns, turning)
            level = level_at(track, turning)
        last, n = min(len(rows), k + BLOCK), 1
        first_ns, end_ns = max(begin - whole_ns, begun - turn_ns), min(end - whole_ns, ended - turn_ns)
        while k + n < last and first_ns <= time_ns[k + n] < end_ns:
            n += 1
        here = slice(k, k + n)
        part, stamps, fates = rows[here], time_ns[here], out.fate[here]
        covered = max(fate, turn_fate)
        known = mounted.known[here] if moves else mounted.known
        judge(part, stamps, fates, known, scanning, elevation[here], covered)
        given_ns = out.time_ns[here]
        for i in range(n):
            given_ns[i] = stamps[i] + whole_ns
        if covered != DONE:
            k += n
            continue

        shares(block, SHARE, stamps, begin, offset_ns, per_ns)
        shares(block, TURN_SHARE, stamps, begun, turn_offset_ns, per_turn_ns)
        beams(block, k, part, model, rate[here], acceleration[here], elevation[here])
        gate(block, fates, ranging.minimum_m, ranging.maximum_m)
        factors(block, n, phi2)
        to_e(block, n, (place, way), (turn, phi), arms, mounted.shifted)
        hand_out(block, n, here, level, out)
        if doubt is not None:
            tilts = with_axes or not doubt.known.along_only or len(elevation) > 0
            turn_axes(block, n, k, scanning.kind, mounted, tilts)
            if at != doubted:
                interval, doubted = interval_at(doubt.flown, at), at
            if not doubt.known.along_only:
                take_readings(block, n, part, scanning, rate[here], acceleration[here])
            fill_covariance(block, n, k, part, track, turning, interval, doubt)
        if axes is not None:
            if doubt is None:
                turn_axes(block, n, k, scanning.kind, mounted, True)
            fill_axes(block, n, k, track, axes, turning, at, phi2)  # must be last, as it changes the block's own rows
        k += n
