"""Names in one line each what a log lacks for navigation, and which of its data are doubtful."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from swath.calib.control.doubts import geoid_undulation
from swath.daemon.errors import UserError
from swath.daemon.processing.navigation.log import NavigationLog
from swath.daemon.processing.navigation.observations import Observed
from swath.daemon.processing.navigation.sources import NavigationSources
from swath.daemon.processing.navigation.times import ImuTimes
from swath.georef.arrays import StructArray
from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.navigation.diagnosis.data import Finding
from swath.georef.navigation.inputs import Inertial, Kind
from swath.georef.trajectory.trajectory import gps_text

FEWEST_HEIGHTS = 10
TIME_IS_KNOWN_S = 1e-4  # if the IMU's times are better, no offset needs to be estimated: 6 mm at 60 m/s


def refuse_nothing(found: NavigationLog, sources: NavigationSources, log: Path, *, outside: bool) -> None:
    """Refuse a log that lacks samples, or lacks positions while there are none from ``outside``.

    Raises:
        UserError: samples or positions are missing.
    """
    if not len(found.imu):
        hint = "; it has INS solutions: use --ins as-is to take these" if len(found.ins) else ""
        raise UserError(f"{log}: no samples of {sources.imu_source}: {_heard(found, sources.imu_source)}{hint}")
    if not found.fixes and not outside and sources.gnss_source is not None:
        raise UserError(
            f"{log}: no position of {sources.gnss_source}, and an IMU alone gives no trajectory: "
            f"{_heard(found, sources.gnss_source)}; or give --gnss FILE with post-processed positions"
        )


def _heard(found: NavigationLog, source: str) -> str:
    """Return what a source without records sent, and what that suggests."""
    size, skipped, messages = found.heard.get(source, (0, 0, Counter()))
    if not size:
        return "the log has no byte of it; check that its wire is recorded"
    received = [f"{count:,} {name}" for name, count in messages.most_common(4)]
    received += [
        f"{count:,} with {why.replace('_', ' ')}" for why, count in found.refused.get(source, Counter()).items()
    ]
    of_it = f" ({', '.join(received)})" if received else ""
    share = f", {skipped / size:.0%} of them in no known message" if skipped else ""
    return f"{size:,} bytes came{share}{of_it}; set another protocol, or let the device send other messages"


def no_time(found: NavigationLog, sources: NavigationSources, log: Path) -> str:
    if sources.clock is None:
        return (
            f"{log}: the configuration has neither [pps.…] nor [gnss.…], so no source gives GPS time; add one of them"
        )
    status = found.host.status(sources.clock, int(found.imu["host_time_ns"][-1]))
    if sources.gnss_source is None:
        return (
            f"{log}: {sources.clock}: neither a receiver nor a disciplined wall clock names the seconds of its edges, "
            f"so no sample of {sources.imu_source} has GPS time; use [gnss.NAME] with its time messages, a host that "
            "chrony disciplines, or an IMU that sends GPS time"
        )
    remedy = f"record PPS edges, or at least time messages of {sources.gnss_source}"
    why = "; ".join(filter(None, [status.ambiguous, status.leap_doubt, *found.remarks])) or remedy
    return (
        f"{log}: {sources.clock}: the host's clock is {status.state.value}, so no sample of {sources.imu_source} has "
        f"GPS time; {why}"
    )


def refuse_elsewhere(
    inertial: Inertial, observations: StructArray, sources: NavigationSources, outside: Path | None, log: Path
) -> None:
    """Refuse observations without a position, or of another time than the samples.

    Args:
        outside: file of the positions; None: they are the receiver's.

    Raises:
        UserError: there is no position, or no common time.
    """
    positions = observations[observations["kind"] == Kind.POSITION]
    if not len(positions) and outside is not None:
        raise UserError(f"--gnss {outside}: none of its positions has a fix of usable quality; give another file")
    if not len(positions):
        raise UserError(
            f"{log}: no usable position of {sources.gnss_source}: its fixes have no ellipsoidal height, no time, or "
            "are invalid; let the receiver send other messages, or give --gnss FILE"
        )
    begin, end = int(inertial.time_ns[0]), int(inertial.time_ns[-1])
    first, last = int(positions["time_ns"][0]), int(positions["time_ns"][-1])
    if last < begin or first > end:
        raise UserError(
            f"{log}: no common time: {sources.imu_source} from {gps_text(begin)} to {gps_text(end)}, positions from "
            f"{gps_text(first)} to {gps_text(last)}"
        )


# ---------------------------------------------------------------------- doubts and findings


def input_doubts(
    found: NavigationLog, sources: NavigationSources, times: ImuTimes, parts: Mapping[str, Observed], log: Path
) -> list[str]:
    lines = [f"{log}: {remark}" for remark in found.remarks]
    lines += time_doubts(sources, times, log)
    if not sources.arm_is_said:
        lines.append(
            f"{log}: the lever arm of the positions' antenna is unknown, so the filter estimates it, starting at 0 m; "
            "give --lever-arm X,Y,Z, forward, right, down from the IMU"
        )
    if sources.imu_is_in_receiver and not parts["fix"].refused["blended_by_ins"]:
        blended = sorted({fix.message for fix in found.fixes} & {"BESTPOS", "BESTVEL"})
        if blended:
            lines.append(
                f"{log}: {' and '.join(blended)} of a receiver with an INS contain its IMU's data, so that IMU errors "
                "count twice; use BESTGNSSPOS and BESTGNSSVEL"
            )
    lines += [f"{log}: {doubt}" for doubt in found.warnings]
    without = parts["heading"].refused["no_secondary_lever_arm"]
    if without:
        lines.append(
            f"{log}: {without:,} headings of {sources.gnss_source} are left out; set "
            f"gnss.{sources.gnss_name}.secondary_lever_arm_m, the second antenna's position"
        )
    lines += _silent_antenna(found, sources, log)
    lines += [f"{log}: the recorder lost {count:,} units of {source}" for source, count in sorted(found.lost.items())]
    lines += _baseline_doubts(found, sources, log)
    return lines


def time_doubts(sources: NavigationSources, times: ImuTimes, log: Path) -> list[str]:
    """Return what is uncertain in the times of the samples, with its size, a line each."""
    lines = []
    if times.by == "arrival":
        lines.append(
            f"{log}: {sources.imu_source} sends no time: its samples are timed by their arrival, to about "
            f"{times.sigma_s * 1e3:.1f} ms; the filter estimates an offset"
        )
    elif times.sigma_s > TIME_IS_KNOWN_S:
        remedy = "" if sources.imu.protocol == "records" else "; let the IMU latch PPS edges"
        lines.append(
            f"{log}: the times of {sources.imu_source} are good to {times.sigma_s * 1e3:.1f} ms only, so the "
            f"filter estimates an offset{remedy}"
        )
    if sources.gnss_source is None and times.by != "gps":
        lines.append(
            f"{log}: the host's wall clock alone names the seconds of {sources.clock}, because there is no receiver; "
            "an error of this clock moves the trajectory along its track"
        )
    return lines


def height_findings(found: NavigationLog, sources: NavigationSources) -> list[Finding]:
    """Return a warning if a receiver's heights may be above the geoid.

    GGA and GNS give the height above the receiver's geoid and the geoid's height above the ellipsoid (NMEA 0183 v4.11).
    A separation that is 0 in every sentence is not a real one: the altitude may then be either height.
    """
    fixes = [fix for fix in found.fixes if fix.message in ("GGA", "GNS") and fix.valid and fix.height_m is not None]
    if len(fixes) < FEWEST_HEIGHTS or any(fix.undulation_m != 0.0 for fix in fixes):
        return []
    fix = fixes[len(fixes) // 2]
    place = [np.nan if value is None else value for value in (fix.lat_rad, fix.lon_rad, fix.height_m)]
    known = geoid_undulation(e_from_geodetic(*place))
    size = "up to 107 m" if known is None else f"{known[0]:.1f} m ({known[1]})"
    text = (
        f"all {len(fixes):,} {fix.message} of {sources.gnss_source} report a geoid separation of 0.0 m, which no "
        "flight has throughout: unless its altitudes are ellipsoidal already, heights are wrong by the geoid's "
        f"height, {size}; let the receiver send its geoid separation, or compare with control"
    )
    return [Finding("geoid_unsaid", "warning", text)]


def _silent_antenna(found: NavigationLog, sources: NavigationSources, log: Path) -> list[str]:
    """Return a line if a configured second antenna sent neither headings nor positions of its own."""
    if sources.gnss is None or sources.gnss.secondary_lever_arm_m is None or found.headings:
        return []
    if any(fix.antenna == "secondary" for fix in found.fixes):
        return []
    return [
        f"{log}: {sources.gnss_source} sent no heading that this program reads, although secondary_lever_arm_m names "
        "a second antenna; let it send the heading messages that the page of its protocol lists"
    ]


def _baseline_doubts(found: NavigationLog, sources: NavigationSources, log: Path) -> list[str]:
    """Return a line if the baseline that the receiver measured has another length than the lever arms give."""
    baselines = [heading.baseline_m for heading in found.headings if heading.valid and heading.baseline_m]
    baseline = sources.setup().baseline_b
    if not baselines or baseline is None:
        return []
    measured, configured = float(np.median(baselines)), float(np.linalg.norm(baseline))
    if abs(measured - configured) <= max(0.05, 0.05 * configured):
        return []
    return [
        f"{log}: {sources.gnss_source} measures {measured:.2f} m between its antennas, lever_arm_m and "
        f"secondary_lever_arm_m are {configured:.2f} m apart; correct the wrong one"
    ]
