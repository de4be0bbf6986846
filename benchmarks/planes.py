"""Measure what the search for planes costs on one core, beside a copy of the points.

python -m benchmarks.planes [--repeats 3] [--returns 12] [--json FILE]

Figures are returns a second of this process's own CPU time, medians over the repeats: for finding planes, for finding
the same planes again after a calibration, and for reading all points and writing them once. The flight has six strips
over houses on rolling ground, with some five returns a square metre. Its returns are computed from heights alone, which
is all that the search needs, and are mapped from files, as in `swath calibrate`. More returns make longer strips.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.cpu_time import cpu_seconds
from swath.calib.flight import Flight, Head, Swath, Tangent
from swath.calib.planes.matching import rematch
from swath.calib.planes.search import find_planes
from swath.daemon.system import keep_freed_memory
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.records import RETURN_DTYPE
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import nominal
from swath.georef.scanner.uncertainty import Noise
from swath.georef.trajectory.trajectory import Trajectory

STRIPS, RETURNS_PER_M = 6, 2_000  # number of strips, returns per metre of each
HALF_WIDTH_M, HEIGHT_M = 200.0, 500.0
HOUSE_M, LOT_M = 12.0, 40.0
SPEED_MPS = 50.0


@dataclass
class Figure:
    """One line of the table; rates are returns a second of CPU."""

    name: str
    rate: float
    target: float | None
    limit: float


def ground(east: FloatArray, north: FloatArray) -> FloatArray:
    """Return the heights of hills with a gabled roof on every lot."""
    height = 4.0 * np.sin(east / 150.0) + 3.0 * np.cos(north / 120.0)
    x, y = np.mod(east, LOT_M) - 0.5 * LOT_M, np.mod(north, LOT_M) - 0.5 * LOT_M
    roof = (np.abs(x) < 0.5 * HOUSE_M) & (np.abs(y) < 0.5 * HOUSE_M)
    lot_x, lot_y = east - x, north - y
    base = 4.0 * np.sin(lot_x / 150.0) + 3.0 * np.cos(lot_y / 120.0)
    turned = np.where(np.floor(lot_x / LOT_M + lot_y / LOT_M) % 2 == 0, x, y)
    return np.where(roof, base + 8.0 - 0.7 * np.abs(turned), height)


def mapped(folder: Path, name: str, array: NDArray[Any]) -> NDArray[Any]:
    """Save the array to a file and return it mapped from there."""
    np.save(folder / f"{name}.npy", array)
    loaded: NDArray[Any] = np.load(folder / f"{name}.npy", mmap_mode="r")
    return loaded


def strip(
    number: int, count: int, folder: Path, frame: Tangent, draws: np.random.Generator
) -> tuple[Swath, FloatArray, Int64Array]:
    """Make a swath; return it with the positions (k, 3) of its aircraft in frame e and their times (ns)."""
    length_m = count / RETURNS_PER_M
    second = np.arange(count) / (SPEED_MPS * RETURNS_PER_M)
    along = SPEED_MPS * second - 0.5 * length_m
    across = HALF_WIDTH_M * (2.0 * (50.0 * second % 1.0) - 1.0)
    turn = number * np.pi / 2.0
    east, north = along * np.cos(turn) - across * np.sin(turn), along * np.sin(turn) + across * np.cos(turn)
    up = ground(east, north) + draws.normal(0.0, 0.02, count)
    rows = np.zeros(count, RETURN_DTYPE)
    rows["return_number"] = rows["number_of_returns"] = 1
    rows["range_m"] = np.hypot(across, HEIGHT_M)
    start_ns = number * 10_000_000_000_000
    epochs = np.arange(0.0, length_m / SPEED_MPS, 0.1)
    way = SPEED_MPS * epochs - 0.5 * length_m
    place_t = np.stack([way * np.cos(turn), way * np.sin(turn), np.full(len(way), HEIGHT_M)], axis=1)
    time_ns = start_ns + np.rint(1e9 * second).astype(np.int64)
    columns = {"rows": rows, "time": time_ns, "points": np.stack([east, north, up], axis=1)}
    taken = [mapped(folder, f"{number}.{name}", column) for name, column in columns.items()]
    swath = Swath(f"{number:02d}", 0, number, 0, *taken)
    return swath, frame.e_from_t(place_t), start_ns + np.rint(1e9 * epochs).astype(np.int64)


def flight(returns: int, folder: Path) -> Flight:
    """Make a flight of all strips."""
    frame = Tangent.at(np.asarray(e_from_geodetic(np.radians(47.4), np.radians(8.9), 0.0)))
    draws = np.random.default_rng(7)
    made = [strip(number, returns // STRIPS, folder, frame, draws) for number in range(STRIPS)]
    position_e, time_ns = np.concatenate([one[1] for one in made]), np.concatenate([one[2] for one in made])
    level = np.tile([1.0, 0.0, 0.0, 0.0], (len(time_ns), 1))
    unknown = np.full_like(position_e, np.nan)
    trajectory = Trajectory(time_ns, position_e, level, unknown, unknown, unknown)
    head = Head("left", nominal("left", np.zeros(3), np.eye(3)), LineGeometry(), Noise())
    return Flight(frame, (head,), (trajectory,), tuple(one[0] for one in made))


def measure(repeats: int, asked: int, folder: Path) -> tuple[list[Figure], str]:
    """Measure all lines of the table; return them with a description of what was found."""
    whole = flight(asked, folder)
    returns = sum(len(swath) for swath in whole.swaths)
    found = find_planes(whole)
    by = np.array([0.1, 0.0, 0.02])
    points = [mapped(folder, f"{swath.name}.moved", swath.points_t + by) for swath in whole.swaths]
    moved = replace(
        whole, swaths=tuple(replace(one, points_t=place) for one, place in zip(whole.swaths, points, strict=True))
    )

    def rate(work: object) -> float:
        assert callable(work)
        return returns / cpu_seconds(work, repeats)

    limit = rate(lambda: [swath.points_t.copy() for swath in whole.swaths])
    figures = [
        Figure("planes found", rate(lambda: find_planes(whole)), 1e6, limit),
        Figure("planes found again", rate(lambda: rematch(moved, found)), None, limit),
    ]
    roofs = sum(plane.kind == "roof" for plane in found.planes)
    return figures, f"{returns / 1e6:.0f} M returns, {roofs} roofs, {len(found.planes) - roofs} pieces of ground"


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3, help="measurements per figure; the median counts")
    parser.add_argument("--returns", type=float, default=12.0, help="returns of the flight, in millions")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    arguments = parser.parse_args()
    keep_freed_memory()  # as every command of swath does
    with tempfile.TemporaryDirectory() as folder:
        figures, what = measure(arguments.repeats, int(1e6 * arguments.returns), Path(folder))
    print(f"{'planes, one core: ' + what:<66} {'rate':>9} {'asked':>8} {'copy':>9}")
    for one in figures:
        asked = f"{one.target / 1e6:>4.0f} M/s" if one.target else ""
        print(f"{one.name:<66} {one.rate / 1e6:>5.2f} M/s {asked:>8} {one.limit / 1e6:>5.0f} M/s")
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(figure) for figure in figures], indent=1))


if __name__ == "__main__":
    main()
