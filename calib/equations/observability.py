"""Decide from the reduced normal matrix which parameters a flight determines; hold the others, and explain why.

Before the calibration each parameter is known to its plausible sigma. A parameter is held if the flight adds almost
nothing to that. A parameter that the flight determines in part is estimated, with its start as an observation of that
sigma: if it were held, its error would remain in all parameters with similar effects, as that of a scan angle scale
would in the range offset. Whether the result is good enough is decided by the verdict. If several parameters have
similar effects, physics decides which is held, not numbers: the boresight is kept as long as possible, then the usual
errors of scanners (`RULES`, from its top). The known sets are those of FORMULAS 5.5, by their effects on the ground
(Skaloud and Lichti 2006; Filin 2003).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from swath.calib.labels import sized
from swath.calib.outcome import FixedParameter
from swath.georef.arrays import BoolArray, FloatArray
from swath.georef.scanner.calibration import INDEX, PARAMETERS

ALIKE = 0.8  # correlation above which two parameters absorb each other's errors
NOTHING = 300.0  # sigma in plausible sizes; larger ones count as infinite
_WEAK = 1e-3  # 1 / plausible sizes: a weak prior for all, so that the matrix for the explanations is not singular
NOTHING_TOLD = 0.95  # of the plausible sigma; a flight that leaves more than this adds nothing
WEAK = 0.3  # of the plausible sigma; below, the start is not needed as an observation


@dataclass(frozen=True, slots=True)
class Rule:
    """A parameter's plausible error, and what to do where the flight does not determine it.

    Attributes:
        plausible: its error before the calibration, one sigma, SI.
        looks: its effect on the ground, in words.
        remedy: flight lines or control that would determine it.
    """

    plausible: float
    looks: str
    remedy: str


_DEG = float(np.pi / 180.0)
_HEIGHT = "fly the same area at a second height, at least 1.7 times the first above ground"
_CONTROL = "measure ground control: at least 8 points at 1 cm on flat hard ground"
_SPEED = "fly a second height at least 1.7 times the first, or one line at another speed"
_EDGE = "fly lines where the edge of one overlaps the middle of the other over flat ground, and measure ground control"


def _plausible(name: str) -> float:
    return PARAMETERS[INDEX[name]].plausible


RULES: Mapping[str, Rule] = {  # in the order in which they are kept: the last is held first
    "omega_rad": Rule(
        _plausible("omega_rad"), "it tilts the swath", "fly a line and the same line in the opposite direction"
    ),
    "phi_rad": Rule(
        _plausible("phi_rad"),
        "it shifts the swath along the track, which flat ground does not show",
        "fly opposite lines over roofs or slopes that face along the track",
    ),
    "kappa_rad": Rule(
        _plausible("kappa_rad"),
        "it skews the swath, most at its edges, which flat ground does not show",
        "fly parallel lines that overlap by half a swath over roofs or slopes that face along the track",
    ),
    "range_offset_m": Rule(
        _plausible("range_offset_m"),
        "it lowers all points alike; on roofs the effect depends on how steeply the beam meets them",
        f"{_CONTROL}; or fly roofs from several lines with a side overlap of half a swath, and crossing lines",
    ),
    "range_scale": Rule(
        _plausible("range_scale"),
        "it lowers points in proportion to their distance",
        f"{_HEIGHT}; or {_CONTROL} at both heights",
    ),
    "scan_angle_scale": Rule(_plausible("scan_angle_scale"), "it bends the swath up at both edges", _EDGE),
    "time_offset_s": Rule(
        _plausible("time_offset_s"), "it shifts points along the track in proportion to the speed", _SPEED
    ),
    "scan_plane_tilt_rad": Rule(
        _plausible("scan_plane_tilt_rad"),
        "it shifts points backwards, by almost the same amount at the edges",
        "fly a much wider swath; nothing else shows it",
    ),
    "lever_arm_y_m": Rule(
        _plausible("lever_arm_y_m"), "it shifts points across the track, as roll does at one height", _HEIGHT
    ),
    "lever_arm_x_m": Rule(
        _plausible("lever_arm_x_m"), "it shifts points along the track, as pitch does at one height", _HEIGHT
    ),
    "lever_arm_z_m": Rule(
        _plausible("lever_arm_z_m"), "it lowers all points alike, as a height error of GNSS does", _CONTROL
    ),
    "imu_latency_s": Rule(
        _plausible("imu_latency_s"), "it acts only while the aircraft turns", "roll and pitch gently on some lines"
    ),
    "encoder_latency_s": Rule(
        _plausible("encoder_latency_s"),
        "it separates the scan lines of the two mirror directions",
        "scan flat ground in both mirror directions",
    ),
    "torsion_s2": Rule(
        _plausible("torsion_s2"),
        "at one scan rate it bends the swath in the same way as a scale of the scan angle",
        "fly a second scan rate",
    ),
    "range_offset_slot": Rule(
        0.02, "it acts only on returns of one return number", "collect more of such returns on planes"
    ),
    "range_offset_zone": Rule(
        0.02, "it acts only on one number of pulses in the air", "fly lines over the same roofs in both zones"
    ),
    "ibrc": Rule(0.02, "it acts only on returns of one intensity", "fly planes of that brightness in several strips"),
    "beam.range_m": Rule(0.02, "it acts on one beam only", "fly planes that this beam sees in several strips"),
    "beam.azimuth_rad": Rule(0.05 * _DEG, "it acts on one beam only", "roofs that this beam sees in many strips"),
    "beam.elevation_rad": Rule(0.05 * _DEG, "it acts on one beam only", "roofs that this beam sees in many strips"),
    "pitch_slope": Rule(
        _plausible("pitch_slope"),
        "it skews the swath in the same way as heading",
        "measure the mirror on a bench; no flight shows it",
    ),
    "scan_angle_offset_rad": Rule(
        _plausible("scan_angle_offset_rad"),
        "it turns the swath about the track in the same way as roll",
        "none is needed, because roll absorbs it",
    ),
}
_OTHER = Rule(1.0, "", "")

PAIRS: Mapping[frozenset[str], str] = {  # remedies that separate two parameters, where more is needed than for one
    frozenset(("omega_rad", "scan_angle_offset_rad")): "none is needed, because both describe the same rotation",
    frozenset(("phi_rad", "scan_plane_tilt_rad")): "fly a much wider swath: their difference grows as 1/cos θ",
    frozenset(("kappa_rad", "pitch_slope")): "measure the mirror on a bench; no flight shows it",
    frozenset(("phi_rad", "lever_arm_x_m")): _HEIGHT,
    frozenset(("omega_rad", "lever_arm_y_m")): _HEIGHT,
    frozenset(("phi_rad", "time_offset_s")): _SPEED,
    frozenset(("lever_arm_x_m", "time_offset_s")): "fly one line at another speed, or turn on a line",
    frozenset(("range_offset_m", "scan_angle_scale")): _EDGE,
    frozenset(("range_offset_m", "range_scale")): _HEIGHT,
    frozenset(("range_offset_m", "lever_arm_z_m")): f"{_CONTROL}, and roofs at the swath's edges",
    frozenset(("scan_angle_scale", "torsion_s2")): "fly a second scan rate",
}


@dataclass(frozen=True)
class Rules:
    """The rules of a decision.

    Attributes:
        table: rules by parameter, most wanted first.
    """

    table: Mapping[str, Rule] = field(default_factory=lambda: RULES)

    def of(self, name: str) -> Rule:
        """Return the rule of an unknown by its name, as ``left.ibrc.3``."""
        return self.table.get(kind_of(name), _OTHER)

    def rank(self, name: str) -> int:
        """Return the rank of an unknown; the one with the largest rank is given up first."""
        kinds = list(self.table)
        kind = kind_of(name)
        return kinds.index(kind) if kind in self.table else len(kinds)


RULES_OF_ALL = Rules()


def kind_of(name: str) -> str:
    """Return the kind of a name: ``left.omega_rad`` → ``omega_rad``; ``left.ibrc.3`` → ``ibrc``.

    Likewise ``left.beam.12.range_m`` → ``beam.range_m``.
    """
    _, *rest = name.split(".")
    if len(rest) == 3:
        return f"{rest[0]}.{rest[2]}"
    return rest[0] if rest else name


def decide(
    normal: FloatArray,
    names: Sequence[str],
    prior_sigmas: FloatArray | None = None,
    rules: Rules = RULES_OF_ALL,
) -> tuple[tuple[FixedParameter, ...], dict[str, float]]:
    """Return the unknowns to hold, and those to estimate with their start as an observation.

    The worst is held and everything is computed again, until all others are determined; finally those that are
    determined after all are released, unless they would replace one that is held.

    Args:
        normal: (u, u) reduced normal matrix of the parameters: trajectory, planes and ties eliminated, their own priors
            left out.
        names: (u,) as ``left.omega_rad``.
        prior_sigmas: (u,) of the user's priors, inf: no prior; a parameter with a prior is never held.
        rules: sizes and limits.

    Returns:
        The held unknowns, in the order of the names; and by name, one sigma of the start of weakly determined ones.
    """
    case = _Case(normal, names, prior_sigmas, rules)
    case.hold_the_worst()
    case.take_back()
    return tuple(case.told(at) for at in sorted(case.partner)), case.weak()


class _Case:
    """A decision in progress; sigmas are in plausible sizes.

    Attributes:
        partner: for every unknown held so far: the one for which it was given up; −1: none.
    """

    def __init__(self, normal: FloatArray, names: Sequence[str], prior_sigmas: FloatArray | None, rules: Rules) -> None:
        self._names, self._rules = list(names), rules
        size = np.array([rules.of(name).plausible for name in names])
        self._size = size
        self._rank = np.array([rules.rank(name) for name in names])
        # two heads of one aircraft share its trajectory's errors: that correlates them, but leaves both determined
        heads = np.array([name.partition(".")[0] for name in names])
        self._of_one_head = heads[:, np.newaxis] == heads
        sigmas = np.full(len(names), np.inf) if prior_sigmas is None else np.asarray(prior_sigmas, dtype=np.float64)
        self._given = np.isfinite(sigmas)
        own = np.where(self._given, size / np.where(self._given, sigmas, 1.0), 1.0)
        observed = _positive(normal, size)
        self._information = observed + np.diag(own**2)
        self._observed = observed + np.diag(np.where(self._given, own, _WEAK) ** 2)
        self.partner: dict[int, int] = {}

    def hold_the_worst(self) -> None:
        """Hold unknowns, the worst first, until all others are determined."""
        while True:
            active = self._active()
            sigma, rho = self._figures(active)
            at = self._next(active, sigma, rho)
            if at is None:
                return
            self.partner[at[0]] = at[1]

    def take_back(self) -> None:
        """Release the held unknowns that are determined beside all others after all, the most wanted first."""
        for at in sorted(self.partner, key=lambda index: int(self._rank[index])):
            if self.partner[at] in self.partner:
                continue
            active = sorted([*self._active(), at])
            if self._determined(active, self._figures(active)[0]).all():
                del self.partner[at]

    def told(self, at: int) -> FixedParameter:
        """Describe a held unknown in words, with those for which it was given up counted as free.

        If they were held as well, it would look determined.
        """
        free, other = set(self._active()), at
        while other in self.partner and other not in free:
            free.add(other)
            other = self.partner[other]
        active = sorted(free)
        sigma, rho = self._figures(active, self._observed)
        here = active.index(at)
        own = np.abs(rho[here]) * self._of_one_head[at, active]
        alike = tuple(
            (self._names[active[other]], float(rho[here, other])) for other in np.argsort(-own) if own[other] >= ALIKE
        )
        scanner, _, name = self._names[at].partition(".")
        found = float(sigma[here] * self._size[at]) if sigma[here] < NOTHING else np.inf
        others = [other for other, _ in alike]
        return FixedParameter(scanner, name, self._why(at, found, alike), self._remedy(at, others), found, alike)

    def _active(self) -> list[int]:
        return [at for at in range(len(self._names)) if at not in self.partner]

    def weak(self) -> dict[str, float]:
        """Return by name, for estimated unknowns that need their start as an observation, its sigma, SI."""
        active = self._active()
        sigma, _ = self._figures(active)
        return {
            self._names[at]: float(self._size[at])
            for at, size in zip(active, sigma.tolist(), strict=True)
            if size > WEAK and not self._given[at]
        }

    def _figures(self, active: list[int], information: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Return sigmas in plausible sizes, and correlations with a zero diagonal."""
        part = (self._information if information is None else information)[np.ix_(active, active)]
        root = np.sqrt(np.diag(part))
        covariance = np.linalg.inv(part / np.outer(root, root)) / np.outer(root, root) if active else part
        sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        rho = covariance / np.outer(sigma, sigma)
        np.fill_diagonal(rho, 0.0)
        return sigma, rho

    def _determined(self, active: list[int], sigma: FloatArray) -> BoolArray:
        found: BoolArray = self._given[active] | (sigma <= NOTHING_TOLD)
        return found

    def _next(self, active: list[int], sigma: FloatArray, rho: FloatArray) -> tuple[int, int] | None:
        """Return the unknown to hold, and the one for which it is held; None: all are determined.

        Among the worst and those with similar effects, the least wanted is held; of equal ranks the worse one.
        """
        open_ = ~self._determined(active, sigma)
        if not open_.any():
            return None
        excess = np.where(open_, sigma, 0.0)
        worst = int(np.argmax(excess))
        own = np.abs(rho[worst]) * self._of_one_head[active[worst], active]
        alike = np.flatnonzero((own >= ALIKE) & ~self._given[active])
        candidates = [worst, *alike.tolist()]
        held = max(candidates, key=lambda at: (self._rank[active[at]], excess[at]))
        kept = worst if held != worst else (int(np.argmax(own)) if len(alike) else -1)
        return active[held], active[kept] if kept >= 0 else -1

    def _why(self, at: int, sigma: float, alike: Sequence[tuple[str, float]]) -> str:
        rule = self._rules.of(self._names[at])
        if alike:
            others = " and ".join(f"{other} (correlation {rho:+.3f})" for other, rho in alike[:3])
            text = f"this flight cannot separate it from {others}"
        elif np.isinf(sigma):
            text = "nothing in this flight shows it"
        else:
            found, before = (sized(self._names[at], size) for size in (sigma, rule.plausible))
            text = f"this flight would estimate it to {found}, and its initial value is plausible to {before}"
        return f"{text}: {rule.looks}" if rule.looks else text

    def _remedy(self, at: int, others: Sequence[str]) -> str:
        kind = kind_of(self._names[at])
        for other in others:
            found = PAIRS.get(frozenset((kind, kind_of(other))))
            if found is not None:
                return found
        return self._rules.of(self._names[at]).remedy


def _positive(normal: FloatArray, size: FloatArray) -> FloatArray:
    """Return the normal matrix in plausible sizes, without eigenvalues that rounding made negative.

    Such eigenvalues would count as information.
    """
    scaled = np.asarray(normal, dtype=np.float64) * np.outer(size, size)
    root = np.sqrt(np.maximum(np.diag(scaled), 0.0))
    divisor = np.outer(root, root) + (np.outer(root, root) == 0.0)
    values, vectors = np.linalg.eigh(0.5 * (scaled + scaled.T) / divisor)
    clean: FloatArray = (vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(root, root)
    return clean


def spectrum(normal: FloatArray) -> FloatArray:
    """Return the eigenvalues (u,) of the normal matrix scaled to unit diagonal, rising.

    An eigenvalue near 0 belongs to a combination that no observation shows.
    """
    root = np.sqrt(np.maximum(np.diag(normal), 0.0))
    divisor = np.where(root > 0.0, root, 1.0)
    values: FloatArray = np.linalg.eigvalsh(normal / np.outer(divisor, divisor))
    return values
