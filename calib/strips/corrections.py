"""Adjust strips after the calibration: correct each strip's trajectory, but no parameter of the scanner.

The calibration is held; each strip gets the simplest correction that its returns justify, as a correction of the
trajectory (ISO/TS 19159-2, 6.3.3, Eq. 12; FORMULAS 7.3):

    none        0
    constant    a
    linear      a + b τ,  τ = −1 … 1 along the strip
    spline      a + b τ + bends between knots, with second differences held to 0

of position (north, east, down) and of small turns about these axes. All have priors, because no observation shows a
common shift of all strips without control. An information criterion (Schwarz 1978; AIC of Akaike 1974 as corrected by
Hurvich and Tsai 1989) chooses the model of each strip. Its number of parameters is the number that the returns
determine: the trace of N (N + P)⁻¹ over those combinations of them that the returns know much better than the prior
does; along all others there is no correction. The equations are those of the adjustment
(`swath.calib.equations.normals`) with only the states of the trajectory as unknowns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from swath.calib.equations.normals import Normals, TrajectoryWeight, normals
from swath.calib.equations.rows import Rows, State
from swath.calib.equations.tie_rows import Ties
from swath.calib.equations.trajectory_prior import ERRORS, TrajectoryPrior, apply, knots_of
from swath.calib.features import Features
from swath.calib.flight import Flight
from swath.calib.outcome import TrajectoryFit
from swath.calib.parameters import ParameterOptions, unknowns
from swath.georef.arrays import FloatArray, Int64Array, SingleArray
from swath.georef.scanner.calibration import Calibration
from swath.georef.trajectory.trajectory import Trajectory

MODELS = ("none", "constant", "linear", "spline")
MOST_CHOSEN_SINGLY = 30  # strips; with more, all get one model
MOST_SWEEPS = 5
LEAST_KNOWN = 15.0  # times the prior's information: below, a correction would keep a quarter of its prior's sigma


class StripError(ValueError):
    """Strips that cannot be adjusted; the message is one line for the user."""


@dataclass(frozen=True)
class Settings:
    """Settings of the strip adjustment.

    Attributes:
        knot_s: distance of a spline's knots.
        position_m, turn_rad: prior sigmas of a strip's constant correction; its drift has half of them.
        bend_m, bend_rad: prior sigmas of a spline's second differences.
        criterion: ``bic`` or ``aicc``.
        models: models that may be chosen.
        huber: returns with misclosures above this many sigmas lose weight.
        linearisations: number of linearisations.
    """

    knot_s: float = 10.0
    position_m: float = 0.2
    turn_rad: float = float(np.radians(0.02))
    bend_m: float = 0.03
    bend_rad: float = float(np.radians(0.003))
    criterion: str = "bic"
    models: tuple[str, ...] = MODELS
    huber: float = 3.0
    linearisations: int = 3


DEFAULTS = Settings()


@dataclass(frozen=True, slots=True)
class StripChoice:
    """The model that one strip got.

    Attributes:
        trajectory_index, strip: of the strip.
        model: of `MODELS`.
        gains: by model: criterion of this strip with it minus with the one chosen, the others as chosen; 0: chosen.
    """

    trajectory_index: int
    strip: int
    model: str
    gains: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class StripAdjusted:
    """The result of a strip adjustment; it contains no calibration.

    Attributes:
        choices: one per strip, by time.
        fit: the corrections along the strips, to be added to the trajectory, with their sigmas.
        trajectories: corrected.
        parameters: number of parameters that the returns determined.
        variance_before, variance_after: mean square of misclosures in sigmas.
        observations: number of rows.
        notes: for display.
    """

    choices: tuple[StripChoice, ...]
    fit: TrajectoryFit
    trajectories: tuple[Trajectory, ...]
    parameters: float
    variance_before: float
    variance_after: float
    observations: int
    notes: tuple[str, ...]


def adjust_strips(
    flight: Flight,
    features: Features,
    calibrations: Mapping[str, Calibration],
    settings: Settings = DEFAULTS,
    row_weight: SingleArray | None = None,
) -> StripAdjusted:
    """Correct each strip's trajectory according to its features.

    Args:
        flight: as measured.
        features: seen by several strips; control makes the corrections absolute.
        calibrations: by scanner; they are held.
        settings: of the strip adjustment.
        row_weight: (n,) of the rows on planes, in the order of `swath.calib.equations.rows`, from the calibration;
            None: 1.

    Raises:
        StripError: an unknown model or criterion, or no features; `FlightError`: there is no strip.
    """
    _check(settings)
    if not features.ties and not any(plane.points for plane in features.planes):
        raise StripError(
            "several strips share neither planes nor tie points, so no correction can be estimated; use strips that "
            "overlap over roofs or open ground"
        )
    knots = knots_of(flight, settings.knot_s)
    free = TrajectoryPrior(knots.trajectory_index, knots.time_ns, knots.strip, np.eye(ERRORS * len(knots)))
    case = _Equations(flight, features, calibrations, free, settings, row_weight)
    choice = _Choice(knots.trajectory_index, knots.strip, settings)
    state, before = case.start(), None
    for _ in range(settings.linearisations):
        quadratic = case.at(state)
        before = quadratic if before is None else before
        choice.choose(quadratic)
        along = choice.solved(quadratic)[0]
        state = case.moved(along)
    last = case.at(state)
    along, sigma, parameters = choice.solved(last)
    assert before is not None
    return StripAdjusted(
        choice.told(last),
        _fit(free, along, sigma, choice.prior_sigmas()),
        tuple(apply(one, number, free, along) for number, one in enumerate(flight.trajectories)),
        parameters,
        before.square(np.zeros(ERRORS * len(knots))) / before.observations,
        last.square(along.ravel()) / last.observations,
        last.observations,
        choice.notes(),
    )


def _check(settings: Settings) -> None:
    wrong = [repr(model) for model in settings.models if model not in MODELS]
    if wrong or not settings.models:
        raise StripError(f"strip model: got {', '.join(wrong) or 'none at all'}, want some of {', '.join(MODELS)}")
    if settings.criterion not in ("bic", "aicc"):
        raise StripError(f"criterion: got {settings.criterion!r}, want bic or aicc")


def _fit(free: TrajectoryPrior, along: FloatArray, sigma: FloatArray, prior: FloatArray) -> TrajectoryFit:
    return TrajectoryFit(
        free.trajectory_index, free.time_ns, free.strip,
        along[:, :3], along[:, 3:], sigma[:, :3], sigma[:, 3:], prior[:, :3], prior[:, 3:],
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Quadratic:
    """The function χ²(x) = constant − 2 right · x + x · normal x, of corrections x (6k,) in l or parameters."""

    normal: FloatArray
    right: FloatArray
    constant: float
    observations: int

    def square(self, x: FloatArray) -> float:
        """Return χ² of corrections or parameters."""
        return float(self.constant - 2.0 * self.right @ x + x @ self.normal @ x)

    def of(self, basis: FloatArray) -> _Quadratic:
        """Return χ² as a function of parameters (u,) with x = basis · parameters."""
        return _Quadratic(basis.T @ self.normal @ basis, basis.T @ self.right, self.constant, self.observations)


class _Equations:
    """The equations of the adjustment with states of the trajectory as the only unknowns."""

    def __init__(
        self,
        flight: Flight,
        features: Features,
        calibrations: Mapping[str, Calibration],
        free: TrajectoryPrior,
        settings: Settings,
        row_weight: SingleArray | None,
    ) -> None:
        planes = tuple(plane for plane in features.planes if plane.points)
        self._rows = Rows(flight, planes, unknowns(flight, ParameterOptions(), calibrations), free)
        self._ties = Ties(self._rows, features.ties, None)
        self._weight = TrajectoryWeight(self._rows)
        self._weight.normal = np.zeros_like(self._weight.normal)
        self._row_weight = np.ones(self._rows.count, np.float32) if row_weight is None else row_weight
        self._tie_weight = np.ones(sum(len(tie.sightings) for tie in features.ties), np.float32)
        self._huber = settings.huber

    def start(self) -> State:
        """Return the state without corrections."""
        return self._rows.start(len(self._ties.ties))

    def at(self, state: State) -> _Quadratic:
        """Return χ², linearised at a state."""
        found = normals(self._rows, self._ties, self._weight, state, self._row_weight, self._tie_weight, self._huber)
        x, p = state.knots.reshape(-1, 1), found.parameters  # parameters are held: their rows and columns are dropped
        normal, right = found.normal[p:, p:], found.right[p:].reshape(-1, 1)
        constant = _reduced_square(found) - 2.0 * float((right * x).sum()) + float((x * (normal @ x)).sum())
        to_l = self._weight.to_l
        turned = to_l(to_l(normal).T)
        return _Quadratic(
            (turned + turned.T) / 2.0, to_l(normal @ x - right).ravel(), constant, found.observations - len(x)
        )

    def moved(self, along: FloatArray) -> State:
        """Return the state with corrections (k, 6) in l; planes are as at the start."""
        return replace(self.start(), knots=self._weight.to_e(along.reshape(-1, 1)).reshape(-1, ERRORS))


def _reduced_square(found: Normals) -> float:
    """Return Σ p w² with planes and tie points at their optimum."""
    features = (*found.planes, *found.ties)
    return found.square - sum(float(one.right @ one.inverse @ one.right) for one in features)


@dataclass(frozen=True, eq=False)
class _Solved:
    """Parameters, scaled to prior sigmas of 1, that minimise the sum of χ² and the prior.

    Combinations of which the returns know little keep their prior, zero: the best estimate would be mostly noise.

    Attributes:
        values: (u,).
        parameters: number of them that the returns determine.
        square: χ² with them.
        known, axes: (u,) ratio of the returns' information to the prior's along axes (u, u).
    """

    values: FloatArray
    parameters: float
    square: float
    known: FloatArray
    axes: FloatArray

    @classmethod
    def of(cls, quadratic: _Quadratic, columns: Int64Array) -> _Solved:
        """Solve for some parameters, with the others held at zero."""
        known, axes = np.linalg.eigh(quadratic.normal[np.ix_(columns, columns)])
        taken = known > LEAST_KNOWN
        right = axes[:, taken].T @ quadratic.right[columns]
        best = right / (1.0 + known[taken])
        square = quadratic.constant - 2.0 * float(right @ best) + float(known[taken] @ best**2)
        return cls(axes[:, taken] @ best, float(np.sum(known[taken] / (1.0 + known[taken]))), square, known, axes)

    def covariance(self) -> FloatArray:
        """Return the covariance (u, u); it is 1 along axes that keep their prior."""
        spread = np.where(self.known > LEAST_KNOWN, 1.0 / (1.0 + np.maximum(self.known, 0.0)), 1.0)
        covariance: FloatArray = self.axes * spread @ self.axes.T
        return covariance


class _Choice:
    """The choice of a model for each strip.

    A model's parameters are the first ones of every richer model, so those of the richest are computed once.
    """

    def __init__(self, trajectory_index: Int64Array, strip: Int64Array, settings: Settings) -> None:
        self._settings = settings
        firsts = np.unique(np.stack([trajectory_index, strip], axis=1), axis=0, return_index=True)[1]
        self._keys = [(int(trajectory_index[at]), int(strip[at])) for at in sorted(firsts.tolist())]
        self._at = [np.flatnonzero((trajectory_index == key[0]) & (strip == key[1])) for key in self._keys]
        self.models = [settings.models[0]] * len(self._keys)
        self._columns: list[dict[str, Int64Array]] = []
        bases, begin = [], 0
        for at in self._at:
            own = {model: _basis(model, len(at), settings) for model in settings.models}
            self._columns.append({model: begin + np.arange(basis.shape[1]) for model, basis in own.items()})
            richest = max(own.values(), key=lambda basis: basis.shape[1])
            bases.append(np.zeros((ERRORS * len(trajectory_index), richest.shape[1])))
            bases[-1][(ERRORS * at[:, np.newaxis] + np.arange(ERRORS)).ravel()] = richest
            begin += richest.shape[1]
        self._basis = np.concatenate(bases, axis=1)

    def choose(self, quadratic: _Quadratic) -> None:
        """Choose models by the criterion: first one model for all strips, then strip by strip until no choice changes.

        Without control, one strip can remain uncorrected at no cost, and the others move to it: the strips that the
        common solution moves least come first.
        """
        of_all = quadratic.of(self._basis)
        alike = [[model] * len(self._keys) for model in self._settings.models]
        self.models = min([self.models, *alike], key=lambda models: self._criterion(of_all, models))
        if len(self._keys) > MOST_CHOSEN_SINGLY:
            return
        for _ in range(MOST_SWEEPS):
            before = list(self.models)
            for number in self._least_moved_first(of_all):
                found = self._tried(of_all, number)
                self.models[number] = min(found, key=lambda model: found[model])
            if self.models == before:
                return

    def _least_moved_first(self, of_all: _Quadratic) -> list[int]:
        columns = self._taken(self.models)
        moved = (self._basis[:, columns] @ _Solved.of(of_all, columns).values).reshape(-1, ERRORS)
        moved /= np.repeat([self._settings.position_m, self._settings.turn_rad], 3)
        size = [float(np.mean(moved[at] ** 2)) for at in self._at]
        return sorted(range(len(size)), key=lambda number: size[number])

    def solved(self, quadratic: _Quadratic) -> tuple[FloatArray, FloatArray, float]:
        """Return corrections (k, 6), their sigmas, and the number of parameters determined."""
        basis = self._basis[:, self._taken(self.models)]
        found = _Solved.of(quadratic.of(basis), np.arange(basis.shape[1]))
        spread = np.sqrt(np.maximum(np.einsum("ia,ia->i", basis @ found.covariance(), basis), 0.0))
        factor = np.sqrt(max(1.0, found.square / max(quadratic.observations - found.parameters, 1.0)))
        x, sigmas = basis @ found.values, factor * spread
        return x.reshape(-1, ERRORS), sigmas.reshape(-1, ERRORS), found.parameters

    def prior_sigmas(self) -> FloatArray:
        """Return the prior sigmas (k, 6) of the chosen models."""
        sigmas: FloatArray = np.sqrt(np.sum(self._basis[:, self._taken(self.models)] ** 2, axis=1))
        return sigmas.reshape(-1, ERRORS)

    def told(self, quadratic: _Quadratic) -> tuple[StripChoice, ...]:
        """Return the choice of each strip."""
        of_all = quadratic.of(self._basis)
        singly = len(self._keys) <= MOST_CHOSEN_SINGLY
        told = []
        for number, (trajectory_index, strip) in enumerate(self._keys):
            found = self._tried(of_all, number) if singly else {}
            chosen = found.get(self.models[number], 0.0)
            gains = {model: value - chosen for model, value in found.items()}
            told.append(StripChoice(trajectory_index, strip, self.models[number], gains))
        return tuple(told)

    def notes(self) -> tuple[str, ...]:
        """Return notes on the choice for display."""
        name = "Schwarz's" if self._settings.criterion == "bic" else "Akaike's corrected"
        models = self._settings.models
        how = (
            f"models chosen by {name} information criterion" if len(models) > 1 else f"model of all strips: {models[0]}"
        )
        notes = [f"{how}; the calibration parameters were held"]
        if len(self._keys) > MOST_CHOSEN_SINGLY:
            notes.append(f"{len(self._keys)} strips, more than {MOST_CHOSEN_SINGLY}, so all use the same model")
        return tuple(notes)

    def _tried(self, of_all: _Quadratic, number: int) -> dict[str, float]:
        """Return the criterion by model of one strip, with the other strips' models unchanged."""
        found = {}
        for model in self._settings.models:
            models = [*self.models[:number], model, *self.models[number + 1 :]]
            found[model] = self._criterion(of_all, models)
        return found

    def _criterion(self, of_all: _Quadratic, models: Sequence[str]) -> float:
        found, n = _Solved.of(of_all, self._taken(models)), of_all.observations
        k, fit = found.parameters, n * np.log(max(found.square, 1e-12 * n) / n)
        if self._settings.criterion == "bic":
            return float(fit + k * np.log(n))
        return float(fit + 2.0 * k + 2.0 * k * (k + 1.0) / max(n - k - 1.0, 1.0))

    def _taken(self, models: Sequence[str]) -> Int64Array:
        """Return the columns (u,) of the basis that belong to these models."""
        return np.concatenate([own[model] for own, model in zip(self._columns, models, strict=True)])


def _basis(model: str, knots: int, settings: Settings) -> FloatArray:
    """Return the basis (6 knots, u) of one strip, with each parameter in prior sigmas."""
    constant = np.repeat([settings.position_m, settings.turn_rad], 3)
    tau = np.linspace(-1.0, 1.0, knots)[:, np.newaxis]
    along, sigmas = [np.ones((knots, 1)), tau], [constant, 0.5 * constant]
    if knots > 2:
        bends = np.split(np.linalg.pinv(np.diff(np.eye(knots), n=2, axis=0)), knots - 2, axis=1)
        along += bends
        sigmas += [np.repeat([settings.bend_m, settings.bend_rad], 3)] * len(bends)
    count = {"none": 0, "constant": 1, "linear": 2, "spline": len(along)}[model]
    basis = [np.kron(shape, np.diag(sigma)) for shape, sigma in zip(along[:count], sigmas[:count], strict=True)]
    return np.concatenate([np.zeros((ERRORS * knots, 0)), *basis], axis=1)
