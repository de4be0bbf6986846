"""Writes what matters of a run of `swath georef` as lines, each on one subject."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from typing import Any

from swath.calib.labels import degrees, length, number
from swath.daemon.processing.pages.head import calibration_words

GEOID = re.compile(r"proj=vgridshift\b(?:(?! step ).)*?\bgrids=([^\s,]+)")  # of a PROJ pipeline
SOURCES = {
    "navigated": "navigated from IMU and GNSS",
    "ins": "the device's own INS, from the log",
    "file": "from a file",
}


def georef_lines(record: Mapping[str, Any], elapsed_s: float) -> Iterator[str]:
    """Yield the lines that end a run: strips, returns, then calibration, trajectory, CRS, density, time.

    Args:
        record: the run's sidecar, which is the same whatever time the run took.
        elapsed_s: how long it took.
    """
    yield from map(_strip_line, record["strips"])
    for scanner, counts in record["counts"].items():
        reasons = ", ".join(f"{count:,} {reason.replace('_', ' ')}" for reason, count in counts["dropped"].items())
        left_out = f"; left out: {reasons}" if reasons else ""
        yield f"{scanner}: {counts['read']:,} returns, {counts['written']:,} in files{left_out}"
    yield from (f"warning: {line}" for line in record["warnings"])
    flights = record["flights"]
    yield from dict.fromkeys(
        f"calibration: {calibration_words(name, calibration, unsaid='good')}"
        for flight in flights
        for name, calibration in flight["calibrations"].items()
    )
    for flight in flights:
        name = f" of {flight['session']}" if len(flights) > 1 else ""
        yield f"trajectory{name}: {trajectory_words(flight['trajectory'])}"
    yield f"CRS: {crs_line(record['crs'])}"
    if record["surface"] is not None:
        yield f"surface for the sigmas: {surface_words(record['surface'])}"
    yield _density_line(record["totals"])
    yield _time_line(record, elapsed_s)


def _strip_line(strip: Mapping[str, Any]) -> str:
    seconds = ((strip["last_gps_ns"] or 0) - (strip["first_gps_ns"] or 0)) / 1e9
    density = f", {density_words(strip['density_m2'])}" if strip["density_m2"] else ""
    return (
        f"strip {strip['number']}: {strip['points']:,} points, {seconds:.1f} s{density}, {strip['file'] or 'no file'}"
    )


def density_words(density: Mapping[str, float]) -> str:
    """Return densities in words: all returns, and last ones if they differ."""
    every, last = (number(density[key], "#.3g").removesuffix(".") for key in ("all", "last"))
    return f"{every} per m²" + (f" ({last} last returns)" if last != every else "")


def trajectory_words(trajectory: Mapping[str, Any]) -> str:
    """Return source, sigmas, share of fixed positions and doubts of a trajectory."""
    words = [SOURCES.get(trajectory["source"], trajectory["source"])]
    if trajectory["source"] == "file":
        words[0] += f" ({trajectory['name']})"
    quality = trajectory["quality"]
    sigma = quality["sigma_rms"]
    if sigma is None:
        words.append("no sigmas")
    else:
        plane = math.hypot(sigma["north_m"], sigma["east_m"])
        tilt = math.hypot(sigma["roll_deg"], sigma["pitch_deg"]) / math.sqrt(2.0)
        words.append(
            f"sigmas {length(plane)} in plan, {length(sigma['down_m'])} in height, {degrees(tilt)} roll and pitch, "
            f"{degrees(sigma['heading_deg'])} heading"
        )
    if quality["fixed_share"] is not None:
        words.append(f"{100.0 * quality['fixed_share']:.0f} % of positions fixed")
    levels = [one["level"] for one in trajectory["verdict"]]
    words.append(f"{levels[0]}, see above" if levels else "no doubts")
    return "; ".join(words)


def surface_words(surface: Mapping[str, Any]) -> str:
    """Return what the sigmas took the footprints to fall on."""
    points = surface["points"]
    total = points["planes"] + points["level_ground"] + points["rough"]
    if surface["kind"] != "planes" or not total:
        return "none" if not total else "level ground"
    planes, level, rough = (number(100.0 * points[key] / total, ".3g") for key in ("planes", "level_ground", "rough"))
    return f"planes under {planes} % of the points, none under {rough} %, too few points to tell under {level} %"


def crs_line(crs: Mapping[str, Any]) -> str:
    """Return coordinate system, heights with their geoid, and datum."""
    code = f" ({crs['crs']})" if crs["crs"] != crs["name"] and len(crs["crs"]) < 40 else ""
    geoids = dict.fromkeys(GEOID.findall(crs.get("pipeline") or ""))
    heights = f"heights {crs['heights']}" + (f", geoid {', '.join(geoids)}" if geoids else "")
    return f"{crs['name']}{code}; {heights}; from {crs['datum']}"


def _density_line(totals: Mapping[str, Any]) -> str:
    words = f"density: {density_words(totals['density_m2'])}" if totals["density_m2"] else "density: not known"
    area = totals["area_m2"]
    ground = "" if area is None else f", {area / 1e6:.3g} km²" if area >= 1e5 else f", {area:,.0f} m²"
    count = totals["strips"]
    return f"{words}, all strips together; {totals['points']:,} points, {count} strip{'s' * (count != 1)}{ground}"


def _time_line(record: Mapping[str, Any], elapsed_s: float) -> str:
    read = sum(counts["read"] for counts in record["counts"].values())
    return f"time: {elapsed_s:.1f} s, {read / max(elapsed_s, 1e-9):,.0f} returns a second"
