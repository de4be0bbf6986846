"""Tests that cells and differences of strips depend on the points alone, with one level everywhere."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from numpy.typing import NDArray
from pyproj import CRS

from swath.calib.strips.differences import single_return_sigma_m
from swath.daemon.cli import strips, view
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.quicklook.run import Look, look_at
from swath.daemon.processing.quicklook.strips import TILE, Overlap
from tests.daemon.builders import EAST_M, NORTH_M, plane, write_laz

pytestmark = pytest.mark.xdist_group("kernels")

Array = NDArray[Any]
Cloud = dict[str, Array]
LIFT_M = 0.03
ORDERS: dict[str, Callable[[Cloud, np.random.Generator], Array]] = {
    "by strip": lambda cloud, rng: np.lexsort((cloud["time"], cloud["strip"])),
    "shuffled": lambda cloud, rng: rng.permutation(len(cloud["x"])),
    "by x": lambda cloud, rng: np.argsort(cloud["x"], kind="stable"),
    "by time": lambda cloud, rng: np.argsort(cloud["time"], kind="stable"),
}


def flown(pulses_m2: float, seed: int = 3) -> Cloud:
    """Return two strips of 160 m × 100 m that overlap by 80 m, with alternating points.

    The west is a meadow, the east a wood with three returns per pulse. The second strip is 3 cm higher.
    """
    rng = np.random.default_rng(seed)
    parts = []
    for strip, south_m, lift_m in ((1, 0.0, 0.0), (2, 20.0, LIFT_M)):
        count = int(pulses_m2 * 160.0 * 100.0)
        x, y = EAST_M + rng.uniform(0.0, 160.0, count), NORTH_M + south_m + rng.uniform(0.0, 100.0, count)
        wood = x > EAST_M + 100.0
        times = np.where(wood, 3, 1)
        pulse = np.repeat(np.arange(count), times)
        number = np.arange(len(pulse)) - np.repeat(np.cumsum(times) - times, times) + 1
        z = plane(x, y)[pulse] + lift_m + rng.normal(0.0, 0.02, len(pulse)) + 5.0 * (times[pulse] - number)
        parts.append(
            (x[pulse], y[pulse], z, np.full(len(pulse), strip), number, times[pulse], 100.0 * strip + pulse * 1e-4)
        )
    columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    return dict(zip(("x", "y", "z", "strip", "number", "of", "time"), columns, strict=True))


def tiles(folder: Path, cloud: Cloud, order: Array, side_m: float = 70.0) -> Path:
    """Write the points as square tiles in this order."""
    folder.mkdir()
    cloud = {key: values[order] for key, values in cloud.items()}
    across, up = ((cloud[axis] - at) // side_m for axis, at in (("x", EAST_M), ("y", NORTH_M)))
    for tile in sorted(set(zip(across.tolist(), up.tolist(), strict=True))):
        own = (across == tile[0]) & (up == tile[1])
        part = {key: values[own] for key, values in cloud.items()}
        name = folder / f"tile_{tile[0]:.0f}_{tile[1]:.0f}.laz"
        columns = {"return_number": part["number"], "number_of_returns": part["of"], "gps_time": part["time"]}
        crs = CRS.from_epsg(25832)
        write_laz(name, part["x"], part["y"], part["z"], part["strip"].astype(np.uint16), crs=crs, **columns)
    return folder


def places_of(look: Look) -> set[tuple[float, float]]:
    """Return the centres of the compared cells, on the map."""
    assert look.overlap.best is not None
    return set(map(tuple, look.cells.frame.centres(look.overlap.best.row, look.overlap.best.column).tolist()))


def row_of(look: Look) -> dict[str, Any]:
    """Return the row of the pair as strip 1 minus strip 2."""
    (row,) = look.overlap.rows
    sign = 1.0 if look.names[row["first"]] == "1" else -1.0
    return row | {key: sign * row[key] for key in ("mean_m", "median_m")}


def run(command: Any, *arguments: str) -> None:
    """Run a command in this process."""
    app = typer.Typer()
    app.command()(command)
    app(args=list(arguments), standalone_mode=False)


@pytest.mark.slow
def test_tiles_in_any_order_give_the_same_cells_and_differences(tmp_path: Path) -> None:
    """All returns of both strips have 18 per square metre; one strip's single returns on the meadow have 5."""
    cloud, rng = flown(5.0), np.random.default_rng(1)
    looks = {name: look_at([tiles(tmp_path / name, cloud, order(cloud, rng))]) for name, order in ORDERS.items()}
    looks["one file"] = look_at([tiles(tmp_path / "whole", cloud, ORDERS["shuffled"](cloud, rng), 1000.0)])
    first = looks["by strip"]
    assert first.cells.frame.cell_m == 2.0
    assert first.overlap.compared_cells == pytest.approx(100.0 * 80.0 / 4.0, rel=0.1)  # the meadow's overlap
    for name, look in looks.items():
        assert look.cells.frame.cell_m == 2.0, name
        assert places_of(look) == places_of(first), name
        for key in ("mean_m", "median_m", "rms_m", "max_m"):
            assert row_of(look)[key] == pytest.approx(row_of(first)[key], abs=1e-6), (name, key)
        assert look.agreement.best == first.agreement.best == "QL0", name


@pytest.mark.slow
@pytest.mark.parametrize(("pulses_m2", "cell_m"), [(1.2, 4.0), (5.0, 2.0), (10.0, 1.0)])
def test_cells_contain_enough_returns_at_any_density_and_thinning(
    tmp_path: Path, pulses_m2: float, cell_m: float
) -> None:
    """A plane through n returns is accurate to 2 cm / √n, so the mean over all cells is known to 0.3 mm."""
    cloud = flown(pulses_m2)
    order = ORDERS["shuffled"](cloud, np.random.default_rng(2))
    thin = order[np.arange(len(order)) % 7 != 0]  # returns are left out, not pulses
    for name, chosen in (("all", order), ("thinned", thin)):
        look = look_at([tiles(tmp_path / name, cloud, chosen)])
        assert look.cells.frame.cell_m == cell_m
        assert row_of(look)["mean_m"] == pytest.approx(-LIFT_M, abs=1e-3)
        assert look.agreement.judged


def test_the_density_is_that_of_single_returns_of_each_strip_on_open_ground(tmp_path: Path) -> None:
    look = look_at([tiles(tmp_path / "t", flown(6.0), ORDERS["by x"](flown(6.0), np.random.default_rng(0)))])
    assert look.cells.single_densities() == pytest.approx([6.0, 6.0], rel=0.05)
    assert look.density == pytest.approx(6.0 * 2 * 100.0 / 120.0, rel=0.05)  # pulses of both strips


def test_a_cell_size_given_by_the_user_is_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cloud = flown(5.0)
    folder = tiles(tmp_path / "t", cloud, np.arange(len(cloud["x"])))
    run(strips.command, str(folder), "--cell", "4", "--json")
    record = json.loads(capsys.readouterr().out)
    assert (record["cell_m"], record["quality"]["cell_m"]) == (4.0, 4.0)
    assert "cells of 4 m" in record["quality"]["measure"]
    seen = look_at([folder], cell_m=4.0).agreement  # as of swath view --cell 4
    assert seen.record()["rmsdz_m"] == pytest.approx(record["quality"]["rmsdz_m"], abs=1e-6)
    with pytest.raises(UserError, match=r"--cell: got 0, want 0.05 to 100 metres") as caught:
        run(strips.command, str(folder), "--cell", "0")
    assert caught.value.exit_code == ExitCode.USAGE


@pytest.mark.slow
def test_few_cells_give_no_verdict_but_advice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A meadow of 14 m × 80 m has hundreds of square metres but only dozens of cells."""
    cloud = flown(5.0)
    near = cloud["x"] < EAST_M + 14.0
    small = tiles(tmp_path / "small", cloud, np.flatnonzero(near & (cloud["y"] < NORTH_M + 50.0)))
    with pytest.raises(UserError) as caught:
        run(strips.command, str(small), "--level", "QL3")
    assert caught.value.exit_code == ExitCode.PROBLEM
    told = capsys.readouterr().out
    assert re.search(r"no verdict: .* cells of 2 m in \d place.*a verdict needs 100 in 3", told)
    assert str(caught.value).startswith("add tiles with smooth open ground where strips overlap")
    assert "strips meet" not in told
    assert "RMSDz" in told
    run(view.command, str(small), "-o", str(tmp_path / "view"), "--json")
    quality = json.loads(capsys.readouterr().out)["quality"]
    assert (quality["best"], quality["levels"]) == (None, [])
    assert quality["cells"] < 100 or quality["places"] < 3
    assert "no verdict" in (tmp_path / "view" / "index.html").read_text()


def test_cells_of_one_patch_are_one_place() -> None:
    patches = {"one": [(20, 20)], "three": [(4, 4), (4, 40), (40, 4)]}
    found = {}
    for name, corners in patches.items():
        worst = np.full((4 * TILE, 4 * TILE), np.nan, np.float32)
        for row, column in corners:
            worst[row : row + 6, column : column + 6] = 0.01
        found[name] = Overlap(worst).places
    assert found == {"one": 1, "three": 3}


@pytest.mark.parametrize("noise_m", [0.02, 0.08])
def test_repeatability_equals_the_noise_beyond_the_compared_cells(noise_m: float) -> None:
    """From 3600 planes through 16 returns the quartile of variances is known to 1 %, its root to half of that."""
    count = np.full(3600, 16.0)
    variance = noise_m**2 * np.random.default_rng(4).chisquare(13, 3600) / 13.0
    variance[::3] *= 9.0  # a third of the cells have vegetation
    assert single_return_sigma_m(variance[np.arange(3600) % 3 > 0], count[:2400]) == pytest.approx(noise_m, rel=0.02)
    assert noise_m < single_return_sigma_m(variance, count) < 1.1 * noise_m
