"""The command ``swath export``: writes logs as the files of the devices' own tools."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.written import Reached, error_words, room_noted
from swath.georef.progress import BYTES, Tell

if TYPE_CHECKING:
    from swath.daemon.exchange.export import ExportReport
    from swath.daemon.log.reader import Session

LEAST_OF_LOG, MOST_OF_LOG = 0.7, 3.0  # size of exported files by that of the log, whose chunks are compressed


def command(
    logs: Annotated[list[Path], typer.Argument(help="Logs, or directories of logs.", metavar="LOG…")],
    directory: Annotated[
        Path, typer.Argument(help="Destination; each session gets its own folder in it.", metavar="DIR")
    ],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace earlier exports of the logs.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
) -> None:
    """Write logs as serial streams (with RTKLIB's time tags), candump logs, pcap files and PPS text.

    What these formats cannot hold goes into a small file beside each; with it `swath import` makes the same log again.
        Exit code 4 when the log is damaged; everything readable is still written.
    """
    from swath.daemon.cli.progress import progress_bar
    from swath.daemon.exchange.export import export_session
    from swath.daemon.free_space import check_space
    from swath.daemon.log.format import LogError
    from swath.daemon.log.reader import open_logs

    passed_over: list[str] = []
    done: list[tuple[Session, ExportReport]] = []
    try:
        with progress_bar() as tell:
            sessions = open_logs(logs, passed_over)
            size = sum(part.path.stat().st_size for session in sessions for part in session.parts)
            check_space(directory, "exported files", least_bytes=LEAST_OF_LOG * size, most_bytes=MOST_OF_LOG * size)
            for session in sessions:
                reached = Reached(partial(_tell, tell, session.session_id))
                session.progress = reached
                with room_noted(directory, reached.share):
                    done.append((session, export_session(session, directory, overwrite=overwrite)))
    except LogError as error:
        raise UserError(one_line(str(error)), ExitCode.IO) from error
    except OSError as error:
        raise UserError(one_line(error_words(error, directory)), ExitCode.IO) from error
    if as_json:
        print(json.dumps({"sessions": [_plain(*one) for one in done], "passed_over": passed_over}, indent=2))
    else:
        for session, report in done:
            _print(session, report)
    lines = [f"passed over: {line}" for line in passed_over]
    lines += [_damage(session) for session, _ in done if session.damage]
    if lines:
        raise UserError("\n".join(map(one_line, lines)), ExitCode.DAMAGE)
    if any(session.missing_parts for session, _ in done):
        raise typer.Exit(int(ExitCode.PROBLEM))


def _tell(tell: Tell, name: str, done: int, total: int) -> None:
    tell(f"exporting {name}", done, total, BYTES)


def _plain(session: Session, report: ExportReport) -> dict[str, object]:
    return {
        "session_id": session.session_id,
        "folder": str(report.folder),
        "files": report.files,
        "units": dict(report.units),
        "notes": report.notes,
        "missing_parts": session.missing_parts,
        "growing": None if session.growing is None else session.growing.name,
        "damage": [f"{one.path.name} at byte {one.damage.offset}: {one.damage.what}" for one in session.damage],
    }


def _print(session: Session, report: ExportReport) -> None:
    print(one_line(str(report.folder)))
    for name, entry in report.files.items():
        print(f"  {name}: {entry['kind']}, {entry['units']} units")
    for note in report.notes:
        print(one_line(f"  note: {note}"))
    for number in session.missing_parts:
        print(f"  part {number} is missing")
    if session.growing is not None:
        print(one_line(f"  {session.growing.name} is still being recorded; exported up to now"))


def _damage(session: Session) -> str:
    first = session.damage[0]
    more = f" ({len(session.damage)} such places)" if len(session.damage) > 1 else ""
    return f"{first.path} at byte {first.damage.offset}: {first.damage.what}{more}; everything readable was written"
