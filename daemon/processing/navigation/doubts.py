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
from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.navigation.diagnosis.data import Finding
from swath.georef.navigation.inputs import Inertial, Kind
from swath.georef.records import StructArray
from swath.georef.trajectory.trajectory import gps_text

FEWEST_HEIGHTS = 10
TIME_IS_KNOWN_S = 1e-4  # if the IMU's times are better, no offset needs to be estimated: 6 mm at 60 m/s


def refuse_nothing(found: NavigationLog, sources: NavigationSources, log: Path, *, outside: bool) -> None:
    """Refuse a log that lacks samples, or lacks positions while there are none from ``outside``.

    Raises:
        UserError: samples or positions are missing.
    """
    if not len(found.imu):
        hint = "; it has an INS's own solutions: want --ins as-is for these" if len(found.ins) else ""
        raise UserError(f"{log}: no samples of {sources.imu_source}: {_heard(found, sources.imu_source)}{hint}")
    if not found.fixes and not outside and sources.gnss_source is not None:
        raise UserError(
            f"{log}: no position of {sources.gnss_source}, and an IMU alone cannot be navigated: "
            f"{_heard(found, sources.gnss_source)}; or --gnss FILE with post-processed positions"
        )


def _heard(found: NavigationLog, source: str) -> str:
    """Return what a source without records sent, and what that suggests."""
    size, skipped, messages = found.heard.get(source, (0, 0, Counter()))
    if not size:
        return "not a byte of it is in the log; is its wire recorded?"
    told = [f"{count:,} {name}" for name, count in messages.most_common(4)]
    told += [f"{count:,} with {why.replace('_', ' ')}" for why, count in found.refused.get(source, Counter()).items()]
    of_it = f" ({', '.join(told)})" if told else ""
    share = f", {skipped / size:.0%} of them of no message it knows" if skipped else ""
    return f"{size:,} bytes came{share}{of_it}; want another protocol, or other messages of the device"


def no_time(found: NavigationLog, sources: NavigationSources, log: Path) -> str:
    if sources.clock is None:
        return f"{log}: the configuration has neither [pps.…] nor [gnss.…]: nobody tells GPS time"
    status = found.host.status(sources.clock, int(found.imu["host_time_ns"][-1]))
    if sources.gnss_source is None:
        return (
            f"{log}: {sources.clock}: no receiver says which second its edges are, and no disciplined wall clock "
            f"either, so no sample of {sources.imu_source} has GPS time; want [gnss.NAME] with its time messages, a "
            "host that chrony keeps, or an IMU that says GPS time itself"
        )
    remedy = f"want PPS edges, or at least time messages of {sources.gnss_source}"
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
        raise UserError(f"--gnss {outside}: none of its positions has a fix that is navigated with; want another file")
    if not len(positions):
        raise UserError(
            f"{log}: no usable position of {sources.gnss_source}: its fixes have no ellipsoidal height, no time, or "
            "none is valid; want other messages of the receiver, or --gnss FILE"
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
    if times.by == "arrival":
        lines.append(
            f"{log}: {sources.imu_source} says no time of its own: its samples are placed by their arrival, to about "
            f"{times.sigma_s * 1e3:.1f} ms; an offset is estimated"
        )
    elif times.sigma_s > TIME_IS_KNOWN_S:
        lines.append(
            f"{log}: the times of {sources.imu_source} are good to {times.sigma_s * 1e3:.1f} ms only; want PPS edges "
            "that it latches; an offset is estimated"
        )
    if sources.gnss_source is None and times.by != "gps":
        lines.append(
            f"{log}: the host's wall clock alone names the seconds of {sources.clock}, for there is no receiver; an "
            "error of it moves the trajectory along its track"
        )
    if not sources.arm_is_said:
        lines.append(
            f"{log}: nobody says the lever arm of the positions' antenna: it is estimated with the flight, from "
            "0 m on; want --lever-arm X,Y,Z, forward, right, down from the IMU"
        )
    if sources.imu_is_in_receiver and not parts["fix"].refused["blended_by_ins"]:
        blended = sorted({fix.message for fix in found.fixes} & {"BESTPOS", "BESTVEL"})
        if blended:
            lines.append(
                f"{log}: {' and '.join(blended)} of a receiver with an INS are blended with it, so that its errors "
                "come twice; want BESTGNSSPOS and BESTGNSSVEL"
            )
    lines += [f"{log}: {doubt}" for doubt in found.doubts]
    without = parts["heading"].refused["no_secondary_lever_arm"]
    if without:
        lines.append(
            f"{log}: {without:,} headings of {sources.gnss_source} are left out: want "
            f"gnss.{sources.gnss_name}.secondary_lever_arm_m, the second antenna's place"
        )
    lines += _silent_antenna(found, sources, log)
    lines += [f"{log}: the recorder lost {count:,} units of {source}" for source, count in sorted(found.lost.items())]
    lines += _baseline_doubts(found, sources, log)
    return lines


def height_findings(found: NavigationLog, sources: NavigationSources) -> list[Finding]:
    """Return a warning if a receiver's heights may be above the geoid.

    GGA and GNS give the height above the receiver's geoid and the geoid's height above the ellipsoid (NMEA 0183 v4.11).
    A separation that is 0 in every sentence is not a real one: the altitude may then be either height.
    """
    told = [fix for fix in found.fixes if fix.message in ("GGA", "GNS") and fix.valid and fix.height_m is not None]
    if len(told) < FEWEST_HEIGHTS or any(fix.undulation_m != 0.0 for fix in told):
        return []
    fix = told[len(told) // 2]
    place = [np.nan if value is None else value for value in (fix.lat_rad, fix.lon_rad, fix.height_m)]
    known = geoid_undulation(e_from_geodetic(*place))
    size = "up to 107 m" if known is None else f"{known[0]:.1f} m ({known[1]})"
    text = (
        f"all {len(told):,} {fix.message} of {sources.gnss_source} say that geoid and ellipsoid are one (separation "
        "0.0 m), as they are nowhere on a whole flight: unless its altitudes are ellipsoidal already, heights are "
        f"wrong by the geoid's, {size}; let the receiver send its geoid separation, or compare with control"
    )
    return [Finding("geoid_unsaid", "warning", text)]


def _silent_antenna(found: NavigationLog, sources: NavigationSources, log: Path) -> list[str]:
    """Return a line if a configured second antenna sent neither headings nor positions of its own."""
    if sources.gnss is None or sources.gnss.secondary_lever_arm_m is None or found.headings:
        return []
    if any(fix.antenna == "secondary" for fix in found.fixes):
        return []
    return [
        f"{log}: {sources.gnss_source} sent no heading that is known here, though secondary_lever_arm_m names a second "
        "antenna: want its messages of heading as the page of its protocol lists them"
    ]


def _baseline_doubts(found: NavigationLog, sources: NavigationSources, log: Path) -> list[str]:
    """Return a line if the baseline that the receiver measured has another length than the lever arms give."""
    told = [heading.baseline_m for heading in found.headings if heading.valid and heading.baseline_m]
    baseline = sources.setup().baseline_b
    if not told or baseline is None:
        return []
    measured, configured = float(np.median(told)), float(np.linalg.norm(baseline))
    if abs(measured - configured) <= max(0.05, 0.05 * configured):
        return []
    return [
        f"{log}: {sources.gnss_source} measures {measured:.2f} m between its antennas, lever_arm_m and "
        f"secondary_lever_arm_m are {configured:.2f} m apart: one of them is wrong"
    ]
