"""Tests the states of lines by whole logs of flights with faults, as ``swath live --replay`` gives them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from swath.daemon.config import load_config
from swath.daemon.simulate.into_log import fly_into_log
from swath.sim.companions import companion_files, config_text, default_wires
from swath.sim.fly import VirtualFlight
from swath.sim.plan.plan import Plan, parse_plan
from tests.daemon.builders import swath

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]

PLAN = """
[flight]
name = "lines"
seed = 5
speed_mps = 50.0
bank_max_deg = 35.0
lead_s = 3.0
[gnss.rover]
ins = true
[scanner.left]
prf_hz = 4000
half_angle_deg = 30.0
"""
LINE = """
[[line]]
name = "{name}"
from_m = [{start}, {north}]
to_m = [{end}, {north}]
height_m = 900
"""


def plan_text(off_m: float = 0.0) -> str:
    """Return four lines of 700 m, to and fro; line 1 is flown ``off_m`` to the north."""
    lines = [(f"{i + 1}", -350 if i % 2 == 0 else 350, 300.0 * i + off_m * (i == 0)) for i in range(4)]
    return PLAN + "".join(LINE.format(name=name, start=start, end=-start, north=north) for name, start, north in lines)


def with_faults(plan: Plan) -> Plan:
    """Return the plan with a receiver without satellites for 6 s on line 2, and a scanner silent for 5 s on line 3."""
    _, second, third, _ = VirtualFlight(plan, None, 1.0).trajectory.lines
    changes: dict[str, Any] = {
        "gnss": {"rover": {"outage": [{"at_s": second.start_s + 3.0, "for_s": 6.0}]}},
        "fault": [{"source": "scanner/left", "kind": "silent", "at_s": third.start_s + 5.0, "for_s": 5.0}],
    }
    return plan.changed(changes)


def flown(folder: Path, plan: Plan, planned: str) -> Path:
    """Fly a plan into a log whose configuration has another plan."""
    flight = VirtualFlight(plan, None)
    for name, data in companion_files(plan, flight.site, flight.scene).items():
        (folder / name).write_bytes(data)
    (folder / "plan.toml").write_text(planned)
    text = config_text(plan, default_wires(plan), "logs").replace('"novatel"', '"novatel"\ndatum = "same"')
    text = text.replace("nominal.toml", "true.toml")
    text += "[plan.wanted]\ndensity_per_m2 = 0.1\noverlap_percent = 20\n"
    text += 'quality_level = "QL2"\n'
    (folder / "swath.toml").write_text(text)
    return fly_into_log(load_config(folder / "swath.toml"), folder / "logs", flight, plan.tables.flight.seed).paths[0]


def test_faults_of_a_recorded_flight_are_told_line_by_line(tmp_path: Path) -> None:
    plan = with_faults(parse_plan(plan_text(off_m=30.0), Path()))
    log = flown(tmp_path, plan, plan_text())
    done = swath("live", "--replay", str(log), "-o", str(tmp_path / "out"))
    assert done.returncode == 0, done.stderr
    assert "FLY AGAIN: 1, 3" in done.stdout
    overlap = json.loads((tmp_path / "out/live.json").read_text())["overlap"]
    assert (overlap["wanted"], overlap["limits_m"]["QL2"]) == ("QL2", 0.08)
    verdict = json.loads((tmp_path / "out/verdict.json").read_text())
    assert verdict["sentence"].startswith("Fly again: lines 1, 3")
    lines = json.loads((tmp_path / "out/lines.json").read_text())
    found = {
        line["name"]: (line["state"], {one["code"]: one["grave"] for one in line["reasons"]}) for line in lines["lines"]
    }
    assert found["1"][0] == "again"
    assert found["1"][1]["cross_track"] is True
    assert found["2"] == ("remarks", {"gnss": False})
    assert found["3"] == ("again", {"laser_off": True, "losses": False})  # its packets have numbers
    assert found["4"] == ("good", {})
    text = next(one["text"] for one in lines["lines"][0]["reasons"] if one["code"] == "cross_track")
    assert re.match(r"3[0-2] m left of the line, over 20 m", text)  # it flies east
    silence = lines["lines"][2]["reasons"][0]
    assert (silence["to_gps_ns"] - silence["from_gps_ns"]) / 1e9 == pytest.approx(5.0, abs=0.5)
    assert all(line["flown_fraction"] == pytest.approx(1.0 if line["name"] != "3" else 0.64, abs=0.04)
               for line in lines["lines"])  # fmt: skip
