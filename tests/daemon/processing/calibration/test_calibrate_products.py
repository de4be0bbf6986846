"""Tests the header of a calibration file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from swath.calib.need import POINT, need_of
from swath.calib.verdict import judge, wanted_of
from swath.daemon.config import parse_config
from swath.daemon.processing.calibration.products import _header, _wanted, trajectory_says
from swath.daemon.processing.calibration.run import Calibrated
from swath.daemon.processing.carried_verdict import Carried
from swath.georef.verdicts import Level
from tests.calib.made_outcome import made_outcome, made_report

pytestmark = pytest.mark.xdist_group("kernels")


def session(installation: str, **serials: str) -> Any:
    scanner = {name: SimpleNamespace(model="SIM", serial=serial) for name, serial in serials.items()}
    config = SimpleNamespace(scanner=scanner, profile=SimpleNamespace(installation=installation))
    return SimpleNamespace(setup=SimpleNamespace(config=config, scanners=sorted(scanner)))


def test_a_scanner_missing_from_the_first_session_uses_its_own_head() -> None:
    found = SimpleNamespace(parameters=np.zeros(3))
    adjusted = SimpleNamespace(calibrations={"left": found, "right": found}, variance_factor=1.0, redundancy=9)
    kept = SimpleNamespace(logged=[session("D-ABCD", left="L1"), session("D-ABCD", left="L1", right="R1")])
    features, flight = SimpleNamespace(planes=[], ties=[]), SimpleNamespace(swaths=[])
    done = cast(Calibrated, SimpleNamespace(adjusted=adjusted, kept=kept, features=features, flight=flight))
    assert [_header(done, name, []).scanner_serial for name in ("left", "right")] == ["L1", "R1"]


def test_the_verdict_on_the_trajectory_comes_first_against_the_calibration() -> None:
    bad, care = trajectory_says([Carried(Level.UNUSABLE, "lever arm"), Carried(Level.CARE, "few fixes")])
    assert (bad.what, bad.unusable, bad.excess) == ("lever arm", True, np.inf)
    assert (care.what, care.unusable) == ("few fixes", False)


def wanted(text: str) -> dict[str, float]:
    """Return the requirements of a configuration as used by `swath calibrate`."""
    config = parse_config(f'[session]\nname = "x"\n{text}', Path("swath.toml"))
    kept = SimpleNamespace(logged=[SimpleNamespace(setup=SimpleNamespace(config=config))])
    return _wanted(cast(Calibrated, SimpleNamespace(kept=kept)))


@pytest.mark.slow
def test_requirements_of_the_configuration_determine_the_verdict() -> None:
    """The path leads from TOML in users' units, through the needs of points, to the words and the level."""
    table = "[calibration.wanted]\npoint_m = {point_m}\nkappa_deg = {kappa_deg}\nrange_scale_ppm = 7.5\n"
    outcome = made_outcome()
    adjusted, report = outcome.adjusted, made_report(outcome)
    kappa_deg = float(np.degrees(adjusted.sigmas[adjusted.names.index("left.kappa_rad")]))
    found: dict[str, Any] = {}
    for words, times in (("met", 2.0), ("not met", 0.5), ("far from met", 0.05)):
        asked = wanted(table.format(point_m=50.0, kappa_deg=times * kappa_deg))
        assert asked == pytest.approx({POINT: 50.0, "kappa_rad": np.radians(times * kappa_deg), "range_scale": 7.5e-6})
        need = need_of(outcome.flight, adjusted.calibrations, adjusted.trajectory, asked)
        whole = replace(report, need=need)
        assert wanted_of(whole)["kappa_rad"] == pytest.approx(np.radians(times * kappa_deg))
        found[words] = judge(whole)
        told = [one for one in found[words].reasons if one.what.startswith("boresight κ (heading) is known to")]
        if words == "met":
            assert told == []
        else:
            (one,) = told
            assert one.what.endswith(" is required")
            assert one.level is (Level.CARE if words == "not met" else Level.UNUSABLE)
            assert one.excess > 1.0
    assert found["far from met"].level is Level.UNUSABLE
    assert wanted("") == {}
