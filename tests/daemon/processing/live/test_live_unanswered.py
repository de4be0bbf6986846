"""Tests that pulses without a return are counted where their rays meet the ground, and silence is not."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray
from pyproj import Proj

from swath.daemon.processing.live import unanswered
from swath.daemon.processing.live.frame import LocalFrame
from swath.daemon.processing.live.grid import CellGrid
from swath.daemon.processing.live.tiles import Placement, TileReader
from swath.daemon.processing.live.unanswered import LONGEST_NS, UnansweredPulses
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.georeference import Georeferencer
from swath.georef.points import Points
from swath.georef.records import RETURN_DTYPE
from swath.georef.stream.stream import CONTEXT_FLAG
from swath.georef.trajectory.trajectory import Trajectory
from tests.daemon.builders import swath

pytestmark = pytest.mark.xdist_group("kernels")

HIGH_M, MS = 500.0, 1_000_000
NO_TRAJECTORY = cast(Trajectory, None)
FRAME = cast(LocalFrame, SimpleNamespace(of_points=lambda points: points))
PLAN = """
[flight]
name = "lake"
seed = 5
origin_deg = [47.482, 8.905]
speed_mps = 50.0
lead_s = 3.0
[gnss.rover]
ins = true
[scanner.left]
prf_hz = 30000
half_angle_deg = 30.0
[[line]]
name = "1"
from_m = [-300, 0]
to_m = [300, 0]
height_m = 800
[[terrain.water]]
center_m = [120.0, 60.0]
radius_m = 70.0
returns = 0.0
[[fault]]
source = "scanner/left"
kind = "silent"
at_s = {silent_s}
for_s = 1.0
"""


class Straight:
    """Georeferences rows that look down from `HIGH_M` at their encoder's angle; it flies 1 m north a millisecond."""

    model = SimpleNamespace(range_gate=(0.0, 1.0))

    def georeference(
        self, rows: NDArray[Any], time_ns: Int64Array, trajectory: object
    ) -> tuple[Points, NDArray[np.uint8]]:
        assert not (rows["flags"] & CONTEXT_FLAG).any()
        points = Points.empty(len(rows), with_sigmas=False)
        angle, north = rows["encoder_rad"], time_ns / MS
        points.points_map[:] = np.stack(
            [rows["range_m"] * np.sin(angle), north, HIGH_M - rows["range_m"] * np.cos(angle)], axis=1
        )
        points.time_ns[:], points.range_m[:] = time_ns, rows["range_m"]
        return points, np.zeros(len(rows), np.uint8)


def pulses(angles: FloatArray, time_ns: Int64Array) -> NDArray[Any]:
    rows = np.zeros(len(angles), RETURN_DTYPE)
    rows["encoder_rad"], rows["flags"] = angles, CONTEXT_FLAG
    assert len(angles) == len(time_ns)
    return rows


def returns(up_m: FloatArray, time_ns: Int64Array) -> Points:
    """Return points straight below at heights."""
    rows = np.zeros(len(up_m), RETURN_DTYPE)
    rows["range_m"] = HIGH_M - up_m
    return Straight().georeference(rows, time_ns, None)[0]


def test_a_pulse_meets_the_level_between_the_lowest_neighbours_before_and_after() -> None:
    """The shore rises from 10 m to 20 m; every second return there is from a tree. 80 and 160 ms of 401 have passed."""
    asked = UnansweredPulses(cast(Georeferencer, Straight()))
    before, after = np.arange(0, 100) * MS, np.arange(500, 600) * MS
    trees = np.where(np.arange(100) % 2, 25.0, 0.0)
    assert len(asked.places(returns(10.0 + trees, before), FRAME)) == 0
    time_ns = np.array([179, 259, 260, 700]) * MS
    angles = np.radians([10.0, 0.0, 100.0, 0.0])
    asked.take_pulses(pulses(angles, time_ns), time_ns, NO_TRAJECTORY)
    found = asked.places(returns(20.0 + trees, after), FRAME)
    level_m = 10.0 + 10.0 * np.array([80.0, 160.0]) / 401.0
    wanted = np.stack([(HIGH_M - level_m) * np.tan(angles[:2]), [179.0, 259.0], level_m], axis=1)
    np.testing.assert_allclose(found, wanted, atol=0.02)  # neither into the sky, nor before its neighbours are known
    assert len(asked.overdue(int(time_ns[-1]) + LONGEST_NS - 1, FRAME)) == 0
    late = asked.overdue(int(time_ns[-1]) + LONGEST_NS, FRAME)
    np.testing.assert_allclose(late, [[0.0, 700.0, 20.0]])
    assert asked.left_out == 0


def test_pulses_beyond_what_the_scanner_reaches_have_no_place() -> None:
    asked = UnansweredPulses(cast(Georeferencer, Straight()))
    time_ns = np.arange(100) * MS
    asked.places(returns(np.zeros(100), time_ns), FRAME)
    middle = np.array([50, 51]) * MS
    asked.take_pulses(pulses(np.radians([17.0, 19.0]), middle), middle, NO_TRAJECTORY)  # 500 m / cos is 523 m, 529 m
    found = asked.places(returns(np.zeros(100), time_ns + 100 * MS), FRAME)
    assert found[:, 1].tolist() == [50.0]


def test_pulses_that_wait_are_bounded_and_those_left_out_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unanswered, "MOST_WAITING", 250)
    asked = UnansweredPulses(cast(Georeferencer, Straight()))
    for block in range(4):
        time_ns = (100 * block + np.arange(100)) * MS
        asked.take_pulses(pulses(np.zeros(100), time_ns), time_ns, NO_TRAJECTORY)
    assert asked.left_out == 200
    assert len(asked.overdue(LONGEST_NS * 2, FRAME)) == 0  # nothing has told the ground's level
    assert asked.left_out == 400


def test_cells_count_pulses_without_a_return_up_to_what_they_hold() -> None:
    grid = CellGrid(2.0, tiles=1)
    grid.add_no_return(np.array([[3.0, 5.0, 7.0]] * 70_000 + [[4.0, 5.0, 7.0]]))
    grid.add_no_return(np.array([[-3.0, 5.0, 7.0]]))
    counts = grid._cells[0]["no_return"]
    assert (counts[2, 1], counts[2, 2], counts.sum(dtype=np.int64)) == (65_535, 1, 65_536)  # no second tile
    assert grid.has_changed
    grid.add_no_return(np.empty((0, 3)))


@pytest.mark.slow
def test_a_lake_is_told_from_a_gap_of_the_scanner(tmp_path: Path) -> None:
    """The lake is the plan's disc, placed by PROJ; in the second of silence there is neither point nor pulse."""
    (tmp_path / "plan.toml").write_text(PLAN.format(silent_s=14.0))
    done = swath("sim", "fly", str(tmp_path / "plan.toml"), "-o", str(tmp_path / "log"))
    assert done.returncode == 0, done.stderr
    done = swath("live", "--replay", str(tmp_path / "log"), "-o", str(tmp_path / "out"), "--accept-verdict")
    assert done.returncode == 0, done.stderr
    reader = TileReader(tmp_path / "out")
    reader.refresh()
    placement, extent = Placement.of(reader.index), reader.extent_m()
    assert placement is not None
    assert extent is not None
    view = reader.view(*extent, reader.cell_m, ("points", "no_return"))
    assert view is not None
    lon, lat = Proj(proj="aeqd", lat_0=47.482, lon_0=8.905)(120.0, 60.0, inverse=True)
    middle = placement.local(np.array([[lat, lon]]))[0]
    rows, columns = np.indices(view.shape)
    away_m = np.hypot(
        view.west_m + (columns + 0.5) * view.cell_m - middle[0], view.south_m + (rows + 0.5) * view.cell_m - middle[1]
    )
    points, no_return = view.layers["points"], view.layers["no_return"]
    water = (points == 0) & (no_return > 0)
    assert water[away_m < 66.0].mean() > 0.98
    assert water[away_m > 74.0].sum() < 0.01 * water.sum()
    west, east = (placement.local(np.array([[lat, lon]]))[0, 0] - 120.0 + at_m for at_m in (-140.0, -115.0))
    across = (view.west_m + columns * view.cell_m > west) & (view.west_m + columns * view.cell_m < east)
    silent = across & (np.abs(away_m) < 300.0) & (points == 0)
    assert silent.sum() > 500
    assert not no_return[silent].any()
