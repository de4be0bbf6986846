"""Writes the outputs of `swath strips --adjust`: each log's corrected trajectory, and a record of the corrections."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from swath import __version__
from swath.calib.labels import decimals_of, number, with_sigma
from swath.calib.strips.corrections import NONE, Settings, StripChoice
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.calibration.products import Told, strips_entry
from swath.daemon.processing.carried_verdict import ADJUSTMENT, first_lines, trajectory_entry
from swath.daemon.processing.files import gone_on_failure, put_in_place, sha256_of, write_aside
from swath.daemon.processing.flights.read import Flight as LoggedFlight
from swath.daemon.processing.flights.read import verdict_of
from swath.daemon.processing.strips.adjust import AdjustOptions, StripsCorrected, files_of
from swath.daemon.processing.trajectory.files import write_trajectory
from swath.daemon.processing.trajectory.summary import write_json
from swath.daemon.processing.user_errors import finite
from swath.daemon.written import error_words, remove_empty_folders
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.progress import Tell
from swath.georef.trajectory.trajectory import Trajectory

WHAT = (
    "Correction of the trajectory by strips (ISO/TS 19159-2, 6.3.3). No calibration: the scanners' parameters were "
    "held. Corrections were added to the trajectory: position north, east, down, then small turns of the body about "
    "these axes."
)
KEPT = "velocities and sigmas of the trajectories are unchanged"
AXES = ("north", "east", "down")
COMPONENTS = ("along", "across", "down", "roll", "pitch", "heading")
CM, MDEG = 100.0, 1e3 * math.degrees(1.0)
FACTORS = (CM, CM, CM, MDEG, MDEG, MDEG)  # of the components' units on the console
WIDTH = 16
NOT_DETERMINED = "not determined"


def write_adjustment(request: AdjustOptions, done: StripsCorrected, tell: Tell) -> Told:
    """Write all files, the record last: a folder with a record is complete.

    Raises:
        UserError: a file cannot be written; no file is left then.
    """
    tell("trajectories", 0, 0)
    files = [files_of(request, flight) for flight in done.kept.logged]
    written: list[tuple[Path, Path]] = []
    try:
        with gone_on_failure(written):
            for flight, own, trajectory in zip(done.kept.logged, files, done.adjusted.trajectories, strict=True):
                written += write_trajectory(own, _as_given(flight, trajectory), None)
            record = finite(_record(request, done, written))
            path = request.output / ADJUSTMENT
            written.append((write_aside(path, partial(write_json, record)), path))
        put_in_place(written)
    except OSError as error:
        remove_empty_folders()
        raise UserError(error_words(error, request.output), ExitCode.IO) from error
    paths = [str(path) for _, path in written]
    return Told(record | {"files": paths}, [*first_lines(record["verdict"]), *_lines(done), *paths])


def _as_given(flight: LoggedFlight, trajectory: Trajectory) -> Trajectory:
    """Return the trajectory with its attitude referred back to the log's own vertical; reading turns it to the
    ellipsoid's normal.
    """
    if flight.setup.deflection_rad is None:
        return trajectory
    xi_rad, eta_rad = flight.setup.deflection_rad
    return trajectory.with_deflection(-xi_rad, -eta_rad)


# ---------------------------------------------------------------------- for scripts


@dataclass(frozen=True, eq=False)
class _Strip:
    """A strip's corrections, and its distance from other strips before and after.

    Attributes:
        choice: its model, and the means of its corrections in its own axes.
        time_ns: (k,) times of its knots.
        corrections, sigmas, priors: (k, 6) north, east, down, metres, turns about these, rad; sigmas after and before.
        before_m, after_m: RMSDz; nan: no other strip overlaps it.
    """

    choice: StripChoice
    time_ns: Int64Array
    corrections: FloatArray
    sigmas: FloatArray
    priors: FloatArray
    before_m: float
    after_m: float

    @property
    def is_corrected(self) -> bool:
        """True if the strip has a correction."""
        return self.choice.model != NONE

    def words(self, component: int) -> str:
        """Return the correction of a component with its sigma, or why there is none."""
        own, factor = self.choice.components, FACTORS[component]
        if own.datum[component]:
            return "datum"
        if not own.determined[component]:
            return NOT_DETERMINED
        if not self.is_corrected:
            return "0"
        value, sigma = factor * float(own.mean[component]), factor * float(own.sigma[component])
        return with_sigma(value, sigma)

    def reason(self, component: int) -> str | None:
        """Return why a component has no correction; None: it has one."""
        own = self.choice.components
        if own.datum[component]:
            return "without control this strip holds the datum"
        if own.outweighed[component]:
            factor, unit = FACTORS[component], "cm" if component < len(AXES) else "mdeg"
            size = factor * float(own.of_calibration[component])
            return f"{NOT_DETERMINED}: errors of the held calibration move it by {size:.0f} {unit}"
        if not own.determined[component]:
            share = 100.0 * (1.0 - math.sqrt(max(1.0 - float(own.redundancy[component]), 0.0)))
            return f"{NOT_DETERMINED}: the returns reduce the prior sigma by {share:.0f} %, and 75 % are needed"
        return None if self.is_corrected else "the strip agrees with the others without a correction"


def _strips(done: StripsCorrected) -> Iterator[_Strip]:
    fit = done.adjusted.fit
    corrections = np.concatenate([fit.position_l, fit.attitude_rad], axis=1)
    sigmas = np.concatenate([fit.position_sigma_l, fit.attitude_sigma_rad], axis=1)
    priors = np.concatenate([fit.prior_position_sigma_l, fit.prior_attitude_sigma_rad], axis=1)
    for choice in done.adjusted.choices:
        mine = (fit.trajectory_index == choice.trajectory_index) & (fit.strip == choice.strip)
        names = {swath.name for swath in done.kept.flight.swaths if swath.strip == choice.strip}
        own = (fit.time_ns[mine], corrections[mine], sigmas[mine], priors[mine])
        yield _Strip(choice, *own, done.before.rms_of(names), done.after.rms_of(names))


def _record(request: AdjustOptions, done: StripsCorrected, written: list[tuple[Path, Path]]) -> dict[str, Any]:
    adjusted, settings = done.adjusted, request.settings
    heads = done.kept.flight.heads
    inputs = [part.path for flight in done.kept.logged for part in flight.session.parts]
    control = None if request.control is None else request.control.path
    inputs += [path for path in (request.logs.trajectory.file, control) if path is not None]
    inputs += [Path(file) for _, file in request.logs.options.calibrations.values()]
    return {
        "format": "swath.strip-adjustment",
        "version": 1,
        "software": f"swath {__version__}",
        "what": f"{WHAT} {KEPT[0].upper()}{KEPT[1:]}.",
        "verdict": verdict_of(request.logs, done.kept.logged),
        "flights": [
            {
                "session": flight.session.session_id,
                "trajectory": trajectory_entry(trajectory, flight.source, flight.trajectory_verdicts),
            }
            for flight, trajectory in zip(done.kept.logged, done.adjusted.trajectories, strict=True)
        ],
        "calibrations_held": {head.name: head.start.id for head in heads},
        "strip_model": request.model,
        "settings": asdict(settings),
        "strips": [_strip_entry(done, strip) for strip in _strips(done)],
        "planes": len(done.features.planes),
        "control": sum(len(plane.control) for plane in done.features.planes),
        "observations": adjusted.observations,
        "parameters_determined": adjusted.parameters,
        "variance": {"before": adjusted.variance_before, "after": adjusted.variance_after},
        "differences": {"before": strips_entry(done.before), "after": strips_entry(done.after)},
        "refused": dict(done.features.refused),
        "notes": [*done.notes, KEPT],
        "inputs": [{"name": path.name, "sha256": sha256_of(path)} for path in inputs],
        "trajectories": [{"name": path.name, "sha256": sha256_of(aside)} for aside, path in written],
    }


def _strip_entry(done: StripsCorrected, strip: _Strip) -> dict[str, Any]:
    """Return a strip's entry in the record; an uncorrected strip has no corrections and no sigmas."""
    knots = zip(strip.time_ns.tolist(), strip.corrections, strip.sigmas, strip.priors, strict=True)
    means = (strip.corrections.mean(axis=0), strip.sigmas.mean(axis=0), strip.priors.mean(axis=0))
    return {
        "strip": strip.choice.strip,
        "log": done.kept.logged[strip.choice.trajectory_index].log.name,
        "model": strip.choice.model,
        "criterion_gains": dict(strip.choice.gains),
        "course_deg": math.degrees(strip.choice.course_rad) % 360.0,
        "components": {name: _component_entry(done, strip, at) for at, name in enumerate(COMPONENTS)},
        "rms_dz_m": {"before": strip.before_m, "after": strip.after_m},
        "mean": _named(*means) if strip.is_corrected else None,
        "knots": [{"gps_ns": time_ns} | _named(*values) for time_ns, *values in knots] if strip.is_corrected else [],
    }


def _component_entry(done: StripsCorrected, strip: _Strip, at: int) -> dict[str, Any]:
    """Return the mean correction along the strip's own axes, m or degrees; null with the reason if there is none."""
    own, reason = strip.choice.components, strip.reason(at)
    settings, unit = done.settings, 1.0 if at < len(AXES) else math.degrees(1.0)
    return {
        "unit": "m" if at < len(AXES) else "deg",
        "determined": bool(own.determined[at]),
        "correction": None if reason else unit * float(own.mean[at]),
        "sigma": unit * float(own.sigma[at]),
        "sigma_of_calibration": unit * float(own.of_calibration[at]),
        "prior_sigma": unit * (settings.position_m if at < len(AXES) else settings.turn_rad),
        "redundancy": float(own.redundancy[at]),
        "contains": [name for other, name in enumerate(COMPONENTS) if own.absorbs[at, other]],
        "reason": reason,
    }


def _named(*sixes: FloatArray) -> dict[str, float]:
    """Return a correction (6,), its sigmas and prior sigmas by names with units."""
    entry: dict[str, float] = {}
    for prefix, six in zip(("", "sigma_", "prior_sigma_"), sixes, strict=True):
        entry |= {f"{prefix}{axis}_m": float(value) for axis, value in zip(AXES, six[:3], strict=True)}
        turns = np.degrees(six[3:])
        entry |= {f"{prefix}turn_{axis}_deg": float(value) for axis, value in zip(AXES, turns, strict=True)}
    return entry


# ---------------------------------------------------------------------- for people


def _lines(done: StripsCorrected) -> list[str]:
    adjusted, strips = done.adjusted, list(_strips(done))
    held = ", ".join(f"{head.name} {head.start.id}" for head in done.kept.flight.heads)
    titles = [f"{name} {'cm' if at < len(AXES) else 'mdeg'}" for at, name in enumerate(COMPONENTS)]
    lines = [f"correction of the trajectory, no calibration; held: {held}"]
    lines.append(f"{'strip':<7}{'model':<10}" + "".join(f"{title:>{WIDTH}}" for title in (*titles, "RMSDz cm")))
    lines += [_row(strip) for strip in strips]
    control = sum(len(plane.control) for plane in done.features.planes)
    lines.append(
        f"{len(done.features.planes)} planes"
        + (f", {control} of {len(done.control)} control points" if done.control else "")
        + f"; misclosures {math.sqrt(adjusted.variance_before):.2f} → {math.sqrt(adjusted.variance_after):.2f} sigmas"
    )
    rms = [100.0 * strips.rms_m for strips in (done.before, done.after)]
    lines.append(f"all strips: RMSDz {number(rms[0], '.1f')} → {number(rms[1], '.1f')} cm")
    return [*lines, *_legend(done.settings, strips), *(f"note: {note}" for note in (*done.notes, KEPT))]


def _legend(settings: Settings, strips: Sequence[_Strip]) -> list[str]:
    """Return what the words of the table mean, as far as it has them."""
    shown = {strip.words(at) for strip in strips for at in range(len(COMPONENTS))}
    lines = []
    if NOT_DETERMINED in shown:
        lines.append(
            f"{NOT_DETERMINED}: the returns leave more than a quarter of the prior sigma of "
            f"{CM * settings.position_m:.0f} cm or {MDEG * settings.turn_rad:.0f} mdeg, or the held calibration may be "
            "off by more than it; the component is not corrected"
        )
    if "0" in shown:
        lines.append("0: the strip agrees with the others without a correction")
    parts = np.array([strip.choice.components.of_calibration for strip in strips]).max(axis=0)
    if parts.any():
        sizes = [
            f"{name} {number(factor * part, f'.{decimals_of(factor * part)}f')} {'cm' if at < len(AXES) else 'mdeg'}"
            for at, (name, factor, part) in enumerate(zip(COMPONENTS, FACTORS, parts.tolist(), strict=True))
            if part > 0.0
        ]
        lines.append(f"sigmas contain errors of the held calibration: at most {', '.join(sizes)}")
    for strip in strips:
        own = strip.choice.components
        for at, name in enumerate(COMPONENTS):
            if merged := [other for number, other in enumerate(COMPONENTS) if own.absorbs[at, number]]:
                lines.append(
                    f"strip {strip.choice.strip:02d}: {name} contains {' and '.join(merged)}, because the returns show "
                    "only their sum"
                )
    return lines


def _row(strip: _Strip) -> str:
    """Return a line of means along the strip, in its own axes."""
    columns = [strip.words(at) for at in range(len(COMPONENTS))]
    columns.append(f"{100 * strip.before_m:.1f} → {100 * strip.after_m:.1f}" if math.isfinite(strip.after_m) else "–")
    return f"{strip.choice.strip:02d}     {strip.choice.model:<10}" + "".join(f"{one:>{WIDTH}}" for one in columns)
