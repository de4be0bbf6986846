"""Tests that the map's pictures show each cell at its place: colours, gaps, water."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from swath.daemon.console.painting import GAP, PIXELS, RAMPS, WATER, Painter, coloured, gaps, shade
from swath.daemon.processing.live.tiles import SIDE
from tests.daemon.console.builders import write_map


def picture_of(painter: Painter, layer: str, zoom: int, x: int, y: int) -> np.ndarray:
    image = np.asarray(Image.open(io.BytesIO(painter.picture(layer, zoom, x, y))))
    assert image.shape == (PIXELS, PIXELS, 4)
    return image


def test_a_cell_is_painted_where_it_lies(tmp_path: Path) -> None:
    """At zoom 0 a pixel is a metre wide: row 0 of the square −1 lies below 256 m north."""
    points = np.zeros((SIDE, SIDE), np.uint32)
    points[20, 30] = 3
    height = np.full((SIDE, SIDE), np.nan, np.float32)
    height[20, 30] = 5.0
    write_map(tmp_path, {(1, 0): {"points": points, "height": height}})
    painter = Painter(tmp_path)
    painter.legend()
    for layer in RAMPS:
        if layer == "difference":
            continue
        rows, columns = np.nonzero(picture_of(painter, layer, 0, 0, -1)[..., 3])
        assert (rows.tolist(), columns.tolist()) == ([255 - 20], [128 + 30]), layer
    at_half = picture_of(painter, "density", 1, 1, -1)  # 0.5 m pixels, from 128 m east, up to 128 m north
    rows, columns = np.nonzero(at_half[..., 3])
    assert sorted(set(rows)) == [255 - 41, 255 - 40]
    assert sorted(set(columns)) == [60, 61]
    coarse = picture_of(painter, "density", -2, 0, -1)
    rows, columns = np.nonzero(coarse[..., 3])
    assert (rows.tolist(), columns.tolist()) == ([255 - 5], [32 + 7])
    assert not picture_of(painter, "density", 0, 5, 5).any()


def test_density_is_coloured_by_class(tmp_path: Path) -> None:
    points = np.zeros((SIDE, SIDE), np.uint32)
    points[0, :7] = [1, 2, 4, 8, 16, 32, 200]
    write_map(tmp_path, {(0, 0): {"points": points}})
    row = picture_of(Painter(tmp_path), "density", 0, 0, -1)[255, :7, :3]
    wanted = [RAMPS["density"][k] for k in (1, 2, 3, 4, 5, 6, 6)]
    assert ["#" + bytes(pixel).hex() for pixel in row] == wanted


def test_gaps_are_red_and_water_is_not(tmp_path: Path) -> None:
    points = np.ones((SIDE, SIDE), np.uint32)
    no_return = np.zeros((SIDE, SIDE), np.uint16)
    points[40:50, 40:50] = 0
    points[80:90, 80:90] = 0
    no_return[80:90, 80:90] = 2
    points[100:, :] = 0  # beyond the edge of what was flown
    write_map(tmp_path, {(0, 0): {"points": points, "no_return": no_return}})
    image = picture_of(Painter(tmp_path), "density", 0, 0, -1)
    is_gap = (image == GAP).all(axis=-1)
    is_water = (image == WATER).all(axis=-1)
    assert (is_gap.sum(), is_water.sum()) == (100, 100)
    assert is_gap[255 - 49 : 255 - 39, 40:50].all()
    assert is_water[255 - 89 : 255 - 79, 80:90].all()
    assert not image[: 255 - 99].any()


def test_a_picture_is_painted_anew_when_its_tiles_change(tmp_path: Path) -> None:
    one = np.ones((SIDE, SIDE), np.uint32)
    write_map(tmp_path, {(0, 0): {"points": one}})
    painter = Painter(tmp_path)
    before = painter.picture("density", 0, 0, -1)
    assert painter.picture("density", 0, 0, -1) is before
    write_map(tmp_path, {(0, 0): {"points": 9 * one}})
    assert painter.picture("density", 0, 0, -1) != before


def test_a_gap_has_points_on_both_sides_within_reach() -> None:
    row = np.array([[1, 0, 0, 1, 0, 0, 0, 1, 0]], bool)
    assert gaps(row, 2).astype(int).tolist() == [[0, 1, 1, 0, 0, 0, 0, 0, 0]]
    assert gaps(row.T, 3).astype(int).ravel().tolist() == [0, 1, 1, 0, 1, 1, 1, 0, 0]


def test_slopes_towards_the_light_are_bright_and_level_ground_is_even() -> None:
    steps = np.arange(8.0)
    level = shade(np.zeros((8, 8)), 1.0)
    assert level.min() == level.max()
    facing_west, facing_east = (shade(np.tile(sign * steps, (8, 1)), 1.0)[4, 4] for sign in (0.5, -0.5))
    assert facing_west > level[4, 4] > facing_east  # the light comes from north-west
    facing_north = shade(np.tile(0.5 * steps[:, None], (1, 8)), 1.0)[4, 4]  # rows run southwards: it rises southwards
    assert facing_north > level[4, 4]


@pytest.mark.parametrize("ramp", sorted(RAMPS))
def test_ramps_begin_and_end_with_their_colours(ramp: str) -> None:
    image = coloured(ramp, np.array([[0.0, 1.0, np.nan, -3.0]]))[0]
    assert ["#" + bytes(pixel[:3]).hex() for pixel in image[:2]] == [RAMPS[ramp][0], RAMPS[ramp][-1]]
    assert image[2, 3] == 0
    assert image[3].tolist() == image[0].tolist()


def test_lines_are_placed_by_the_index_of_the_map(tmp_path: Path) -> None:
    """One degree is a kilometre north or east here, by the index's own polynomials."""
    painter = Painter(tmp_path)
    geometry = {"lines": {"4": [[47.0, 9.0, None], [47.5, 9.25, 800.0]]}, "area": [[[[46.0, 8.0], [47.0, 10.0]]]]}
    assert painter.local_m(geometry) is None
    linear = np.zeros((2, 10))
    linear[0, 2] = linear[1, 1] = 1.0  # constant, first, second angle, …: east follows longitude
    placement = {
        "about_deg": [47.0, 9.0],
        "about_m": [100.0, 200.0],
        "to_geodetic": linear.tolist(),
        "to_local": linear.tolist(),
    }
    write_map(tmp_path, {(0, 0): {"points": np.ones((SIDE, SIDE), np.uint32)}}, placement=placement)
    painter.legend()
    assert painter.local_m(geometry) == {
        "lines": {"4": [[100.0, 200.0], [350.0, 700.0]]},
        "area": [[[[-900.0, -800.0], [1100.0, 200.0]]]],
    }
