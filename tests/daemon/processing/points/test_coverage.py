"""Tests the ground that points cover: areas of known shapes, holes, overlapping strips, other units."""

from __future__ import annotations

import numpy as np
import pytest

from swath.daemon.processing.points import coverage
from swath.daemon.processing.points.coverage import Coverage, area_of_all_m2
from swath.georef.arrays import FloatArray


def lattice(west: float, south: float, width: float, height: float) -> tuple[FloatArray, FloatArray]:
    """Return a point a metre; edges lie amid cells, as those of strips do on average."""
    x, y = np.meshgrid(west + 2.0 + np.arange(0.5, width), south + 2.0 + np.arange(0.5, height))
    return x.ravel(), y.ravel()


def covered(*blocks: tuple[FloatArray, FloatArray], unit_m: float = 1.0) -> Coverage:
    """Return the coverage of points that come block by block."""
    found = Coverage(unit_m)
    for x, y in blocks:
        found.add(x / unit_m, y / unit_m)
    return found


@pytest.mark.parametrize("west", [0.0, -3.3, 641_001.7])
def test_the_area_of_a_rectangle_is_its_own_within_its_edge(west: float) -> None:
    found = covered(lattice(west, 5_210_003.2, 400.0, 300.0)).covered()
    assert found is not None
    assert found.area_m2 == pytest.approx(120_000.0, rel=0.01)


def test_the_order_of_blocks_and_the_unit_do_not_matter() -> None:
    parts = [lattice(1000.0 * index, 500.0 * index, 200.0, 100.0) for index in range(4)]
    areas = [
        one.area_m2
        for order, unit_m in ((parts, 1.0), (parts[::-1], 1.0), (parts, 0.3048))
        if (one := covered(*order, unit_m=unit_m).covered()) is not None
    ]
    assert areas[0] == areas[1]
    assert areas == pytest.approx([80_000.0] * 3, rel=0.03)


def test_a_lake_is_not_covered() -> None:
    x, y = lattice(0.0, 0.0, 400.0, 400.0)
    dry = (np.abs(x - 202.0) > 100.0) | (np.abs(y - 202.0) > 100.0)
    found = covered((x[dry], y[dry])).covered()
    assert found is not None
    assert found.area_m2 == pytest.approx(120_000.0, rel=0.01)


def test_ground_that_strips_share_counts_once() -> None:
    one, two = (covered(lattice(west, -52.0, 300.0, 200.0)).covered() for west in (-100.0, 100.0))
    assert one is not None
    assert two is not None
    assert one.area_m2 + two.area_m2 == pytest.approx(120_000.0, rel=0.01)
    assert area_of_all_m2([one, two, None]) == pytest.approx(100_000.0, rel=0.01)
    assert area_of_all_m2([None]) is None


def test_no_points_and_too_much_ground_have_no_area(monkeypatch: pytest.MonkeyPatch) -> None:
    assert covered().covered() is None
    monkeypatch.setattr(coverage, "MOST_CELLS", 50_000)
    assert covered(lattice(0.0, 0.0, 10.0, 10.0)).covered() is not None
    assert covered(lattice(0.0, 0.0, 10.0, 10.0), lattice(9000.0, 0.0, 10.0, 10.0)).covered() is None
