"""Computes the figures of a navigated flight: one dict, for the page, the summary and the verdict."""

from __future__ import annotations

from typing import Any

import numpy as np

from swath.daemon.processing.trajectory.series import (
    GAP_INTERVALS,
    USED,
    Flight,
    Separation,
    bridged_spans,
    outages_of,
    used_positions,
)
from swath.georef.arrays import FloatArray, StructArray
from swath.georef.navigation.inputs import ARM_UNSAID_M, Fate, Kind, Setup, Solution
from swath.georef.records import FixType
from swath.georef.timescales.gps_time import SECOND_NS

Figures = dict[str, Any]

AXES_L, AXES_B, PAIRS_B = ("north", "east", "down"), ("x", "y", "z"), ("yz", "zx", "xy")
ANGLES = ("roll", "pitch", "heading")
SIGMAS: tuple[tuple[str, str, tuple[str, ...], str, float], ...] = (
    ("position", "position_sigma_l", AXES_L, "m", 1.0),
    ("velocity", "velocity_sigma_l", AXES_L, "mps", 1.0),
    ("attitude", "attitude_sigma_rad", ANGLES, "deg", 180.0 / np.pi),
)
SENSORS: tuple[tuple[str, str, str], ...] = (  # name, field of Solution, of ImuNoise
    ("gyro_bias", "gyro_bias", "gyro_bias"),
    ("accel_bias", "accel_bias", "accel_bias"),
    ("gyro_scale", "gyro_scale", "gyro_scale"),
    ("accel_scale", "accel_scale", "accel_scale"),
    ("gyro_misalignment", "gyro_misalignment", "misalignment"),
    ("accel_misalignment", "accel_misalignment", "misalignment"),
)
CHI2_MEDIAN = np.array([np.nan, 0.45494, 1.38629, 2.36597])  # of 1, 2, 3 degrees of freedom
MOST_SORTED = 400_000  # maximum epochs that a percentile is computed from
FEWEST = 30  # minimum observations of a kind for figures of their spread
WINDOW_NS = 30 * SECOND_NS  # a disturbance of this length may be hidden in the root mean square of a whole flight


def figures_of(flight: Flight, separation: Separation | None) -> Figures:
    """Return all figures of a flight; sigmas are one standard deviation, of the smoother if it ran."""
    best = flight.best
    intervals = np.diff(best.time_ns)
    return {
        "solution": "filter" if flight.smoothed is None else "smoother",
        "start_gps_ns": flight.start_ns,
        "end_gps_ns": int(best.time_ns[-1]),
        "duration_s": flight.duration_s,
        "missing_s": flight.missing_s,
        "missing_share": flight.missing_s / max(flight.missing_s + flight.duration_s, 1e-9),
        "epochs": len(best),
        "rate_hz": SECOND_NS / float(np.median(intervals)) if len(intervals) else None,
        "not_finite": _not_finite(best),
        "start": flight.start,
        "bridged": _bridged(best),
        "positions": _positions(flight),
        "observations": _observations(flight.forward.innovations),
        "sigma_rms": _sigmas(best, _root_mean_square),
        "sigma_p95": _sigmas(best, _percentile_95),
        "sigma_largest": _sigmas(best, lambda column: float(np.nanmax(column))),
        "filter_sigma_rms": _sigmas(flight.forward, _root_mean_square),
        "separation": _separation(separation),
        "separation_worst": _worst_separation(separation, flight.start_ns),
        "sensors": _sensors(flight),
        "lever_arm": _lever_arm(flight),
        "time_offset": _time_offset(flight),
        "noise_found": dict(flight.noise_found),
        "lasting_share": flight.setup.gnss_correlated_share,
        "lasting_velocity_share": flight.setup.gnss_velocity_share,
        "lasting_velocity_s": flight.setup.gnss_velocity_correlation_s if flight.setup.gnss_velocity_share else None,
        "lasting_heading_share": flight.setup.gnss_heading_share if flight.setup.baseline_b is not None else None,
        "lasting_heading_s": _heading_s(flight.setup),
        "counts": {name: int(count) for name, count in sorted(flight.forward.counts.items())},
    }


def _heading_s(setup: Setup) -> float | None:
    """Return the assumed correlation time of headings' errors; None if none is assumed."""
    lasts = setup.baseline_b is not None and setup.gnss_heading_share > 0.0
    return setup.gnss_heading_correlation_s if lasts else None


def _not_finite(solution: Solution) -> int:
    columns = solution.position_e, solution.velocity_e, solution.q_e_from_b, solution.position_sigma_l
    return int((~np.logical_and.reduce([np.isfinite(column).all(axis=1) for column in columns])).sum())


def _bridged(solution: Solution) -> Figures:
    spans = bridged_spans(solution)
    longest_ns = int((spans[:, 1] - spans[:, 0]).max()) if len(spans) else 0
    epochs = int(solution.bridged.sum())
    return {"epochs": epochs, "share": epochs / max(len(solution), 1), "longest_s": longest_ns / SECOND_NS}


def _positions(flight: Flight) -> Figures:
    used, outages = used_positions(flight.forward), outages_of(flight)
    lengths_s = (outages[:, 1] - outages[:, 0]) / SECOND_NS
    types, counts = np.unique(used["fix_type"], return_counts=True)
    counted = used["satellites"][used["satellites"] > 0]
    return {
        "used": len(used),
        "fix_types": {FixType(int(code)).name.lower(): int(count) for code, count in zip(types, counts, strict=True)},
        "satellites_median": float(np.median(counted)) if len(counted) else None,
        "satellites_least": int(counted.min()) if len(counted) else None,
        "outages": len(outages),
        "outages_s": float(lengths_s.sum()),
        "longest_outage_s": float(lengths_s.max()) if len(lengths_s) else 0.0,
    }


def _observations(innovations: StructArray) -> dict[str, Figures]:
    """Return by kind the number of observations by fate, and how innovations compare with their sigmas."""
    found = {}
    for code in np.unique(innovations["kind"]):
        rows = innovations[innovations["kind"] == code]
        outside = int((rows["fate"] == Fate.OUTSIDE).sum())
        fates = {fate.name.lower(): int((rows["fate"] == fate).sum()) for fate in Fate}
        found[Kind(int(code)).name.lower()] = {
            "seen": len(rows) - outside,
            **fates,
            "sigma_factor": sigma_factor(rows),
            "correlation": correlation_of(rows),
        }
    return found


def sigma_factor(rows: StructArray) -> float | None:
    """Return the factor by which innovations exceed their sigmas: 1 if these are right; None for fewer than 30.

    From the median of chi2 against that of its distribution, which neither outliers nor the gate affect much.
    """
    rows = rows[np.isin(rows["fate"], (*USED, Fate.REJECTED)) & (rows["dimension"] > 0) & np.isfinite(rows["chi2"])]
    if len(rows) < FEWEST:
        return None
    return float(np.sqrt(np.median(rows["chi2"] / CHI2_MEDIAN[rows["dimension"]])))


def correlation_of(rows: StructArray) -> float | None:
    """Return the correlation of each normalised innovation with its antenna's next: 0 if white;
    None for fewer than 30.
    """
    products, squares, pairs = 0.0, 0.0, 0
    for antenna in np.unique(rows["antenna"]):
        mine = rows[(rows["antenna"] == antenna) & np.isin(rows["fate"], USED)]
        if len(mine) < 2:
            continue
        steps_ns = np.diff(mine["time_ns"])
        near = steps_ns <= GAP_INTERVALS * np.median(steps_ns)
        first, second = mine["normalised"][:-1][near], mine["normalised"][1:][near]
        both = np.isfinite(first) & np.isfinite(second)
        first, second = first[both], second[both]
        products += float((first * second).sum())
        squares += float((first**2).sum() + (second**2).sum()) / 2
        pairs += int(near.sum())
    return products / squares if pairs >= FEWEST and squares > 0.0 else None


def _root_mean_square(column: FloatArray) -> float:
    return float(np.sqrt(np.nanmean(np.square(column, dtype=np.float64))))


def _percentile_95(column: FloatArray) -> float:
    return float(np.nanpercentile(column[:: max(1, len(column) // MOST_SORTED)], 95.0))


def _sigmas(solution: Solution, told: Any) -> dict[str, float | None]:
    """Return figures of sigmas by name with unit, ``north_m`` to ``heading_deg``; None if no epoch has one."""
    found = {}
    for name, column, axes, unit, factor in SIGMAS:
        values = getattr(solution, column)
        for axis, word in enumerate(axes):
            key = f"{word}_{unit}" if name != "velocity" else f"velocity_{word}_{unit}"
            known = bool(np.isfinite(values[:, axis]).any())
            found[key] = factor * told(values[:, axis]) if known else None
    return found


def _ratios(separation: Separation) -> dict[str, FloatArray]:
    return {
        "position": separation.position_m / separation.position_sigma_m,
        "velocity": separation.velocity_mps / separation.velocity_sigma_mps,
        "attitude": separation.attitude_rad / separation.attitude_sigma_rad,
    }


def _separation(separation: Separation | None) -> Figures | None:
    """Return the root mean square of filter − smoother over its predicted sigma: 1 if both sigmas are right."""
    if separation is None:
        return None
    return {
        name: _root_mean_square(ratio[np.isfinite(ratio)]) if np.isfinite(ratio).sum() >= FEWEST else None
        for name, ratio in _ratios(separation).items()
    }


def _worst_separation(separation: Separation | None, start_ns: int) -> dict[str, Figures] | None:
    """Return the same for the window in which it is largest, and its middle.

    It shows seconds of a wrong fix in hours of a flight.
    """
    if separation is None:
        return None
    found = {}
    for name, ratio in _ratios(separation).items():
        known = np.isfinite(ratio)
        squares = np.where(known, ratio, 0.0) ** 2
        sums, counts = (np.append(0.0, np.cumsum(values.sum(axis=1))) for values in (squares, known))
        first = np.arange(len(ratio))
        last = np.searchsorted(separation.time_ns, separation.time_ns + WINDOW_NS)
        count = counts[last] - counts[first]
        mean = np.where(count >= FEWEST, (sums[last] - sums[first]) / np.maximum(count, 1.0), 0.0)
        at = int(np.argmax(mean))
        if mean[at] > 0.0:
            middle_ns = (int(separation.time_ns[at]) + int(separation.time_ns[last[at] - 1])) // 2
            found[name] = {"value": float(np.sqrt(mean[at])), "at_s": (middle_ns - start_ns) / SECOND_NS}
    return found


def _sensors(flight: Flight) -> dict[str, dict[str, Figures]]:
    """Return for each sensor error and axis: last estimate, its sigma, and its size relative to the
    configured noise.
    """
    best, noise = flight.best, flight.setup.noise
    found: dict[str, dict[str, Figures]] = {}
    for name, column, expected in SENSORS:
        values, sigmas, prior = getattr(best, column), getattr(best, f"{column}_sigma"), getattr(noise, expected)
        if not len(values) or prior <= 0.0:
            continue
        found[name] = {
            axis: {
                "estimate": float(values[-1, i]),
                "sigma": float(sigmas[-1, i]),
                "largest_over_expected": float(np.nanmax(np.abs(values[:, i]))) / prior,
            }
            for i, axis in enumerate(PAIRS_B if name.endswith("misalignment") else AXES_B)
        }
    return found


def _lever_arm(flight: Flight) -> Figures | None:
    best, prior_m = flight.best, flight.setup.estimate_lever_arm
    if prior_m <= 0.0 or not len(best.lever_arm_b):
        return None
    given = np.asarray(flight.setup.lever_arms_b, np.float64)[0]
    estimate, sigma = best.lever_arm_b[-1], best.lever_arm_sigma[-1]
    moved = np.abs(estimate - given) if prior_m < ARM_UNSAID_M else np.zeros(3)  # it had no given value
    return {
        "given_m": given.tolist(),
        "estimate_m": estimate.tolist(),
        "sigma_m": sigma.tolist(),
        "moved_m": np.where(moved > 3 * sigma, moved, 0.0).tolist(),
        "sigma_over_prior": (sigma / prior_m).tolist(),
    }


def _time_offset(flight: Flight) -> Figures | None:
    best, prior_s = flight.best, flight.setup.estimate_time_offset_s
    if prior_s <= 0.0 or not len(best.time_offset_s):
        return None
    offset_s, sigma_s = float(best.time_offset_s[-1]), float(best.time_offset_sigma_s[-1])
    return {"estimate_s": offset_s, "sigma_s": sigma_s, "significant": abs(offset_s) > 3 * sigma_s}


def accuracy_words(figures: Figures) -> str:
    """Return the sigmas over the flight in words."""
    rms = figures["sigma_rms"]
    place = [rms["north_m"], rms["east_m"], rms["down_m"]]
    known = [value for value in place if value is not None]
    if not known:
        return "sigmas are not known"
    worst_m = max(known)
    words = [f"position to {100 * worst_m:.1f} cm" if worst_m < 1.0 else f"position to {worst_m:.1f} m"]
    tilt = [rms[f"{angle}_deg"] for angle in ANGLES[:2] if rms[f"{angle}_deg"] is not None]
    words += [f"roll and pitch to {max(tilt):.4f}°"] if tilt else []
    words += [f"heading to {rms['heading_deg']:.4f}°"] if rms["heading_deg"] is not None else []
    return ", ".join(words) + " (one sigma, root mean square over the flight)"
