"""The command ``swath recover``: repairs logs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.written import error_words

if TYPE_CHECKING:
    from swath.daemon.log.recover import RecoveryReport


def command(
    logs: Annotated[list[Path], typer.Argument(help="Logs, or directories of logs.", metavar="LOG…")],
    output: Annotated[
        Path | None, typer.Option(help="Folder for the repaired copies; default: beside the log.")
    ] = None,
    keep_free_mb: Annotated[float, typer.Option(help="Repair only if this much disk stays free, in MB.", min=0)] = 0.0,
    background: Annotated[bool, typer.Option("--background", help="Run at idle CPU and I/O priority.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
) -> None:
    """Check every CRC, save all intact data into LOG.recovered.mcap and report exactly what was lost.

    The log itself stays unchanged. In a directory, logs that are being recorded or were already recovered are left
    out. Exit code 4 when damage was found (an index that a kill left missing is none), 3 when a log could not be
    recovered (the others still are).
    """
    from swath.daemon.cli.progress import progress_bar
    from swath.daemon.log.format import LogError
    from swath.daemon.log.recover import recover
    from swath.daemon.system import give_way

    if background:
        give_way()
    reports = []
    refused: list[str] = []
    with progress_bar() as tell:
        for path in _files(logs, output):
            try:
                report = recover(path, output, keep_free_bytes=round(keep_free_mb * 1e6), tell=tell)
            except LogError as error:
                refused.append(str(error))
            except OSError as error:
                refused.append(error_words(error, path))
            else:
                reports.append(report)
                if not as_json:
                    _print_report(report)
    if as_json:
        print(json.dumps({"logs": [report.plain() for report in reports], "refused": refused}, indent=2))
    elif not reports and not refused:
        print("nothing to recover: every log is being recorded or was already recovered")
    if refused:
        raise UserError("\n".join(map(one_line, refused)), ExitCode.IO)
    if not all(report.index_only for report in reports):
        raise typer.Exit(int(ExitCode.DAMAGE))


def _files(paths: list[Path], output: Path | None) -> list[Path]:
    """Return the named files, and those of the named directories that may need recovery."""
    from swath.daemon.log.claim import is_being_written
    from swath.daemon.log.reader import RECOVERED

    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            found = sorted(path.glob("*.mcap"))
            if not found:
                raise UserError(f"{path}: contains no logs (*.mcap)", ExitCode.IO)
            for file in found:
                copy = (output or path) / (file.name.removesuffix(".mcap") + RECOVERED)
                if not (file.name.endswith(RECOVERED) or copy.exists() or is_being_written(file)):
                    files.append(file)
        elif path.is_file():
            files.append(path)
        else:
            raise UserError(f"{path}: no such file or directory", ExitCode.IO)
    return files


def _print_report(report: RecoveryReport) -> None:
    count = sum(report.messages.values())
    if report.whole:
        print(f"{report.path}: intact, {report.chunks} chunks, {count} messages; nothing to do")
        return
    if report.index_only:
        print(f"{report.path}: only its index was missing; {count} messages, all of them, saved in {report.recovered}")
        return
    lost = "" if report.messages_lost is None else f", {report.messages_lost} lost"
    print(f"{report.path}: {report.chunks} good chunks, {count} messages saved in {report.recovered}{lost}")
    for item in report.damage:
        messages = "" if item.messages is None else f", {item.messages} messages lost"
        print(f"  at byte {item.offset}: {item.length} bytes, {item.what}{messages}")
