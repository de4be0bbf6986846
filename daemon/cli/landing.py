"""The command ``swath landing``: says whether a flight may end, from what live has written."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.log.directory import DEFAULT_CONFIG, log_directory
from swath.daemon.processing.requirements import PRINTED_PAGES, require_installed
from swath.daemon.written import error_words

HTML = ".html"


def command(
    where: Annotated[
        Path,
        typer.Argument(
            metavar="[CONFIG|DIR]",
            help="Configuration or log directory of the recorder, or a folder of swath live's files.",
            readable=False,
        ),
    ] = DEFAULT_CONFIG,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="NAME.html", help="Also write a page, and its PDF beside it."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files of an earlier run.")] = False,
    predict: Annotated[
        bool,
        typer.Option(
            "--predict/--no-predict", help="Predict what the lines flown determine of the calibration: half a minute."
        ),
    ] = True,
    base: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE", help="RINEX observations of a base station, also packed by gzip; for each file once."
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the verdict as one JSON object.")] = False,
) -> None:
    """Say before landing whether to fly again or to go home, and why.

    Reads what `swath live` has written: lines, gaps, density, overlap, calibration lines, base data, the log. Exit
    code 1: something is to be flown again, or has not been flown.
    """
    require_installed("swath landing", *(PRINTED_PAGES if output else ()))
    from swath.daemon.processing.landing.command import FLY_AGAIN
    from swath.daemon.processing.landing.page import read_verdict

    if output is not None and output.suffix.lower() != HTML:
        raise UserError(f"-o: got {one_line(str(output))}, want a name that ends in {HTML}", ExitCode.USAGE)
    live = _folder(where)
    found = read_verdict(live)
    if base:
        from swath.daemon.processing.landing.base import with_base

        found = with_base(found, base)
    found["predicted"] = _predicted(live, str(found.get("session_id")), predict=predict)
    warnings: list[str] = []
    written = [] if output is None else _write(live, found, output, warnings, overwrite=overwrite)
    if as_json:
        print(json.dumps(found, indent=2))
    else:
        print("\n".join(map(one_line, [*_lines(found), *map(str, written)])))
    for line in warnings:
        print(one_line(f"swath: {line}"), file=sys.stderr)
    if found["state"] == FLY_AGAIN:
        raise typer.Exit(int(ExitCode.PROBLEM))  # stdout has the verdict


def _folder(where: Path) -> Path:
    from swath.daemon.processing.landing.command import VERDICT
    from swath.daemon.processing.live.tiles import FOLDER

    return where if (where / VERDICT).is_file() else log_directory(where) / FOLDER


def _predicted(live: Path, session_id: str, *, predict: bool) -> dict[str, Any]:
    """Return what the lines flown would determine of the calibration, or the last prediction of it."""
    from swath.daemon.processing.landing.command import PREDICTED

    if not predict:
        try:
            found = json.loads((live / PREDICTED).read_bytes())
        except (OSError, ValueError):
            return {}
        return found if isinstance(found, dict) else {}
    from swath.daemon.processing.landing.predict import prediction_of

    return prediction_of(live, live.parent, session_id)


def _lines(found: dict[str, Any]) -> list[str]:
    from swath.daemon.processing.landing.page import prediction_lines

    width = max(len(check["title"]) for check in found["checks"])
    checks = [f"{check['title']:{width}}  {check['state']:7}  {check['text']}" for check in found["checks"]]
    return [found["sentence"], *checks, *prediction_lines(found["predicted"])]


def _write(live: Path, found: dict[str, Any], page: Path, warnings: list[str], *, overwrite: bool) -> list[Path]:
    """Write the page and its PDF; return what was written."""
    from swath.daemon.processing.earlier_runs import refuse_existing
    from swath.daemon.processing.landing.page import landing_page
    from swath.daemon.processing.live.files import replace_file
    from swath.daemon.processing.pages.pdf import page_files

    refuse_existing([page], overwrite=overwrite, instead="name")
    files = page_files(page, landing_page(live, found), warnings)
    try:
        for path, data in files.items():  # without a sync, which a recorder beside it would feel
            replace_file(path, data)
    except OSError as error:
        raise UserError(one_line(error_words(error, page)), ExitCode.IO) from error
    return list(files)
