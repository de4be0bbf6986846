"""Makes plans over flat ground."""

from __future__ import annotations

from pathlib import Path

from swath.sim.plan.plan import Plan, parse_plan

FLAT = """
[flight]
name = "flat"
speed_mps = 50.0
turbulence = "none"

[terrain]
height_m = 400.0

[control]
points = 3

[scanner.left]
prf_hz = 100_000.0
half_angle_deg = 30.0
"""
LINE = """
[[line]]
name = "{name}"
from_m = [{from_m}]
to_m = [{to_m}]
height_m = {height_m}
"""


def line(name: str, from_m: str, to_m: str, height_m: float = 800.0) -> str:
    return LINE.format(name=name, from_m=from_m, to_m=to_m, height_m=height_m)


def flat_plan(*lines: str, more: str = "") -> Plan:
    return parse_plan(FLAT + more + "".join(lines), Path())
