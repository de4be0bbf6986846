"""Check an adjustment independently by profiles, and test whether both agree.

Profiles are measured with the points where the adjustment put them. The finding of each profile is, to first order,

    y = S x + L t + v

with x the corrections that all parameters still need, t the errors of the trajectory at knots, v the noise of its
pieces. S and L come from the pieces themselves: how far each moves with every parameter (by placing it anew) and with
the trajectory at the moment it was seen. So profiles of one line share its errors, those of a long one average errors
that change along it, and for an opposite pair side by side S shows that pitch moves it as heading does.

The angles and the range of all profiles together are x̂ = W y, by least squares with V = L C Lᵀ + D, C the prior
covariance of the trajectory's errors. Their difference d from the adjustment is W S times the errors of the adjustment,
less W (L t + v). An efficient estimate is uncorrelated with its difference from any other unbiased one (Hausman 1978,
Econometrica 46, lemma 2.1), so cov d = W V Wᵀ − (W S) Σ (W S)ᵀ, with Σ that of the adjustment's own errors; it is never
less than the profiles' noise alone, which the adjustment does not share. The errors of held parameters, and their
effects on the estimated ones, are in d as they are in the profiles: they add (W S) H (W S)ᵀ, with H their covariance.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from swath.calib.equations.trajectory_prior import TrajectoryPrior
from swath.calib.features import ControlPoint
from swath.calib.flight import Flight
from swath.calib.outcome import Adjusted
from swath.calib.profiles.influence import Influence, influence
from swath.calib.profiles.measure import KINDS, PARAMETER, Settings
from swath.calib.profiles.stepwise import MISSING, Profile, survey
from swath.georef.arrays import FloatArray
from swath.georef.progress import Tell, silent
from swath.georef.scanner.calibration import INDEX, PARAMETERS

CHECK = Settings(search_rad=1e-4, most_a_pair=2)  # the strips already coincide


@dataclass(frozen=True, slots=True)
class Comparison:
    """The comparison for one parameter of a scanner, SI.

    Attributes:
        scanner, parameter: as ``left``, ``omega_rad``.
        profiles: number of profiles of its kind.
        told, told_sigma: value from the profiles; all other parameters as adjusted.
        adjusted, adjusted_sigma: value from the adjustment.
        difference_sigma: of told − adjusted.
    """

    scanner: str
    parameter: str
    profiles: int
    told: float
    told_sigma: float
    adjusted: float
    adjusted_sigma: float
    difference_sigma: float

    @property
    def normalised(self) -> float:
        """The difference in its sigmas."""
        return (self.told - self.adjusted) / self.difference_sigma


@dataclass(frozen=True, eq=False)
class Check:
    """The result of checking an adjustment by profiles.

    Attributes:
        profiles: as measured with the points as adjusted.
        comparisons: of the parameters they determine.
        missing: by scanner and kind, why there is no comparison, in words.
        refused: counts of refused profiles, by reason.
    """

    profiles: tuple[Profile, ...]
    comparisons: tuple[Comparison, ...]
    missing: Mapping[tuple[str, str], str] = field(default_factory=dict)
    refused: Counter[str] = field(default_factory=Counter)


def check(
    flight: Flight,
    adjusted: Adjusted,
    prior: TrajectoryPrior,
    control: Sequence[ControlPoint] = (),
    settings: Settings = CHECK,
    tell: Tell = silent,
) -> Check:
    """Measure profiles where the procedure prescribes them, and compare them with the adjustment.

    Args:
        flight: with points as placed by ``adjusted.calibrations``, on the trajectories that were adjusted.
        adjusted: the outcome.
        prior: of the trajectories' errors, as used in the adjustment.
        control: for the range.
        settings: limits of the profiles.
        tell: called with the progress.
    """
    refused: Counter[str] = Counter()
    profiles: list[Profile] = []
    for number, kind in enumerate(KINDS):
        tell("profiles", number, len(KINDS) + 1, "kinds")
        seen = survey(flight, kind, control, settings, adjusted.calibrations)
        refused.update({f"{kind}: {why}": count for why, count in seen.refused.items() if count})
        profiles += seen.profiles
    tell("profiles", len(KINDS), len(KINDS) + 1, "kinds")
    comparisons = compare(flight, profiles, adjusted, prior, control, settings)
    compared = {(one.scanner, one.parameter) for one in comparisons}
    missing = {
        (head.name, kind): MISSING[kind]
        for head in flight.heads
        for kind in KINDS
        if (head.name, PARAMETER[kind]) not in compared
    }
    return Check(tuple(profiles), comparisons, missing, refused)


def compare(
    flight: Flight,
    profiles: Sequence[Profile],
    adjusted: Adjusted,
    prior: TrajectoryPrior,
    control: Sequence[ControlPoint] = (),
    settings: Settings = CHECK,
) -> tuple[Comparison, ...]:
    """Compare the joint result of all profiles with the adjustment; see `check` for the arguments."""
    if not profiles:
        return ()
    together = _Together.of(flight, profiles, adjusted, prior, control)
    names = sorted({f"{profile.scanner}.{PARAMETER[profile.kind]}" for profile in profiles})
    solved = together.solved(names)
    while names and (worst := int(np.argmax(solved.told_sigma))) >= 0:
        if np.isfinite(solved.told_sigma).all() and solved.told_sigma[worst] <= _most(names[worst], settings):
            break
        names.pop(worst)
        solved = together.solved(names)
    counts = Counter(f"{profile.scanner}.{PARAMETER[profile.kind]}" for profile in profiles)
    at = {name: i for i, name in enumerate(adjusted.names)}
    found = []
    for i, name in enumerate(names):
        scanner, _, parameter = name.partition(".")
        value = float(adjusted.calibrations[scanner].value(parameter))
        sigma = float(adjusted.sigmas[at[name]]) if name in at else 0.0
        told, told_sigma, apart = (float(row[i]) for row in (solved.found, solved.told_sigma, solved.difference_sigma))
        found.append(Comparison(scanner, parameter, counts[name], value + told, told_sigma, value, sigma, apart))
    return tuple(found)


def _most(name: str, settings: Settings) -> float:
    """Return the greatest useful sigma of a parameter, rad or m."""
    return 0.5 if name.endswith(PARAMETER["range"]) else settings.greatest_sigma_rad


@dataclass(frozen=True, eq=False)
class _Solved:
    """Results (k,) for k parameters."""

    found: FloatArray
    told_sigma: FloatArray
    difference_sigma: FloatArray


@dataclass(frozen=True, eq=False)
class _Together:
    """Profiles (p,) as joint observations.

    Attributes:
        found: (p,) y.
        names: all parameters of all scanners; `by_parameter` (p, names) S.
        variance: (p, p) V; noise: (p,) sigmas of the pieces' own part of it.
        adjusted: (names, names) Σ; zero for held parameters.
        held: (names, c) change by one sigma of each held parameter, itself included.
    """

    found: FloatArray
    names: tuple[str, ...]
    by_parameter: FloatArray
    variance: FloatArray
    noise: FloatArray
    adjusted: FloatArray
    held: FloatArray

    @classmethod
    def of(
        cls,
        flight: Flight,
        profiles: Sequence[Profile],
        adjusted: Adjusted,
        prior: TrajectoryPrior,
        control: Sequence[ControlPoint],
    ) -> _Together:
        parts = [influence(flight, profile, adjusted.calibrations, prior, adjusted.names) for profile in profiles]
        names = tuple(f"{head.name}.{parameter.name}" for head in flight.heads for parameter in PARAMETERS)
        by_parameter = np.stack(
            [_by_parameter(part, profile, names) for part, profile in zip(parts, profiles, strict=True)]
        )
        by_knot = np.stack([part.by_knot for part in parts])
        shared = np.array(
            [
                [part.by_target.get(point.name, 0.0) * float(np.broadcast_to(point.sigma_m, 3)[2]) for point in control]
                for part in parts
            ]
        ).reshape(len(parts), -1)
        own = np.array([profile.noise_sigma**2 for profile in profiles]) - (shared**2).sum(axis=1)
        noise = np.sqrt(np.maximum(own, 0.0))
        factor = adjusted.variance_factor if adjusted.scaled else 1.0
        variance = factor * (by_knot @ prior.covariance @ by_knot.T + shared @ shared.T + np.diag(noise**2))
        found = np.array([profile.found for profile in profiles])
        return cls(found, names, by_parameter, variance, noise, *_covariances(adjusted, names))

    def solved(self, names: Sequence[str]) -> _Solved:
        """Solve for these parameters, with all others as adjusted."""
        columns = [self.names.index(name) for name in names]
        mine = self.by_parameter[:, columns]
        weight = np.linalg.inv(self.variance)
        normal = mine.T @ weight @ mine
        try:
            gain = np.linalg.solve(normal, mine.T @ weight)
        except np.linalg.LinAlgError:
            gain = np.full((len(names), len(self.found)), np.nan)
        own = gain @ self.variance @ gain.T
        through = gain @ self.by_parameter
        efficient = np.diag(through @ self.adjusted @ through.T)
        others = through.copy()
        others[:, columns] = 0.0
        told = np.diag(own + others @ (self.adjusted + self.held @ self.held.T) @ others.T)
        least = ((gain * self.noise) ** 2).sum(axis=1)
        apart = np.maximum(np.diag(own) - efficient, least) + ((through @ self.held) ** 2).sum(axis=1)
        return _Solved(gain @ self.found, np.sqrt(told), np.sqrt(apart))


def _by_parameter(part: Influence, profile: Profile, names: Sequence[str]) -> FloatArray:
    row = np.zeros(len(names))
    for parameter, change in part.by_parameter.items():
        row[names.index(f"{profile.scanner}.{parameter}")] = change
    return row


def _covariances(adjusted: Adjusted, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (names, names) of estimated parameters' own errors, and effects (names, c) of held ones.

    The effects are those of one sigma of each held parameter.
    """
    covariance, held = np.zeros((len(names), len(names))), np.zeros((len(names), len(adjusted.considered)))
    at = [i for i, name in enumerate(adjusted.names) if name.partition(".")[2] in INDEX and name in names]
    to = [names.index(adjusted.names[i]) for i in at]
    moved = adjusted.movements[at]
    covariance[np.ix_(to, to)] = adjusted.covariance[np.ix_(at, at)] - moved @ moved.T
    held[to] = moved
    for column, one in enumerate(adjusted.considered):
        held[names.index(f"{one.scanner}.{one.name}"), column] = one.sigma
    return covariance, held
