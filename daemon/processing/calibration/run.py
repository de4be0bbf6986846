"""`swath calibrate`: from the logs of a calibration flight to parameters, their sigmas and the proof.

    returns of the strips as measured, and the trajectory's own joint covariance    calibration_flight
    coarse boresight, so that the same roof is found in every strip                 swath.calib.prealign
    planes, tie points, control                                                     swath.calib.planes.search, …
    adjustment, with correspondences found anew until they stay                     swath.calib.adjust
    height differences of strips, before and after; files, record, report           calibrate_products

All files are written aside and renamed at the end, so that any calibration file is a complete one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from swath.calib.adjust import adjust
from swath.calib.control.doubts import doubts
from swath.calib.control.points import ControlError, control_planes, in_t
from swath.calib.equations.normals import NormalError
from swath.calib.equations.trajectory_prior import TrajectoryPrior, gauss_markov
from swath.calib.features import ControlPoint, Features
from swath.calib.flight import Flight, FlightError
from swath.calib.labels import number, unknown
from swath.calib.outcome import Adjusted
from swath.calib.parameters import ANGLES, ParameterError, check_options, check_scanners
from swath.calib.parameters import ParameterOptions as Model
from swath.calib.planes.fit import PlaneError, PlaneSettings
from swath.calib.planes.given import given_planes
from swath.calib.planes.matching import rematch
from swath.calib.planes.returns import limited
from swath.calib.planes.search import find_planes
from swath.calib.prealign import PrealignError, PrealignSettings, prealigned
from swath.calib.profiles.check import Check, check
from swath.calib.record.values import Plain
from swath.calib.summary import Finding
from swath.calib.ties.intersections import find_ties
from swath.calib.ties.markings import find_markings
from swath.calib.ties.picked import PickedError
from swath.calib.ties.picked import carried as carried_points
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.free_space import check_space
from swath.daemon.log.reader import Session
from swath.daemon.processing.calibration.inputs import PolygonError, rings_of, ties_of
from swath.daemon.processing.calibration.returns import (
    KeptFlight,
    check_space_to_keep,
    read_flight,
    refuse_installations,
    refuse_without_noise,
    replaced,
    smoothed_prior,
)
from swath.daemon.processing.carried_verdict import told_before
from swath.daemon.processing.control.files import ControlFile
from swath.daemon.processing.flights.read import GeorefOptions, trajectory_verdicts_of
from swath.daemon.processing.setup.setup import Setup
from swath.daemon.processing.user_errors import as_user_error
from swath.georef.mapping.frame import MappingError
from swath.georef.progress import Tell
from swath.georef.scanner.calibration import Calibration
from swath.georef.strips import StripError
from swath.georef.trajectory.trajectory import TrajectoryError

COARSE_RAD = math.radians(0.05)  # how well an angle can be found at best from heights of overlapping strips
COARSE_SIGMAS = 3.0
OUTCOME = "calibration.json"  # name of the outcome's file in a report's folder
# Enough to bring strips together, and for a trajectory with sigmas only: how its errors change from one patch to the
# next is then assumed, and thousands of returns would get more weight than this assumption deserves.
PLANES = PlaneSettings(most_points=25)
# If the smoother's covariance describes the errors: without control the range offset is found by averaging noise over
# all ground. Beyond 400 returns a patch the attitude between two knots dominates.
EVERY = PlaneSettings(most_points=400, most_planes=4000, ground_planes=100)
PLACED = 5  # times that the returns are placed anew: aligned, matched, entire, calibrated, and for the comparison
REPORT_BYTES = (5e6, 2e8)  # of a report with its record, whose matrices grow with the observations
ROWS_MOST = 4_000_000  # in all: some seconds per pass, and 300 MB
REFUSED = (
    ControlError,
    FlightError,
    MappingError,
    NormalError,
    ParameterError,
    PickedError,
    PlaneError,
    PolygonError,
    PrealignError,
    StripError,
    TrajectoryError,
)


@dataclass(frozen=True)
class CalibrationOptions:
    """The options of `swath calibrate` from the command line.

    Attributes:
        logs: which logs are read and how; its options about products are ignored.
        output: path of the calibration file; for several scanners the folder of their files.
        model: the parameters that are estimated.
        model_file: file of the model; None: the model is given by name.
        control: file of surveyed points; None: no control.
        ties: CSV of points picked in several strips; used beside the observations found.
        polygons: CSV of polygons that planes fill; used instead of a search for planes.
        observe: kinds of features that are searched for: planes or ties, and markings.
        report: folder of the report, the record and the pictures; None: no report.
        facts: facts for the record that only the user knows, by ``CLASS.attribute``.
        limit_deg, limit_m: how far boresight and range offset may move from the start.
        overwrite: replace files of an earlier run.
    """

    logs: GeorefOptions
    output: Path
    model: Model = field(default_factory=Model)
    model_file: Path | None = None
    control: ControlFile | None = None
    ties: Path | None = None
    polygons: Path | None = None
    observe: tuple[str, ...] = ("planes",)
    report: Path | None = None
    facts: Mapping[str, Plain] = field(default_factory=dict)
    limit_deg: float = 5.0
    limit_m: float = 10.0
    overwrite: bool = False


@dataclass(frozen=True, eq=False)
class Calibrated:
    """The outcome of a calibration.

    Attributes:
        kept: the flight as read.
        flight: the flight placed with the estimated calibrations.
        prealigned: by scanner, the initial values of the adjustment's iterations.
        findings: contradictions between the pre-alignment and angles that are held, for the verdict.
        check: results of profiles on the outcome.
        notes: notes for people, one line each.
    """

    kept: KeptFlight
    flight: Flight
    features: Features
    prior: TrajectoryPrior
    prealigned: Mapping[str, Calibration]
    adjusted: Adjusted
    control: tuple[ControlPoint, ...]
    check: Check
    notes: tuple[str, ...]
    findings: tuple[Finding, ...] = ()


def calibrate(request: CalibrationOptions, folder: Path, tell: Tell) -> Calibrated:
    """Calibrate a flight's scanners.

    Args:
        request: options of the calibration.
        folder: temporary folder for the returns, some 150 bytes each.
        tell: called with the progress.

    Raises:
        UserError: the flight cannot be calibrated; one line.
    """
    with as_user_error(folder, *REFUSED):
        return _calibrate(request, folder, tell)


def _calibrate(request: CalibrationOptions, folder: Path, tell: Tell) -> Calibrated:
    _refuse_existing(request, [] if request.report is None else [request.report / OUTCOME])

    def check(sessions: Sequence[Session], setups: Sequence[Setup]) -> None:
        check_scanners(list(dict.fromkeys(name for setup in setups for name in setup.scanners)), request.model)
        if request.control is not None:
            request.control.place(sessions, setups)
        check_space_to_keep(folder.parent, PLACED, sessions, setups)
        if request.report is not None:
            check_space(request.report, "report and record", least_bytes=REPORT_BYTES[0], most_bytes=REPORT_BYTES[1])

    kept = read_flight(request.logs, folder, tell, check)
    _refuse_existing(request, paths_of(request, (head.name for head in kept.flight.heads)).values())
    check_options(kept.flight, request.model)
    with told_before(trajectory_verdicts_of(kept.logged), *REFUSED):
        return _calibrated(request, kept, folder, tell)


def _calibrated(request: CalibrationOptions, kept: KeptFlight, folder: Path, tell: Tell) -> Calibrated:
    _refuse_one_strip(kept)
    points = _control(request, kept.flight)
    workers = request.logs.workers
    tell("pre-alignment", 0, 0)
    first, away = _aligned(kept.flight, request.model.fix)
    doubted = {name: abs(apart) for name, apart in away.items()}
    flight = replaced(kept.flight, first, folder, "aligned", workers, tell)
    notes = (*(request.control.notes if request.control else ()), *_doubts(request, flight, points))
    rings = None if request.polygons is None else rings_of(request.polygons, kept)
    picked = Features() if request.ties is None else ties_of(request.ties, kept)

    def search(settings: PlaneSettings = PLANES) -> Features:
        if rings is not None:
            return given_planes(flight, rings, settings)
        with ThreadPoolExecutor(workers) as pool:
            return find_planes(flight, settings, pool.map, tell)

    def match() -> Features:
        with ThreadPoolExecutor(workers) as pool:
            return rematch(flight, planes, PLANES, pool.map, tell)

    def observed() -> Features:
        return Features.joined(
            [_features(request, flight, planes, points), carried_points(picked, kept.flight, flight)]
        )

    planes, searched = search(), 1
    refuse_no_planes(str(request.logs.logs[0] if rings is None else request.polygons), planes)
    features = observed()
    prior = prior_of(kept)

    def found_anew(calibrations: Mapping[str, Calibration]) -> Features:
        nonlocal flight, planes, features, searched
        flight = replaced(kept.flight, calibrations, folder, "matched", workers, tell)
        # search once more: roofs at a swath's edges that the pre-alignment left apart overlap now
        again = searched == 1 or rings is not None
        planes, searched = search() if again else match(), searched + 1
        features = observed()
        return features

    def everything(calibrations: Mapping[str, Calibration]) -> Features | None:
        nonlocal flight, planes, features
        if not len(prior.walk_rad2) or "ties" in request.observe:
            return None
        flight = replaced(kept.flight, calibrations, folder, "entire", workers, tell)
        planes = limited(search(EVERY), ROWS_MOST)
        features = observed()
        return features

    adjusted = adjust(
        flight,
        features,
        request.model,
        prior,
        rematch=found_anew,
        first=first,
        doubted=doubted,
        entire=everything,
        tell=tell,
    )
    _refuse_far(request, kept.flight, adjusted)
    refuse_lost_control(request.control, features)
    flight = replaced(kept.flight, adjusted.calibrations, folder, "calibrated", workers, tell)
    checked = check(flight, adjusted, prior, points, tell=tell)
    all_notes = (*kept.notes, *notes, *adjusted.notes)
    findings = prealigned_otherwise(away, adjusted)
    return Calibrated(kept, flight, features, prior, first, adjusted, points, checked, all_notes, findings)


def _aligned(flight: Flight, fixed: frozenset[str]) -> tuple[dict[str, Calibration], dict[str, float]]:
    """Return a coarse boresight by scanner, and the deviations that contradict the start, by name, SI.

    The range offset keeps its start: heights of strips alone hardly determine it. A coarse angle contradicts the start
    if it deviates by more than the error that heights of strips may have.
    """
    starts = flight.starts()
    coarse = prealigned(flight, PrealignSettings(held=fixed))
    first, away = {}, {}
    for name, found in coarse.calibrations.items():
        first[name] = found.changed(range_offset_m=starts[name].value("range_offset_m"))
        for angle, sigma in zip(ANGLES, coarse.sigmas[name].tolist(), strict=False):
            apart = found.value(angle) - starts[name].value(angle)
            if abs(apart) > max(COARSE_SIGMAS * sigma, COARSE_RAD):
                away[f"{name}.{angle}"] = apart
    return first, away


def prealigned_otherwise(away: Mapping[str, float], adjusted: Adjusted) -> tuple[Finding, ...]:
    """Return findings where the pre-alignment contradicts angles that the adjustment held at their start.

    Args:
        away: by name, as ``left.kappa_rad``, the deviation that contradicts the start, SI.
        adjusted: outcome of the adjustment.
    """
    found = []
    for held in adjusted.held:
        apart = away.get(f"{held.scanner}.{held.name}")
        if apart is not None:
            words, apart_text = unknown(f"{held.scanner}.{held.name}").words, number(math.degrees(apart), "+.2f")
            what = f"the pre-alignment puts {words} {apart_text}° from the initial value at which it is held"
            change = "fly the lines that determine it, or start from a calibration that holds"
            found.append(Finding(what, change, abs(apart) / COARSE_RAD, unusable=True))
    return tuple(found)


def _refuse_existing(request: CalibrationOptions, files: Iterable[Path]) -> None:
    """Refuse with `UserError` to replace files that exist, unless the user allows it."""
    for path in files:
        if path.exists() and not request.overwrite:
            raise UserError(f"{path}: already exists; choose another folder or use --overwrite", ExitCode.USAGE)


def paths_of(request: CalibrationOptions, scanners: Iterable[str]) -> dict[str, Path]:
    """Return the path of each scanner's calibration file."""
    names = list(scanners)
    if len(names) == 1 and not request.output.is_dir():
        return dict.fromkeys(names, request.output)
    return {name: request.output / f"{name}.toml" for name in names}


def _refuse_one_strip(kept: KeptFlight) -> None:
    strips = {(swath.trajectory_index, swath.strip) for swath in kept.flight.swaths}
    log = kept.logged[0].log
    if not strips and (holes := [line for flight in kept.logged for line in flight.holes]):
        raise UserError("\n".join(holes))
    if len(strips) < 2:
        raise UserError(
            f"{log}: {len(strips) or 'no'} strip with returns; a calibration compares strips: fly at least two that "
            "overlap, better opposite, crossing and parallel ones at two heights"
        )
    refuse_installations(kept.logged)
    refuse_without_noise(kept)


def refuse_no_planes(log: str, planes: Features) -> None:
    """Refuse with `UserError` strips that have no plane in common."""
    if planes.planes:
        return
    why = ", ".join(f"{count:,} {reason}" for reason, count in planes.refused.most_common(3))
    raise UserError(
        f"{log}: no two strips see a common plane ({why or 'no candidates'}); fly strips that overlap over roofs and "
        "open ground, with about 2 returns per square metre"
    )


def refuse_lost_control(control: ControlFile | None, features: Features) -> None:
    """Refuse with `UserError` control of which no point can be used."""
    if control is None or any(plane.control for plane in features.planes):
        return
    why = ", ".join(f"{count:,} {reason}" for reason, count in features.refused.items() if "control" in reason)
    raise UserError(f"{control.path}: no point lies on ground where a strip has a plane ({why or 'no returns'})")


# ---------------------------------------------------------------------- observations


def _control(request: CalibrationOptions, flight: Flight) -> tuple[ControlPoint, ...]:
    if request.control is None:
        return ()
    return in_t(request.control.points, flight.frame)


def _doubts(request: CalibrationOptions, flight: Flight, points: Sequence[ControlPoint]) -> tuple[str, ...]:
    """Return doubts about control; refuse with `UserError` control that cannot be used at all.

    An equal offset of all its heights is only a doubt here: the range offset that is to be found causes one too. An
    offset too large for that is refused at the end (`_refuse_far`).
    """
    found = doubts(flight, points)
    whole = [doubt.text for doubt in found if doubt.kind not in ("point", "height")]
    path = "" if request.control is None else f"{request.control.path}: "
    if whole:
        raise UserError("\n".join(f"{path}{text}" for text in whole))
    return tuple(f"{path}{doubt.text}" for doubt in found)


def _features(
    request: CalibrationOptions, flight: Flight, planes: Features, points: Sequence[ControlPoint]
) -> Features:
    """Return the observations of the adjustment: planes or their intersections, never both, as they share their
    returns.
    """
    found = [planes]
    if "ties" in request.observe:
        found = [find_ties(flight, planes)]
    if points:
        found.append(control_planes(flight, points))
    if "markings" in request.observe:
        found.append(find_markings(flight))
    return Features.joined(found)


def prior_of(kept: KeptFlight) -> TrajectoryPrior:
    """Return the prior errors of the trajectory: the exact covariance if smoothed here, otherwise by its sigmas."""
    return smoothed_prior(kept) or gauss_markov(kept.flight)


# ---------------------------------------------------------------------- results


def _refuse_far(request: CalibrationOptions, flight: Flight, adjusted: Adjusted) -> None:
    """Refuse with `UserError` an adjustment that did not converge or moved implausibly far, before
    any file is written.
    """
    log = request.logs.logs[0]
    if not adjusted.converged:
        raise UserError(f"{log}: the adjustment does not converge; inspect the strips with swath view first")
    for head in flight.heads:
        found = adjusted.calibrations[head.name]
        for name in ANGLES:
            away_deg = math.degrees(found.value(name) - head.start.value(name))
            if abs(away_deg) > request.limit_deg:
                raise UserError(
                    f"{log}: {head.name}: {name.removesuffix('_rad')} would change by {away_deg:.2f}°, more than "
                    f"--limit-deg {request.limit_deg:g}; check the installation matrix"
                )
        away_m = found.value("range_offset_m") - head.start.value("range_offset_m")
        if abs(away_m) > request.limit_m:
            raise UserError(
                f"{log}: {head.name}: the range offset would change by {away_m:.2f} m, more than --limit-m "
                f"{request.limit_m:g}; check that the control's heights are ellipsoidal and in this datum"
            )
