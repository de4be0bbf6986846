"""Tests what the lines flown would determine of the calibration, against the prediction for their plan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swath.calib.parameters import ParameterOptions
from swath.daemon.config import load_config
from swath.daemon.config.tables import LiveConfig
from swath.daemon.log.reader import open_logs
from swath.daemon.processing.calibration.plan.run import PlanOptions, plan_calibration
from swath.daemon.processing.landing.command import FLOWN, PREDICTED
from swath.daemon.processing.landing.predict import prediction_of
from swath.daemon.processing.live.session import replay
from swath.daemon.processing.setup.setup import Options, Setup
from swath.daemon.simulate.into_log import fly_into_log
from swath.sim.companions import companion_files, config_text, default_wires
from swath.sim.fly import VirtualFlight
from swath.sim.plan.plan import parse_plan

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600), pytest.mark.xdist_group("kernels")]

PLAN = """
[flight]
name = "cross"
seed = 5
speed_mps = 50.0
lead_s = 3.0
[gnss.rover]
ins = true
[imu.main]
[scanner.left]
prf_hz = 30000
half_angle_deg = 30.0
[[line]]
name = "1"
from_m = [-300, 0]
to_m = [300, 0]
height_m = 900
[[line]]
name = "2"
from_m = [300, 0]
to_m = [-300, 0]
height_m = 900
[[line]]
name = "3"
from_m = [0, -300]
to_m = [0, 300]
height_m = 900
[terrain]
height_m = 450
slope_percent = 12
"""


def test_the_lines_flown_determine_what_their_plan_was_predicted_to_determine(tmp_path: Path) -> None:
    """The plan's prediction sees whole roofs, and the flight's the map's squares: it is never much better."""
    plan = parse_plan(PLAN, tmp_path)
    flight = VirtualFlight(plan, None)
    for name, data in companion_files(plan, flight.site, flight.scene).items():
        (tmp_path / name).write_bytes(data)
    text = config_text(plan, default_wires(plan), "logs").replace('"novatel"', '"novatel"\ndatum = "same"')
    (tmp_path / "swath.toml").write_text(text)
    fly_into_log(load_config(tmp_path / "swath.toml"), tmp_path / "logs", flight, 5)
    (session,) = open_logs([tmp_path / "logs"])
    live = tmp_path / "live"
    replay(session, Setup.of_session(session, None, Options(uncertainty=False)), live, LiveConfig(), None)
    with np.load(live / FLOWN) as flown:
        assert flown["half_rad"] == pytest.approx(np.radians(30.0), abs=1e-3)
        assert flown["rate_hz"] == pytest.approx(30_000.0, rel=0.15)
        assert len(flown["strips"]) == 3
        sigmas = [float(np.median(flown["position_sigma_l"])), *np.degrees(np.median(flown["attitude_sigma_rad"], 0))]
    found = prediction_of(live, tmp_path / "logs", session.session_id)
    assert found["strips"] == 3, found
    told = {row["name"]: row for row in found["rows"]}
    request = PlanOptions(ParameterOptions("scanner"), (sigmas[0], sigmas[1], sigmas[3]), control=False)
    planned = {row["name"]: row for row in plan_calibration(plan, request).rows}
    ratios = {name: _ratio(told[name], planned[name]) for name in told}
    for name in ("omega_deg", "phi_deg", "kappa_deg", "range_offset_m"):
        ratio = ratios[name]
        assert ratio is not None, name
        assert 0.8 < ratio < 2.0, ratios
    assert all(ratio is None or 0.8 < ratio < 10.0 for ratio in ratios.values()), ratios
    assert json.loads((live / PREDICTED).read_bytes()) == found
    assert prediction_of(live, tmp_path / "nowhere", session.session_id) == found  # it is kept
    (live / PREDICTED).unlink()
    assert "is not in" in prediction_of(live, tmp_path / "nowhere", session.session_id)["why"]


def _ratio(told: dict[str, Any], planned: dict[str, Any]) -> float | None:
    if told["sigma"] is None or planned["sigma"] is None:
        return None
    return float(told["sigma"] / planned["sigma"])
