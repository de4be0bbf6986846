"""Find faults of inertial samples or GNSS by themselves: times, gaps, fixes, units."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from swath.georef.arrays import StructArray
from swath.georef.navigation.inputs import Inertial, Kind
from swath.georef.records import FixType
from swath.georef.timescales.gps_time import SECOND_NS, week_from_gps

G_MPS2 = 9.80665
MOSTLY = 0.5
WEEK_S = 604_800.0
BAD_SIGMA_M = 100.0
BRIDGED = (0.01, 0.3)  # shares of made-up intervals: worth a warning, and a sign of another rate
SIZE = (0.9, 1.1)  # of g: limits of the mean specific force of anything that stands, drives or flies
SPEED_OFF_MPS = 1.0  # greatest difference between velocities and the positions' changes


@dataclass(frozen=True, slots=True)
class Finding:
    """A fault of the input.

    Attributes:
        code: short name of the fault.
        severity: error: the trajectory will be wrong or missing; warning: it may be worse.
        text: one sentence, with the remedy.
    """

    code: str
    severity: Literal["error", "warning"]
    text: str


def times(inertial: Inertial, place: StructArray) -> Iterator[Finding]:
    """Yield a fault if IMU and GNSS have no common time, or if either's times jump by weeks."""
    for name, time_ns in (("the IMU's samples", inertial.time_ns), ("GNSS's positions", place["time_ns"])):
        if not len(time_ns):
            yield Finding("no_data", "error", f"there are none of {name}: look for the device in the log's sources")
            return
        step_s = np.diff(time_ns) / SECOND_NS
        weeks = np.rint(step_s / WEEK_S)
        jumps = np.flatnonzero((weeks != 0.0) & (np.abs(step_s - weeks * WEEK_S) < 0.25 * WEEK_S))
        if len(jumps):
            yield Finding(
                "week_jump",
                "error",
                f"the times of {name} jump by {step_s[jumps[0]]:.0f} s after {_time(time_ns[jumps[0]])}, about a "
                "week: the week number changed too early or too late at the change of weeks; give each part its own "
                "week",
            )
            return
    spans = [(int(time_ns[0]), int(time_ns[-1])) for time_ns in (inertial.time_ns, place["time_ns"])]
    if min(spans[0][1], spans[1][1]) > max(spans[0][0], spans[1][0]):
        return
    off_s = (sum(spans[1]) - sum(spans[0])) / 2 / SECOND_NS
    weeks_off = round(off_s / WEEK_S)
    hint = "check which clock stamps the IMU (pps, device time) and which week or date GNSS gives"
    if weeks_off and abs(off_s - weeks_off * WEEK_S) < max(np.diff(spans).max() / SECOND_NS, 60.0):
        hint = f"they are {weeks_off:+d} weeks apart: the week number of one of them is wrong"
    yield Finding(
        "no_common_time",
        "error",
        f"the IMU's samples span {_time(spans[0][0])} to {_time(spans[0][1])}, GNSS's positions "
        f"{_time(spans[1][0])} to {_time(spans[1][1])}, and have no time in common: {hint}",
    )


def gaps(inertial: Inertial) -> Iterator[Finding]:
    """Yield faults of missing or made-up samples."""
    begins_ns = inertial.time_ns - np.rint(inertial.interval_s * SECOND_NS).astype(np.int64)
    missing_s = (begins_ns[1:] - inertial.time_ns[:-1]) / SECOND_NS
    found = np.flatnonzero(missing_s > 0.5 * inertial.interval_s[1:])
    if len(found):
        longest = found[int(np.argmax(missing_s[found]))]
        yield Finding(
            "imu_gaps",
            "warning",
            f"the IMU's samples have {len(found)} gap{'s' * (len(found) > 1)} of {missing_s[found].sum():.2f} s in "
            f"all, the longest of {missing_s[longest]:.2f} s after {_time(inertial.time_ns[longest])}: look for losses "
            "(cable, bus load, disk)",
        )
    share = float(inertial.bridged.mean())
    if share > BRIDGED[1]:
        yield Finding(
            "imu_rate",
            "warning",
            f"{100.0 * share:.0f} % of the IMU's intervals had to be interpolated: the samples are rarer than "
            "rate_hz; set rate_hz to their true rate",
        )
    elif share > BRIDGED[0]:
        yield Finding(
            "imu_bridged",
            "warning",
            f"{100.0 * share:.1f} % of the IMU's intervals had to be interpolated over short gaps: look for losses "
            "(cable, bus load)",
        )


def receiver(observations: StructArray, place: StructArray) -> Iterator[Finding]:
    """Yield faults of positions without a fix or with a large sigma, or that contradict the velocities."""
    finite = np.isfinite(place["value"]).all(axis=1) & np.isfinite(place["sigma"]).all(axis=1)
    bad = ~finite | (place["sigma"].max(axis=1) > BAD_SIGMA_M) | (place["fix_type"] == FixType.NONE)
    if bad.mean() > MOSTLY:
        yield Finding(
            "gnss_bad",
            "error" if bad.all() else "warning",
            f"{100.0 * bad.mean():.0f} % of GNSS's positions have no fix or a sigma above {BAD_SIGMA_M:.0f} m: check "
            "the antenna, its view of the sky, and that the receiver sends its solution",
        )
    off = _speed_off(observations[observations["kind"] == Kind.VELOCITY], place[~bad])
    if off is not None:
        yield Finding(
            "positions_and_velocities",
            "error",
            f"GNSS's velocities and the changes of its positions differ by {off:.1f} m/s: they come from different "
            "receivers, or the velocities have another unit; take both from the same messages",
        )


def _speed_off(speed: StructArray, place: StructArray) -> float | None:
    """Return the typical difference between velocities and the positions' changes, m/s; None if it is small."""
    speed = speed[np.isfinite(speed["value"]).all(axis=1)]
    if len(place) < 10 or len(speed) < 10:
        return None
    first = place[np.concatenate([[True], np.diff(place["time_ns"] // (SECOND_NS // 2)) > 0])]
    step_s = np.diff(first["time_ns"]) / SECOND_NS
    moved = np.linalg.norm(np.diff(first["value"], axis=0), axis=1) / np.maximum(step_s, 1e-3)
    middle_ns = first["time_ns"][:-1] + np.diff(first["time_ns"]) // 2
    since_s = (speed["time_ns"] - speed["time_ns"][0]) / SECOND_NS
    at_s = (middle_ns - speed["time_ns"][0]) / SECOND_NS
    speeds = np.interp(at_s, since_s, np.linalg.norm(speed["value"], axis=1))
    used = (step_s < 2.5) & (at_s > since_s[0]) & (at_s < since_s[-1])
    if used.sum() < 10:
        return None
    noise = 2.0 * (first["sigma"].max(axis=1)[1:] / np.maximum(step_s, 0.5) + np.median(speed["sigma"].max(axis=1)))
    off = np.abs(moved - speeds)[used]
    typical = float(np.percentile(off, 75))
    return typical if typical > SPEED_OFF_MPS + float(np.median(noise[used])) else None


def force(inertial: Inertial) -> Iterator[Finding]:
    """Yield a fault if the mean specific force is not that of gravity."""
    total_s = float(inertial.interval_s.sum())
    size = float(np.linalg.norm(inertial.velocity_b, axis=1).sum()) / max(total_s, 1e-9)
    if not SIZE[0] * G_MPS2 < size < 2.0 * G_MPS2:
        hint = "it seems to be in g" if SIZE[0] < size < 2.0 else "check its unit and scale"
        yield Finding(
            "force_size",
            "error",
            f"the specific force is {size:.3g} m/s² on average, but gravity alone gives {G_MPS2:.2f}: {hint}",
        )


def _time(gps_ns: int | np.int64) -> str:
    week, of_week_ns = week_from_gps(int(gps_ns))
    return f"week {week} {of_week_ns / SECOND_NS:.3f} s"
