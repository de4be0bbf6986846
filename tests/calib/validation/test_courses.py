"""Tests the course of parameters through calibrations: constant, drifting, jumping, and after a new mounting."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from swath.calib.validation.courses import Course, ScannerCourse, courses
from swath.calib.validation.history import BORESIGHT, HistoryError
from swath.georef.scanner.calibration import INDEX, Calibration, nominal

SIGMA_DEG = 0.002


def made(
    number: int,
    omega_deg: float,
    *,
    mounting: str = "HB-ABC/left/2026-03",
    serial: str = "S-17",
    scanner: str = "left",
    **more: float,
) -> Calibration:
    """Return a calibration of the boresight, made in a month of 2026."""
    one = nominal(scanner, [0.0, 0.0, 0.0], np.eye(3).tolist())
    one = one.changed(omega_rad=float(np.radians(omega_deg)), **more)
    sigmas = np.zeros(len(INDEX))
    sigmas[[INDEX[name] for name in BORESIGHT]] = np.radians(SIGMA_DEG)
    created = dt.datetime(2026, number, 1, 12, tzinfo=dt.UTC)
    header = {"created": created, "installation": mounting, "scanner_serial": serial}
    identity = np.eye(len(INDEX))
    return replace(one, id=f"{scanner}-{number}", method="planes", sigmas=sigmas, correlation=identity, header=header)


def course_of(omegas_deg: Sequence[float]) -> tuple[Course, ScannerCourse]:
    """Return the course of ω through one mounting."""
    (one,) = courses([made(number, value) for number, value in enumerate(omegas_deg, start=1)])
    ((found, *_),) = one.courses.values()
    assert found.name == "omega_rad"
    return found, one


def test_scatter_within_the_sigmas_is_constant() -> None:
    found, one = course_of([0.250, 0.252, 0.249, 0.251])
    assert found.kind == "constant"
    assert np.degrees(found.value) == pytest.approx(0.2505)
    assert np.degrees(found.sigma) == pytest.approx(SIGMA_DEG / 2.0)
    assert found.words.startswith("boresight ω (roll): constant, 0.2505 ± 0.0010° (mean of 4, p 0.7")
    assert not any(step.changed for step in one.steps)
    assert one.steps[0].words.startswith("2026-01-01 to 2026-02-01: no significant change (χ² ")


def test_the_flight_dates_a_calibration_not_its_making() -> None:
    flown: dict[str, object] = {"flown": dt.datetime(2026, 4, 9, tzinfo=dt.UTC)}
    logs: dict[str, object] = {"logs": [{"name": "north-20260228T235900Z-a6f2_0.mcap"}]}
    three = [made(number, 0.25) for number in (1, 2, 3)]
    late, early = (replace(one, header={**one.header, **more}) for one, more in zip(three, (flown, logs), strict=False))
    (one,) = courses([three[2], late, early])
    assert [entry.id for entry in one.entries] == ["left-2", "left-3", "left-1"]
    assert [(step.before, step.after) for step in one.steps] == [
        ("2026-02-28", "2026-03-01"),
        ("2026-03-01", "2026-04-09"),
    ]
    rows = one.record()["calibrations"]
    assert (rows[2]["flown"], rows[2]["created"]) == ("2026-04-09T00:00:00Z", "2026-01-01T12:00:00Z")


def test_a_calibration_without_serial_number_belongs_to_the_scanner_of_its_name() -> None:
    """Its mounting is that of its neighbours; if several scanners have its name, nothing is guessed."""
    bare = made(2, 0.25, mounting="", serial="")
    (one,) = courses([made(1, 0.25), made(3, 0.25), bare])
    assert (one.serial, len(one.entries), set(one.mountings)) == ("S-17", 3, {"HB-ABC/left/2026-03"})
    (moved,) = courses([made(1, 0.25), made(3, 0.25, mounting="HB-ABC/left/2026-09"), bare])
    assert moved.mountings[1] == "mounting not recorded"
    assert [step.remounted for step in moved.steps] == [None, None]
    assert moved.steps[0].words.startswith("2026-01-01 to 2026-02-01, perhaps mounted anew: no significant change")
    assert len(courses([made(1, 0.25), made(3, 0.25, serial="S-18"), bare])) == 3
    assert len(courses([made(1, 0.25), made(2, 0.25, mounting="HB-XYZ/left", serial="")])) == 2


def test_a_steady_change_is_a_drift() -> None:
    found, _ = course_of([0.250 + 0.004 * month for month in range(6)])
    assert found.kind == "drift"
    assert np.degrees(found.value) == pytest.approx(0.004 * 12.0, rel=0.03)
    assert "drifts by +0.0486 ± 0.0058° a year" in found.words


def test_a_jump_has_its_dates_and_size() -> None:
    found, one = course_of([0.250, 0.251, 0.249, 0.280, 0.281])
    assert found.kind == "jump"
    assert (found.before, found.after) == ("2026-03-01", "2026-04-01")
    assert np.degrees(found.value) == pytest.approx(0.0305)
    assert [step.changed for step in one.steps] == [False, False, True, False]
    assert "changed: omega_deg +0.0310 ± 0.0028 (11.0 σ)" in one.steps[2].words


def test_back_and_forth_is_neither() -> None:
    found, _ = course_of([0.250, 0.280, 0.250, 0.280])
    assert found.kind == "varies"


def test_chance_is_called_a_change_at_the_stated_rate() -> None:
    rng = np.random.default_rng(4)
    kinds = [course_of((0.25 + SIGMA_DEG * rng.standard_normal(4)).tolist())[0].kind for _ in range(500)]
    assert kinds.count("constant") >= 497


def test_a_new_mounting_is_named_and_begins_a_new_course() -> None:
    entries = [made(1, 0.25), made(2, 0.251), made(3, 0.40, mounting="HB-ABC/left/2026-09")]
    (one,) = courses(entries)
    assert list(one.courses) == ["HB-ABC/left/2026-03", "HB-ABC/left/2026-09"]
    assert one.courses["HB-ABC/left/2026-09"][0].kind == "once"
    assert [step.remounted for step in one.steps] == [False, True]
    assert one.steps[1].words.startswith("2026-02-01 to 2026-03-01, mounted anew: changed: omega_deg ")


def test_scanners_are_told_apart_by_their_serial_numbers() -> None:
    moved = made(2, 0.25, scanner="rear", mounting="HB-ABC/rear/2026-05")
    other = made(3, 0.25, serial="S-18")
    unsaid = made(4, 0.25, serial="", scanner="nose")
    found = courses([made(1, 0.25), moved, other, unsaid])
    assert [(one.scanner, one.serial, len(one.entries)) for one in found] == [
        ("left", "S-18", 1),
        ("left and rear", "S-17", 2),
        ("nose", "", 1),
    ]


def test_calibrations_with_other_held_values_are_not_tested() -> None:
    (one,) = courses([made(1, 0.25), made(2, 0.26, lever_arm_z_m=0.5)])
    assert one.steps[0].compared is None
    assert "lever_arm_z_m, held, is 0 and 0.5" in one.steps[0].words
    assert {course.kind for found in one.courses.values() for course in found} == {"once"}


def test_a_calibration_without_date_is_refused() -> None:
    with pytest.raises(HistoryError, match=r"left-1: calibration\.created is not a time"):
        courses([replace(made(1, 0.25), header={})])
