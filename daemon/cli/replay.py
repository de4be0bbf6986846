"""The command ``swath replay``: sends the bytes of a log over wires again."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from swath.daemon.written import note_done
from swath.georef.progress import BYTES

INTERRUPTED = 130  # 128 + SIGINT

if TYPE_CHECKING:
    from rich.console import Console

    from swath.daemon.log.reader import Session
    from swath.daemon.replay.wire_player import Output, PlayReport


def command(
    logs: Annotated[list[Path], typer.Argument(help="Logs, or a directory of logs.", metavar="LOG…")],
    wire: Annotated[Path, typer.Option(help="Configuration that names the ports, buses and FIFOs to write to.")],
    pace: Annotated[float, typer.Option(help="Speed factor; PPS edges are written at 1 only.")] = 1.0,
    wait: Annotated[float, typer.Option(help="Seconds to wait until every port and FIFO has a reader.", min=0)] = 10.0,
) -> None:
    """Play back the bytes of a log on ptys, CAN, UDP and TCP, and its PPS edges into fixed: FIFOs."""
    from rich.console import Console

    from swath.daemon.config import load_config
    from swath.daemon.errors import ExitCode, UserError
    from swath.daemon.replay.units import close_outputs, open_outputs
    from swath.daemon.replay.wire_player import PlayReport, wait_for_readers

    note_done("nothing played")
    if not 0 < pace < math.inf:
        raise UserError(f"--pace {pace}: must be a number above 0", exit_code=ExitCode.USAGE)
    config = load_config(wire)
    console = Console(stderr=True, markup=False, highlight=False)
    sessions = _open_sessions(logs, console)
    stop: list[int] = []
    for signum in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signum, lambda number, frame: stop.append(number))
    try:
        outputs = open_outputs(config, with_pps=pace == 1.0)
    except OSError as error:
        raise UserError(str(error), exit_code=ExitCode.IO) from error
    try:
        waited_for = wait_for_readers(outputs, wait, lambda: bool(stop))
        for source in [] if stop else waited_for:
            console.print(f"{source}: no reader has opened it; playing without one")
        for number, session in enumerate(sessions):
            report = PlayReport() if stop else _play_session(session, outputs, pace, lambda: bool(stop))
            if stop:
                note_done(_played_words(report, session, number))
                raise typer.Exit(INTERRUPTED)
            _tell_report(report, session, outputs, wire, console)
    finally:
        close_outputs(outputs)


def _played_words(report: PlayReport, session: Session, whole: int) -> str:
    """Return what was played up to an interrupt: whole sessions, then the begun one."""
    count = report.units.total()
    begun = f"{report.played_s:.1f} s of {session.session_id} ({count:,} unit{'s' if count > 1 else ''})"
    before = f"{whole} whole session{'s' if whole > 1 else ''}"
    parts = [*([before] if whole else []), *([begun] if report.units else [])]
    return f"played {' and '.join(parts)}" if parts else "nothing played"


def _open_sessions(logs: list[Path], console: Console) -> list[Session]:
    from swath.daemon.errors import ExitCode, UserError, one_line
    from swath.daemon.log.format import LogError
    from swath.daemon.log.reader import open_logs

    left_out: list[str] = []
    try:
        sessions = open_logs(logs, left_out)
    except LogError as error:
        raise UserError(str(error), exit_code=ExitCode.IO) from error
    for line in left_out:
        console.print(f"passed over: {one_line(line)}")
    return sessions


def _play_session(
    session: Session, outputs: Mapping[str, Output], pace: float, stopped: Callable[[], bool]
) -> PlayReport:
    from swath.daemon.cli.progress import progress_bar
    from swath.daemon.replay.units import timed_units
    from swath.daemon.replay.wire_player import play

    with progress_bar() as tell:
        session.progress = lambda done, total: tell(f"playing {session.session_id}", done, total, BYTES)
        return play(timed_units(session, with_pps=pace == 1.0), outputs, pace=pace, stopped=stopped)


def _tell_report(
    report: PlayReport, session: Session, outputs: Mapping[str, Output], wire: Path, console: Console
) -> None:
    if report.jumps:
        console.print(f"{session.session_id}: skipped the waiting at {report.jumps} time gaps of more than an hour")
    for source in sorted(report.passed_over):
        console.print(f"{source}: is in the log but not in {wire}; not played")
    for source in sorted(outputs):
        if not report.units[source] and not report.refused[source]:
            console.print(f"{source}: no data for it in {session.session_id}")
            continue
        refused = f", {report.refused[source]} rejected by a reader" if report.refused[source] else ""
        console.print(f"{source}: {report.units[source]} units, {report.bytes[source]} bytes{refused}")
