"""Collect the returns of known planes, and build planes from the sights in several swaths."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from swath.calib.features import Features, Patch, Plane
from swath.calib.flight import Flight, Swath
from swath.calib.planes.cells import BLOCK, blocks, keys_of
from swath.calib.planes.fit import PlaneSettings, Sight, fit_sight, refusal
from swath.calib.planes.kernels import fill_table, gather
from swath.georef.arrays import BoolArray, FloatArray, Int64Array

WIDE_M = 0.5  # greatest distance of examined returns from a plane
RIM_M = 0.5  # of a face: this far beyond a fold of 17° the other face is 0.15 m away, outside a gate of that size
PURE, PURE_BEFORE = 0.9, 0.75  # least share of a cell's returns that lie on the plane; the second for former members
COMES = 0.9  # share of the gate for returns that were not on the plane before
_SAG_SHARE, _SHORTEST = 0.7, 0.3  # of the allowed sag, for the middle part; of a tile, its least length
_SEED = 19159  # for the choice of returns where there are too many


def returns_near(
    swath: Swath, keys: Int64Array, labels: Int64Array, planes: FloatArray, cell_m: float
) -> dict[int, Int64Array]:
    """Return a swath's single returns in cells, near the plane of their cell: rising indexes by label.

    Args:
        swath: swath with the returns.
        keys, labels: (c,) cells of the lattice, and the plane of each.
        planes: (k, 5) by label: normal, its product with a point of the plane, greatest distance.
        cell_m: of the lattice.
    """
    if not len(keys):
        return {}
    size = 1 << int(np.ceil(np.log2(4 * len(keys))))
    table_keys, table_labels = np.zeros(size, np.int64), np.full(size, -1, np.int32)
    fill_table(keys, labels.astype(np.int32), table_keys, table_labels)
    room_at, room_label = np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int32)
    found_at, found_label = [np.zeros(0, np.int64)], [np.zeros(0, np.int32)]
    for first, points, returns in blocks(swath):
        count = gather(points, returns, first, cell_m, table_keys, table_labels, planes, room_at, room_label)
        found_at.append(room_at[:count].copy())
        found_label.append(room_label[:count].copy())
    at, label = np.concatenate(found_at), np.concatenate(found_label)
    order = np.argsort(label, kind="stable")
    at, label = at[order], label[order]
    cuts = np.flatnonzero(np.diff(label)) + 1
    return {int(label[part[0]]): at[part] for part in np.split(np.arange(len(at)), cuts) if len(part)}


def cells_of(points_t: FloatArray, cell_m: float) -> Int64Array:
    """Return numbers (n,), from 0 on, of the cells in which points (n, 3) lie."""
    columns, rows = np.floor(points_t[:, :2].T / cell_m).astype(np.int64)
    columns, rows = columns - columns.min(initial=0), rows - rows.min(initial=0)
    numbers: Int64Array = np.unique(keys_of(columns, rows), return_inverse=True)[1]
    return numbers


def well_inside(points_t: FloatArray, keys: Int64Array, cell_m: float) -> BoolArray:
    """Return which of points (n, 3) are at least `RIM_M`, or half of a small cell, inside the cells (c,) of a face.

    Beyond a ridge the other face stays within the gate for some decimetres, always below: returns from there would make
    roofs lower, most of all in strips whose gate is wide, which looks like a range scale.
    """
    inside = np.ones(len(points_t), np.bool_)
    rim_m = min(RIM_M, 0.5 * cell_m)
    for corner_m in ((-rim_m, -rim_m), (-rim_m, rim_m), (rim_m, -rim_m), (rim_m, rim_m)):
        columns, rows = np.floor((points_t[:, :2] + corner_m).T / cell_m).astype(np.int64)
        inside &= np.isin(keys_of(columns, rows), keys)
    return inside


def pure(
    points_t: FloatArray, plane: FloatArray, gate_m: float, cell: Int64Array, had: BoolArray | None = None
) -> BoolArray:
    """Return which of points (n, 3) are within a gate of a plane (4,), in cells (n,) where nearly all points are.

    At a ridge both faces run through one cell: returns within the gate there belong to both. Former members (``had``)
    stay within wider limits than new ones, so that sets become stable.
    """
    distance = np.abs(points_t @ plane[:3] - plane[3])
    share = np.bincount(cell, distance <= gate_m) / np.bincount(cell)
    comes: BoolArray = (distance <= COMES * gate_m) & (share >= PURE)[cell]
    if had is None:
        return comes
    stays: BoolArray = (distance <= gate_m) & (share >= PURE_BEFORE)[cell]
    return (stays & had) | comes


def thinned(at: Int64Array, most: int) -> Int64Array:
    """Thin indexes to at most ``most``: one drawn from each of as many equal stretches, always the same ones."""
    if len(at) <= most:
        return at
    edges = np.linspace(0.0, len(at), most + 1)
    share = np.random.default_rng(_SEED).random(most)
    return at[np.minimum((edges[:-1] + share * np.diff(edges)).astype(np.int64), len(at) - 1)]


def limited(features: Features, rows: int) -> Features:
    """Limit the total number of returns on planes; large patches are cut to a common size."""
    sizes = np.sort([len(patch.at) for plane in features.planes for patch in plane.patches])
    if sizes.sum() <= rows:
        return features
    kept = np.concatenate([[0], np.cumsum(sizes)[:-1]]) + sizes * np.arange(len(sizes), 0, -1)  # larger ones cut to it
    first = int(np.argmax(kept > rows))
    most = max(int((rows - sizes[:first].sum()) // (len(sizes) - first)), 1)
    planes = (
        replace(plane, patches=tuple(Patch(patch.swath, thinned(patch.at, most)) for patch in plane.patches))
        for plane in features.planes
    )
    return replace(features, planes=tuple(planes))


def sights_of(
    flight: Flight, found: Mapping[int, Int64Array], settings: PlaneSettings, refused: Counter[str]
) -> dict[int, Sight]:
    """Return, by swath, the sights of a plane that pass the tests; reasons of failures are counted.

    If a place is curved as a whole, only its middle is used, as far as that is plane.
    """
    good, why, bent_m = _tested(flight, found, settings)
    if len(good) < 2 and bent_m > settings.sag_m:
        middle = _middle(flight, found, float(np.sqrt(_SAG_SHARE * settings.sag_m / bent_m)), settings)
        good, _, _ = _tested(flight, middle, settings)
    kept = _together(flight, good, settings)
    why["ambiguous"] += len(good) - len(kept)
    if len(kept) < 2:
        refused[why.most_common(1)[0][0] if why.total() else "seen by one swath only"] += 1
    return kept


def _tested(
    flight: Flight, found: Mapping[int, Int64Array], settings: PlaneSettings
) -> tuple[dict[int, Sight], Counter[str], float]:
    """Return the sights that are planes, the reasons why others are not, and the curvature of these, metres."""
    good: dict[int, Sight] = {}
    why: Counter[str] = Counter()
    bent_m = 0.0
    for swath, at in sorted(found.items()):
        sight = fit_sight(flight, flight.swaths[swath], thinned(at, settings.most_points), settings)
        reason = refusal(sight, settings)
        if sight is not None and not reason:
            good[swath] = sight
        else:
            why[reason] += 1
            bent_m = max(bent_m, sight.sag_m if sight is not None and reason == "curved" else 0.0)
    return good, why, bent_m


def _middle(
    flight: Flight, found: Mapping[int, Int64Array], share: float, settings: PlaneSettings
) -> dict[int, Int64Array]:
    """Return the returns in the middle of all, a share of the whole length and width; none if that is too short."""
    places = {swath: np.asarray(flight.swaths[swath].points_t[at, :2]) for swath, at in found.items()}
    every = np.concatenate(list(places.values()))
    low, high = every.min(axis=0), every.max(axis=0)
    half = 0.5 * share * (high - low)
    if 2.0 * half.max() < _SHORTEST * settings.tile_m:
        return {}
    inside = {swath: (np.abs(place - 0.5 * (low + high)) <= half).all(axis=1) for swath, place in places.items()}
    return {swath: found[swath][one] for swath, one in inside.items() if one.any()}


def _together(flight: Flight, sights: dict[int, Sight], settings: PlaneSettings) -> dict[int, Sight]:
    """Return the sights that cover the same area as the one with most returns, or a part of it."""
    if len(sights) < 2:
        return sights
    boxes = {}
    for swath, sight in sights.items():
        place = flight.swaths[swath].points_t[sight.at, :2]
        boxes[swath] = place.min(axis=0), place.max(axis=0)
    low, high = boxes[max(sights, key=lambda swath: len(sights[swath].at))]
    kept = {}
    for swath, (mine_low, mine_high) in boxes.items():
        common = np.minimum(high, mine_high) - np.maximum(low, mine_low) + settings.displacement_m
        smaller = np.minimum(high - low, mine_high - mine_low) + settings.displacement_m
        if (common > settings.overlap * smaller).all():
            kept[swath] = sights[swath]
    return kept


def plane_of(name: str, kind: str, sights: Mapping[int, Sight], like: Plane | None = None) -> Plane:
    """Build a plane from its sights, weighted by the certainty of their directions.

    Control and surveyed sigmas are copied from the plane ``like``, if given.
    """
    weight = np.array([1.0 / max(sight.normal_sigma_rad, 1e-9) ** 2 for sight in sights.values()])
    normals = np.array([sight.normal_t for sight in sights.values()])
    normal = weight @ normals
    normal /= np.linalg.norm(normal)
    count = np.array([len(sight.at) for sight in sights.values()], np.float64)
    centre = count @ np.array([sight.centre_t for sight in sights.values()]) / count.sum()
    squares = sum((len(sight.at) - 3) * sight.rms_m**2 for sight in sights.values())
    rms_m = float(np.sqrt(squares / max(float(count.sum()) - 3 * len(sights), 1.0)))
    patches = tuple(Patch(swath, sight.at) for swath, sight in sights.items())
    if like is None:
        return Plane(name, centre, normal, patches, rms_m, kind=kind)
    return Plane(name, centre, normal, patches, rms_m, like.control, like.given_sigma_m, like.given_sigma_rad, kind)


def named(planes: Sequence[Plane]) -> tuple[Plane, ...]:
    """Name the planes by kind and number, as ``roof 017``."""
    counts: Counter[str] = Counter()
    made = []
    for plane in planes:
        counts[plane.kind] += 1
        made.append(replace(plane, name=f"{plane.kind} {counts[plane.kind]:03d}"))
    return tuple(made)
