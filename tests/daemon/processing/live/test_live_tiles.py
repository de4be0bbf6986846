"""Tests the map's tile files against bytes laid out by hand, and the reader against NumPy and against damaged files."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from swath.daemon.config.tables import LiveConfig
from swath.daemon.processing.live.grid import CellGrid
from swath.daemon.processing.live.painting import HERE, METRES
from swath.daemon.processing.live.products import LiveProducts
from swath.daemon.processing.live.tiles import FILE_BYTES, INDEX, SIDE, TILES, TileFolder, TileReader
from swath.georef.arrays import FloatArray
from swath.georef.timescales.gps_time import SECOND_NS
from tests.daemon.processing.live.builders import GPS_NS, Utm, flight, points_at

pytestmark = pytest.mark.xdist_group("kernels")

STRIPS = np.array([[GPS_NS, GPS_NS + SECOND_NS, 7], [GPS_NS + 2 * SECOND_NS, GPS_NS + 9 * SECOND_NS, 8]])


def written(folder: Path, grid: CellGrid, tiles: TileFolder | None = None) -> TileReader:
    """Write what has changed, and return a reader that has read the index."""
    tiles = tiles or TileFolder(folder)
    tiles.write(grid.take_changed(), {"cell_m": grid.cell_m})
    reader = TileReader(folder)
    assert reader.refresh()
    return reader


def some(count: int, low_m: float, high_m: float, seed: int = 1) -> FloatArray:
    """Return places on a slope, in a square."""
    places = np.random.default_rng(seed).uniform(low_m, high_m, (count, 3))
    places[:, 2] = 0.1 * places[:, 0] + 250.0
    return places


def test_a_tile_has_the_layout_that_the_page_states(tmp_path: Path) -> None:
    """The offsets are those of docs/live.md: 64 bytes of head, then one plane of cells after the other."""
    grid = CellGrid(2.0)
    places = np.array([[3.0, -1.0, 50.0], [3.5, -1.5, 51.0], [2.5, -0.5, 49.0], [3.1, -1.1, 50.4]])
    times = GPS_NS + np.array([0, SECOND_NS // 2, 2 * SECOND_NS, 3 * SECOND_NS])
    points = points_at(places, times)
    points.return_number[1] = 2
    grid.add(points, HERE, METRES, STRIPS)
    written(tmp_path, grid)
    data = (tmp_path / TILES / "0_-1.tile").read_bytes()
    assert len(data) == FILE_BYTES == 64 + 23 * SIDE * SIDE
    head = struct.unpack_from("<4sHHiiIIdQdI", data)
    assert head == (b"SWTL", 1, 64, 0, -1, 1, 128, 2.0, 1, 50.0, GPS_NS // SECOND_NS)
    cell, cells = 127 * SIDE + 1, SIDE * SIDE  # the row just south of the origin is the tile's last
    found, at = [], 64
    for kind in "IHfhhHHhHB":
        found.append(struct.unpack_from(f"<{kind}", data, at + cell * struct.calcsize(kind))[0])
        at += cells * struct.calcsize(kind)
    assert at == len(data)
    points_, pulses, height, lowest, highest, seconds, strip, difference, no_return, strips = found
    assert (points_, pulses, lowest, highest, seconds, strip, no_return, strips) == (4, 3, -100, 100, 4, 8, 0, 2)
    assert height == pytest.approx(50.1, abs=1e-4)
    assert difference == -32768


def test_the_reader_gives_what_was_painted(tmp_path: Path) -> None:
    grid, places = CellGrid(1.0), some(40_000, -150.0, 150.0)
    times = GPS_NS + np.arange(len(places)) * 100_000
    for piece in (slice(0, 15_000), slice(15_000, None)):
        grid.add(points_at(places[piece], times[piece]), HERE, METRES, STRIPS)
    reader = written(tmp_path, grid)
    view = reader.view(-150.0, -150.0, 150.0, 150.0, 1.0)
    assert view is not None
    assert (view.west_m, view.south_m, view.cell_m, view.shape) == (-150.0, -150.0, 1.0, (300, 300))
    across, up = np.floor(places[:, 0]).astype(int) + 150, np.floor(places[:, 1]).astype(int) + 150
    count = np.zeros((300, 300), int)
    np.add.at(count, (up, across), 1)
    total = np.zeros((300, 300))
    np.add.at(total, (up, across), places[:, 2])
    low, high = np.full((300, 300), np.inf), np.full((300, 300), -np.inf)
    np.minimum.at(low, (up, across), places[:, 2])
    np.maximum.at(high, (up, across), places[:, 2])
    newest = np.zeros((300, 300), int)
    np.maximum.at(newest, (up, across), times // SECOND_NS)
    there = count > 0
    layers = view.layers
    np.testing.assert_array_equal(layers["points"], count)
    np.testing.assert_array_equal(layers["gps_s"], newest)
    np.testing.assert_allclose(layers["height_m"][there], (total[there] / count[there]), atol=2e-4)
    np.testing.assert_allclose(layers["lowest_m"][there], low[there], atol=0.0051)
    np.testing.assert_allclose(layers["highest_m"][there], high[there], atol=0.0051)
    assert np.isnan(layers["height_m"][~there]).all()
    assert np.isnan(layers["lowest_m"][~there]).all()
    in_strip = np.zeros((300, 300, 2), bool)
    np.logical_or.at(in_strip[..., 0], (up, across), times < STRIPS[0, 1])
    np.logical_or.at(in_strip[..., 1], (up, across), times >= STRIPS[1, 0])
    np.testing.assert_array_equal(layers["strips"], in_strip.sum(axis=2))
    np.testing.assert_array_equal(layers["strip"], np.where(in_strip[..., 1], 8, np.where(in_strip[..., 0], 7, 0)))


@pytest.mark.parametrize("step", [2, 4, 16, 128])
def test_joined_cells_are_sums_means_and_extremes(tmp_path: Path, step: int) -> None:
    grid, places = CellGrid(1.0), some(30_000, -100.0, 400.0)
    grid.add(points_at(places), HERE, METRES)
    view = written(tmp_path, grid).view(-1e6, -1e6, 1e6, 1e6, step + 0.5)
    assert view is not None
    assert (view.cell_m, view.west_m, view.south_m) == (step, -128.0, -128.0)
    rows, columns = view.shape
    across = np.floor((places[:, 0] + 128.0) / step).astype(int)
    up = np.floor((places[:, 1] + 128.0) / step).astype(int)
    count, total = np.zeros((rows, columns), int), np.zeros((rows, columns))
    np.add.at(count, (up, across), 1)
    np.add.at(total, (up, across), places[:, 2])
    low = np.full((rows, columns), np.inf)
    np.minimum.at(low, (up, across), places[:, 2])
    np.testing.assert_array_equal(view.layers["points"], count)
    there = count > 0
    np.testing.assert_allclose(view.layers["height_m"][there], total[there] / count[there], atol=1e-3)
    np.testing.assert_allclose(view.layers["lowest_m"][there], low[there], atol=0.0051)


def test_only_changed_tiles_are_written_and_named(tmp_path: Path) -> None:
    grid, tiles = CellGrid(1.0), TileFolder(tmp_path)
    grid.add(points_at(some(100, 0.0, 300.0)), HERE, METRES)
    reader = written(tmp_path, grid, tiles)
    assert set(reader.changed().values()) == {1}
    before = reader.view(0.0, 0.0, 300.0, 300.0, 8.0)
    grid.add(points_at(some(100, 10.0, 20.0)), HERE, METRES)
    tiles.write(grid.take_changed(), {"cell_m": 1.0})
    assert reader.refresh()
    assert not reader.refresh()
    assert reader.changed(1) == {(0, 0): 2}
    after = reader.view(0.0, 0.0, 300.0, 300.0, 8.0)
    assert before is not None
    assert after is not None
    assert int(after.layers["points"].sum()) == int(before.layers["points"].sum()) + 100
    assert reader.view(500.0, 0.0, 600.0, 100.0, 1.0) is None


def test_a_new_run_and_wider_cells_replace_the_tiles_before(tmp_path: Path) -> None:
    grid, tiles = CellGrid(1.0, tiles=4), TileFolder(tmp_path)
    grid.add(points_at(some(500, 0.0, 200.0)), HERE, METRES)
    reader = written(tmp_path, grid, tiles)
    old = (tmp_path / TILES / "1_1.tile").read_bytes()
    grid.add(points_at(some(500, 200.0, 400.0)), HERE, METRES)
    tiles.renew()
    tiles.write(grid.take_changed(), {"cell_m": grid.cell_m})
    assert reader.tile((1, 1)) is None, "the reader knows another generation"
    reader.refresh()
    assert (reader.generation, reader.cell_m) == (2, 2.0)
    assert sorted(path.name for path in (tmp_path / TILES).iterdir()) == [
        "0_0.tile", "0_1.tile", "1_0.tile", "1_1.tile", INDEX,
    ]  # fmt: skip
    (tmp_path / TILES / "1_1.tile").write_bytes(old)
    assert reader.tile((1, 1)) is None, "an outdated tile"
    assert written(tmp_path, CellGrid(1.0)).generation == 3
    assert sorted(path.name for path in (tmp_path / TILES).iterdir()) == [INDEX]


def test_damaged_files_are_counted_and_left_out(tmp_path: Path) -> None:
    grid = CellGrid(1.0)
    grid.add(points_at(some(500, 0.0, 250.0)), HERE, METRES)
    reader = written(tmp_path, grid)
    good = (tmp_path / TILES / "0_0.tile").read_bytes()
    cuts = [b"", good[:30], good[:-1], b"X" + good[1:], good[:4] + b"\2" + good[5:], good + b"\0"]
    for number, data in enumerate(cuts, start=1):
        (tmp_path / TILES / "0_0.tile").write_bytes(data)
        view = reader.view(0.0, 0.0, 250.0, 250.0, 1.0)
        assert view is not None
        assert (reader.unreadable, int(view.layers["points"][:128, :128].sum())) == (number, 0)
    index = json.loads((tmp_path / TILES / INDEX).read_text())
    broken = [b"", b"[]", b"{", b'{"version":2}', json.dumps(index | {"cell_m": "wide"}).encode()]
    for data in broken:
        (tmp_path / TILES / INDEX).write_bytes(data)
        fresh = TileReader(tmp_path)
        assert not fresh.refresh()
        assert (fresh.extent_m(), fresh.changed(), fresh.view(0, 0, 1, 1, 1)) == (None, {}, None)
    index["tiles"] |= {"a_b": 1, "9_9": "x"}
    (tmp_path / TILES / INDEX).write_text(json.dumps(index))
    fresh = TileReader(tmp_path)
    assert fresh.refresh()
    assert (9, 9) not in fresh.changed()
    assert fresh.view(-1e4, -1e4, 1e4, 1e4, 1.0) is not None


def test_the_map_keeps_to_its_quota_and_to_free_space(tmp_path: Path) -> None:
    trajectory = flight()
    position = Utm().map_from_e(trajectory.position_e)[-1]
    points = points_at(position + some(3000, -300.0, 300.0))
    products = LiveProducts(tmp_path / "small", LiveConfig(live_quota_mb=2.0), Utm(), 0, "EPSG:32632")
    products.take("left", points, trajectory, SECOND_NS)
    products.save_map({}, SECOND_NS)
    products.close()
    assert products.map.trouble.startswith("tiles: live_quota_mb is used up")
    assert sum(path.stat().st_size for path in (tmp_path / "small" / TILES).glob("*.tile")) <= 1_000_000
    full = LiveProducts(tmp_path / "full", LiveConfig(), Utm(), 1 << 60, "EPSG:32632")
    full.look_for_room()
    full.take("left", points, trajectory, SECOND_NS)
    full.save_map({}, SECOND_NS, last=True)
    assert list((tmp_path / "full").iterdir()) == []
