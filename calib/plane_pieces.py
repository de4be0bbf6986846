"""Faces cut into pieces that count as plane, and which of the pieces are worth having."""

from __future__ import annotations

from collections import Counter
from collections.abc import Set
from dataclasses import dataclass

import numpy as np

from swath.calib.flight import Flight, sensor_t
from swath.calib.plane_settings import PlaneSettings
from swath.calib.planes.cells import CELLS_LEAST, Segments, cell_middles
from swath.georef.arrays import BoolArray, FloatArray
from swath.georef.records import Int64Array

FIFTHS, THIRDS, OCTANTS = 5, 3, 8
_ROOF_SHARE = 0.8  # of all planes, where there are too many


@dataclass(frozen=True, eq=False)
class Pieces:
    """Pieces of faces and their sights: what one segment shows of a piece.

    Attributes:
        steep: (p,) whether a piece is steeper than ground that is thinned.
        aspect: (p,) azimuth it faces, rad.
        points: (p,) returns of all swaths.
        piece, segment: (s,) of sights, by piece.
        cell_sight: (c,) sight each of the segments' cells belongs to; −1: none.
    """

    steep: BoolArray
    aspect: FloatArray
    points: Int64Array
    piece: Int64Array
    segment: Int64Array
    cell_sight: Int64Array


def cut(segments: Segments, face: Int64Array, cell_m: float, settings: PlaneSettings, refused: Counter[str]) -> Pieces:
    """Faces (k,) of segments in pieces no longer than a tile; those that one swath alone shows well are left out."""
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
    """(c,) which part of its face a cell at (c, 2) is in: steep faces are cut along their longer side and across."""
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
    """Pieces to be taken: roofs, those of every direction in turn; then ground, spread over every pair of swaths."""
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
    """Level pieces, those that many swaths see first, as long as a pair of swaths lacks them at a place of theirs."""
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
    """(k,) where in its swath a segment lies: fifths of the swath across times thirds along."""
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
