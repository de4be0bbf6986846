"""Tests ``swath georef --write-dropped``: returns beyond the gate are withheld points, others are listed."""

from __future__ import annotations

import csv
import gzip
import json
from collections import Counter
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from pyproj import Transformer

from swath.daemon.cli.main import run_app
from swath.georef.formats.trajectory.csv import csv_text
from tests.daemon.builders import digests
from tests.daemon.one_line import Flown, fly

pytestmark = [pytest.mark.xdist_group("kernels"), pytest.mark.slow]

S = 1_000_000_000
GATE_M = (310.0, 330.0)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Return a flight with a narrow range gate, whose trajectory ends early."""
    made = fly(tmp_path_factory.mktemp("line"))
    config = made.folder / "swath.toml"
    text = config.read_text()
    for key, value, gate in (("min", "20.0", GATE_M[0]), ("max", "3000.0", GATE_M[1])):
        assert f"range_{key}_m = {value}" in text
        text = text.replace(f"range_{key}_m = {value}", f"range_{key}_m = {gate}")
    config.write_text(text)
    first, last = (int(made.truth["left.gps_ns"][at]) for at in (0, -1))
    (made.folder / "short.csv").write_text(csv_text(made.trajectory().between(first - 20 * S, last - 3 * S)))
    middle = (first + last) // 2
    (made.folder / "halves.csv").write_text(f"start_gps_ns,end_gps_ns\n{first},{middle}\n{middle},{last + S}\n")
    return made


def made_of(flown: Flown, output: Path, *more: str) -> dict[str, Any]:
    """Return the sidecar of a run over two strips, which is partial."""
    config, strips = str(flown.folder / "swath.toml"), str(flown.folder / "halves.csv")
    arguments = flown.arguments(output, "--config", config, "--strips", strips, *more)
    arguments[arguments.index("--trajectory") + 1] = str(flown.folder / "short.csv")
    assert run_app(arguments) == 1
    told: dict[str, Any] = json.loads(next(output.glob("*.json")).read_text())
    return told


@pytest.fixture(scope="module")
def asked(flown: Flown, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    output = tmp_path_factory.mktemp("asked")
    return output, made_of(flown, output, "--write-dropped")


def listed(path: Path) -> list[dict[str, str]]:
    with gzip.open(path, "rt") as file:
        return list(csv.DictReader(file))


def test_every_return_is_a_point_a_withheld_point_or_a_listed_row(
    flown: Flown, asked: tuple[Path, dict[str, Any]]
) -> None:
    output, told = asked
    dropped = told["counts"]["left"]["dropped"]
    assert set(dropped) == {"below_range_gate", "above_range_gate", "outside_trajectory"}
    assert min(dropped.values()) > 1000
    files = [laspy.read(output / strip["file"]) for strip in told["strips"]]
    withheld = sum(int(np.asarray(las.withheld).sum()) for las in files)
    rows = [row for strip in told["strips"] if strip["dropped_file"] for row in listed(output / strip["dropped_file"])]
    assert withheld == sum(strip["withheld"] for strip in told["strips"])
    assert withheld == dropped["below_range_gate"] + dropped["above_range_gate"]
    assert len(rows) == sum(strip["dropped_rows"] for strip in told["strips"]) == dropped["outside_trajectory"]
    assert sum(map(len, files)) + len(rows) == told["counts"]["left"]["read"] == len(flown.truth["left.gps_ns"])
    assert [strip["dropped_file"] for strip in told["strips"]] == [None, f"{flown.name}_strip02.dropped.csv.gz"]
    assert told["options"]["write_dropped"]


def test_withheld_points_exceed_the_gate_and_match_the_truth(flown: Flown, asked: tuple[Path, dict[str, Any]]) -> None:
    output, told = asked
    truth = flown.truth
    files = [laspy.read(output / strip["file"]) for strip in told["strips"]]
    points, times, numbers, flags = (
        np.concatenate([np.asarray(getattr(las, name)) for las in files])
        for name in ("xyz", "gps_time", "return_number", "withheld")
    )
    mine = np.lexsort((numbers, times))
    of_time = np.lexsort((truth["left.return_number"], truth["left.gps_ns"]))[: len(mine)]
    to_map = Transformer.from_crs("EPSG:4978", "EPSG:32632", always_xy=True)
    expected = np.stack(to_map.transform(*truth["left.point_e"][of_time].T), axis=1)
    assert np.abs(points[mine] - expected).max() < 0.002
    range_m = truth["left.range_m"][of_time]
    beyond = (range_m < GATE_M[0]) | (range_m > GATE_M[1])
    sure = np.minimum(abs(range_m - GATE_M[0]), abs(range_m - GATE_M[1])) > 0.001
    assert np.array_equal(flags[mine][sure] != 0, beyond[sure])
    assert 0.99 < sure.mean()


def test_listed_rows_contain_the_known_values(flown: Flown, asked: tuple[Path, dict[str, Any]]) -> None:
    output, told = asked
    rows = listed(output / told["strips"][1]["dropped_file"])
    assert Counter(row["reason"] for row in rows) == {"outside_trajectory": len(rows)}
    assert {row["scanner"] for row in rows} == {"left"}
    truth = flown.truth
    last = np.sort(truth["left.gps_ns"])[-len(rows) :]
    assert np.abs(np.sort([int(row["gps_ns"]) for row in rows]) - last).max() < 200
    near = truth["left.range_m"].min() - 1.0, truth["left.range_m"].max() + 1.0
    assert all(near[0] < float(row["range_m"]) < near[1] for row in rows)
    assert max(abs(float(row["encoder_deg"])) for row in rows) == pytest.approx(30.0, abs=0.1)


def test_two_processes_write_the_same_bytes(flown: Flown, asked: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    made_of(flown, tmp_path, "--write-dropped", "--workers", "2")
    assert digests(tmp_path) == digests(asked[0])


def test_discarded_returns_are_only_counted_by_default(
    flown: Flown, asked: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    told = made_of(flown, tmp_path)
    assert told["counts"] == asked[1]["counts"]
    assert not list(tmp_path.glob("*.csv.gz"))
    assert [strip["withheld"] for strip in told["strips"]] == [0, 0]
    assert not any(np.asarray(laspy.read(tmp_path / strip["file"]).withheld).any() for strip in told["strips"])
