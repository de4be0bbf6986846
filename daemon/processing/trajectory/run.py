"""`swath trajectory`: from logs to the files of one trajectory, its summary and its page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.log.reader import Session, open_logs
from swath.daemon.processing.earlier_runs import listed_files
from swath.daemon.processing.files import put_in_place, refuse_no_name, remove, write_aside
from swath.daemon.processing.navigation.inputs import Mark
from swath.daemon.processing.navigation.log import session_holes
from swath.daemon.processing.navigation.navigate import Navigated, joined_trajectory, navigate_session
from swath.daemon.processing.navigation.sources import config_of_log, files_of, without_scanners
from swath.daemon.processing.points.clocks import read_clocks
from swath.daemon.processing.setup.setup import Options, Setup
from swath.daemon.processing.trajectory.event_marks import EventTable, event_table
from swath.daemon.processing.trajectory.files import TrajectoryFiles, write_trajectory
from swath.daemon.processing.trajectory.request import TrajectoryRequest
from swath.daemon.processing.trajectory.summary import pages_of, summary_head, summary_of_run, write_json
from swath.daemon.processing.user_errors import as_user_error
from swath.georef.progress import Tell
from swath.georef.trajectory.buffer import TrajectoryBuffer
from swath.georef.trajectory.trajectory import Trajectory, TrajectoryError, gps_text

if TYPE_CHECKING:
    from swath.daemon.config.config import Config
    from swath.daemon.log.reader import Session

Written = list[tuple[Path, Path]]
AS_IS = "as-is"


@dataclass(frozen=True)
class TrajectoryReport:
    """The outcome: the summary's content, its path, all files, and warnings about files that could not be made."""

    record: dict[str, Any]
    summary: Path
    files: list[Path]
    warnings: list[str] = field(default_factory=list)


def make_trajectory(request: TrajectoryRequest, tell: Tell) -> TrajectoryReport:
    """Make the trajectory of logs and write its files.

    Raises:
        UserError: there is no trajectory, one line per reason; no file is left then.
    """
    with as_user_error(request.output, TrajectoryError):
        passed_over: list[str] = []
        sessions = open_logs(request.logs, passed_over)
        for session in sessions:
            refuse_no_name(session.session_id, session.parts[0].path)
        holes = [f"skipped: {line}" for line in passed_over]
        files = TrajectoryFiles.of_output(request.output, sessions[0].session_id, csv=request.csv)
        _refuse_one_name(request.events, files)
        if not request.overwrite:
            files.refuse_existing(request.events)
        if request.navigate.inputs.ins == AS_IS:
            return _write_as_is(request, files, sessions, holes)
        flights = [navigate_session(session, request.navigate, tell) for session in sessions]
        flights.sort(key=lambda flight: int(flight.solutions()[0].time_ns[0]))  # the hosts' clocks may be wrong
        flights[0].holes.extend(holes)
        return _write(request, files, flights, tell)


def _write(
    request: TrajectoryRequest, files: TrajectoryFiles, flights: Sequence[Navigated], tell: Tell
) -> TrajectoryReport:
    tell("files", 0, 0)
    trajectory = _joined(flights)
    sigma = np.concatenate([flight.velocity_sigma_l() for flight in flights])
    written = write_trajectory(files, trajectory, sigma)
    warnings: list[str] = []
    try:
        events = _write_events(request, flights, trajectory, written)
        tell("page", 0, 0)
        verdicts, figures = _write_pages(request, files, flights, written, warnings)
        record = summary_of_run(request, flights, verdicts, figures, events)
        record["files"] = [path.name for _, path in written]
        written.append((write_aside(files.summary, partial(write_json, record)), files.summary))
    except BaseException:
        remove(written)
        raise
    put_in_place(written, listed_files(files.summary))
    return TrajectoryReport(record, files.summary, [path for _, path in written], warnings)


def _write_as_is(
    request: TrajectoryRequest, files: TrajectoryFiles, sessions: Sequence[Session], holes: Sequence[str]
) -> TrajectoryReport:
    """Write the solutions of the devices' own INS, without a page."""
    if request.events is not None:
        raise UserError(
            "--events: only a navigated trajectory gives event marks their place; leave --ins as-is out", ExitCode.USAGE
        )
    read = [(session, ins_as_is(session, request.navigate.inputs.config)) for session in sessions]
    read.sort(key=lambda pair: pair[1].trajectory.span)  # the hosts' clocks may be wrong
    sessions, found = [session for session, _ in read], [one for _, one in read]
    _refuse_overlap([(session.parts[0].path, one.trajectory) for session, one in read])
    trajectory = joined_trajectory([one.trajectory for one in found], found[0].trajectory.name)
    record = summary_head(request, AS_IS, sessions, [*(line for one in found for line in one.holes), *holes], [])
    record["sessions"] = [
        {"session": session.session_id, "ins": one.source, "solutions": dict(sorted(one.solutions.items()))}
        for session, one in zip(sessions, found, strict=True)
    ]
    written = write_trajectory(files, trajectory, None)
    record["files"] = [path.name for _, path in written]
    try:
        written.append((write_aside(files.summary, partial(write_json, record)), files.summary))
    except BaseException:
        remove(written)
        raise
    put_in_place(written, listed_files(files.summary))
    return TrajectoryReport(record, files.summary, [path for _, path in written])


def _joined(flights: Sequence[Navigated]) -> Trajectory:
    """Return all sessions' trajectories as one; refuse with `UserError` two that overlap in time."""
    parts = [flight.trajectory(flight.session_id) for flight in flights]
    _refuse_overlap([(flight.inputs.log, part) for flight, part in zip(flights, parts, strict=True)])
    return joined_trajectory(parts, parts[0].name)


def _refuse_overlap(parts: Sequence[tuple[Path, Trajectory]]) -> None:
    for (first, one), (second, other) in pairwise(parts):
        if other.span[0] <= one.span[1]:
            raise UserError(
                f"{second}: begins at {gps_text(other.span[0])}, before {first} ends at {gps_text(one.span[1])}: the "
                "recordings overlap in time; navigate them one by one",
                ExitCode.USAGE,
            )


def _refuse_one_name(events: Path | None, files: TrajectoryFiles) -> None:
    """Refuse with `UserError` to write the marks into a file of the trajectory."""
    if events is not None and events.resolve() in [path.resolve() for path in files.all()]:
        raise UserError(f"--events {events}: is a file of the trajectory itself; choose another name", ExitCode.USAGE)


def _write_events(
    request: TrajectoryRequest, flights: Sequence[Navigated], trajectory: Trajectory, written: Written
) -> EventTable | None:
    marks: list[Mark] = [mark for flight in flights for mark in flight.inputs.marks]
    if request.events is None:
        return event_table(marks, trajectory) if marks else None
    table = event_table(marks, trajectory)
    data = table.text.encode()

    def write(stream: IO[bytes]) -> None:
        stream.write(data)

    written.append((write_aside(request.events, write), request.events))
    return table


def _write_pages(
    request: TrajectoryRequest,
    files: TrajectoryFiles,
    flights: Sequence[Navigated],
    written: Written,
    warnings: list[str],
) -> tuple[list[Any], list[Any]]:
    """Write one page with its PDF per leg; return verdicts and figures of all legs, in order."""
    verdicts: list[Any] = []
    figures: list[Any] = []
    for page in pages_of(flights):
        path = files.page if not verdicts else files.page.with_stem(f"{files.page.stem}_{len(verdicts) + 1}")
        if request.page:
            verdict, own = page.write(path, written, warnings)
        else:
            verdict, own = page.judge()
        verdicts.append(verdict)
        figures.append(own)
    return verdicts, figures


@dataclass(frozen=True, eq=False)
class AsIs:
    """The solutions of a session's own INS.

    Attributes:
        source: source of the solutions.
        trajectory: trajectory with the attitude of b.
        solutions: number of solutions by fate.
        holes: missing data, one line each.
    """

    source: str
    trajectory: Trajectory
    solutions: Counter[str]
    holes: list[str]


def ins_as_is(session: Session, config: Config | None) -> AsIs:
    """Read the INS solutions of a session.

    Raises:
        UserError: there are none.
        LogError, OSError: the log cannot be read.
    """
    log = session.parts[0].path
    files = files_of(session, config)
    try:
        setup = Setup(without_scanners(config or config_of_log(files)), files, Options(uncertainty=False))
    except UserError as error:
        lines = [f"{log}: {line}" for line in error.message.splitlines()]
        raise UserError("\n".join(lines), error.exit_code) from error
    clocks = read_clocks(session, setup.sources)
    if setup.sources.ins_source is None or not len(clocks.ins_rows):
        raise UserError(f"{log}: the log has no INS solution; leave --ins as-is out to navigate from its IMU and GNSS")
    buffer = TrajectoryBuffer(setup.sources.ins_protocol, name=session.session_id)
    buffer.append(clocks.ins_rows)
    trajectory = buffer.snapshot().with_velocities()
    if len(trajectory) < 2:
        raise UserError(f"{log}: {setup.sources.ins_source}: its INS had no solution")
    return AsIs(setup.sources.ins_source, trajectory, +Counter(buffer.counts), session_holes(session))
