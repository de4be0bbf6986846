"""The command ``swath validate``: checks whether a calibration is right and still holds."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from swath.daemon.cli.options import (
    AcceptVerdict,
    ControlColumns,
    ControlCrs,
    ControlPath,
    ForceTrajectory,
    TrajectoryDatum,
    TrajectoryPoint,
    TrajectoryWeek,
)
from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.processing.requirements import PRINTED_PAGES, require_installed
from swath.daemon.text_files import text_of


def command(
    calibration: Annotated[Path, typer.Argument(help="The calibration file.", metavar="CALIBRATION", readable=False)],
    logs: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Logs that were not used for the calibration, or directories of logs.", metavar="LOG…", readable=False
        ),
    ] = None,
    also: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="Calibration of another scanner in the same logs; repeatable."),
    ] = None,
    control: ControlPath = None,
    control_crs: ControlCrs = None,
    control_columns: ControlColumns = None,
    anew: Annotated[
        bool, typer.Option("--anew", help="Also estimate the parameters from these logs and compare.")
    ] = False,
    past: Annotated[
        list[Path] | None,
        typer.Option(
            "--history",
            metavar="DIR|FILE",
            help="Earlier calibrations of this installation, to detect that it moved; repeatable.",
        ),
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="SBET, Waypoint text or CSV; default: computed from the logs' IMU and GNSS."),
    ] = None,
    at: TrajectoryPoint = "body",
    week: TrajectoryWeek = None,
    datum: TrajectoryDatum = None,
    config: Annotated[Path | None, typer.Option(metavar="FILE", help="Configuration; default: the logs' own.")] = None,
    strips: Annotated[str, typer.Option(help="How to divide the flight: auto, whole, or a CSV of times.")] = "auto",
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR",
            help="Folder for page, PDF, validation.json, history.png and updated records.",
        ),
    ] = None,
    record: Annotated[
        Path | None,
        typer.Option(metavar="DIR|FILE", help="Record of the calibration; -o gets a copy with this validation added."),
    ] = None,
    workers: Annotated[int | None, typer.Option(help="Number of processes; default: one per processor.", min=1)] = None,
    force_trajectory: ForceTrajectory = False,
    accept_verdict: AcceptVerdict = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files of an earlier run.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
) -> None:
    """Validate a calibration by the six methods of ISO/TS 19159-2, 6.8, each with numbers, a test and a sentence.

    Exit code 1 when a test rejects the calibration, when the boresight has moved, or when a requested test, or any test
    at all, could not be made.
    """
    require_installed("swath validate", *PRINTED_PAGES)
    from swath.daemon.processing.control.files import read_control_file

    if not logs and not past:
        raise UserError("nothing to validate against; give LOG… or --history", ExitCode.USAGE)
    if record is not None and not (logs and output):
        raise UserError(
            "--record needs LOG… and --output DIR, because the new record holds the results from the logs",
            ExitCode.USAGE,
        )
    surveyed = read_control_file(control, control_crs, control_columns)  # before all that takes seconds to import
    from swath.daemon.cli.progress import progress_bar
    from swath.daemon.config import load_config
    from swath.daemon.processing.carried_verdict import acceptance
    from swath.daemon.processing.earlier_runs import refuse_existing
    from swath.daemon.processing.flights.read import GeorefOptions
    from swath.daemon.processing.flights.trajectory_choice import TrajectoryOptions
    from swath.daemon.processing.pages.names import VALIDATION
    from swath.daemon.processing.setup.setup import Options
    from swath.daemon.processing.validation.run import RECORD, ValidationOptions, read_file, run_validation

    files = [calibration, *(also or [])]
    given = {read_file(path).scanner: (text_of(path, "a calibration file"), str(path)) for path in files}
    if len(given) < len(files):
        raise UserError(
            f"{files[-1]}: a calibration of this scanner was already given; give one per scanner", ExitCode.USAGE
        )
    request = ValidationOptions(
        calibrations=files,
        logs=GeorefOptions(
            logs=logs or [],
            output=output or Path(),
            trajectory=TrajectoryOptions(trajectory, week, at, navigate=True, force=force_trajectory),
            options=Options(datum=datum, calibrations=given, uncertainty=False, force_crs=True),
            config=None if config is None else load_config(config),
            strips=strips,
            workers=workers or os.cpu_count() or 1,
            accept_verdict=accept_verdict,
        ),
        control=surveyed,
        histories=past or (),
        anew=anew,
        output=output,
        record=record,
    )
    if output is not None:
        refuse_existing((output / RECORD, output / VALIDATION), overwrite=overwrite)
    with tempfile.TemporaryDirectory(prefix="swath-") as folder, progress_bar(compiling=True) as tell:
        done = run_validation(request, Path(folder), tell)
    print(json.dumps(done.record, indent=2) if as_json else "\n".join(map(one_line, done.lines)))
    for line in done.warnings:
        print(one_line(f"swath: {line}"), file=sys.stderr)
    if done.problem:
        raise UserError(done.problem if as_json else acceptance(done.record["verdict"]))  # stdout has the verdict
