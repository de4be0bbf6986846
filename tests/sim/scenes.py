"""Provides small scenes for tests, and rays towards places on them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from swath.georef.arrays import FloatArray
from swath.sim.plan.plan import Plan, parse_plan
from swath.sim.scene.scene import Scene, build_scene
from swath.sim.shots import Echoes
from swath.sim.site import Site

HEAD = """
[flight]
name = "test"
[[line]]
name = "1"
from_m = [-500, 0]
to_m = [500, 0]
height_m = 1250
[terrain]
"""


def plan_of(terrain: str, folder: Path = Path()) -> Plan:
    """Return a plan with these lines in its table ``[terrain]`` and the tables after it."""
    return parse_plan(HEAD + terrain, folder)


def scene_of(terrain: str, half_m: float = 200.0, center_m: tuple[float, float] = (0.0, 0.0)) -> Scene:
    """Return the scene of a square."""
    plan = plan_of(terrain)
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * half_m + center_m
    return build_scene(plan, Site.at(*plan.tables.flight.origin_deg), corners)


def towards(origin: FloatArray, target: FloatArray) -> FloatArray:
    """Return (n, 3) unit vectors towards places."""
    way = target - origin
    unit: FloatArray = way / np.linalg.norm(way, axis=1, keepdims=True)
    return unit


def cast(
    scene: Scene,
    origin: FloatArray,
    direction: FloatArray,
    *,
    time_s: float = 0.0,
    divergence_rad: float = 0.0,
    pulse_m: float = 0.45,
    slots: int = 5,
) -> Echoes:
    """Return the echoes of pulses numbered from 0, all at one time."""
    number = np.arange(len(origin))
    times = np.full(len(origin), time_s)
    return scene.cast(origin, direction, times, number, divergence_rad, pulse_m, slots)
