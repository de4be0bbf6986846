"""Chooses the trajectory of a session: from a file, from the device's own INS, or navigated from IMU and GNSS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.given_trajectory import Given, judge_given, points_of
from swath.daemon.processing.navigation.inputs import InputOptions
from swath.daemon.processing.navigation.navigate import NavigationOptions, navigate_session
from swath.daemon.processing.trajectory.files import smrmsg_beside
from swath.georef.formats.trajectory.file import read_trajectory
from swath.georef.progress import Tell, silent
from swath.georef.stream.path import SHORTEST_TRAJECTORY
from swath.georef.strips import Span
from swath.georef.trajectory.buffer import COLUMNS, TrajectoryBuffer
from swath.georef.trajectory.trajectory import Trajectory, TrajectoryError, gps_text

if TYPE_CHECKING:
    from swath.daemon.log.reader import Session
    from swath.daemon.processing.navigation.navigate import Navigated
    from swath.daemon.processing.points.clocks import LogClocks
    from swath.daemon.processing.setup.setup import Setup
    from swath.georef.trajectory.trajectory import Trajectory


LATE_S = 0.06  # longer than an IMU's samples are delayed at the host
LOOKED_AT = 10_000  # epochs sampled to test whether the body flies forward and upright
FLIES_MPS = 15.0  # no aircraft flies so fast sideways
FORWARD = 0.5  # cosine between nose and course below which it would fly sideways
AXES = (
    "give the attitude of the axes forward, right, down; imu.….rotation_b_imu rotates the attitude of a device's INS "
    "as it rotates the samples"
)

Vector = tuple[float, float, float]
FROM_LOG = "INS solution in the log"


@dataclass(frozen=True, slots=True)
class TrajectoryOptions:
    """The options for the trajectory from the command line.

    Attributes:
        file: the trajectory's file; None: the device's own INS.
        week: GPS week of a file without one; None: the week that fits the log.
        at: the point that the file describes: body, antenna, scanner, or ``x,y,z`` from the body's origin in b, metres.
        navigate: without a file, navigate and smooth IMU and GNSS if the log has both, even if the device's own INS has
            a solution.
        force: use a file that does not belong to the log all the same, with a warning.
        navigated: navigations done before, by session, which are used as they are.
        given: a trajectory of the body's origin, in place of a file.
    """

    file: Path | None = None
    week: int | None = None
    at: str = "body"
    navigate: bool = False
    force: bool = False
    navigated: Mapping[str, Navigated] = field(default_factory=dict)
    given: Trajectory | None = None

    def __post_init__(self) -> None:
        """Refuse with `UserError` to force a file if no file is given."""
        if self.force and self.file is None:
            raise UserError("--force-trajectory: needs --trajectory FILE, because it accepts that file", ExitCode.USAGE)

    @property
    def is_given(self) -> bool:
        """True if the trajectory comes from outside the log, so that it is tested against the log."""
        return self.file is not None or self.given is not None


@dataclass(frozen=True, slots=True)
class Chosen:
    """The body's trajectory in a session.

    Attributes:
        trajectory: the trajectory; its attitude refers to the ellipsoid's normal, whatever the source's did
            (``[attitude]``).
        warnings: doubts about it, one line each.
        solutions: number of the device's INS solutions by fate (`swath.georef.trajectory.buffer`); empty for a file.
        navigated: the navigation that it was smoothed in; None: it comes from elsewhere.
    """

    trajectory: Trajectory
    warnings: list[str]
    solutions: dict[str, int]
    navigated: Navigated | None = None


def choose_trajectory(
    request: TrajectoryOptions,
    setup: Setup,
    session: Session,
    clocks: LogClocks,
    span: tuple[int, int],
    leap_seconds: int | None,
    tell: Tell = silent,
) -> Chosen:
    """Return the trajectory of a session whose returns lie in a span of GPS time.

    ``leap_seconds``, as the log knows them, are for files in UTC.

    Raises:
        UserError: there is no trajectory, it cannot be read, or it is of another time.
    """
    log = session.parts[0].path
    warnings: list[str] = []
    solutions: dict[str, int] = {}
    navigated: Navigated | None = None
    both = setup.sources.imu_source is not None and bool(setup.config.gnss)
    offset = offset_of(request.at, setup)
    file = str(request.file or (request.given.name if request.given is not None else ""))
    done = request.navigated.get(session.session_id)
    try:
        if request.given is not None:
            trajectory = request.given
            warnings = refuse_other_motion(clocks, trajectory, file, log)
        elif done is not None:
            navigated, trajectory = done, done.trajectory()
            warnings = _warnings_of(done)
        elif request.file is None:
            trajectory, solutions = _from_device(setup, clocks)
            if (request.navigate and both) or len(trajectory) < SHORTEST_TRAJECTORY:
                navigated = _navigated(setup, session, solutions, tell)
                trajectory, warnings = navigated.trajectory(), _warnings_of(navigated)
        else:
            trajectory = _from_file(request, request.file, span, leap_seconds)
            warnings = refuse_other_motion(clocks, trajectory, str(request.file), log)
        refuse_no_overlap(trajectory, file or trajectory.name, span, log)
        trajectory.require_attitude()
        if navigated is None:
            warnings += attitude_doubts(trajectory, file or f"{log}: {FROM_LOG}")
        if setup.deflection_rad is not None:
            trajectory = trajectory.with_deflection(*setup.deflection_rad)
        if offset is not None and navigated is not None:
            warnings.append(
                f"{log}: the trajectory navigated from IMU and GNSS is that of the body; leave --trajectory-at out"
            )
        elif offset is not None:
            trajectory = trajectory.at_body(offset)
        if file:
            warnings += _belonging(request, file, trajectory, setup, clocks, log)
    except TrajectoryError as error:
        named = str(error) if str(log) in str(error) else f"{error} ({log})"
        raise UserError(named) from error
    return Chosen(trajectory, warnings, solutions, navigated)


def _warnings_of(navigated: Navigated) -> list[str]:
    """Return doubts about a navigation, one line each."""
    findings = [finding.text for leg in navigated.legs for finding in leg.findings]
    return [*navigated.warnings, *navigated.holes, *findings]


def _belonging(
    request: TrajectoryOptions, file: str, trajectory: Trajectory, setup: Setup, clocks: LogClocks, log: Path
) -> list[str]:
    """Return doubts about a file's trajectory against the log; refuse one that does not belong to
    it with `UserError`.
    """
    offset = offset_of(request.at, setup) or (0.0, 0.0, 0.0)
    given = Given(file, trajectory, offset, points_of(setup), setup.options.datum is not None)
    found = judge_given(given, setup, clocks, log)
    if found.refused and not request.force:
        raise UserError("\n".join(f"{line}; use --force-trajectory to accept it" for line in found.refused))
    return [*found.refused, *found.warnings]


def _from_file(request: TrajectoryOptions, file: Path, span: tuple[int, int], leap_seconds: int | None) -> Trajectory:
    smrmsg = smrmsg_beside(file)
    return read_trajectory(
        file.read_bytes(),
        str(file),
        span_ns=span,
        week=request.week,
        leap_seconds=leap_seconds,
        smrmsg=None if smrmsg is None else smrmsg.read_bytes(),
    )


def _from_device(setup: Setup, clocks: LogClocks) -> tuple[Trajectory, dict[str, int]]:
    """Return the solution of the device's own INS, and how many solutions met which fate."""
    buffer = TrajectoryBuffer(setup.sources.protocol(setup.sources.ins_source), name=FROM_LOG)
    buffer.append(clocks.ins_rows)
    solutions = buffer.snapshot().with_velocities()
    return solutions, {what: count for what, count in sorted(buffer.counts.items()) if count}


def _navigated(setup: Setup, session: Session, solutions: dict[str, int], tell: Tell) -> Navigated:
    """Return the session navigated and smoothed from IMU and GNSS."""
    log = session.parts[0].path
    if setup.sources.imu_source is None or not setup.config.gnss:
        reason = f"{setup.sources.ins_source}: its INS had no solution" if solutions else "the log has no INS solution"
        missing = "no receiver" if setup.sources.imu_source is not None else "no IMU"
        raise UserError(
            f"{log}: {reason}, and {missing} to compute a trajectory; give --trajectory FILE", ExitCode.USAGE
        )
    try:
        return navigate_session(session, NavigationOptions(InputOptions(config=setup.config)), tell)
    except UserError as error:
        hint = "; or give --trajectory FILE"
        raise UserError("\n".join(f"{line}{hint}" for line in error.message.splitlines()), error.exit_code) from error


def offset_of(at: str, setup: Setup) -> Vector | None:
    """Return the offset of a trajectory's point from the body's origin in b; None: no offset.

    The offset of the scanner comes from its calibration.

    Raises:
        UserError: there is no such point.
    """
    if at == "body":
        return None
    if at == "antenna":
        arms = [gnss.lever_arm_m for gnss in setup.config.gnss.values()]
        if not arms:
            raise UserError("--trajectory-at antenna: the configuration has no [gnss.…]", ExitCode.USAGE)
        return _vector(arms[0])
    if at == "scanner":
        heads = [setup.calibrations[name].lever_arm_b for name in setup.scanners]
        if len(heads) != 1:
            raise UserError(
                f"--trajectory-at scanner: the configuration has {len(heads)} scanners; give x,y,z instead",
                ExitCode.USAGE,
            )
        return _vector(heads[0].tolist())
    try:
        x, y, z = (float(part) for part in at.split(","))
    except ValueError:
        raise UserError(
            f'--trajectory-at: got "{at}", want body, antenna, scanner or x,y,z in metres', ExitCode.USAGE
        ) from None
    return (x, y, z)


def _vector(values: Sequence[float]) -> Vector:
    return float(values[0]), float(values[1]), float(values[2])


def refuse_no_overlap(trajectory: Trajectory, file: str, span: Span, log: Path) -> None:
    """Refuse a trajectory that has no time in common with the log.

    Raises:
        UserError: they do not overlap; the line gives the start and end of both.
    """
    first_ns, last_ns = trajectory.span
    if first_ns <= span[1] and last_ns >= span[0]:
        return
    raise UserError(
        f"{file}: covers {gps_text(first_ns)} to {gps_text(last_ns)}, {log} from {gps_text(span[0])} to "
        f"{gps_text(span[1])}: they do not overlap; give the trajectory of this flight, or --week"
    )


def refuse_other_motion(clocks: LogClocks, trajectory: Trajectory, file: str, log: Path) -> list[str]:
    """Refuse a trajectory that turns at other times than the log's IMU: one in UTC or of another week does.

    Returns:
        A line of doubt if it turns a little earlier or later; else no line.

    Raises:
        UserError: it turns at other times; the line gives the time offset.
    """
    if len(clocks.imu_gps_ns) < 2 or len(trajectory) < 2:
        return []
    from swath.georef.trajectory.turn_rates import correlate_turn_rates  # scipy.signal, which takes seconds to load

    shift = correlate_turn_rates(trajectory, clocks.imu_gps_ns, clocks.imu_rate_b)
    if shift.is_wrong:
        raise UserError(f"{file}: {shift.what} (by comparison of its turn rates with those of the IMU in {log})")
    if shift.is_certain and abs(shift.seconds) > LATE_S:
        return [
            f"{file}: its turns lag those of the IMU in {log} by {-shift.seconds:.3f} s; its time may be off by this "
            "amount"
        ]
    return []


def attitude_doubts(trajectory: Trajectory, named: str) -> list[str]:
    """Return a line if the body would fly on its back or sideways: the attitude then refers to other axes than b's."""
    step = max(1, len(trajectory) // LOOKED_AT)
    seen = replace(trajectory, **{column: getattr(trajectory, column)[::step] for column in COLUMNS})
    roll, pitch, heading = seen.attitude()
    north, east, _ = seen.velocity_l().T
    flies = np.hypot(north, east) > FLIES_MPS
    lines = []
    if len(seen) and np.median(np.cos(roll) * np.cos(pitch)) < 0.0:
        lines.append(f"{named}: its z axis points up, so the body would fly upside down; {AXES}")
    if flies.any():
        apart = heading[flies] - np.arctan2(east[flies], north[flies])
        if np.median(np.cos(apart)) < FORWARD:
            usual_deg = np.degrees(np.arctan2(np.median(np.sin(apart)), np.median(np.cos(apart))))
            lines.append(f"{named}: its x axis points {usual_deg:+.0f}° beside the course; {AXES}")
    return lines
