"""Writes the outputs of `swath calibrate`: a calibration file per scanner; if asked, report, record and outcome."""

from __future__ import annotations

import datetime as dt
import hashlib
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from swath import __version__
from swath.calib.calibration_file import CalibrationFileError, Header, calibration_text
from swath.calib.flight import Flight
from swath.calib.need import POINT, Need, need_of
from swath.calib.outcome import Adjusted
from swath.calib.parameters import ANGLES
from swath.calib.profiles.check import Check
from swath.calib.record.record import RecordInput, record_json, record_of, record_xml
from swath.calib.record.values import Plain, utc_text
from swath.calib.strips.cells import StripRules
from swath.calib.strips.differences import differences
from swath.calib.strips.effects import SeenFrom
from swath.calib.strips.signatures import signatures
from swath.calib.summary import Finding, ReportInput
from swath.calib.validation.methods import Asked, validate
from swath.calib.verdict import judge
from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.processing.calibration.console import calibration_lines
from swath.daemon.processing.calibration.inputs import control_places
from swath.daemon.processing.calibration.model import in_words, key_of
from swath.daemon.processing.calibration.record import instruments_of
from swath.daemon.processing.calibration.run import OUTCOME, Calibrated, CalibrationOptions, paths_of
from swath.daemon.processing.carried_verdict import Carried, first_lines, verdict_entry
from swath.daemon.processing.earlier_runs import stale_records
from swath.daemon.processing.files import sha256_of, write_whole
from swath.daemon.processing.flights.read import trajectory_verdicts_of
from swath.daemon.processing.pages.head import NOTHING_KNOWN, PageHead, head_of_flights, headers_words
from swath.daemon.processing.pages.names import PRINTED, REPORT
from swath.daemon.processing.strip_agreement import FlightStrips, before_and_after, difference_map
from swath.daemon.processing.user_errors import finite
from swath.daemon.written import error_words
from swath.georef.arrays import FloatArray
from swath.georef.mapping.chart import chart_of
from swath.georef.progress import Tell
from swath.georef.scanner.calibration import INDEX, PARAMETERS
from swath.georef.verdicts import Level, Verdict

MAP_CELLS = 400  # maximum cells across a map of differences
BEYOND = 3.0  # sigmas, of strips and calibration together, above which strips contradict the calibration


@dataclass(frozen=True)
class Told:
    """The outcome: values for scripts, lines for people, and warnings about files that could not be made."""

    record: dict[str, Any]
    lines: list[str]
    warnings: list[str] = field(default_factory=list)


def write_products(request: CalibrationOptions, done: Calibrated, tell: Tell) -> Told:
    """Write all outputs; files from an earlier run are replaced last.

    Raises:
        UserError: a file cannot be written.
    """
    before, after = before_and_after(done.kept.flight, done.flight, done.kept.logged[0].setup.mapping, tell)
    inputs = _inputs(request, done)
    headers = {name: _header(done, name, inputs) for name in done.adjusted.calibrations}
    tell("checks", 0, 0)
    carried = trajectory_verdicts_of(done.kept.logged)
    findings = (
        *trajectory_says(carried),
        *done.findings,
        *strips_say(done, after.cells.frame.cell_m),
        *validation_says(done),
    )
    report = replace(_report(request, done, headers, before, after, inputs), findings=findings)
    verdict = judge(report)
    source = done.kept.logged[0].source
    headers = {
        name: replace(_judged(header, done, name, verdict), trajectory=source) for name, header in headers.items()
    }
    try:
        texts = {name: calibration_text(_named(done, name, headers), header) for name, header in headers.items()}
    except CalibrationFileError as error:
        raise UserError(str(error)) from error
    files: dict[Path, bytes] = {path: texts[name].encode() for name, path in paths_of(request, headers).items()}
    record = _record(done, headers, before, after, inputs) | {
        "model": in_words(request.model),
        "ibrc_knots": list(request.model.ibrc_knots),
        "verdict": _verdict_entry(verdict),
        "need": _need_entry(report.need),
        "carried": verdict_entry(carried, accepted=request.logs.accept_verdict),
    }
    warnings: list[str] = []
    stale: list[Path] = []
    if request.report is not None:
        stale = stale_records(request.report / OUTCOME, headers.keys())
        tell("report", 0, 0)
        head = head_of_flights(done.kept.logged, headers_words(headers, verdict.level.words))
        files |= pages(request.report, _with_profiles(report, done), warnings, head)
        files |= _records(request.report, done, report, request.facts)
        files[request.report / OUTCOME] = (json.dumps(record, indent=2) + "\n").encode()
    _write(files)
    printed = None if request.report is None else (request.report / REPORT).with_suffix(PRINTED)
    if printed is not None and printed not in files:
        printed.unlink(missing_ok=True)  # of an earlier run
    for path in stale:
        path.unlink(missing_ok=True)
    written = [str(path) for path in files]
    lines = calibration_lines(done, report, request.model.ibrc_knots, (before, after), verdict)
    return Told(record | {"files": written}, [*first_lines(record["carried"]), *lines, *written], warnings)


def trajectory_says(carried: Sequence[Carried]) -> list[Finding]:
    """Return the verdicts on the trajectories as the first findings: parameters absorbed the trajectories' errors."""
    change = "correct the trajectory, then calibrate again"
    return [Finding(one.sentence, change, math.inf, unusable=one.level is Level.UNUSABLE) for one in carried]


def strips_say(done: Calibrated, cell_m: float) -> list[Finding]:
    """Return effects that strips still show and that neither their sigmas nor the calibration's explain.

    Args:
        done: the calibration's outcome.
        cell_m: side of the cells in which strips are compared.
    """
    seen = signatures(differences(done.flight, StripRules(cell_m=cell_m)).checks, SeenFrom.of(done.flight), done.prior)
    found = []
    for one in seen.found:
        if one.level != "significant":
            continue
        known = max(float(each.all_sigmas[INDEX[one.effect.parameter]]) for each in done.adjusted.calibrations.values())
        excess = abs(one.value) / (BEYOND * math.hypot(one.sigma, known))
        if excess > 1.0:
            change = (
                "run swath strips: one strip may differ from all others, the trajectory may be bad, or the strips "
                "may be too few to separate effects"
            )
            found.append(Finding(f"strips still show this effect: {one.words}", change, excess))
    return found


def validation_says(done: Calibrated) -> list[Finding]:
    """Return the tests of a validation that the calibration fails on its own planes and control.

    The calibration was adjusted to these observations, so a failed test counts all the more.
    """
    asked = Asked(done.control or None)
    outcome = validate(done.flight, done.features, done.adjusted.calibrations, asked, done.prior)
    change = "run swath validate: its planes and pairs show where the calibration does not hold"
    return [Finding(f"validation: {one.sentence}", change) for one in outcome.methods if one.passed is False]


def _judged(header: Header, done: Calibrated, name: str, verdict: Verdict) -> Header:
    """Return the header with the verdict on the calibration, and the requested parameters of this scanner that were
    held.
    """
    held = tuple(key_of(one.name)[0] for one in done.adjusted.held if one.scanner == name and one.name in INDEX)
    reasons = tuple(one_line(reason.what) for reason in verdict.reasons)
    return replace(header, verdict=verdict.level.words, verdict_reasons=reasons, held=held)


def _named(done: Calibrated, name: str, headers: Mapping[str, Header]) -> Any:
    return replace(done.adjusted.calibrations[name], id=headers[name].id, method=headers[name].method)


def _write(files: Mapping[Path, bytes]) -> None:
    try:
        write_whole(files)
    except OSError as error:
        raise UserError(error_words(error, error.filename or "output"), ExitCode.IO) from error


def _inputs(request: CalibrationOptions, done: Calibrated) -> list[tuple[str, str]]:
    """Return name and SHA-256 of every input file, logs first."""
    paths = [part.path for flight in done.kept.logged for part in flight.session.parts]
    control = None if request.control is None else request.control.path
    given = (request.logs.trajectory.file, control, request.ties, request.polygons, request.model_file)
    paths += [path for path in given if path is not None]
    return [(path.name, sha256_of(path)) for path in paths]


def _header(done: Calibrated, name: str, inputs: list[tuple[str, str]]) -> Header:
    now = dt.datetime.now(dt.UTC).replace(microsecond=0)
    found = done.adjusted.calibrations[name]
    digest = hashlib.sha256(found.parameters.tobytes() + "".join(sha for _, sha in inputs).encode()).hexdigest()
    # a session may lack a scanner: its settings are those of its first session, as for the heads
    config = next(flight.setup.config for flight in done.kept.logged if name in flight.setup.scanners)
    table = config.scanner[name]
    logs = tuple(entry for entry in inputs if entry[0].endswith(".mcap"))
    return Header(
        id=f"{now:%Y-%m-%dT%H:%M:%SZ}-{digest[:4]}",
        created=now,
        flown=_flown(done),
        method=method_of(done),
        scanner_model=table.model,
        scanner_serial=table.serial,
        installation=config.profile.installation,
        logs=logs,
        variance_factor=done.adjusted.variance_factor,
        redundancy=done.adjusted.redundancy,
    )


def _flown(done: Calibrated) -> dt.datetime | None:
    """Return the time of the first return used, as `CA_Frames.timeRecording` of the record has it, to the second."""
    starts = [int(swath.time_ns[0]) for swath in done.flight.swaths if len(swath)]
    return dt.datetime.fromisoformat(utc_text(min(starts))).replace(microsecond=0) if starts else None


def method_of(done: Calibrated) -> str:
    """Return the word that a calibration file uses for the kinds of observations it was made from."""
    kinds = {"control" if plane.control else "planes" for plane in done.features.planes}
    kinds |= {"tie_points" for _ in done.features.ties[:1]}
    return kinds.pop() if len(kinds) == 1 else "combined"


def _record(
    done: Calibrated,
    headers: Mapping[str, Header],
    before: FlightStrips,
    after: FlightStrips,
    inputs: list[tuple[str, str]],
) -> dict[str, Any]:
    """Return the outcome as values for scripts."""
    adjusted = done.adjusted
    return {
        "format": "swath.calibration",
        "version": 1,
        "software": f"swath {__version__}",
        "calibrations": {name: header.id for name, header in headers.items()},
        "unknowns": [
            {"name": name, "start": start, "value": value, "sigma": sigma}
            for name, start, value, sigma in zip(
                adjusted.names,
                adjusted.start.tolist(),
                adjusted.values.tolist(),
                adjusted.sigmas.tolist(),
                strict=True,
            )
        ],
        "correlation": adjusted.correlation.tolist(),
        "held": [
            {"scanner": one.scanner, "name": one.name, "why": one.why, "remedy": one.remedy} for one in adjusted.held
        ],
        "considered": [_considered_entry(adjusted, column) for column in range(len(adjusted.considered))],
        "prealigned": {
            name: {angle: found.value(angle) for angle in ANGLES} for name, found in done.prealigned.items()
        },
        "variance_factor": adjusted.variance_factor,
        "redundancy": adjusted.redundancy,
        "global_test": adjusted.global_test,
        "iterations": adjusted.iterations,
        "matchings": adjusted.matchings,
        "groups": [
            {"group": group.group, "observations": group.observations, "variance_factor": group.variance_factor}
            for group in adjusted.groups
        ],
        "strips": {"before": strips_entry(before), "after": strips_entry(after)},
        "profiles": profiles_entry(done.check),
        "control": _control_entry(done),
        "refused": dict(done.features.refused),
        "notes": list(done.notes),
        "inputs": [{"name": name, "sha256": digest} for name, digest in inputs],
    }


def _control_entry(done: Calibrated) -> list[dict[str, Any]]:
    """Return place and residual of every control point that was used: how far the laser lies above it; SI."""
    places = control_places(done.control, done.flight, done.kept.logged[0].setup.mapping)
    return [
        {"name": one.name, "laser_above_m": -one.misclosure_m, "sigma_m": one.sigma_m, "normalised": one.normalised}
        | places.get(one.name, {})
        for one in done.adjusted.control
    ]


def _considered_entry(adjusted: Adjusted, column: int) -> dict[str, Any]:
    """Return a held parameter, its sigma, and by how much one sigma moves each estimated one; SI."""
    one, moved = adjusted.considered[column], adjusted.movements[:, column]
    estimate = {"told": one.told, "told_sigma": one.told_sigma} if math.isfinite(one.told) else {}
    moves = dict(zip(adjusted.names, moved.tolist(), strict=True))
    return {
        "scanner": one.scanner,
        "name": one.name,
        "value": one.value,
        "sigma": one.sigma,
        **estimate,
        "moves": moves,
    }


def _need_entry(need: Need | None) -> dict[str, Any] | None:
    """Return the wanted accuracy and the errors that the calibration leaves in points; SI."""
    return None if need is None else finite(asdict(need))


def strips_entry(strips: FlightStrips) -> dict[str, Any]:
    """Return height differences of all pairs together and of each pair, and the quality level that follows."""
    numbers = strips.agreement.numbers or {}
    every = {"n": numbers.get("cells", 0)} | {key: numbers.get(key) for key in ("mean_m", "std_m", "rms_m")}
    pairs = [
        {"first": first, "second": second, "n": one.count, "mean_m": one.mean_m, "std_m": one.std_m, "rms_m": one.rms_m}
        for (first, second), one in strips.pairs().items()
    ]
    return {"all": every, "pairs": pairs, "quality": finite(strips.agreement.record())}


def profiles_entry(check: Check) -> dict[str, Any]:
    """Return how profiles compare with the adjustment, and each profile; SI."""
    profiles = [
        {
            "kind": one.kind,
            "scanner": one.scanner,
            "strips": list(one.names),
            "separation_m": one.separation_m,
            "baseline_m": one.baseline_m,
            "found": one.found,
            "pieces": one.pieces,
            "formula": one.formula,
        }
        for one in check.profiles
    ]
    compared = [asdict(one) | {"normalised": one.normalised} for one in check.comparisons]
    missing = [{"scanner": scanner, "kind": kind, "why": why} for (scanner, kind), why in check.missing.items()]
    return {"comparisons": compared, "missing": missing, "profiles": profiles}


def _verdict_entry(verdict: Verdict) -> dict[str, Any]:
    reasons = [{"level": one.level.name.lower(), "what": one.what, "remedy": one.change} for one in verdict.reasons]
    return {"level": verdict.level.name.lower(), "sentence": verdict.sentence, "reasons": reasons}


def _report(
    request: CalibrationOptions,
    done: Calibrated,
    headers: Mapping[str, Header],
    before: FlightStrips,
    after: FlightStrips,
    inputs: list[tuple[str, str]],
) -> ReportInput:
    mapping = done.kept.logged[0].setup.mapping
    return ReportInput(
        flight=done.flight,
        features=done.features,
        adjusted=done.adjusted,
        headers=headers,
        before=before.pairs(),
        after=after.pairs(),
        differences=difference_map(before, after, MAP_CELLS, in_t=mapping is None),
        measure=after.agreement.measure,
        level=after.agreement.level_words,
        prealigned=done.prealigned,
        chart=chart_of(mapping, _positions_e(done.flight)),
        check=done.check,
        inputs=inputs,
        settings=_settings(request, done),
        need=need_of(done.flight, done.adjusted.calibrations, done.adjusted.trajectory, _wanted(done)),
        notes=[note for note in done.notes if note not in done.adjusted.notes],  # which the report has anyway
    )


def _positions_e(flight: Flight) -> FloatArray:
    """Return some positions of all trajectories."""
    return np.concatenate([one.position_e[:: max(1, len(one.position_e) // 200)] for one in flight.trajectories])


def _wanted(done: Calibrated) -> dict[str, float]:
    """Return the accuracies that the configuration asks for, SI, by parameter's name."""
    factors = {parameter.key: (parameter.name, parameter.factor) for parameter in PARAMETERS} | {
        "point_m": (POINT, 1.0)
    }
    wanted = done.kept.logged[0].setup.config.calibration.wanted.model_dump(exclude_none=True)
    return {factors[key][0]: sigma * factors[key][1] for key, sigma in wanted.items()}


def _with_profiles(report: ReportInput, done: Calibrated) -> ReportInput:
    from swath.daemon.processing.calibration.report.profiles import pictures

    return replace(report, profiles=pictures(done.check, done.kept.flight, done.control))


def pages(folder: Path, report: ReportInput, warnings: list[str], head: PageHead = NOTHING_KNOWN) -> dict[Path, bytes]:
    """Return the report as HTML and PDF; where this computer cannot make a PDF, add a warning instead."""
    from swath.daemon.processing.calibration.report.page import html, paper_page
    from swath.daemon.processing.pages.pdf import page_files

    return page_files(folder / REPORT, html(report, head), warnings, paper_page(report, head))


def _records(folder: Path, done: Calibrated, report: ReportInput, facts: Mapping[str, Plain]) -> dict[Path, bytes]:
    """Return per scanner a record as XML and JSON with its matrices."""
    files = {}
    for name, header in report.headers.items():
        matrices, known = f"{name}.record.npz", instruments_of(done.kept)
        one = RecordInput(
            done.flight, done.features, done.adjusted, name, header, facts, report.settings, matrices, known
        )
        record = record_of(one)
        files[folder / f"{name}.record.xml"] = record_xml(record).encode()
        files[folder / f"{name}.record.json"] = record_json(record).encode()
        files[folder / matrices] = _npz(record.arrays())
    return files


def _npz(arrays: Mapping[str, Any]) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def _settings(request: CalibrationOptions, done: Calibrated) -> dict[str, str]:
    air = done.kept.logged[0].setup.config.atmosphere
    return {
        "Swath": __version__,
        "model": in_words(request.model),
        "observed": ", ".join(request.observe) + (", control" if done.control else ""),
        "trajectory": "; ".join(trajectory.name for trajectory in done.flight.trajectories),
        "trajectory errors": "; ".join(done.prior.notes) or f"{len(done.prior)} knots",
        "atmosphere": f"ranges {air.ranges}, refraction {air.refraction}",
    }
