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
    from collections.abc import Callable

    from swath.daemon.exchange.export import ExportReport
    from swath.daemon.log.reader import PartDamage, Session
    from swath.daemon.processing.records.files import RecordFiles
    from swath.daemon.processing.records.ros2 import RosExport

LEAST_OF_RECORDS, MOST_OF_RECORDS = 0.1, 8.0  # the same of records: a slice as Parquet, and all as text
LEAST_OF_LOG, MOST_OF_LOG = 0.7, 3.0  # size of exported files by that of the log, whose chunks are compressed


def command(
    logs: Annotated[list[Path], typer.Argument(help="Logs, or directories of logs.", metavar="LOG…")],
    directory: Annotated[
        Path, typer.Argument(help="Destination; each session gets its own folder in it.", metavar="DIR")
    ],
    records: Annotated[
        str | None,
        typer.Option(metavar="FORMAT", help="Write decoded records with GPS time instead: csv, parquet, npz or mcap."),
    ] = None,
    source: Annotated[
        list[str] | None,
        typer.Option(metavar="KIND/NAME", help="With --records: only this source; repeatable."),
    ] = None,
    begin: Annotated[
        str | None, typer.Option("--from", metavar="TIME", help="With --records: from this time, UTC or GPS ns.")
    ] = None,
    end: Annotated[
        str | None, typer.Option("--to", metavar="TIME", help="With --records: up to this time, UTC or GPS ns.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace earlier exports of the logs.")] = False,
    ros2: Annotated[
        bool, typer.Option("--ros2", help="Write ROS 2 bags with standard messages, for Foxglove, RViz and ROS.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
) -> None:
    """Write logs as serial streams (with RTKLIB's time tags), candump logs, pcap files and PPS text.

    What these formats cannot hold goes into a small file beside each; with it `swath import` makes the same log again.
    With --records, the fixes, samples, returns and other records that the drivers decode, as tables, or (mcap) as
    messages that Foxglove and PlotJuggler show; with --ros2, as messages of a bag. Exit code 4 when the log is damaged;
    everything readable is still written.
    """
    if records is not None and ros2:
        raise UserError("--records and --ros2 are two exports; choose one of them", ExitCode.USAGE)
    if records is not None:
        _export_records(logs, directory, records, source or [], (begin, end), overwrite=overwrite, as_json=as_json)
        return
    if source or begin or end:
        raise UserError("--source, --from and --to need --records", ExitCode.USAGE)
    from swath.daemon.cli.progress import progress_bar
    from swath.daemon.exchange.export import export_session
    from swath.daemon.free_space import check_space
    from swath.daemon.log.format import LogError
    from swath.daemon.log.reader import open_logs

    export: Callable[..., ExportReport | RosExport] = export_session
    if ros2:
        from swath.daemon.processing.requirements import require_installed

        require_installed("export --ros2", "rosbags")
        from swath.daemon.processing.records.ros2 import export_ros2 as export

    passed_over: list[str] = []
    done: list[tuple[Session, ExportReport | RosExport]] = []
    try:
        with progress_bar() as tell:
            sessions = open_logs(logs, passed_over)
            size = sum(part.path.stat().st_size for session in sessions for part in session.parts)
            check_space(directory, "exported files", least_bytes=LEAST_OF_LOG * size, most_bytes=MOST_OF_LOG * size)
            for session in sessions:
                reached = Reached(partial(_tell, tell, session.session_id))
                session.progress = reached
                with room_noted(directory, reached.share):
                    done.append((session, export(session, directory, overwrite=overwrite)))
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
    damaged = [[*session.damage, *getattr(report, "damage", ())] for session, report in done]
    lines += [_damage(places) for places in damaged if places]
    if lines:
        raise UserError("\n".join(map(one_line, lines)), ExitCode.DAMAGE)
    if any(session.missing_parts for session, _ in done):
        raise typer.Exit(int(ExitCode.PROBLEM))


def _export_records(
    logs: list[Path],
    directory: Path,
    form: str,
    sources: list[str],
    times: tuple[str | None, str | None],
    *,
    overwrite: bool,
    as_json: bool,
) -> None:
    from swath.daemon.processing.requirements import require_installed

    if form == "mcap":
        require_installed("swath export --records mcap", "foxglove", "google.protobuf")
    else:
        require_installed("swath export --records")
    from swath.daemon.cli.progress import progress_bar
    from swath.daemon.free_space import check_space
    from swath.daemon.log.reader import open_logs
    from swath.daemon.processing.records.files import FORMATS, arrow, write_records
    from swath.daemon.processing.records.read import LogRecords
    from swath.daemon.processing.user_errors import as_user_error

    if form not in FORMATS:
        raise UserError(f'--records: got "{form}", want {", ".join(FORMATS)}', ExitCode.USAGE)
    if form in ("csv", "parquet"):
        arrow()
    start_ns, stop_ns = (None if time is None else _gps_ns(time) for time in times)
    passed_over: list[str] = []
    done = []
    with as_user_error(directory), progress_bar(compiling=True) as tell:
        sessions = open_logs(logs, passed_over)
        size = sum(part.path.stat().st_size for session in sessions for part in session.parts)
        check_space(directory, "records", least_bytes=LEAST_OF_RECORDS * size, most_bytes=MOST_OF_RECORDS * size)
        for session in sessions:
            read = LogRecords.of_session(session)
            written = write_records(
                read,
                directory,
                form,
                sources=sources,
                start_ns=start_ns,
                stop_ns=stop_ns,
                overwrite=overwrite,
                tell=tell,
            )
            done.append((written, read.damage))
    if as_json:
        plain = [{"folder": str(one.folder), "rows": one.rows, "notes": one.notes} for one, _ in done]
        print(json.dumps({"sessions": plain, "passed_over": passed_over}, indent=2))
    else:
        for written, _ in done:
            _print_records(written)
    lines = [f"passed over: {line}" for line in passed_over]
    lines += [f"{one.path} at byte {one.damage.offset}: {one.damage.what}" for _, damage in done for one in damage[:5]]
    if lines:
        raise UserError("\n".join(map(one_line, lines)), ExitCode.DAMAGE)


def _print_records(written: RecordFiles) -> None:
    print(one_line(str(written.folder)))
    for name, count in written.rows.items():
        print(one_line(f"  {name}: {count:,} {'messages' if name.startswith('/') else 'rows'}"))
    for note in written.notes:
        print(one_line(f"  note: {note}"))


def _gps_ns(text: str) -> int:
    """Return GPS ns of a time as the command line gives it."""
    import datetime as dt

    from swath.georef.timescales.gps_time import gps_ns_from_datetime

    if text.isdecimal():
        return int(text)
    try:
        moment = dt.datetime.fromisoformat(text)
    except ValueError:
        raise UserError(
            f'got "{text}", want a time in UTC as 2026-06-15T09:00:05.5, or GPS nanoseconds', ExitCode.USAGE
        ) from None
    return gps_ns_from_datetime(moment.replace(tzinfo=dt.UTC) if moment.tzinfo is None else moment)


def _tell(tell: Tell, name: str, done: int, total: int) -> None:
    tell(f"exporting {name}", done, total, BYTES)


def _plain(session: Session, report: ExportReport | RosExport) -> dict[str, object]:
    return {
        "session_id": session.session_id,
        "folder": str(report.folder),
        **report.plain(),
        "notes": report.notes,
        "missing_parts": session.missing_parts,
        "growing": None if session.growing is None else session.growing.name,
        "damage": [f"{one.path.name} at byte {one.damage.offset}: {one.damage.what}" for one in session.damage],
    }


def _print(session: Session, report: ExportReport | RosExport) -> None:
    print(one_line(str(report.folder)))
    for line in report.lines():
        print(one_line(f"  {line}"))
    for note in report.notes:
        print(one_line(f"  note: {note}"))
    for number in session.missing_parts:
        print(f"  part {number} is missing")
    if session.growing is not None:
        print(one_line(f"  {session.growing.name} is still being recorded; exported up to now"))


def _damage(places: list[PartDamage]) -> str:
    first = places[0]
    more = f" ({len(places)} such places)" if len(places) > 1 else ""
    return f"{first.path} at byte {first.damage.offset}: {first.damage.what}{more}; everything readable was written"
