"""The command ``swath plan-calibration``: predicts before take-off what a flight would determine of the calibration."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from swath.daemon.cli.sim import PlanArgument
from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.processing.requirements import PRINTED_PAGES, require_installed
from swath.daemon.written import error_words

if TYPE_CHECKING:
    from rich.console import Console

    from swath.daemon.processing.calibration.plan.run import PlannedCalibration


def command(
    plan: PlanArgument,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="NAME.html (page and PDF), or a picture: PNG, PDF, SVG; default: PLAN-calibration.png in this folder.",
        ),
    ] = None,
    model: Annotated[str, typer.Option(help="Parameters to estimate: basic, scanner, full, or FILE.toml.")] = "scanner",
    sigmas: Annotated[
        str | None,
        typer.Option(
            metavar="P,R,H",
            help="Expected trajectory sigmas: position (m), roll and pitch, heading (degrees); default: from the plan.",
        ),
    ] = None,
    no_control: Annotated[bool, typer.Option("--no-control", help="Leave out the plan's control points.")] = False,
    control_sigma: Annotated[
        float,
        typer.Option(
            "--control-sigma", metavar="M", help="Sigma of the control points, in metres.", min=0.0005, max=1.0
        ),
    ] = 0.01,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files of an earlier run.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
) -> None:
    """Predict how well a planned flight determines the calibration: the sigma of each parameter, or why it has none.

    Computes which roofs, ground and control points the flight lines see, and puts them through the equations of
    `swath calibrate`. Exit code 1 when the flight would not determine boresight or range offset.
    """
    require_installed("swath plan-calibration", *PRINTED_PAGES)
    from swath.daemon.cli.progress import page_console, progress_bar
    from swath.daemon.processing.calibration.model import model_of
    from swath.daemon.processing.calibration.plan.page import require_picture
    from swath.daemon.processing.calibration.plan.run import PlanOptions, plan_calibration
    from swath.daemon.processing.earlier_runs import refuse_existing
    from swath.daemon.simulate.plans import FlightOptions

    picture = output if output is not None else Path(f"{Path(plan).stem}-calibration.png")
    require_picture(picture)
    refuse_existing([picture], overwrite=overwrite, instead="name")
    asked = PlanOptions(model_of(model), None if sigmas is None else _three(sigmas), not no_control, control_sigma)
    flight = FlightOptions(plan)
    warnings: list[str] = []
    with progress_bar(compiling=True) as tell, flight.as_user_errors():
        planned = plan_calibration(flight.load(), asked, tell)
        tell("picture", 0, 0)
        try:
            written = _write(planned, picture, warnings)
        except OSError as error:
            raise UserError(one_line(error_words(error, picture)), ExitCode.IO) from error
    if as_json:
        print(json.dumps(_document(planned, picture), indent=2))
    else:
        _print(page_console(), planned, written)
    for line in warnings:
        print(one_line(f"swath: {line}"), file=sys.stderr)
    if planned.lacking:
        if as_json:
            raise UserError(one_line(f"{plan}: {planned.sentence}"))
        raise typer.Exit(int(ExitCode.PROBLEM))  # stdout has the verdict


def _write(planned: PlannedCalibration, path: Path, warnings: list[str]) -> list[Path]:
    """Write the page with its PDF, or the picture; return what was written."""
    from swath.daemon.processing.calibration.plan.document import HTML, write_planned
    from swath.daemon.processing.calibration.plan.page import draw_planned
    from swath.daemon.processing.files import aside_folder

    with aside_folder(path.parent) as folder:
        aside = folder / path.name
        if path.suffix.lower() == HTML:
            made = write_planned(planned, aside, warnings)
        else:
            draw_planned(planned, aside)
            made = [aside]
    return [path.parent / one.name for one in made]


def _three(text: str) -> tuple[float, float, float]:
    try:
        position_m, tilt_deg, heading_deg = (float(part) for part in text.split(","))
    except ValueError as error:
        wanted = "want three numbers: position (m), roll and pitch, heading (degrees), such as 0.02,0.004,0.01"
        raise UserError(f'--sigmas: got "{one_line(text)}", {wanted}', ExitCode.USAGE) from error
    if not 0.0 < min(position_m, tilt_deg, heading_deg) <= max(position_m, tilt_deg, heading_deg) < 100.0:
        raise UserError(f'--sigmas: got "{one_line(text)}", want numbers above 0 and below 100', ExitCode.USAGE)
    return position_m, tilt_deg, heading_deg


def _document(planned: PlannedCalibration, picture: Path) -> dict[str, Any]:
    return {
        "verdict": planned.sentence,
        "notes": planned.notes,
        "parameters": [{key: value for key, value in row.items() if key != "basic"} for row in planned.rows],
        "planes": planned.predicted.planes,
        "control_points": planned.control,
        "trajectory_sigmas": dict(zip(("position_m", "roll_pitch_deg", "heading_deg"), planned.sigmas, strict=True)),
        "picture": str(picture),
    }


def _print(console: Console, planned: PlannedCalibration, written: list[Path]) -> None:
    from rich.table import Table

    from swath.daemon.processing.calibration.plan.document import sigma_words

    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in ("scanner", "parameter", "unit", "sigma", "wanted", "determined"):
        table.add_column(column, justify="right" if column in ("sigma", "wanted") else "left")
    for row in planned.rows:
        word = "yes" if row["determined"] else "no"
        words = one_line(row["scanner"]), row["name"], row["unit"], sigma_words(row["sigma"])
        table.add_row(*words, f"{row['wanted']:.3g}", word)
    console.print(table)
    for row in planned.rows:
        if row["why"]:
            print(one_line(f"{row['scanner']} {row['name']}: {row['why']}; to determine it: {row['remedy']}"))
    for note in planned.notes:
        print(one_line(note))
    print(planned.sentence)
    for path in written:
        print(one_line(str(path)))
