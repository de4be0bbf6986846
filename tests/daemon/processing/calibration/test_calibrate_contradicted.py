"""Tests that objections to a calibration by strips, a validation and profiles reach its verdict."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from swath.calib.profiles.check import Check, Comparison
from swath.daemon.processing.calibration.model import model_of
from swath.daemon.processing.calibration.products import strips_say, validation_says, write_products
from swath.daemon.processing.calibration.run import Calibrated, CalibrationOptions, calibrate
from swath.daemon.processing.flights.read import GeorefOptions
from swath.daemon.processing.flights.trajectory_choice import TrajectoryOptions
from swath.daemon.processing.setup.setup import Options
from swath.georef.formats.trajectory.csv import csv_text
from swath.georef.progress import silent
from swath.georef.scanner.calibration import INDEX, Calibration, read_calibration
from swath.georef.trajectory.trajectory import Trajectory
from tests.calib.village import KNOWN, Made, village

pytestmark = [pytest.mark.xdist_group("kernels"), pytest.mark.slow]

CELL_M = 8.0
ROLL_RAD = math.radians(0.02)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return village(tmp_path_factory.mktemp("village"), lines=(0, 1, 2))


@pytest.fixture(scope="module")
def options(made: Made, tmp_path_factory: pytest.TempPathFactory) -> CalibrationOptions:
    folder = made.flown.folder
    true = folder / "left.true.toml"
    options = Options(datum="same", calibrations={"left": (true.read_text(), str(true))}, uncertainty=False)
    output = tmp_path_factory.mktemp("out") / "left.toml"
    logs = GeorefOptions([made.flown.log], output, TrajectoryOptions(folder / "true_trajectory.csv"), options)
    return CalibrationOptions(logs, output, model_of("basic", KNOWN[1], "", KNOWN[3::2]), overwrite=True)


@pytest.fixture(scope="module")
def done(options: CalibrationOptions, tmp_path_factory: pytest.TempPathFactory) -> Calibrated:
    """Return an outcome without faults before it is written."""
    return calibrate(options, tmp_path_factory.mktemp("returns"), silent)


def wrong(done: Calibrated, sigma_rad: float = 1e-5, **by: float) -> Calibrated:
    """Return the result with a calibration that is wrong by `by` but states small sigmas for its angles."""
    calibrations: dict[str, Calibration] = {}
    for name, found in done.adjusted.calibrations.items():
        sigmas = found.sigmas.copy()
        sigmas[[INDEX[angle] for angle in ("omega_rad", "phi_rad", "kappa_rad")]] = sigma_rad
        changed = found.changed(**{key: found.value(key) + value for key, value in by.items()})
        calibrations[name] = replace(changed, sigmas=sigmas)
    adjusted = replace(done.adjusted, calibrations=calibrations)
    return replace(done, adjusted=adjusted, flight=done.flight.placed(calibrations))


def test_a_correct_calibration_is_not_contradicted(done: Calibrated) -> None:
    assert strips_say(done, CELL_M) == []
    assert validation_says(done) == []


def test_strips_contradict_a_wrong_roll(done: Calibrated) -> None:
    (said,) = strips_say(wrong(done, omega_rad=ROLL_RAD), CELL_M)
    assert said.what.startswith("strips still show this effect: roll: ")
    assert "to omega_deg" in said.what
    assert "swath strips" in said.change
    assert said.excess > 1.0
    assert not said.unusable


def test_an_effect_within_the_joint_sigma_is_not_a_contradiction(done: Calibrated) -> None:
    """The limit is three sigmas of both together."""
    assert strips_say(wrong(done, ROLL_RAD / 2.0, omega_rad=ROLL_RAD), CELL_M) == []
    assert strips_say(wrong(done, ROLL_RAD / 4.0, omega_rad=ROLL_RAD), CELL_M) != []


def test_a_validation_contradicts_a_wrong_roll(done: Calibrated) -> None:
    """Such a flight has two methods that compare strips, and both of them report it."""
    said = validation_says(wrong(done, omega_rad=ROLL_RAD))
    assert [one.what.split(": ")[1] for one in said] == ["crossStripFlight (002)", "other (006)"]
    for one in said:
        assert one.what.startswith("validation: ")
        assert "as an error of roll would leave" in one.what
        assert "swath validate" in one.change
        assert not one.unusable


def test_all_three_contradictions_are_in_the_verdict_of_a_calibration(
    done: Calibrated, options: CalibrationOptions
) -> None:
    """Eight pairs of one sign are three sigmas off together; terminal, record and file have the reasons."""
    sigma = 2.0**-16
    comparison = Comparison("left", "phi_rad", 8, -3.0 * sigma, sigma, 0.0, sigma, sigma)
    bad = wrong(done, omega_rad=ROLL_RAD)
    bad = replace(bad, check=Check((), (comparison,)))
    words = [
        "strips still show this effect: roll: ",
        "validation: crossStripFlight (002): ",
        "8 profiles put boresight φ (pitch) −0.0026° from the adjustment (−3.0 sigmas)",
    ]
    told = write_products(options, bad, silent)
    assert told.record["verdict"]["level"] in ("care", "unusable")
    reasons = [one["what"] for one in told.record["verdict"]["reasons"]]
    in_file = read_calibration(options.output.read_text(), "left.toml").header["verdict_reasons"]
    assert isinstance(in_file, list)
    for word in words:
        assert any(reason.startswith(word) for reason in reasons), reasons
        assert any(str(reason).startswith(word) for reason in in_file)
        assert any(word in line for line in told.lines)
    sound = write_products(options, replace(done, check=Check((), (replace(comparison, told=-2.75 * sigma),))), silent)
    for word in words:
        assert not any(one["what"].startswith(word) for one in sound.record["verdict"]["reasons"])


def test_a_forced_trajectory_of_another_place_is_noted(made: Made, options: CalibrationOptions, tmp_path: Path) -> None:
    """All strips are displaced alike, so only this note reveals it."""
    true, file = made.trajectory, tmp_path / "away.csv"
    lat, lon, height = true.geodetic()
    away = Trajectory.from_geodetic(
        true.time_ns, lat, lon + math.radians(0.1), height, true.velocity_l(), *true.attitude(), name="away"
    )
    sigmas = {name: getattr(true, name) for name in ("position_sigma_l", "attitude_sigma_rad")}
    file.write_text(csv_text(replace(away, **sigmas)))
    elsewhere = replace(options.logs, trajectory=TrajectoryOptions(file, force=True))
    output = tmp_path / "left.toml"
    forced = replace(options, logs=elsewhere, output=output)
    told = write_products(forced, calibrate(forced, tmp_path, silent), silent)
    (note,) = (line for line in told.record["notes"] if line.startswith(f"{file}: "))
    assert "lies 7.6 km off the fixes of gnss/rover" in note
    assert f"note: {note}" in told.lines
