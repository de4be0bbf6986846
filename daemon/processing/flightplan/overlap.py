"""Find where the swaths of neighbouring lines overlap less than wanted, and which line is to blame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from swath.daemon.config.tables import PlanConfig
from swath.daemon.processing.flightplan.geometry import LineGeometry
from swath.daemon.processing.flightplan.judge import LineVerdict, Reason
from swath.daemon.processing.flightplan.lines import Line
from swath.daemon.processing.flightplan.plan import PlannedLine
from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.georef.geodesy.earth import e_from_geodetic, geodetic_from_e

PARALLEL_RAD = math.radians(20.0)
SAME_TRACK = 0.1  # of the swath's half: a nearer line, as at another height, is no neighbour
FAR = 1.5  # of both halves of the swaths: a line farther away is no neighbour
LEAST_M = 50.0  # shorter stretches of too little overlap are no remark
DUE_SHARE = 0.3  # of the tolerance: a line that was flown this far off towards the outside is to blame


@dataclass(frozen=True, slots=True, eq=False)
class _Side:
    """One line's cells beside a neighbour.

    Attributes:
        cells, other_cells: (n,) of the line and of the neighbour.
        overlap: (n,) overlap by the narrower swath, 0 … 1; negative: a gap.
        outward_m, other_outward_m: (n,) how far either line was flown off, away from the other.
    """

    cells: Int64Array
    other_cells: Int64Array
    overlap: FloatArray
    outward_m: FloatArray
    other_outward_m: FloatArray


def overlap_reasons(
    geometry: LineGeometry, planned: Sequence[PlannedLine], lines: Sequence[Line], config: PlanConfig
) -> None:
    """Set the lines' ``overlap``: the worst lack of overlap for which a line is to blame.

    Of two neighbours, the line is to blame that was flown off its plan, away from the other; if neither was, as over
    ground higher than planned, the one that was flown later.
    """
    wanted = (config.wanted.overlap_percent or 0.0) / 100.0
    due_m = DUE_SHARE * config.tolerance.cross_track_m
    for one, line in enumerate(lines):
        worst: Reason | None = None
        if line.verdict is None:
            line.take_overlap(None)
            continue
        for side in (-1, 1):
            found = _beside(geometry, planned, lines, one, side)
            if found is None:
                continue
            other, beside = found
            lacks = beside.overlap < wanted
            theirs = np.maximum(beside.other_outward_m, 0.0) > np.maximum(beside.outward_m, 0.0)
            is_due = np.maximum(beside.outward_m, beside.other_outward_m) > due_m
            blamed = np.where(is_due, ~theirs, _is_later(line, lines[other]))
            worst = _worse(worst, _lack(line, lines[other].name, beside, lacks & blamed, wanted))
        line.take_overlap(worst)


def _is_later(line: Line, other: Line) -> bool:
    return max(one.begin_ns for one in line.passes) > max(one.begin_ns for one in other.passes)


def _worse(one: Reason | None, other: Reason | None) -> Reason | None:
    if one is None or other is None:
        return one if other is None else other
    return other if (other.is_grave, -other.value) > (one.is_grave, -one.value) else one


def _lack(line: Line, other: str, beside: _Side, mask: BoolArray, wanted: float) -> Reason | None:
    """Return the reason for the masked cells; None: they are too few."""
    assert line.verdict is not None
    cell_m = line.verdict.cell_m
    size_m = float(mask.sum()) * cell_m
    if size_m < LEAST_M:
        return None
    least = float(beside.overlap[mask].min())
    is_grave = float((mask & (beside.overlap < wanted / 2.0)).sum()) * cell_m >= LEAST_M
    places = beside.cells[mask]
    what = f"overlap {100 * least:.0f} % with line {other}" if least >= 0.0 else f"gap to line {other}"
    from_m, to_m = float(places.min()) * cell_m, float(places.max() + 1) * cell_m
    text = f"{what}, below {100 * wanted:g} % on {size_m:.0f} m, {from_m:.0f} to {to_m:.0f} m"
    return Reason("overlap", is_grave, text, 100 * least, 100 * wanted, from_m, to_m)


def _beside(
    geometry: LineGeometry, planned: Sequence[PlannedLine], lines: Sequence[Line], one: int, side: int
) -> tuple[int, _Side] | None:
    """Return the nearest flown neighbour on a side (1: right), and both lines' cells there."""
    verdict = lines[one].verdict
    assert verdict is not None
    edge = verdict.right_m if side > 0 else -verdict.left_m
    known = np.flatnonzero(verdict.flown & ~np.isnan(edge))
    if not len(known):
        return None
    lat, lon, azimuth = _middle(
        planned[one], (known.astype(np.float64) + 0.5) * verdict.cell_m, float(geometry.length_m[one])
    )
    places = geometry.places(lat, lon)
    turned = np.cos(azimuth[:, np.newaxis] - places.azimuth_rad)
    # the neighbour lies to our right if we lie to its left, as seen in our direction
    lies = -places.across_m * np.sign(turned) * side
    inside = (places.along_m >= 0.0) & (places.along_m <= geometry.length_m)
    inside &= (np.abs(turned) > math.cos(PARALLEL_RAD)) & (lies > SAME_TRACK * float(np.median(edge[known])))
    inside[:, one] = False
    there = np.flatnonzero(inside.any(axis=0))
    if not len(there):
        return None
    distance_m = np.array([float(np.median(lies[inside[:, other], other])) for other in there.tolist()])
    other = int(there[np.argmin(distance_m)])
    neighbour = lines[other].verdict
    if neighbour is None:
        return None
    found = _facing(
        verdict, neighbour, known, places.along_m[:, other], places.across_m[:, other], inside[:, other], side
    )
    return None if found is None else (other, found)


def _facing(
    verdict: LineVerdict,
    other: LineVerdict,
    known: Int64Array,
    along: FloatArray,
    across: FloatArray,
    inside: BoolArray,
    side: int,
) -> _Side | None:
    theirs = np.clip((along / other.cell_m).astype(np.int64), 0, len(other.flown) - 1)
    is_right = across > 0.0  # of the other line
    edge = np.where(is_right, other.right_m[theirs], -other.left_m[theirs])
    inside = inside & other.flown[theirs] & ~np.isnan(edge)
    if not inside.any():
        return None
    cells, theirs, edge = known[inside], theirs[inside], edge[inside]
    own_edge = verdict.right_m[cells] if side > 0 else -verdict.left_m[cells]
    width = np.minimum(verdict.right_m[cells] - verdict.left_m[cells], other.right_m[theirs] - other.left_m[theirs])
    distance = np.abs(across[inside])
    if float(np.median(distance)) > FAR * float(np.median(own_edge + edge)):
        return None  # no overlap was planned
    outward = -side * verdict.across_m[cells]
    other_outward = np.where(is_right[inside], -1.0, 1.0) * other.across_m[theirs]
    return _Side(cells, theirs, (own_edge + edge - distance) / width, outward, other_outward)


def _middle(line: PlannedLine, along_m: FloatArray, length_m: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return latitude, longitude and azimuth of places along a line, by straight steps through the earth."""
    lat, lon = np.radians(line.lat_deg), np.radians(line.lon_deg)
    e = e_from_geodetic(lat, lon, np.zeros_like(lat))
    steps = np.linalg.norm(np.diff(e, axis=0), axis=1)
    reached = np.concatenate([[0.0], np.cumsum(steps)])
    share = np.clip(along_m / length_m, 0.0, 1.0) * reached[-1]
    place_e = np.stack([np.interp(share, reached, e[:, axis]) for axis in range(3)], axis=-1)
    place_lat, place_lon, _ = geodetic_from_e(place_e)
    index = np.clip(np.searchsorted(reached, share, side="right") - 1, 0, len(steps) - 1)
    east = (lon[index + 1] - lon[index]) * np.cos((lat[index] + lat[index + 1]) / 2.0)
    return place_lat, place_lon, np.arctan2(east, lat[index + 1] - lat[index])
