"""Navigates logs: start, filter, smoother, diagnosis, leg by leg; gives one trajectory per session."""

from __future__ import annotations

import math
import mmap
import os
import tempfile
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.log.reader import Session
from swath.daemon.processing.navigation.inputs import InputOptions, Leg, NavigationInputs, protocol_of, read_inputs
from swath.daemon.processing.navigation.sources import noise_of
from swath.daemon.processing.navigation.times import Stretch
from swath.georef.arrays import FloatArray, StructArray
from swath.georef.geodesy.quaternions import conjugate, rotated
from swath.georef.navigation.alignment.align import align
from swath.georef.navigation.alignment.earlier_start import earlier_start
from swath.georef.navigation.diagnosis.diagnose import diagnose
from swath.georef.navigation.filter.stores import IN_MEMORY, Storage
from swath.georef.navigation.inputs import (
    GRADES,
    OBSERVATION_DTYPE,
    Kind,
    NavigationError,
    Solution,
    sort_observations,
)
from swath.georef.navigation.solve import solve, stretch_of
from swath.georef.navigation.stillness import with_still_seconds
from swath.georef.navigation.unit_noise import noise_findings
from swath.georef.points import Fate
from swath.georef.progress import BYTES, Tell, silent
from swath.georef.records import FixType
from swath.georef.trajectory.buffer import TrajectoryBuffer
from swath.georef.trajectory.trajectory import DEFAULT_MAX_GAP_NS, Trajectory

if TYPE_CHECKING:
    from swath.georef.navigation.diagnosis.diagnose import Finding
    from swath.georef.navigation.inputs import Setup, Start
    from swath.georef.navigation.solve import Solved

FEWEST = 20  # minimum number of solutions to compare
STEP_NS = 1_000_000_000
APART_M = 0.2  # offset from which on the INS gives another point
STEADY = 0.5  # scatter of the offset in b, relative to its length, above which it is not a point of the body
NEAR = 0.3  # of the lever arm: within this distance the point is the antenna

SMALLEST_BYTES = 1 << 20  # smaller arrays are kept in memory

UNTIL_A_FIX_NS = 1_000_000_000  # a shorter wait for a position is due to the receiver's rate
NAVIGATED = "navigation of the log's IMU and GNSS"
GIVEN_SIGMA_RAD = tuple(map(math.radians, (1.0, 1.0, 3.0)))  # sigmas of an attitude that the user enters
COLUMNS = ("time_ns", "position_e", "q_e_from_b", "velocity_e", "position_sigma_l", "attitude_sigma_rad")


@dataclass(frozen=True, slots=True)
class NavigationOptions:
    """The options of navigation from the command line.

    Attributes:
        inputs: options of the inputs.
        smooth: run the smoother too; False: as in real time.
        attitude_rad: roll, pitch, heading at the start; None: they are estimated.
        compare_noise: test whether the flight suggests another noise of the IMU; takes some runs of ten minutes.
    """

    inputs: InputOptions = field(default_factory=InputOptions)
    smooth: bool = True
    attitude_rad: tuple[float, float, float] | None = None
    compare_noise: bool = False


@dataclass(frozen=True, eq=False)
class NavigatedLeg:
    """A leg with its solution."""

    leg: Leg
    start: Start
    setup: Setup
    solved: Solved
    findings: list[Finding]

    def solution(self, *, smooth: bool) -> Solution:
        """Return the smoothed or the forward solution."""
        return self.solved.smoothed if smooth else self.solved.forward

    def noise_found(self) -> dict[str, float]:
        """Return the factors on the receiver's sigmas, its own or assumed ones, with which the leg was navigated."""
        rows, setup = self.solved.forward.innovations, self.setup
        found: dict[str, float] = {}
        for kind, words, scales, of_vertical in (
            (Kind.POSITION, "positions", setup.gnss_sigma_scale, setup.gnss_vertical_scale),
            (Kind.VELOCITY, "velocities", setup.gnss_velocity_scale, setup.gnss_velocity_vertical_scale),
        ):
            for fix in sorted(set(rows["fix_type"][rows["kind"] == kind].tolist())):
                name = f"{words}, {FixType(fix).name.lower().replace('_', ' ')}"
                if fix in scales:
                    found[name] = scales[fix]
                if fix in of_vertical:
                    found[f"{name}, vertical"] = scales.get(fix, 1.0) * of_vertical[fix]
        if setup.gnss_heading_scale != 1.0:
            found["headings"] = setup.gnss_heading_scale
        return found


@dataclass(frozen=True, eq=False)
class Navigated:
    """A session's trajectory and how it came about.

    Attributes:
        legs: legs that could be navigated.
        holes: missing data, one line each, those of the inputs included.
        warnings: lines for the user.
        missing: stretches of samples without a trajectory, by time; each has a line in holes.
    """

    inputs: NavigationInputs
    smooth: bool
    legs: list[NavigatedLeg]
    holes: list[str]
    warnings: list[str]
    missing: list[Stretch] = field(default_factory=list)

    @property
    def missing_s(self) -> float:
        """Total time of samples without a trajectory, s."""
        return sum(part.seconds for part in self.missing)

    @property
    def session_id(self) -> str:
        """The session's identifier."""
        return self.inputs.session.session_id

    def solutions(self) -> list[Solution]:
        """Return the solutions of the legs, in order of time."""
        return [leg.solution(smooth=self.smooth) for leg in self.legs]

    def trajectory(self, name: str = NAVIGATED) -> Trajectory:
        """Return the trajectory of all legs, with gaps between them."""
        return joined_trajectory([solution.trajectory() for solution in self.solutions()], name)

    def velocity_sigma_l(self) -> FloatArray:
        """Return sigmas of velocity (n, 3), m/s, at the trajectory's epochs."""
        return np.concatenate([solution.velocity_sigma_l for solution in self.solutions()])


def navigate_session(session: Session, request: NavigationOptions, tell: Tell = silent) -> Navigated:
    """Read a session and navigate it.

    Raises:
        UserError: the session cannot be navigated; one line per reason.
        LogError, OSError: the log cannot be read.
    """
    session.progress = lambda done, total: tell("IMU and GNSS", done, total, BYTES)
    storage = MappedStorage()
    inputs = read_inputs(session, request.inputs, storage)
    storage.rest()
    return navigate_inputs(inputs, request, tell, storage)


def navigate_inputs(
    inputs: NavigationInputs,
    request: NavigationOptions,
    tell: Tell = silent,
    storage: Storage = IN_MEMORY,
) -> Navigated:
    """Navigate inputs that were read; runs and solutions are kept in the storage.

    Raises:
        UserError: no leg can be navigated; one line per reason.
    """
    legs: list[NavigatedLeg] = []
    holes, missing = list(inputs.holes), list(inputs.missing)
    for number, leg in enumerate(inputs.legs):
        tell("alignment" if len(inputs.legs) == 1 else f"alignment, leg {number + 1} of {len(inputs.legs)}", 0, 0)
        try:
            legs.append(_navigated(inputs, leg, request, storage, tell))
            storage.rest()
        except NavigationError as error:
            missing.append(Stretch(*leg.span, str(error)))
            holes.append(f"{inputs.log}: {missing[-1].text}")
            holes += _why_not(inputs, leg)
    if not legs:
        why = holes[len(inputs.holes) :] or [
            f"{inputs.log}: {inputs.sources.imu_source}: no run of samples without a gap is long enough for navigation"
        ]
        raise UserError("\n".join(why))
    warnings = list(inputs.warnings)
    for part, has_fixes in _unreached(legs, smooth=request.smooth):
        if request.smooth and has_fixes:
            missing.append(part)
        (holes if request.smooth and has_fixes else warnings).append(f"{inputs.log}: {part.text}")
    navigated = Navigated(
        inputs, request.smooth, legs, holes, warnings, sorted(missing, key=lambda part: part.begin_ns)
    )
    navigated.warnings.extend(_ins_doubts(inputs, navigated.trajectory()))
    return navigated


def _navigated(
    inputs: NavigationInputs, leg: Leg, request: NavigationOptions, storage: Storage, tell: Tell
) -> NavigatedLeg:
    rows = leg.observations if request.attitude_rad is None else _with_attitude(leg, request.attitude_rad)
    start = align(leg.inertial, rows, inputs.setup)
    if request.smooth:
        start = earlier_start(leg.inertial, leg.observations, inputs.setup, start)
    setup, rows = inputs.setup, with_still_seconds(leg.inertial, leg.observations)
    solved = solve(leg.inertial, rows, setup, start, storage=storage, tell=tell)
    setup = solved.report.setup
    tell("diagnosis", 0, 0)
    findings = diagnose(leg.inertial, leg.observations, setup, solved) + inputs.findings
    if request.compare_noise and not any(finding.severity == "error" for finding in findings):
        tell("noise of the IMU", 0, 0)
        table, name = inputs.sources.imu.noise, inputs.sources.imu_name
        grades = {grade: noise_of(table.model_copy(update={"grade": grade})) for grade in GRADES}
        run = stretch_of(leg.inertial, rows, start)
        findings += noise_findings(run, setup, table.grade, grades, f"imu.{name}.noise")
    return NavigatedLeg(leg, start, setup, solved, findings)


def _why_not(inputs: NavigationInputs, leg: Leg) -> list[str]:
    """Return the faults in the data of a leg for which no start was found."""
    found = diagnose(leg.inertial, leg.observations, inputs.setup, None)
    return [f"{inputs.log}: {finding.text}" for finding in found]


def _with_attitude(leg: Leg, attitude_rad: tuple[float, float, float]) -> StructArray:
    """Return the observations together with a known attitude at the leg's beginning."""
    row = np.zeros(1, OBSERVATION_DTYPE)
    row["time_ns"], row["kind"] = leg.inertial.time_ns[0], Kind.ATTITUDE
    row["value"], row["sigma"] = attitude_rad, GIVEN_SIGMA_RAD
    return sort_observations(np.concatenate([leg.observations, row]))


def _unreached(legs: Sequence[NavigatedLeg], *, smooth: bool) -> list[tuple[Stretch, bool]]:
    """Return the stretches before the starts, and for each whether it has positions to start from."""
    found: list[tuple[Stretch, bool]] = []
    for leg in legs:
        first, rows = int(leg.solution(smooth=smooth).time_ns[0]), leg.leg.observations
        fixes_ns = rows["time_ns"][(rows["kind"] == Kind.POSITION) & (rows["time_ns"] >= leg.leg.span[0])]
        fix_ns = int(fixes_ns[0]) if len(fixes_ns) else first
        if fix_ns - leg.leg.span[0] > UNTIL_A_FIX_NS:
            part = Stretch(leg.leg.span[0], min(fix_ns, first), "no trajectory before the first position")
            found.append((part, False))
        if first - fix_ns > UNTIL_A_FIX_NS:
            found.append((Stretch(fix_ns, first, "no trajectory: alignment found no earlier start"), True))
    return found


def _ins_doubts(inputs: NavigationInputs, navigated: Trajectory) -> list[str]:
    """Return doubts about the device's own INS, compared with the navigated trajectory."""
    source = inputs.sources.ins_source
    if source is None or len(inputs.ins) < 2:
        return []
    buffer = TrajectoryBuffer(protocol_of(inputs.sources, source), name=source)
    buffer.append(inputs.ins)
    lines = point_doubts(buffer.snapshot(), navigated, list(inputs.setup.lever_arms_b), source)
    return [f"{inputs.log}: {line}" for line in lines]


def joined_trajectory(parts: Sequence[Trajectory], name: str, max_gap_ns: int = DEFAULT_MAX_GAP_NS) -> Trajectory:
    """Return one trajectory of several that follow each other."""
    if len(parts) == 1:
        return replace(parts[0], name=name, max_gap_ns=max_gap_ns)
    columns = {column: np.concatenate([getattr(part, column) for part in parts]) for column in COLUMNS}
    return Trajectory(**columns, max_gap_ns=max_gap_ns, name=name)


def arm_of_text(text: str) -> tuple[float, float, float]:
    """Return the lever arm, m in b, from a text ``x,y,z`` in metres.

    Raises:
        UserError: the text is not a lever arm.
    """
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not max(abs(x), abs(y), abs(z)) < 1000.0:
        raise UserError(f'--lever-arm: got "{text}", want x,y,z in metres, as 0.35,-0.12,-1.1', ExitCode.USAGE)
    return x, y, z


def attitude_of_text(text: str) -> tuple[float, float, float]:
    """Return the attitude, rad, from a text ``roll,pitch,heading`` in degrees.

    Raises:
        UserError: the text is not an attitude.
    """
    try:
        roll, pitch, heading = (float(part) for part in text.split(","))
    except ValueError:
        roll = pitch = heading = math.nan
    if not (abs(roll) <= 180.0 and abs(pitch) <= 90.0 and abs(heading) <= 360.0):
        raise UserError(f'--start: got "{text}", want roll,pitch,heading in degrees, as 0.5,-1.2,273', ExitCode.USAGE)
    return math.radians(roll), math.radians(pitch), math.radians(heading)


class MappedStorage(Storage):
    """Keeps large arrays in unnamed files, which vanish with the arrays; `rest` takes them out of memory.

    Disk space is reserved when an array is made, so that a full disk is noticed then; such an array is kept in memory.

    Args:
        folder: folder of the files; None: that of temporary files.
        smallest_bytes: arrays from this size on are mapped.
    """

    def __init__(self, folder: Path | None = None, smallest_bytes: int = SMALLEST_BYTES) -> None:
        self._folder, self._smallest_bytes = folder, smallest_bytes
        self._mapped: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()

    def empty(self, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        """Return an array, mapped and zeroed if it is large."""
        size = prod(shape) * np.dtype(dtype).itemsize
        if size < max(self._smallest_bytes, 1):
            return np.empty(shape, dtype)
        try:
            with tempfile.TemporaryFile(dir=self._folder) as file:
                os.posix_fallocate(file.fileno(), 0, size)
                mapping = mmap.mmap(file.fileno(), size)
        except OSError:
            return np.empty(shape, dtype)
        self._mapped.add(mapping)
        return np.frombuffer(mapping, dtype).reshape(shape)

    def rest(self) -> None:
        """Take mapped arrays out of memory; they are read from their files again when used."""
        for mapping in self._mapped:
            mapping.madvise(mmap.MADV_DONTNEED)


def offset_in_b(ins: Trajectory, navigated: Trajectory) -> tuple[FloatArray, FloatArray] | None:
    """Return median and scatter (3,) of an INS's point, from the body's origin in b, m; None if there are too few
    epochs.
    """
    _, first = np.unique(ins.time_ns // STEP_NS, return_index=True)
    first = first[navigated.fates(ins.time_ns[first]) == Fate.GEOREFERENCED]
    if len(first) < FEWEST:
        return None
    poses = navigated.poses(ins.time_ns[first])
    apart_b = rotated(conjugate(poses.q_e_from_b), ins.position_e[first] - poses.position_e)
    middle: FloatArray = np.median(apart_b, axis=0)
    scatter: FloatArray = 1.4826 * np.median(np.abs(apart_b - middle), axis=0)
    return middle, scatter


def point_doubts(ins: Trajectory, navigated: Trajectory, lever_arms_b: Sequence[FloatArray], source: str) -> list[str]:
    """Return a line if the INS's point is not the body's origin, naming the likely point."""
    found = offset_in_b(ins, navigated)
    if found is None:
        return []
    offset, scatter = found
    length_m = float(np.linalg.norm(offset))
    if length_m < APART_M or float(np.linalg.norm(scatter)) > STEADY * length_m:
        return []
    place = ", ".join(f"{value:.2f}" for value in offset)
    what, point = "another point than the IMU", place.replace(" ", "")
    for arm in lever_arms_b:
        length = float(np.linalg.norm(arm))
        if length > APART_M and float(np.linalg.norm(offset - arm)) < NEAR * length:
            what, point = "its antenna", "antenna"
            break
    return [
        f"{source}: its own INS gives the trajectory of {what}, {length_m:.2f} m from the body's origin ({place} m in "
        f"b); use --trajectory-at {point} with that solution, or let the device give its solution at the IMU"
    ]
