"""Compute the rows of the design matrix for returns on planes (FORMULAS 5.2, 6.1, 6.2).

A row is f = n · (x − centre) + offset = 0 in e with unknowns in this order: the head's parameters; where trajectory
states are estimated, eight columns that stand for the twelve of the knots before and after (both positions have the
plane's normal as their coefficients); the plane's two turns and its offset. The last column is f itself.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from swath.calib.equations.tables import OF_PLANE, STATES, Beam, Head, Knots, Planes, Sigmas, Task
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.compiled import jit_cached, jit_inline
from swath.georef.geodesy.vectors import cross, dot, matrix_at, plus, rot_of, times, transposed_times, vector_at
from swath.georef.scanner.calibration import INDEX
from swath.georef.scanner.kernels.types import Three, Track
from swath.georef.trajectory.trajectory import locate_epoch

_LEAST_COSINE_2 = 0.01  # of the incidence: limits the size of a footprint
_FARTHEST = 4.0  # sigmas of f that may be errors of measurement; a larger f means a poor start
_LATER = 1e9

OMEGA, PHI, KAPPA, SLOPE = (INDEX[name] for name in ("omega_rad", "phi_rad", "kappa_rad", "pitch_slope"))
OFFSET, SCALE, TILT = (INDEX[name] for name in ("range_offset_m", "range_scale", "scan_plane_tilt_rad"))
ENCODER, ENCODER_SCALE = INDEX["scan_angle_offset_rad"], INDEX["scan_angle_scale"]
LATENCY, TORSION = INDEX["encoder_latency_s"], INDEX["torsion_s2"]
ARM, TIME, IMU = INDEX["lever_arm_x_m"], INDEX["time_offset_s"], INDEX["imu_latency_s"]
FIRST_EXTRA = len(INDEX)
SLOT, ZONE, KNOT, AZIMUTH, ELEVATION, RANGE = range(FIRST_EXTRA, FIRST_EXTRA + 6)

# Rows of the scratch table: normal in b; effects of turns of the boresight and of the body, in b; turns of the body in
# e; along the beam, by scan angle, by tilt; the share of the later knot; f; M; θ; speed along the normal; place in the
# plane; variance of the range; the parts of f that are probably errors of the range and of the encoder; variance due to
# the attitude's changes between knots, which the rows of a run share
NORMAL, BORE, BODY, BODY_E, ALONG, BY_ANGLE, BY_TILT, SHARE, MISCLOSURE, VARIANCE = 0, 3, 6, 9, 12, 13, 14, 15, 16, 17
SPEED, TURNED, PLACE, RANGING, LONGER, AHEAD, COMMON, ROWS = 18, 19, 20, 23, 24, 25, 26, 27


@jit_inline
def geometry(cells: FloatArray, n: int, k: int, beam: Beam, head: Head, planes: Planes, at: int, states: bool) -> None:
    """Compute the quantities from which the columns are built."""
    normal, centre = vector_at(planes.normal_e, at), vector_at(planes.centre_e, at)
    first, second = vector_at(planes.first_e, at), vector_at(planes.second_e, at)
    offset, lever = planes.offset[at], (head.value[ARM], head.value[ARM + 1], head.value[ARM + 2])
    q, arms = beam.q_e_from_b, beam.arm_b
    for i in range(n):
        j = k + i
        rot_e_from_b = rot_of(q[0, j], q[1, j], q[2, j], q[3, j])
        normal_b = transposed_times(rot_e_from_b, normal)
        arm = arms[0, j], arms[1, j], arms[2, j]
        body = cross(arm, normal_b)
        bore = plus(body, -1.0, cross(lever, normal_b))
        cells[NORMAL, i], cells[NORMAL + 1, i], cells[NORMAL + 2, i] = normal_b
        cells[BORE, i], cells[BORE + 1, i], cells[BORE + 2, i] = bore
        cells[BODY, i], cells[BODY + 1, i], cells[BODY + 2, i] = body
        x = plus((beam.points_e[j, 0], beam.points_e[j, 1], beam.points_e[j, 2]), -1.0, centre)
        cells[MISCLOSURE, i] = dot(normal, x) + offset
        cells[PLACE, i], cells[PLACE + 1, i], cells[PLACE + 2, i] = dot(first, x), dot(second, x), 1.0
    for i in range(n):
        j = k + i
        x, y, z = cells[NORMAL, i], cells[NORMAL + 1, i], cells[NORMAL + 2, i]
        u, a, t = beam.range_axis_b, beam.angle_axis_b, beam.tilt_axis_b
        cells[ALONG, i] = x * u[0, j] + y * u[1, j] + z * u[2, j]
        cells[BY_ANGLE, i] = x * a[0, j] + y * a[1, j] + z * a[2, j]
        cells[BY_TILT, i] = x * t[0, j] + y * t[1, j] + z * t[2, j]
    if states:
        for i in range(n):
            j = k + i
            rot_e_from_b = rot_of(q[0, j], q[1, j], q[2, j], q[3, j])
            turned = times(rot_e_from_b, (cells[BODY, i], cells[BODY + 1, i], cells[BODY + 2, i]))
            cells[BODY_E, i], cells[BODY_E + 1, i], cells[BODY_E + 2, i] = turned


@jit_inline
def speeds(cells: FloatArray, n: int, k: int, beam: Beam, track: Track, normal: Three) -> None:
    """Compute the speed of the body along the normal."""
    epoch = -1
    speed = 0.0
    for i in range(n):
        now = beam.epoch[k + i]
        if now != epoch:
            epoch = now
            way = plus(vector_at(track.position_e, epoch + 1), -1.0, vector_at(track.position_e, epoch))
            speed = dot(normal, way) * (_LATER / (track.time_ns[epoch + 1] - track.time_ns[epoch]))
        cells[SPEED, i] = speed


@jit_inline
def turnings(cells: FloatArray, n: int, k: int, beam: Beam, track: Track) -> None:
    """Compute the speed of the point along the normal due to the body's rotation."""
    for i in range(n):
        at = locate_epoch(track.time_ns, beam.time_ns[k + i] + round(track.latency_ns), beam.epoch[k + i])
        at = max(at, 0)
        rate = vector_at(track.rotvec_b, at)
        turned = dot(rate, (cells[BODY, i], cells[BODY + 1, i], cells[BODY + 2, i]))
        cells[TURNED, i] = turned * (_LATER / (track.time_ns[at + 1] - track.time_ns[at]))


@jit_inline
def own_variance(cells: FloatArray, n: int, k: int, beam: Beam, head: Head) -> None:
    """Compute M due to range, footprint, scan angle and time (FORMULAS 6.2)."""
    longer, wider = 1.0 + head.value[SCALE], 1.0 + head.value[ENCODER_SCALE]
    for i in range(n):
        along = cells[ALONG, i]
        cosine2 = min(max(along * along, _LEAST_COSINE_2), 1.0)
        foot = 0.25 * head.divergence_rad * beam.range_m[k + i]
        ranging = longer * longer * head.range_m * head.range_m + foot * foot * (1.0 - cosine2) / cosine2
        turned = wider * head.angle_rad * cells[BY_ANGLE, i]
        raised = head.elevation_rad * cells[BY_TILT, i]
        later = head.time_s * cells[SPEED, i]
        cells[RANGING, i] = ranging
        cells[VARIANCE, i] = along * along * ranging + turned * turned + raised * raised + later * later


@jit_inline
def adjust_observations(cells: FloatArray, n: int, k: int, beam: Beam, head: Head, planes: Planes, at: int) -> None:
    """Move the columns' quantities to the adjusted observations, l − Σ Bᵀ f / M in range and angles (FORMULAS 6.3).

    A point lies off its plane mainly because of an error of its range, and this error is in its coefficients, too: with
    the coefficients as measured, Σ aᵀ p f has the expectation Σ (∂a/∂ρ) / (∂f/∂ρ), which for the range scale is the
    number of rows, for the scan angle's scale Σ θ tan i. Where a million rows share a trajectory, this amounts to a few
    millimetres, which are several sigmas.

    The beam is assumed to begin where its range does and to swing along a great circle. Where it does not, the small
    part of the coefficients that angle errors cause is slightly wrong.
    """
    first, second = vector_at(planes.first_e, at), vector_at(planes.second_e, at)
    longer, wider = 1.0 + head.value[SCALE], (1.0 + head.value[ENCODER_SCALE])
    q, u, a, t = beam.q_e_from_b, beam.range_axis_b, beam.angle_axis_b, beam.tilt_axis_b
    for i in range(n):
        j = k + i
        limit = _FARTHEST * math.sqrt(cells[VARIANCE, i])
        share = min(max(cells[MISCLOSURE, i], -limit), limit) / cells[VARIANCE, i]
        by_range = share * cells[ALONG, i] * cells[RANGING, i]
        cells[LONGER, i] = by_range / longer
        cells[AHEAD, i] = share * wider * head.angle_rad * head.angle_rad * cells[BY_ANGLE, i]
        by_angle = wider * cells[AHEAD, i]
        by_tilt = share * head.elevation_rad * head.elevation_rad * cells[BY_TILT, i]
        moved_b = (
            by_range * u[0, j] + by_angle * a[0, j] + by_tilt * t[0, j],
            by_range * u[1, j] + by_angle * a[1, j] + by_tilt * t[1, j],
            by_range * u[2, j] + by_angle * a[2, j] + by_tilt * t[2, j],
        )
        turned_b = cross(moved_b, (cells[NORMAL, i], cells[NORMAL + 1, i], cells[NORMAL + 2, i]))
        rot_e_from_b = rot_of(q[0, j], q[1, j], q[2, j], q[3, j])
        moved, turned = times(rot_e_from_b, moved_b), times(rot_e_from_b, turned_b)
        range_m, along, across = beam.range_m[j], cells[ALONG, i], cells[BY_ANGLE, i]
        swing2 = a[0, j] * a[0, j] + a[1, j] * a[1, j] + a[2, j] * a[2, j]
        cells[ALONG, i] -= (by_angle * across + by_tilt * cells[BY_TILT, i]) / range_m
        cells[BY_ANGLE, i] += (by_angle * swing2 * along - by_range * across) / range_m
        cells[BY_TILT, i] -= by_range * cells[BY_TILT, i] / range_m
        for axis in range(3):
            cells[BORE + axis, i] -= turned_b[axis]
            cells[BODY + axis, i] -= turned_b[axis]
            cells[BODY_E + axis, i] -= turned[axis]
        cells[PLACE, i] -= dot(first, moved)
        cells[PLACE + 1, i] -= dot(second, moved)


@jit_inline
def flown_variance(
    cells: FloatArray, n: int, k: int, beam: Beam, sigmas: Sigmas, normal: Three, rot_l_from_e: FloatArray
) -> None:
    """Add M due to a trajectory whose errors count as independent from return to return."""
    north, east, down = vector_at(rot_l_from_e, 0), vector_at(rot_l_from_e, 1), vector_at(rot_l_from_e, 2)
    by_n, by_e, by_d = dot(normal, north), dot(normal, east), dot(normal, down)
    q = beam.q_e_from_b
    for i in range(n):
        j = k + i
        epoch = beam.epoch[j]
        rot_e_from_b = rot_of(q[0, j], q[1, j], q[2, j], q[3, j])
        down_b = transposed_times(rot_e_from_b, down)
        level = cross(down_b, (1.0, 0.0, 0.0))
        length = math.sqrt(dot(level, level))
        body = cells[BODY, i], cells[BODY + 1, i], cells[BODY + 2, i]
        s, a = sigmas.position_l, sigmas.attitude
        shifted = (by_n * s[epoch, 0]) ** 2 + (by_e * s[epoch, 1]) ** 2 + (by_d * s[epoch, 2]) ** 2
        rolled, pitched = a[epoch, 0] * body[0], a[epoch, 1] * dot(level, body) / length
        headed = a[epoch, 2] * dot(down_b, body)
        cells[VARIANCE, i] += shifted + rolled * rolled + pitched * pitched + headed * headed


@jit_inline
def between(nodes: FloatArray, value: FloatArray, row: int, intensity: float) -> float:
    """Interpolate a row (d,) of a table linearly between its nodes (d,), constant beyond the ends."""
    last = len(nodes) - 1
    if intensity >= nodes[last]:
        return float(value[row, last])
    if not intensity > nodes[0]:
        return float(value[row, 0])
    at = np.searchsorted(nodes, intensity, side="right") - 1
    share = (intensity - nodes[at]) / (nodes[at + 1] - nodes[at])
    return float(value[row, at] + share * (value[row, at + 1] - value[row, at]))


@jit_inline
def extra(cells: FloatArray, i: int, j: int, beam: Beam, head: Head, kind: int, argument: int) -> float:
    """Return an element of a column that is not a parameter of the model."""
    row, along = beam.rows[j], cells[ALONG, i]
    if kind == SLOT:
        return float(along) if row.return_number == argument else 0.0
    if kind == ZONE:
        return float(along) if row.mta_zone == argument else 0.0
    if kind == KNOT:
        return float(-along * between(head.nodes, head.by_knot, argument, row.intensity))
    if row.channel != argument:
        return 0.0
    if kind == RANGE:
        return float(along)
    normal = cells[NORMAL, i], cells[NORMAL + 1, i], cells[NORMAL + 2, i]
    u = beam.range_axis_b[0, j], beam.range_axis_b[1, j], beam.range_axis_b[2, j]
    spin = vector_at(head.spin_b, 0)
    turns_with_beam = math.isnan(head.before_m)
    length = beam.range_m[j] - cells[LONGER, i] * (1.0 + head.value[SCALE])
    length -= 0.0 if turns_with_beam else head.before_m
    if kind == AZIMUTH:
        return float(cells[BY_ANGLE, i] if turns_with_beam else length * dot(normal, cross(u, spin)))
    sine = dot(u, spin)
    return float(length * dot(normal, plus(spin, -sine, u)) / math.sqrt(1.0 - sine * sine))


@jit_inline
def column(cells: FloatArray, n: int, k: int, beam: Beam, head: Head, kind: int, argument: int, out: Any) -> None:
    """Compute one parameter's column (FORMULAS 5.2), like `swath.georef.scanner.jacobian.parameter_columns_e`."""
    outer, value = matrix_at(head.outer, 0), head.value
    if kind == OMEGA:
        for i in range(n):
            out[i] = cells[BORE, i]
    elif kind in (PHI, SLOPE):
        for i in range(n):
            out[i] = outer[0][1] * cells[BORE, i] + outer[1][1] * cells[BORE + 1, i] + outer[2][1] * cells[BORE + 2, i]
        if kind == SLOPE:
            for i in range(n):
                out[i] *= beam.angle_rad[k + i] - cells[AHEAD, i] * (1.0 + value[ENCODER_SCALE])
    elif kind == KAPPA:
        for i in range(n):
            lean = value[SLOPE] * beam.angle_rad[k + i]
            sin, cos = math.sin(lean), math.cos(lean)
            bore = cells[BORE, i], cells[BORE + 1, i], cells[BORE + 2, i]
            turned = transposed_times(outer, bore)
            out[i] = sin * turned[0] + cos * turned[2]
    elif kind == OFFSET:
        for i in range(n):
            out[i] = cells[ALONG, i]
    elif kind == SCALE:
        for i in range(n):
            out[i] = cells[ALONG, i] * (beam.rows[k + i].range_m - cells[LONGER, i])
    elif kind == ENCODER:
        for i in range(n):
            out[i] = cells[BY_ANGLE, i] * -(1.0 + value[ENCODER_SCALE])
    elif kind == ENCODER_SCALE:
        for i in range(n):
            out[i] = cells[BY_ANGLE, i] * (beam.encoder_rad[k + i] - cells[AHEAD, i] - value[ENCODER])
    elif kind == LATENCY:
        for i in range(n):
            out[i] = cells[BY_ANGLE, i] * beam.encoder_rate[k + i]
    elif kind == TORSION:
        for i in range(n):
            out[i] = cells[BY_ANGLE, i] * beam.encoder_acceleration[k + i]
    elif kind == TILT:
        for i in range(n):
            out[i] = cells[BY_TILT, i]
    elif kind in (ARM, ARM + 1, ARM + 2):
        for i in range(n):
            out[i] = cells[NORMAL + kind - ARM, i]
    elif kind == TIME:
        for i in range(n):
            out[i] = cells[SPEED, i] + cells[TURNED, i]
    elif kind == IMU:
        for i in range(n):
            out[i] = cells[TURNED, i]
    else:
        for i in range(n):
            out[i] = extra(cells, i, k + i, beam, head, kind, argument)


@jit_inline
def share_of(knots: Knots, before: int, after: int, t: int) -> float:
    """Return the position between two knots as a share; 0 if both are the same."""
    if after == before:
        return 0.0
    return float((t - knots.time_ns[before]) / (knots.time_ns[after] - knots.time_ns[before]))


@jit_inline
def states_now(
    cells: FloatArray, n: int, k: int, beam: Beam, knots: Knots, before: int, after: int, normal: Three
) -> None:
    """Add the effects of the current states to f."""
    state = knots.state
    shift = dot(normal, vector_at(state, before))
    shifted = dot(normal, vector_at(state, after))
    turn = state[before, 3], state[before, 4], state[before, 5]
    turned = state[after, 3], state[after, 4], state[after, 5]
    for i in range(n):
        share = share_of(knots, before, after, beam.time_ns[k + i])
        by = cells[BODY_E, i], cells[BODY_E + 1, i], cells[BODY_E + 2, i]
        cells[SHARE, i] = share
        cells[MISCLOSURE, i] += (1.0 - share) * (shift + dot(turn, by)) + share * (shifted + dot(turned, by))


@jit_inline
def walked(cells: FloatArray, n: int, walk: float) -> None:
    """Compute the variance of f due to the attitude's random walk between knots, as a bridge from one to the other."""
    for i in range(n):
        by, share = (cells[BODY_E, i], cells[BODY_E + 1, i], cells[BODY_E + 2, i]), cells[SHARE, i]
        cells[COMMON, i] = share * (1.0 - share) * walk * dot(by, by) if walk > 0.0 else 0.0


@jit_inline
def of_states(cells: FloatArray, n: int, panel: FloatArray, c: int) -> None:
    """Fill the eight columns of the states, from column c on."""
    for i in range(n):
        share = cells[SHARE, i]
        rest = 1.0 - share
        x, y, z = cells[BODY_E, i], cells[BODY_E + 1, i], cells[BODY_E + 2, i]
        panel[c, i], panel[c + 1, i] = rest, share
        panel[c + 2, i], panel[c + 3, i], panel[c + 4, i] = rest * x, rest * y, rest * z
        panel[c + 5, i], panel[c + 6, i], panel[c + 7, i] = share * x, share * y, share * z


@jit_cached
def fill(
    cells: FloatArray,
    panel: FloatArray,
    k: int,
    task: Task,
    active: Int64Array,
    at: int,
    before: int,
    after: int,
) -> None:
    """Fill the columns (c + 1, n) of the rows from k on of one plane and pair of knots, and f and M in ``cells``.

    ``active`` are the head's unknowns that these rows can have; rows of returns without a point are zero.
    """
    beam, _, head, planes, knots, sigmas, track, rot_l_from_e = task
    n, states, normal = panel.shape[1], before >= 0, vector_at(planes.normal_e, at)
    turns = False
    for kind in head.kind:
        turns = turns or kind == TIME or kind == IMU
    geometry(cells, n, k, beam, head, planes, at, states)
    speeds(cells, n, k, beam, track, normal)
    own_variance(cells, n, k, beam, head)
    if len(sigmas.position_l):
        flown_variance(cells, n, k, beam, sigmas, normal, rot_l_from_e)
    if states:
        states_now(cells, n, k, beam, knots, before, after, normal)
    adjust_observations(cells, n, k, beam, head, planes, at)
    if turns:
        turnings(cells, n, k, beam, track)
    walked(cells, n, knots.walk[before] if states else 0.0)
    for c in range(len(active)):
        column(cells, n, k, beam, head, head.kind[active[c]], head.argument[active[c]], panel[c])
    c = len(active)
    if states:
        of_states(cells, n, panel, c)
        c += STATES
    for i in range(n):
        for axis in range(OF_PLANE):
            panel[c + axis, i] = cells[PLACE + axis, i]
        panel[c + OF_PLANE, i] = cells[MISCLOSURE, i]
    for i in range(n):
        if beam.fate[k + i] != 0:
            for axis in range(len(panel)):
                panel[axis, i] = 0.0
            cells[MISCLOSURE, i], cells[VARIANCE, i] = np.nan, np.nan
