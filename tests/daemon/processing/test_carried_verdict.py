"""Tests that verdicts on a calibration or a trajectory are passed on to everything made with it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from swath.calib.prealign import PrealignError
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.carried_verdict import (
    Carried,
    acceptance,
    calibration_verdicts,
    file_verdicts,
    first_lines,
    points_verdicts,
    refusal,
    told_before,
    trajectory_entry,
    verdict_entry,
)
from swath.daemon.processing.setup.setup import Setup
from swath.georef.scanner.calibration import INDEX, Calibration, nominal, read_calibration
from swath.georef.verdicts import Level
from tests.georef.flown import flown

TEXT = """
[calibration]
id = "c1"
scanner = "left"
method = "{method}"
{more}

[parameters]
omega_deg = 0.1
phi_deg = 0.0
kappa_deg = 0.0
range_offset_m = 0.0
lever_arm_x_m = 0.0
lever_arm_y_m = 0.0
lever_arm_z_m = 0.0
"""


def calibration(more: str = "", method: str = "planes") -> Calibration:
    return read_calibration(TEXT.format(more=more, method=method), "c1.toml")


def said_of(one: Calibration, source: str = "navigated", installation: str = "HB-ABC/1") -> list[Carried]:
    config = SimpleNamespace(profile=SimpleNamespace(installation=installation))
    setup = cast(Setup, SimpleNamespace(config=config, calibrations={"left": one}))
    return list(calibration_verdicts(setup, source))


def test_a_nominal_calibration_is_unusable_and_states_the_possible_point_error() -> None:
    """One degree about each of two axes gives 100 m · √2 · π/180 = 2.47 m."""
    for one in (nominal("left", [0.0, 0.0, 0.0], np.eye(3)), calibration(method="nominal")):
        (said,) = said_of(one)
        assert said.level is Level.UNUSABLE
        assert "is nominal: points may lie 2.5 m off at 100 m of range" in said.sentence
    assert said_of(calibration('verdict = "good"', method="nominal")) == []
    assert said_of(calibration()) == []


def test_points_of_a_nominal_calibration_have_its_plausible_sigmas() -> None:
    one = nominal("left", [0.0, 0.0, 0.0], np.eye(3)).with_plausible_sigmas()
    assert one.all_sigmas[INDEX["omega_rad"]] == pytest.approx(np.radians(1.0))
    assert np.sqrt(np.diag(one.covariance()))[INDEX["range_offset_m"]] == pytest.approx(0.2)
    for other in (calibration(), calibration('verdict = "good"', method="nominal")):
        assert other.with_plausible_sigmas() is other


def test_the_verdict_of_a_calibration_is_passed_on_with_its_reason() -> None:
    (said,) = said_of(calibration('verdict = "not to be used"\nverdict_reasons = ["kappa is held", "more"]'))
    assert said.line == "not to be used: calibration c1 of left: kappa is held"
    (said,) = said_of(calibration('verdict = "usable with care"'))
    assert said.level is Level.CARE


def test_another_mounting_is_refused_and_another_trajectory_source_gives_a_warning() -> None:
    (said,) = said_of(calibration('installation = "HB-ABC/2"'))
    assert said.level is Level.UNUSABLE
    assert 'belongs to installation "HB-ABC/2", the log to "HB-ABC/1"' in said.sentence
    assert said_of(calibration('installation = "HB-ABC/2"'), installation="") == []
    one = calibration('trajectory = "navigated"')
    (said,) = said_of(one, "ins")
    assert said.level is Level.CARE
    assert "the device's own INS, whose alignment differs" in said.sentence
    assert said_of(one, "navigated") == said_of(one, "file") == said_of(one, "") == []


def leg(first_ns: int, last_ns: int, level: str) -> dict[str, Any]:
    reason = {"level": level, "name": "x", "what": "the lever arm has another sign", "change": "turn it"}
    verdict = {"level": level, "sentence": "…", "reasons": [reason]}
    return {"first_gps_ns": first_ns, "last_gps_ns": last_ns, "verdict": verdict}


def test_the_summary_beside_a_trajectory_applies_to_the_time_of_the_log(tmp_path: Path) -> None:
    file = tmp_path / "flight.sbet"
    legs = [leg(0, 100, "unusable"), leg(200, 300, "good")]
    summary = {"format": "swath.trajectory", "solution": "smoothed", "sessions": [{"legs": legs}]}
    file.with_suffix(".json").write_text(json.dumps(summary))
    (said,), source = file_verdicts(file, (50, 60))
    assert source == "navigated"
    assert said.level is Level.UNUSABLE
    assert said.sentence == f"trajectory {file}: the lever arm has another sign; turn it"
    assert file_verdicts(file, (250, 260)) == ([], "navigated")
    file.with_suffix(".json").write_text(json.dumps(summary | {"solution": "as-is"}))
    assert file_verdicts(file, (250, 260)) == ([], "ins")


def test_the_sidecar_of_points_carries_the_verdict_of_its_trajectory(tmp_path: Path) -> None:
    told = {"level": "not to be used", "what": "navigated trajectory of s: lever arm"}
    trajectory = {"source": "navigated", "first_gps_ns": 0, "last_gps_ns": 100, "verdict": [told]}
    (tmp_path / "s.json").write_text(json.dumps({"format": "swath.georef", "flights": [{"trajectory": trajectory}]}))
    (said,), source = file_verdicts(tmp_path / "s_trajectory.csv", (10, 20))
    assert (said.level, source) == (Level.UNUSABLE, "navigated")


def test_the_record_of_a_strip_adjustment_carries_the_verdict_of_its_trajectories(tmp_path: Path) -> None:
    first = int(flown().time_ns[0])
    entry = trajectory_entry(flown(), "file", [Carried(Level.UNUSABLE, "trajectory a.sbet: lever arm")])
    record = {"format": "swath.strip-adjustment", "flights": [{"session": "s", "trajectory": entry}]}
    (tmp_path / "strip-adjustment.json").write_text(json.dumps(record))
    (said,), source = file_verdicts(tmp_path / "s_trajectory.sbet", (first, first + 1))
    assert (said.level, source) == (Level.UNUSABLE, "file")
    assert said.sentence.endswith("s_trajectory.sbet: trajectory a.sbet: lever arm")


def test_a_failure_with_unusable_input_reports_the_input_first() -> None:
    care, bad = Carried(Level.CARE, "a"), Carried(Level.UNUSABLE, "lever arm")
    told = r"^not to be used: lever arm; therefore: does not come to rest$"
    for error in (UserError("does not come to rest"), PrealignError("does not come to rest")):
        with pytest.raises(UserError, match=told), told_before([care, bad], PrealignError):
            raise error
    with pytest.raises(UserError, match=r"^no planes$"), told_before([care]):
        raise UserError("no planes")
    with pytest.raises(UserError, match=r"^no such file$"), told_before([bad]):
        raise UserError("no such file", ExitCode.IO)


@pytest.mark.parametrize("text", ["", "[]", "no json", '{"format": "of others", "sessions": 3}'])
def test_a_file_without_a_readable_summary_has_no_verdict(tmp_path: Path, text: str) -> None:
    assert file_verdicts(tmp_path / "x.out", (0, 1)) == ([], "file")
    (tmp_path / "x.json").write_text(text)
    assert file_verdicts(tmp_path / "x.out", (0, 1)) == ([], "file")


def test_the_worst_verdict_comes_first_and_only_an_unusable_one_is_a_problem() -> None:
    care, bad = Carried(Level.CARE, "a"), Carried(Level.UNUSABLE, "b")
    entry = verdict_entry([care, bad], accepted=False)
    assert first_lines(entry) == ["not to be used: b", "usable with care: a"]
    assert refusal(entry) == "not to be used: b; use --accept-verdict to accept it"
    assert acceptance(entry) == 'the verdict is "not to be used"; use --accept-verdict to accept it'
    assert acceptance(verdict_entry([care, bad], accepted=True)) == ""
    assert refusal(verdict_entry([care, bad], accepted=True)) == ""
    assert refusal(verdict_entry([care], accepted=False)) == ""
    assert verdict_entry([], accepted=False) == {"level": "good", "reasons": [], "accepted": False}
    assert refusal({}) == ""


def test_points_carry_the_verdict_of_their_sidecar() -> None:
    entry = verdict_entry([Carried(Level.UNUSABLE, "b")], accepted=True)
    sidecars: list[dict[str, Any]] = [{"format": "swath.georef", "verdict": entry}, {}, {"verdict": 3}]
    assert points_verdicts([*sidecars, *sidecars]) == [Carried(Level.UNUSABLE, "b")]
    assert replace(Carried(Level.CARE, "b"), level=Level.UNUSABLE).line == "not to be used: b"


def test_the_reason_of_a_carried_verdict_has_its_remedy_apart() -> None:
    nominal_one = Carried(Level.UNUSABLE, "calibration c is nominal: points may lie 2 m off; run swath calibrate")
    assert (nominal_one.reason.what, nominal_one.reason.change) == (
        "calibration c is nominal: points may lie 2 m off",
        "run swath calibrate",
    )
    figure = "the calibration leaves 7.1 cm in points; 4.5 cm is required"
    assert (Carried(Level.CARE, figure).reason.what, Carried(Level.CARE, figure).reason.change) == (figure, "")
