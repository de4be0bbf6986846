"""Tests that strips side by side have different colours, for colour-blind readers too."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from swath.georef.arrays import BoolArray, FloatArray
from swath.georef.strip_colours import PALETTE, colours_of, contact

# Machado, Oliveira and Fernandes 2009: complete protanopia, deuteranopia, tritanopia, in linear RGB
SEEN = {
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def blocks(count: int, columns: int, width: int, step: int) -> BoolArray:
    """Return strips of a width, each a step east of the one before."""
    occupied = np.zeros((count, 4, columns), bool)
    for number in range(count):
        occupied[number, :, number * step : number * step + width] = True
    return occupied


def lab(colour: FloatArray) -> FloatArray:
    """Return CIE L*a*b* of linear RGB under D65."""
    xyz = XYZ @ np.clip(colour, 0.0, 1.0) / [0.9505, 1.0, 1.089]
    root = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * root[1] - 16, 500 * (root[0] - root[1]), 200 * (root[1] - root[2])])


def test_cells_shared_and_touching_are_counted() -> None:
    touching = contact(blocks(3, 12, 4, 4))
    assert touching[0, 1] == touching[1, 0] == 8.0  # 4 rows on either side of the border
    assert touching[0, 2] == 0.0
    assert contact(blocks(2, 12, 4, 6))[0, 1] == 0.0


@pytest.mark.parametrize(("width", "step"), [(10, 10), (10, 6), (30, 6)])
def test_forty_strips_side_by_side_and_a_cross_strip_differ_from_their_neighbours(width: int, step: int) -> None:
    occupied = blocks(40, 40 * step + width, width, step)
    across = np.zeros((1, *occupied.shape[1:]), bool)
    across[0, 1:3] = True
    touching = contact(np.concatenate([occupied, across]))
    colours = colours_of(touching)
    same = [(a, b) for a, b in combinations(range(41), 2) if touching[a, b] > 0.0 and colours[a] == colours[b]]
    assert same == []


def test_few_strips_all_have_different_colours() -> None:
    assert colours_of(np.zeros((5, 5))) == list(PALETTE[:5])


def test_where_more_strips_meet_than_there_are_colours_the_least_shared_ground_decides() -> None:
    count = len(PALETTE) + 1
    touching = np.full((count, count), 100.0)
    touching[0, count - 1] = touching[count - 1, 0] = 1.0
    np.fill_diagonal(touching, 0.0)
    colours = colours_of(touching)
    assert colours[0] == colours[-1]
    assert len(set(colours)) == len(PALETTE)


@pytest.mark.parametrize("sight", ["full", *SEEN])
def test_the_palette_is_told_apart_by_colour_blind_readers(sight: str) -> None:
    srgb = np.array([to_rgb(colour) for colour in PALETTE])
    linear = np.where(srgb > 0.04045, ((srgb + 0.055) / 1.055) ** 2.4, srgb / 12.92)
    seen = [lab(np.array(SEEN.get(sight, np.eye(3))) @ colour) for colour in linear]
    nearest = min(float(np.linalg.norm(a - b)) for a, b in combinations(seen, 2))
    assert nearest > 15.0  # the eye notices about 2.3
