"""Diagnose faults of navigation's input, in words and with the remedy.

Earlier checks come first because their faults hide later ones: without a common time no further check is made, and a
lever arm cannot be judged before the axes are right.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np

from swath.georef.arrays import FloatArray, StructArray
from swath.georef.navigation.diagnosis.data import MOSTLY, force, gaps, receiver, times
from swath.georef.navigation.diagnosis.data import Finding as Finding
from swath.georef.navigation.diagnosis.motion import (
    FAILS,
    FITS,
    Mounting,
    Window,
    body_axes,
    heading_offset,
    lever_arm,
    median_misfit,
    mounting_of,
    other_signs,
    windows,
)
from swath.georef.navigation.diagnosis.time import SIGMAS, TimeOffset, time_offset, velocities
from swath.georef.navigation.inputs import Fate, Inertial, Kind, Setup, Solution
from swath.georef.timescales.gps_time import GPS_EPOCH, SECOND_NS, table_leap_seconds

G_MPS2 = 9.80665
SWAPPED_RAD, TURNED_RAD = np.radians([135.0, 10.0])
ORIGIN_SHARE = 0.25  # of the lever arm: positions this close to the origin are taken as the body's
ARM_OFF_M = 1.0
AXES = "xyz"
SHIFTED = 0.5  # times the misfit: the most that removing a time offset may leave
ALONE = 5.0  # sigmas of an offset that no fit can confirm
SHOWS = 0.5  # share of the innovations expected from an offset that the filter must show at least if the offset is real
AGREES_S = 0.05  # a smaller offset is ignored


class HasSolution(Protocol):
    """A solved navigation with its smoothed solution."""

    @property
    def smoothed(self) -> Solution:
        """The smoothed solution, with its innovations."""


def diagnose(
    inertial: Inertial, observations: StructArray, setup: Setup, solved: HasSolution | None = None
) -> list[Finding]:
    """Return faults of the input that the data themselves show, the worst first; empty if there are none.

    Args:
        inertial: samples.
        observations: `OBSERVATION_DTYPE`, by time.
        setup: as the filter takes it.
        solved: of the same data; None: the filter's rejections are not checked.
    """
    place = observations[observations["kind"] == Kind.POSITION]
    findings = list(times(inertial, place))
    if not any(finding.severity == "error" for finding in findings):
        findings += gaps(inertial)
        findings += receiver(observations, place)
        findings += force(inertial)
        codes = {finding.code for finding in findings if finding.severity == "error"}
        if "positions_and_velocities" in codes:
            observations = observations[observations["kind"] != Kind.VELOCITY]
        if not codes & {"gnss_bad", "force_size"}:
            findings += _motion(inertial, observations, setup, solved)
        findings += _rejected(solved)
    return sorted(findings, key=lambda finding: finding.severity != "error")


def _motion(
    inertial: Inertial, observations: StructArray, setup: Setup, solved: HasSolution | None
) -> Iterator[Finding]:
    """Yield faults that IMU and GNSS show together: axes, time, headings, lever arm.

    Axes come first: with wrong ones no time is right. A time offset is reported if removing it improves the fit.
    """
    taken_s = 0.0
    if solved is not None and setup.estimate_time_offset_s > 0.0 and len(solved.smoothed.time_offset_s):
        taken_s = float(solved.smoothed.time_offset_s[-1])  # estimated by the filter, so that these times include it
        observations = observations.copy()
        observations["time_ns"] += round(taken_s * SECOND_NS)
    chosen = windows(inertial, observations, setup)
    mounting = mounting_of(chosen, setup)
    if mounting is None or mounting.is_as_it_is:
        offset = time_offset(inertial, observations)
        if offset is not None and abs(offset.seconds) > max(AGREES_S, SIGMAS * offset.sigma):
            moved = observations.copy()
            moved["time_ns"] -= round(offset.seconds * SECOND_NS)
            there = windows(inertial, moved, setup)
            other = mounting_of(there, setup)
            left = median_misfit(there) if other is None or other.is_as_it_is else other.left
            clear = abs(offset.seconds) > ALONE * offset.sigma
            mends = left < SHIFTED * median_misfit(chosen) if chosen else clear
            if mends and offset.is_wrong and not _filter_denies(offset, observations, solved):
                whole = replace(offset, seconds=offset.seconds - taken_s)
                yield _offset_finding(whole, int(inertial.time_ns[0]))
                observations, chosen, mounting = moved, there, other
            elif offset.contradiction and median_misfit(chosen) > FITS:
                yield _doubted_offset(offset)
    body = body_axes(chosen, setup, mounting)
    if mounting is None or mounting.is_as_it_is:
        unmatched = _matched(chosen) if mounting is None else None
    else:
        unmatched = _sensor_finding(mounting, body)
    turned = _axes_finding(body) if body is not None else None
    wrong = unmatched or turned or _gravity(inertial)
    if wrong is not None:
        yield wrong
        return
    arms = [*_headings(chosen, setup), *_arms(chosen, setup)]
    yield from arms
    unmatched = _matched(chosen)
    if unmatched is not None and not arms:
        yield unmatched


def _filter_denies(offset: TimeOffset, observations: StructArray, solved: HasSolution | None) -> bool:
    """Return whether the filter's innovations contradict an offset, which would have made them larger."""
    if solved is None:
        return False
    rows = solved.smoothed.innovations
    rows = rows[~np.isin(rows["fate"], (Fate.OUTSIDE, Fate.UNUSABLE))]
    time_ns, velocity_l = velocities(observations)
    step_s = np.diff(time_ns) / SECOND_NS
    if len(step_s) < 10:
        return False
    change = np.linalg.norm(np.diff(velocity_l[:, :2], axis=0), axis=1) / np.maximum(step_s, 1e-3)
    expected = abs(offset.seconds) * float(
        np.sqrt(np.mean(change[step_s < 2.5] ** 2))
    )  # m/s between GNSS and the filter
    for kind, per_s in ((Kind.VELOCITY, 1.0), (Kind.POSITION, float(np.median(step_s)))):
        left = rows[rows["kind"] == kind]["value"][:, :2]
        if len(left) >= 10:
            return bool(np.sqrt(np.nanmean((left**2).sum(axis=1))) < SHOWS * expected * per_s)
    return False


def _doubted_offset(offset: TimeOffset) -> Finding:
    return Finding(
        "time_unclear",
        "warning",
        f"comparisons of the motion disagree about the time between GNSS and IMU: by the {offset.compared} "
        f"{1000.0 * offset.seconds:+.0f} ± {1000.0 * offset.sigma:.0f} ms, {offset.contradiction}; no offset is "
        "applied: check how the IMU is stamped (pps, sample, stamp)",
    )


def _offset_finding(offset: TimeOffset, gps_ns: int) -> Finding:
    late = "late" if offset.seconds > 0.0 else "early"
    leap = table_leap_seconds(GPS_EPOCH + dt.timedelta(seconds=gps_ns // SECOND_NS))[0]
    size = abs(offset.seconds)
    words = f"{1000.0 * size:.0f} ms" if size < 2.0 else f"{size:.2f} s"
    hint = "check how the IMU is stamped (pps, sample, stamp) or let the filter estimate the offset"
    if size > 0.5:
        hint = (
            "check that the positions are in GPS time (not with other leap seconds) and that seconds are named "
            "correctly, or " + hint
        )
    if abs(size - leap) < 0.5:
        hint = f"GPS and UTC differ by these {leap} s: give both sensors' times in one of the two time scales"
    return Finding(
        "time_offset",
        "error",
        f"GNSS's times are {words} {late} against the IMU's (±{1000.0 * offset.sigma:.0f} ms, by comparing their "
        f"motion): {hint}",
    )


def _sensor_finding(mounting: Mounting, body: FloatArray | None) -> Finding:
    """Return the finding for wrong sensor axes or units, with the remedy.

    ``body`` is the turn that the direction of travel requires.
    """
    turn = np.eye(3) if body is None else body
    gyro, accel = turn @ mounting.gyro, turn @ mounting.accel
    times = f"{np.sqrt(mounting.gain):.0f} times better"
    if mounting.rivals:
        ways = " or ".join(
            f"gyroscopes ({_taken(turn @ one)}) with accelerometers ({_taken(turn @ other)})"
            for one, other in ((mounting.gyro, mounting.accel), *mounting.rivals)
        )
        return Finding(
            "axes_unclear",
            "error",
            "the gyroscopes do not fit the accelerometers and GNSS, and the motion does not show which axes are "
            f"right: for body x, y, z {ways} fit equally well; fly banked turns and pull up between them, or inspect "
            "the mounting",
        )
    unit = "degrees are read as radians" if mounting.unit < 1.0 else "radians are read as degrees"
    if mounting.unit != 1.0 and _is_one(gyro) and _is_one(accel):
        return Finding(
            "gyro_unit",
            "error",
            f"the gyroscopes do not fit the accelerometers and GNSS: {mounting.unit:.4g} times as large they fit "
            f"{times}; angular_rate has the wrong unit: {unit}",
        )
    also = "" if mounting.unit == 1.0 else f"; angular_rate has the wrong unit too: {unit}"
    if np.array_equal(gyro, accel):
        return Finding(
            "axes_mirrored",
            "error",
            f"both triads are mirrored, which rotation_b_imu cannot correct: read as ({_taken(gyro)}) for body x, y, "
            f"z they fit {times}; put specific_force's and angular_rate's signals into that order and sign{also}",
        )
    if _is_one(accel) or _is_one(gyro) or body is None:
        name, other, key, matrix = ("gyroscopes", "accelerometers", "angular_rate", gyro)
        if _is_one(gyro):
            name, other, key, matrix = ("accelerometers", "gyroscopes", "specific_force", accel)
        mirrored = "" if body is not None or _is_one(accel) else ", specific_force's negated"
        return Finding(
            f"{name[:4] if name[0] == 'g' else name[:5]}_axes",
            "error",
            f"the {name} do not fit the {other} and GNSS: read as ({_taken(matrix)}) for body x, y, z they fit "
            f"{times}; put {key}'s signals into that order and sign{mirrored}{also}",
        )
    return Finding(
        "sensor_axes",
        "error",
        f"gyroscopes and accelerometers both have wrong axes, each in its own way: read as ({_taken(gyro)}) and "
        f"({_taken(accel)}) for body x, y, z they fit {times}; put angular_rate's signals into the first order and "
        f"sign, specific_force's into the second{also}",
    )


def _is_one(matrix: FloatArray) -> bool:
    return bool(np.array_equal(matrix, np.eye(3)))


def _taken(matrix: FloatArray) -> str:
    return ", ".join(_axis(row) for row in matrix)


def _matched(chosen: list[Window]) -> Finding | None:
    misfit = median_misfit(chosen)
    if misfit < FAILS:
        return None
    return Finding(
        "not_one_motion",
        "error",
        f"GNSS and IMU show different motion (residuals {np.sqrt(misfit):.0f} times their sigma): they may be on "
        "different vehicles, or a sensor's axes, units or times are wrong; check which receiver it is",
    )


def _axes_finding(matrix: FloatArray) -> Finding | None:
    if _is_one(matrix):
        return None
    rows = "[" + ", ".join("[" + ", ".join(f"{value:.0f}" for value in row + 0.0) + "]" for row in matrix) + "]"
    read = np.array([0.0, 0.0, -1.0]) @ matrix
    axis = int(np.argmax(np.abs(read)))
    gravity = f"body {AXES[axis]} reads {read[axis]:+.0f} g" if axis != 2 or read[2] > 0.0 else "z points down"
    ahead = _axis(matrix[0])
    return Finding(
        "axes",
        "error",
        f"the body's axes are not forward, right, down: {gravity} (z down reads -1 g) and the vehicle goes along body "
        f"{ahead}; multiply rotation_b_imu from the left by {rows}",
    )


def _gravity(inertial: Inertial) -> Finding | None:
    """Return a finding if the mean specific force lies along a wrong axis, for a vehicle that never moves."""
    mean = inertial.velocity_b.sum(axis=0) / max(float(inertial.interval_s.sum()), 1e-9) / G_MPS2
    axis = int(np.argmax(np.abs(mean)))
    if (axis == 2 and mean[2] < 0.0) or abs(mean[axis]) < 0.8:
        return None
    matrix = np.eye(3)
    if axis == 2:
        matrix = np.diag([1.0, -1.0, -1.0])
    else:  # the axis that reads 1 g becomes z, up where it reads +1 g
        sign = float(np.sign(mean[axis]))
        other = 1 - axis
        matrix = np.zeros((3, 3))
        matrix[2, axis], matrix[axis, 2], matrix[other, other] = -sign, sign, 1.0
    rows = "[" + ", ".join("[" + ", ".join(f"{value:.0f}" for value in row + 0.0) + "]" for row in matrix) + "]"
    return Finding(
        "gravity_axis",
        "error",
        f"body {AXES[axis]} reads {mean[axis]:+.2f} g on average where z, down, should read -1 g: multiply "
        f"rotation_b_imu from the left by {rows}, or by another rotation that brings gravity to z (motion shows which "
        "way is forward)",
    )


def _headings(chosen: list[Window], setup: Setup) -> Iterator[Finding]:
    found = heading_offset(chosen, setup)
    if found is None:
        return
    off, sigma = found
    if abs(off) > SWAPPED_RAD:
        yield Finding(
            "antennas_swapped",
            "error",
            f"dual-antenna headings are {np.degrees(abs(off)):.0f}° off the motion's: the antennas are exchanged; "
            "swap lever_arm_m and secondary_lever_arm_m, or the cables",
        )
    elif abs(off) > max(TURNED_RAD, 5.0 * sigma):
        yield Finding(
            "heading_offset",
            "warning",
            f"dual-antenna headings are {np.degrees(off):+.0f}° off the motion's: check secondary_lever_arm_m",
        )


def _arms(chosen: list[Window], setup: Setup) -> Iterator[Finding]:
    found = lever_arm(chosen, setup)
    if found is None:
        return
    fitted, sigma = found
    arm = setup.lever_arms_b[0]
    off = float(np.linalg.norm(fitted - arm))
    signs = other_signs(arm, fitted, sigma)
    clear = max(0.3, 8.0 * float(sigma.max()))
    if signs is not None:
        wrong = [AXES[axis] for axis in np.flatnonzero(signs < 0.0)]
        every = (signs < 0.0)[np.abs(arm) > 0.1].all()
        what = "the data fit -l better than" if every else f"the sign of {', '.join(wrong)} is wrong in"
        yield Finding(
            "lever_arm_sign",
            "error",
            f"{what} the given lever_arm_m, {_vector(arm)} m: {_vector(fitted)} m (±{sigma.max():.2f}) fits; x is "
            "forward, y right, z down, from the body's origin to the antenna",
        )
    elif np.linalg.norm(arm) > clear and np.linalg.norm(fitted) < ORIGIN_SHARE * off:
        yield Finding(
            "position_at_body",
            "error",
            f"GNSS's positions are those of the body's origin, not of an antenna at {_vector(arm)} m "
            f"({_vector(fitted)} m fits, ±{sigma.max():.2f}): they are already reduced to the origin; set lever_arm_m "
            "to zero for them",
        )
    elif max(abs(fitted - arm)[1:]) > max(ARM_OFF_M, clear):
        given_none = np.linalg.norm(arm) < 0.1
        hint = "check whether they are an INS solution at the antenna" if given_none else "measure it again"
        yield Finding(
            "lever_arm",
            "warning",
            f"GNSS's positions fit a lever arm of {_vector(fitted)} m (±{sigma.max():.2f}), {off:.1f} m from the "
            f"{_vector(arm)} m configured: {hint}",
        )


def _rejected(solved: HasSolution | None) -> Iterator[Finding]:
    if solved is None:
        return
    rows = solved.smoothed.innovations
    for kind, name in ((Kind.POSITION, "positions"), (Kind.VELOCITY, "velocities"), (Kind.HEADING, "headings")):
        fates = rows["fate"][rows["kind"] == kind]
        refused = np.isin(fates, (Fate.REJECTED, Fate.REACQUIRED))
        if len(fates) >= 20 and refused.mean() > MOSTLY:
            yield Finding(
                "gnss_rejected",
                "warning",
                f"the filter rejected {100.0 * refused.mean():.0f} % of GNSS's {name}: check their sigmas, which may "
                "be too small, lever_arm_m, the times and the noise of the IMU",
            )


def _axis(row: FloatArray) -> str:
    """Return the axis, with its sign, that a row of a signed permutation selects."""
    axis = int(np.argmax(np.abs(row)))
    return f"{'-' if row[axis] < 0.0 else '+'}{AXES[axis]}"


def _vector(values: FloatArray) -> str:
    return "[" + ", ".join(f"{value:.2f}" for value in values + 0.0) + "]"
