"""Tests that a calibration adjusts the ranges that `swath georef` places."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swath.calib.flight import Flight
from swath.daemon.cli.main import run_app
from swath.daemon.processing.calibration import returns as calibration_flight
from swath.daemon.processing.calibration.returns import read_flight
from swath.daemon.processing.flights import read as flights
from swath.daemon.processing.flights.read import GeorefOptions
from swath.daemon.processing.flights.trajectory_choice import TrajectoryOptions, offset_of
from swath.daemon.processing.points.jobs import JobResult
from swath.daemon.processing.points.workers import run_jobs
from swath.daemon.processing.setup.setup import Options, Setup
from tests.calib.village import Made, village

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]

PRF_HZ, OFFSET_M = 2_000.0, 0.05


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return village(tmp_path_factory.mktemp("village"), prf_hz=PRF_HZ, lines=(0, 1))


def kept_with(made: Made, folder: Path, more: str) -> Flight:
    """Return the flight as read with the true calibration and additional lines."""
    text = (made.flown.folder / "left.true.toml").read_text() + more
    options = Options(datum="same", uncertainty=False, calibrations={"left": (text, "start.toml")})
    trajectory = TrajectoryOptions(made.flown.folder / "true_trajectory.csv")
    folder.mkdir()
    return read_flight(GeorefOptions([made.flown.log], folder, trajectory, options), folder, lambda *_: None).flight


@pytest.mark.parametrize(("rate_hz", "added_m"), [(PRF_HZ, OFFSET_M), (2 * PRF_HZ, 0.0)])
def test_a_range_offset_by_pulse_rate_is_applied_once(
    made: Made, tmp_path: Path, rate_hz: float, added_m: float
) -> None:
    plain = kept_with(made, tmp_path / "plain", "")
    row = f"\n[[range_offset]]\nprf_hz = {rate_hz}\noffset_m = {OFFSET_M}\n"
    flight = kept_with(made, tmp_path / "offset", row)
    [head] = flight.heads
    assert [offset.prf_hz for offset in head.start.range_offsets] == [rate_hz]
    for before, swath in zip(plain.swaths, flight.swaths, strict=True):
        np.testing.assert_allclose(swath.rows["range_m"] - before.rows["range_m"], added_m, atol=1e-12)
        np.testing.assert_allclose(flight.place(swath, head.start), swath.points_t, atol=1e-9)
        rays = head.model(head.start).rays(
            before.rows,
            before.time_ns,
            flight.trajectories[swath.trajectory_index],
            encoder_rate=before.encoder_rate,
            encoder_acceleration=before.encoder_acceleration,
            prf_hz=PRF_HZ,
        )  # as swath georef places them
        np.testing.assert_allclose(flight.frame.t_from_e(rays.points_e), swath.points_t, atol=1e-8)


@pytest.mark.parametrize("option", [("--fix", "right.phi_deg"), ("--prior", "right.kappa_deg=0.1")])
def test_parameters_of_an_unknown_scanner_are_refused_before_the_log_is_read(
    made: Made,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    option: tuple[str, str],
) -> None:
    monkeypatch.setattr(flights, "read_clocks", None)  # the first step that takes long
    trajectory = str(made.flown.folder / "true_trajectory.csv")
    log, output, same = str(made.flown.log), str(tmp_path / "left.toml"), ("--trajectory-datum", "same")
    assert run_app(["calibrate", log, "-o", output, "--trajectory", trajectory, *same, *option]) != 0
    assert "parameters of right: this flight has no such scanner; its scanners are left" in capsys.readouterr().err


def test_returns_without_time_are_noted(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of each strip's returns lose their time; calibrate, validate and strips name the logs concerned."""

    def without_time(*args: Any, **keys: Any) -> list[JobResult]:
        results = run_jobs(*args, **keys)
        for result in results:
            result.fates["left"]["no_time"] += result.fates["left"].total()
        return results

    monkeypatch.setattr(calibration_flight, "run_jobs", without_time)
    trajectory = TrajectoryOptions(made.flown.folder / "true_trajectory.csv")
    request = GeorefOptions([made.flown.log], tmp_path, trajectory, Options(datum="same", uncertainty=False))
    kept = read_flight(request, tmp_path, lambda *_: None)
    total = 2 * sum(len(swath) for swath in kept.flight.swaths)
    (line,) = (line for line in kept.notes if "have no time" in line)
    assert line.startswith(f"{made.flown.log}: scanner/left: ")
    lost, of = (int(words.replace(",", "")) for words in re.findall(r"[\d,]{3,}(?= of| returns)", line))
    assert 2 * lost == of >= total


def test_a_navigated_trajectory_is_always_that_of_the_body(made: Made, tmp_path: Path) -> None:
    found = []
    for at in ("body", "antenna"):
        (tmp_path / at).mkdir()
        options = Options(datum="same", uncertainty=False)
        request = GeorefOptions([made.flown.log], tmp_path / at, TrajectoryOptions(navigate=True, at=at), options)
        kept = read_flight(request, tmp_path / at, lambda *_: None)
        found.append((kept.flight.trajectories[0].position_e, kept.logged[0].troubles))
    (plain, before), (asked, told) = found
    assert made.flown.config.gnss["rover"].lever_arm_m != [0.0, 0.0, 0.0]
    np.testing.assert_array_equal(plain, asked)
    assert [line for line in told if line not in before] == [
        f"{made.flown.log}: the trajectory navigated from IMU and GNSS is that of the body; leave --trajectory-at out"
    ]


def test_the_point_of_the_scanner_is_that_of_its_calibration(made: Made) -> None:
    text = (made.flown.folder / "left.true.toml").read_text()
    moved = re.sub(r"lever_arm_y_m = .*", "lever_arm_y_m = 0.75", text, count=1)
    assert moved != text
    config = made.flown.config
    files = {name: data for name, _, data in config.attachments()}
    setup = Setup(config, files, Options(datum="same", calibrations={"left": (moved, "moved.toml")}))
    given = config.scanner["left"].lever_arm_m
    assert offset_of("scanner", setup) == pytest.approx((given[0], 0.75, given[2]))
