"""Tests histories of calibrations: significant moves with correlations, slow drifts, and unusable files."""

from __future__ import annotations

import datetime as dt
import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from swath.calib.validation.history import BORESIGHT, HistoryError, compare, history
from swath.daemon.processing.validation.run import history_png
from swath.georef.scanner.calibration import INDEX, BeamCorrection, Calibration, RangeOffset, nominal

SIGMAS = np.radians([0.001, 0.001, 0.002])
AT = [INDEX[name] for name in BORESIGHT]


def made(
    number: int,
    angles_deg: tuple[float, float, float] = (0.25, -0.4, 0.6),
    *,
    month: int | None = None,
    sigmas: np.ndarray | None = None,
    correlation: float = 0.0,
    installation: str = "HB-ABC/left/2026-03",
) -> Calibration:
    """Return a calibration of the boresight, made in a month."""
    values = dict(zip(BORESIGHT, np.radians(angles_deg), strict=True))
    one = nominal("left", np.zeros(3), np.eye(3)).changed(**values)
    whole, matrix = np.zeros(len(INDEX)), np.eye(len(INDEX))
    whole[AT] = SIGMAS if sigmas is None else sigmas
    matrix[AT[0], AT[1]] = matrix[AT[1], AT[0]] = correlation
    created = dt.datetime(2026, month or number, 1, 12, tzinfo=dt.UTC)
    header = {"created": created, "installation": installation}
    return replace(one, id=f"cal-{number}", method="planes", sigmas=whole, correlation=matrix, header=header)


def test_differences_are_tested_against_the_joint_sigma() -> None:
    told = compare(made(1), made(2, (0.253, -0.4, 0.6)))
    row = told.rows[0]
    assert np.degrees(row.difference) == pytest.approx(0.003)
    assert np.degrees(row.sigma) == pytest.approx(0.001 * np.sqrt(2.0))
    assert told.chi2 == pytest.approx(4.5)  # (3 / √2)²
    assert told.freedom == 3
    assert told.p == pytest.approx(0.2123, abs=1e-4)  # from tables of χ² with 3 degrees of freedom
    assert not told.moved
    assert row.words == "omega_deg +0.0030 ± 0.0014 (2.1 σ)"


def test_correlation_is_taken_into_account() -> None:
    """Differences along the poorly known direction are no surprise; across it they are."""
    along = compare(made(1, correlation=0.9), made(2, (0.253, -0.397, 0.6), correlation=0.9))
    across = compare(made(1, correlation=0.9), made(2, (0.253, -0.403, 0.6), correlation=0.9))
    assert along.chi2 == pytest.approx(9.0 / (1.0 + 0.9), rel=1e-6)
    assert across.chi2 == pytest.approx(9.0 / (1.0 - 0.9), rel=1e-6)
    assert across.moved
    assert not along.moved


def test_parameters_estimated_by_one_calibration_only_are_not_compared() -> None:
    held = made(2, sigmas=np.array([SIGMAS[0], 0.0, SIGMAS[2]]))
    assert [row.name for row in compare(made(1), held).rows] == ["omega_rad", "kappa_rad"]
    assert compare(made(1), made(2, sigmas=np.zeros(3))).freedom == 0
    assert not compare(made(1), made(2, sigmas=np.zeros(3))).moved


def test_calibrations_with_different_installations_cannot_be_compared() -> None:
    turned = replace(made(2), installation_matrix=np.diag([-1.0, -1.0, 1.0]))
    with pytest.raises(HistoryError, match="cal-1 and cal-2 have different installation matrices"):
        compare(made(1), turned)


def test_a_jump_is_reported_with_its_dates_and_size() -> None:
    (one,) = history([made(3, (0.25, -0.392, 0.6)), made(1), made(2)])
    assert [entry.id for entry in one.entries] == ["cal-1", "cal-2", "cal-3"]
    assert [step.moved for step in one.steps] == [False, True]
    assert one.moved
    text = " ".join(one.sentences)
    assert "left: the boresight has moved between 2026-02-01 and 2026-03-01: phi_deg +0.0080 ± 0.0014" in text


def test_a_slow_drift_is_found_by_a_line_without_any_step() -> None:
    entries = [made(number, (0.25, -0.4 + 0.0008 * number, 0.6)) for number in range(1, 11)]
    (one,) = history(entries)
    assert not any(step.moved for step in one.steps)
    trend = next(trend for trend in one.trends if trend.name == "phi_rad")
    times = np.array(one.times) / (365.25 * 86400.0)
    slope, covariance = np.polyfit(
        times - times.mean(),
        [entry.value("phi_rad") for entry in entries],
        1,
        w=np.full(10, 1.0 / SIGMAS[1]),
        cov="unscaled",
    )
    assert trend.per_year == pytest.approx(slope[0], rel=1e-6)
    assert trend.sigma == pytest.approx(np.sqrt(covariance[0, 0]), rel=1e-6)
    assert trend.p < 1e-3
    assert one.moved
    assert any("phi_deg drifts by +0.009" in line for line in one.sentences)


def test_noise_is_reported_as_a_change_at_the_stated_rate() -> None:
    draws = np.random.default_rng(4)
    moved = 0
    for _ in range(400):
        noise = np.degrees(draws.normal(0.0, 1.0, (3, 3)) * SIGMAS)
        values = [(0.25 + a, -0.4 + b, 0.6 + c) for a, b, c in noise]
        (one,) = history([made(number + 1, angles) for number, angles in enumerate(values)])
        moved += one.moved
    assert moved <= 8  # 5 tests of 0.1 % each: 2 expected


def test_nominal_values_are_listed_and_not_tested() -> None:
    (one,) = history([made(1, sigmas=np.zeros(3)), made(2)])
    assert [row["omega_deg_sigma"] for row in one.table()] == [None, pytest.approx(0.001)]
    assert one.steps == ()
    assert "fewer than two calibrations have sigmas" in one.sentences[0]
    assert not one.moved


IBRC = np.array([200.0, 2000.0])


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"scan_plane_tilt_rad": np.radians(0.01)}, "scan_plane_tilt_deg, held, is 0 and 0.01"),
        ({"range_scale": 50e-6}, "range_scale_ppm, held, is 0 and 50"),
        ({"lever_arm_x_m": 0.2}, "lever_arm_x_m, held, is 0 and 0.2"),
        ({"ibrc": (IBRC, np.array([0.0, 0.08]))}, "range corrections by intensity differ"),
        ({"range_offsets": (RangeOffset(0.03, return_slot=2),)}, "range offsets by return, zone or rate differ"),
        ({"beams": {3: BeamCorrection(elevation_rad=1e-4)}}, "corrections of beams differ"),
        ({"facet_tilt_rad": {1: 1e-4}}, "tilts of facets differ"),
        ({"refraction": "ardc"}, "refraction is none and ardc"),
    ],
)
def test_a_parameter_held_at_another_value_is_not_a_change(other: dict[str, Any], said: str) -> None:
    """An entry with another held value is left out of steps and lines; the other entries are judged."""
    values = {name: value for name, value in other.items() if name in INDEX}
    tables = {name: value for name, value in other.items() if name not in INDEX}
    entries = [replace(made(number), refraction="none") for number in (1, 2, 3)]
    entries.append(replace(made(4, (0.25, -0.39, 0.6)), **({"refraction": "none"} | tables)).changed(**values))
    (one,) = history(entries)
    assert not one.moved
    assert len(one.steps) == 2
    assert one.trends == ()
    assert one.sentences[0].startswith("left: the boresight has not moved: 2 steps")
    assert one.sentences[1] == f"left: the step between 2026-03-01 and 2026-04-01 was not tested: {said}"
    (alone,) = history(entries[2:])
    assert alone.sentences == one.sentences[1:]


def test_parameters_held_at_nearly_equal_values_are_compared() -> None:
    near = made(2, (0.25, -0.39, 0.6)).changed(lever_arm_x_m=0.002, range_offset_m=0.001, range_scale=2e-6)
    near = replace(near, ibrc=(IBRC, np.array([0.0, 0.002])), refraction="none")  # absent in the other one
    (one,) = history([made(1), near])
    assert one.moved


def test_a_held_and_an_estimated_parameter_are_compared_if_they_agree() -> None:
    tilt, sigmas = INDEX["scan_plane_tilt_rad"], made(2).sigmas.copy()
    sigmas[tilt] = np.radians(0.002)
    estimated = replace(made(2, (0.25, -0.39, 0.6)), sigmas=sigmas)
    (one,) = history([made(1), estimated])
    assert one.moved
    (one,) = history([made(1), estimated.changed(scan_plane_tilt_rad=np.radians(0.003))])
    assert one.sentences == (
        "left: the step between 2026-01-01 and 2026-02-01 was not tested: scan_plane_tilt_deg, held in one "
        "of them, is 0 and 0.003",
    )
    both = replace(made(1), sigmas=sigmas)
    (one,) = history([both, estimated.changed(scan_plane_tilt_rad=np.radians(0.003))])
    assert one.moved


def test_each_installation_has_its_own_history() -> None:
    found = history([made(1), made(2), made(3, installation="HB-XYZ"), made(4, installation="HB-XYZ")])
    assert [(one.installation, len(one.entries)) for one in found] == [("HB-ABC/left/2026-03", 2), ("HB-XYZ", 2)]


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ({"created": dt.datetime(2026, 1, 1, tzinfo=dt.UTC)}, "has no calibration.installation"),
        ({"installation": "a"}, "created is not a time"),
    ],
)
def test_files_that_form_no_history_are_refused_in_one_line(header: dict[str, object], said: str) -> None:
    with pytest.raises(HistoryError, match=said):
        history([replace(made(1), header=header)])
    with pytest.raises(HistoryError, match="is given twice"):
        history([made(1), made(1)])


def test_record_and_picture_include_every_calibration() -> None:
    found = history([made(number) for number in range(1, 5)])
    record = found[0].record()
    assert [row["id"] for row in record["calibrations"]] == ["cal-1", "cal-2", "cal-3", "cal-4"]
    assert len(record["steps"]) == len(record["trends"]) == 3
    png = history_png(found)
    width, height = struct.unpack(">II", png[16:24])
    assert png[:4] == b"\x89PNG"
    assert width > 500
    assert height > 500
