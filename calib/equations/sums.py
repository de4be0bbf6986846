"""Sum rows up to normal equations, or inspect them one by one (FORMULAS 6.3 to 6.5)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from swath.calib.equations.kernels import ALONG, AZIMUTH, COMMON, MISCLOSURE, ROWS, SPEED, VARIANCE, fill
from swath.calib.equations.tables import OF_PLANE, STATES, Groups, Head, Knots, RowDiagnostics, Sums, Task
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.compiled import jit_cached, jit_inline, whole
from swath.georef.geodesy.vectors import vector_at
from swath.georef.scanner.kernels.types import Three

PIECE = 256  # returns processed at once
MODE_SUM, MODE_LOOK, MODE_GIVE = whole(0), whole(1), whole(2)


@jit_inline
def weigh(cells: FloatArray, panel: FloatArray, weight: Any, huber: float, together: float) -> tuple[float, int]:
    """Multiply rows by √(weight / (M + n c)), and by Huber's weight of f / √(M + c) if ``huber`` > 0.

    An error c that n rows share counts n times for each of them: their mean then has the variance M / n + c.

    Returns:
        Σ p f², and the number of rows with a positive weight.
    """
    n, last, total, count = panel.shape[1], len(panel) - 1, 0.0, 0
    for i in range(n):
        size = abs(cells[MISCLOSURE, i]) / math.sqrt(cells[VARIANCE, i] + cells[COMMON, i])
        root = math.sqrt(cells[VARIANCE, i] + together * cells[COMMON, i])
        share = math.sqrt(weight[i] * (huber / size if huber > 0.0 and size > huber else 1.0)) / root
        cells[SPEED, i] = share if math.isfinite(share) else 0.0
        count += 1 if cells[SPEED, i] > 0.0 else 0
    for c in range(len(panel)):
        for i in range(n):
            panel[c, i] *= cells[SPEED, i]
    for i in range(n):
        total += panel[last, i] * panel[last, i]
    return total, count


@jit_inline
def add_up(total: FloatArray, more: FloatArray) -> None:
    """Add a matrix to another one, element by element."""
    for i in range(len(total)):
        for j in range(len(total)):
            total[i, j] += more[i, j]


@jit_inline
def spread_out(head: Head, knots: Knots, active: Int64Array, normal: Three, groups: Groups, g: int, table: Any) -> int:
    """Fill ``table`` with the unknowns of a group's columns, and return their number.

    For each unknown the table holds its position among all unknowns, its position in the plane's list, its column, and
    its factor.
    """
    to, place, source, factor = table
    m = len(active)
    for c in range(m):
        to[c] = place[c] = head.at[active[c]]
        source[c], factor[c] = c, 1.0
    if groups.before[g] < 0:
        return m
    parameters = knots.first
    for side in range(2):
        knot = groups.after[g] if side else groups.before[g]
        slot = groups.place_after[g] if side else groups.place_before[g]
        for axis in range(6):
            to[m], place[m] = parameters + 6 * knot + axis, parameters + 6 * slot + axis
            shift = axis < 3
            source[m] = len(active) + (side if shift else 2 + 3 * side + axis - 3)
            factor[m] = normal[axis] if shift else 1.0
            m += 1
    return m


@jit_inline
def put(sums: Sums, total: FloatArray, table: Any, m: int, columns: int, plane: int) -> None:
    """Add a group's sums of products (c + 1, c + 1) to the sums of their unknowns."""
    to, place, source, factor = table
    f = columns + OF_PLANE
    first = sums.first[plane]
    for i in range(m):
        row, scale = total[source[i]], factor[i]
        for j in range(m):
            sums.normal[to[i], to[j]] += scale * factor[j] * row[source[j]]
        for j in range(OF_PLANE):
            sums.mixed[first + place[i], j] += scale * row[columns + j]
        sums.right[to[i]] += scale * row[f]
    for i in range(OF_PLANE):
        for j in range(OF_PLANE):
            sums.plane[plane, i, j] += total[columns + i, columns + j]
        sums.plane_right[plane, i] += total[columns + i, f]


@jit_inline
def give(k: int, cells: FloatArray, panel: FloatArray, looks: RowDiagnostics) -> None:
    """Copy rows unchanged to the diagnostics."""
    for i in range(panel.shape[1]):
        looks.misclosure[k + i], looks.variance[k + i] = cells[MISCLOSURE, i], cells[VARIANCE, i]
        looks.along[k + i] = cells[ALONG, i]
        for c in range(len(panel)):
            looks.design[k + i, c] = panel[c, i]


@jit_inline
def inspect(
    k: int,
    cells: FloatArray,
    panel: FloatArray,
    looks: RowDiagnostics,
    cofactor: FloatArray,
    g: int,
    weight: Any,
    n: float,
) -> None:
    """Compute f, its variance M + c, and the part of the variance that the estimated unknowns absorb.

    ``cofactor`` is working space.

    n returns that share an error c have the covariance V = M I + c 1 1ᵀ and weights P = I / (M + n c); the fit to a
    return shares (A Q Aᵀ P V)ᵢᵢ = (M aᵢ Q aᵢ + n c aᵢ Q ā) / (M + n c) with it, where ā is the mean of their rows a.
    The residual's variance is M + c minus that if these weights are optimal: exactly so where all rows of a run are
    equal. If they differ, for example by the place in a plane, the sum over all rows is exact if M + n c is the same
    for all; the variance of a single residual is wrong by a seventh at most (99 %) while c is below M / 3. ā is the
    mean of at most PIECE rows.
    """
    width, count = panel.shape
    for c in range(width - 1):  # f itself has no column
        for other in range(width - 1):
            cofactor[c, other] = looks.cofactor[g, c, other]
    turned = np.dot(cofactor, panel)
    mean, rows = np.zeros(width), 0.0
    for i in range(count):
        share = weight[i] if math.isfinite(cells[VARIANCE, i]) else 0.0
        rows += share
        for c in range(width - 1):
            mean[c] += share * panel[c, i]
    mean /= max(rows, 1.0)
    for i in range(count):
        own, with_mean = 0.0, 0.0
        for c in range(width - 1):
            own += panel[c, i] * turned[c, i]
            with_mean += mean[c] * turned[c, i]
        variance, common = cells[VARIANCE, i], n * cells[COMMON, i]
        looks.misclosure[k + i], looks.along[k + i] = cells[MISCLOSURE, i], cells[ALONG, i]
        looks.variance[k + i] = variance + cells[COMMON, i]
        looks.spread[k + i] = (variance * own + common * with_mean) / (variance + common)


@jit_inline
def counted(weight: Any, fate: Any, begin: int, end: int) -> float:
    """Return the number of valid returns in a run, each row counted with the returns that it represents."""
    n = 0.0
    for k in range(begin, end):
        if fate[k] == 0:
            n += weight[k]
    return n


@jit_cached
def accumulate(mode: int, task: Task, weight: FloatArray, huber: float, sums: Sums, looks: RowDiagnostics) -> None:
    """Process a batch: MODE_SUM adds to ``sums``, MODE_LOOK and MODE_GIVE fill ``looks``."""
    groups, head, planes, knots = task.groups, task.head, task.planes, task.knots
    widest = len(head.kind) + STATES + OF_PLANE + 1
    cells, room = np.zeros((ROWS, PIECE)), np.zeros(widest * PIECE)
    every, unknowns = np.zeros(len(head.kind), np.int64), len(head.kind) + 12
    table = np.zeros(unknowns, np.int64), np.zeros(unknowns, np.int64), np.zeros(unknowns, np.int64), np.zeros(unknowns)
    for g in range(len(groups.begin)):
        plane, before, channel = groups.plane[g], groups.before[g], groups.channel[g]
        m = 0
        for c in range(len(head.kind)):
            if head.kind[c] < AZIMUTH or channel < 0 or head.argument[c] == channel:
                every[m] = c
                m += 1
        active = every[:m]
        columns = m + (STATES if before >= 0 else 0)
        width = columns + OF_PLANE + 1
        total = np.zeros((width, width))
        together = counted(weight, task.beam.fate, groups.begin[g], groups.end[g])
        for k in range(groups.begin[g], groups.end[g], PIECE):
            n = min(PIECE, groups.end[g] - k)
            panel = room[: width * n].reshape(width, n)
            fill(cells, panel, k, task, active, plane, before, groups.after[g])
            if mode == MODE_SUM:
                square, count = weigh(cells, panel, weight[k : k + n], huber, together)
                sums.square[0] += square
                sums.counts[0] += count
                add_up(total, np.dot(panel, panel.T))
            elif mode == MODE_LOOK:
                inspect(k, cells, panel, looks, total, g, weight[k : k + n], together)
            else:
                give(k, cells, panel, looks)
        if mode == MODE_SUM:
            normal = vector_at(planes.normal_e, plane)
            m = spread_out(head, knots, active, normal, groups, g, table)
            put(sums, total, table, m, columns, plane)
