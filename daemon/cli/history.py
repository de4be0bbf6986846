"""The command ``swath history``: shows the parameters of all calibrations of an aircraft over time."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from swath.daemon.errors import one_line
from swath.daemon.processing.requirements import PRINTED_PAGES, require_installed


def command(
    paths: Annotated[
        list[Path],
        typer.Argument(
            help="Folders with calibrations of swath calibrate, at any depth, or such files.",
            metavar="DIR|FILE…",
            readable=False,
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Folder for a page with pictures, its PDF, and a CSV."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files of an earlier run.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
) -> None:
    """Show the parameters of all calibrations over time, scanner by scanner, and test what has changed.

    Reads calibration files, and records (NAME.record.json) of calibrations whose files are gone. Each calibration is
    compared with the one before; each parameter of a mounting is called constant, drifting or changed at one time.
    """
    require_installed("swath history", *(PRINTED_PAGES if output else ()))
    from swath.daemon.processing.earlier_runs import refuse_existing
    from swath.daemon.processing.history.run import collect, history_lines
    from swath.daemon.processing.pages.names import HISTORY, HISTORY_TABLE

    if output is not None:
        refuse_existing((output / HISTORY, output / HISTORY_TABLE), overwrite=overwrite)
    found = collect(paths)
    warnings: list[str] = []
    written: list[Path] = []
    if output is not None:
        from swath.daemon.processing.history.page import write_history

        written = write_history(found, output, warnings)
    if as_json:
        print(json.dumps(found.record(), indent=2))
    else:
        print("\n".join(map(one_line, [*history_lines(found), *map(str, written)])))
    for line in warnings:
        print(one_line(f"swath: {line}"), file=sys.stderr)
