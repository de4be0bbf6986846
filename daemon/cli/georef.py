"""The command ``swath georef``: computes points from logs and a trajectory."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from swath.daemon.cli.options import (
    AcceptVerdict,
    ForceCrs,
    ForceTrajectory,
    TrajectoryDatum,
    TrajectoryPoint,
    TrajectoryWeek,
)
from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.processing.requirements import require_installed
from swath.daemon.text_files import text_of


def command(
    logs: Annotated[list[Path], typer.Argument(help="Logs, or directories of logs.", metavar="LOG…", readable=False)],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for the products.")],
    trajectory: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="SBET, Waypoint text or CSV; default: the log's INS, or else its IMU and GNSS."
        ),
    ] = None,
    at: TrajectoryPoint = "body",
    datum: TrajectoryDatum = None,
    week: TrajectoryWeek = None,
    calibration: Annotated[
        list[str] | None,
        typer.Option(metavar="[SCANNER=]FILE", help="Use this calibration instead of the log's own; once per scanner."),
    ] = None,
    crs: Annotated[
        str | None, typer.Option(help="Coordinate system, such as EPSG:25832+7837; overrides output.crs.")
    ] = None,
    force_crs: ForceCrs = False,
    epoch: Annotated[
        float | None, typer.Option(help="Epoch of the coordinates, such as 2026.9; overrides output.epoch.")
    ] = None,
    config: Annotated[Path | None, typer.Option(metavar="FILE", help="Configuration; default: the logs' own.")] = None,
    strips: Annotated[
        str, typer.Option(help="auto: split at turns and laser off; whole: at laser off only; or a CSV of times.")
    ] = "auto",
    min_strip: Annotated[
        float, typer.Option(metavar="SECONDS", help="Minimum strip duration; shorter stretches are ignored.", min=0.0)
    ] = 5.0,
    workers: Annotated[int | None, typer.Option(help="Number of processes; default: one per processor.", min=1)] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Compute on the Dask cluster at this address (tcp://…).")
    ] = None,
    no_sigma: Annotated[bool, typer.Option("--no-sigma", help="Do not write the three sigmas of each point.")] = False,
    error_model: Annotated[
        bool, typer.Option("--error-model", help="Also write how the points' errors are correlated (swath accuracy).")
    ] = False,
    surface: Annotated[
        Literal["planes", "level", "none"],
        typer.Option(
            help="Surface under the beams' footprints, for sigmas: planes found in the points, level ground, or none."
        ),
    ] = "planes",
    incidence: Annotated[
        bool, typer.Option("--incidence", help="Also write each point's angle of incidence, and where it is from.")
    ] = False,
    range_sigma: Annotated[
        bool, typer.Option("--range-sigma", help="Also write the sigma of each point's range alone.")
    ] = False,
    covariances: Annotated[
        bool, typer.Option("--covariances", help="Also write the six covariances of each point's coordinates.")
    ] = False,
    copc: Annotated[bool, typer.Option("--copc", help="Write cloud-optimised files (.copc.laz).")] = False,
    scale: Annotated[
        float, typer.Option(help="Resolution of stored coordinates, in their unit.", min=1e-9, max=1.0)
    ] = 0.001,
    write_dropped: Annotated[
        bool,
        typer.Option(
            "--write-dropped", help="Also write discarded returns: out-of-range points flagged, others listed."
        ),
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace products of an earlier run.")] = False,
    force_trajectory: ForceTrajectory = False,
    accept_verdict: AcceptVerdict = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the sidecar as JSON, for scripts.")] = False,
) -> None:
    """Georeference logs; write one LAZ file per strip, the trajectory, and a JSON file that documents their origin.

    Every return is either in a file or counted with the reason for leaving it out. Exit code 1 when the products are
    partial: parts missing, data damaged, strips that failed; 2 or 3 when there are no products.
    """
    require_installed("swath georef")
    from swath.daemon.cli.progress import progress_bar
    from swath.daemon.config import load_config
    from swath.daemon.processing.flights.read import GeorefOptions
    from swath.daemon.processing.flights.trajectory_choice import TrajectoryOptions
    from swath.daemon.processing.georeferencing.run import georeference
    from swath.daemon.processing.setup.setup import Options
    from swath.georef.strips import StripRules

    _refuse_columns(no_sigma, surface, incidence=incidence, range_sigma=range_sigma, covariances=covariances)
    request = GeorefOptions(
        logs=logs,
        output=output,
        trajectory=TrajectoryOptions(trajectory, week, at, navigate=error_model, force=force_trajectory),
        options=Options(
            crs=crs,
            force_crs=force_crs,
            datum=datum,
            epoch=epoch,
            calibrations=calibrations_given(calibration or []),
            uncertainty=not no_sigma,
            surface=surface,
            incidence=incidence,
            range_sigma=range_sigma,
            covariances=covariances,
        ),
        config=None if config is None else load_config(config),
        strips=strips,
        rules=StripRules(min_strip_s=min_strip),
        workers=workers or os.cpu_count() or 1,
        accept_verdict=accept_verdict,
        scheduler=scheduler,
        sigmas=not no_sigma,
        error_model=error_model,
        copc=copc,
        scale=scale,
        overwrite=overwrite,
        write_dropped=write_dropped,
    )
    with progress_bar(compiling=True) as tell:
        began_s = time.monotonic()
        report = georeference(request, tell)
        elapsed_s = time.monotonic() - began_s
    _tell(report.record, report.sidecar, elapsed_s, as_json=as_json)


def _refuse_columns(no_sigma: bool, surface: str, **columns: bool) -> None:
    """Refuse with `UserError` columns that the other options leave without content."""
    named = [f"--{name.replace('_', '-')}" for name, wanted in columns.items() if wanted]
    if no_sigma and named:
        raise UserError(f"{named[0]} needs the sigmas: leave out --no-sigma", ExitCode.USAGE)
    if surface == "none" and columns["incidence"]:
        raise UserError("--incidence needs a surface: use --surface planes or level", ExitCode.USAGE)


def calibrations_given(given: list[str]) -> dict[str, tuple[str, str]]:
    """Return text and name of each calibration file, by the scanner named in the option, or else in the file."""
    found: dict[str, tuple[str, str]] = {}
    for entry in given:
        named, equals, rest = entry.partition("=")
        file = Path(rest if equals else entry)
        text = text_of(file, "a calibration file")
        scanner = named if equals else _scanner_of(text, file)
        if scanner in found:
            raise UserError(
                f"{file}: a calibration of scanner {scanner} was already given; give one per scanner", ExitCode.USAGE
            )
        found[scanner] = (text, str(file))
    return found


def _scanner_of(text: str, file: Path) -> str:
    from swath.georef.scanner.calibration import CalibrationError, read_calibration

    try:
        return read_calibration(text, str(file)).scanner
    except CalibrationError as error:
        raise UserError(str(error), ExitCode.USAGE) from error


def _tell(record: dict[str, Any], sidecar: Path, elapsed_s: float, *, as_json: bool) -> None:
    from swath.daemon.processing.carried_verdict import first_lines, refusal

    if as_json:
        print(json.dumps(record, indent=2))
    else:
        print(*(f"{one_line(line)}\n" for line in first_lines(record["verdict"])), sep="", end="")
        _print(record, sidecar, elapsed_s)
    partial = [] if record["complete"] else ["partial: " + "; ".join(map(one_line, record["holes"][:5]))]
    unusable = refusal(record["verdict"])
    if partial or unusable:
        raise UserError(f"{sidecar}: " + "; ".join([*partial, *([one_line(unusable)] if unusable else [])]))


def _print(record: dict[str, Any], sidecar: Path, elapsed_s: float) -> None:
    from swath.daemon.processing.georeferencing.console import georef_lines

    for line in georef_lines(record, elapsed_s):
        print(one_line(line))
    print(f"{'complete' if record['complete'] else 'partial'}: {one_line(str(sidecar))}")
