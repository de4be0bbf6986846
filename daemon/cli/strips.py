"""The command ``swath strips``: compares strips, or corrects their trajectory with the calibration held."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from swath.daemon.cli.options import (
    AcceptVerdict,
    ControlColumns,
    ControlCrs,
    ControlPath,
    ForceTrajectory,
    TrajectoryDatum,
    TrajectoryPoint,
)
from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.processing.requirements import PRINTED_PAGES, require_installed

if TYPE_CHECKING:
    from swath.daemon.processing.control.files import ControlFile
    from swath.daemon.processing.flights.read import GeorefOptions

SMALLEST_CELL_M, LARGEST_CELL_M = 0.05, 100.0
LEVELS = ("QL0", "QL1", "QL2", "QL3")


def command(
    paths: Annotated[
        list[Path],
        typer.Argument(help="Folder of swath georef, LAS or LAZ files, or logs.", metavar="DIR|LOG…", readable=False),
    ],
    before: Annotated[
        list[Path] | None,
        typer.Option(metavar="DIR|LOG", help="An earlier version of the same strips, to compare with; repeatable."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Folder for page, PDF, difference maps and strips.json."),
    ] = None,
    level: Annotated[
        str | None, typer.Option(help="Quality level that the strips must meet: QL0, QL1, QL2 or QL3.")
    ] = None,
    cells: Annotated[int, typer.Option(help="Number of cells of the overlap to examine.", min=100)] = 20_000,
    cell: Annotated[
        float | None,
        typer.Option(
            "--cell", metavar="METRES", help="Side of a cell; default: from the density of the sparsest strip."
        ),
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="For logs: SBET, Waypoint text or CSV; default: computed from their IMU and GNSS."
        ),
    ] = None,
    at: TrajectoryPoint = "body",
    week: Annotated[
        int | None, typer.Option(help="GPS week, if the trajectory or the point files hold none.", min=0)
    ] = None,
    calibration: Annotated[
        list[str] | None,
        typer.Option(metavar="[SCANNER=]FILE", help="For logs: use this calibration instead of their own."),
    ] = None,
    datum: TrajectoryDatum = None,
    config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="For logs: configuration; default: their own.")
    ] = None,
    strips: Annotated[
        str, typer.Option(help="For logs: how to divide the flight: auto, whole, or a CSV of times.")
    ] = "auto",
    adjust: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Correct the trajectory of each strip with a fixed calibration; write to DIR."
        ),
    ] = None,
    control: ControlPath = None,
    control_crs: ControlCrs = None,
    control_columns: ControlColumns = None,
    strip_model: Annotated[
        str,
        typer.Option(
            "--strip-model", help="Correction for --adjust: none, constant, linear, spline, or auto (chosen per strip)."
        ),
    ] = "auto",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files of an earlier run.")] = False,
    workers: Annotated[int | None, typer.Option(help="Number of processes; default: one per processor.", min=1)] = None,
    force_trajectory: ForceTrajectory = False,
    accept_verdict: AcceptVerdict = False,
    all_pairs: Annotated[bool, typer.Option("--all-pairs", help="List every pair, not only the ten worst.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
) -> None:
    """Compare overlapping strips, point to plane and gridded; find the pattern of the differences and judge them.

    With --adjust, correct the trajectory of each strip instead and write files for swath georef --trajectory.

    Exit code 1 when the differences show a significant calibration error, when --level is not met, when strips are
    too far apart to find the cause, when there are too few cells for a verdict, or when no strips could be compared.
    """
    require_installed("swath strips", *(PRINTED_PAGES if output else ()))
    from swath.daemon.cli.georef import calibrations_given
    from swath.daemon.config import load_config
    from swath.daemon.processing.control.files import read_control_file
    from swath.daemon.processing.flights.read import GeorefOptions
    from swath.daemon.processing.flights.trajectory_choice import TrajectoryOptions
    from swath.daemon.processing.setup.setup import Options

    if cell is not None and not SMALLEST_CELL_M <= cell <= LARGEST_CELL_M:
        wanted = f"{SMALLEST_CELL_M:g} to {LARGEST_CELL_M:g} metres"
        raise UserError(f"--cell: got {cell:g}, want {wanted}", ExitCode.USAGE)
    if level is not None and level not in LEVELS:
        raise UserError(f'--level: got "{level}", want one of {", ".join(LEVELS)}', ExitCode.USAGE)
    logs = GeorefOptions(
        logs=paths,
        output=output or Path(),
        trajectory=TrajectoryOptions(trajectory, week, at, navigate=True, force=force_trajectory),
        options=Options(
            datum=datum, calibrations=calibrations_given(calibration or []), uncertainty=False, force_crs=True
        ),
        config=None if config is None else load_config(config),
        strips=strips,
        workers=workers or os.cpu_count() or 1,
        accept_verdict=accept_verdict,
    )
    if adjust is not None:
        _refuse_besides(("--before", before), ("--output", output), ("--level", level), ("--cell", cell))
        surveyed = read_control_file(control, control_crs, control_columns)
        _adjust(logs, adjust, surveyed, strip_model, overwrite=overwrite, as_json=as_json)
        return
    if control or control_crs or control_columns or strip_model != "auto":
        of_control = control or control_crs or control_columns
        named = "--control" if of_control else "--strip-model"
        raise UserError(f"{named} needs --adjust DIR, because only an adjustment uses it", ExitCode.USAGE)
    _compare(
        logs, before or (), (cells, cell), output, level, overwrite=overwrite, as_json=as_json, all_pairs=all_pairs
    )


def _compare(
    logs: GeorefOptions,
    before: Sequence[Path],
    cells: tuple[int, float | None],
    output: Path | None,
    level: str | None,
    *,
    overwrite: bool,
    as_json: bool,
    all_pairs: bool,
) -> None:
    from swath.daemon.cli.progress import progress_bar
    from swath.daemon.processing.carried_verdict import acceptance
    from swath.daemon.processing.earlier_runs import refuse_existing
    from swath.daemon.processing.pages.names import STRIPS
    from swath.daemon.processing.strip_agreement import MORE_CELLS
    from swath.daemon.processing.strips.compare import RECORD, StripsOptions, compare_strips, rules_of
    from swath.daemon.processing.strips.console import comparison_lines

    if output is not None:
        refuse_existing((output / RECORD, output / STRIPS), overwrite=overwrite)
    elif overwrite:
        raise UserError("--overwrite needs --output or --adjust, because nothing is written otherwise", ExitCode.USAGE)
    request = StripsOptions(logs.logs, logs, before, rules_of(*cells), level)
    warnings: list[str] = []
    written: list[Path] = []
    with tempfile.TemporaryDirectory(prefix="swath-") as folder, progress_bar(compiling=True) as tell:
        done = compare_strips(request, Path(folder), tell)
        if output is not None:
            from swath.daemon.processing.strips.page import write_comparison

            tell("page", 0, 0)
            written = write_comparison(done, output, level, warnings)
    lines = [*comparison_lines(done, level, all_pairs=all_pairs), *map(str, written)]
    print(json.dumps(done.record, indent=2) if as_json else "\n".join(map(one_line, lines)))
    for line in warnings:
        print(one_line(f"swath: {line}"), file=sys.stderr)
    if done.problem:  # stdout has the verdict
        remedy = MORE_CELLS if done.now.agreement.no_verdict else ""
        raise UserError(done.problem if as_json else acceptance(done.record["verdict"]) or remedy)


def _adjust(
    logs: GeorefOptions, folder: Path, control: ControlFile | None, strip_model: str, *, overwrite: bool, as_json: bool
) -> None:
    from swath.daemon.cli.progress import progress_bar
    from swath.daemon.processing.carried_verdict import acceptance, refusal
    from swath.daemon.processing.strips.adjust import AdjustOptions, correct_strips
    from swath.daemon.processing.strips.adjust_products import write_adjustment

    request = AdjustOptions(logs, folder, control, strip_model, overwrite)
    with tempfile.TemporaryDirectory(prefix="swath-") as returns, progress_bar(compiling=True) as tell:
        products = write_adjustment(request, correct_strips(request, Path(returns), tell), tell)
    print(json.dumps(products.record, indent=2) if as_json else "\n".join(map(one_line, products.lines)))
    if line := refusal(products.record["verdict"]):
        raise UserError(line if as_json else acceptance(products.record["verdict"]))  # stdout has the verdict


def _refuse_besides(*given: tuple[str, object]) -> None:
    for option, value in given:
        if value:
            raise UserError(f"{option} is for a comparison; use it without --adjust", ExitCode.USAGE)
