"""Makes a calibration flight without a log: level lines over roofs, each return where its beam meets one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from swath.calib.features import Features
from swath.calib.flight import Flight, Head, Tangent
from swath.calib.plan import MOST_MADE, Line, Scan, Surface, planned
from swath.georef.geodesy.earth import e_from_geodetic, geodetic_from_e
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import Calibration, nominal
from swath.georef.scanner.uncertainty import Noise
from swath.georef.trajectory.trajectory import Trajectory
from tests.calib.roofs import exactly_known

SECOND, BEGIN = 10**9, 1_400_000_000 * 10**9
FRAME = Tangent.at(e_from_geodetic(np.radians(47.0), np.radians(9.0), 0.0))
SPEED_MPS, LINE_S, APART_S = 60.0, 16.0, 90.0
NOISE = Noise(0.02, float(np.radians(0.001)), 0.0, 0.0)

# heading, height, offset to the right of the middle: as FORMULAS 5.5
OPPOSITE = ((0.0, 800.0, 0.0), (180.0, 800.0, 0.0))
ONE_HEIGHT = (*OPPOSITE, (0.0, 800.0, 250.0), (0.0, 800.0, -250.0), (90.0, 800.0, 0.0), (270.0, 800.0, 0.0))
TWO_HEIGHTS = (*ONE_HEIGHT, (0.0, 1500.0, 0.0), (90.0, 1500.0, 0.0))


def path(
    lines: Sequence[tuple[float, float, float]], sigma_m: float = 0.02, sigma_deg: float = 0.003
) -> tuple[Trajectory, list[Line]]:
    """Return lines flown one after the other through the middle, with slightly rocking wings and nothing in between."""
    columns, found = [], []
    t = np.arange(0.0, LINE_S + 1e-9, 0.02)
    for number, (heading_deg, height_m, offset) in enumerate(lines):
        course = np.radians(heading_deg)
        along = np.array([np.sin(course), np.cos(course)])
        right = np.array([np.cos(course), -np.sin(course)])
        place = (t - LINE_S / 2)[:, np.newaxis] * SPEED_MPS * along + offset * right
        points_t = np.column_stack([place, np.full(len(t), height_m)])
        begin = BEGIN + round(number * APART_S * SECOND)
        wave = np.radians(1.0) * np.sin(0.7 * t + number)
        columns.append((begin + np.rint(t * SECOND).astype(np.int64), points_t, wave, np.full(len(t), course)))
        found.append(Line(f"{number + 1:02d}", 0, number + 1, begin + SECOND, begin + round((LINE_S - 1.0) * SECOND)))
    time_ns, points_t, wave, heading = (np.concatenate(column) for column in zip(*columns, strict=True))
    lat, lon, height = geodetic_from_e(FRAME.e_from_t(points_t))
    trajectory = Trajectory.from_geodetic(
        time_ns, lat, lon, height, np.zeros((len(time_ns), 3)), wave, 0.7 * wave[::-1], heading,
        position_sigma_l=np.full((len(time_ns), 3), sigma_m),
        attitude_sigma_rad=np.radians(np.tile([sigma_deg, sigma_deg, 2.0 * sigma_deg], (len(time_ns), 1))),
        name="planned",
    )  # fmt: skip
    return trajectory, found


def surfaces(*, roofs: bool = True, count: int = 7, spread_m: float = 300.0) -> list[Surface]:
    """Return count² pieces of 10 m: slopes of 35° in four aspects with every fifth flat, or all flat."""
    made = []
    places = np.linspace(-spread_m, spread_m, count)
    grid = np.stack(np.meshgrid(np.linspace(-5, 5, 7), np.linspace(-5, 5, 7)), axis=-1).reshape(-1, 2)
    for index, (east, north) in enumerate((e, n) for e in places for n in places):
        azimuth, slope = index % 4 * np.pi / 2 + 0.3, np.radians(35.0 if roofs and index % 5 else 0.0)
        normal = np.array([np.sin(slope) * np.sin(azimuth), np.sin(slope) * np.cos(azimuth), np.cos(slope)])
        z = -(grid @ normal[:2]) / normal[2]
        points = np.column_stack([grid, z]) + np.array([east, north, 5.0])
        made.append(Surface(f"p{index}", normal, points, 100.0, "roof" if slope else "ground"))
    return made


def scanner(name: str = "left", **values: float) -> Head:
    """Return a scanner with some parameters changed."""
    start: Calibration = nominal(name, [0.15, -0.08, 0.42], np.eye(3)).changed(**values)
    return Head(name, exactly_known(start), LineGeometry(), NOISE, (20.0, 3000.0))


def flown(
    lines: Sequence[tuple[float, float, float]], *, roofs: bool = True, sigma_m: float = 0.02, sigma_deg: float = 0.003
) -> tuple[Flight, Features]:
    """Return a flight of such lines."""
    trajectory, planned_lines = path(lines, sigma_m, sigma_deg)
    scan = Scan(float(np.radians(30.0)), 100_000.0, 40.0, "sine")
    return planned(FRAME, [scanner()], [scan], [trajectory], planned_lines, surfaces(roofs=roofs), MOST_MADE)


def noised(flight: Flight, seed: int) -> Flight:
    """Add noise to ranges and angles as large as the heads state."""
    rng = np.random.default_rng(seed)
    swaths = []
    for swath in flight.swaths:
        rows = swath.rows.copy()
        noise = flight.heads[swath.head].noise
        rows["range_m"] += noise.range_m * rng.standard_normal(len(rows))
        rows["encoder_rad"] += noise.angle_rad * rng.standard_normal(len(rows))
        swaths.append(replace(swath, rows=rows))
    return replace(flight, swaths=tuple(swaths))
