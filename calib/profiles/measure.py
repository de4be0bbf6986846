"""Measure one profile: place its returns anew with the current angle until the two sections coincide."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from swath.calib.flight import Flight, Swath
from swath.calib.profiles.fit import TURNS, Fit, comparable, levers, solve, trajectory_sigmas
from swath.calib.profiles.places import SAMPLES, Place, Track
from swath.calib.profiles.sections import Corridor, Pieces, best_shift, fit_pieces, heights_by_bin
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.scanner.calibration import Calibration

Drawn = tuple[FloatArray, FloatArray]
"""Distances and heights (n,)."""
FloatTriple = tuple[FloatArray, FloatArray, FloatArray]
"""Distances, asides and heights (n,)."""

KINDS = ("roll", "pitch", "heading", "range")
PARAMETER = {"roll": "omega_rad", "pitch": "phi_rad", "heading": "kappa_rad", "range": "range_offset_m"}
BIN_M = 1.0  # bin size of the sections that are shifted against each other
CAP_M = 1.0  # greatest deviation of heights that counts
UNIQUE = 1.1  # factor by which the next best shift has to fit worse
RETURNS_A_PIECE = 16  # average number of returns that sets the size of pieces
ITERATIONS = 6
DONE = 0.02  # sigmas
LEAST_SLOPE = 0.06  # along the profile, of pieces for pitch and heading: flatter ones do not show the angle
CHUNK = 8192  # neighbouring returns that are examined or skipped together
NO_TRACK = "a swath has no straight track"
TOO_FEW_RETURNS = "too few returns"
TOO_FEW_PIECES = "both swaths share too few pieces of smooth ground"
TOO_FEW_SLOPES = "both swaths share too few smooth slopes along the profile"
TOO_UNSURE = "too uncertain"


@dataclass(frozen=True, slots=True)
class Settings:
    """Limits and sizes of the profiles.

    Attributes:
        half_width_m, piece_m: of the corridor and of its pieces where the returns are dense enough; otherwise they
            grow.
        least_returns, least_pieces: with fewer a piece or profile is refused.
        most_a_pair: profiles of a pair of swaths.
        flat_slope: greatest slope of ground for roll and of targets.
        rms_m: greatest scatter of a piece about its plane.
        slope_apart: greatest difference of slopes of two swaths' pieces that count as the same ground.
        search_rad: greatest angle that is searched.
        target_radius_m: of a control target.
        unsaid_sigma: position m, attitude rad, for trajectories without sigmas.
        greatest_sigma_rad: greatest sigma of an accepted profile.
        rounds: of the stepwise procedure.
        most_drawn: returns of a section that are kept for its picture.
    """

    half_width_m: float = 2.0
    piece_m: float = 3.0
    least_returns: int = 7
    least_pieces: int = 8
    most_a_pair: int = 3
    flat_slope: float = 0.12
    rms_m: float = 0.06
    slope_apart: float = 0.12
    search_rad: float = math.radians(2.0)
    target_radius_m: float = 2.0
    unsaid_sigma: tuple[float, float] = (0.05, 1e-4)
    greatest_sigma_rad: float = 2e-3
    rounds: int = 2
    most_drawn: int = 8000


@dataclass(frozen=True, eq=False)
class Measured:
    """The numbers of a measured profile; see `swath.calib.profiles.stepwise.Profile`."""

    kind: str
    first: int
    second: int
    ends_t: FloatArray
    before: tuple[Drawn, Drawn]
    after: tuple[Drawn, Drawn]
    baseline_m: float
    found: float
    fit: Fit
    pieces: int
    cells: tuple[Corridor, ...]
    slope_t: FloatArray
    targets: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Part:
    """A swath's returns around a corridor."""

    flight: Flight
    swath: Swath
    corridor: Corridor
    calibration: Calibration

    def section(self, parameter: str, correction: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return distance, aside and height (n,) of the returns that lie in the corridor with a corrected parameter."""
        value = self.calibration.value(parameter) + correction
        points_t = self.flight.place(self.swath, self.calibration.changed(**{parameter: value}))
        points_t = points_t[np.isfinite(points_t[:, 0])]
        points_t = points_t[self.corridor.holds(points_t)]
        distance_m, aside_m = self.corridor.coordinates(points_t)
        return distance_m, aside_m, points_t[:, 2]


def shifts_m(flight: Flight, points_of: Mapping[str, Calibration], now: Mapping[str, Calibration]) -> float:
    """Return approximately how far points move at most from one set of calibrations to another."""
    moved = 0.0
    for swath in flight.swaths:
        name = flight.heads[swath.head].name
        if points_of[name] is now[name] or not len(swath):
            continue
        at = np.unique(np.linspace(0, len(swath) - 1, SAMPLES).astype(np.int64))
        away = flight.place(swath, now[name], at) - flight.place(swath, points_of[name], at)
        away = away[np.isfinite(away[:, 0])]
        moved = max(moved, float(np.max(np.linalg.norm(away, axis=1), initial=0.0)))
    return 1.1 * moved


@dataclass(frozen=True, eq=False)
class Ground:
    """A swath, and boxes (k, 4) of least and greatest east and north around every `CHUNK` of its points."""

    swath: Swath
    boxes_t: FloatArray

    @classmethod
    def of(cls, swath: Swath) -> Ground:
        """Create the boxes of a swath; points that are nan do not count."""
        begins = range(0, len(swath), CHUNK)
        parts = [np.asarray(swath.points_t[begin : begin + CHUNK, :2]) for begin in begins]
        boxes = [np.concatenate([np.fmin.reduce(part), np.fmax.reduce(part)]) for part in parts]
        return cls(swath, np.array(boxes).reshape(-1, 4))

    def rows_near(self, corridor: Corridor, longer_m: float = 0.0) -> Int64Array:
        """Return the indexes (k,) of its returns in a corridor that is extended by ``longer_m`` at either end."""
        pieces = [np.zeros(0, np.int64)]
        for chunk in np.flatnonzero(corridor.meets(self.boxes_t, longer_m)).tolist():
            points_t = np.asarray(self.swath.points_t[chunk * CHUNK : (chunk + 1) * CHUNK, :2])
            pieces.append(chunk * CHUNK + np.flatnonzero(corridor.holds(points_t, longer_m)))
        return np.concatenate(pieces)

    def taken(self, at: Int64Array) -> Swath:
        """Select these returns (k,) of the swath."""
        swath = self.swath
        rate, acceleration = swath.encoder_rate, swath.encoder_acceleration
        return replace(
            swath,
            rows=swath.rows[at],
            time_ns=swath.time_ns[at],
            points_t=swath.points_t[at],
            encoder_rate=None if rate is None else rate[at],
            encoder_acceleration=None if acceleration is None else acceleration[at],
        )


def part_of(
    flight: Flight, ground: Ground, corridor: Corridor, wider_m: tuple[float, float], calibration: Calibration
) -> Part:
    """Select the returns whose points lie in the corridor after it is extended and widened."""
    wide = replace(corridor, half_width_m=corridor.half_width_m + wider_m[1])
    return Part(flight, ground.taken(ground.rows_near(wide, wider_m[0])), corridor, calibration)


def measure_place(
    flight: Flight,
    grounds: Mapping[int, Ground],
    tracks: Sequence[Track | None],
    place: Place,
    calibrations: Mapping[str, Calibration],
    settings: Settings,
    margin_m: float,
) -> Measured | str:
    """Measure an angle from two swaths along a corridor; a string is the reason of failure.

    Args:
        flight: with points.
        grounds: of both swaths.
        tracks: of all swaths.
        place: the corridor and its swaths.
        calibrations: to measure with, by scanner.
        settings: limits of the profiles.
        margin_m: how far those calibrations move the flight's points at most.
    """
    indexes, kind = (place.first, place.second), place.kind
    one, other = tracks[place.first], tracks[place.second]
    if one is None or other is None:
        return NO_TRACK
    corridor, piece_m = _widened(place.corridor, settings, min(one.density, other.density))
    calibration = calibrations[flight.heads[flight.swaths[place.first].head].name]
    wider_m = (margin_m + settings.search_rad * max(one.above_m, other.above_m), margin_m)
    parts = [part_of(flight, grounds[index], corridor, wider_m, calibration) for index in indexes]
    before = [part.section(PARAMETER[kind], 0.0) for part in parts]
    if min(len(section[0]) for section in before) < settings.least_returns * settings.least_pieces:
        return TOO_FEW_RETURNS
    pair = _Pair(kind, corridor, piece_m, (one, other), settings)
    prior = {index: trajectory_sigmas(flight, index, settings.unsaid_sigma) for index in indexes}
    settled = _settle(pair, indexes, parts, prior, -_coarse(pair, before))
    if isinstance(settled, str):
        return settled
    found, fit, compared, after = settled
    drawn = [_drawn(section, settings.most_drawn) for section in chain(before, after)]
    height = float(np.median(after[0][2]))
    ends = np.column_stack([corridor.place(np.array([0.0, corridor.length_m])), [height, height]])
    return Measured(
        kind,
        *indexes,
        ends,
        (drawn[0], drawn[1]),
        (drawn[2], drawn[3]),
        _baseline(pair, compared.at_m[fit.used]),
        found,
        fit,
        int(fit.used.sum()),
        tuple(corridor.part(at, piece_m) for at in compared.at_m.tolist()),
        compared.slope_t,
    )


@dataclass(frozen=True, eq=False)
class _Pair:
    """The comparison of two tracks along a corridor, in pieces."""

    kind: str
    corridor: Corridor
    piece_m: float
    tracks: tuple[Track, Track]
    settings: Settings


def _settle(
    pair: _Pair,
    indexes: tuple[int, int],
    parts: Sequence[Part],
    prior: Mapping[int, FloatArray],
    found: float,
) -> tuple[float, Fit, _Compared, list[FloatTriple]] | str:
    """Iterate to the angle; return it, its last fit, the compared pieces, and both final sections.

    A string is the reason of failure.
    """
    settings = pair.settings
    for step in range(ITERATIONS):
        sections = [part.section(PARAMETER[pair.kind], found) for part in parts]
        compared = _compare(pair, sections, wide=step < 2)
        if len(compared.at_m) < settings.least_pieces:
            return TOO_FEW_PIECES if pair.kind == "roll" else TOO_FEW_SLOPES
        states = {indexes[0]: compared.levers[0], indexes[1]: -compared.levers[1]}
        lever = (compared.levers[0] - compared.levers[1])[:, TURNS[pair.kind]]
        fit = solve(compared.difference_m, compared.sigma_m, lever, states, prior)
        found -= fit.error
        if abs(fit.error) < DONE * fit.sigma:
            break
    if fit.used.sum() < settings.least_pieces:
        return TOO_FEW_PIECES if pair.kind == "roll" else TOO_FEW_SLOPES
    if fit.sigma > settings.greatest_sigma_rad:
        return TOO_UNSURE
    return found, fit, compared, sections


def _widened(corridor: Corridor, settings: Settings, density: float) -> tuple[Corridor, float]:
    """Widen the corridor and lengthen its pieces so that thin clouds too have enough returns in them."""
    wanted = RETURNS_A_PIECE / max(density, 1e-6)
    factor = max(1.0, math.sqrt(wanted / (2.0 * settings.half_width_m * settings.piece_m)))
    return replace(corridor, half_width_m=factor * settings.half_width_m), factor * settings.piece_m


def _forward_levers(kind: str, corridor: Corridor, track: Track) -> float:
    """Return the distance by which a unit of the angle's error moves a swath along the corridor."""
    sense = float(track.forward @ corridor.along)
    if kind == "pitch":
        return track.above_m * sense
    middle = corridor.place(np.array([0.5 * corridor.length_m]))
    return -float(track.aside(middle)[0]) * sense


def _coarse(pair: _Pair, sections: Sequence[FloatTriple]) -> float:
    """Return the error that aligns the sections within a bin; 0 if no shift stands out."""
    if pair.kind == "roll":
        return 0.0
    corridor, (one, other) = pair.corridor, pair.tracks
    base = _forward_levers(pair.kind, corridor, other) - _forward_levers(pair.kind, corridor, one)
    if abs(base) * pair.settings.search_rad < BIN_M:
        return 0.0
    bins = int(corridor.length_m / BIN_M)
    first, second = (heights_by_bin(distance, height, BIN_M, bins) for distance, _, height in sections)
    most = min(int(abs(base) * pair.settings.search_rad / BIN_M) + 1, bins // 2)
    shift, rival = best_shift(first, second, most, CAP_M)
    return shift * BIN_M / base if abs(base) > 1.0 and rival >= UNIQUE else 0.0


@dataclass(frozen=True, eq=False)
class _Compared:
    """The pieces (k,) that both swaths show.

    Attributes:
        difference_m, sigma_m: heights of the first less those of the second, and their sigmas.
        levers: (k, 6) of both swaths.
        at_m: distances along the corridor.
        slope_t: (k, 2) of the ground, east and north.
    """

    difference_m: FloatArray
    sigma_m: FloatArray
    levers: tuple[FloatArray, FloatArray]
    at_m: FloatArray
    slope_t: FloatArray


def _compare(pair: _Pair, sections: Sequence[FloatTriple], *, wide: bool) -> _Compared:
    """Compare two sections; for slopes the pieces overlap by half, because a roof is seldom longer than two pieces."""
    if pair.kind == "roll":
        return _compare_from(0.0, pair, sections, wide=wide)
    one, other = (_compare_from(begin, pair, sections, wide=wide) for begin in (0.0, 0.5 * pair.piece_m))
    levers_of = [np.concatenate(pieces) for pieces in zip(one.levers, other.levers, strict=True)]
    return _Compared(
        np.concatenate([one.difference_m, other.difference_m]),
        math.sqrt(2.0) * np.concatenate([one.sigma_m, other.sigma_m]),  # every return counts twice
        (levers_of[0], levers_of[1]),
        np.concatenate([one.at_m, other.at_m]),
        np.concatenate([one.slope_t, other.slope_t]),
    )


def _compare_from(begin_m: float, pair: _Pair, sections: Sequence[FloatTriple], *, wide: bool) -> _Compared:
    corridor, settings = pair.corridor, pair.settings
    pieces = int((corridor.length_m - begin_m) / pair.piece_m)
    first, second = (
        fit_pieces(distance_m - begin_m, aside_m, height_m, pair.piece_m, pieces, settings.least_returns)
        for distance_m, aside_m, height_m in sections
    )
    good = comparable(first, second, settings.rms_m, (2.5 if wide else 1.0) * settings.slope_apart)
    slopes = _slopes(corridor, first, second)
    with np.errstate(invalid="ignore"):
        if pair.kind == "roll":
            good &= np.hypot(slopes[:, 0], slopes[:, 1]) <= settings.flat_slope
        else:
            good &= np.abs(slopes @ corridor.along) >= LEAST_SLOPE
    at_m = begin_m + (np.flatnonzero(good).astype(np.float64) + 0.5) * pair.piece_m
    height = 0.5 * (first.height_m + second.height_m)[good]
    one, other = (levers(track, corridor.place(at_m), height, slopes[good]) for track in pair.tracks)
    sigma = np.hypot(first.sigma_m, second.sigma_m)[good]
    return _Compared((first.height_m - second.height_m)[good], sigma, (one, other), at_m, slopes[good])


def _slopes(corridor: Corridor, first: Pieces, second: Pieces) -> FloatArray:
    """Return slopes (k, 2) of the ground, east and north, averaged over both swaths.

    A wrong roll tilts the swaths of an opposite pair against each other, and the average removes that.
    """
    along, across = 0.5 * (first.slope + second.slope), 0.5 * (first.side_slope + second.side_slope)
    slopes: FloatArray = along[:, np.newaxis] * corridor.along + across[:, np.newaxis] * corridor.across
    return slopes


def _baseline(pair: _Pair, at_m: FloatArray) -> float:
    if pair.kind == "roll":
        return float(at_m.max() - at_m.min()) + pair.piece_m
    one, other = (_forward_levers(pair.kind, pair.corridor, track) for track in pair.tracks)
    return abs(other - one)


def _drawn(section: FloatTriple, most: int) -> Drawn:
    every = max(1, -(-len(section[0]) // most))
    return section[0][::every], section[2][::every]
