"""Choose which parameters of the sensor model a calibration estimates, and arrange them in one vector for all scanners.

Beyond the model's sixteen (CONVENTIONS, "The beam") a scanner may have: a separate range offset for each return slot or
zone of pulses in air; a range correction by intensity, linear between knots; corrections of the beams of a spinning
head. Where only differences are observable, one member is held: the reference intensity's correction and the first
beam's.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from swath.calib.flight import Flight, Head
from swath.calib.intensity_curve import at_knots, curve, nodes_of
from swath.calib.outcome import FixedParameter
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.scanner.beams import OusterGeometry, SpinningGeometry
from swath.georef.scanner.calibration import INDEX, PARAMETERS, BeamCorrection, Calibration, RangeOffset

_BASIC = ("omega_rad", "phi_rad", "kappa_rad", "range_offset_m")
_SCANNER = (*_BASIC, "scan_angle_scale", "range_scale", "scan_plane_tilt_rad", "time_offset_s")
MODELS: Mapping[str, tuple[str, ...]] = {
    "basic": _BASIC,
    "scanner": _SCANNER,
    "full": tuple(parameter.name for parameter in PARAMETERS),
}
# Kinds of design columns, besides the places of PARAMETERS
SLOT, ZONE, KNOT, AZIMUTH, ELEVATION, RANGE = range(len(PARAMETERS), len(PARAMETERS) + 6)
EXTRA = ("range_offset_slot.", "range_offset_zone.", "ibrc.", "beam.")  # prefixes of tables, of one scanner or of all
BEAM_PARTS = {"azimuth_rad": AZIMUTH, "elevation_rad": ELEVATION, "range_m": RANGE}
_BY_CONVENTION = "scan_angle_offset_rad"
ANGLES = ("omega_rad", "phi_rad", "kappa_rad")
# One sigma of parameters that are measured on the ground with the scanner installed. All other parameters that the
# model `scanner` lacks and that the user does not name are known exactly.
INSTALLED: Mapping[str, float] = {f"lever_arm_{axis}_m": 0.002 for axis in "xyz"}


class ParameterError(ValueError):
    """Options of a parameter that cannot be met; the message is one line for the user."""


@dataclass(frozen=True)
class ParameterOptions:
    """Selects the parameters to estimate. Names are of all scanners (``phi_rad``) or of one (``left.phi_rad``).

    A setting for one scanner's parameter overrides the setting for all scanners; for the same name `fix` takes
    precedence.

    Attributes:
        model: key of `MODELS`.
        fix: parameters of the model that keep their value.
        free: parameters beyond the model.
        priors: one sigma by which a parameter is held to its start, SI; the parameter is estimated, whether it is in
            the model or not. For a parameter in `fix`: the sigma of its value.
        ibrc_knots: rising intensities of a range correction by intensity; empty: it is not estimated.
        ibrc_reference: the knot whose correction is 0; None: the middle one.
        ibrc_smoothness_m: one sigma of a knot's distance from the line through its neighbours.
        beams: parts of a spinning head's beams that are estimated, keys of `BEAM_PARTS`.
        range_offset_slots: return numbers with their own range offset, in addition to the common one.
        range_offset_zones: numbers of pulses in air (from 0), likewise.
    """

    model: str = "basic"
    fix: frozenset[str] = frozenset()
    free: frozenset[str] = frozenset()
    priors: Mapping[str, float] = field(default_factory=dict)
    ibrc_knots: tuple[float, ...] = ()
    ibrc_reference: float | None = None
    ibrc_smoothness_m: float = 0.02
    beams: frozenset[str] = frozenset()
    range_offset_slots: tuple[int, ...] = ()
    range_offset_zones: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Unknown:
    """One estimated parameter.

    Attributes:
        head: index in `Flight.heads`.
        kind: place in `PARAMETERS`, or SLOT … RANGE.
        argument: return slot, zone, knot or channel.
        name: as ``left.omega_rad``.
        start: its value before, SI.
        prior_sigma: sigma by which it is held to that value; inf: free.
        plausible: one sigma, SI, of the start's error where it is held; 0: the start is exact, or a reference.
        first: the value from which iterations begin; nan: the start.
        assumed: whether the prior is the plausible sigma, not the user's.
    """

    head: int
    kind: int
    argument: int
    name: str
    start: float
    prior_sigma: float = np.inf
    plausible: float = 0.0
    first: float = np.nan
    assumed: bool = False


@dataclass(frozen=True, eq=False)
class Unknowns:
    """The vector of the estimated parameters of all heads.

    Attributes:
        base: calibration of each head, with the values of parameters that are not estimated.
        items: (u,).
        held: parameters of the model that are excluded at the user's request or by convention.
        knots: (k,) intensities of the range correction by intensity; empty: it is not estimated. The base's tables use
            these knots.
        smoothness_m: of the range correction by intensity.
        considered: (c,) parameters that keep their start, each with its plausible error.
    """

    base: tuple[Calibration, ...]
    items: tuple[Unknown, ...]
    held: tuple[FixedParameter, ...] = ()
    knots: FloatArray = field(default_factory=lambda: np.zeros(0))
    smoothness_m: float = 0.02
    considered: tuple[Unknown, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names (u,) as ``left.omega_rad``."""
        return tuple(item.name for item in self.items)

    @property
    def start(self) -> FloatArray:
        """Values (u,) before the adjustment."""
        return np.array([item.start for item in self.items], dtype=np.float64)

    @property
    def first(self) -> FloatArray:
        """Values (u,) from which iterations begin."""
        first = np.array([item.first for item in self.items], dtype=np.float64)
        return np.where(np.isnan(first), self.start, first)

    @property
    def prior_sigmas(self) -> FloatArray:
        """Prior sigmas (u,); inf where a parameter has no prior."""
        return np.array([item.prior_sigma for item in self.items], dtype=np.float64)

    def __len__(self) -> int:
        """Return the number of unknowns."""
        return len(self.items)

    def of_head(self, head: int) -> tuple[Int64Array, Int64Array, Int64Array]:
        """Return a head's unknowns (m,): their places in the vector, kinds and arguments."""
        at = [index for index, item in enumerate(self.items) if item.head == head]
        kinds = [self.items[index].kind for index in at]
        arguments = [self.items[index].argument for index in at]
        return np.array(at, dtype=np.int64), np.array(kinds, dtype=np.int64), np.array(arguments, dtype=np.int64)

    def without(self, names: frozenset[str], held: Sequence[FixedParameter] = ()) -> Unknowns:
        """Return the same unknowns with some held at their start."""
        items = tuple(item for item in self.items if item.name not in names)
        gone = tuple(item for item in self.items if item.name in names and item.plausible > 0.0)
        return replace(self, items=items, held=(*self.held, *held), considered=(*self.considered, *gone))

    def assuming(self, sigmas: Mapping[str, float]) -> Unknowns:
        """Return the same unknowns; the starts of some count as observed with one sigma (SI) by name."""
        items = tuple(
            replace(item, prior_sigma=sigmas[item.name], assumed=True) if item.name in sigmas else item
            for item in self.items
        )
        return replace(self, items=items)

    @property
    def given_sigmas(self) -> FloatArray:
        """Sigmas (u,) of the user's priors; inf where the user gave no prior."""
        return np.where([item.assumed for item in self.items], np.inf, self.prior_sigmas)

    def complete(self) -> Unknowns:
        """Return the same unknowns with the considered parameters appended to them."""
        free = tuple(replace(item, prior_sigma=np.inf) for item in self.considered)
        return replace(self, items=(*self.items, *free), considered=())

    def calibrations(self, values: FloatArray) -> dict[str, Calibration]:
        """Return calibrations by scanner with the values (u,)."""
        return {base.scanner: self._with(head, values) for head, base in enumerate(self.base)}

    def finished(
        self, values: FloatArray, covariance: FloatArray, held_sigmas: FloatArray, moved: FloatArray
    ) -> dict[str, Calibration]:
        """Return calibrations by scanner, with the joint covariance of their parameters.

        Args:
            values: (u,) of the unknowns.
            covariance: (u, u) of them, with what those considered do to them.
            held_sigmas: (c,) one sigma of those considered.
            moved: (u, c) by which that moves the unknowns.
        """
        done = {}
        joint = np.block([[covariance, moved * held_sigmas], [(moved * held_sigmas).T, np.diag(held_sigmas**2)]])
        items = (*self.items, *self.considered)
        for head, base in enumerate(self.base):
            at = np.array([i for i, one in enumerate(items) if one.head == head and one.kind < SLOT], dtype=np.int64)
            kinds = np.array([items[i].kind for i in at], dtype=np.int64)
            sigma, estimated = np.sqrt(np.diag(joint)[at]), at < len(self.items)
            sigmas, held, correlation = np.zeros(len(PARAMETERS)), np.zeros(len(PARAMETERS)), np.eye(len(PARAMETERS))
            sigmas[kinds[estimated]], held[kinds[~estimated]] = sigma[estimated], sigma[~estimated]
            correlation[np.ix_(kinds, kinds)] = joint[np.ix_(at, at)] / np.outer(sigma, sigma)
            correlation[kinds, kinds] = 1.0
            found = self._with(head, values)
            done[base.scanner] = replace(found, sigmas=sigmas, held_sigmas=held, correlation=correlation)
        return done

    def pseudo(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return pseudo-observations 0 = A x + w of values (u,), divided by their sigmas: A (m, u), w (m,).

        There is one for each prior of a parameter, and one for each inner knot: the correction by intensity bends
        little.
        """
        rows, misclosures = [], []
        for at, item in enumerate(self.items):
            if np.isfinite(item.prior_sigma):
                rows.append(np.eye(len(self.items))[at] / item.prior_sigma)
                misclosures.append((values[at] - item.start) / item.prior_sigma)
        for head in range(len(self.base)):
            for row, misclosure in self._bends(head, values):
                rows.append(row / self.smoothness_m)
                misclosures.append(misclosure / self.smoothness_m)
        return np.array(rows).reshape(len(rows), len(self.items)), np.array(misclosures, dtype=np.float64)

    def _bends(self, head: int, values: FloatArray) -> Iterator[tuple[FloatArray, float]]:
        """Yield coefficients and distance of each inner knot's correction from the line through its neighbours."""
        at, kinds, arguments = self.of_head(head)
        place = dict(zip(arguments[kinds == KNOT].tolist(), at[kinds == KNOT].tolist(), strict=True))
        table = self._with(head, values).ibrc
        if not place or table is None:
            return
        knots, corrections = self.knots, at_knots(table[1])
        for knot in range(1, len(knots) - 1):
            share = (knots[knot] - knots[knot - 1]) / (knots[knot + 1] - knots[knot - 1])
            row = np.zeros(len(self.items))
            factors = {knot - 1: share - 1.0, knot: 1.0, knot + 1: -share}
            for other, factor in factors.items():
                if other in place:
                    row[place[other]] = factor
            yield row, float(sum(factor * corrections[other] for other, factor in factors.items()))

    def _with(self, head: int, values: FloatArray) -> Calibration:
        base = self.base[head]
        parameters, offsets, beams = base.parameters.copy(), list(base.range_offsets), dict(base.beams)
        correction_m = None if base.ibrc is None else base.ibrc[1].copy()
        for item, value in zip(self.items, values.tolist(), strict=True):
            if item.head != head:
                continue
            if item.kind < SLOT:
                parameters[item.kind] = value
            elif item.kind in (SLOT, ZONE):
                _put_offset(offsets, item, value)
            elif item.kind == KNOT and correction_m is not None:
                correction_m[item.argument] = value
            else:
                part = item.name.rsplit(".", 1)[-1]
                beams[item.argument] = replace(beams.get(item.argument, BeamCorrection()), **{part: value})
        table = base.ibrc
        if len(self.knots) and correction_m is not None:
            table = nodes_of(self.knots), curve(self.knots, correction_m)
        return replace(base, parameters=parameters, range_offsets=tuple(offsets), ibrc=table, beams=beams)


def unknowns(
    flight: Flight,
    options: ParameterOptions,
    start: Mapping[str, Calibration] | None = None,
    first: Mapping[str, Calibration] | None = None,
    doubted: Mapping[str, float] | None = None,
) -> Unknowns:
    """Return the unknowns of a flight.

    Args:
        flight: flight with the heads.
        options: which parameters to estimate.
        start: calibrations to start from, by scanner; None: the heads' own. Held parameters keep their values.
        first: by scanner, boresight angles from which iterations begin; None: from the start.
        doubted: by name, as ``left.kappa_rad``, least sigma (SI) of its start where it is held.

    Raises:
        ParameterError: the options name an unknown parameter, or one that such a scanner does not have.
    """
    check_options(flight, options)
    bases, items, held, considered = [], [], [], []
    for index, head in enumerate(flight.heads):
        calibration = head.start if start is None else start[head.name]
        base = _with_knots(replace(calibration, scanner=head.name), options)
        bases.append(base)
        for parameter in PARAMETERS:
            name, word = parameter.name, _word(head, parameter.name, options)
            near = np.nan if first is None or name not in ANGLES else first[head.name].value(name)
            plausible = max(_plausible(head, base, name, options), (doubted or {}).get(f"{head.name}.{name}", 0.0))
            known = Unknown(index, INDEX[name], 0, f"{head.name}.{name}", base.value(name), plausible=plausible)
            if word is None:
                items.append(replace(known, prior_sigma=_prior(head, name, options), first=near))
                continue
            if plausible > 0.0:
                considered.append(known)
            if name in MODELS[options.model] or _asked(head, name, options) == "fix":
                held.append(FixedParameter(head.name, name, word))
        items += _extras(index, head, base, options)
    knots = np.array(options.ibrc_knots, dtype=np.float64)
    return Unknowns(tuple(bases), tuple(items), tuple(held), knots, options.ibrc_smoothness_m, tuple(considered))


def _asked(head: Head, name: str, options: ParameterOptions) -> str:
    """Return ``fix``, ``free``, ``prior`` or an empty string, the user's setting for this head or else for all."""
    for key in (f"{head.name}.{name}", name):
        for word, names in (("fix", options.fix), ("prior", options.priors), ("free", options.free)):
            if key in names:
                return word
    return ""


def _prior(head: Head, name: str, options: ParameterOptions) -> float:
    if _asked(head, name, options) == "free":
        return np.inf
    return options.priors.get(f"{head.name}.{name}", options.priors.get(name, np.inf))


def _word(head: Head, name: str, options: ParameterOptions) -> str | None:
    """Return why a parameter is not estimated; None: it is estimated."""
    asked = _asked(head, name, options)
    if name in head.geometry.without:
        if asked in ("free", "prior"):
            raise ParameterError(f"{head.name}.{name}: cannot be estimated, because this scanner has no such parameter")
        return "this kind of scanner has no such parameter"
    if asked == "fix":
        return "held by your choice"
    if asked:
        return None
    if name == _BY_CONVENTION:
        return "held by convention, because it cannot be separated from the boresight; free it by name to estimate it"
    return None if name in MODELS[options.model] else "not in the model"


def _plausible(head: Head, base: Calibration, name: str, options: ParameterOptions) -> float:
    """Return one sigma, SI, by which a parameter may be wrong while it is held; 0: the value is exact.

    The user's sigma counts first, then the one of an earlier calibration, then the plausible one. By convention the
    scan angle's offset is part of roll; parameters that neither the model nor the user names have their installed
    values.
    """
    if name in head.geometry.without:
        return 0.0
    prior = options.priors.get(f"{head.name}.{name}", options.priors.get(name))
    if prior is not None:
        return prior
    if name == _BY_CONVENTION:
        return 0.0
    stated = 0.0 if base.method == "nominal" else float(base.all_sigmas[INDEX[name]])
    if stated > 0.0:
        return stated
    if name in _SCANNER or name in MODELS[options.model] or _asked(head, name, options):
        return PARAMETERS[INDEX[name]].plausible
    return INSTALLED.get(name, 0.0)


def _extras(index: int, head: Head, base: Calibration, options: ParameterOptions) -> Iterator[Unknown]:
    for kind, word, numbers in (
        (SLOT, "range_offset_slot", options.range_offset_slots),
        (ZONE, "range_offset_zone", options.range_offset_zones),
    ):
        for number in numbers:
            name = f"{word}.{number}"
            value = sum(row.offset_m for row in base.range_offsets if _is_own(row, kind, number))
            yield Unknown(index, kind, number, f"{head.name}.{name}", value, _prior(head, name, options))
    if options.ibrc_knots and base.ibrc is not None:
        for knot, value in enumerate(base.ibrc[1].tolist()):
            if knot != _reference(options):
                name = f"ibrc.{knot}"
                yield Unknown(index, KNOT, knot, f"{head.name}.{name}", value, _prior(head, name, options))
    if options.beams and _spins(head):
        for channel in range(1, len(head.geometry.deflection(base).table)):
            for part, kind in BEAM_PARTS.items():
                if part in options.beams:
                    name = f"beam.{channel}.{part}"
                    value = getattr(base.beams.get(channel, BeamCorrection()), part)
                    yield Unknown(
                        index, kind, channel, f"{head.name}.{name}", value, _prior(head, f"beam.{part}", options)
                    )


def _spins(head: Head) -> bool:
    return isinstance(head.geometry, SpinningGeometry | OusterGeometry) and not head.mount.moves


def _is_own(row: RangeOffset, kind: int, number: int) -> bool:
    """Return whether this row is the offset of just this slot or zone, whatever the pulse rate."""
    wanted = (number, None) if kind == SLOT else (None, number)
    return row.prf_hz is None and (row.return_slot, row.mta_zone) == wanted


def _put_offset(offsets: list[RangeOffset], item: Unknown, value: float) -> None:
    own = RangeOffset(value, item.argument) if item.kind == SLOT else RangeOffset(value, None, item.argument)
    offsets[:] = [row for row in offsets if not _is_own(row, item.kind, item.argument)] + [own]


def _reference(options: ParameterOptions) -> int:
    """Return the index of the knot whose correction is 0."""
    if options.ibrc_reference is None:
        return len(options.ibrc_knots) // 2
    return int(np.argmin(np.abs(np.array(options.ibrc_knots) - options.ibrc_reference)))


def _with_knots(calibration: Calibration, options: ParameterOptions) -> Calibration:
    """Return a calibration whose correction by intensity is at the knots of the options and 0 at the reference.

    The correction at the reference moves to the range offset.
    """
    if not options.ibrc_knots:
        return calibration
    knots = np.array(options.ibrc_knots, dtype=np.float64)
    if calibration.ibrc is None:
        return replace(calibration, ibrc=(knots, np.zeros(len(knots))))
    values = np.interp(knots, *calibration.ibrc)
    away = float(values[_reference(options)])
    moved = calibration.changed(range_offset_m=calibration.value("range_offset_m") - away)
    return replace(moved, ibrc=(knots, values - away))


def check_scanners(scanners: Sequence[str], options: ParameterOptions) -> None:
    """Refuse options that name a scanner that is not among these names.

    Raises:
        ParameterError: with the name and the scanners there are.
    """
    for name in sorted({*options.fix, *options.free, *options.priors}):
        scanner, dot, _ = name.partition(".")
        if dot and scanner not in scanners and not name.startswith(EXTRA):
            raise ParameterError(
                f"parameters of {scanner}: this flight has no such scanner; its scanners are {', '.join(scanners)}"
            )


def check_options(flight: Flight, options: ParameterOptions) -> None:
    """Refuse options with unknown names or impossible values before any long computation starts.

    Raises:
        ParameterError: with the name and the values that are possible.
    """
    if options.model not in MODELS:
        raise ParameterError(f"model: got {options.model!r}, want one of {', '.join(MODELS)}")
    heads = [head.name for head in flight.heads]
    check_scanners(heads, options)
    known = set(INDEX) | {f"{head}.{name}" for head in heads for name in INDEX}
    for name in sorted({*options.fix, *options.free} - known):
        raise ParameterError(
            f"{name}: unknown parameter; use one of {', '.join(INDEX)}, or the same with {heads[0]}. before it"
        )
    for name, sigma in options.priors.items():
        if name not in known and not name.split(".", 1)[-1].startswith(EXTRA) and not name.startswith(EXTRA):
            raise ParameterError(f"prior {name}: unknown parameter; use one of {', '.join(INDEX)}")
        if not sigma > 0.0:
            raise ParameterError(f"prior {name}: got {sigma:g}, want a sigma above 0")
    if options.ibrc_knots and (len(options.ibrc_knots) < 2 or bool((np.diff(options.ibrc_knots) <= 0.0).any())):
        raise ParameterError("ibrc_knots: needs at least two increasing intensities")
    for part in sorted(options.beams - BEAM_PARTS.keys()):
        raise ParameterError(f"beams: got {part!r}, want some of {', '.join(BEAM_PARTS)}")
    if options.beams and not any(_spins(head) for head in flight.heads):
        raise ParameterError("beams: this flight has no spinning head on a rigid mount; leave beams out")
