"""GPS time from remembered knots: piecewise, continuous, monotone; between knots both sides' models are blended."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from swath.georef.records import Int64Array
from swath.georef.timescales.edge_train import EdgeTrain, KnotTable
from swath.georef.timescales.gps_time import SECOND_NS

DOUBT_SIGMA_NS = 1e9
BREAK_NS = SECOND_NS // 2  # two sides further apart than this are not blended
LONG_GAP_S = 10.0  # beyond, the errors of both sides are independent; below they are the same


def gps_of_trains(trains: Sequence[EdgeTrain], host_ns: Int64Array) -> tuple[Int64Array, NDArray[np.float64]]:
    """GPS ns (n,) and sigma ns (n,) at host times (n,) from labelled trains in order of time (at least one)."""
    low, high = int(host_ns.min()), int(host_ns.max())
    chosen = _overlapping(trains, low, high)
    tables = [train.knots_between(low, high) for train in chosen]
    gps = [(table.index + (train.labeller.label or 0)) * SECOND_NS for train, table in zip(chosen, tables, strict=True)]
    table, knot_gps = _joined(tables), np.concatenate(gps)
    left = np.clip(np.searchsorted(table.host_ns, host_ns, side="right") - 1, 0, None).astype(np.int64)
    seconds = table.seconds_from(left, host_ns)
    from_left = np.rint(seconds * SECOND_NS).astype(np.int64) + knot_gps[left]
    variance = table.variance(left, seconds)
    sigma = np.sqrt(variance)
    doubt = table.doubt[left] | (chosen[-1].doubtful & (host_ns >= chosen[-1].last_knot_ns))
    right = left + 1
    inside = (right < len(knot_gps)) & (host_ns >= table.host_ns[left])
    if np.any(inside):
        _blend(table, knot_gps, host_ns, left, inside, from_left, sigma)
    return from_left, np.where(doubt, np.maximum(sigma, DOUBT_SIGMA_NS), sigma)


def _overlapping(trains: Sequence[EdgeTrain], low: int, high: int) -> list[EdgeTrain]:
    """The trains with knots in low … high, and the neighbours on both sides."""
    after = [train for train in trains if train.first_knot_ns > high][:1]
    before = [train for train in trains if train.last_knot_ns < low][-1:]
    within = [train for train in trains if train.last_knot_ns >= low and train.first_knot_ns <= high]
    return [*before, *within, *after]


def _joined(tables: Sequence[KnotTable]) -> KnotTable:
    if len(tables) == 1:
        return tables[0]
    return KnotTable(
        np.concatenate([table.host_ns for table in tables]),
        np.concatenate([table.index for table in tables]),
        np.concatenate([table.doubt for table in tables]),
        np.concatenate([table.numbers for table in tables]),
    )


def _blend(
    table: KnotTable,
    knot_gps: Int64Array,
    host_ns: Int64Array,
    left: Int64Array,
    inside: NDArray[np.bool_],
    gps: Int64Array,
    sigma: NDArray[np.float64],
) -> None:
    """Between two knots go over from the left one's line to the right one's, in place."""
    k, host = left[inside], host_ns[inside]
    back = table.seconds_from(k + 1, host)
    from_right = np.rint(back * SECOND_NS).astype(np.int64) + knot_gps[k + 1]
    gap = (table.host_ns[k + 1] - table.host_ns[k]).astype(np.float64)
    share = (host - table.host_ns[k]).astype(np.float64) / gap
    apart = (from_right - gps[inside]).astype(np.float64)
    joined = np.abs(apart) <= BREAK_NS
    gps[inside] += np.where(joined, np.rint(share * apart), 0.0).astype(np.int64)
    left_sigma, right_sigma = sigma[inside] * (1.0 - share), np.sqrt(table.variance(k + 1, back)) * share
    independent = np.hypot(left_sigma, right_sigma)
    mixed = np.where(gap > LONG_GAP_S * SECOND_NS, independent, left_sigma + right_sigma)
    sigma[inside] = np.where(joined, mixed, sigma[inside])
