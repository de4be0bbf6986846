"""Profiles in the report: what they say beside the adjustment, each of them with its formula, and the surest drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from swath.calib.features import ControlPoint
from swath.calib.flight import Flight
from swath.calib.labels import decimals_of, number, unknown
from swath.calib.profiles.check import Check, Comparison
from swath.calib.profiles.measure import Ground
from swath.calib.profiles.sections import Corridor, fit_pieces
from swath.calib.profiles.stepwise import Profile, Section
from swath.calib.summary import Profile as Picture
from swath.daemon.processing.calibration.report.profile_picture import draw, svg
from swath.daemon.processing.calibration.report.tables import Table

MOST_DRAWN = 6
MOST_RETURNS = 8000
DOUBTFUL = 3.0
TITLE = "Profiles, an independent check"
UNDER = (
    "Roll, pitch, heading and range from profile pairs over the areas of the stepwise procedure, on the trajectory as "
    "it came, all other parameters as adjusted. Both share the flight and its trajectory's errors: the sigma of the "
    "difference is what the two do not share."
)


def comparison_table(checked: Check) -> Table | None:
    """Profiles say, adjustment says, difference in sigmas; and what has no profile."""
    if not checked.comparisons and not checked.missing:
        return None
    several = len({one.scanner for one in checked.comparisons} | {scanner for scanner, _ in checked.missing}) > 1
    rows = [_compared(one, several=several) for one in checked.comparisons]
    lost = "; ".join(f"{kind} has none: {why}" for (_, kind), why in checked.missing.items())
    heads = ("parameter", "unit", "profiles", "profiles say", "sigma", "adjustment says", "sigma", "difference / sigma")
    return Table(TITLE, heads, rows, f"{UNDER} {lost[:1].upper()}{lost[1:]}{'.' if lost else ''}".strip())


def _compared(one: Comparison, *, several: bool) -> list[str]:
    named = unknown(f"{one.scanner}.{one.parameter}")
    digits = decimals_of(one.adjusted_sigma * named.factor if one.adjusted_sigma > 0.0 else one.told_sigma)
    pattern = f".{digits}f"
    told, told_sigma, adjusted, sigma = (
        number(named.factor * value, pattern) for value in (one.told, one.told_sigma, one.adjusted, one.adjusted_sigma)
    )
    words = f"{one.scanner}: {named.words}" if several else named.words
    apart = number(one.normalised, "+.1f") + (" !" if abs(one.normalised) > DOUBTFUL else "")
    return [words, named.unit, str(one.profiles), told, told_sigma, adjusted, sigma, apart]


def profiles_table(checked: Check) -> Table | None:
    """Every profile: separation, baseline, formula."""
    rows = [
        [
            profile.kind,
            f"{profile.names[0]} and {profile.names[1]}",
            number(profile.separation_m, "+.3f"),
            number(profile.separation_sigma_m, ".3f"),
            "–" if profile.kind == "range" else number(profile.baseline_m, ".1f"),
            str(profile.pieces),
            profile.formula,
        ]
        for profile in checked.profiles
    ]
    heads = ("kind", "strips", "separation, m", "sigma", "baseline, m", "pieces", "formula")
    under = "Measured with the points as adjusted: the separations are what is left."
    return Table("", heads, rows, under, left=(0, 1, 6)) if rows else None


def pictures(checked: Check, at_start: Flight, control: Sequence[ControlPoint] = ()) -> list[Picture]:
    """Return the surest profiles of each kind as pictures: as the points lay at the start, and as they lie in the end.

    What a profile itself finds is not taken out of the second, so that it shows what the adjustment left.

    Args:
        checked: profiles, measured with the points as adjusted.
        at_start: the flight with the points as they lay before.
        control: the surveyed points, which profiles for the range compare the ground with.
    """
    found = []
    for profile in _surest(checked.profiles):
        before = _targets if profile.kind == "range" else _sections
        shown = replace(profile, before=before(profile, at_start, control), after=profile.before)
        title = f"Profile for {profile.kind}: {profile.names[0]} and {profile.names[1]}"
        found.append(Picture(title, "", svg(shown), partial(draw, shown)))
    return found


def _surest(profiles: Sequence[Profile]) -> list[Profile]:
    """One of every pair and kind, kinds in turn, no more than are worth looking at."""
    pairs: dict[tuple[str, int, int], Profile] = {}
    for profile in sorted(profiles, key=lambda one: one.noise_sigma):
        pairs.setdefault((profile.kind, profile.first, profile.second), profile)
    kinds: dict[str, list[Profile]] = {}
    for profile in pairs.values():
        kinds.setdefault(profile.kind, []).append(profile)
    deepest = max((len(several) for several in kinds.values()), default=0)
    in_turn = [several[depth] for depth in range(deepest) for several in kinds.values() if depth < len(several)]
    return in_turn[:MOST_DRAWN]


def _sections(profile: Profile, flight: Flight, control: Sequence[ControlPoint]) -> tuple[Section, Section]:
    """Both strips' returns along it, as this flight places them."""
    corridor = Corridor.between(profile.ends_t[0], profile.ends_t[1], profile.cells[0].half_width_m)
    first, second = (_section(corridor, Ground.of(flight.swaths[swath])) for swath in (profile.first, profile.second))
    return first, second


def _section(corridor: Corridor, ground: Ground) -> Section:
    rows = ground.rows_near(corridor)
    rows = rows[:: max(1, math.ceil(len(rows) / MOST_RETURNS))]
    points_t = ground.swath.points_t[rows]
    return Section(corridor.coordinates(points_t)[0], points_t[:, 2])


def _targets(profile: Profile, flight: Flight, control: Sequence[ControlPoint]) -> tuple[Section, Section]:
    """The ground that this flight shows at the profile's targets, less what was surveyed; those without any are left
    out."""
    surveyed = {point.name: point.position_t for point in control}
    ground = Ground.of(flight.swaths[profile.first])
    right = profile.ends_t[1, :2] - profile.ends_t[0, :2]
    ordered = sorted(
        zip(profile.targets, profile.cells, strict=True), key=lambda one: float(right @ surveyed[one[0]][:2])
    )
    height_m = np.full(len(ordered), np.nan)
    for row, (name, cell) in enumerate(ordered):
        points_t = np.asarray(ground.swath.points_t[ground.rows_near(cell)])
        if len(points_t):
            along_m, aside_m = cell.coordinates(points_t)
            piece = fit_pieces(along_m, aside_m, points_t[:, 2], 2.0 * cell.half_width_m, 1, 3)
            height_m[row] = piece.height_m[0] - surveyed[name][2]
    shown = np.isfinite(height_m)
    distance_m = profile.before[0].distance_m[shown]  # in the order from left to right
    return Section(distance_m, height_m[shown]), Section(distance_m, np.zeros(len(distance_m)))
