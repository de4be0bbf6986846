"""Adjust strips after the calibration: correct each strip's trajectory, but no parameter of the scanner.

The calibration is held, and its errors are part of the sigmas. Each strip gets the simplest correction that its returns
justify, as a correction of the trajectory (ISO/TS 19159-2, 6.3.3, Eq. 12; FORMULAS 7.3):

    none        0
    constant    a
    linear      a + b τ,  τ = −1 … 1 along the strip
    spline      a + b τ + bends between knots, with second differences held to 0

of position (north, east, down) and of small turns about these axes. All have priors, because no observation shows a
common shift of all strips without control. An information criterion (Schwarz 1978; AIC of Akaike 1974 as corrected by
Hurvich and Tsai 1989) chooses the model of each strip. Its number of parameters is the trace of N (N + P)⁻¹. The
equations are those of the adjustment (`swath.calib.equations.normals`) with only the states of the trajectory as
unknowns.

A strip's corrections have six components: shifts along and across its course and down, and turns about these axes. A
component is determined if the returns take at least 15/16 of its prior variance away: its redundancy,
1 − σ² / σ_prior², counts, not the size of its estimate. A component that is not determined is estimated like all
others, so that its errors go into none of them, but it is not corrected. Of a shift along the course and a turn about
the axis across it, which move the ground below alike, one may contain the other (decision 0034).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from swath.calib.equations.normals import Normals, TrajectoryWeight, normals
from swath.calib.equations.rows import Rows, State
from swath.calib.equations.tie_rows import Ties
from swath.calib.equations.trajectory_prior import ERRORS, Knots, TrajectoryPrior, apply, knots_of
from swath.calib.features import Features
from swath.calib.flight import Flight
from swath.calib.outcome import TrajectoryFit
from swath.calib.parameters import ParameterOptions, unknowns
from swath.calib.parameters import Unknowns as Parameters
from swath.calib.strips.determined import ALONG, DOWN, LEAST_KNOWN, ORDERS, PITCH, Quadratic, Solved, Unknowns
from swath.georef.arrays import BoolArray, FloatArray, Int64Array, SingleArray
from swath.georef.geodesy.earth import geodetic_from_e, rot_e_from_l
from swath.georef.geodesy.rotations import rot_z
from swath.georef.progress import Tell, silent
from swath.georef.scanner.calibration import INDEX, PARAMETERS, Calibration
from swath.georef.trajectory.trajectory import Trajectory

NONE, CONSTANT = "none", "constant"
MODELS = (NONE, CONSTANT, "linear", "spline")
MOST_CHOSEN_SINGLY = 30  # strips; with more, all get one model
MOST_SWEEPS = 5
MOST_REFERENCES = 4  # strips without control that are tried as the one that the others are related to
IN_PLAN = (0, 1, 4, 5)  # shifts along and across, and what moves the ground like them: pitch and heading


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


@dataclass(frozen=True, eq=False)
class Components:
    """Means along a strip of its correction, in its own axes: shifts along and across the course, down, then turns.

    Attributes:
        mean, sigma: (6,) m, rad; a component that is not determined has mean 0 and its prior sigma.
        of_calibration: (6,) part of `sigma` that errors of the held calibration have, m, rad; 0: its file tells none.
            Of an outweighed component: the size of these errors.
        redundancy: (6,) share of the prior variance that the returns take away.
        determined: (6,) flags of components that the returns determine; the others are not corrected.
        outweighed: (6,) flags of components that would be determined, were the held calibration's errors in them not
            larger than the prior sigma.
        absorbs: (6, 6) [i, j]: component i contains the error of component j, which is held. The sigma of i is that of
            their sum.
        datum: (6,) flags of components that are held because, without control, those of other strips are related to
            them. They have no sigma (nan).
    """

    mean: FloatArray
    sigma: FloatArray
    of_calibration: FloatArray
    redundancy: FloatArray
    determined: BoolArray
    outweighed: BoolArray
    absorbs: BoolArray
    datum: BoolArray

    @classmethod
    def held(cls) -> Components:
        """Return components that all hold the datum."""
        no = np.zeros(ERRORS, np.bool_)
        zero, unknown = np.zeros(ERRORS), np.full(ERRORS, np.nan)
        absorbs = np.zeros((ERRORS, ERRORS), np.bool_)
        return cls(zero, unknown, zero.copy(), zero.copy(), no, no.copy(), absorbs, ~no)


@dataclass(frozen=True, slots=True)
class StripChoice:
    """The model that one strip got.

    Attributes:
        trajectory_index, strip: of the strip.
        model: of `MODELS`.
        gains: by model: criterion of this strip with it minus with the one chosen, the others as chosen; 0: chosen.
        course_rad: course of the strip.
        components: its correction; of a strip without one: what a constant correction would determine.
    """

    trajectory_index: int
    strip: int
    model: str
    gains: Mapping[str, float]
    course_rad: float
    components: Components


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
    tell: Tell = silent,
) -> StripAdjusted:
    """Correct each strip's trajectory according to its features.

    Args:
        flight: as measured.
        features: seen by several strips; control makes the corrections absolute.
        calibrations: by scanner; they are held.
        settings: of the strip adjustment.
        row_weight: (n,) of the rows on planes, in the order of `swath.calib.equations.rows`, from the calibration;
            None: 1.
        tell: called with the progress.

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
    choice = _Choice(knots.trajectory_index, knots.strip, _courses(flight, knots), settings)
    state, before = case.start(), None
    for number in range(settings.linearisations):
        tell("corrections", number, settings.linearisations + 1, "linearisations")
        quadratic = case.at(state)
        before = quadratic if before is None else before
        choice.choose(quadratic)
        state = case.moved(choice.corrections(quadratic))
    tell("corrections", settings.linearisations, settings.linearisations + 1, "linearisations")
    last = case.at(state)
    along, sigma, parameters = choice.solved(last)
    assert before is not None
    told = choice.told(last)
    return StripAdjusted(
        told,
        _fit(free, along, sigma, choice.prior_sigmas()),
        tuple(apply(one, number, free, along) for number, one in enumerate(flight.trajectories)),
        parameters,
        before.square(np.zeros(ERRORS * len(knots))) / before.observations,
        last.square(along.ravel()) / last.observations,
        last.observations,
        choice.notes(told),
    )


def _courses(flight: Flight, knots: Knots) -> FloatArray:
    """Return the course (k,) of each knot's strip, from its first to its last knot."""
    courses = np.zeros(len(knots))
    for number, trajectory in enumerate(flight.trajectories):
        for strip in np.unique(knots.strip[knots.trajectory_index == number]).tolist():
            at = np.flatnonzero((knots.trajectory_index == number) & (knots.strip == strip))
            ends_e = trajectory.poses(np.clip(knots.time_ns[at[[0, -1]]], *trajectory.span)).position_e
            lat_rad, lon_rad, _ = geodetic_from_e(ends_e[0])
            north, east, _ = rot_e_from_l(lat_rad, lon_rad).T @ (ends_e[1] - ends_e[0])
            courses[at] = np.arctan2(east, north)
    return courses


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
        held = unknowns(flight, _with_sigmas(flight, calibrations), calibrations)
        self._held = _roots(held)
        self._rows = Rows(flight, planes, held, free)
        self._ties = Ties(self._rows, features.ties, None)
        self._weight = TrajectoryWeight(self._rows)
        self._weight.normal = np.zeros_like(self._weight.normal)
        self._row_weight = np.ones(self._rows.count, np.float32) if row_weight is None else row_weight
        self._tie_weight = np.ones(sum(len(tie.sightings) for tie in features.ties), np.float32)
        self._huber = settings.huber

    def start(self) -> State:
        """Return the state without corrections."""
        return self._rows.start(len(self._ties.ties))

    def at(self, state: State) -> Quadratic:
        """Return χ², linearised at a state."""
        found = normals(self._rows, self._ties, self._weight, state, self._row_weight, self._tie_weight, self._huber)
        x, p = state.knots.reshape(-1, 1), found.parameters  # parameters are held: their rows and columns are dropped
        normal, right = found.normal[p:, p:], found.right[p:].reshape(-1, 1)
        constant = _reduced_square(found) - 2.0 * float((right * x).sum()) + float((x * (normal @ x)).sum())
        to_l = self._weight.to_l
        turned = to_l(to_l(normal).T)
        return Quadratic(
            (turned + turned.T) / 2.0,
            to_l(normal @ x - right).ravel(),
            constant,
            found.observations - len(x),
            to_l(found.normal[p:, :p] @ self._held),
        )

    def moved(self, along: FloatArray) -> State:
        """Return the state with corrections (k, 6) in l; planes are as at the start."""
        return replace(self.start(), knots=self._weight.to_e(along.reshape(-1, 1)).reshape(-1, ERRORS))


def _with_sigmas(flight: Flight, calibrations: Mapping[str, Calibration]) -> ParameterOptions:
    """Return options that let the equations contain each parameter whose sigma its calibration tells."""
    names = [
        f"{head.name}.{name}"
        for head in flight.heads
        for name, at in INDEX.items()
        if calibrations[head.name].all_sigmas[at] > 0.0 and name not in head.geometry.without
    ]
    return ParameterOptions(free=frozenset(names))


def _roots(held: Parameters) -> FloatArray:
    """Return L (p, h) with L Lᵀ the covariance of the held parameters; scanners' errors count as independent."""
    covariance = np.zeros((len(held), len(held)))
    for head, base in enumerate(held.base):
        places, kinds, _ = held.of_head(head)
        own = kinds < len(PARAMETERS)
        covariance[np.ix_(places[own], places[own])] = base.covariance()[np.ix_(kinds[own], kinds[own])]
    sigmas = np.sqrt(np.diag(covariance))
    known = np.flatnonzero(sigmas > 0.0)
    scaled = covariance[np.ix_(known, known)] / np.outer(sigmas[known], sigmas[known])
    values, vectors = np.linalg.eigh(scaled) if len(known) else (np.zeros(0), np.zeros((0, 0)))
    roots = np.zeros((len(held), len(known)))
    roots[known] = sigmas[known, np.newaxis] * vectors * np.sqrt(np.maximum(values, 0.0))
    return roots


def _reduced_square(found: Normals) -> float:
    """Return Σ p w² with planes and tie points at their optimum."""
    features = (*found.planes, *found.ties)
    return found.square - sum(float(one.right @ one.inverse @ one.right) for one in features)


@dataclass(frozen=True)
class _Group:
    """Indices of strips that are related to each other; whether control tells their common height, their common place.

    Where it does not, a strip without correction holds the datum.
    """

    strips: list[int]
    knows_height: bool
    knows_plan: bool

    @property
    def needs_plan(self) -> bool:
        """True if the strips' heights are known, but their common place in plan is not."""
        return self.knows_height and not self.knows_plan and len(self.strips) > 1

    def models_of(self, models: Sequence[str]) -> list[str]:
        """Return the models of its strips."""
        return [models[number] for number in self.strips]

    def datum(self, models: Sequence[str]) -> list[int]:
        """Return the one strip without correction that all others are related to; empty: there are several or none."""
        kept = [number for number in self.strips if models[number] == NONE]
        return kept if len(kept) == 1 < len(self.strips) and not self.knows_height else []


class _Choice:
    """The choice of a model for each strip.

    A model's parameters are the first ones of every richer model, so those of the richest are computed once.
    """

    def __init__(
        self, trajectory_index: Int64Array, strip: Int64Array, course_rad: FloatArray, settings: Settings
    ) -> None:
        self._settings = settings
        firsts = np.unique(np.stack([trajectory_index, strip], axis=1), axis=0, return_index=True)[1]
        self._keys = [(int(trajectory_index[at]), int(strip[at])) for at in sorted(firsts.tolist())]
        self._at = [np.flatnonzero((trajectory_index == key[0]) & (strip == key[1])) for key in self._keys]
        self._courses = [float(course_rad[at[0]]) for at in self._at]
        self.models = [NONE] * len(self._keys)
        self._groups: list[_Group] = []
        self._columns: list[dict[str, Int64Array]] = []
        bases, begin = [], 0
        for at, course in zip(self._at, self._courses, strict=True):
            own = {model: _basis(model, len(at), settings) for model in {NONE, CONSTANT, *settings.models}}
            self._columns.append({model: begin + np.arange(basis.shape[1]) for model, basis in own.items()})
            richest = max(own.values(), key=lambda basis: basis.shape[1])
            rows = (ERRORS * at[:, np.newaxis] + np.arange(ERRORS)).ravel()
            bases.append(np.zeros((ERRORS * len(trajectory_index), richest.shape[1])))
            bases[-1][rows] = np.kron(np.eye(2 * len(at)), rot_z(course)) @ richest
            begin += richest.shape[1]
        self._basis = np.concatenate(bases, axis=1)
        counts = [basis.shape[1] for basis in bases]
        within = np.concatenate([np.arange(count) for count in counts])
        order = np.minimum(within // ERRORS, ORDERS - 1)
        self._unknowns = Unknowns(np.repeat(np.arange(len(counts)), counts), within % ERRORS, order)

    def choose(self, quadratic: Quadratic) -> None:
        """Choose models by the criterion: first one model for all strips, then strip by strip until no choice changes.

        Of strips that no control relates to the ground at least one gets no correction, and the others are related to
        it. Of the half that the returns know best, those that the common solution moves least are tried as the first of
        these, because from a wrong one no single change leads to the strips that agree.
        """
        of_all = quadratic.of(self._basis)
        self._groups = self._linked(of_all)
        ends: list[tuple[float, list[int], list[str]]] = []
        for rank in range(MOST_REFERENCES):
            starts = [self._start(of_all, model, rank) for model in self._settings.models]
            order, models = min(starts, key=lambda start: self._criterion(of_all, start[1]))
            if len(self._keys) <= MOST_CHOSEN_SINGLY:
                models = self._swept(of_all, order, models)
            ends.append((self._criterion(of_all, models), order, models))
            if all(group.knows_height for group in self._groups):
                break  # no strip is a reference
        _, order, self.models = min(ends, key=lambda end: end[0])
        self._groups = [replace(one, strips=sorted(one.strips, key=order.index)) for one in self._groups]

    def _swept(self, of_all: Quadratic, order: Sequence[int], models: list[str]) -> list[str]:
        """Return the models of strips when no single change improves the criterion any more."""
        self.models = list(models)
        for _ in range(MOST_SWEEPS):
            before = list(self.models)
            for number in order:
                found = self._tried(of_all, number)
                self.models[number] = min(found, key=lambda model: found[model])
            if self.models == before:
                break
        return self.models

    def _start(self, of_all: Quadratic, model: str, rank: int) -> tuple[list[int], list[str]]:
        """Return strips in the order in which one model for all moves them, and the models to begin with.

        Args:
            of_all: χ² of all parameters.
            model: of all strips but references.
            rank: number in this order of the reference of each group, among the half that the returns know best.
        """
        models = [model] * len(self._keys)
        columns = self._taken(models)
        moved = (self._basis[:, columns] @ self._solve(of_all, models).whole).reshape(-1, ERRORS)
        moved /= np.repeat([self._settings.position_m, self._settings.turn_rad], 3)
        size = [float(np.mean(moved[at] ** 2)) for at in self._at]
        order = sorted(range(len(size)), key=lambda number: size[number])
        own = np.array([of_all.normal[columns[CONSTANT][DOWN], columns[CONSTANT][DOWN]] for columns in self._columns])
        for group in self._groups:
            if not group.knows_height:
                well_seen = [number for number in group.strips if own[number] >= np.median(own[group.strips])]
                models[sorted(well_seen, key=order.index)[: rank + 1][-1]] = NONE
        return order, models

    def _linked(self, of_all: Quadratic) -> list[_Group]:
        """Return groups of strips whose heights the returns relate to each other, and what control says of them."""
        columns = np.array([own[CONSTANT][:3] for own in self._columns])
        down = columns[:, DOWN]
        count, label = connected_components(
            csr_array(-of_all.normal[np.ix_(down, down)] >= LEAST_KNOWN), directed=False
        )
        groups = []
        for number in range(count):
            strips = np.flatnonzero(label == number)
            own = columns[strips].ravel()
            together = np.concatenate([rot_z(-self._courses[strip]) for strip in strips.tolist()])
            known = np.diag(together.T @ of_all.normal[np.ix_(own, own)] @ together) >= LEAST_KNOWN
            groups.append(_Group(strips.tolist(), bool(known[DOWN]), bool(known[:DOWN].all())))
        return groups

    def _solve(self, of_all: Quadratic, models: Sequence[str]) -> Solved:
        columns = self._taken(models)
        return Solved.of(of_all, columns, self._unknowns.at(columns))

    def corrections(self, quadratic: Quadratic) -> FloatArray:
        """Return corrections (k, 6) in l."""
        values = self._solve(quadratic.of(self._basis), self.models).values
        corrections: FloatArray = (self._basis[:, self._taken(self.models)] @ values).reshape(-1, ERRORS)
        return corrections

    def solved(self, quadratic: Quadratic) -> tuple[FloatArray, FloatArray, float]:
        """Return corrections (k, 6) in l, their sigmas, and how many parameters are determined."""
        found, basis = self._solve(quadratic.of(self._basis), self.models), self._basis[:, self._taken(self.models)]
        variance = np.einsum("ia,ia->i", basis @ found.covariance, basis) + np.sum((basis @ found.held) ** 2, axis=1)
        sigmas: FloatArray = np.sqrt(np.maximum(variance, 0.0))
        return (basis @ found.values).reshape(-1, ERRORS), sigmas.reshape(-1, ERRORS), found.parameters

    def prior_sigmas(self) -> FloatArray:
        """Return the prior sigmas (k, 6) of the chosen models."""
        sigmas: FloatArray = np.sqrt(np.sum(self._basis[:, self._taken(self.models)] ** 2, axis=1))
        return sigmas.reshape(-1, ERRORS)

    def told(self, quadratic: Quadratic) -> tuple[StripChoice, ...]:
        """Return the choice of each strip."""
        of_all = quadratic.of(self._basis)
        singly = len(self._keys) <= MOST_CHOSEN_SINGLY
        chosen = self._components(of_all, self.models)
        datum = {number for group in self._groups for number in group.datum(self.models)}
        told = []
        for number, (trajectory_index, strip) in enumerate(self._keys):
            found = self._tried(of_all, number) if singly else {}
            gains = {model: value - found[self.models[number]] for model, value in found.items()}
            own = chosen.get(number)
            if number in datum:
                own = Components.held()
            elif own is None:
                would = self._components(of_all, self._with(number, CONSTANT))[number]
                own = replace(would, mean=np.zeros(ERRORS), absorbs=np.zeros_like(would.absorbs))
            model, course = self.models[number], self._courses[number]
            told.append(StripChoice(trajectory_index, strip, model, gains, course, own))
        return tuple(told)

    def _components(self, of_all: Quadratic, models: Sequence[str]) -> dict[int, Components]:
        """Return the components of all strips that have a correction."""
        own, found = self._unknowns.at(self._taken(models)), self._solve(of_all, models)
        prior, components = np.repeat([self._settings.position_m, self._settings.turn_rad], 3), {}
        for number in np.unique(own.strip).tolist():
            at = np.flatnonzero((own.strip == number) & (own.order == 0))
            named = own.component[at]
            one = Components.held()
            one.mean[named] = prior[named] * found.values[at]
            one.of_calibration[named] = prior[named] * np.sqrt(np.sum(found.held[at] ** 2, axis=1))
            by_returns = prior[named] * np.sqrt(np.diag(found.covariance)[at])
            one.sigma[named] = np.where(
                found.outweighed[at], prior[named], np.hypot(by_returns, one.of_calibration[named])
            )
            one.redundancy[named] = np.maximum(1.0 - found.left[at], 0.0)
            one.determined[named], one.outweighed[named] = found.determined[at], found.outweighed[at]
            for both in ((ALONG, PITCH), (PITCH, ALONG)):
                one.absorbs[both] = one.determined[both[0]] and both[1] in own.component[at[found.merged[at]]]
            one.datum[named] = False
            components[number] = one
        return components

    def _is_related(self, models: Sequence[str]) -> bool:
        """Return True if every group of strips without control has a strip without correction."""
        return all(group.knows_height or NONE in group.models_of(models) for group in self._groups)

    def _with(self, number: int, model: str) -> list[str]:
        return [*self.models[:number], model, *self.models[number + 1 :]]

    def notes(self, told: Sequence[StripChoice]) -> tuple[str, ...]:
        """Return notes on the choice for display."""
        name = "Schwarz's" if self._settings.criterion == "bic" else "Akaike's corrected"
        models = self._settings.models
        how = (
            f"models chosen by {name} information criterion" if len(models) > 1 else f"model of all strips: {models[0]}"
        )
        notes = [how]
        if not any(one.components.of_calibration.any() for one in told):
            notes.append("the held calibration's file tells no sigmas, and no sigma here contains its errors")
        if len(self._keys) > MOST_CHOSEN_SINGLY:
            notes.append(f"{len(self._keys)} strips, more than {MOST_CHOSEN_SINGLY}, so all use the same model")
        notes += [
            f"no control: strip {one.strip:02d} keeps its trajectory, and corrections of others are relative to it"
            for one in told
            if one.components.datum.all()
        ]
        notes += [
            f"control tells no place in plan: strip {one.strip:02d} keeps its place and heading, and those of other "
            "strips are relative to it"
            for one in told
            if one.components.datum.any() and not one.components.datum.all()
        ]
        return tuple(notes)

    def _tried(self, of_all: Quadratic, number: int) -> dict[str, float]:
        """Return the criterion by model of one strip, with the other strips' models unchanged."""
        models = dict.fromkeys([self.models[number], *self._settings.models])
        trials = {model: self._with(number, model) for model in models}
        return {model: self._criterion(of_all, models) for model, models in trials.items() if self._is_related(models)}

    def _criterion(self, of_all: Quadratic, models: Sequence[str]) -> float:
        found, n = self._solve(of_all, models), of_all.observations
        k, fit = found.freedom, n * np.log(max(found.square, 1e-12 * n) / n)
        if self._settings.criterion == "bic":
            return float(fit + k * np.log(n))
        return float(fit + 2.0 * k + 2.0 * k * (k + 1.0) / max(n - k - 1.0, 1.0))

    def _taken(self, models: Sequence[str]) -> Int64Array:
        """Return the columns (u,) of the basis that belong to these models."""
        taken = [own[model] for own, model in zip(self._columns, models, strict=True)]
        for group in self._groups:
            if group.needs_plan and NONE not in group.models_of(models):  # the first one holds the datum in plan
                first = taken[group.strips[0]]
                taken[group.strips[0]] = first[~np.isin(self._unknowns.component[first], IN_PLAN)]
        return np.concatenate(taken)


def _basis(model: str, knots: int, settings: Settings) -> FloatArray:
    """Return the basis (6 knots, u) of one strip in its own axes, with each parameter in prior sigmas."""
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
