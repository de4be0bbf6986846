"""What cannot be georeferenced together, or not with this trajectory: a line each, file and what would be right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import numpy as np
from pyproj import CRS

from swath.daemon.errors import ExitCode, UserError
from swath.georef.points import Fate
from swath.georef.timescales import StampScale, TimeState
from swath.georef.trajectory.buffer import COLUMNS
from swath.georef.trajectory.trajectory import gps_text

if TYPE_CHECKING:
    from swath.daemon.config.config import Config
    from swath.daemon.processing.flights.read import Flight
    from swath.daemon.processing.points.feed import LogClocks
    from swath.daemon.processing.setup.setup import Options
    from swath.georef.timescales import ClockStatus, Stamps
    from swath.georef.trajectory.trajectory import Trajectory

Span = tuple[int, int]
NO_TIME = Fate.NO_TIME.name.lower()
GOOD_STATES = (TimeState.LOCKED, TimeState.HOLDOVER)
MUCH = 0.01  # share of returns without time that is worth a warning
LATE_S = 0.06  # more than an IMU's samples are late at the host
LOOKED_AT = 10_000  # epochs, whether the body flies forward and upright
UNSAID = "a datum that is not said"
FLIES_MPS = 15.0  # nothing flies so fast sideways
FORWARD = 0.5  # cosine between nose and course, below which it would
AXES = (
    "want the attitude of axes forward, right, down: of a device's INS imu.….rotation_b_imu turns it, as it turns the "
    "samples"
)


def refuse_different_settings(
    configs: Mapping[Path, Config], crs: str | None, datum: str | None = None, epoch: float | None = None
) -> None:
    """Logs of one run share the mapping frame, and of their trajectory the antenna and the datum.

    Args:
        configs: by log.
        crs, datum, epoch: what the command line says, over the configurations.

    Raises:
        UserError: they do not.
    """
    for (one, first), (other, second) in pairwise(configs.items()):
        for key, said in (("crs", crs), ("epoch", epoch)):
            ours, theirs = getattr(first.output, key), getattr(second.output, key)
            if said is None and ours != theirs:
                raise UserError(
                    f"{other}: its output.{key} is {_said(theirs)}, that of {one} {_said(ours)}; "
                    f"say one with --{key} (of swath georef) or --config, or take them one by one",
                    ExitCode.USAGE,
                )
        if datum is None and (theirs := _datum_of(second)) != (ours := _datum_of(first)):
            raise UserError(
                f"{other}: its positions are in {theirs or UNSAID}, those of {one} in {ours or UNSAID} "
                "(gnss.….datum); say one with --trajectory-datum, or georeference them one by one",
                ExitCode.USAGE,
            )
        arms = {name: list(gnss.lever_arm_m) for name, gnss in first.gnss.items()}
        others = {name: list(gnss.lever_arm_m) for name, gnss in second.gnss.items()}
        if arms != others:
            name = next(name for name in {**arms, **others} if arms.get(name) != others.get(name))
            raise UserError(
                f"{other}: gnss.{name}.lever_arm_m is {_said(others.get(name))}, in {one} {_said(arms.get(name))}: "
                "another antenna; georeference them one by one",
                ExitCode.USAGE,
            )


def refuse_geocentric(crs: str) -> None:
    """Files of points hold eastings, northings and heights; ``crs`` is one that PROJ reads.

    Raises:
        UserError: its coordinates are not those.
    """
    read = CRS.from_user_input(crs)
    if read.is_geocentric:
        raise UserError(
            f'output.crs = "{crs}" ({read.name}) is geocentric: files of points want a projected one, such as '
            '"EPSG:326ZZ" for UTM zone ZZ north on WGS 84',
            ExitCode.USAGE,
        )


def of_log(log: Path, lines: Sequence[str], options: Options) -> list[str]:
    """What is wrong with the configuration in a log names the log; what the command line said does not."""
    files = [file for _, file in options.calibrations.values()]
    own = ("output.", "datum", *files) if options.crs or options.datum or options.epoch else ("--", *files)
    return [line if line.startswith(own) else f"{log}: {line}" for line in lines]


def _datum_of(config: Config) -> str | None:
    """As `swath.daemon.processing.setup.setup.Setup` takes it."""
    return next((gnss.datum for gnss in config.gnss.values() if gnss.datum), None)


def _said(value: object) -> str:
    return "not set" if value is None else str(value)


def refuse_overlap(spans: Mapping[Path, Span]) -> None:
    """Logs of one run follow each other; spans in GPS ns.

    Raises:
        UserError: two overlap.
    """
    ordered = sorted(spans.items(), key=lambda item: item[1])
    for (one, (_, end_ns)), (other, (start_ns, _)) in pairwise(ordered):
        if start_ns < end_ns:
            raise UserError(
                f"{other}: begins at {gps_text(start_ns)}, before {one} ends at {gps_text(end_ns)}: "
                "two recordings of one time; georeference them one by one",
                ExitCode.USAGE,
            )


def note_strips_elsewhere(file: str, strips: Sequence[Span], flights: Sequence[Flight]) -> None:
    """Strips that a file asks for and that lie in no log will be missing; spans in GPS ns.

    Raises:
        UserError: all of them.
    """
    elsewhere = [
        (start, end)
        for start, end in strips
        if not any(start < flight.span[1] and end > flight.span[0] for flight in flights)
    ]
    if len(elsewhere) == len(strips):
        logs = ", ".join(f"{gps_text(flight.span[0])} to {gps_text(flight.span[1])}" for flight in flights)
        raise UserError(f"{file}: none of its strips lies in the logs, {logs}; want GPS nanoseconds since 1980-01-06")
    flights[0].holes += [
        f"{file}: its strip from {gps_text(start)} to {gps_text(end)} lies in no log" for start, end in elsewhere
    ]


def refuse_no_overlap(trajectory: Trajectory, file: str, span: Span, log: Path) -> None:
    """A trajectory and a log have some time in common.

    Raises:
        UserError: they have none; the line says from when to when each is.
    """
    first_ns, last_ns = trajectory.span
    if first_ns <= span[1] and last_ns >= span[0]:
        return
    raise UserError(
        f"{file}: is from {gps_text(first_ns)} to {gps_text(last_ns)}, {log} from {gps_text(span[0])} to "
        f"{gps_text(span[1])}: they do not overlap; want the trajectory of this flight, or --week"
    )


def refuse_no_time(
    log: Path,
    clock: str | None,
    status: ClockStatus | None,
    config: Config,
    remarks: Sequence[str] = (),
    trouble: str = "",
) -> None:
    """The log's own clock must be known well enough to say which second a pulse belongs to.

    Args:
        log: stands for the session.
        clock: the source that shows the time.
        status: of that clock at the end.
        config: of the session.
        remarks: what the receivers' parsers have to say.
        trouble: why what the head says of time cannot be used, where the clock is a head's own.

    Raises:
        UserError: it is not, and why.
    """
    if trouble and status is not None and status.state is TimeState.NO_TIME:
        raise UserError(f"{log}: {clock}: no receiver is in the log, and the head {trouble}")
    if remarks and clock is not None and clock.startswith("scanner/") and status is not None:
        _refuse_by_remarks(log, status, remarks)
    if status is None or clock is None or (clock.startswith("scanner/") and status.state is TimeState.NO_TIME):
        key = "" if clock is None else f"{clock.replace('/', '.')}.clock"
        hint = (
            f"; or the head's position packets (auxiliary), or {key} where its stamps are UTC or TAI" if clock else ""
        )
        raise UserError(
            f"{log}: no source of time in its configuration; want [pps.…] or [gnss.…]{hint}", ExitCode.USAGE
        )
    if status.ambiguous:
        raise UserError(
            f"{log}: {clock}: which second an edge is, is not certain: {status.ambiguous}; "
            "want the time messages of the receiver that gives the pulse (gnss.….pps)"
        )
    said = {f"pps/{gnss.pps}": name for name, gnss in config.gnss.items() if gnss.pps}
    if status.state is TimeState.NO_TIME and clock.startswith("pps/") and clock not in said:
        heard = "; ".join(f'gnss.{name}.pps is "{pps.removeprefix("pps/")}"' for pps, name in said.items())
        raise UserError(
            f"{log}: {clock}: no receiver says which second its edges are ({heard or 'no gnss.….pps is set'}); "
            "want the receiver that gives the pulse there, with --config"
        )
    if status.leap_doubt:
        raise UserError(f"{log}: {clock}: UTC cannot be brought to GPS time: {status.leap_doubt}")
    _refuse_by_remarks(log, status, remarks)
    if status.state is TimeState.NO_TIME:
        raise UserError(f"{log}: {clock}: nothing in the log says the time; want PPS edges and time messages")


def _refuse_by_remarks(log: Path, status: ClockStatus, remarks: Sequence[str]) -> None:
    """Refuse a log without time by what parsers say of the dates that they did not believe."""
    if status.state is TimeState.NO_TIME and remarks:
        raise UserError("\n".join(f"{log}: {remark}" for remark in remarks))


def time_trouble(
    scanner: str,
    fates: Mapping[str, int],
    refused: Mapping[str, int],
    status: ClockStatus | None,
    stamps: Stamps | None = None,
    trouble: str = "",
) -> str:
    """Return how many returns have no time good enough, and why; empty: few or none.

    Args:
        scanner: its name.
        fates: of its returns.
        refused: stamps that its clock did not believe, by reason.
        status: of the host's clock.
        stamps: what its stamps were found to count from; None: it says itself whether it is locked, or nobody knew.
        trouble: why what it says of time itself cannot be used; empty: it can, or it says nothing.
    """
    total = sum(fates.values())
    lost = fates.get(NO_TIME, 0)
    if not total or lost <= MUCH * total:
        return ""
    told = f"scanner/{scanner}: {lost:,} of {total:,} returns have no time"
    if refused.get("past_hour"):
        return (
            f"{told}: its stamps contradict the host's clock by more than half a second: the head is locked to another "
            "second; want the NMEA sentences and the pulse of one receiver at the head"
        )
    if trouble:
        return f"{told}: the head {trouble}"
    if status is not None and status.state not in GOOD_STATES:
        return f"{told}: the host's clock is {status.state.value}; want PPS edges and time messages all through"
    if refused.get("spacing"):
        return f"{told}: {refused['spacing']:,} edges that it latched are not a second apart; want the receiver's PPS"
    if refused.get("stamp_jump"):
        return f"{told}: {refused['stamp_jump']:,} stamps lie more than a second from their arrival: its clock was set"
    found = "" if stamps is None or stamps.scale is not StampScale.FREE else f" ({stamps.text})"
    return (
        f"{told}: its stamps run free{found}; want a head that is locked to the PPS, or latches it, or "
        f"scanner.{scanner}.clock where its stamps are UTC or TAI all the same"
    )


def refuse_nothing(log: Path, troubles: Sequence[str], became: str) -> NoReturn:
    """Where no return at all could be placed, there is no product.

    Args:
        log: the first one.
        troubles: lines that say why; empty: unknown.
        became: what became of the returns.

    Raises:
        UserError: always.
    """
    raise UserError("\n".join(troubles) or f"{log}: no return could be georeferenced: {became}")


def refuse_other_motion(clocks: LogClocks, trajectory: Trajectory, file: str, log: Path) -> list[str]:
    """The trajectory turns when the log's IMU does; one in UTC or of another week does not.

    Gives a line of doubt where it turns a little earlier or later.

    Raises:
        UserError: it turns at other times; the line says by how much.
    """
    if len(clocks.imu_gps_ns) < 2 or len(trajectory) < 2:
        return []
    from swath.georef.trajectory.turn_rates import correlate_turn_rates  # scipy.signal, which takes seconds to load

    shift = correlate_turn_rates(trajectory, clocks.imu_gps_ns, clocks.imu_rate_b)
    if shift.is_wrong:
        raise UserError(f"{file}: {shift.what}, by how it turns and how the IMU in {log} does")
    if shift.is_certain and abs(shift.seconds) > LATE_S:
        return [f"{file}: turns {-shift.seconds:.3f} s later than the IMU in {log} does; its time may be off by that"]
    return []


def attitude_doubts(trajectory: Trajectory, named: str) -> list[str]:
    """A line where the body would fly on its back or not forward: the attitude is of other axes than b's."""
    step = max(1, len(trajectory) // LOOKED_AT)
    seen = replace(trajectory, **{column: getattr(trajectory, column)[::step] for column in COLUMNS})
    roll, pitch, heading = seen.attitude()
    north, east, _ = seen.velocity_l().T
    flies = np.hypot(north, east) > FLIES_MPS
    lines = []
    if len(seen) and np.median(np.cos(roll) * np.cos(pitch)) < 0.0:
        lines.append(f"{named}: its z axis points up, the body would fly on its back; {AXES}")
    if flies.any():
        apart = heading[flies] - np.arctan2(east[flies], north[flies])
        if np.median(np.cos(apart)) < FORWARD:
            usual_deg = np.degrees(np.arctan2(np.median(np.sin(apart)), np.median(np.cos(apart))))
            lines.append(f"{named}: its x axis points {usual_deg:+.0f}° beside the course; {AXES}")
    return lines
