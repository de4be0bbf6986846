"""Tests that an INS which gives its antenna's path is detected, and one that does not is accepted."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from swath.daemon.processing.flights.trajectory_choice import _from_device
from swath.daemon.processing.navigation.navigate import offset_in_b, point_doubts
from swath.georef.records import INS_DTYPE
from swath.georef.trajectory.trajectory import Trajectory

pytestmark = pytest.mark.xdist_group("kernels")

S = 1_000_000_000
ARM = np.array([0.3, -0.2, -1.1])


def turning(n: int = 600) -> Trajectory:
    """Return a level turn at 10 Hz."""
    since = np.arange(n) / 10
    heading = 0.05 * since
    north, east = 1000 * np.sin(heading), -1000 * np.cos(heading)
    velocity = np.stack([50 * np.cos(heading), 50 * np.sin(heading), np.zeros(n)], axis=1)
    return Trajectory.from_geodetic(
        10**18 + np.arange(n) * S // 10,
        0.8 + north / 6.37e6,
        0.1 + east / (6.39e6 * np.cos(0.8)),
        np.full(n, 600.0),
        velocity,
        np.full(n, 0.2),
        np.full(n, 0.03),
        heading,
    )


def test_the_offset_is_that_of_the_reference_point() -> None:
    body = turning()
    found = offset_in_b(body.at_body(-ARM), body)
    assert found is not None
    assert found[0] == pytest.approx(ARM, abs=1e-6)


def test_the_antenna_is_recognised_as_reference_point() -> None:
    body = turning()
    (line,) = point_doubts(body.at_body(-ARM - [0.02, 0.0, 0.05]), body, [ARM], "gnss/rover")
    assert line.startswith("gnss/rover: its own INS gives the trajectory of its antenna, 1.")
    assert "use --trajectory-at antenna" in line


def test_another_reference_point_is_described_by_its_place() -> None:
    body = turning()
    (line,) = point_doubts(body.at_body([-1.0, 0.0, 0.0]), body, [ARM], "gnss/rover")
    assert "another point than the IMU, 1.00 m" in line
    assert "--trajectory-at 1.00," in line


def test_the_body_itself_and_a_bad_solution_give_no_finding() -> None:
    body, generator = turning(), np.random.default_rng(1)
    noise = generator.normal(0.0, 0.02, (600, 3))
    near = body._with(position_e=body.position_e + noise)
    wild = body._with(position_e=body.position_e + 100 * noise)
    assert point_doubts(near, body, [ARM], "x") == []
    assert point_doubts(wild, body, [ARM], "x") == []
    assert point_doubts(turning(15), body, [ARM], "x") == []


def test_absent_ins_velocities_are_derived_from_positions() -> None:
    body = turning()
    rows = np.zeros(len(body), INS_DTYPE)
    rows["gps_ns"], rows["velocity_l"] = body.time_ns, np.nan
    rows["lat_rad"], rows["lon_rad"], rows["height_m"] = body.geodetic()
    rows["roll_rad"], rows["pitch_rad"], rows["heading_rad"] = body.attitude()
    setup: Any = SimpleNamespace(sources=SimpleNamespace(ins_source="imu/main", protocol=lambda source: ""))
    told: Any = SimpleNamespace(ins_rows=rows)
    trajectory, counts = _from_device(setup, told)
    assert counts == {"taken": len(body)}
    np.testing.assert_allclose(trajectory.velocity_l()[1:-1], body.velocity_l()[1:-1], rtol=0, atol=0.3)
