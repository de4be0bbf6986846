"""Scores the reference flights and the car as their README does."""

from __future__ import annotations

import json
from functools import cache

import numpy as np

from swath.georef.arrays import FloatArray, StructArray
from swath.georef.geodesy.earth import e_from_geodetic, rot_e_from_l
from swath.georef.geodesy.quaternions import rotated
from swath.georef.geodesy.rotations import rot_l_from_b
from swath.georef.navigation.inputs import Solution, Start
from tests.georef.navigation.vehicles import BEGIN_NS, NAVIGATION, flight_arrays, ns

LINES_S = (100_600.0, 101_550.0)

# north, east, down m, roll, pitch, heading degrees
FILTER = {
    "tactical": [0.0079, 0.0068, 0.0111, 0.0035, 0.0031, 0.0081],
    "mems": [0.0098, 0.0092, 0.0146, 0.0102, 0.0142, 0.0518],
}
SMOOTHER = {
    "tactical": [0.0031, 0.0028, 0.0048, 0.0020, 0.0017, 0.0037],
    "mems": [0.0043, 0.0037, 0.0064, 0.0068, 0.0076, 0.0183],
}
OUTAGES_M = {"tactical": (1.81, 0.090), "mems": (8.4, 0.31)}


@cache
def truth(name: str) -> FloatArray:
    """Return the rows of the truth."""
    rows: FloatArray = flight_arrays(name)["truth"]
    return rows


@cache
def outages(name: str) -> FloatArray:
    """Return the outages (10, 2) in s."""
    spans: FloatArray = flight_arrays(name)["outages"]
    return spans


def without(rows: StructArray, spans_s: FloatArray) -> StructArray:
    """Return the observations outside spans of time."""
    t = (rows["time_ns"] - BEGIN_NS) / 1e9
    kept: StructArray = rows[~((t[:, None] >= spans_s[:, 0]) & (t[:, None] < spans_s[:, 1])).any(axis=1)]
    return kept


def start_of(folder: str, name: str) -> Start:
    """Return the start that the recording's description gives."""
    about = json.loads((NAVIGATION / f"{folder}/{name}.json").read_text())
    lat, lon = np.radians(about["initpos"][:2])
    return Start(
        int(ns(about["starttime"])),
        e_from_geodetic(lat, lon, about["initpos"][2]),
        np.array(about["initvel"]),
        np.radians(about["initatt"]),
        np.array(about.get("initposstd", [0.05] * 3)),
        np.array(about.get("initvelstd", [0.05] * 3)),
        np.radians(about["initattstd"]),
    )


def flight_errors(name: str, solution: Solution, span_s: tuple[float, float]) -> tuple[FloatArray, FloatArray]:
    """Return times and (n, 6) found − true north, east, down (m), roll, pitch, heading (deg), at the truth's epochs."""
    rows = truth(name)
    rows = rows[(rows[:, 1] >= span_s[0]) & (rows[:, 1] <= span_s[1])]
    poses = solution.trajectory().poses(ns(rows[:, 1]))
    lat, lon = np.radians(rows[:, 2:4]).T
    level = rot_e_from_l(lat, lon)
    off = np.einsum("nji,nj->ni", level, poses.position_e - e_from_geodetic(lat, lon, rows[:, 4]))
    axes = np.stack([rotated(poses.q_e_from_b, np.tile(axis, (len(rows), 1))) for axis in np.eye(3)], axis=-1)
    found = np.swapaxes(level, 1, 2) @ axes
    true = rot_l_from_b(*np.radians(rows[:, 8:11]).T)
    roll, pitch, heading = (_angles(found)[i] - _angles(true)[i] for i in range(3))
    turned = (np.degrees(np.stack([roll, pitch, heading], axis=1)) + 180.0) % 360.0 - 180.0
    return rows[:, 1], np.concatenate([off, turned], axis=1)


def _angles(rot: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    return (
        np.arctan2(rot[:, 2, 1], rot[:, 2, 2]),
        -np.arcsin(rot[:, 2, 0]),
        np.arctan2(rot[:, 1, 0], rot[:, 0, 0]),
    )


def rms(errors: FloatArray) -> FloatArray:
    """Return the RMS by column."""
    mean: FloatArray = np.sqrt((errors**2).mean(axis=0))
    return mean


def of_maxima(t: FloatArray, size_m: FloatArray, spans_s: FloatArray) -> float:
    """Return the RMS of the largest error in each outage, m."""
    largest = [size_m[(t >= begin) & (t <= end)].max() for begin, end in spans_s]
    return float(np.sqrt(np.mean(np.square(largest))))


def off_fixes(solution: Solution, fixes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return times and (n, 3) found − fixed north, east, down (m), for antennas at the body's origin.

    The times are those of the fixes.
    """
    at_ns = ns(fixes[:, 0])
    inside = (at_ns >= solution.time_ns[0]) & (at_ns <= solution.time_ns[-1])
    lat, lon = np.radians(fixes[inside, 1:3].T)
    place = e_from_geodetic(lat, lon, fixes[inside, 3])
    level = rot_e_from_l(lat, lon)
    found = solution.trajectory().poses(at_ns[inside]).position_e
    return fixes[inside, 0], np.einsum("nji,nj->ni", level, found - place)
