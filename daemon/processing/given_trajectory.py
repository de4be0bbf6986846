"""Checks whether a trajectory given as a file belongs to the log, and names the likely mistake if not."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from swath.daemon.processing.navigation.observations import fix_observations, gps_times
from swath.georef.agreement import (
    MUCH_BETTER,
    Apart,
    apart_from_fixes,
    compare_motion,
    heading_offset,
    time_that_explains,
)
from swath.georef.arrays import StructArray
from swath.georef.geodesy.earth import e_from_geodetic, geodetic_from_e
from swath.georef.mapping.datums import MappingError, between_datums, datum_that_explains, read_source, read_target
from swath.georef.navigation.inputs import Kind
from swath.georef.timescales.gps_time import SECOND_NS, table_leap_seconds, utc_from_gps

if TYPE_CHECKING:
    from pyproj import CRS

    from swath.daemon.processing.points.clocks import LogClocks
    from swath.daemon.processing.setup.setup import Setup
    from swath.georef.trajectory.trajectory import Trajectory


REFUSED_M, REFUSED_SIGMAS, WARNED_SIGMAS = 3.0, 20.0, 5.0
UNLIKE = 0.3  # correlation of turn rates below which two motions are doubtful to be one
FOOT_M = 0.3048
GREATEST_UNDULATION_M = 110.0  # anywhere on earth
LEAP_NEAR_S = 0.3
WARNED_HEADING_DEG, REFUSED_HEADING_DEG = 0.2, 1.0
DATUMS_APART_M = 3000.0  # no two datums are farther apart


@dataclass
class Belonging:
    """Findings about a given trajectory.

    Attributes:
        refused: why the trajectory is not of this flight, or not as declared; one line each.
        warnings: doubts, one line each.
    """

    refused: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Given:
    """A trajectory that was read from a file.

    Attributes:
        file: its name, for messages.
        trajectory: the trajectory of the body's origin; its attitude refers to the ellipsoid.
        offset_b: (3,) the point that the file describes, by ``--trajectory-at``, from the body's origin, m.
        points_b: other points that the file may describe, by the value of ``--trajectory-at`` for each.
        datum_is_said: True if the command line names its datum.
    """

    file: str
    trajectory: Trajectory
    offset_b: tuple[float, float, float]
    points_b: dict[str, tuple[float, float, float]]
    datum_is_said: bool


def points_of(setup: Setup) -> dict[str, tuple[float, float, float]]:
    """Return the points that a trajectory may describe, from the body's origin in b, m, by their ``--trajectory-at``
    words.
    """
    points = {"body": (0.0, 0.0, 0.0)}
    arms = [gnss.lever_arm_m for gnss in setup.config.gnss.values()]
    if arms:
        points["antenna"] = (arms[0][0], arms[0][1], arms[0][2])
    for name in setup.scanners:
        x, y, z = setup.calibrations[name].lever_arm_b.tolist()
        points["scanner" if len(setup.scanners) == 1 else f"{x:g},{y:g},{z:g}"] = (x, y, z)
    return points


def judge_given(given: Given, setup: Setup, clocks: LogClocks, log: Path) -> Belonging:
    """Compare a trajectory with the log's fixes and its IMU."""
    found = Belonging()
    _judge_motion(given, setup, clocks, log, found)
    apart, source, undulation_m = _nearest(given, setup, clocks)
    if apart is not None:
        _judge_place(given, apart, source, undulation_m, setup, log, found)
    return found


# ---------------------------------------------------------------------- place


def _nearest(given: Given, setup: Setup, clocks: LogClocks) -> tuple[Apart | None, str, float | None]:
    """Return the comparison with the most precise receiver, its source, and the geoid undulation that it reports."""
    best: tuple[Apart | None, str, float | None] = (None, "", None)
    for name, table in setup.config.gnss.items():
        source = f"gnss/{name}"
        fixes = clocks.fixes.get(source, [])
        if not fixes:
            continue
        arms = [arm for arm in (table.lever_arm_m, table.secondary_lever_arm_m) if arm is not None]
        tags = [fix.time for fix in fixes]
        times = gps_times(clocks.clocks.host, source, [fix.host_time_ns for fix in fixes], tags)
        rows = fix_observations(fixes, times, len(arms)).rows
        rows = _in_datum(rows[rows["kind"] == Kind.POSITION], table.datum, given, setup)
        apart = apart_from_fixes(given.trajectory, rows, np.array(arms, dtype=np.float64))
        if apart is None or (best[0] is not None and max(best[0].fix_sigma_l) <= max(apart.fix_sigma_l)):
            continue
        undulations = [
            fix.undulation_m for fix in fixes if fix.undulation_m is not None and math.isfinite(fix.undulation_m)
        ]
        best = apart, source, float(np.median(undulations)) if undulations else None
    return best


def _in_datum(rows: StructArray, datum: str | None, given: Given, setup: Setup) -> StructArray:
    """Return the fixes transformed to the datum of the trajectory; unchanged unless both datums are named."""
    wanted = _datum_of(given, setup)
    if datum is None or wanted is None or not len(rows) or setup.mapping is None:
        return rows
    try:
        source = read_source(datum, read_target(setup.options.crs or setup.config.output.crs or ""))
    except MappingError:
        return rows
    moved = None if source == wanted else between_datums(rows["value"], source, wanted, _epoch(given, setup))
    if moved is None:
        return rows
    changed = rows.copy()
    changed["value"] = moved
    return changed


def _datum_of(given: Given, setup: Setup) -> CRS | None:
    """Return the datum of the trajectory from the command line; None if it names none: then it is
    the receivers' own.
    """
    return setup.mapping.datum_crs if setup.mapping is not None and given.datum_is_said else None


def _epoch(given: Given, setup: Setup) -> float:
    epoch = setup.options.epoch if setup.options.epoch is not None else setup.config.output.epoch
    day, _ = utc_from_gps(given.trajectory.span[0], 0)
    return epoch if epoch is not None else day.year + (day.timetuple().tm_yday - 0.5) / 365.25


def _judge_place(
    given: Given, apart: Apart, source: str, undulation_m: float | None, setup: Setup, log: Path, found: Belonging
) -> None:
    far = apart.metres >= REFUSED_M and apart.fix_sigmas >= WARNED_SIGMAS
    refused = far or apart.sigmas >= REFUSED_SIGMAS
    if not refused and apart.sigmas < WARNED_SIGMAS and apart.metres < REFUSED_M:
        return
    reason = next(_reasons(given, apart, undulation_m, setup), "")
    by_datum = reason.startswith("its datum") and given.datum_is_said and apart.metres < REFUSED_M
    unsaid = apart.metres < REFUSED_M and _arm_is_unsaid(setup, source)
    if unsaid:
        key = f"{source.replace('/', '.')}.lever_arm_m"
        reason = (
            f"{key} is not configured, so the antenna is assumed at the body's origin; set it to allow the comparison"
        )
    line = f"{given.file}: {_figures(apart, source, log)}"
    if not reason and not refused and apart.sigmas < WARNED_SIGMAS:
        reason = "fixes of this kind may be wrong by this amount, or the trajectory may be"
    line += f": {reason or _unknown(apart, setup)}"
    (found.refused if refused and not by_datum and not unsaid else found.warnings).append(line)


def _arm_is_unsaid(setup: Setup, source: str) -> bool:
    """Return True if a receiver's lever arm is not configured: then it cannot be a reason to refuse a trajectory."""
    table = setup.config.gnss[source.removeprefix("gnss/")]
    return "lever_arm_m" not in table.model_fields_set


def _figures(apart: Apart, source: str, log: Path) -> str:
    north, east, up = apart.median_l
    scatter, sigma = (", ".join(f"{value:.2f}" for value in row) for row in (apart.scatter_l, apart.sigma_l))
    kind = apart.of.fix_type.name.lower().replace("_", " ")
    return (
        f"lies {_length(apart.metres)} off the fixes of {source} in {log} (median north {north:+.2f}, "
        f"east {east:+.2f}, up {up:+.2f} m; scatter {scatter} m; one sigma {sigma} m; "
        f"{len(apart.of.time_ns):,} fixes, {kind})"
    )


def _length(metres: float) -> str:
    return f"{metres / 1000.0:,.1f} km" if metres >= 2000.0 else f"{metres:.2f} m"


def _reasons(given: Given, apart: Apart, undulation_m: float | None, setup: Setup) -> Iterator[str]:
    """Yield possible reasons for the offset between trajectory and fixes, the most certain first."""
    yield from _other_point(given, apart)
    yield from _other_height(apart, undulation_m)
    yield from _other_time(apart)
    yield from _other_angles(apart)
    size_e = np.median(apart.of.apart_e, axis=0)
    if np.linalg.norm(size_e) < DATUMS_APART_M and float(np.max(apart.scatter_l)) < 0.3 * apart.metres + 0.05:
        tolerance = max(0.15 * float(np.linalg.norm(size_e)), 3.0 * float(np.linalg.norm(apart.fix_sigma_l)))
        tolerance = min(tolerance, MUCH_BETTER * float(np.linalg.norm(size_e)))
        fix_e = np.median(apart.of.fix_e, axis=0)
        named = datum_that_explains(fix_e, size_e, min(tolerance, 15.0), _epoch(given, setup))
        if named:
            yield (
                f"its datum differs as {named} differs from that of the fixes; set --trajectory-datum, and the "
                "receiver's datum in gnss.….datum, or give coordinates in the fixes' datum"
            )


def _other_point(given: Given, apart: Apart) -> Iterator[str]:
    """Yield another point that the file may describe: the offset is then constant in the body's axes."""
    apart_b = apart.of.apart_b
    median_b = np.median(apart_b, axis=0)
    tolerance = np.maximum(3.0 * apart.fix_sigma_l.max(), 0.05)
    if np.linalg.norm(median_b) > 100.0:
        return
    for words, point in given.points_b.items():
        shift = np.array(point) - np.array(given.offset_b)
        if np.linalg.norm(shift) > tolerance and (np.abs(median_b - shift) < tolerance).all():
            yield f"it describes another point; use --trajectory-at {words}"
    arm = apart.of.arm_b
    if np.linalg.norm(arm) > tolerance and (np.abs(np.abs(median_b) - 2.0 * np.abs(arm)) < tolerance).all():
        yield (
            "the antenna's lever arm has the opposite sign in the trajectory and in gnss.….lever_arm_m; use one sign "
            "in both"
        )


def _other_height(apart: Apart, undulation_m: float | None) -> Iterator[str]:
    """Yield other meanings of its heights: above the geoid, or in feet."""
    north, east, up = apart.median_l
    if max(abs(north), abs(east)) > max(REFUSED_M, WARNED_SIGMAS * float(apart.fix_sigma_l[:2].max())):
        return
    tolerance = max(2.0, 3.0 * float(apart.fix_sigma_l[2]))
    if undulation_m is not None and abs(undulation_m) > tolerance:
        for sign, words in ((-1.0, "are above the geoid"), (1.0, "have the geoid's undulation added twice")):
            if abs(up - sign * undulation_m) < tolerance:
                yield (
                    f"its heights {words}, which lies {undulation_m:+.1f} m from the ellipsoid at this place; "
                    f"{_ELLIPSOIDAL}"
                )
    height = float(np.median(geodetic_from_e(apart.of.fix_e)[2])) + float(apart.of.arm_b[2])  # of the body
    for above in (height, height - (undulation_m or 0.0)):
        if abs(up + height - above / FOOT_M) < tolerance:
            yield "its heights are in feet; give metres"
        if abs(up + height - above * FOOT_M) < tolerance:
            yield "its heights were converted from feet, but were metres; give metres"
    sure = float(np.median(np.abs(apart.of.in_l(apart.of.apart_e)[:, 2] - up))) < tolerance
    if undulation_m is None and REFUSED_M <= abs(up) < GREATEST_UNDULATION_M and sure:
        yield f"its heights may be above the geoid, and no receiver reports the geoid's height; {_ELLIPSOIDAL}"


_ELLIPSOIDAL = "give ellipsoidal heights"


def _other_time(apart: Apart) -> Iterator[str]:
    late_s = time_that_explains(apart)
    if late_s is None:
        return
    day, _ = utc_from_gps(int(apart.of.time_ns[0]), 0)
    leap = table_leap_seconds(day)[0]
    scale = "; it is in UTC, not GPS time" if leap and abs(late_s + leap) < LEAP_NEAR_S else ""
    scale = scale or ("; leap seconds were added to it twice" if leap and abs(late_s - leap) < LEAP_NEAR_S else "")
    yield f"it lies along the track as if its time were {abs(late_s):.2f} s {'late' if late_s > 0 else 'early'}{scale}"


def _other_angles(apart: Apart) -> Iterator[str]:
    """Yield a change of sign or order of latitude and longitude that would explain the offset."""
    if apart.metres < 1000.0:
        return
    fix_e = np.median(apart.of.fix_e, axis=0)
    there_e = fix_e + np.median(apart.of.apart_e, axis=0)
    lat, lon, height = (float(value[0]) for value in geodetic_from_e(there_e[np.newaxis]))
    for words, place in (
        ("its latitude has the other sign", (-lat, lon)),
        ("its longitude has the other sign", (lat, -lon)),
        ("its latitude and longitude are exchanged", (lon, lat)),
    ):
        if abs(place[0]) <= math.pi / 2 and np.linalg.norm(e_from_geodetic(*place, height) - fix_e) < 2000.0:
            yield words


def _unknown(apart: Apart, setup: Setup) -> str:
    if apart.metres >= 1000.0:
        return "it lies in another place: it belongs to another flight, or its coordinates are of another kind"
    return (
        "it may belong to another flight, datum or point (--trajectory-at), or gnss.….lever_arm_m or the position of "
        "the corrections' base station may be wrong"
    )


# ---------------------------------------------------------------------- motion


def _judge_motion(given: Given, setup: Setup, clocks: LogClocks, log: Path, found: Belonging) -> None:
    motion = compare_motion(given.trajectory, clocks.imu_gps_ns, clocks.imu_rate_b)
    if motion is None:
        return
    axes = ", ".join(f"{value:+.2f}" for value in motion.by_axis)
    correlations = f"(correlations about the axes forward, right, down {axes}; {motion.correlation:+.2f} in all)"
    if motion.convention:
        found.refused.append(
            f"{given.file}: turns like the IMU in {log} only if {motion.convention} ({motion.converted:+.2f} "
            f"then) {correlations}; give axes forward, right, down relative to north, east, down, or correct "
            "imu.….rotation_b_imu"
        )
    elif motion.is_other:
        found.refused.append(
            f"{given.file}: does not turn like the IMU in {log} {correlations}; give the trajectory of this flight, or "
            "correct imu.….rotation_b_imu"
        )
    elif motion.gusts_are_others:
        found.refused.append(
            f"{given.file}: turns like the IMU in {log}, but its response to gusts differs (correlation "
            f"{motion.gusts:+.2f} from 0.5 to 2.5 Hz): it belongs to another flight over the same lines; give that of "
            "this flight"
        )
    elif motion.correlation < UNLIKE:
        found.warnings.append(
            f"{given.file}: does not turn like the IMU in {log} {correlations}; it may belong to another flight, or "
            "imu.….rotation_b_imu may be wrong"
        )
    if not found.refused:
        _judge_heading(given, setup, clocks, log, found)


def _judge_heading(given: Given, setup: Setup, clocks: LogClocks, log: Path, found: Belonging) -> None:
    if len(clocks.imu_force_b) != len(clocks.imu_gps_ns) or len(clocks.imu_gps_ns) < 2 * SECOND_NS // 10**9:
        return
    offset = heading_offset(given.trajectory, clocks.imu_gps_ns, clocks.imu_force_b)
    if offset is None:
        return
    own = given.trajectory.attitude_sigma_rad[:, 2]
    own_rad = float(np.median(own[np.isfinite(own)])) if np.isfinite(own).any() else 0.0
    sigma_deg = math.degrees(math.hypot(offset.sigma_rad, own_rad))
    offset_deg = math.degrees(offset.offset_rad)
    if abs(offset_deg) < max(WARNED_HEADING_DEG, WARNED_SIGMAS * sigma_deg):
        return
    grid_deg = 0.0
    if setup.mapping is not None:
        middle = given.trajectory.position_e[len(given.trajectory) // 2]
        grid_deg = math.degrees(setup.mapping.convergence_rad(middle))
    line = (
        f"{given.file}: its heading is {offset_deg:+.2f} ± {sigma_deg:.3f}° off, by comparison of its accelerations "
        f"with those of the IMU in {log}"
    )
    if abs(grid_deg) > 0.1 and abs(offset_deg + grid_deg) < max(3.0 * sigma_deg, 0.1):
        line += f": it counts from grid north, which lies {grid_deg:+.2f}° from true north; give true headings"
    else:
        line += "; give headings of the body's x axis from true north"
    (found.refused if abs(offset_deg) >= REFUSED_HEADING_DEG else found.warnings).append(line)
