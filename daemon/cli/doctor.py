"""The command ``swath doctor``: checks whether this computer is fit to record."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from swath.daemon.errors import ExitCode, one_line
from swath.daemon.log.directory import DEFAULT_CONFIG

if TYPE_CHECKING:
    from swath.daemon.doctor import Finding


def command(
    config: Annotated[
        Path | None,
        typer.Argument(
            metavar="[CONFIG]",
            help="Configuration of the recorder; default: /etc/swath/swath.toml if it exists.",
            show_default=False,
        ),
    ] = None,
    write: Annotated[bool, typer.Option(help="Measure the disk by writing 64 MiB to the log directory.")] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
) -> None:
    """Check whether this computer can record without losing data; show a remedy for each problem.

    Opens no device and changes no setting. Exit code 1 when a problem would cost data.
    """
    from swath.daemon.config import load_config
    from swath.daemon.doctor import Verdict, examine

    path = config if config is not None else DEFAULT_CONFIG if DEFAULT_CONFIG.exists() else None
    loaded = None if path is None else load_config(path, to_record=True)
    findings = list(examine(loaded, write=write))
    fine = all(finding.verdict is not Verdict.WRONG for finding in findings)
    if as_json:
        rows = [
            {"check": one.check, "verdict": str(one.verdict), "text": one.text, "mend": one.mend} for one in findings
        ]
        print(json.dumps({"config": None if path is None else str(path), "ok": fine, "findings": rows}, indent=2))
    else:
        _print(findings)
    if not fine:
        raise typer.Exit(int(ExitCode.PROBLEM))


def _print(findings: list[Finding]) -> None:
    from rich.text import Text

    from swath.daemon.cli.progress import page_console

    style = {"ok": "green", "note": "yellow", "wrong": "bold red"}
    width = max(len(finding.check) for finding in findings)
    console = page_console()
    for finding in findings:
        line = Text(f"{finding.verdict:<6}", style=style[finding.verdict])
        line.append(f"{finding.check:<{width}}  {one_line(finding.text)}", style="default")
        console.print(line, soft_wrap=True)
        if finding.mend:
            console.print(Text(f"{'':{width + 8}}{one_line(finding.mend)}", style="dim"), soft_wrap=True)
