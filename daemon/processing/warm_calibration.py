"""Two short strips over level ground, searched for planes and adjusted, so that calibration's loops are compiled."""

from __future__ import annotations

import contextlib

import numpy as np

from swath.calib.adjust import adjust
from swath.calib.equations.trajectory_prior import gauss_markov
from swath.calib.flight import Flight, Head, Swath, Tangent
from swath.calib.parameters import Wish
from swath.calib.planes.matching import rematch
from swath.calib.planes.search import find_planes
from swath.georef.geodesy.earth import e_from_geodetic, geodetic_from_e
from swath.georef.records import RETURN_DTYPE
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import nominal
from swath.georef.scanner.uncertainty import Noise
from swath.georef.timescales import SECOND_NS
from swath.georef.trajectory.trajectory import Trajectory

START_NS = 1_465_000_000 * SECOND_NS
SECONDS, APART_S = 4, 60
RATE_HZ, SCANS_HZ, HALF_ANGLE_RAD = 4000, 20, 0.3
SPEED_MPS, HEIGHT_M = 10.0, 50.0


def warm_calibration() -> None:
    """Run everything once."""
    flight = _flight()
    planes = find_planes(flight)
    planes = rematch(flight, planes)
    with contextlib.suppress(ValueError):  # what such a flight does not determine is no matter here
        adjust(flight, planes, Wish("basic"), gauss_markov(flight))


def _flight() -> Flight:
    frame = Tangent.at(e_from_geodetic(np.radians(47.0), np.radians(9.0), 0.0))
    head = Head("line", nominal("line", np.zeros(3), np.eye(3)), LineGeometry(), Noise(0.02, 1e-5, 0.0, 0.0))
    trajectory = _trajectory(frame)
    bare = Flight(frame, (head,), (trajectory,), ())
    swaths = []
    for strip, begin_ns in enumerate((START_NS, START_NS + APART_S * SECOND_NS), start=1):
        swath = _swath(strip, begin_ns + SECOND_NS // 2)
        points_t = bare.place(swath, head.start)
        swaths.append(Swath(swath.name, 0, strip, 0, swath.rows, swath.time_ns, points_t))
    return Flight(frame, (head,), (trajectory,), tuple(swaths))


def _trajectory(frame: Tangent) -> Trajectory:
    """The same way twice, northwards."""
    since_s = np.arange(0.0, SECONDS + 1.0, 0.02)
    north_m = SPEED_MPS * (since_s - 0.5 * SECONDS)
    lat, lon, height = geodetic_from_e(
        frame.e_from_t(np.stack([0.0 * north_m, north_m, np.full(len(north_m), HEIGHT_M)], axis=1))
    )
    one_ns = START_NS + np.rint(since_s * SECOND_NS).astype(np.int64)
    time_ns = np.concatenate([one_ns, one_ns + APART_S * SECOND_NS])
    level, sigma = np.zeros(len(time_ns)), np.full((len(time_ns), 3), 0.02)
    return Trajectory.from_geodetic(
        time_ns, np.tile(lat, 2), np.tile(lon, 2), np.tile(height, 2), np.zeros_like(sigma), level, level, level,
        position_sigma_l=sigma, attitude_sigma_rad=0.01 * sigma, name="warm-up",
    )  # fmt: skip


def _swath(strip: int, begin_ns: int) -> Swath:
    """Returns from level ground, not placed yet."""
    count = SECONDS * RATE_HZ
    since_s = np.arange(count) / RATE_HZ
    rows = np.zeros(count, RETURN_DTYPE)
    rows["return_number"] = rows["number_of_returns"] = 1
    rows["encoder_rad"] = HALF_ANGLE_RAD * np.sin(2.0 * np.pi * SCANS_HZ * since_s)
    rows["range_m"] = HEIGHT_M / np.cos(rows["encoder_rad"])
    time_ns = begin_ns + np.rint(since_s * SECOND_NS).astype(np.int64)
    return Swath(f"{strip:02d}", 0, strip, 0, rows, time_ns, np.zeros((count, 3)))
