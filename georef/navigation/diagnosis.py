"""What is wrong with the input of navigation, in words and with what to change.

What stands first hides what comes later: of data without a common time nothing more is asked, and a lever arm means
nothing before the axes are right.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from georef.navigation.diagnosis_data import MOSTLY, force, gaps, receiver, times
from georef.navigation.diagnosis_data import Finding as Finding
from georef.navigation.diagnosis_motion import (
    FAILS,
    Axes,
    Sensor,
    Window,
    body_axes,
    heading_offset,
    lever_arm,
    other_signs,
    sensor_axes,
    windows,
)
from georef.navigation.diagnosis_time import TimeOffset, time_offset
from georef.navigation.inputs import Fate, Inertial, Kind, Setup, Solution
from georef.records import StructArray
from georef.timescales.gps_time import GPS_EPOCH, SECOND_NS, table_leap_seconds

FloatArray = NDArray[np.float64]

G_MPS2 = 9.80665
SWAPPED_RAD, TURNED_RAD = np.radians([135.0, 10.0])
ORIGIN_SHARE = 0.25  # of the lever arm: so near the origin positions are the body's
ARM_OFF_M = 1.0
AXES = "xyz"


class HasSolution(Protocol):
    """Solved navigation."""

    @property
    def smoothed(self) -> Solution:
        """With its innovations."""


def diagnose(
    inertial: Inertial, observations: StructArray, setup: Setup, solved: HasSolution | None = None
) -> list[Finding]:
    """Faults of the input that the data themselves show, the worst first; empty where nothing is wrong.

    Args:
        inertial: samples.
        observations: `OBSERVATION_DTYPE`, by time.
        setup: as the filter takes it.
        solved: of the same data; None: without what the filter rejected.
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
            findings += _motion(inertial, observations, setup)
        findings += _rejected(solved)
    return sorted(findings, key=lambda finding: finding.severity != "error")


def _motion(inertial: Inertial, observations: StructArray, setup: Setup) -> Iterator[Finding]:
    """Do IMU and GNSS go together: in time, axes, headings, lever arm?"""
    offset = time_offset(inertial, observations)
    if offset is not None and offset.is_wrong:
        yield _offset_finding(offset, int(inertial.time_ns[0]))
        observations = observations.copy()
        observations["time_ns"] -= round(offset.seconds * SECOND_NS)
    chosen = windows(inertial, observations, setup)
    sensor = sensor_axes(chosen, setup)
    unmatched = _sensor_finding(*sensor) if sensor is not None else _matched(chosen)
    if unmatched is not None:
        yield unmatched
        return
    axes = body_axes(chosen)
    turned = _axes_finding(axes) if axes is not None else None
    turned = turned or _gravity(inertial)
    if turned is not None:
        yield turned
        return
    yield from _headings(chosen, setup)
    yield from _arms(chosen, setup)


def _offset_finding(offset: TimeOffset, gps_ns: int) -> Finding:
    late = "late" if offset.seconds > 0.0 else "early"
    leap = table_leap_seconds(GPS_EPOCH + dt.timedelta(seconds=gps_ns // SECOND_NS))[0]
    size = abs(offset.seconds)
    words = f"{1000.0 * size:.0f} ms" if size < 2.0 else f"{size:.2f} s"
    hint = "check how the IMU is stamped (pps, sample, stamp) or let the filter estimate the offset"
    if abs(size - leap) < 0.5:
        hint = f"GPS and UTC differ by these {leap} s: one of the two is taken for the other"
    return Finding(
        "time_offset",
        "error",
        f"GNSS's times are {words} {late} against the IMU's (±{1000.0 * offset.sigma:.0f} ms, by comparing their "
        f"motion): {hint}",
    )


def _sensor_finding(sensor: Sensor, axes: Axes) -> Finding:
    name, other, key = (
        ("gyroscopes", "accelerometers", "angular_rate")
        if sensor == "gyro"
        else ("accelerometers", "gyroscopes", "specific_force")
    )
    scale = float(np.abs(axes.matrix).max())
    taken = ", ".join(_axis(row) for row in axes.matrix)
    how = f"taken as ({taken}) for body x, y, z they fit"
    what = f"put {key}'s signals into that order and sign"
    if not np.isclose(scale, 1.0):
        how, what = f"{scale:.4g} times as large they fit", f"{key} has the wrong unit: degrees are taken for radians"
        if scale > 1.0:
            what = f"{key} has the wrong unit: radians are taken for degrees"
    return Finding(
        f"{sensor}_axes" if np.isclose(scale, 1.0) else f"{sensor}_unit",
        "error",
        f"the {name} do not go with the {other} and GNSS: {how} {np.sqrt(axes.gain):.0f} times better; {what}",
    )


def _matched(chosen: list[Window]) -> Finding | None:
    misfit = [window.fitted.misfit for window in chosen]
    if not misfit or np.median(misfit) < FAILS:
        return None
    return Finding(
        "not_one_motion",
        "error",
        f"GNSS does not move as the IMU feels (residuals {np.sqrt(np.median(misfit)):.0f} times their sigma): they may "
        "be on different vehicles, or a sensor's axes, units or times are wrong; check which receiver it is",
    )


def _axes_finding(axes: Axes) -> Finding | None:
    if np.array_equal(axes.matrix, np.eye(3)):
        return None
    rows = "[" + ", ".join("[" + ", ".join(f"{value:.0f}" for value in row + 0.0) + "]" for row in axes.matrix) + "]"
    read = np.array([0.0, 0.0, -1.0]) @ axes.matrix
    axis = int(np.argmax(np.abs(read)))
    gravity = f"body {AXES[axis]} reads {read[axis]:+.0f} g" if axis != 2 or read[2] > 0.0 else "z does point down"
    ahead = _axis(axes.matrix[0])
    return Finding(
        "axes",
        "error",
        f"the body's axes are not forward, right, down: {gravity} (z down reads -1 g) and the vehicle goes along body "
        f"{ahead}; multiply rotation_b_imu from the left by {rows}",
    )


def _gravity(inertial: Inertial) -> Finding | None:
    """The mean specific force, for what never goes anywhere."""
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
        f"rotation_b_imu from the left by {rows}, or by another turn that brings gravity there (which way is forward, "
        "motion will tell)",
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
            f"dual-antenna headings are {np.degrees(abs(off)):.0f}° off the motion's: the antennas are swapped; "
            "exchange lever_arm_m and secondary_lever_arm_m, or the cables",
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
            f"{what} the lever_arm_m given, {_vector(arm)} m: {_vector(fitted)} m (±{sigma.max():.2f}) fits; x is "
            "forward, y right, z down, from the body's origin to the antenna",
        )
    elif np.linalg.norm(arm) > clear and np.linalg.norm(fitted) < ORIGIN_SHARE * off:
        yield Finding(
            "position_at_body",
            "error",
            f"GNSS's positions are of the body's origin, not of an antenna at {_vector(arm)} m ({_vector(fitted)} m "
            f"fits, ±{sigma.max():.2f}): they were brought there already; set lever_arm_m to zero for them",
        )
    elif max(abs(fitted - arm)[1:]) > max(ARM_OFF_M, clear):
        given_none = np.linalg.norm(arm) < 0.1
        hint = "they may be an INS solution given at the antenna" if given_none else "measure it again"
        yield Finding(
            "lever_arm",
            "warning",
            f"GNSS's positions fit a lever arm of {_vector(fitted)} m (±{sigma.max():.2f}), {off:.1f} m from the "
            f"{_vector(arm)} m given: {hint}",
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
                f"the filter refused {100.0 * refused.mean():.0f} % of GNSS's {name}: their sigmas are too small, or "
                "lever_arm_m, times or noise of the IMU are wrong",
            )


def _axis(row: FloatArray) -> str:
    """Which axis, with its sign, a row of a signed permutation takes."""
    axis = int(np.argmax(np.abs(row)))
    return f"{'-' if row[axis] < 0.0 else '+'}{AXES[axis]}"


def _vector(values: FloatArray) -> str:
    return "[" + ", ".join(f"{value:.2f}" for value in values + 0.0) + "]"
