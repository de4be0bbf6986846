"""Tests whole flights: a seed always gives the same bytes, in order, with faults and truth in place."""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings
from swath.georef.records import Chunk, GnssFix, ScannerReturns
from swath.sim.companions import companion_files, config_text, default_wires
from swath.sim.fly import VirtualFlight, open_truth
from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import Plan, parse_plan
from swath.sim.scanners.calibration_files import calibration_text
from swath.sim.shots import WireUnit
from tests.sim.direct import TO_ECEF

pytestmark = pytest.mark.xdist_group("kernels")  # the loops that cast rays are compiled once, by one worker

PLAN = """
[flight]
name = "short"
seed = 5
speed_mps = 50.0

[[line]]
name = "1"
from_m = [-150, 0]
to_m = [150, 0]
height_m = 800

[terrain]
relief_m = 20

[[terrain.village]]
center_m = [0, 0]
size_m = [200, 200]
houses = 8

[gnss.rover]
secondary_lever_arm_m = [0.10, 0.95, -1.20]

[scanner.left]
prf_hz = 5000
on_lines_only = false
"""
TOP = {
    "kind": "vlp16",
    "scan_hz": 10.0,
    "installation": [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
    "range_min_m": 1.0,
    "range_max_m": 400.0,
}


def plan(**changes: Any) -> Plan:
    """Return the plan with changes."""
    return parse_plan(PLAN, Path()).changed(changes)


def flown(changed: Plan, stop_s: float = 3.2) -> tuple[VirtualFlight, list[WireUnit]]:
    """Return a flight and everything that it sent."""
    flight = VirtualFlight(changed, stop_s=stop_s)
    return flight, list(flight.units())


def digest(units: list[WireUnit]) -> dict[str, str]:
    """Return a digest of times and bytes by source."""
    sums: dict[str, Any] = defaultdict(hashlib.sha256)
    for unit in units:
        sums[unit.source].update(f"{unit.time_s!r} ".encode() + unit.data)
    return {source: one.hexdigest() for source, one in sums.items()}


@pytest.fixture(scope="module")
def flight_and_units() -> tuple[VirtualFlight, list[WireUnit]]:
    """Return the flight of the unchanged plan and its units."""
    return flown(plan(scanner={"top": TOP}))


def test_the_same_seed_gives_the_same_bytes(flight_and_units: tuple[VirtualFlight, list[WireUnit]]) -> None:
    _, again = flown(plan(scanner={"top": TOP}))
    assert digest(again) == digest(flight_and_units[1])


def test_another_seed_changes_every_source(flight_and_units: tuple[VirtualFlight, list[WireUnit]]) -> None:
    one, other = digest(flight_and_units[1]), digest(flown(plan(scanner={"top": TOP}).with_seed(6))[1])
    assert one.keys() == other.keys()
    assert [source for source in one if one[source] == other[source]] == []


def test_every_source_sends_in_order_of_time(flight_and_units: tuple[VirtualFlight, list[WireUnit]]) -> None:
    flight, units = flight_and_units
    times = [unit.time_s for unit in units]
    assert times == sorted(times)
    counts = Counter(unit.source for unit in units)
    assert set(counts) == set(flight.sources)
    assert counts["pps/main"] == 4
    assert 3 * 199 * 3.2 / 3 < counts["imu/main"] / 4 < 202 * 3.2  # four frames a sample, and the latches
    assert 0.9 * 753.5 * 3.2 < counts["scanner/top"] <= 753.6 * 3.2  # packets a second, VLP-16 manual 9.3


def test_an_early_stop_changes_nothing_before_it(flight_and_units: tuple[VirtualFlight, list[WireUnit]]) -> None:
    _, longer = flown(plan(), stop_s=5.0)
    of_gnss = [[unit for unit in units if unit.source == "gnss/rover"] for units in (flight_and_units[1], longer)]
    assert of_gnss[1][: len(of_gnss[0])] == of_gnss[0]


def test_receiver_positions_lie_at_its_antenna(tmp_path: Path) -> None:
    """Everything else is exact, so the receiver's fix minus its lever arm is the true body."""
    changed = plan(flight={"noise": False}, scanner={"left": {"prf_hz": 1000}})
    flight = VirtualFlight(changed, open_truth(changed, tmp_path / "truth.npz"), stop_s=3.2)
    parser = find_driver("gnss", "novatel").make_parser(DeviceSettings("gnss/rover"))
    fixes = []
    for unit in flight.units():
        if unit.source == "gnss/rover":
            records = parser.feed(Chunk(unit.source, round(1e9 * unit.time_s), unit.data))
            fixes += [record for record in records if isinstance(record, GnssFix) and record.lat_rad is not None]
    flight.finish_truth()
    with np.load(tmp_path / "truth.npz") as truth:
        gps_ns = truth["trajectory.gps_ns"]
        body = np.stack(
            TO_ECEF.transform(
                np.degrees(truth["trajectory.lon_rad"]),
                np.degrees(truth["trajectory.lat_rad"]),
                truth["trajectory.height_m"],
            ),
            axis=1,
        )
    assert len(fixes) >= 14
    for fix in fixes:
        assert fix.time.week is not None
        assert fix.lat_rad is not None
        assert fix.lon_rad is not None
        at = np.flatnonzero(gps_ns == fix.time.week * 604_800 * 10**9 + fix.time.time_ns)
        antenna = np.stack(TO_ECEF.transform(np.degrees(fix.lon_rad), np.degrees(fix.lat_rad), fix.height_m))
        arm = np.linalg.norm(antenna - body[at[0]])
        assert abs(arm - np.linalg.norm([0.10, -0.05, -1.20])) < 1e-4  # BESTPOS says heights to a tenth of a mm


def test_truth_has_a_row_for_every_return(tmp_path: Path) -> None:
    changed = plan()
    flight = VirtualFlight(changed, open_truth(changed, tmp_path / "truth.npz"))
    files = companion_files(changed, flight.site, flight.scene)
    assert set(files) >= {
        "left.true.toml",
        "left.nominal.toml",
        "main.dbc",
        "control.csv",
        "README.md",
    }
    assert "[scanner.left]" in config_text(changed, default_wires(changed), ".")
    parser = find_driver("scanner", "srep").make_parser(DeviceSettings("scanner/left", {"mirror_factor": 2.0}))
    rows = []
    for unit in flight.units():
        if unit.source == "scanner/left":
            records = parser.feed(Chunk(unit.source, round(1e9 * unit.time_s), unit.data))
            rows += [record.rows for record in records if isinstance(record, ScannerReturns)]
    flight.finish_truth()
    returns = np.concatenate(rows)
    with np.load(tmp_path / "truth.npz") as truth:
        assert len(truth["left.pulse"]) == len(returns) > 10_000
        assert flight.returns == len(truth["left.pulse"])
        np.testing.assert_array_equal(truth["left.return_number"], returns["return_number"])
        depth_m = 0.5e-3 * truth["left.range_m"] * np.tan(np.minimum(truth["left.incidence_rad"], np.radians(85.0)))
        weak = 0.1 * 4000.0 / returns["intensity"]  # of full intensity
        sigma_m = np.sqrt(0.015**2 * weak + (0.25 * depth_m) ** 2)  # [scanner.left.range_noise], as the page has it
        error = (returns["range_m"] - truth["left.range_m"]) / sigma_m
        assert abs(error.mean()) < 5 / np.sqrt(len(error))
        assert abs(error.std() - 1.0) < 5 / np.sqrt(2 * len(error))
        assert set(truth["left.strip"].tolist()) == {-1, 0}
        assert truth["lines"].tolist() == ["1"]
        assert truth["control_e"].shape == (20, 3)
        assert truth["imu.main.gyro_bias_radps"].shape == (3,)
        assert (np.diff(truth["trajectory.gps_ns"]) == 5_000_000).all()


def test_a_device_without_its_edges_reports_it() -> None:
    fault = {"source": "scanner/left", "kind": "pps_lost", "at_s": 0.5, "for_s": 10.0}
    _, units = flown(plan(fault=[fault]), stop_s=4.0)
    parser = find_driver("scanner", "srep").make_parser(DeviceSettings("scanner/left", {"mirror_factor": 2.0}))
    counts, locked = set(), []
    for unit in units:
        if unit.source == "scanner/left":
            for record in parser.feed(Chunk(unit.source, round(1e9 * unit.time_s), unit.data)):
                rows = getattr(record, "rows", None)
                if rows is not None and "pps_count" in (rows.dtype.names or ()):
                    counts |= set(rows["pps_count"].tolist())
                    locked += rows["locked"].tolist()
    assert len(counts) == 1  # the edge at the start, none after
    assert locked[0] == 1
    assert locked[-1] == 0
    assert sum(unit.source == "pps/main" for unit in units) == 5  # the host has all edges


def test_error_for_an_unknown_pps_names_the_key() -> None:
    with pytest.raises(PlanError, match=r"^scanner\.left\.pps: the plan has no \[pps\.second\]"):
        VirtualFlight(plan(scanner={"left": {"pps": "second"}}))


def test_a_late_imu_is_in_the_true_calibration_only() -> None:
    late = plan(imu={"main": {"latency_us": 300.0}})
    assert "imu_latency_us = 300.0" in calibration_text(late, "left", true=True)
    assert "imu_latency_us = 0.0" in calibration_text(late, "left", true=False)
    with pytest.raises(PlanError, match=r"^scanner\.left\.true\.imu_latency_us: set 0 and use imu\.<name>\.latency_us"):
        VirtualFlight(plan(scanner={"left": {"true": {"imu_latency_us": 300.0}}}))
