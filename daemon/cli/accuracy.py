"""The command ``swath accuracy``: says how sure points are, and differences of points."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated

import typer

from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.processing.requirements import require_installed


def command(
    points: Annotated[
        list[Path] | None,
        typer.Argument(help="LAZ files of swath georef --error-model.", metavar="LAZ…", readable=False),
    ] = None,
    at: Annotated[
        str | None, typer.Option(metavar="E,N", help="A place: the nearest point of each strip within 2 m.")
    ] = None,
    between: Annotated[
        tuple[str, str] | None,
        typer.Option(metavar="E,N E,N", help="Two places: the difference of their nearest points."),
    ] = None,
    volume: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A polygon, GeoJSON or lines of easting,northing: its volume over --base."),
    ] = None,
    base: Annotated[float | None, typer.Option(metavar="H", help="Height of the base of --volume.")] = None,
    pairs: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="Pairs of points: columns file_1, point_1, file_2, point_2; rows from 0."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="CSV", help="Where --pairs writes its answers.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the answers of an earlier run.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
) -> None:
    """Say how sure points are, and how sure the difference of two points is, by the run's error model.

    A difference is surer than its points: neighbours share the errors of trajectory and calibration. Places are
    easting and northing in the files' CRS and units. Sigmas are in metres, whatever the files' units.
    """
    require_installed("swath accuracy")
    from swath.daemon.processing.earlier_runs import refuse_existing
    from swath.daemon.processing.error_model import answers

    asked = [
        name
        for name, value in (("--at", at), ("--between", between), ("--pairs", pairs), ("--volume", volume))
        if value is not None
    ]
    if len(asked) != 1:
        raise UserError("give one of --at E,N, --between E,N E,N, --volume FILE and --pairs CSV", ExitCode.USAGE)
    if (base is None) != (volume is None):
        raise UserError("--volume FILE and --base H go together", ExitCode.USAGE)
    if pairs is not None:
        if output is None or points:
            raise UserError(
                "--pairs CSV needs -o CSV for the answers, and no LAZ: the table names them", ExitCode.USAGE
            )
        refuse_existing((output,), overwrite=overwrite)
        count = answers.answer_pairs(pairs, output)
        print(json.dumps({"pairs": count, "file": str(output)}) if as_json else f"{count:,} pairs: {output}")
        return
    if not points or output is not None:
        raise UserError(f"{asked[0]} needs LAZ… of swath georef --error-model, and no -o", ExitCode.USAGE)
    if volume is not None and base is not None:
        from swath.daemon.processing.error_model import volume as volumes

        measured = volumes.volume(points, volumes.read_polygon(volume), base)
        print(json.dumps(measured, indent=2) if as_json else "\n".join(map(one_line, volumes.volume_lines(measured))))
    elif at is not None:
        told = answers.at_place(points, _place(at, "--at"))
        lines = answers.point_lines(told)
        print(json.dumps(told, indent=2) if as_json else "\n".join(map(one_line, lines)))
    elif between is not None:
        first, second = (_place(text, "--between") for text in between)
        difference = answers.between(points, first, second)
        lines = answers.difference_lines(difference)
        print(json.dumps(difference, indent=2) if as_json else "\n".join(map(one_line, lines)))


def _place(text: str, option: str) -> tuple[float, float]:
    try:
        east, north = (float(part) for part in text.split(","))
    except ValueError:
        east = north = math.nan
    if not (math.isfinite(east) and math.isfinite(north)):
        raise UserError(f'{option} "{text}": want easting and northing, as 477244.9,5218927.2', ExitCode.USAGE)
    return east, north
