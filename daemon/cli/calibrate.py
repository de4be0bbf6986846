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
    logs: Annotated[list[Path], typer.Argument(help="Logs, or directories of them.", metavar="LOG…", readable=False)],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="FILE.toml; of several scanners a folder.")
    ],
    scanner: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Only this one; may be repeated. Default: all.")
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="SBET, Waypoint text or CSV; default: the log's IMU and GNSS, navigated."),
    ] = None,
    at: TrajectoryPoint = "body",
    week: TrajectoryWeek = None,
    control: Annotated[
        Path | None, typer.Option(metavar="CSV", help="name,lat_deg,lon_deg,h_ellipsoidal_m,sigma_m")
    ] = None,
    ties: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Picked points: name,strip,x,y,z,sigma_m in output.crs.")
    ] = None,
    polygons: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Planes to use: WKT,name; polygons in output.crs.")
    ] = None,
    model: Annotated[str, typer.Option(help="basic, scanner, full, or a file FILE.toml.")] = "scanner",
    fix: Annotated[str, typer.Option(metavar="KEY,…", help="Parameters that keep their value, as phi_deg.")] = "",
    free: Annotated[str, typer.Option(metavar="KEY,…", help="Parameters beyond the model.")] = "",
    prior: Annotated[
        list[str] | None, typer.Option(metavar="KEY=SIGMA", help="Held to its start by one sigma; may be repeated.")
    ] = None,
    observe: Annotated[
        str, typer.Option(metavar="WHAT,…", help="planes or ties (their intersections); markings.")
    ] = "planes",
    report: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Report as page and PDF, record by ISO 19159, pictures.")
    ] = None,
    facts: Annotated[
        Path | None, typer.Option(metavar="TOML", help="What only people know, for the record: CLASS.attribute = …")
    ] = None,
    start: Annotated[
        list[str] | None,
        typer.Option("--calibration", metavar="[SCANNER=]FILE", help="To begin with, instead of the log's own."),
    ] = None,
    datum: TrajectoryDatum = None,
    crs: Annotated[str | None, typer.Option(help="Coordinate system; over output.crs.")] = None,
    force_crs: ForceCrs = False,
    config: Annotated[Path | None, typer.Option(metavar="FILE", help="Instead of the logs' own.")] = None,
    strips: Annotated[str, typer.Option(help="auto, whole, or a CSV of times.")] = "auto",
    limit_deg: Annotated[float, typer.Option("--limit-deg", help="Boresight may change by so much.", min=0.0)] = 5.0,
    limit_m: Annotated[float, typer.Option("--limit-m", help="The range offset likewise.", min=0.0)] = 10.0,
    workers: Annotated[int | None, typer.Option(help="Processes; default: one a processor.", min=1)] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")] = False,
    force_trajectory: ForceTrajectory = False,
    accept_verdict: AcceptVerdict = False,
    as_json: Annotated[bool, typer.Option("--json", help="The outcome to stdout, for scripts.")] = False,
) -> None:
    """Calibrate: boresight, range offset and the rest of the sensor model, with sigmas, from logs alone.

    What this flight cannot determine is held, and said. Exit code 1 where no calibration could be made that would
    be worth its name, then no file is written; or where its verdict is "Not to be used", unless --accept-verdict
    is given: the verdict stands in the file all the same.
    """
    require_installed("swath calibrate", *(PRINTED_PAGES if report else ()))
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

    _refuse(output, observe, overwrite=overwrite)
    if facts is not None and report is None:
        raise UserError("--facts: they stand in the record; want --report DIR, too", ExitCode.USAGE)
    wish = CalibrationOptions(
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
        control=control,
        ties=ties,
        polygons=polygons,
        observe=tuple(observe.split(",")),
        report=report,
        facts={} if facts is None else facts_of(facts),
        limit_deg=limit_deg,
        limit_m=limit_m,
        overwrite=overwrite,
    )
    with tempfile.TemporaryDirectory(prefix="swath-", dir=output.resolve().parent) as folder, progress_bar() as tell:
        told = write_products(wish, calibrate(wish, Path(folder), tell), tell)
    print(json.dumps(told.record, indent=2) if as_json else "\n".join(map(one_line, told.lines)))
    for line in told.warnings:
        print(one_line(f"swath: {line}"), file=sys.stderr)
    if told.record["verdict"]["level"] == "unusable" and not accept_verdict:
        raise UserError(f"{output}: {one_line(told.record['verdict']['sentence'])}")


def _refuse(output: Path, observe: str, *, overwrite: bool) -> None:
    unknown = [word for word in observe.split(",") if word not in OBSERVE]
    if unknown:
        raise UserError(f'--observe: got "{unknown[0]}", want {", ".join(OBSERVE)}', ExitCode.USAGE)
    if {"planes", "ties"} <= set(observe.split(",")):
        raise UserError("--observe: planes and ties are of the same returns; want one of both", ExitCode.USAGE)
    if output.is_file() and not overwrite:
        raise UserError(f"{output}: is there already; want another name, or --overwrite", ExitCode.USAGE)
    if not output.resolve().parent.is_dir():
        raise UserError(f"{output}: no such folder: {output.parent}", ExitCode.USAGE)
