"""Turns a receiver's fixes and headings into observations: one position and velocity per epoch, in GPS time, with
sigmas.

Receivers spread an epoch over several messages (BESTPOS and BESTVEL), or send it twice (BESTPOS and BESTGNSSPOS); some
send no sigmas. Here each epoch gives at most one row of each kind, and refused messages are counted by reason.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import BoolArray, FloatArray, StructArray
from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.navigation.alignment.noise import white_factor
from swath.georef.navigation.inputs import OBSERVATION_DTYPE, Kind, sort_observations
from swath.georef.records import FixType, GnssFix, GnssHeading, TimeScale, TimeTag
from swath.georef.stream.clocks import HostClocks
from swath.georef.timescales import complete_time

# One standard deviation for receivers that send none: horizontal and vertical, of positions in m, of velocities in m/s.
# Usual figures of an antenna in flight; a fix type that is not listed is not used in navigation.
DEFAULT_SIGMAS: dict[FixType, tuple[tuple[float, float], tuple[float, float]]] = {
    FixType.SINGLE: ((2.0, 4.0), (0.10, 0.20)),
    FixType.DIFFERENTIAL: ((0.8, 1.6), (0.08, 0.16)),
    FixType.RTK_FLOAT: ((0.3, 0.5), (0.05, 0.10)),
    FixType.RTK_FIXED: ((0.02, 0.04), (0.03, 0.06)),
    FixType.PPP: ((0.1, 0.2), (0.05, 0.10)),
}
GREATEST_SIGMA = 1e4  # m or m/s: a larger one means that the receiver does not know
DEFAULT_BASELINE_SIGMA_M = 0.01  # across a baseline; divided by its length it gives an angle
DEFAULT_HEADING_SIGMA_RAD = math.radians(0.5)  # for a baseline of unknown length
DEFAULT_INS_SIGMAS_RAD = (math.radians(0.05), math.radians(0.05), math.radians(0.2))
HEADING_REACH_NS = 500_000_000  # a heading without time belongs to the nearest fix in this reach
BLENDED_BY_INS = {"BESTPOS": "BESTGNSSPOS", "BESTVEL": "BESTGNSSVEL"}  # message: its counterpart from satellites alone

# Errors of an INS's attitude last: neighbours repeat each other. One attitude per step is used, with the sigma of a
# white error that averages as slowly: share of sigma that is correlated, and for how long.
INS_STEP_NS, INS_SHARE, INS_TAU_S = 20_000_000_000, 1.0, 120.0
RANK = {FixType.RTK_FIXED: 5, FixType.PPP: 4, FixType.RTK_FLOAT: 3, FixType.DIFFERENTIAL: 2, FixType.SINGLE: 1}


@dataclass(slots=True)
class Observed:
    """Observations of a session.

    Attributes:
        rows: OBSERVATION_DTYPE, sorted.
        refused: number of messages that gave no observation, by reason.
        assumed: number of observations with default sigmas, by kind.
    """

    rows: StructArray
    refused: Counter[str]
    assumed: Counter[str]


def gps_times(
    host: HostClocks, source: str | None, host_ns: Sequence[int], tags: Sequence[TimeTag | None]
) -> list[int | None]:
    """Return GPS ns of a receiver's tags, from the tags and their arrival; None for one that cannot be placed.

    Args:
        host: the host's clocks, complete.
        source: source of the receiver, ``gnss/rover``; None: there is none, and no tag.
        host_ns: host times of arrival.
        tags: time tags; None: the message has no time.
    """
    if source is None or not tags:
        return [None] * len(tags)
    clock = host.by_source[source]
    near, sigma = host.gps_from_host(source, np.array(host_ns, np.int64))
    arrived = np.array(host_ns, np.int64)
    ahead = {scale: host.tag_error_ns(source, arrived, utc=scale is TimeScale.UTC).tolist() for scale in TimeScale}
    placed: list[int | None] = []
    for at, (tag, near_ns, known) in enumerate(zip(tags, near.tolist(), np.isfinite(sigma).tolist(), strict=True)):
        if tag is None:
            placed.append(None)
            continue
        leap = clock.leap_seconds_at(near_ns) if known else None
        error_ns = ahead[tag.scale][at]
        completed = complete_time(tag, near_ns + error_ns if known else None, leap)
        placed.append(None if completed is None else completed - error_ns)
    return placed


def fix_observations(
    fixes: Sequence[GnssFix], time_ns: Sequence[int | None], antennas: int, said: Collection[str] = ()
) -> Observed:
    """Return positions and velocities of fixes at GPS times; ``antennas`` of the receiver have a known lever arm.

    ``said`` holds names of messages that the receiver sent earlier.
    """
    refused: Counter[str] = Counter()
    assumed: Counter[str] = Counter()
    names = {*said, *(fix.message for fix in fixes)}
    best: dict[tuple[int, int, int], tuple[int, GnssFix]] = {}
    for fix, at_ns in zip(fixes, time_ns, strict=True):
        reason = _why_not(fix, at_ns, antennas, names)
        if reason is not None:
            refused[reason] += 1
            continue
        assert at_ns is not None
        antenna, rank = int(fix.antenna == "secondary"), RANK.get(fix.fix_type, 0)
        placed, moving = None not in (fix.lat_rad, fix.height_m), fix.velocity_l is not None
        for kind in [Kind.POSITION] * placed + [Kind.VELOCITY] * moving:
            key = (at_ns, int(kind), antenna)
            if key in best:
                refused["repeated_in_epoch"] += 1
            if key not in best or rank > best[key][0]:
                best[key] = (rank, fix)
    rows = np.zeros(len(best), OBSERVATION_DTYPE)
    for row, ((epoch_ns, of_kind, antenna), (_, fix)) in zip(rows, best.items(), strict=True):
        row["time_ns"], row["kind"], row["antenna"] = epoch_ns, of_kind, antenna
        row["fix_type"], row["satellites"] = int(fix.fix_type), min(fix.satellites or 0, 255)
        (_fill_position if of_kind == Kind.POSITION else _fill_velocity)(row, fix, assumed)
    return Observed(sort_observations(rows), refused, assumed)


def _why_not(fix: GnssFix, at_ns: int | None, antennas: int, said: set[str]) -> str | None:
    """Return why a fix is not an observation; None if it is one."""
    if not fix.valid:
        return "not_valid"
    if fix.fix_type not in DEFAULT_SIGMAS:
        return f"fix_type_{fix.fix_type.name.lower()}"
    if at_ns is None:
        return "no_time"
    if BLENDED_BY_INS.get(fix.message) in said:
        return "blended_by_ins"
    if fix.antenna == "secondary" and antennas < 2:
        return "no_lever_arm"
    if fix.lat_rad is None and fix.velocity_l is None:
        return "empty"
    if fix.lat_rad is not None and fix.height_m is None and fix.velocity_l is None:
        return "no_ellipsoidal_height"
    numbers = [value for value in (fix.lat_rad, fix.lon_rad, fix.height_m) if value is not None]
    return None if all(map(math.isfinite, numbers)) else "not_finite"


def _fill_position(row: np.void, fix: GnssFix, assumed: Counter[str]) -> None:
    assert fix.lat_rad is not None
    assert fix.lon_rad is not None
    assert fix.height_m is not None
    row["value"] = e_from_geodetic(fix.lat_rad, fix.lon_rad, fix.height_m)
    horizontal, vertical = DEFAULT_SIGMAS[fix.fix_type][0]
    _fill_sigmas(row, fix.position_cov_l, (horizontal, horizontal, vertical), assumed, "position")


def _fill_velocity(row: np.void, fix: GnssFix, assumed: Counter[str]) -> None:
    assert fix.velocity_l is not None
    row["value"] = fix.velocity_l
    horizontal, vertical = DEFAULT_SIGMAS[fix.fix_type][1]
    _fill_sigmas(row, fix.velocity_cov_l, (horizontal, horizontal, vertical), assumed, "velocity")


def _fill_sigmas(
    row: np.void, covariance: FloatArray | None, default: tuple[float, float, float], assumed: Counter[str], kind: str
) -> None:
    """Fill in sigmas and correlations of a covariance, and on each axis without a valid variance the default."""
    given = np.full((3, 3), np.nan) if covariance is None else np.asarray(covariance, np.float64)
    variance = np.diag(given)
    known = np.isfinite(variance) & (variance > 0.0) & (variance < GREATEST_SIGMA**2)
    sigma = np.sqrt(np.where(known, variance, np.square(default)))
    row["sigma"] = sigma
    if not known.all():
        assumed[kind] += 1
    for place, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
        correlation = given[i, j] / (sigma[i] * sigma[j]) if known[i] and known[j] else 0.0
        row["correlation"][place] = correlation if abs(correlation) < 1.0 else 0.0


def heading_times(
    headings: Sequence[GnssHeading],
    time_ns: Sequence[int | None],
    fixes: Sequence[GnssFix],
    fix_time_ns: Sequence[int | None],
) -> list[int | None]:
    """Return GPS ns of headings; one without time (HDT) takes that of the fix that arrived nearest to it."""
    placed = [(fix.host_time_ns, at) for fix, at in zip(fixes, fix_time_ns, strict=True) if at is not None]
    placed.sort()
    arrived = np.array([host_ns for host_ns, _ in placed], np.int64)
    found: list[int | None] = []
    for heading, at_ns in zip(headings, time_ns, strict=True):
        if heading.time is not None or not placed:
            found.append(at_ns)
            continue
        near = int(np.argmin(np.abs(arrived - heading.host_time_ns)))
        found.append(placed[near][1] if abs(int(arrived[near]) - heading.host_time_ns) <= HEADING_REACH_NS else None)
    return found


def heading_observations(
    headings: Sequence[GnssHeading], time_ns: Sequence[int | None], baseline_m: float | None
) -> Observed:
    """Return directions of a baseline at GPS times; ``baseline_m`` from the configuration, None without a second
    antenna.
    """
    refused: Counter[str] = Counter()
    assumed: Counter[str] = Counter()
    best: dict[int, GnssHeading] = {}
    for heading, at_ns in zip(headings, time_ns, strict=True):
        if not heading.valid or not math.isfinite(heading.heading_rad):
            refused["not_valid"] += 1
        elif at_ns is None:
            refused["no_time"] += 1
        elif baseline_m is None:
            refused["no_secondary_lever_arm"] += 1
        elif at_ns in best:
            refused["repeated_in_epoch"] += 1
        else:
            best[at_ns] = heading
    usual = DEFAULT_HEADING_SIGMA_RAD if baseline_m is None else math.atan(DEFAULT_BASELINE_SIGMA_M / baseline_m)
    rows = np.zeros(len(best), OBSERVATION_DTYPE)
    for row, (time, heading) in zip(rows, best.items(), strict=True):
        row["time_ns"], row["kind"] = time, Kind.HEADING
        pitch = math.nan if heading.pitch_rad is None else heading.pitch_rad
        row["value"] = (heading.heading_rad, pitch, math.nan)
        sigma = _angle_sigma(heading.heading_sigma_rad, usual), _angle_sigma(heading.pitch_sigma_rad, 2.0 * usual)
        row["sigma"] = (*sigma, math.nan)
        assumed["heading"] += heading.heading_sigma_rad is None
    return Observed(sort_observations(rows), +refused, +assumed)


def _angle_sigma(said: float | None, usual: float) -> float:
    return said if said is not None and 0.0 < said < math.pi else usual


def ins_observations(rows: StructArray, is_solution: Callable[[NDArray[np.uint32]], BoolArray] | None) -> Observed:
    """Return attitudes of a device's own INS at intervals; its positions rest on fixes that are already used."""
    usable = np.isfinite(rows["roll_rad"]) & np.isfinite(rows["pitch_rad"]) & np.isfinite(rows["heading_rad"])
    if is_solution is not None:
        usable &= is_solution(rows["status"])
    taken = rows[usable & (rows["gps_ns"] > 0)]
    _, first = np.unique(taken["gps_ns"] // INS_STEP_NS, return_index=True)
    taken = taken[first]
    found = np.zeros(len(taken), OBSERVATION_DTYPE)
    found["time_ns"], found["kind"] = taken["gps_ns"], Kind.ATTITUDE
    found["value"] = np.stack([taken["roll_rad"], taken["pitch_rad"], taken["heading_rad"]], axis=1)
    sigma = taken["attitude_sigma_rad"].astype(np.float64)
    known = np.isfinite(sigma) & (sigma > 0.0)
    careful = white_factor(INS_STEP_NS, INS_SHARE, INS_TAU_S)
    found["sigma"] = careful * np.where(known, sigma, np.array(DEFAULT_INS_SIGMAS_RAD))
    assumed = Counter({"attitude": int((~known.all(axis=1)).sum())})
    return Observed(sort_observations(found), Counter({"no_solution": int((~usable).sum())}), +assumed)


def joined(parts: Sequence[Observed]) -> StructArray:
    """Return the rows of all parts, sorted."""
    rows = [part.rows for part in parts]
    return sort_observations(np.concatenate(rows) if rows else np.empty(0, OBSERVATION_DTYPE))
