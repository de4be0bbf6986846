"""Tests strips of `swath live` against those that the office cuts and compares from the same data."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from swath.daemon.processing.live.grid import CellGrid
from swath.daemon.processing.live.painting import HERE, METRES
from swath.daemon.processing.live.strips import NEVER_NS, StripComparison, StripCutter
from swath.daemon.processing.quicklook.grids import Frame
from swath.daemon.processing.quicklook.read import Block
from swath.daemon.processing.quicklook.strips import StripCells, compare
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.points import Points
from swath.georef.strips import common, cut, laser_spans, straight_spans
from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.trajectory.trajectory import Trajectory
from tests.daemon.processing.live.builders import GPS_NS, HEIGHT_M, LAT_DEG, LON_DEG, points_at, read_map

pytestmark = pytest.mark.xdist_group("kernels")

RATE_HZ = 50
# Seconds of straight flight and of turning, one after the other; the third stretch is too short for a strip.
STRETCHES = (20.0, 12.0, 3.5, 8.0, 30.0, 10.0, 25.0)
LASER_OFF = (58.0, 60.5)  # seconds; in the fifth stretch
HOST_MINUS_GPS_NS = 5_000_000_000


def flown() -> Trajectory:
    """Return a flight whose turns have 3°/s and 20° of bank, which builds up within a second."""
    t = np.arange(round(sum(STRETCHES) * RATE_HZ)) / RATE_HZ
    ends = np.cumsum(STRETCHES)
    turning = np.interp(t, *_ramps(ends))
    heading = np.cumsum(np.radians(3.0) * turning) / RATE_HZ
    zero = np.zeros(len(t))
    return Trajectory.from_geodetic(
        GPS_NS + np.rint(t * SECOND_NS).astype(np.int64),
        np.full(len(t), np.radians(LAT_DEG)) + 1e-6 * t,
        np.full(len(t), np.radians(LON_DEG)),
        np.full(len(t), HEIGHT_M),
        np.tile([60.0, 0.0, 0.0], (len(t), 1)),
        np.radians(20.0) * turning,
        zero,
        heading,
    )


def _ramps(ends: FloatArray) -> tuple[list[float], list[float]]:
    times, values = [0.0], [0.0]
    for number, end in enumerate(ends[:-1].tolist()):
        times += [end, end + 1.0]
        values += [float(number % 2), float((number + 1) % 2)]
    return times, values


def test_strips_in_flight_are_those_of_the_office() -> None:
    trajectory = flown()
    roll, _, heading = trajectory.attitude()
    end_s = sum(STRETCHES)
    off_ns = [GPS_NS + round(second * SECOND_NS) for second in LASER_OFF]
    laser = laser_spans(np.array([GPS_NS, off_ns[1]]), np.array([off_ns[0], GPS_NS + round(end_s * SECOND_NS)]))
    office = cut(common(straight_spans(trajectory.time_ns, heading, roll), laser), laser)
    cutter = StripCutter(lambda host_ns: host_ns - HOST_MINUS_GPS_NS)
    dropped: list[int] = []
    labelled: Int64Array = np.zeros(len(trajectory), np.int64)
    for last in range(10, len(trajectory), 10):
        part = slice(max(0, last - 30 * RATE_HZ), last)
        seen = Trajectory(*(getattr(trajectory, name)[part] for name in (
            "time_ns", "position_e", "q_e_from_b", "velocity_e", "position_sigma_l", "attitude_sigma_rad",
        )))  # fmt: skip
        host_ns = trajectory.time_ns[last - 10 : last] + HOST_MINUS_GPS_NS
        on = (host_ns - HOST_MINUS_GPS_NS < off_ns[0]) | (host_ns - HOST_MINUS_GPS_NS >= off_ns[1])
        if on.any():
            cutter.note_laser(int(host_ns[on][0]), int(host_ns[on][-1]))
        cutter.update(seen, int(host_ns[-1]))
        dropped += cutter.dropped
        cutter.dropped.clear()
        new = slice(last - 10, last)
        for start, end, number in cutter.edges().tolist():
            labelled[new][(trajectory.time_ns[new] >= start) & (trajectory.time_ns[new] < end)] = number
    assert cutter.edges()[-1, 1] == NEVER_NS
    cutter.end()
    assert [strip.number for strip in cutter.strips] == [1, 2, 3, 4]
    assert dropped == [2], "the number of the short stretch is given again"
    for strip, (start, end) in zip(cutter.strips, office, strict=True):
        assert abs(strip.start_ns - start) < 0.15 * SECOND_NS
        # the trajectory is looked at once a second: the last strip ends at the last look
        assert abs(strip.end_ns - end) < (0.15 if strip.number < 4 else 1.0) * SECOND_NS
    truth = np.zeros(len(trajectory), np.int64)
    for number, (start, end) in enumerate(office, start=1):
        truth[(trajectory.time_ns >= start) & (trajectory.time_ns < end)] = number
    late_s = np.count_nonzero((labelled != truth) & (labelled != 2) & (truth > 0)) / RATE_HZ
    assert late_s < 2.0 * len(office), "when a point came, its strip was known but for two seconds at a strip's ends"


def strip_points(number: int, up_m: float) -> Points:
    """Return a strip's points on rough, gently sloping ground with a steep wall, four a square metre."""
    rng = np.random.default_rng(number)
    count = 240_000
    xyz = rng.uniform((-150.0, -100.0, 0.0), (150.0, 100.0, 1.0), (count, 3))
    xyz[:, 0] += 100.0 * (number - 1)
    xyz[:, 2] = 300.0 + up_m + 0.05 * xyz[:, 0] - 0.1 * xyz[:, 1] + rng.normal(0.0, 0.02, count)
    xyz[:, 2] += np.where(np.abs(xyz[:, 1] - 40.0) < 5.0, 4.0 * (xyz[:, 1] - 40.0), 0.0)
    points = points_at(xyz, GPS_NS + number * 20 * SECOND_NS + np.arange(count) * 20_000)
    points.number_of_returns[::7] = 2
    points.return_number[::14] = 2
    return points


@pytest.mark.parametrize("cell_m", [1.0, 2.0])
def test_differences_in_flight_are_those_of_the_office(tmp_path: Path, cell_m: float) -> None:
    """Both compare planes of the same returns in the same cells; those kept of earlier strips are rounded."""
    grid, comparison = CellGrid(cell_m), StripComparison(cell_m)
    cells = StripCells(Frame(-512.0, -512.0, 2.0, 512, 512), 0.0, fixed=True)
    for number, up_m in ((1, 0.0), (2, 0.03), (3, -0.02)):
        points = strip_points(number, up_m)
        edges = np.array([[points.time_ns[0], NEVER_NS, number]])
        for piece in np.array_split(np.arange(len(points)), 5):
            part = points.take(piece)
            grid.add(part, HERE, METRES, edges)
            comparison.take(part, part.points_map, HERE, METRES, edges, grid)
            comparison.update(int(part.time_ns[-1]), grid)
        east, north, up = (np.ascontiguousarray(column) for column in points.points_map.T)
        block = Block(
            x_m=east,
            y_m=north,
            z_m=up,
            intensity=points.intensity,
            strip=np.full(len(points), number, np.int32),
            first=points.return_number <= 1,
            single=points.number_of_returns <= 1,
            sigma_m=np.empty((0, 3), np.float32),
            skipped=0,
        )
        cells.add(block)
    comparison.finish(grid)
    assert comparison.side_m == 2.0
    office = {(row["first"], row["second"]): row for row in compare(cells).rows}
    mine = {(row["first"], row["second"]): row for row in comparison.pairs}
    assert (1, 2) in mine
    assert (2, 3) in mine
    for pair in ((1, 2), (2, 3)):
        assert mine[pair]["cells"] == pytest.approx(office[pair]["cells"], rel=0.02)
        for name in ("mean_m", "rms_m", "median_m"):
            assert mine[pair][name] == pytest.approx(office[pair][name], abs=0.0011), name
    layers = read_map(tmp_path, grid)
    known = np.isfinite(layers["difference_m"])
    assert known.sum() * cell_m**2 == pytest.approx(4.0 * comparison.total.numbers()["cells"], rel=0.35)
    assert np.median(layers["difference_m"][known & (layers["strip"] == 2)]) == pytest.approx(-0.03, abs=0.003)
    assert layers["strips"].max() == 3


def test_a_strip_that_is_given_up_leaves_no_trace(tmp_path: Path) -> None:
    grid, comparison = CellGrid(2.0), StripComparison(2.0)
    points = strip_points(1, 0.0)
    edges = np.array([[points.time_ns[0], NEVER_NS, 1]])
    grid.add(points, HERE, METRES, edges)
    comparison.take(points, points.points_map, HERE, METRES, edges, grid)
    assert comparison.present()["strip"] == 1
    grid.forget_strip(1)
    comparison.drop(1)
    comparison.finish(grid)
    layers = read_map(tmp_path, grid)
    assert not layers["strip"].any()
    assert not layers["strips"].any()
    assert comparison.present() == {"strip": None, "cells": 0, "against": []}
    assert comparison.side_m is None, "nothing was compared or kept"


def test_differences_are_entered_in_cells_of_any_size(tmp_path: Path) -> None:
    """A tile of 64 fine cells is compared in 16 cells of 4 m; the map has cells of 1, 2, 4 or 8 m by then."""
    dz_m = np.full((16, 16), np.nan, np.float32)
    dz_m[0, 1], dz_m[1, 1], dz_m[15, 15] = 0.010, 0.030, -0.5
    for cell_m, count, first in ((1.0, 48, 0.010), (2.0, 12, 0.010), (4.0, 3, 0.010), (8.0, 2, 0.020)):
        grid = CellGrid(cell_m)
        grid.add(points_at(np.array([[-70.0, 70.0, 10.0]])), HERE, METRES)
        grid.set_differences(-128, 64, 1.0, 4.0, dz_m)
        grid.set_differences(-128, 64, 1.0, 4.0, 0.5 * dz_m)
        found = read_map(tmp_path / f"{cell_m:g}", grid)["difference_m"]
        assert np.isfinite(found).sum() == count
        # the tile's south-western corner lies at 128 m west, 64 m north of the origin
        up, across = round(64.0 / cell_m), int((-123.0 + 128.0 * cell_m) / cell_m)
        assert found[up, across] == pytest.approx(first, abs=1e-6)
        assert np.nanmin(found) == pytest.approx(-0.5)
