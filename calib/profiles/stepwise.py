"""Measure roll, pitch, heading and range by profiles, one after the other (Leica's stepwise procedure; FORMULAS 5.4).

Two swaths are cut along one line. Where an angle is wrong their sections are separated; the separation and its baseline
give the angle: roll at the edges of an opposite pair over flat ground; pitch along an opposite pair at nadir over
slopes; heading along two lines side by side, at nadir of one of them, over slopes; the range by heights of flat
targets. The result is a first approximation for the adjustment, and a check of it that shares only the points with it.

The sections are compared by planes of their pieces (`swath.calib.profiles.fit`), and the points are placed anew with
the angle found until no separation is left, so that the lecture's formulas also hold for large angles.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from swath.calib.features import ControlPoint
from swath.calib.flight import Flight
from swath.calib.profiles.measure import KINDS, PARAMETER, Ground, Measured, Settings, measure_place, shifts_m
from swath.calib.profiles.places import Place, Track, places, tracks_of
from swath.calib.profiles.sections import Corridor
from swath.calib.profiles.targets import measure_range
from swath.georef.arrays import FloatArray
from swath.georef.scanner.calibration import Calibration

_DEFAULT = Settings()


@dataclass(frozen=True, eq=False)
class Section:
    """Returns of one swath along a profile (n,): distance from its begin, height in t; metres."""

    distance_m: FloatArray
    height_m: FloatArray


@dataclass(frozen=True, eq=False)
class Profile:
    """One profile pair and its result.

    Attributes:
        kind: ``roll``, ``pitch``, ``heading`` or ``range``.
        scanner: scanner with the angle.
        first, second: indexes in `Flight.swaths`; second −1: control.
        names: of the two.
        ends_t: (2, 3) begin and end.
        before, after: the two sections, with the flight's points as they are and with the correction; for a range:
            laser less survey (first) and zero (second), over the distance to the right of the track.
        separation_m: their separation before, with the sign of ``found``; roll: at the swath's edge; pitch, heading:
            along track; range: in height.
        separation_sigma_m: one sigma.
        baseline_m: roll: the swath's width; pitch: the sum of both heights above ground; heading: the sum or difference
            of the distances from nadir; range: 1.
        found: to be added to the scanner's parameter, rad or m.
        sigma: one sigma of it, with the trajectory's errors as constants of each swath.
        noise_sigma: one sigma without these.
        by_trajectory: by swath (6,), change of ``found`` by one sigma of its position (north, east, down), roll, pitch
            and heading.
        pieces: number of pieces of ground, or targets, that counted.
        formula: the lecture's, with the numbers.
        cells: (k) ground of every piece or target that was compared.
        slope_t: (k, 2) of it, east and north.
        gain: (k,) change of ``found`` per unit of each piece's difference, first − second.
        targets: (k) their names, for a range.
    """

    kind: str
    scanner: str
    first: int
    second: int
    names: tuple[str, str]
    ends_t: FloatArray
    before: tuple[Section, Section]
    after: tuple[Section, Section]
    separation_m: float
    separation_sigma_m: float
    baseline_m: float
    found: float
    sigma: float
    noise_sigma: float
    by_trajectory: Mapping[int, FloatArray]
    pieces: int
    formula: str
    cells: tuple[Corridor, ...]
    slope_t: FloatArray
    gain: FloatArray
    targets: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Given:
    """A profile at a place that the user gives: kind, two swaths by index, two ends (≥ 2,) in t."""

    kind: str
    first: int
    second: int
    start_t: FloatArray
    end_t: FloatArray


@dataclass(frozen=True, eq=False)
class Survey:
    """Profiles of a flight, and counts of refused ones by reason."""

    profiles: tuple[Profile, ...]
    refused: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True, eq=False)
class Step:
    """One step of the procedure: a kind, its profiles, and by scanner their joint result with its sigma (rad or m)."""

    kind: str
    profiles: tuple[Profile, ...]
    found: Mapping[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Stepwise:
    """The result of the procedure.

    Attributes:
        calibrations: by scanner.
        steps: roll, pitch, heading, range, and once more.
        sigmas: by ``scanner.parameter`` as ``left.omega_rad``, of the determined parameters.
        missing: by scanner and kind, the kinds for which this flight has no profile, in words.
        refused: counts of refused profiles, by reason.
    """

    calibrations: Mapping[str, Calibration]
    steps: tuple[Step, ...]
    sigmas: Mapping[str, float]
    missing: Mapping[tuple[str, str], str]
    refused: Counter[str]


MISSING = {
    "roll": "the flight has no two lines in opposite directions along one track over flat ground",
    "pitch": "the flight has no two lines in opposite directions along one track over ground that slopes along it "
    "below the aircraft",
    "heading": "the flight has no two overlapping parallel lines over ground that slopes along them where the nadir of "
    "one lies on the edge of the other",
    "range": "no swath contains control on flat targets",
}


def roll_rad(separation_m: float, width_m: float) -> float:
    """Compute roll from the separation at the edges of an opposite pair and the full width of the swath."""
    return math.atan(separation_m / width_m)


def pitch_rad(separation_m: float, height_m: float) -> float:
    """Compute pitch from the separation along track of an opposite pair and the height above ground."""
    return math.atan(separation_m / 2.0 / height_m)


def heading_rad(separation_m: float, from_nadir_m: float) -> float:
    """Compute heading from the separation along track and the distance from nadir.

    For two lines that distance is the sum or difference of their distances.
    """
    return separation_m / from_nadir_m


def range_m(height_m: FloatArray, cosine: FloatArray) -> float:
    """Compute the range offset from heights above control (laser less survey) (k,) and cosines of the beams.

    The cosines (k,) are those of the angles with the vertical.
    """
    return float(np.mean(height_m * cosine) / np.mean(cosine**2))


def measure(
    flight: Flight,
    control: Sequence[ControlPoint] = (),
    settings: Settings = _DEFAULT,
    calibrations: Mapping[str, Calibration] | None = None,
    given: Sequence[Given] = (),
) -> tuple[Profile, ...]:
    """Measure all profiles that the flight allows, kind by kind, each with the points as they are.

    Args:
        flight: with points.
        control: flat targets.
        settings: limits of the profiles.
        calibrations: by scanner, those the points were placed with; None: those to start from.
        given: the user's profiles, instead of automatically placed ones of their kinds.
    """
    found = [survey(flight, kind, control, settings, calibrations, given) for kind in KINDS]
    return tuple(profile for one in found for profile in one.profiles)


def survey(
    flight: Flight,
    kind: str,
    control: Sequence[ControlPoint] = (),
    settings: Settings = _DEFAULT,
    calibrations: Mapping[str, Calibration] | None = None,
    given: Sequence[Given] = (),
    *,
    with_points_of: Mapping[str, Calibration] | None = None,
    pitch_unknown: Collection[str] = (),
) -> Survey:
    """Measure profiles of one kind, and keep the best ones of each pair; see `measure` for the other arguments.

    Args:
        with_points_of: by scanner, the calibrations of the flight's points, where they are not those to measure with.
        pitch_unknown: scanners that get no heading from opposite lines (`swath.calib.profiles.places.places`).
    """
    now = flight.starts() if calibrations is None else dict(calibrations)
    tracks = tracks_of(flight, now)
    margin = shifts_m(flight, now if with_points_of is None else with_points_of, now)
    refused: Counter[str] = Counter()
    taken: list[Profile] = []
    if kind == "range":
        for swath, track in enumerate(tracks):
            if track is not None and control:
                ground = Ground.of(flight.swaths[swath])
                measured = measure_range(flight, ground, track, swath, control, now, settings, margin)
                _sort(flight, now, tracks, [measured], 1, taken, refused)
        return Survey(tuple(taken), refused)
    grounds: dict[int, Ground] = {}
    for group in _groups(flight, tracks, kind, settings, given, pitch_unknown):
        for swath in (group[0].first, group[0].second):
            grounds.setdefault(swath, Ground.of(flight.swaths[swath]))
        outcomes = [measure_place(flight, grounds, tracks, place, now, settings, margin) for place in group]
        most = len(group) if any(one.kind == kind for one in given) else settings.most_a_pair
        _sort(flight, now, tracks, outcomes, most, taken, refused)
    return Survey(tuple(taken), refused)


def _groups(
    flight: Flight,
    tracks: Sequence[Track | None],
    kind: str,
    settings: Settings,
    given: Sequence[Given],
    pitch_unknown: Collection[str],
) -> Iterator[list[Place]]:
    asked = [one for one in given if one.kind == kind]
    for one in asked:
        corridor = Corridor.between(one.start_t, one.end_t, settings.half_width_m)
        yield [Place(kind, one.first, one.second, corridor)]
    if not asked:
        yield from places(flight, tracks, kind, settings.half_width_m, pitch_unknown)


def _sort(
    flight: Flight,
    calibrations: Mapping[str, Calibration],
    tracks: Sequence[Track | None],
    outcomes: Sequence[Measured | str],
    most: int,
    taken: list[Profile],
    refused: Counter[str],
) -> None:
    """Append the most certain profiles to ``taken``, and count the others."""
    good = sorted((one for one in outcomes if isinstance(one, Measured)), key=lambda one: one.fit.noise_sigma)
    refused.update(one for one in outcomes if isinstance(one, str))
    refused["other profiles of this pair are more certain"] += max(0, len(good) - most)
    taken.extend(_profile(flight, calibrations, tracks, one) for one in good[:most])


def _profile(
    flight: Flight, calibrations: Mapping[str, Calibration], tracks: Sequence[Track | None], measured: Measured
) -> Profile:
    swath = flight.swaths[measured.first]
    scanner = flight.heads[swath.head].name
    other = "control" if measured.second < 0 else flight.swaths[measured.second].name
    kind, baseline_m, found = measured.kind, measured.baseline_m, measured.found
    lever_m = 1.0 if kind == "range" else baseline_m
    separation_m = baseline_m * (found if kind in ("range", "heading") else math.tan(found))
    sections = [tuple(Section(*one) for one in pair) for pair in (measured.before, measured.after)]
    return Profile(
        kind=kind,
        scanner=scanner,
        first=measured.first,
        second=measured.second,
        names=(swath.name, other),
        ends_t=measured.ends_t,
        before=(sections[0][0], sections[0][1]),
        after=(sections[1][0], sections[1][1]),
        separation_m=separation_m,
        separation_sigma_m=lever_m * measured.fit.sigma,
        baseline_m=baseline_m,
        found=found,
        sigma=measured.fit.sigma,
        noise_sigma=measured.fit.noise_sigma,
        by_trajectory=measured.fit.by_trajectory,
        pieces=measured.pieces,
        formula=formula(kind, separation_m, baseline_m, calibrations[scanner].installation_matrix),
        cells=measured.cells,
        slope_t=measured.slope_t,
        gain=-measured.fit.gain,
        targets=measured.targets,
    )


def formula(kind: str, separation_m: float, baseline_m: float, installation: FloatArray | None = None) -> str:
    """Return the lecture's formula with numbers, the sense of the correction, and its value.

    The value is given about our axes, and about the scanner's where these differ in sign.
    """
    size = abs(separation_m)
    if kind == "range":
        return f"range offset = mean(dh · cos θ) / mean(cos² θ) = {separation_m / baseline_m:+.4f} m"
    text, angle_rad, senses, axis = {
        "roll": (
            f"atan(separation at the edge / swath width) = atan({size:.3f} m / {baseline_m:.1f} m)",
            roll_rad(size, baseline_m),
            ("clockwise", "counter-clockwise"),
            0,
        ),
        "pitch": (
            f"atan(separation / 2 / height) = atan({size:.3f} m / 2 / {baseline_m / 2.0:.1f} m)",
            pitch_rad(size, baseline_m / 2.0),
            ("forward", "rearward"),
            1,
        ),
        "heading": (
            f"separation / distance from nadir = {size:.3f} m / {baseline_m:.1f} m",
            heading_rad(size, baseline_m),
            ("left forward, right rearward", "left rearward, right forward"),
            2,
        ),
    }[kind]
    found = math.copysign(angle_rad, separation_m)
    words = f"{text} = {angle_rad:.7f} rad; correction {senses[found < 0.0]}: {math.degrees(found):+.5f}°"
    if installation is not None and abs(installation[axis, axis]) < 1.0 - 1e-9:
        return f"{words} about the body's axis"
    if installation is not None and installation[axis, axis] < 0.0:
        return f"{words} ({-math.degrees(found):+.5f}° in the scanner's own axes)"
    return words


def combined(profiles: Sequence[Profile]) -> tuple[float, float]:
    """Combine profiles of a kind to one value with its sigma; those of one swath share its trajectory's errors."""
    weight = np.array([profile.sigma**-2.0 for profile in profiles])
    weight /= weight.sum()
    variance = float(np.sum((weight * [profile.noise_sigma for profile in profiles]) ** 2))
    shared: dict[int, FloatArray] = {}
    for share, profile in zip(weight, profiles, strict=True):
        for swath, effect in profile.by_trajectory.items():
            shared[swath] = shared.get(swath, np.zeros(len(effect))) + share * effect
    variance += sum(float(effect @ effect) for effect in shared.values())
    return float(weight @ [profile.found for profile in profiles]), math.sqrt(variance)


def stepwise(
    flight: Flight,
    control: Sequence[ControlPoint] = (),
    settings: Settings = _DEFAULT,
    calibrations: Mapping[str, Calibration] | None = None,
    given: Sequence[Given] = (),
) -> Stepwise:
    """Run the procedure: roll, pitch, heading, range, each with the previous ones applied.

    It runs `Settings.rounds` times, because each step presumes that the other errors are small. An angle without
    profiles keeps its value, and the others absorb its error: the sigmas hold only if all angles were found.

    See `measure` for the arguments.
    """
    start = flight.starts() if calibrations is None else dict(calibrations)
    now = dict(start)
    steps: list[Step] = []
    sigmas: dict[str, float] = {}
    refused: Counter[str] = Counter()
    for _ in range(settings.rounds):
        refused.clear()
        for kind in KINDS:
            unknown = [head.name for head in flight.heads if f"{head.name}.{PARAMETER['pitch']}" not in sigmas]
            seen = survey(flight, kind, control, settings, now, given, with_points_of=start, pitch_unknown=unknown)
            refused.update({f"{kind}: {why}": count for why, count in seen.refused.items() if count})
            scanners = sorted({profile.scanner for profile in seen.profiles})
            found = {name: combined([one for one in seen.profiles if one.scanner == name]) for name in scanners}
            for name, (value, sigma) in found.items():
                parameter = PARAMETER[kind]
                now[name] = now[name].changed(**{parameter: now[name].value(parameter) + value})
                sigmas[f"{name}.{parameter}"] = sigma
            steps.append(Step(kind, seen.profiles, found))
    missing = {
        (head.name, kind): MISSING[kind]
        for head in flight.heads
        for kind in KINDS
        if f"{head.name}.{PARAMETER[kind]}" not in sigmas
    }
    return Stepwise(now, tuple(steps), sigmas, missing, refused)
