"""Find planes in overlapping strips (ISO/TS 19159-2, 6.6), or take those that the user gives.

The search uses grids first: planes grow over the cells of each swath, the same face is recognised in other swaths by
its place and direction, and faces are cut into pieces. Only then are single returns tested: do they form a plane, as
far as the accuracy of range and angle allows? All roofs are kept; of level ground enough pieces, spread over every pair
of swaths.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Set
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from swath.calib.features import Features, Plane
from swath.calib.flight import Flight, sensor_t
from swath.calib.planes.cells import CELLS_LEAST, Segments, cell_middles, cell_size, segments_of
from swath.calib.planes.fit import GATE, PlaneError, PlaneSettings, expected_sigma, scaled_to
from swath.calib.planes.given import given_planes
from swath.calib.planes.returns import WIDE_M, cells_of, named, plane_of, pure, returns_near, sights_of, well_inside
from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.georef.progress import Tell, silent

FIFTHS, THIRDS, OCTANTS = 5, 3, 8
_ROOF_SHARE = 0.8  # of all planes, if there are too many

_COPLANAR_M = 0.08  # distance between parts of one face in the same swath, beyond their noise
_SIGMAS = 4.0

__all__ = ["PlaneError", "PlaneRow", "PlaneSettings", "find_planes", "given_planes", "plane_rows"]

_DEFAULT = PlaneSettings()
_ROUNDS = 4


def find_planes(
    flight: Flight, settings: PlaneSettings = _DEFAULT, each: Callable[..., Any] = map, tell: Tell = silent
) -> Features:
    """Find planes seen by at least two swaths, roofs first; the reasons why other places have none are counted.

    Only returns of pulses with a single return are used. Failures are counted as tiles of the ground where no plane
    grew, and as planes afterwards. Swaths are searched by `each`, which is called like `map`: that of a pool searches
    several at a time, with the same result. ``tell`` is called with the progress.

    Raises:
        PlaneError: no swath has points.
    """
    refused: Counter[str] = Counter()
    settings = scaled_to(flight, settings)
    cell_m = cell_size(flight, settings)
    segments = _grown(flight, cell_m, settings, refused, each, tell)
    face = same_faces(segments, settings, refused)
    pieces = cut(segments, face, cell_m, settings, refused)
    planes: dict[int, Plane] = {}
    tried: set[int] = set()
    for number in range(_ROUNDS):  # other pieces replace those that turn out to be no planes
        tell("planes, single returns", number, _ROUNDS, "rounds")
        chosen = choose(flight, segments, pieces, settings, tried - planes.keys())
        fresh = np.array([piece for piece in chosen.tolist() if piece not in tried], np.int64)
        tried.update(fresh.tolist())
        for piece, found in _returns(flight, segments, pieces, fresh, cell_m, settings).items():
            sights = sights_of(flight, found, settings, refused)
            if len(sights) > 1:
                planes[piece] = plane_of("", "roof" if pieces.steep[piece] else "ground", sights)
        if not len(fresh):
            break
    refused["more than needed"] += len(pieces.steep) - len(tried)
    order = [piece for piece in dict.fromkeys([*chosen.tolist(), *planes]) if piece in planes]
    return Features(planes=named([planes[piece] for piece in order][: settings.most_planes]), refused=+refused)


def _grown(
    flight: Flight, cell_m: float, settings: PlaneSettings, refused: Counter[str], each: Callable[..., Any], tell: Tell
) -> Segments:
    """Grow planes in all swaths; each swath has its own counter of refusals."""
    why: list[Counter[str]] = [Counter() for _ in flight.swaths]
    found: list[list[Segments]] = []
    tell("planes, grown", 0, len(why), "swaths")
    for pieces in each(lambda index: segments_of(flight, index, cell_m, settings, why[index]), range(len(why))):
        found.append(pieces)
        tell("planes, grown", len(found), len(why), "swaths")
    for counted in why:
        refused.update(counted)
    return Segments.joined([one for pieces in found for one in pieces])


def _returns(
    flight: Flight, segments: Segments, pieces: Pieces, chosen: Int64Array, cell_m: float, settings: PlaneSettings
) -> dict[int, dict[int, Int64Array]]:
    """Return, by piece and swath, the returns in the cells of its segments, near the plane that the segment shows."""
    wanted = np.isin(pieces.piece, chosen)
    cell = np.flatnonzero(pieces.cell_sight >= 0)
    cell = cell[wanted[pieces.cell_sight[cell]]]
    normal, centre = segments.normal_t[pieces.segment], segments.moments[pieces.segment, 1:4]
    gate_m = GATE * _coarse_sigma(flight, segments, settings)[pieces.segment]
    planes = np.column_stack([normal, (normal * centre).sum(axis=1), np.maximum(gate_m, WIDE_M)])
    by_segment = np.argsort(segments.cell_of, kind="stable")
    begin = np.searchsorted(segments.cell_of[by_segment], np.arange(len(segments) + 1))
    found: dict[int, dict[int, Int64Array]] = {piece: {} for piece in chosen.tolist()}
    for index, swath in enumerate(flight.swaths):
        mine = cell[segments.swath[segments.cell_of[cell]] == index]
        near = returns_near(swath, segments.cell_key[mine], pieces.cell_sight[mine], planes, cell_m)
        for sight, at in near.items():
            points = np.asarray(swath.points_t[at])
            face = by_segment[begin[pieces.segment[sight]] : begin[pieces.segment[sight] + 1]]
            taken = pure(points, planes[sight], float(gate_m[sight]), cells_of(points, cell_m))
            at = at[taken & well_inside(points, segments.cell_key[face], cell_m)]
            of_piece = found[int(pieces.piece[sight])]
            of_piece[index] = np.sort(np.concatenate([of_piece[index], at])) if index in of_piece else at
    return found


def _coarse_sigma(flight: Flight, segments: Segments, settings: PlaneSettings) -> FloatArray:
    """Return the expected sigma (k,) of a segment's returns along its normal, metres."""
    sigma = np.zeros(len(segments))
    for index in np.unique(segments.swath):
        swath, mine = flight.swaths[int(index)], np.flatnonzero(segments.swath == index)
        away = segments.moments[mine, 1:4] - sensor_t(flight, swath, segments.first[mine])
        sigma[mine] = expected_sigma(flight.heads[swath.head].noise, away, segments.normal_t[mine], settings)
    return sigma


@dataclass(frozen=True, slots=True)
class PlaneRow:
    """A plane as a row of a report.

    Attributes:
        name, kind: of the plane.
        slope_rad, aspect_rad: its slope, and the azimuth it faces.
        swaths: names of the swaths that saw it.
        points: number of returns on it.
        rms_m: distance of these from it, each swath relative to its own fitted plane.
    """

    name: str
    kind: str
    slope_rad: float
    aspect_rad: float
    swaths: tuple[str, ...]
    points: int
    rms_m: float


def plane_rows(flight: Flight, features: Features) -> list[PlaneRow]:
    """Return the planes used, as rows of a report."""
    return [
        PlaneRow(
            plane.name,
            plane.kind,
            float(np.arccos(np.clip(plane.normal_t[2], -1.0, 1.0))),
            float(np.arctan2(plane.normal_t[0], plane.normal_t[1]) % (2.0 * np.pi)),
            tuple(flight.swaths[patch.swath].name for patch in plane.patches),
            plane.points,
            plane.rms_m,
        )
        for plane in features.planes
    ]


def same_faces(segments: Segments, settings: PlaneSettings, refused: Counter[str]) -> Int64Array:
    """Return the number (k,) of each segment's face; −1 if several swaths do not clearly see that face.

    Two segments are linked where they overlap, face alike, and lie no farther apart than strips do. A face whose
    segments are not all alike, or of which one swath has two that are not coplanar, is ambiguous: it is refused.
    """
    one, other = _overlapping(segments, settings)
    near = _alike(segments, one, other, settings)
    links = coo_array((np.ones(int(near.sum())), (one[near], other[near])), shape=(len(segments), len(segments)))
    count, face = connected_components(links, directed=False)
    face = face.astype(np.int64)
    swaths = np.zeros(count, np.int64)
    np.add.at(swaths, np.unique(np.stack([face, segments.swath], axis=1), axis=0)[:, 0], 1)
    doubtful = np.zeros(count, np.bool_)
    doubtful[face[~_with_largest(segments, face, count, settings)]] = True
    one, other = _of_same_swath(segments, face)
    doubtful[face[one[~_coplanar(segments, one, other)]]] = True
    refused["seen by one swath only"] += int((swaths == 1).sum())
    refused["ambiguous"] += int((doubtful & (swaths > 1)).sum())
    taken = (swaths > 1) & ~doubtful
    number = np.cumsum(taken) - 1
    numbered: Int64Array = np.where(taken[face], number[face], -1)
    return numbered


def _overlapping(segments: Segments, settings: PlaneSettings) -> tuple[Int64Array, Int64Array]:
    """Return the pairs of segments of different swaths with enough cells in common."""
    order = np.argsort(segments.cell_key, kind="stable")
    key, of = segments.cell_key[order], segments.cell_of[order]
    pairs = []
    for lag in range(1, len(key)):
        same = np.flatnonzero(key[lag:] == key[:-lag])
        if not len(same):
            break
        one, other = of[same], of[same + lag]
        apart = segments.swath[one] != segments.swath[other]
        low, high = np.minimum(one, other)[apart], np.maximum(one, other)[apart]
        pairs.append(low * len(segments) + high)
    found, cells = np.unique(np.concatenate([np.zeros(0, np.int64), *pairs]), return_counts=True)
    one, other = found // max(len(segments), 1), found % max(len(segments), 1)
    size = np.bincount(segments.cell_of, minlength=len(segments))
    enough = cells >= settings.overlap * np.minimum(size[one], size[other])
    return one[enough], other[enough]


def _differences(segments: Segments, one: Int64Array, other: Int64Array) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return angles between normals, their sigmas, and distances between the planes midway, of pairs (m,)."""
    cosine = np.minimum((segments.normal_t[one] * segments.normal_t[other]).sum(axis=1), 1.0)
    across, along, _ = segments.spread_m.T
    turn = across / (np.sqrt(segments.moments[:, 0]) * np.maximum(along, 1e-6))
    middle = segments.normal_t[one] + segments.normal_t[other]
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    apart = np.abs((middle * (segments.moments[one, 1:4] - segments.moments[other, 1:4])).sum(axis=1))
    return np.arccos(cosine), np.hypot(turn[one], turn[other]), apart


def _alike(segments: Segments, one: Int64Array, other: Int64Array, settings: PlaneSettings) -> BoolArray:
    """Return whether pairs may be the same face in two slightly displaced swaths."""
    angle, sigma, apart = _differences(segments, one, other)
    level = segments.normal_t[one, 2]
    limit = settings.offset_m + settings.displacement_m * np.sqrt(np.maximum(0.0, 1.0 - level**2))
    alike: BoolArray = (angle <= settings.angle_rad + _SIGMAS * sigma) & (apart <= limit)
    return alike


def _with_largest(segments: Segments, face: Int64Array, count: int, settings: PlaneSettings) -> BoolArray:
    """Return whether segments are like the largest of their face."""
    points = segments.moments[:, 0]
    order = np.lexsort((points, face))
    largest = np.zeros(count, np.int64)
    largest[face[order]] = order
    return _alike(segments, largest[face], np.arange(len(segments)), settings)


def _of_same_swath(segments: Segments, face: Int64Array) -> tuple[Int64Array, Int64Array]:
    """Return the pairs of consecutive segments in the same face and swath."""
    order = np.lexsort((segments.swath, face))
    again = (np.diff(face[order]) == 0) & (np.diff(segments.swath[order]) == 0)
    return order[1:][again], order[:-1][again]


def _coplanar(segments: Segments, one: Int64Array, other: Int64Array) -> BoolArray:
    angle, sigma, apart = _differences(segments, one, other)
    reach = np.linalg.norm(segments.moments[one, 1:4] - segments.moments[other, 1:4], axis=1)
    coplanar: BoolArray = apart <= _COPLANAR_M + 0.5 * _SIGMAS * sigma * reach
    coplanar &= angle <= np.radians(1.0) + _SIGMAS * sigma
    return coplanar


@dataclass(frozen=True, eq=False)
class Pieces:
    """Pieces of faces and their sights; a sight is a piece as one segment shows it.

    Attributes:
        steep: (p,) whether a piece is steeper than ground that is thinned.
        aspect: (p,) azimuth it faces, rad.
        points: (p,) returns of all swaths.
        piece, segment: (s,) of sights, by piece.
        cell_sight: (c,) sight to which each of the segments' cells belongs; −1: none.
    """

    steep: BoolArray
    aspect: FloatArray
    points: Int64Array
    piece: Int64Array
    segment: Int64Array
    cell_sight: Int64Array


def cut(segments: Segments, face: Int64Array, cell_m: float, settings: PlaneSettings, refused: Counter[str]) -> Pieces:
    """Cut faces (k,) of segments into pieces no longer than a tile; two swaths must show a piece well."""
    at = np.flatnonzero(face[segments.cell_of] >= 0)
    of_face = face[segments.cell_of[at]]
    faces = int(face.max(initial=-1)) + 1
    normal = np.zeros((faces, 3))
    known = face >= 0
    np.add.at(normal, face[known], segments.normal_t[known] * segments.moments[known, :1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    steep = normal[:, 2] < np.cos(settings.roof_slope_rad)
    part = _parts(cell_middles(segments.cell_key[at], cell_m), of_face, steep, cell_m, settings)
    _, of_piece = np.unique(of_face * (1 << 20) + part, return_inverse=True)
    sights, first, of_sight = np.unique(
        of_piece * len(segments) + segments.cell_of[at], return_index=True, return_inverse=True
    )
    piece, segment = sights // len(segments), sights % len(segments)
    count = int(of_piece.max(initial=-1)) + 1
    points = np.bincount(of_sight, segments.cell_points[at]).astype(np.int64)
    enough = (points >= 1.2 * settings.least_points) & (np.bincount(of_sight) >= CELLS_LEAST)
    seen = np.unique(np.stack([piece, segments.swath[segment]], axis=1)[enough], axis=0)[:, 0]
    taken = np.bincount(seen, minlength=count) > 1
    refused["too few returns"] += int((~taken).sum())
    kept = enough & taken[piece]
    number, sight_number = np.cumsum(taken) - 1, np.where(kept, np.cumsum(kept) - 1, -1)
    cell_sight = np.full(len(segments.cell_key), -1, np.int64)
    cell_sight[at] = sight_number[of_sight]
    piece, segment, points = number[piece[kept]], segment[kept], points[kept]
    face_of = np.zeros(int(taken.sum()), np.int64)
    face_of[piece] = of_face[first[kept]]
    aspect = np.arctan2(normal[face_of, 0], normal[face_of, 1])
    total = np.bincount(piece, points, minlength=len(face_of)).astype(np.int64)
    return Pieces(steep[face_of], aspect, total, piece, segment, cell_sight)


def _parts(
    place: FloatArray, of_face: Int64Array, steep: BoolArray, cell_m: float, settings: PlaneSettings
) -> Int64Array:
    """Return which part of its face a cell at (c, 2) is in; steep faces are cut along their longer side and across."""
    faces = len(steep)
    size = np.maximum(np.bincount(of_face, minlength=faces), 1)
    mean = np.stack([np.bincount(of_face, axis, minlength=faces) / size for axis in place.T], axis=1)
    x, y = (place - mean[of_face]).T
    xx, xy, yy = (np.bincount(of_face, product, minlength=faces) for product in (x * x, x * y, y * y))
    turn = 0.5 * np.arctan2(2.0 * xy, xx - yy)[of_face]
    part = np.zeros(len(of_face), np.int64)
    for axis in (x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)):
        low, high = np.full(faces, np.inf), np.full(faces, -np.inf)
        np.minimum.at(low, of_face, axis)
        np.maximum.at(high, of_face, axis)
        length = np.where(steep, high - low + cell_m, 0.0)
        pieces = np.maximum(np.ceil(length / settings.tile_m - 0.2), 1).astype(np.int64)
        share = (axis - low[of_face] + 0.5 * cell_m) / (high - low + cell_m)[of_face]
        part = part * 1024 + np.minimum(share * pieces[of_face], pieces[of_face] - 1).astype(np.int64)
    return part


def choose(
    flight: Flight, segments: Segments, pieces: Pieces, settings: PlaneSettings, without: Set[int]
) -> Int64Array:
    """Choose the pieces to use: roofs, in turn by direction; then ground, spread over every pair of swaths."""
    usable = np.ones(len(pieces.steep), np.bool_)
    usable[list(without)] = False
    roofs = np.flatnonzero(pieces.steep & usable)
    octant = np.floor((pieces.aspect[roofs] / (2.0 * np.pi) + 0.5) * OCTANTS).astype(np.int64) % OCTANTS
    order = np.lexsort((-pieces.points[roofs], octant))
    rank = np.empty(len(roofs), np.int64)
    begin = np.searchsorted(octant[order], np.arange(OCTANTS))
    rank[order] = np.arange(len(roofs)) - begin[octant[order]]
    roofs = roofs[np.lexsort((-pieces.points[roofs], rank))]
    ground = _spread_ground(flight, segments, pieces, usable, settings)
    most = max(int(_ROOF_SHARE * settings.most_planes), settings.most_planes - len(ground))
    return np.concatenate([roofs[:most], ground[: settings.most_planes - len(roofs[:most])]])


def _spread_ground(
    flight: Flight, segments: Segments, pieces: Pieces, usable: BoolArray, settings: PlaneSettings
) -> Int64Array:
    """Return level pieces, those seen by many swaths first, as long as a pair of swaths needs more at their place."""
    place = _places(flight, segments)
    level = np.flatnonzero(~pieces.steep & usable)
    begin, end = np.searchsorted(pieces.piece, level), np.searchsorted(pieces.piece, level, side="right")
    order = np.lexsort((-pieces.points[level], begin - end))
    wanted, chosen = Counter[tuple[int, int, int]](), []
    for at in order:
        segment = pieces.segment[begin[at] : end[at]]
        swath = segments.swath[segment].tolist()
        needs = {
            (one, other, int(where))
            for one, where in zip(swath, place[segment], strict=True)
            for other in swath
            if one != other
        }
        if any(wanted[need] < settings.ground_planes for need in needs):
            wanted.update(needs)
            chosen.append(int(level[at]))
    return np.array(chosen, np.int64)


def _places(flight: Flight, segments: Segments) -> Int64Array:
    """Return where in its swath a segment lies (k,): fifths of the swath across times thirds along."""
    place = np.zeros(len(segments), np.int64)
    for index in np.unique(segments.swath):
        swath = flight.swaths[int(index)]
        mine = np.flatnonzero(segments.swath == index)
        ends = sensor_t(flight, swath, np.array([0, len(swath) - 1]))
        track = (ends[1] - ends[0])[:2]
        track = track / max(float(np.linalg.norm(track)), 1e-9)
        away = segments.moments[mine, 1:4] - sensor_t(flight, swath, segments.first[mine])
        aside = np.arctan2(away[:, 0] * track[1] - away[:, 1] * track[0], -away[:, 2])
        along = segments.moments[mine, 1:3] @ track
        place[mine] = _binned(aside, FIFTHS) * THIRDS + _binned(along, THIRDS)
    return place


def _binned(values: FloatArray, bins: int) -> Int64Array:
    low, high = float(values.min()), float(values.max())
    share = (values - low) / max(high - low, 1e-9)
    binned: Int64Array = np.minimum(share * bins, bins - 1).astype(np.int64)
    return binned
