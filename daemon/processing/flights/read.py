"""Makes the first pass over logs: reads all data but the returns, notes where returns are stored, and cuts strips."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pyproj import CRS

from swath.daemon.errors import ConfigError, ExitCode, UserError
from swath.daemon.log.chunk_index import SCANNER, Listening, LogIndex, index_log, read_chunks
from swath.daemon.log.format import source_of_topic
from swath.daemon.log.parsers import stored_config
from swath.daemon.log.reader import Session, open_logs
from swath.daemon.log.wires import Senders, mixed_text
from swath.daemon.processing.carried_verdict import (
    Carried,
    calibration_verdicts,
    file_fixed_share,
    file_verdicts,
    navigated_fixed_share,
    navigated_verdicts,
    verdict_entry,
)
from swath.daemon.processing.files import refuse_no_name
from swath.daemon.processing.flights.flight_places import flight_places
from swath.daemon.processing.flights.trajectory_choice import TrajectoryOptions, choose_trajectory
from swath.daemon.processing.head_clocks import find_stamps, stamp_lines
from swath.daemon.processing.points.clocks import LogClocks, read_clocks
from swath.daemon.processing.points.time_checks import refuse_no_time, time_trouble
from swath.daemon.processing.points.workers import refuse_in_import
from swath.daemon.processing.setup.setup import Options, Setup
from swath.daemon.text_files import text_of
from swath.georef.mapping.crs_names import plain_code
from swath.georef.mapping.datums import UnknownCrsError
from swath.georef.progress import BYTES
from swath.georef.strips import Span, StripRules, cut, laser_spans, read_strips, straight_spans
from swath.georef.trajectory.trajectory import Trajectory, gps_text

if TYPE_CHECKING:
    from swath.daemon.config.config import Config
    from swath.daemon.processing.navigation.navigate import Navigated
    from swath.daemon.processing.points.jobs import JobResult
    from swath.georef.progress import Tell
    from swath.georef.timescales import ClockStatus


Check = Callable[[Sequence[Session], Sequence[Setup]], None]

UNSAID = "an unspecified datum"

INTENSITY_FACTOR = 257.0  # scales eight bits, 0 … 255, to the 16-bit field


@dataclass(frozen=True)
class GeorefOptions:
    """The options of `swath georef` from the command line.

    Attributes:
        logs, output: logs that are read, and the folder of the products.
        trajectory: options of `TrajectoryOptions`.
        options: options that override the logs' configuration.
        config: configuration instead of the logs' own; None: the logs' own.
        strips: ``auto``, ``whole``, or the name of a CSV file.
        rules: rules that define a strip.
        workers, scheduler: number of worker processes, and the address of a Dask scheduler (None: none).
        sigmas: write three sigmas with each point.
        copc: write COPC files.
        scale: scale of the coordinates, in the coordinate system's units.
        overwrite: replace products of an earlier run.
        write_dropped: also write returns that are left out, flagged or in a list.
        accept_verdict: do not report an unusable verdict as a problem.
        error_model: also write the error model of the points.
    """

    logs: Sequence[Path]
    output: Path
    trajectory: TrajectoryOptions = field(default_factory=TrajectoryOptions)
    options: Options = field(default_factory=Options)
    config: Config | None = None
    strips: str = "auto"
    rules: StripRules = field(default_factory=StripRules)
    workers: int = 1
    scheduler: str | None = None
    sigmas: bool = True
    copc: bool = False
    scale: float = 0.001
    overwrite: bool = False
    write_dropped: bool = False
    accept_verdict: bool = False
    error_model: bool = False

    def record(self) -> dict[str, Any]:
        """Return the options for the sidecar, without those that do not affect the points."""
        return {
            "trajectory": None if self.trajectory.file is None else str(self.trajectory.file),
            "trajectory_at": self.trajectory.at,
            "week": self.trajectory.week,
            "crs": self.options.crs,
            "datum": self.options.datum,
            "epoch": self.options.epoch,
            "force_crs": self.options.force_crs,
            "calibrations": {name: file for name, (_, file) in self.options.calibrations.items()},
            "strips": self.strips,
            "sigmas": self.sigmas,
            "surface": self.options.surface if self.sigmas else None,
            "incidence": self.options.incidence,
            "range_sigma": self.options.range_sigma,
            "covariances": self.options.covariances,
            "copc": self.copc,
            "scale": self.scale,
            "write_dropped": self.write_dropped,
            "intensity_factor": INTENSITY_FACTOR,
        }


@dataclass
class Flight:
    """A session while it is processed.

    Attributes:
        span: GPS time of its first and last return; host_span likewise in log time.
        trajectory: trajectory of the body.
        solutions: number of the device's INS solutions by fate.
        fixed_share: share of the trajectory's GNSS positions that had fixed ambiguities; None: not known.
        navigated: the navigation that the trajectory was smoothed in; None: it comes from elsewhere.
        strips: spans of log time; `first_number` is the number of the first.
        lost: number of units that the recorder lost, by source.
        verdicts: verdicts on calibrations and trajectory, other than good; `trajectory_verdicts` those on the
            trajectory, and `source` where it is from: ``navigated``, ``ins`` or ``file``.
        troubles: problems with time or trajectory, one line each.
        holes: data that will be missing, one line each.
    """

    session: Session
    setup: Setup
    clocks: LogClocks
    index: LogIndex
    span: tuple[int, int]
    host_span: tuple[int, int]
    trajectory: Trajectory | None = None
    solutions: dict[str, int] = field(default_factory=dict)
    fixed_share: float | None = None
    navigated: Navigated | None = None
    strips: list[Span] = field(default_factory=list)
    first_number: int = 1
    lost: dict[str, int] = field(default_factory=dict)
    troubles: list[str] = field(default_factory=list)
    holes: list[str] = field(default_factory=list)
    verdicts: list[Carried] = field(default_factory=list)
    trajectory_verdicts: list[Carried] = field(default_factory=list)
    source: str = ""

    @property
    def log(self) -> Path:
        """The session's first part, which names the log in messages."""
        return self.session.parts[0].path

    @property
    def warnings(self) -> list[str]:
        """Doubts about its data, time and trajectory, one line each."""
        lost = [f"{self.log}: the recorder lost {count:,} units of {source}" for source, count in self.lost.items()]
        return [*lost, *self.troubles]

    @property
    def clock(self) -> str | None:
        """The source of the host's time."""
        devices = self.clocks.clocks.host.plan.devices
        return next((plan.clock for plan in devices.values()), None)

    def status(self, host_ns: int) -> ClockStatus | None:
        """Return the status of the clock that gives the host's time."""
        return None if self.clock is None else self.clocks.clocks.host.status(self.clock, host_ns)

    def gps_from_host(self, host_ns: Any) -> Any:
        """Return GPS times (n,), ns, of log times."""
        assert self.clock is not None
        gps_ns, _ = self.clocks.clocks.host.gps_from_host(self.clock, np.asarray(host_ns, np.int64))
        return gps_ns

    def host_from_gps(self, gps_ns: Sequence[int]) -> list[int]:
        """Return log times of GPS times, to about a nanosecond: the clocks differ by parts in a million."""
        wanted = np.asarray(gps_ns, np.int64)
        host_ns = wanted - self.span[0] + self.host_span[0]
        for _ in range(3):
            host_ns = host_ns + wanted - self.gps_from_host(host_ns)
        found: list[int] = host_ns.tolist()
        return found


def read_flights(request: GeorefOptions, tell: Tell, check: Check = lambda sessions, setups: None) -> list[Flight]:
    """Return the flights of the logs, with trajectories and strips; note files that are not logs as holes of the first.

    Args:
        request: which logs, and how.
        tell: called with the progress.
        check: called with all sessions and their setups before any long work; its exceptions pass through.

    Raises:
        UserError: the logs cannot be georeferenced, or not together.
        LogError, OSError: a log cannot be read.
        StripError, MappingError: strips or mapping are invalid; one line.
    """
    refuse_in_import()
    passed_over: list[str] = []
    sessions = open_logs(request.logs, passed_over)
    setups = [_setup(request, session) for session in sessions]
    logs = [session.parts[0].path for session in sessions]
    configs = dict(zip(logs, (setup.config for setup in setups), strict=True))
    for session in sessions:
        refuse_no_name(session.session_id, session.parts[0].path)
    check(sessions, setups)
    refuse_different_settings(configs, request.options.crs, request.options.datum, request.options.epoch)
    flights: list[Flight] = []
    for session, setup in zip(sessions, setups, strict=True):
        flights.append(_read(session, setup, tell, positions=request.trajectory.is_given))
    flights[0].holes += [f"skipped: {line}" for line in passed_over]
    refuse_overlap({flight.log: flight.span for flight in flights})
    flights.sort(key=lambda flight: flight.span)  # sessions come in host time, which may be wrong
    for flight in flights:
        _choose(request, flight, tell)
    _number_strips(request, flights)
    return flights


def _setup(request: GeorefOptions, session: Session) -> Setup:
    config = request.config
    try:
        setup = Setup.of_session(session, config, request.options)
    except UserError as error:
        if isinstance(error.__cause__, UnknownCrsError):
            error = _with_likely_crs(error.__cause__, session, config)
        lines = error.message.splitlines()
        if config is None:
            lines = of_log(session.parts[0].path, lines, request.options)
        raise UserError("\n".join(lines), error.exit_code) from error
    crs = request.options.crs or setup.config.output.crs
    if crs is None:
        raise UserError(f"{session.parts[0].path}: its configuration has no output.crs; give --crs", ExitCode.USAGE)
    refuse_geocentric(crs)
    return setup


def _with_likely_crs(error: UnknownCrsError, session: Session, config: Config | None) -> ConfigError:
    """Return the error of an unknown CRS with proposals for the place of the flight."""
    attachments = session.attachments()
    if config is None:
        config = stored_config(attachments)
    else:
        attachments = {name: data for name, _, data in config.attachments()}
    places = np.empty((0, 2)) if config is None else flight_places(session, config, attachments)
    place = (float(places[0, 0]), float(places[0, 1])) if len(places) else None
    return ConfigError(str(UnknownCrsError(error.text, error.key, place)))


def _read(session: Session, setup: Setup, tell: Tell, *, positions: bool) -> Flight:
    log = session.parts[0].path
    session.progress = lambda done, total: tell("clocks", done, total, BYTES)
    listening = Listening(session)
    clocks = read_clocks(listening, setup.sources, positions=positions)
    session.growing = listening.growing
    try:
        setup.take_angles(clocks.angles)
    except ConfigError as error:
        raise UserError("\n".join(f"{log}: {line}" for line in error.lines)) from error
    index = index_log(session)
    first, last = index.spans()
    if not len(first):
        raise UserError(f"{log}: the log has no scanner data")
    if mixed := mixed_scanners(index):
        lines = [f"{log}: {source}: {mixed_text(counts, recorded=True)}" for source, counts in sorted(mixed.items())]
        raise UserError("\n".join(lines))
    clocks.clocks = find_stamps(index, setup.sources, clocks.clocks.host)
    clocks.remarks += clocks.clocks.remarks
    flight = Flight(session, setup, clocks, index, (0, 0), (int(first.min()), int(last.max()) + 1))
    flight.lost = listening.lost()
    status, trouble = flight.status(flight.host_span[1]), clocks.clocks.trouble(flight.clock)
    refuse_no_time(log, flight.clock, status, setup.config, clocks.remarks, trouble)
    flight.troubles += [f"{log}: {remark}" for remark in [*clocks.remarks, *stamp_lines(clocks.clocks)]]
    begin, end = flight.gps_from_host(flight.host_span).tolist()
    flight.span = (begin, end)
    return flight


def mixed_scanners(index: LogIndex) -> dict[str, Mapping[str, int]]:
    """Return the scanners of a log to whose port several devices sent at the same time, with datagrams by address.

    Only a log whose channels name several senders is read, up to the first place where they alternate.
    """
    addresses: dict[str, set[str]] = {}
    for part in index.parts:
        for spec in part.channels.values():
            if spec.topic.startswith(SCANNER) and (address := spec.metadata.get("source_address")):
                addresses.setdefault(spec.topic, set()).add(address)
    doubtful = {topic for topic, found in addresses.items() if len(found) > 1}
    senders = {topic: Senders() for topic in doubtful}
    for chunk in index.scanner_chunks() if doubtful else ():
        for batch in read_chunks(index, [chunk], doubtful.__contains__, []):
            first_ns, last_ns = int(batch.log_time_ns.min()), int(batch.log_time_ns.max())
            address = batch.channel.metadata.get("source_address", "")
            senders[batch.channel.topic].add(address, first_ns, last_ns, len(batch.log_time_ns))
        if all(one.mixed for one in senders.values()):
            break
    return {source_of_topic(topic) or topic: one.counts for topic, one in senders.items() if one.mixed}


def _choose(request: GeorefOptions, flight: Flight, tell: Tell) -> None:
    """Set the flight's trajectory, and settle the mapping for its area."""
    status = flight.status(flight.host_span[1])
    leap_seconds = status.leap_seconds if status is not None and status.leap_origin != "guess" else None
    chosen = choose_trajectory(
        request.trajectory, flight.setup, flight.session, flight.clocks, flight.span, leap_seconds, tell
    )
    flight.trajectory, flight.solutions, flight.navigated = chosen.trajectory, chosen.solutions, chosen.navigated
    flight.troubles += [doubt for doubt in chosen.warnings if doubt not in flight.troubles]
    _judge(request, flight)
    assert flight.setup.mapping is not None
    within = flight.trajectory.between(*flight.span)
    places_e = within.position_e[:: max(1, len(within) // 100)]
    flight.setup.mapping.settle(places_e)
    misfit = flight.setup.mapping.misfit(places_e)
    if misfit and not request.options.force_crs:
        lines = of_log(flight.log, [misfit], request.options)
        raise UserError(f"{lines[0]}; use --force-crs to accept it", ExitCode.USAGE)
    flight.troubles += [misfit] if misfit else []


def _judge(request: GeorefOptions, flight: Flight) -> None:
    """Set the verdicts that products of the flight carry."""
    if request.trajectory.file is not None:
        flight.trajectory_verdicts, flight.source = file_verdicts(request.trajectory.file, flight.span)
        flight.fixed_share = file_fixed_share(request.trajectory.file, flight.span)
    elif request.trajectory.given is not None:
        flight.source = "file"
    elif flight.navigated is not None:
        flight.trajectory_verdicts, flight.source = list(navigated_verdicts(flight.navigated)), "navigated"
        flight.fixed_share = navigated_fixed_share(flight.navigated)
    else:
        flight.source = "ins"
    flight.verdicts = [*flight.trajectory_verdicts, *calibration_verdicts(flight.setup, flight.source)]


def verdicts_of(flights: Sequence[Flight]) -> list[Carried]:
    """Return the verdicts on all flights, each once."""
    return list(dict.fromkeys(one for flight in flights for one in flight.verdicts))


def trajectory_verdicts_of(flights: Sequence[Flight]) -> list[Carried]:
    """Return the verdicts on the trajectories of all flights, each once."""
    return list(dict.fromkeys(one for flight in flights for one in flight.trajectory_verdicts))


def verdict_of(request: GeorefOptions, flights: Sequence[Flight]) -> dict[str, Any]:
    """Return the verdict entry of a run, each reason once."""
    return verdict_entry(verdicts_of(flights), accepted=request.accept_verdict)


def _number_strips(request: GeorefOptions, flights: Sequence[Flight]) -> None:
    """Set each flight's strips in log time, numbered throughout the run."""
    given = None if request.strips in ("auto", "whole") else _given_strips(request.strips)
    number = 1
    for flight in flights:
        flight.strips, flight.first_number = _strips(request, flight, given), number
        number += len(flight.strips)
    if given is not None:
        note_strips_elsewhere(request.strips, given, flights)
    if number == 1:
        raise UserError(
            f"{flights[0].log}: has no strip: no straight flight with data lasts {request.rules.min_strip_s:g} s; use "
            "--strips whole, or --strips FILE with the strips' times"
        )


def note_times(flights: Sequence[Flight], results: Sequence[JobResult]) -> None:
    """Note in each flight's holes why returns of its strips have no time, one line per scanner."""
    for number, flight in enumerate(flights):
        own = [result for result in results if result.session == number and result.strip]
        status, clocks = flight.status(flight.host_span[1]), flight.clocks.clocks
        for name in flight.setup.scanners:
            fates: Counter[str] = Counter()
            refused: Counter[str] = Counter()
            for result in own:
                fates.update(result.fates.get(name, {}))
                refused.update(result.time_refused.get(name, {}))
            source = f"scanner/{name}"
            stamps, trouble = clocks.stamps.get(source), clocks.trouble(source)
            line = time_trouble(name, fates, refused, status, stamps, trouble)
            flight.holes += [f"{flight.log}: {line}"] if line else []


def _given_strips(name: str) -> list[Span]:
    if not Path(name).exists():
        raise UserError(f"--strips {name}: no such file; give auto, whole or a CSV file", ExitCode.IO)
    return read_strips(text_of(Path(name), "a CSV file with start_gps_ns,end_gps_ns"), name)


def _strips(request: GeorefOptions, flight: Flight, given: Sequence[Span] | None) -> list[Span]:
    laser = laser_spans(*flight.index.spans(), request.rules)
    if request.strips == "whole":
        return laser
    spans = _straight(request, flight) if given is None else given
    host = flight.host_from_gps([time_ns for span in spans for time_ns in span])
    here = list(zip(host[::2], host[1::2], strict=True))
    if given is None:
        return cut(here, laser, request.rules)
    return [(start, end) for start, end in here if start < flight.host_span[1] and end > flight.host_span[0]]


def _straight(request: GeorefOptions, flight: Flight) -> list[Span]:
    """Return the spans of straight flight in GPS time, and spans without a trajectory.

    Before a device's own INS is aligned there is no solution: this is noted as trouble, not as a strip.
    """
    trajectory = flight.trajectory
    assert trajectory is not None
    (begin, end), (first, last) = flight.span, trajectory.span
    unknown = [(start, stop) for start, stop in trajectory.gaps().tolist()]
    outside = [(start, stop) for start, stop in ((begin, first), (last, end)) if start < stop]
    if request.trajectory.is_given:
        unknown += outside
    else:
        flight.troubles += [
            f"{flight.log}: {(stop - start) / 1e9:.1f} s of the log have no INS solution and therefore no strips"
            for start, stop in outside
            if stop - start >= request.rules.min_strip_s * 1e9
        ]
    roll, _, heading = trajectory.attitude()
    return straight_spans(trajectory.time_ns, heading, roll, request.rules, unknown)


def refuse_different_settings(
    configs: Mapping[Path, Config], crs: str | None, datum: str | None = None, epoch: float | None = None
) -> None:
    """Refuse logs of one run that differ in mapping frame, antenna or datum.

    Args:
        configs: configurations by log.
        crs, datum, epoch: values from the command line, which override the configurations.

    Raises:
        UserError: the settings differ.
    """
    for (one, first), (other, second) in pairwise(configs.items()):
        for key, given in (("crs", crs), ("epoch", epoch)):
            ours, theirs = getattr(first.output, key), getattr(second.output, key)
            if given is None and ours != theirs:
                raise UserError(
                    f"{other}: its output.{key} is {_said(theirs)}, that of {one} {_said(ours)}; set one with --{key} "
                    "(of swath georef) or --config, or process the logs one by one",
                    ExitCode.USAGE,
                )
        if datum is None and (theirs := _datum_of(second)) != (ours := _datum_of(first)):
            raise UserError(
                f"{other}: its positions are in {theirs or UNSAID}, those of {one} in {ours or UNSAID} "
                "(gnss.….datum); set one with --trajectory-datum, or georeference the logs one by one",
                ExitCode.USAGE,
            )
        arms = {name: list(gnss.lever_arm_m) for name, gnss in first.gnss.items()}
        others = {name: list(gnss.lever_arm_m) for name, gnss in second.gnss.items()}
        if arms != others:
            name = next(name for name in {**arms, **others} if arms.get(name) != others.get(name))
            raise UserError(
                f"{other}: gnss.{name}.lever_arm_m is {_said(others.get(name))}, in {one} {_said(arms.get(name))}: "
                "the antennas differ; georeference the logs one by one",
                ExitCode.USAGE,
            )


def refuse_geocentric(crs: str) -> None:
    """Refuse a CRS without eastings, northings and heights; ``crs`` is one that PROJ reads.

    Raises:
        UserError: the CRS is geocentric.
    """
    read = CRS.from_user_input(plain_code(crs))
    if read.is_geocentric:
        raise UserError(
            f'output.crs = "{crs}" ({read.name}) is geocentric; point files need a projected CRS, such as '
            '"EPSG:326ZZ" for UTM zone ZZ north on WGS 84',
            ExitCode.USAGE,
        )


def of_log(log: Path, lines: Sequence[str], options: Options) -> list[str]:
    """Put the log's name before lines about its configuration, but not before those about the command line."""
    files = [file for _, file in options.calibrations.values()]
    own = ("output.", "datum", *files) if options.crs or options.datum or options.epoch else ("--", *files)
    return [line if line.startswith(own) else f"{log}: {line}" for line in lines]


def _datum_of(config: Config) -> str | None:
    """Return the datum of a configuration as `swath.daemon.processing.setup.setup.Setup` uses it."""
    return next((gnss.datum for gnss in config.gnss.values() if gnss.datum), None)


def _said(value: object) -> str:
    return "not set" if value is None else str(value)


def refuse_overlap(spans: Mapping[Path, Span]) -> None:
    """Refuse logs of one run that overlap in time; spans in GPS ns.

    Raises:
        UserError: two logs overlap.
    """
    ordered = sorted(spans.items(), key=lambda item: item[1])
    for (one, (_, end_ns)), (other, (start_ns, _)) in pairwise(ordered):
        if start_ns < end_ns:
            raise UserError(
                f"{other}: begins at {gps_text(start_ns)}, before {one} ends at {gps_text(end_ns)}: the recordings "
                "overlap in time; georeference them one by one",
                ExitCode.USAGE,
            )


def note_strips_elsewhere(file: str, strips: Sequence[Span], flights: Sequence[Flight]) -> None:
    """Note strips of a file that lie in no log as missing; spans in GPS ns.

    Raises:
        UserError: none of the strips lies in a log.
    """
    elsewhere = [
        (start, end)
        for start, end in strips
        if not any(start < flight.span[1] and end > flight.span[0] for flight in flights)
    ]
    if len(elsewhere) == len(strips):
        logs = ", ".join(f"{gps_text(flight.span[0])} to {gps_text(flight.span[1])}" for flight in flights)
        raise UserError(
            f"{file}: none of its strips lies in the logs, {logs}; give times in GPS nanoseconds since 1980-01-06"
        )
    flights[0].holes += [
        f"{file}: its strip from {gps_text(start)} to {gps_text(end)} lies in no log" for start, end in elsewhere
    ]
