"""Navigates an IMU and a receiver given as arrays, by the steps that logs are navigated with."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from swath.daemon.errors import UserError
from swath.daemon.processing.navigation.inputs import legs_of
from swath.daemon.processing.navigation.navigate import GIVEN_SIGMA_RAD
from swath.daemon.processing.navigation.observations import fix_observations
from swath.daemon.processing.navigation.sources import filter_setup
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.navigation.alignment.align import align
from swath.georef.navigation.alignment.earlier_start import earlier_start
from swath.georef.navigation.diagnosis.diagnose import diagnose
from swath.georef.navigation.inputs import (
    ARM_UNSAID_M,
    GRADES,
    OBSERVATION_DTYPE,
    Kind,
    NavigationError,
    sort_observations,
)
from swath.georef.navigation.samples import Sampler
from swath.georef.navigation.solve import Solved, solve
from swath.georef.navigation.stillness import with_still_seconds
from swath.georef.progress import Tell, silent
from swath.georef.records import IMU_DTYPE, FixType, GnssFix, TimeScale, TimeTag
from swath.georef.timescales import SECOND_NS

IMU_FIELDS = ("gps_ns", "specific_force_b", "angular_rate_b")
GNSS_FIELDS = ("gps_ns", "lat_rad", "lon_rad", "height_m")


def navigate_arrays(
    imu: StructArray,
    gnss: StructArray,
    *,
    arm_b: Sequence[float] | None,
    rot_b_from_imu: ArrayLike | None = None,
    rate_hz: float | None = None,
    grade: str = "tactical",
    attitude_rad: tuple[float, float, float] | None = None,
    tell: Tell = silent,
) -> tuple[list[Solved], list[str]]:
    """Navigate arrays; return a solution for each leg, and doubts, one line each.

    Args:
        imu: (n,) with `IMU_FIELDS`; rows without a time (negative) are left out.
        gnss: (m,) with `GNSS_FIELDS`, and others of a table of fixes.
        arm_b: (3,) lever arm of the antenna, m; None: it is estimated.
        rot_b_from_imu: (3, 3) from the axes of the samples to b; None: they are b's.
        rate_hz: nominal rate of the samples; None: from their times.
        grade: noise of the IMU, a name in `GRADES`.
        attitude_rad: roll, pitch, heading at the start; None: they are found.
        tell: called with the progress.

    Raises:
        UserError: a field is missing, or no leg can be navigated; one line per reason.
        NavigationError: an argument is invalid.
    """
    _refuse_missing("imu", imu, IMU_FIELDS)
    _refuse_missing("gnss", gnss, GNSS_FIELDS)
    if grade not in GRADES:
        raise UserError(f'noise: got "{grade}", want one of: {", ".join(GRADES)}')
    rows, gps_ns = _samples(imu)
    sampler = Sampler(rate_hz or _rate_hz(gps_ns), rot_b_from_imu=rot_b_from_imu)
    inertial = sampler.feed(rows, gps_ns)
    observations, warnings = _observations(gnss)
    setup = filter_setup(GRADES[grade], [np.zeros(3) if arm_b is None else np.asarray(arm_b, np.float64)])
    if arm_b is None:
        setup = replace(setup, estimate_lever_arm=ARM_UNSAID_M)
    solved: list[Solved] = []
    for leg in legs_of(inertial, observations)[0]:
        tell("alignment", 0, 0)
        own = leg.observations if attitude_rad is None else _with_attitude(leg.observations, leg.span[0], attitude_rad)
        try:
            start = earlier_start(leg.inertial, leg.observations, setup, align(leg.inertial, own, setup))
            still = with_still_seconds(leg.inertial, leg.observations)
            solved.append(solve(leg.inertial, still, setup, start, tell=tell))
        except NavigationError as error:
            warnings.append(f"from {leg.span[0]} to {leg.span[1]} GPS ns: {error}")
            continue
        found = diagnose(leg.inertial, leg.observations, solved[-1].report.setup, solved[-1])
        warnings += [finding.text for finding in found]
    warnings += [f"imu: {count:,} samples {reason.replace('_', ' ')}" for reason, count in sampler.counts.items()]
    if not solved:
        raise UserError("\n".join(warnings) or "imu: no run of samples without a gap is long enough for navigation")
    return solved, warnings


def _refuse_missing(name: str, array: StructArray, wanted: Sequence[str]) -> None:
    names = array.dtype.names or ()
    missing = [field for field in wanted if field not in names]
    if missing:
        raise UserError(f"{name}: has no field {missing[0]}; want a structured array with {', '.join(wanted)}")
    if not len(array):
        raise UserError(f"{name}: is empty")


def _samples(imu: StructArray) -> tuple[StructArray, Int64Array]:
    """Return the samples that have a time, and their times."""
    timed = imu[imu["gps_ns"] >= 0]
    if len(timed) < 2:
        raise UserError("imu: fewer than two samples have a time (gps_ns)")
    rows = np.zeros(len(timed), IMU_DTYPE)
    for name in ("specific_force_b", "angular_rate_b"):
        rows[name] = timed[name]
    return rows, np.ascontiguousarray(timed["gps_ns"], np.int64)


def _rate_hz(gps_ns: Int64Array) -> float:
    steps = np.diff(gps_ns)
    return SECOND_NS / float(np.median(steps[steps > 0]))


def _observations(gnss: StructArray) -> tuple[StructArray, list[str]]:
    """Return positions and velocities, and doubts about them."""
    fixes = [_fix(row) for row in gnss]
    times = [int(time) if time >= 0 else None for time in gnss["gps_ns"].tolist()]
    observed = fix_observations(fixes, times, 1)
    lines = [f"gnss: {count:,} fixes are not used: {why.replace('_', ' ')}" for why, count in observed.refused.items()]
    assumed: Counter[str] = observed.assumed
    lines += [
        f"gnss: {count:,} {kind} without sigmas have those usual for their fix" for kind, count in assumed.items()
    ]
    return observed.rows, lines


def _fix(row: np.void) -> GnssFix:
    velocity = row["velocity_l"] if "velocity_l" in (row.dtype.names or ()) else np.full(3, np.nan)
    lat, lon, height = (float(row[name]) for name in ("lat_rad", "lon_rad", "height_m"))
    return GnssFix(
        host_time_ns=0,
        time=TimeTag(TimeScale.GPS, 0),
        lat_rad=lat if np.isfinite(lat) else None,
        lon_rad=lon if np.isfinite(lon) else None,
        height_m=height if np.isfinite(height) else None,
        velocity_l=tuple(velocity.tolist()) if np.isfinite(velocity).any() else None,
        position_cov_l=_covariance(row, "position"),
        velocity_cov_l=_covariance(row, "velocity"),
        fix_type=FixType(int(_field(row, "fix_type", FixType.SINGLE))),
        satellites=max(0, int(_field(row, "satellites", 0))),
        antenna=str(_field(row, "antenna", "primary")),
        valid=bool(_field(row, "valid", True)),
        message=str(_field(row, "message", "")),
    )


def _field(row: np.void, name: str, otherwise: Any) -> Any:
    return row[name] if name in (row.dtype.names or ()) else otherwise


def _covariance(row: np.void, what: str) -> FloatArray | None:
    names = row.dtype.names or ()
    if f"{what}_cov_l" in names:
        covariance: FloatArray = row[f"{what}_cov_l"]
    elif f"{what}_sigma_l" in names:
        covariance = np.diag(np.asarray(row[f"{what}_sigma_l"], np.float64) ** 2)
    else:
        return None
    return covariance if np.isfinite(covariance).all() else None


def _with_attitude(rows: StructArray, time_ns: int, attitude_rad: tuple[float, float, float]) -> StructArray:
    row = np.zeros(1, OBSERVATION_DTYPE)
    row["time_ns"], row["kind"], row["value"], row["sigma"] = time_ns, Kind.ATTITUDE, attitude_rad, GIVEN_SIGMA_RAD
    return sort_observations(np.concatenate([rows, row]))
