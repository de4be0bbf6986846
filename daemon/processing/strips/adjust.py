"""`swath strips --adjust`: corrections of the trajectory, strip by strip, while the calibration is held.

returns of the strips, placed with the calibration             calibration_flight
planes, control                                                swath.calib.planes.search, swath.calib.control.points
corrections; planes found anew with them; corrections again    swath.calib.strips.corrections
height differences of strips, before and after                 swath.calib.strips.differences
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from swath.calib.control.points import ControlError, control_planes
from swath.calib.equations.normals import NormalError
from swath.calib.features import ControlPoint, Features
from swath.calib.flight import Flight, FlightError
from swath.calib.planes.fit import PlaneError
from swath.calib.planes.search import find_planes
from swath.calib.strips.cells import StripRules
from swath.calib.strips.corrections import DEFAULTS, MODELS, Settings, StripAdjusted, StripError, adjust_strips
from swath.calib.strips.differences import differences
from swath.calib.strips.effects import SeenFrom
from swath.calib.strips.signatures import signatures
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.log.directory import nearest_there
from swath.daemon.log.reader import Session
from swath.daemon.processing.calibration.inputs import control_of
from swath.daemon.processing.calibration.returns import (
    KeptFlight,
    check_space_to_keep,
    read_flight,
    refuse_installations,
    refuse_without_noise,
    replaced,
    smoothed_prior,
)
from swath.daemon.processing.calibration.run import PLANES, refuse_lost_control, refuse_no_planes
from swath.daemon.processing.carried_verdict import ADJUSTMENT, told_before
from swath.daemon.processing.control.files import ControlFile
from swath.daemon.processing.flights.read import Flight as LoggedFlight
from swath.daemon.processing.flights.read import GeorefOptions, verdicts_of
from swath.daemon.processing.setup.setup import Setup
from swath.daemon.processing.strip_agreement import FlightStrips, before_and_after
from swath.daemon.processing.strips.compare import is_of_logs
from swath.daemon.processing.trajectory.files import TrajectoryFiles
from swath.daemon.processing.user_errors import as_user_error
from swath.georef.mapping.frame import MappingError
from swath.georef.progress import Tell
from swath.georef.strips import StripError as StripTimesError
from swath.georef.trajectory.trajectory import TrajectoryError

AUTO = "auto"
PLACED = 2  # times that the returns are placed anew
CHOICES = (*MODELS, AUTO)
REFUSED = (
    ControlError,
    FlightError,
    MappingError,
    NormalError,
    PlaneError,
    StripError,
    StripTimesError,
    TrajectoryError,
)


@dataclass(frozen=True)
class AdjustOptions:
    """The options of `swath strips --adjust` from the command line.

    Attributes:
        logs: which logs are read and how; its options about products are ignored.
        output: folder for the corrected trajectories and the record.
        control: file of surveyed points; None: no control.
        model: model for all strips, of `swath.calib.strips.corrections.MODELS`; ``auto``: chosen for each strip by its
            returns.
        overwrite: replace files of an earlier run.
    """

    logs: GeorefOptions
    output: Path
    control: ControlFile | None = None
    model: str = AUTO
    overwrite: bool = False

    @property
    def settings(self) -> Settings:
        """Settings of the adjustment."""
        return DEFAULTS if self.model == AUTO else replace(DEFAULTS, models=(self.model,))


@dataclass(frozen=True, eq=False)
class StripsCorrected:
    """The outcome of an adjustment of strips.

    Attributes:
        settings: of the adjustment.
        kept: the flight as read, placed with the calibration that is held.
        features: planes and control that the corrections were estimated from.
        control: surveyed points; empty if there are none.
        adjusted: corrections and trajectories.
        before, after: differences of strips.
        notes: notes for people, one line each.
    """

    settings: Settings
    kept: KeptFlight
    features: Features
    control: tuple[ControlPoint, ...]
    adjusted: StripAdjusted
    before: FlightStrips
    after: FlightStrips
    notes: tuple[str, ...]


def _refuse_output(request: AdjustOptions) -> None:
    """Refuse with `UserError` an unusable folder or one with an adjustment, before any long work."""
    there, permitted = nearest_there(request.output.absolute())
    if permitted and not there.is_dir():
        raise UserError(f"--adjust {request.output}: {there} is a file; give a folder", ExitCode.USAGE)
    if not permitted or not os.access(there, os.W_OK | os.X_OK):
        raise UserError(f"--adjust {request.output}: {there} is not writable", ExitCode.IO)
    if (request.output / ADJUSTMENT).exists() and not request.overwrite:
        raise UserError(
            f"{request.output / ADJUSTMENT}: already exists; choose another folder or use --overwrite", ExitCode.USAGE
        )


def files_of(request: AdjustOptions, flight: LoggedFlight) -> TrajectoryFiles:
    """Return the paths of a session's files; refuse with `UserError` files that exist or that the trajectory was read
    from.
    """
    files = TrajectoryFiles.in_folder(request.output, flight.session.session_id, csv=True)
    paths = [path for path in (files.sbet, files.smrmsg, files.csv) if path is not None]
    read = request.logs.trajectory.file
    for path in paths:
        if path.exists() and read is not None and path.samefile(read):
            raise UserError(f"--adjust: {path} is the trajectory to correct; choose another folder", ExitCode.USAGE)
        if path.exists() and not request.overwrite:
            raise UserError(f"{path}: already exists; choose another folder or use --overwrite", ExitCode.USAGE)
    return files


def correct_strips(request: AdjustOptions, folder: Path, tell: Tell) -> StripsCorrected:
    """Estimate corrections of strips; write no files.

    Args:
        request: options of the adjustment.
        folder: temporary folder for the returns, some 150 bytes each.
        tell: called with the progress.

    Raises:
        UserError: the strips cannot be corrected; one line.
    """
    if request.model not in CHOICES:
        raise UserError(f'--strip-model: got "{request.model}", want one of {", ".join(CHOICES)}', ExitCode.USAGE)
    if not is_of_logs(request.logs.logs):
        raise UserError(
            f"--adjust: corrects the trajectory of logs, but {request.logs.logs[0]} contains points; give the logs "
            "of these points",
            ExitCode.USAGE,
        )
    _refuse_output(request)
    with as_user_error(folder, *REFUSED):
        return _corrected(request, folder, tell)


def _corrected(request: AdjustOptions, folder: Path, tell: Tell) -> StripsCorrected:
    def check(sessions: Sequence[Session], setups: Sequence[Setup]) -> None:
        if request.control is not None:
            request.control.place(sessions, setups)
        check_space_to_keep(folder.parent, PLACED, sessions, setups)

    kept = read_flight(request.logs, folder, tell, check)
    with told_before(verdicts_of(kept.logged), *REFUSED):
        return _of_flight(request, kept, folder, tell)


def _of_flight(request: AdjustOptions, kept: KeptFlight, folder: Path, tell: Tell) -> StripsCorrected:
    _refuse(request, kept)
    for logged in kept.logged:
        files_of(request, logged)
    flight, calibrations, workers = kept.flight, kept.flight.starts(), request.logs.workers
    points, notes = ((), []) if request.control is None else control_of(request.control, flight, ())

    def features_of(placed: Flight) -> Features:
        with ThreadPoolExecutor(workers) as pool:
            planes = find_planes(placed, PLANES, pool.map, tell)
        refuse_no_planes(str(kept.logged[0].log), planes)
        return Features.joined([planes, *([control_planes(placed, points)] if points else [])])

    def moved(adjusted: StripAdjusted, name: str) -> Flight:
        return replaced(replace(flight, trajectories=adjusted.trajectories), calibrations, folder, name, workers, tell)

    features = features_of(flight)
    first = adjust_strips(flight, features, calibrations, replace(request.settings, linearisations=1), tell=tell)
    # strips that errors of the trajectory had kept apart overlap now
    features = features_of(moved(first, "matched"))
    refuse_lost_control(request.control, features)
    adjusted = adjust_strips(flight, features, calibrations, request.settings, tell=tell)
    before, after = before_and_after(flight, moved(adjusted, "adjusted"), kept.logged[0].setup.mapping, tell)
    tell("checks", 0, 0)
    notes += [*kept.notes, *_notes(request, kept, features, before.cells.frame.cell_m), *adjusted.notes]
    return StripsCorrected(request.settings, kept, features, points, adjusted, before, after, tuple(notes))


def _refuse(request: AdjustOptions, kept: KeptFlight) -> None:
    log = kept.logged[0].log
    strips = {(swath.trajectory_index, swath.strip) for swath in kept.flight.swaths}
    if len(strips) < 2:
        raise UserError(
            f"{log}: {len(strips) or 'no'} strip with returns; an adjustment compares strips: fly at least two that "
            "overlap"
        )
    refuse_installations(kept.logged)
    refuse_without_noise(kept)
    for head in kept.flight.heads:
        if head.start.method == "nominal" and head.name not in request.logs.options.calibrations:
            raise UserError(
                f"{log}: {head.name}: has only the nominal calibration, whose errors would distort the trajectory; "
                "give --calibration FILE of swath calibrate",
                ExitCode.USAGE,
            )


def _notes(request: AdjustOptions, kept: KeptFlight, features: Features, cell_m: float) -> list[str]:
    notes, flight = [], kept.flight
    if not request.control:
        notes.append("no control: the datum is not determined; a shift or tilt common to all strips stays as it is")
    seen = {flight.swaths[patch.swath].strip for plane in features.planes for patch in plane.patches}
    for strip in sorted({swath.strip for swath in flight.swaths} - seen):
        notes.append(f"strip {strip:02d}: no other strip sees one of its planes, so nothing of it is determined")
    found = signatures(
        differences(flight, StripRules(cell_m=cell_m)).checks, SeenFrom.of(flight), smoothed_prior(kept)
    ).found
    effects = dict.fromkeys(one.words for one in found if one.level in ("significant", "rough"))
    notes += [
        "before the correction, strips differed as an error of the calibration would make them differ; correct "
        f"it with swath calibrate: {words}"
        for words in effects
    ]
    return notes
