"""Tests navigation with its arrays in files: the same bytes as in memory, and released memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from swath.daemon.processing.navigation.navigate import MappedStorage
from swath.georef.navigation.filter import filter as filter_module
from swath.georef.navigation.filter import smoother as smoother_module
from swath.georef.navigation.filter.stores import IN_MEMORY, Storage
from swath.georef.navigation.inputs import GRADES
from swath.georef.navigation.solve import Solved, solve
from tests.georef.navigation.flights import Fixes, drawn_start, fly, noised, setup_for, survey

pytestmark = pytest.mark.xdist_group("kernels")

ARM = np.array([0.35, -0.12, -1.1])
COLUMNS = ("time_ns", "position_e", "velocity_e", "q_e_from_b", "position_sigma_l", "velocity_sigma_l",
           "attitude_sigma_rad", "bridged", "node_time_ns", "gyro_bias", "accel_scale_sigma", "separation")  # fmt: skip


def resident_kb() -> int:
    """Return the resident memory of this process in kB, mapped files included."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith("VmRSS")))


def test_a_flight_in_files_equals_the_flight_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Results that are filtered and smoothed in pieces, with files for all arrays, are equal in every byte."""
    truth = fly(survey(), 60.0, 50.0)
    inertial, rows = noised(truth, GRADES["tactical"], Fixes(), ARM, 3)

    def solved(storage: Storage) -> Solved:
        return solve(inertial, rows, setup_for(GRADES["tactical"], ARM), drawn_start(truth, 3), storage=storage)

    whole = solved(IN_MEMORY)
    monkeypatch.setattr(filter_module, "PIECE", 700)
    monkeypatch.setattr(smoother_module, "PIECE", 300)
    mapped = solved(MappedStorage(smallest_bytes=0))
    for first, second in ((whole.forward, mapped.forward), (whole.smoothed, mapped.smoothed)):
        for name in COLUMNS:
            assert getattr(first, name).tobytes() == getattr(second, name).tobytes(), name
        assert first.innovations.tobytes() == second.innovations.tobytes()
        assert not second.position_e.flags.owndata


def test_memory_is_released_and_no_data_are_lost(tmp_path: Path) -> None:
    storage = MappedStorage(tmp_path)
    before_kb = resident_kb()
    array = storage.empty((8 << 20,), np.float64)  # 64 MB
    array[:] = np.arange(8 << 20)
    assert resident_kb() > before_kb + 50_000
    storage.rest()
    assert resident_kb() < before_kb + 20_000
    assert (array == np.arange(8 << 20)).all()
    assert list(tmp_path.iterdir()) == []


def test_without_a_file_memory_is_used(tmp_path: Path) -> None:
    array = MappedStorage(tmp_path / "absent").empty((1 << 18,), np.float64)
    assert array.flags.owndata
    assert array.shape == (1 << 18,)
