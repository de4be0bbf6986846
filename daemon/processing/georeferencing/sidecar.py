"""Writes the JSON beside the products: their inputs, their settings, and the fate of every return."""

from __future__ import annotations

import datetime as dt
import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from swath import __version__
from swath.daemon.processing.carried_verdict import trajectory_entry
from swath.daemon.processing.files import utc_text, write_whole
from swath.daemon.processing.points.coverage import area_of_all_m2
from swath.daemon.processing.points.surfaces import SURFACES
from swath.daemon.processing.setup.models import air_of
from swath.daemon.processing.undecoded import undecoded_lines
from swath.georef.points import Fate
from swath.georef.scanner.calibration import PARAMETERS
from swath.georef.surface.local import Surface

if TYPE_CHECKING:
    from swath.daemon.processing.flights.read import Flight
    from swath.daemon.processing.points.jobs import JobResult
    from swath.daemon.processing.setup.setup import Setup
    from swath.georef.scanner.calibration import Calibration

FORMAT = "swath.georef"
FORMAT_VERSION = 1
CARRIED = (
    "created",
    "verdict",
    "verdict_reasons",
    "held",
    "trajectory",
    "installation",
)  # entries of a calibration's header
SIGMAS = ("north_m", "east_m", "down_m", "roll_deg", "pitch_deg", "heading_deg")
IN_FILES = Fate.GEOREFERENCED.name.lower()
ASSUMED: dict[Surface, str] = {
    "planes": "planes in the points around each point; where there are too few points, level ground; where they lie "
    "on no plane, level ground and a slope as rough as they are",
    "level": "level ground",
    "none": "none: sigmas are those of a surface that each beam meets at a right angle",
}
UNCOVERED = {"outside_trajectory": "are outside the trajectory", "trajectory_gap": "are in gaps of the trajectory"}


def calibration_entry(calibration: Calibration) -> dict[str, Any]:
    """Return the entry of a calibration with all its parameters, in the units of its file."""
    parameters = {parameter.key: calibration.value(parameter.name) / parameter.factor for parameter in PARAMETERS}
    carried = {key: calibration.header[key] for key in CARRIED if key in calibration.header}
    carried |= {key: value.isoformat() for key, value in carried.items() if isinstance(value, dt.datetime)}
    created = {"created": str(calibration.header["created"])} if "created" in calibration.header else {}
    return {"id": calibration.id, "method": calibration.method, **created, **carried, "parameters": parameters}


def settings_entry(setup: Setup) -> dict[str, Any]:
    """Return the settings of the configuration that the points depend on."""
    config = setup.config
    return {
        "atmosphere": config.atmosphere.model_dump(mode="json"),
        "attitude": config.attitude.model_dump(mode="json"),
        "mta": config.mta.model_dump(mode="json"),
        "scanners": {name: config.scanner[name].model_dump(mode="json", exclude_none=True) for name in setup.scanners},
        "geometry_from_log": sorted(setup.sources.sent),
        "gnss": {
            name: {"lever_arm_m": list(gnss.lever_arm_m), "datum": gnss.datum} for name, gnss in config.gnss.items()
        },
    }


def count_fates(results: Sequence[JobResult]) -> dict[str, dict[str, Any]]:
    """Return counts by scanner: returns read, returns written, and returns dropped by reason."""
    total: dict[str, Counter[str]] = {}
    for result in results:
        for scanner, fates in result.fates.items():
            total.setdefault(scanner, Counter()).update(fates)
    undecoded = count_undecoded(results)
    return {
        scanner: counts_entry(fates) | {"messages_not_read": dict(sorted(undecoded.get(scanner, {}).items()))}
        for scanner, fates in sorted(total.items())
    }


def count_undecoded(results: Sequence[JobResult]) -> dict[str, Counter[str]]:
    """Return counts by scanner of messages that gave no returns, by reason."""
    total: dict[str, Counter[str]] = {}
    for result in results:
        for scanner, counts in result.undecoded.items():
            total.setdefault(scanner, Counter()).update(counts)
    return total


def reasons_text(fates: Iterable[Counter[str]]) -> str:
    """Return the fates of returns as text for people."""
    total: Counter[str] = Counter()
    for counts in fates:
        total.update(counts)
    became = (f"{count:,} {reason.replace('_', ' ')}" for reason, count in sorted((+total).items()))
    return ", ".join(became) or "no returns were recorded"


def counts_entry(fates: Counter[str]) -> dict[str, Any]:
    """Return counts of returns: read = written + dropped, the latter by reason."""
    discarded = {name: count for name, count in sorted(fates.items()) if name != IN_FILES and count}
    return {"read": fates.total(), "written": fates[IN_FILES], "dropped": discarded}


def strip_entry(result: JobResult, file: Path | None, dropped: Path | None) -> dict[str, Any]:
    """Return the entry of a strip: its files, times, bounds and counts."""
    entry: dict[str, Any] = {
        "number": result.strip,
        "file": None if file is None else file.name,
        "points": result.points,
        "withheld": result.withheld,
        "dropped_file": None if dropped is None else dropped.name,
        "dropped_rows": result.listed,
        "first_gps_ns": result.first_gps_ns,
        "last_gps_ns": result.last_gps_ns,
        "bounds": result.bounds,
        "bytes": result.file_bytes,
        "last_returns": result.last_returns,
        **_density_entry(result.points, result.last_returns, None if (on := result.covered) is None else on.area_m2),
        "counts": {scanner: counts_entry(fates) for scanner, fates in sorted(result.fates.items())},
        "surface": dict(sorted(result.surface.items())),
        "clipped": {
            "sigma_above_6.5535_m": result.clipped.sigma,
            "sigma_unknown": result.clipped.sigma_unknown,
            "intensity": result.clipped.intensity,
        },
    }
    return entry | ({"failed": result.failed} if result.failed else {})


def _density_entry(points: int, last: int, area_m2: float | None) -> dict[str, Any]:
    """Return the area that points cover, and their density there: of all returns and of last ones."""
    density = {"all": points / area_m2, "last": last / area_m2} if area_m2 and points else None
    return {"area_m2": area_m2, "density_m2": density}


def totals_entry(results: Sequence[JobResult]) -> dict[str, Any]:
    """Return points, strips, area and density of all strips together; ground that strips share counts once."""
    strips = [result for result in results if result.strip and result.points]
    points, last = sum(one.points for one in strips), sum(one.last_returns for one in strips)
    known = all(one.covered is not None for one in strips)
    area_m2 = area_of_all_m2(one.covered for one in strips) if known else None
    return {"points": points, "last_returns": last, "strips": len(strips)} | _density_entry(points, last, area_m2)


def surface_entry(setup: Setup, results: Sequence[JobResult]) -> dict[str, Any] | None:
    """Return what the sigmas took the footprints to fall on, and numbers of points by it; None: there are no sigmas."""
    if not setup.options.uncertainty:
        return None
    points: Counter[str] = Counter()
    for result in results:
        for counts in result.surface.values():
            points.update({key: counts[key] for key in SURFACES})
    kind = setup.options.surface
    return {"kind": kind, "assumed": ASSUMED[kind], "points": {key: points[key] for key in SURFACES}}


def quality_entry(flight: Flight) -> dict[str, Any]:
    """Return the trajectory's root mean square sigmas over the returns, and the share of positions with fixed
    ambiguities; null: not known.
    """
    trajectory = flight.trajectory
    assert trajectory is not None
    within = trajectory.between(*flight.span)
    sigmas = np.concatenate([within.position_sigma_l, np.degrees(within.attitude_sigma_rad)], axis=1)
    known = np.isfinite(sigmas).all(axis=1)
    rms = np.sqrt(np.mean(sigmas[known] ** 2, axis=0)).tolist() if known.any() else None
    return {
        "sigma_rms": None if rms is None else dict(zip(SIGMAS, rms, strict=True)),
        "fixed_share": flight.fixed_share,
    }


def run_record(
    flights: Sequence[Flight], results: Sequence[JobResult], files: Mapping[int, tuple[Path | None, Path | None]]
) -> dict[str, Any]:
    """Return the sidecar's record of a run, without the user's options.

    Args:
        flights: flights of the run.
        results: results of all segments.
        files: by strip, the file of its points and that of returns without a place.
    """
    warnings = [line for flight in flights for line in _warnings(flight, _of(results, flight, flights))]
    holes = [line for flight in flights for line in _holes(flight, _of(results, flight, flights))]
    strips = [strip_entry(result, *files[result.strip]) for result in results if result.strip]
    mapping = flights[0].setup.mapping
    assert mapping is not None
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "software": f"swath {__version__}",
        "complete": not holes,
        "holes": holes,
        "warnings": warnings,
        "crs": mapping.description(),
        "counts": count_fates(results),
        "totals": totals_entry(results),
        "surface": surface_entry(flights[0].setup, results),
        "strips": strips,
        "flights": [_flight_entry(flight, _of(results, flight, flights)) for flight in flights],
    }


def _of(results: Sequence[JobResult], flight: Flight, flights: Sequence[Flight]) -> list[JobResult]:
    number = next(number for number, one in enumerate(flights) if one is flight)
    return [result for result in results if result.session == number]


def _flight_entry(flight: Flight, results: Sequence[JobResult]) -> dict[str, Any]:
    setup, trajectory = flight.setup, flight.trajectory
    assert trajectory is not None
    packages = {key: str(package) for key, package in setup.config.packages().items()}
    return {
        "session": flight.session.session_id,
        "start": utc_text(flight.session.info.realtime_ns),
        "recorder": flight.session.info.software,
        **({"drivers": packages} if packages else {}),
        "aircraft": setup.config.profile.aircraft or None,
        "operator": setup.config.profile.operator or None,
        "origin": flight.session.info.origin or "recording",
        "returns_gps_ns": list(flight.span),
        "trajectory": trajectory_entry(trajectory, flight.source, flight.trajectory_verdicts)
        | {
            "quality": quality_entry(flight),
            "epochs": len(trajectory),
            "solutions": flight.solutions,
            "gaps_gps_ns": trajectory.between(*flight.span).gaps().tolist(),
        },
        "clock": flight.clock,
        "stamps": {
            source: {"scale": found.scale.value, "why": found.text, "sigma_ns": round(found.sigma_ns)}
            for source, found in sorted(flight.clocks.clocks.stamps.items())
        },
        "calibrations": {name: calibration_entry(value) for name, value in setup.calibrations.items()},
        "settings": settings_entry(setup),
        "atmosphere_at_edge": _edges(flight, results),
        "lost_by_recorder": flight.lost,
    }


def _edges(flight: Flight, results: Sequence[JobResult]) -> dict[str, Any]:
    """Return by scanner the size of the atmosphere's effects at the swath's edge, whether they were applied or not."""
    config, entries = flight.setup.config, {}
    for name, (angle_rad, above_m, ground_m) in _widest(results).items():
        effect = air_of(config, config.scanner[name]).at_edge(above_m, angle_rad, ground_m)
        entries[name] = {
            "angle_deg": math.degrees(angle_rad),
            "height_above_ground_m": above_m,
            "range_m": effect.range_m,
            "bending_m": effect.bending_m,
        }
    return entries


def _widest(results: Sequence[JobResult]) -> dict[str, tuple[float, float, float]]:
    widest: dict[str, tuple[float, float, float]] = {}
    for result in results:
        for name, edge in result.edges.items():
            widest[name] = max(widest.get(name, edge), edge)
    return widest


def _warnings(flight: Flight, results: Sequence[JobResult]) -> list[str]:
    config = flight.setup.config
    lines = [
        line
        for name, (angle_rad, above_m, ground_m) in _widest(results).items()
        if (line := air_of(config, config.scanner[name]).warning(above_m, angle_rad, ground_m)) is not None
    ]
    lines += unit_doubts(flight)
    lines += flight.warnings
    lines += undecoded_lines(str(flight.log), count_undecoded(results))[1]
    sigma, unknown, intensity = (
        sum(getattr(result.clipped, name) for result in results) for name in ("sigma", "sigma_unknown", "intensity")
    )
    if sigma:
        lines.append(f"{sigma:,} points have a sigma of 6.5535 m or more, which the file stores as 6.5535 m")
    if unknown:
        lines.append(
            f"{unknown:,} points have an unknown sigma, because the trajectory has no sigmas; the file stores 6.5535 m"
        )
    if intensity:
        lines.append(f"{intensity:,} points have an intensity above 65535, which the file stores as 65535")
    return lines


def unit_doubts(flight: Flight) -> list[str]:
    """Return a line if coordinates are in feet but heights in metres because the CRS has no vertical part."""
    assert flight.setup.mapping is not None
    frame = flight.setup.mapping.description()
    unit, _, unit_of_height = frame["units"]["names"]
    if unit == unit_of_height or not frame["heights"].startswith("ellipsoidal"):
        return []
    return [
        f"easting and northing are in {unit}, heights in {unit_of_height} above the ellipsoid: {frame['crs']} does "
        f"not define heights, and other programs may read them as {unit}; set output.crs with a vertical CRS, such as "
        "EPSG:6529+5703"
    ]


def _holes(flight: Flight, results: Sequence[JobResult]) -> list[str]:
    session = flight.session
    damages = list(dict.fromkeys([*session.damage, *flight.index.damage, *(d for r in results for d in r.damage)]))
    lines = [
        f"{flight.log.parent}: part {number} of {session.session_id} is missing" for number in session.missing_parts
    ]
    if session.growing is not None:
        lines.append(f"{session.growing}: is still being recorded; the products cover the part recorded so far")
    for part in damages:
        damage = part.damage
        lines.append(f"{part.path}: at byte {damage.offset}: {damage.length} bytes, {damage.what}")
    lines += flight.holes
    lines += undecoded_lines(str(flight.log), count_undecoded(results))[0]
    for result in results:
        if result.failed:
            lines.append(f"strip {result.strip}: {result.failed}" if result.strip else f"a turn: {result.failed}")
        elif result.strip and not result.points:
            why = reasons_text(result.fates.values())
            file = "" if result.withheld else "; it has no file"
            lines.append(f"strip {result.strip}: no return of it could be georeferenced ({why}){file}")
        elif result.strip:
            lines += [
                f"strip {result.strip}: {count:,} returns of {name} {UNCOVERED[reason]}"
                for name, fates in sorted(result.fates.items())
                for reason, count in sorted(fates.items())
                if reason in UNCOVERED and count
            ]
    return lines


def write_sidecar(path: Path, content: dict[str, Any]) -> None:
    """Write the sidecar completely or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    write_whole({path: (json.dumps(content, indent=2, ensure_ascii=False) + "\n").encode()})
