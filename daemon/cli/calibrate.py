"""The command ``swath calibrate``: estimates a scanner's parameters from the logs of a calibration flight."""

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
    ForceCrs,
    ForceTrajectory,
    TrajectoryDatum,
    TrajectoryPoint,
    TrajectoryWeek,
)
from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.processing.requirements import PRINTED_PAGES, require_installed

OBSERVE = ("planes", "ties", "markings")


def command(
    logs: Annotated[list[Path], typer.Argument(help="Logs, or directories of logs.", metavar="LOG…", readable=False)],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="FILE.toml to write; for several scanners, a folder.")
    ],
    scanner: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Calibrate this scanner only; repeatable. Default: all.")
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="SBET, Waypoint text or CSV; default: computed from the log's IMU and GNSS."),
    ] = None,
    at: TrajectoryPoint = "body",
    week: TrajectoryWeek = None,
    control: ControlPath = None,
    control_crs: ControlCrs = None,
    control_columns: ControlColumns = None,
    ties: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Picked tie points: name, strip, x, y, z, sigma_m in output.crs.")
    ] = None,
    polygons: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Polygons of the planes to use: WKT, name in output.crs.")
    ] = None,
    model: Annotated[str, typer.Option(help="Parameters to estimate: basic, scanner, full, or FILE.toml.")] = "scanner",
    fix: Annotated[
        str, typer.Option(metavar="KEY,…", help="Parameters to hold at their start value, such as phi_deg.")
    ] = "",
    free: Annotated[str, typer.Option(metavar="KEY,…", help="Estimate these parameters too.")] = "",
    prior: Annotated[
        list[str] | None, typer.Option(metavar="KEY=SIGMA", help="Constrain KEY to its start value; repeatable.")
    ] = None,
    observe: Annotated[
        str, typer.Option(metavar="WHAT,…", help="Observations: planes, or ties (their intersections); also markings.")
    ] = "planes",
    report: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for report (HTML, PDF, pictures) and record (ISO 19159).")
    ] = None,
    facts: Annotated[
        Path | None, typer.Option(metavar="TOML", help="Facts for the record that no log holds: CLASS.attribute = …")
    ] = None,
    start: Annotated[
        list[str] | None,
        typer.Option(
            "--calibration", metavar="[SCANNER=]FILE", help="Start from FILE instead of the log's own calibration."
        ),
    ] = None,
    datum: TrajectoryDatum = None,
    crs: Annotated[str | None, typer.Option(help="Coordinate system; overrides output.crs.")] = None,
    force_crs: ForceCrs = False,
    config: Annotated[Path | None, typer.Option(metavar="FILE", help="Configuration; default: the logs' own.")] = None,
    strips: Annotated[str, typer.Option(help="How to divide the flight: auto, whole, or a CSV of times.")] = "auto",
    limit_deg: Annotated[
        float, typer.Option("--limit-deg", help="Largest accepted boresight change, degrees.", min=0.0)
    ] = 5.0,
    limit_m: Annotated[
        float, typer.Option("--limit-m", help="Largest accepted range offset change, metres.", min=0.0)
    ] = 10.0,
    workers: Annotated[int | None, typer.Option(help="Number of processes; default: one per processor.", min=1)] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
    force_trajectory: ForceTrajectory = False,
    accept_verdict: AcceptVerdict = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the outcome as JSON, for scripts.")] = False,
) -> None:
    """Estimate boresight, range offset and the rest of the sensor model, with sigmas, from logs alone.

    Parameters that this flight cannot determine keep their start value, and the report names them. Exit code 1 if the
    logs do not give a calibration (then no file is written), or if its verdict is "Not to be used", unless you give
    --accept-verdict (the file is written and holds the verdict).
    """
    require_installed("swath calibrate", *(PRINTED_PAGES if report else ()))
    from swath.daemon.processing.control.files import read_control_file

    _refuse(output, observe, overwrite=overwrite)
    if facts is not None and report is None:
        raise UserError("--facts needs --report DIR, because facts are written to the record", ExitCode.USAGE)
    surveyed = read_control_file(control, control_crs, control_columns)  # before all that takes seconds to import
    from swath.daemon.cli.georef import calibrations_given
    from swath.daemon.cli.progress import progress_bar
    from swath.daemon.config import load_config
    from swath.daemon.processing.calibration.model import file_of, model_of
    from swath.daemon.processing.calibration.products import write_products
    from swath.daemon.processing.calibration.record import facts_of
    from swath.daemon.processing.calibration.run import CalibrationOptions, calibrate
    from swath.daemon.processing.flights.read import GeorefOptions
    from swath.daemon.processing.flights.trajectory_choice import TrajectoryOptions
    from swath.daemon.processing.setup.setup import Options

    request = CalibrationOptions(
        logs=GeorefOptions(
            logs=logs,
            output=output,
            trajectory=TrajectoryOptions(trajectory, week, at, navigate=True, force=force_trajectory),
            options=Options(
                crs=crs,
                force_crs=force_crs,
                datum=datum,
                scanners=tuple(scanner or ()),
                calibrations=calibrations_given(start or []),
                uncertainty=False,
            ),
            config=None if config is None else load_config(config),
            strips=strips,
            workers=workers or os.cpu_count() or 1,
            accept_verdict=accept_verdict,
        ),
        output=output,
        model=model_of(model, fix, free, prior or []),
        model_file=file_of(model),
        control=surveyed,
        ties=ties,
        polygons=polygons,
        observe=tuple(observe.split(",")),
        report=report,
        facts={} if facts is None else facts_of(facts),
        limit_deg=limit_deg,
        limit_m=limit_m,
        overwrite=overwrite,
    )
    with (
        tempfile.TemporaryDirectory(prefix="swath-", dir=output.resolve().parent) as folder,
        progress_bar(compiling=True) as tell,
    ):
        products = write_products(request, calibrate(request, Path(folder), tell), tell)
    print(json.dumps(products.record, indent=2) if as_json else "\n".join(map(one_line, products.lines)))
    for line in products.warnings:
        print(one_line(f"swath: {line}"), file=sys.stderr)
    if products.record["verdict"]["level"] == "unusable" and not accept_verdict:
        problem = f"{output}: {one_line(products.record['verdict']['sentence'])}"
        accepting = f'{output}: the verdict is "not to be used"; use --accept-verdict to accept it'
        raise UserError(problem if as_json else accepting)  # stdout has the verdict


def _refuse(output: Path, observe: str, *, overwrite: bool) -> None:
    unknown = [word for word in observe.split(",") if word not in OBSERVE]
    if unknown:
        raise UserError(f'--observe: got "{unknown[0]}", want {", ".join(OBSERVE)}', ExitCode.USAGE)
    if {"planes", "ties"} <= set(observe.split(",")):
        raise UserError("--observe: planes and ties use the same returns; give one of the two", ExitCode.USAGE)
    if output.is_file() and not overwrite:
        raise UserError(f"{output}: already exists; choose another name or use --overwrite", ExitCode.USAGE)
    if not output.resolve().parent.is_dir():
        raise UserError(f"{output}: the folder {output.parent} does not exist; create it first", ExitCode.USAGE)
