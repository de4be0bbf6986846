"""Planes found in overlapping strips (ISO/TS 19159-2, 6.6), or given by the user.

Grid first: planes are grown over the cells of each swath, the same face is recognised in other swaths by its place and
direction, faces are cut into pieces, and only then are single returns looked at: are they a plane, as good as the
range and the angle are? Roofs are all kept; of level ground there are enough pieces spread over every pair of swaths.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from swath.calib.features import Features, Plane
from swath.calib.flight import Flight, sensor_t
from swath.calib.plane_faces import same_faces
from swath.calib.plane_pieces import Pieces, choose, cut
from swath.calib.plane_settings import PlaneError, PlaneSettings, scaled_to
from swath.calib.planes.cells import Segments, cell_size, segments_of
from swath.calib.planes.fit import GATE, expected_sigma
from swath.calib.planes.given import given_planes
from swath.calib.planes.returns import WIDE_M, cells_of, named, plane_of, pure, returns_near, sights_of, well_inside
from swath.georef.arrays import FloatArray
from swath.georef.records import Int64Array

__all__ = ["PlaneError", "PlaneRow", "PlaneSettings", "find_planes", "given_planes", "plane_rows"]

_DEFAULT = PlaneSettings()
_ROUNDS = 4


def find_planes(flight: Flight, settings: PlaneSettings = _DEFAULT, each: Callable[..., Any] = map) -> Features:
    """Planes seen by at least two swaths, roofs first; why other places bear none is counted by reason.

    Returns of pulses with a single return count. Candidates are counted as tiles of the ground where nothing grew, as
    planes afterwards. Swaths are searched by `each`, as `map` calls: a pool's does it for several at a time, and the
    result is the same.

    Raises:
        PlaneError: no swath has points.
    """
    refused: Counter[str] = Counter()
    settings = scaled_to(flight, settings)
    cell_m = cell_size(flight, settings)
    segments = _grown(flight, cell_m, settings, refused, each)
    face = same_faces(segments, settings, refused)
    pieces = cut(segments, face, cell_m, settings, refused)
    planes: dict[int, Plane] = {}
    tried: set[int] = set()
    for _ in range(_ROUNDS):  # others stand in for what turns out to be no plane
        chosen = choose(flight, segments, pieces, settings, tried - planes.keys())
        fresh = np.array([piece for piece in chosen.tolist() if piece not in tried], np.int64)
        tried.update(fresh.tolist())
        for piece, found in _returns(flight, segments, pieces, fresh, cell_m, settings).items():
            sights = sights_of(flight, found, settings, refused)
            if len(sights) > 1:
                planes[piece] = plane_of("", "roof" if pieces.steep[piece] else "ground", sights)
        if not len(fresh):
            break
    refused["enough of them"] += len(pieces.steep) - len(tried)
    order = [piece for piece in dict.fromkeys([*chosen.tolist(), *planes]) if piece in planes]
    return Features(planes=named([planes[piece] for piece in order][: settings.most_planes]), refused=+refused)


def _grown(
    flight: Flight, cell_m: float, settings: PlaneSettings, refused: Counter[str], each: Callable[..., Any]
) -> Segments:
    """Of all swaths; each counts for itself why places bear no plane."""
    why: list[Counter[str]] = [Counter() for _ in flight.swaths]
    found = list(each(lambda index: segments_of(flight, index, cell_m, settings, why[index]), range(len(why))))
    for counted in why:
        refused.update(counted)
    return Segments.joined([one for pieces in found for one in pieces])


def _returns(
    flight: Flight, segments: Segments, pieces: Pieces, chosen: Int64Array, cell_m: float, settings: PlaneSettings
) -> dict[int, dict[int, Int64Array]]:
    """By piece and swath, the returns in the cells of its segments, near the plane that the segment shows."""
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
    """(k,) expected of a return of a segment along its normal, metres."""
    sigma = np.zeros(len(segments))
    for index in np.unique(segments.swath):
        swath, mine = flight.swaths[int(index)], np.flatnonzero(segments.swath == index)
        away = segments.moments[mine, 1:4] - sensor_t(flight, swath, segments.first[mine])
        sigma[mine] = expected_sigma(flight.heads[swath.head].noise, away, segments.normal_t[mine], settings)
    return sigma


@dataclass(frozen=True, slots=True)
class PlaneRow:
    """A plane for a report.

    Attributes:
        name, kind: of the plane.
        slope_rad, aspect_rad: how steep it is, and the azimuth it faces.
        swaths: names of those that saw it.
        points: returns on it.
        rms_m: of them from it, swath by swath.
    """

    name: str
    kind: str
    slope_rad: float
    aspect_rad: float
    swaths: tuple[str, ...]
    points: int
    rms_m: float


def plane_rows(flight: Flight, features: Features) -> list[PlaneRow]:
    """What was taken, plane by plane."""
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
