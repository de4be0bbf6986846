"""Which planes of several swaths are one face: what lies in the same place and direction, and nothing else does."""

from __future__ import annotations

from collections import Counter

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from swath.calib.plane_settings import PlaneSettings
from swath.calib.planes.cells import Segments
from swath.georef.arrays import BoolArray, FloatArray
from swath.georef.records import Int64Array

_COPLANAR_M = 0.08  # by which parts of one face may lie apart in the same swath, besides their noise
_SIGMAS = 4.0


def same_faces(segments: Segments, settings: PlaneSettings, refused: Counter[str]) -> Int64Array:
    """(k,) number of the face that each segment belongs to; −1: of none that several swaths see without doubt.

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
    """Pairs of segments of different swaths with enough cells in common."""
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
    """Angles between normals, their sigmas, distances of the planes from each other midway, of pairs (m,)."""
    cosine = np.minimum((segments.normal_t[one] * segments.normal_t[other]).sum(axis=1), 1.0)
    across, along, _ = segments.spread_m.T
    turn = across / (np.sqrt(segments.moments[:, 0]) * np.maximum(along, 1e-6))
    middle = segments.normal_t[one] + segments.normal_t[other]
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    apart = np.abs((middle * (segments.moments[one, 1:4] - segments.moments[other, 1:4])).sum(axis=1))
    return np.arccos(cosine), np.hypot(turn[one], turn[other]), apart


def _alike(segments: Segments, one: Int64Array, other: Int64Array, settings: PlaneSettings) -> BoolArray:
    """Whether pairs may be the same face of two swaths that lie a little beside each other."""
    angle, sigma, apart = _differences(segments, one, other)
    level = segments.normal_t[one, 2]
    limit = settings.offset_m + settings.displacement_m * np.sqrt(np.maximum(0.0, 1.0 - level**2))
    alike: BoolArray = (angle <= settings.angle_rad + _SIGMAS * sigma) & (apart <= limit)
    return alike


def _with_largest(segments: Segments, face: Int64Array, count: int, settings: PlaneSettings) -> BoolArray:
    """Whether segments are like the largest of their face."""
    points = segments.moments[:, 0]
    order = np.lexsort((points, face))
    largest = np.zeros(count, np.int64)
    largest[face[order]] = order
    return _alike(segments, largest[face], np.arange(len(segments)), settings)


def _of_same_swath(segments: Segments, face: Int64Array) -> tuple[Int64Array, Int64Array]:
    """Segments of which another is the one before in the same face and swath, and those."""
    order = np.lexsort((segments.swath, face))
    again = (np.diff(face[order]) == 0) & (np.diff(segments.swath[order]) == 0)
    return order[1:][again], order[:-1][again]


def _coplanar(segments: Segments, one: Int64Array, other: Int64Array) -> BoolArray:
    angle, sigma, apart = _differences(segments, one, other)
    reach = np.linalg.norm(segments.moments[one, 1:4] - segments.moments[other, 1:4], axis=1)
    coplanar: BoolArray = apart <= _COPLANAR_M + 0.5 * _SIGMAS * sigma * reach
    coplanar &= angle <= np.radians(1.0) + _SIGMAS * sigma
    return coplanar
