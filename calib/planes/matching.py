"""Find the same planes again after the points have moved: correspondences of the next iteration.

A plane's footprint is the area that its returns cover now, in all swaths together. Returns of every swath in the
footprint and near the plane become its returns; a swath that no longer shows the same plane is left out, and others may
be added.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from swath.calib.features import Features, Plane
from swath.calib.flight import Flight
from swath.calib.planes.cells import cell_size, keys_of
from swath.calib.planes.fit import GATE, PlaneSettings, Sight, fit_sight, refusal, scaled_to
from swath.calib.planes.returns import WIDE_M, cells_of, plane_of, pure, returns_near, thinned, well_inside
from swath.georef.arrays import BoolArray, Int64Array
from swath.georef.progress import Tell, silent

LOST = "no longer fits"
_DEFAULT = PlaneSettings()
_SLACK = 1.5  # factor of the tests' limits for former planes
_ROUNDS = 6
_SIGMAS = 4.0


def rematch(
    flight: Flight,
    features: Features,
    settings: PlaneSettings = _DEFAULT,
    each: Callable[..., Any] = map,
    tell: Tell = silent,
) -> Features:
    """Return the planes of features with the returns that lie on them now; other features are unchanged.

    The sets of returns stay the same if the points have not moved since the last call. A plane needs two swaths, or one
    and surveyed data; other planes are dropped and counted. Swaths are processed by `each`, which is called like `map`:
    that of a pool processes several at a time, with the same result. ``tell`` is called with the progress.
    """
    tell("planes, matching", 0, len(features.planes), "planes")
    refused = Counter(features.refused)
    settings = scaled_to(flight, settings)
    kept = [(plane, _agreeing(_sights(flight, plane, settings), settings)) for plane in features.planes]
    known = [(plane, sights) for plane, sights in kept if sights]
    refused[LOST] += len(kept) - len(known)
    cell_m = cell_size(flight, settings)
    candidates = _candidates(flight, known, cell_m, settings, each)
    planes = []
    for number, ((plane, sights), near) in enumerate(zip(known, candidates, strict=True)):
        tell("planes, matching", number, len(known), "planes")
        found = _agreeing(_settled(flight, plane, sights, near, cell_m, settings), settings)
        if len(found) < (1 if _surveyed(plane) else 2):
            refused[LOST] += 1
        else:
            planes.append(plane_of(plane.name, plane.kind, found, plane))
    return replace(features, planes=tuple(planes), refused=+refused)


def _surveyed(plane: Plane) -> bool:
    return bool(plane.control) or plane.given_sigma_m is not None


def _sights(flight: Flight, plane: Plane, settings: PlaneSettings) -> dict[int, Sight]:
    """Fit a plane again with its former returns, and return its sights by swath."""
    sights = {}
    for patch in plane.patches:
        at = patch.at[np.isfinite(flight.swaths[patch.swath].points_t[patch.at]).all(axis=1)]
        sight = fit_sight(flight, flight.swaths[patch.swath], at, settings, bent=False)
        if sight is not None and not refusal(sight, settings, _SLACK):
            sights[patch.swath] = sight
    return sights


def _agreeing(sights: Mapping[int, Sight], settings: PlaneSettings) -> dict[int, Sight]:
    """Return the sights that agree with the most widely supported one; ties go to the one with most returns."""
    swaths = sorted(sights, key=lambda swath: -len(sights[swath].at))
    if len(swaths) < 2:
        return dict(sights)
    normal = np.array([sights[swath].normal_t for swath in swaths])
    centre = np.array([sights[swath].centre_t for swath in swaths])
    sigma = np.array([sights[swath].normal_sigma_rad for swath in swaths])
    doubt = _SIGMAS * np.hypot(sigma[:, np.newaxis], sigma)
    middle = normal[:, np.newaxis] + normal
    apart = centre[:, np.newaxis] - centre
    offset_m = np.abs((middle * apart).sum(axis=2)) / np.linalg.norm(middle, axis=2)
    alike = np.arccos(np.minimum(normal @ normal.T, 1.0)) <= settings.angle_rad + doubt
    alike &= offset_m <= settings.tight_m + 0.5 * doubt * np.linalg.norm(apart, axis=2)
    best = int(np.argmax(alike.sum(axis=1)))
    return {swath: sights[swath] for swath in sorted(np.array(swaths)[alike[best]].tolist())}


def _in_sorted(at: Int64Array, others: Int64Array) -> BoolArray:
    """Return whether rising indexes (n,) are among other rising ones."""
    place = np.minimum(np.searchsorted(others, at), max(len(others) - 1, 0))
    among: BoolArray = others[place] == at if len(others) else np.zeros(len(at), np.bool_)
    return among


def _candidates(
    flight: Flight,
    known: list[tuple[Plane, dict[int, Sight]]],
    cell_m: float,
    settings: PlaneSettings,
    each: Callable[..., Any],
) -> list[dict[int, Int64Array]]:
    """Return, by plane and swath, the returns in the footprint that are not far from the plane."""
    keys, labels = _footprints(flight, known, cell_m)
    near: list[dict[int, Int64Array]] = [{} for _ in known]
    joint = np.array([_row(plane_of("", "", sights), sights, settings) for _, sights in known]).reshape(-1, 5)

    def found(index: int) -> dict[int, Int64Array]:
        rows = joint.copy()
        for label, (_, sights) in enumerate(known):
            if index in sights:
                sight = sights[index]
                rows[label] = [*sight.normal_t, sight.normal_t @ sight.centre_t, max(WIDE_M, sight.gate_m)]
        return returns_near(flight.swaths[index], keys, labels, rows, cell_m)

    order = np.argsort(labels, kind="stable")
    begin = np.searchsorted(labels[order], np.arange(len(known) + 1))
    for index, of_swath in enumerate(each(found, range(len(flight.swaths)))):
        for label, at in of_swath.items():
            face = keys[order[begin[label] : begin[label + 1]]]
            near[label][index] = at[well_inside(np.asarray(flight.swaths[index].points_t[at]), face, cell_m)]
    return near


def _row(plane: Plane, sights: Mapping[int, Sight], settings: PlaneSettings) -> list[float]:
    """Return the plane and search distance for a swath that has not shown the plane so far."""
    reach_m = settings.tight_m + GATE * max(sight.sigma_m for sight in sights.values())
    return [*plane.normal_t.tolist(), float(plane.normal_t @ plane.centre_t), reach_m]


def _footprints(
    flight: Flight, known: list[tuple[Plane, dict[int, Sight]]], cell_m: float
) -> tuple[Int64Array, Int64Array]:
    """Return the cells that planes cover; a cell belongs to the plane with most returns in it."""
    keys, labels = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for label, (_, sights) in enumerate(known):
        for swath, sight in sights.items():
            columns, rows = np.floor(flight.swaths[swath].points_t[sight.at, :2].T / cell_m).astype(np.int64)
            keys.append(keys_of(columns, rows))
            labels.append(np.full(len(columns), label))
    both = np.stack([np.concatenate(keys), np.concatenate(labels)], axis=1)
    pairs, count = np.unique(both, axis=0, return_counts=True)
    order = np.lexsort((pairs[:, 1], -count, pairs[:, 0]))
    pairs = pairs[order]
    first = np.r_[True, np.diff(pairs[:, 0]) != 0][: len(pairs)]
    return pairs[first, 0], pairs[first, 1]


def _settled(
    flight: Flight,
    plane: Plane,
    sights: Mapping[int, Sight],
    near: Mapping[int, Int64Array],
    cell_m: float,
    settings: PlaneSettings,
) -> dict[int, Sight]:
    """Return, by swath, the returns within the gate of the plane that is fitted to them."""
    before = {patch.swath: patch.at for patch in plane.patches}
    found = {}
    for swath, at in near.items():
        had = before.get(swath, np.zeros(0, np.int64))
        sight = sights.get(swath) or fit_sight(
            flight, flight.swaths[swath], thinned(at, settings.most_points), settings
        )
        if sight is None:
            continue
        settled = _settle(flight, swath, sight, at, had, cell_m, settings)
        if settled is not None and not refusal(settled, settings, _SLACK):
            found[swath] = settled
    return found


def _settle(
    flight: Flight, swath: int, sight: Sight, at: Int64Array, had: Int64Array, cell_m: float, settings: PlaneSettings
) -> Sight | None:
    points = np.asarray(flight.swaths[swath].points_t[at])
    cell = cells_of(points, cell_m)
    for _ in range(_ROUNDS):
        plane = np.array([*sight.normal_t, sight.normal_t @ sight.centre_t])
        inside = at[pure(points, plane, sight.gate_m, cell, _in_sorted(at, sight.at))]
        if len(inside) > settings.most_points:
            stayed = np.intersect1d(inside, had)[: settings.most_points]
            fresh = thinned(np.setdiff1d(inside, stayed), settings.most_points - len(stayed))
            inside = np.union1d(stayed, fresh)
        if np.array_equal(inside, sight.at) and np.isfinite(sight.sag_sigma_m):
            return sight
        fitted = fit_sight(flight, flight.swaths[swath], inside, settings)
        if fitted is None:
            return None
        sight, had = fitted, inside
    return sight
