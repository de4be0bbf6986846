"""Find where the swaths of neighbouring lines overlap less than wanted, and which line is to blame."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from swath.daemon.config.tables import PlanConfig
from swath.daemon.processing.flightplan.geometry import LineGeometry, Places
from swath.daemon.processing.flightplan.judge import LineVerdict, Reason
from swath.daemon.processing.flightplan.lines import Line
from swath.daemon.processing.flightplan.plan import PlannedLine
from swath.georef.arrays import BoolArray, FloatArray, Int64Array, SingleArray
from swath.georef.geodesy.earth import e_from_geodetic, geodetic_from_e

PARALLEL_RAD = math.radians(20.0)
SAME_TRACK = 0.1  # of the swath's half: a nearer line, as at another height, is no neighbour
FAR = 1.5  # of both halves of the swaths: a line farther away is no neighbour
LEAST_M = 50.0  # shorter stretches of too little overlap are no remark
NEAREST = 6  # lines that are looked at as neighbours, by the plan
LOOKS = 40  # places of a line at which these are looked for
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


@dataclass(slots=True, eq=False)
class _Neighbour:
    """The nearest planned line on a side of a flown one.

    Attributes:
        line: its place in the plan.
        side: 1: to the right, -1: to the left.
        cells: (n,) cells of the flown line.
        along_m, across_m, inside: (n,) where they are on the neighbour, and whether they lie beside it.
        verdict: of the neighbour, for which ``beside`` holds.
        beside: both lines' cells there; None: the neighbour is not flown there, or too far away.
    """

    line: int
    side: int
    cells: Int64Array
    along_m: SingleArray
    across_m: SingleArray
    inside: BoolArray
    verdict: LineVerdict | None = None
    beside: _Side | None = None

    def face(self, own: LineVerdict, verdict: LineVerdict | None) -> None:
        """Compare the flown line with the neighbour's newest verdict, if that has changed."""
        if verdict is not self.verdict:
            self.verdict = verdict
            self.beside = None if verdict is None else _facing(own, verdict, self)


@dataclass(frozen=True, slots=True)
class Pair:
    """Two neighbouring lines.

    Attributes:
        first, second: names, in the order of the plan.
        least: overlap by the narrower swath that is not reached on `LEAST_M` of them; negative: a gap.
    """

    first: str
    second: str
    least: float


@dataclass(frozen=True, slots=True, eq=False)
class _Beside:
    """Where the middles of a line's cells are on the lines nearest to it, by the plan alone.

    Attributes:
        lines: (m,) places of these lines in the plan.
        along_m, across_m: (n, m) on each of them, to a centimetre as all lengths here.
        right_m: (n, m) how far each of them lies to the right, as seen in the line's direction.
        parallel: (n, m) whether it lies beside the cell, in about the same direction or the opposite one.
    """

    lines: Int64Array
    along_m: SingleArray
    across_m: SingleArray
    right_m: SingleArray
    parallel: BoolArray


class Overlaps:
    """Overlap of the swaths of neighbouring lines; what has not changed is not computed again.

    Args:
        planned: the lines.
        geometry: of the lines.
    """

    def __init__(self, planned: Sequence[PlannedLine], geometry: LineGeometry) -> None:
        self._planned, self._geometry = planned, geometry
        self._plan: dict[int, _Beside] = {}
        self._known: dict[int, tuple[LineVerdict, list[_Neighbour]]] = {}
        self._watching: dict[int, set[int]] = {}  # by line, those whose neighbour it is

    def blame(self, lines: Sequence[Line], config: PlanConfig, changed: Iterable[int]) -> None:
        """Set the ``overlap`` of changed lines and their neighbours: the worst lack for which a line is to blame.

        Of two neighbours, the line is to blame that was flown off its plan, away from the other; if neither was, as
        over ground higher than planned, the one that was flown later.
        """
        wanted = (config.wanted.overlap_percent or 0.0) / 100.0
        due_m = DUE_SHARE * config.tolerance.cross_track_m
        for one in sorted({*changed, *(other for line in changed for other in self._watching.get(line, ()))}):
            line = lines[one]
            worst: Reason | None = None
            for neighbour, beside in self._beside(lines, one):
                other = lines[neighbour.line]
                lacks = beside.overlap < wanted
                if not lacks.any():
                    continue
                theirs = np.maximum(beside.other_outward_m, 0.0) > np.maximum(beside.outward_m, 0.0)
                is_due = np.maximum(beside.outward_m, beside.other_outward_m) > due_m
                blamed = np.where(is_due, ~theirs, _is_later(line, other))
                worst = _worse(worst, _lack(line, other.name, beside, lacks & blamed, wanted))
            line.take_overlap(worst)

    def pairs(self, lines: Sequence[Line]) -> list[Pair]:
        """Return the neighbours that have both been flown, in the order of the plan."""
        found: dict[tuple[int, int], float] = {}
        for one, line in enumerate(lines):
            for neighbour, beside in self._beside(lines, one):
                assert line.verdict is not None
                key = min(one, neighbour.line), max(one, neighbour.line)
                count = min(len(beside.overlap), math.ceil(LEAST_M / line.verdict.cell_m))
                least = float(np.partition(beside.overlap, count - 1)[count - 1])
                found[key] = min(least, found.get(key, math.inf))
        return [Pair(lines[one].name, lines[other].name, least) for (one, other), least in sorted(found.items())]

    def _beside(self, lines: Sequence[Line], one: int) -> list[tuple[_Neighbour, _Side]]:
        """Return a line's neighbours that have been flown beside it; on each side one at most."""
        verdict = lines[one].verdict
        if verdict is None:
            self._known.pop(one, None)
            return []
        kept = self._known.get(one)
        if kept is None or kept[0] is not verdict:
            kept = self._known[one] = verdict, self._neighbours(verdict, one)
        for neighbour in kept[1]:
            neighbour.face(verdict, lines[neighbour.line].verdict)
        return [(neighbour, neighbour.beside) for neighbour in kept[1] if neighbour.beside is not None]

    def _neighbours(self, verdict: LineVerdict, one: int) -> list[_Neighbour]:
        """Return the nearest planned line on each side of a flown one."""
        flown = np.flatnonzero(verdict.flown & ~np.isnan(verdict.right_m - verdict.left_m))
        if not len(flown):
            return []
        if one not in self._plan:
            self._plan[one] = self._by_plan(verdict, one)
        plan = self._plan[one]
        found = []
        for side in (-1, 1):
            edge = float(np.median(verdict.right_m[flown] if side > 0 else -verdict.left_m[flown]))
            lies = side * plan.right_m[flown]
            inside = plan.parallel[flown] & (lies > SAME_TRACK * edge)
            there = np.flatnonzero(inside.any(axis=0))
            if not len(there):
                continue
            distance_m = [float(np.median(lies[inside[:, at], at])) for at in there.tolist()]
            at = int(there[np.argmin(distance_m)])
            other = int(plan.lines[at])
            along, across = plan.along_m[flown, at], plan.across_m[flown, at]
            found.append(_Neighbour(other, side, flown, along, across, inside[:, at]))
            self._watching.setdefault(other, set()).add(one)
        return found

    def _by_plan(self, verdict: LineVerdict, one: int) -> _Beside:
        """Return where the line's cells are on the lines that are nearest to it."""
        along_m = (np.arange(len(verdict.flown), dtype=np.float64) + 0.5) * verdict.cell_m
        lat, lon, azimuth = _middle(self._planned[one], along_m, float(self._geometry.length_m[one]))
        sample = slice(None, None, max(1, len(along_m) // LOOKS))
        places = self._geometry.places(lat[sample], lon[sample])
        parallel, _ = _relation(places, self._geometry.length_m, azimuth[sample])
        away_m = np.where(parallel, np.abs(places.across_m), math.inf).min(axis=0)
        away_m[one] = math.inf
        lines = np.sort(np.argsort(away_m, kind="stable")[: int(min(NEAREST, np.isfinite(away_m).sum()))])
        geometry = LineGeometry([self._planned[line] for line in lines.tolist()])
        places = geometry.places(lat, lon)
        parallel, right_m = _relation(places, geometry.length_m, azimuth)
        along32_m, across32_m = places.along_m.astype(np.float32), places.across_m.astype(np.float32)
        return _Beside(lines, along32_m, across32_m, right_m.astype(np.float32), parallel)


def _relation(places: Places, length_m: FloatArray, azimuth: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Return whether lines lie beside places on a line with these directions, and how far to the right; (n, lines)."""
    turned = np.cos(azimuth[:, np.newaxis] - places.azimuth_rad)
    parallel = (places.along_m >= 0.0) & (places.along_m <= length_m) & (np.abs(turned) > math.cos(PARALLEL_RAD))
    # the neighbour lies to our right if we lie to its left, as seen in our direction
    return parallel, -places.across_m * np.sign(turned)


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


def _facing(verdict: LineVerdict, other: LineVerdict, neighbour: _Neighbour) -> _Side | None:
    """Return a flown line's cells beside a neighbour's; None: there are none, or no overlap was planned."""
    theirs = np.clip((neighbour.along_m / other.cell_m).astype(np.int64), 0, len(other.flown) - 1)
    is_right = neighbour.across_m > 0.0  # of the other line
    edge = np.where(is_right, other.right_m[theirs], -other.left_m[theirs])
    inside = neighbour.inside & other.flown[theirs] & ~np.isnan(edge)
    if not inside.any():
        return None
    cells, theirs, edge = neighbour.cells[inside], theirs[inside], edge[inside]
    own_edge = verdict.right_m[cells] if neighbour.side > 0 else -verdict.left_m[cells]
    width = np.minimum(verdict.right_m[cells] - verdict.left_m[cells], other.right_m[theirs] - other.left_m[theirs])
    distance = np.abs(neighbour.across_m[inside])
    if float(np.median(distance)) > FAR * float(np.median(own_edge + edge)):
        return None
    outward = -neighbour.side * verdict.across_m[cells]
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
