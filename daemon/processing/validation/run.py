"""`swath validate`: validates a calibration against logs, control and its own history."""

from __future__ import annotations

import datetime as dt
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from swath.calib.adjust import adjust
from swath.calib.control.points import ControlError, control_planes
from swath.calib.equations.normals import NormalError
from swath.calib.equations.trajectory_prior import TrajectoryPrior
from swath.calib.features import ControlPoint, Features
from swath.calib.flight import Flight, FlightError
from swath.calib.labels import number, with_sigma
from swath.calib.parameters import ParameterOptions as Model
from swath.calib.planes.fit import PlaneError
from swath.calib.planes.search import find_planes
from swath.calib.record.record import Document
from swath.calib.validation.history import BORESIGHT, History, HistoryError, history
from swath.calib.validation.methods import (
    SIGMAS_DEG,
    SIGMAS_M,
    Asked,
    Method,
    Validation,
    same_logs,
    validate,
    with_sigmas,
)
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.log.reader import Session
from swath.daemon.processing.calibration.inputs import control_of, control_places
from swath.daemon.processing.calibration.returns import (
    KeptFlight,
    check_space_to_keep,
    read_flight,
    refuse_installations,
    replaced,
)
from swath.daemon.processing.calibration.run import PLANES, prior_of
from swath.daemon.processing.carried_verdict import Carried, first_lines, refusal, told_before, verdict_entry
from swath.daemon.processing.control.files import ControlFile
from swath.daemon.processing.files import sha256_of, write_whole
from swath.daemon.processing.flights.read import GeorefOptions, verdicts_of
from swath.daemon.processing.pages.head import NOTHING_KNOWN, PageHead, calibrations_words, head_of_flights
from swath.daemon.processing.pages.names import HISTORY_PICTURE, PRINTED, VALIDATION
from swath.daemon.processing.pages.pdf import page_files
from swath.daemon.processing.setup.setup import Setup
from swath.daemon.processing.user_errors import as_user_error, finite
from swath.daemon.processing.validation.page import validation_page
from swath.daemon.processing.validation.record import record_files, records_of
from swath.daemon.text_files import text_of
from swath.daemon.written import error_words
from swath.georef.mapping.frame import MappingError
from swath.georef.progress import Tell
from swath.georef.scanner.calibration import Calibration, CalibrationError, read_calibration
from swath.georef.strips import StripError
from swath.georef.text_encoding import decoded

INK, MUTED, COLOURS = "#1d242b", "#5d6770", ("#0072b2", "#d55e00", "#009e73")
DPI, DAY_S = 140, 86_400.0

RECORD = "validation.json"
REFUSED = (FlightError, PlaneError, HistoryError, StripError, MappingError, CalibrationError, ControlError)


@dataclass(frozen=True)
class ValidationOptions:
    """The options of `swath validate` from the command line.

    Attributes:
        calibrations: files to be validated, one per scanner.
        logs: which logs are read and how; their calibrations are replaced by those above.
        control: file of surveyed points; None: no control.
        histories: calibration files, or folders of them.
        anew: estimate parameters anew from the logs and compare them.
        output: folder for results, the picture and updated records; None: no files.
        record: record, or folder of records, to add the validation to; None: beside the calibration files.
    """

    calibrations: Sequence[Path]
    logs: GeorefOptions
    control: ControlFile | None = None
    histories: Sequence[Path] = ()
    anew: bool = False
    output: Path | None = None
    record: Path | None = None


@dataclass(frozen=True)
class Validated:
    """The outcome: a record for scripts, lines for people, the problem in a line (empty: no problem), and warnings."""

    record: dict[str, Any]
    lines: list[str]
    problem: str
    warnings: list[str] = field(default_factory=list)


@dataclass
class _Found:
    calibrations: dict[str, Calibration]
    validation: Validation | None = None
    histories: tuple[History, ...] = ()
    logs: list[tuple[str, str]] = field(default_factory=list)
    documents: Mapping[str, Document] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    carried: list[Carried] = field(default_factory=list)
    head: PageHead = NOTHING_KNOWN
    warnings: list[str] = field(default_factory=list)
    control: list[dict[str, Any]] = field(default_factory=list)


def run_validation(request: ValidationOptions, folder: Path, told: Tell) -> Validated:
    """Run a validation and write its results.

    Args:
        request: options of the validation.
        folder: temporary folder for returns.
        told: called with the progress.

    Raises:
        UserError: the validation cannot be done; one line.
    """
    with as_user_error(folder, *REFUSED):
        calibrations = [read_file(path) for path in request.calibrations]
        found = _Found({one.scanner: one for one in calibrations})
        found.head = PageHead(calibrations=calibrations_words(found.calibrations))
        if request.histories:
            found.histories = _histories(request.histories, calibrations)
        if request.logs.logs:
            if request.output is not None:
                recorded = records_of(list(zip(request.calibrations, calibrations, strict=True)), request.record)
                found.documents, found.notes = recorded.documents, list(recorded.notes)
            _against_logs(request, found, folder, told)
    return _written(request, found)


def read_file(path: Path) -> Calibration:
    """Return the calibration in a file; refuse with `UserError` a file that cannot be read."""
    try:
        return read_calibration(text_of(path, "a calibration file"), str(path))
    except CalibrationError as error:
        raise UserError(str(error), ExitCode.USAGE) from error


def _histories(paths: Sequence[Path], validated: Sequence[Calibration]) -> tuple[History, ...]:
    """Return the histories of the scanners and installations that are validated."""
    files = [one for path in paths for one in (sorted(path.rglob("*.toml")) if path.is_dir() else [path])]
    entries = [entry for path in files if (entry := _entry(path, paths)) is not None]
    read = {one.id: one for one in [*entries, *validated]}
    wanted = {(one.scanner, one.header.get("installation")) for one in validated}
    own = [one for one in read.values() if (one.scanner, one.header.get("installation")) in wanted]
    return history(own)


def _entry(path: Path, named: Sequence[Path]) -> Calibration | None:
    """Return a file's calibration; None for a file of a folder that is not one, as configurations are TOML too."""
    if path in named or "[calibration]" in decoded(path.read_bytes(), "replace"):
        return read_file(path)
    return None


def _against_logs(request: ValidationOptions, found: _Found, folder: Path, told: Tell) -> None:
    def check(sessions: Sequence[Session], setups: Sequence[Setup]) -> None:
        if request.control is not None:
            request.control.place(sessions, setups)
        check_space_to_keep(folder.parent, int(request.anew), sessions, setups)

    kept = read_flight(request.logs, folder, told, check)
    refuse_installations(kept.logged)
    found.carried += verdicts_of(kept.logged)
    found.head = head_of_flights(kept.logged, calibrations_words(found.calibrations))
    with told_before(found.carried, *REFUSED):
        _against_flight(request, found, kept, folder, told)


def _against_flight(request: ValidationOptions, found: _Found, kept: KeptFlight, folder: Path, told: Tell) -> None:
    _refuse_others(request, found, kept)
    flight = kept.flight
    points, notes = (None, []) if request.control is None else control_of(request.control, flight, ["shift"])
    named = sorted(found.calibrations)
    found.notes += _assumed(kept)
    _along(kept, found)
    planes = find_planes(flight, tell=told)
    if not planes.planes:
        raise UserError(
            f"{request.logs.logs[0]}: no two strips see a common plane; a validation needs strips that overlap"
        )
    anew, why_not = _anew(request, found, kept, points or (), folder, told) if request.anew else (None, "")
    told("tests", 0, 0)
    asked = Asked(points, anew, why_not, named)
    validation = validate(flight, planes, found.calibrations, asked, _prior(kept))
    paths = [part.path for logged in kept.logged for part in logged.session.parts]
    found.logs = [(path.name, sha256_of(path)) for path in paths]
    dependent = tuple(line for one in found.calibrations.values() for line in same_logs(one, found.logs))
    found.validation = replace(validation, dependent=dependent)
    found.control = _control_entry(validation, control_places(points or (), flight, kept.logged[0].setup.mapping))
    found.notes += [*kept.notes, *notes]


def _control_entry(validation: Validation, places: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """Return place and residual of every control point: how far the laser lies above it, mean of its sights; SI."""
    residuals = [found for one in validation.methods for found in one.more.get("residuals_m", {}).items()]
    return [
        {"name": name, "laser_above_m": sum(values) / len(values), "sights": len(values)} | places.get(name, {})
        for name, values in residuals
    ]


def _refuse_others(request: ValidationOptions, found: _Found, kept: KeptFlight) -> None:
    """Refuse with `UserError` logs without the calibrations' scanners or with one strip; note odd installations."""
    scanners = {head.name for head in kept.flight.heads}
    log = kept.logged[0].log
    for name, calibration in found.calibrations.items():
        if name not in scanners:
            raise UserError(
                f"{log}: has no scanner {name}, to which calibration {calibration.id} belongs; it has "
                f"{sorted(scanners)}"
            )
        made, installation = (
            calibration.header.get("installation", ""),
            kept.logged[0].setup.config.profile.installation,
        )
        if made and installation and made != installation:
            found.notes.append(
                f'{log}: was recorded with installation "{installation}", but calibration {calibration.id} '
                f'belongs to "{made}"'
            )
    if len({(swath.trajectory_index, swath.strip) for swath in kept.flight.swaths}) < 2:
        raise UserError(f"{log}: has one strip only; a validation needs at least two strips that overlap")


def _along(kept: KeptFlight, found: _Found) -> None:
    """Add the log's own calibration for scanners without a named one, with a note."""
    for head in kept.flight.heads:
        if head.name not in found.calibrations:
            found.calibrations[head.name] = head.start
            note = (
                f"{kept.logged[0].log}: {head.name}: no calibration was given; its own calibration {head.start.id} is "
                "used"
            )
            found.notes.append(note)


def _prior(kept: KeptFlight) -> TrajectoryPrior | None:
    """Return the trajectory's errors from navigation; None if a trajectory was given, which has sigmas at most."""
    navigated = [flight.navigated for flight in kept.logged]
    if any(one is None or len(one.legs) != 1 for one in navigated):
        return None
    return prior_of(kept)


def _assumed(kept: KeptFlight) -> list[str]:
    """Return a note for each trajectory that has no sigmas."""
    filled = with_sigmas(kept.flight).trajectories
    return [
        f"{flight.log}: its trajectory has no sigmas at some times; {100 * SIGMAS_M:g} cm of position, {roll:g}° of "
        f"roll and pitch and {heading:g}° of heading are assumed there"
        for flight, before, after in zip(kept.logged, kept.flight.trajectories, filled, strict=True)
        for roll, _, heading in [SIGMAS_DEG]
        if not (
            np.array_equal(before.position_sigma_l, after.position_sigma_l)
            and np.array_equal(before.attitude_sigma_rad, after.attitude_sigma_rad)
        )
    ]


def _anew(
    request: ValidationOptions,
    found: _Found,
    kept: KeptFlight,
    points: Sequence[ControlPoint],
    folder: Path,
    told: Tell,
) -> tuple[Mapping[str, Calibration], str]:
    """Return parameters estimated from these logs and control alone, as by `swath calibrate`; or
    none and the reason.
    """

    def features(flight: Flight) -> Features:
        return Features.joined([find_planes(flight, PLANES, tell=told), control_planes(flight, points)])

    def found_anew(calibrations: Mapping[str, Calibration]) -> Features:
        return features(replaced(kept.flight, calibrations, folder, "anew", request.logs.workers, told))

    start = found.calibrations
    try:
        adjusted = adjust(
            kept.flight,
            features(kept.flight),
            Model("scanner"),
            prior_of(kept),
            start=start,
            rematch=found_anew,
            tell=told,
        )
    except (FlightError, NormalError) as error:
        return {}, str(error)
    if not adjusted.converged:
        return {}, "the adjustment does not converge"
    return adjusted.calibrations, ""


# ---------------------------------------------------------------------- output


def _written(request: ValidationOptions, found: _Found) -> Validated:
    record: dict[str, Any] = {"calibrations": {name: one.id for name, one in found.calibrations.items()}}
    record["verdict"] = verdict_entry(found.carried, accepted=request.logs.accept_verdict)
    lines: list[str] = first_lines(record["verdict"])
    wrong: list[str] = list(filter(None, [refusal(record["verdict"])]))
    if found.validation is not None:
        record["validation"] = _record(found.validation)
        record["control"] = found.control
        lines += [method.sentence for method in found.validation.methods] + [found.validation.sentence]
        wrong += [] if found.validation.holds else [found.validation.sentence]
        found.notes += found.validation.dependent
    if found.histories:
        record["history"] = [one.record() for one in found.histories]
        for one in found.histories:
            lines += _table(one) + list(one.sentences)
            wrong += list(one.sentences) if one.moved or not one.steps else []  # without steps no test was made
    record["notes"] = found.notes
    record = finite(record)
    if request.output is not None:
        lines += _write(request, request.output, record, found)
    return Validated(record, [*lines, *found.notes], "; ".join(wrong), found.warnings)


def _record(validation: Validation) -> dict[str, Any]:
    return {
        "passed": validation.passed,
        "sentence": validation.sentence,
        "independent": not validation.dependent,
        "undone": list(validation.undone),
        "smallest_errors": [one.record() for one in validation.detectable],
        "methods": [_method(method) for method in validation.methods],
    }


def _method(method: Method) -> dict[str, Any]:
    numbers = method.numbers
    names = ("count", "mean_m", "std_m", "rms_m", "max_m", "median_m", "p95_m")
    tests = [
        {"kind": one.kind, "value": one.value, "freedom": one.freedom, "p": one.p, "passed": one.passed}
        for one in method.tests
    ]
    return {
        "method": method.name,
        "code": method.code,
        "passed": method.passed,
        "numbers": None if numbers is None else {name: getattr(numbers, name) for name in names},
        "tests": tests,
        "sentence": method.sentence,
        "smallest_errors": [one.record() for one in method.detectable],
    } | dict(method.more)


def _table(one: History) -> list[str]:
    lines = [f"{'calibration':<28}{'flown':<22}" + "".join(f"{key:>20}" for key in ("omega °", "phi °", "kappa °"))]
    for row in one.table():
        values = [
            with_sigma(row[key], row[f"{key}_sigma"], sign=False) if row[f"{key}_sigma"] else number(row[key], ".4f")
            for key in ("omega_deg", "phi_deg", "kappa_deg")
        ]
        lines.append(f"{row['id']:<28}{row['flown']:<22}" + "".join(f"{value:>20}" for value in values))
    return lines


def _write(request: ValidationOptions, output: Path, record: dict[str, Any], found: _Found) -> list[str]:
    page = output / VALIDATION
    picture = history_png(found.histories) if found.histories else None
    heading = "Validation of " + " and ".join(path.name for path in request.calibrations)
    html = validation_page(heading, found.head, found.validation, found.histories, found.carried, found.notes, picture)
    files = page_files(page, html, found.warnings)
    if found.validation is not None and found.validation.passed is not None:
        files |= record_files(output, found.documents, found.validation, found.logs)
    if picture is not None:
        files[output / HISTORY_PICTURE] = picture
    record["files"] = [path.name for path in files]
    files[output / RECORD] = (json.dumps(record, indent=2, allow_nan=False) + "\n").encode()
    try:
        page.with_suffix(PRINTED).unlink(missing_ok=True)  # of an earlier run
        write_whole(files)
    except OSError as error:
        raise UserError(error_words(error, output), ExitCode.IO) from error
    return [str(path) for path in files]


def history_png(histories: Sequence[History]) -> bytes:
    """Return a picture of boresight angles with one sigma over time, one column per history."""
    figure = Figure(figsize=(1.0 + 5.0 * max(len(histories), 1), 6.6), facecolor="white", layout="constrained")
    axes = figure.subplots(len(BORESIGHT), max(len(histories), 1), squeeze=False, sharex="col")
    for column, one in enumerate(histories):
        axes[0, column].set_title(f"{one.scanner}, {one.installation}", fontsize=10, color=INK)
        for row, name in enumerate(BORESIGHT):
            _draw(axes[row, column], one, row, name)
    made = io.BytesIO()
    figure.savefig(made, dpi=DPI)
    return made.getvalue()


def _draw(axes: Axes, one: History, row: int, name: str) -> None:
    days = np.array(one.times) / DAY_S  # matplotlib's dates: days since 1970
    key = name.replace("_rad", "_deg")
    table = one.table()
    known = [number for number, entry in enumerate(table) if entry[f"{key}_sigma"]]
    axes.errorbar(
        days[known],
        [table[number][key] for number in known],
        [table[number][f"{key}_sigma"] for number in known],
        fmt="o-",
        color=COLOURS[row],
        ecolor=MUTED,
        capsize=3,
        lw=1.0,
        ms=4.5,
    )
    for trend in one.trends:
        if trend.name == name:
            text = f"{with_sigma(math.degrees(trend.per_year), math.degrees(trend.sigma))}° a year"
            axes.text(0.98, 0.04, text, transform=axes.transAxes, ha="right", fontsize=8, color=MUTED)
    axes.set_ylabel(f"{key.removesuffix('_deg')} (°)", fontsize=9, color=INK)
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.tick_params(labelsize=8, colors=MUTED)
    axes.xaxis_date(dt.UTC)
    axes.grid(color="#c9cecb", lw=0.4)
    axes.spines[["top", "right"]].set_visible(False)
