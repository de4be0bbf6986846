"""Measure what ray casting of the virtual aircraft costs on one core, over four kinds of country.

python -m benchmarks.raycast [--repeats 5] [--json FILE]

Figures are rays a second of this process's own CPU time, medians over the repeats. Each ray is a pulse of an
oscillating mirror (±30°, 0.5 mrad) 800 m above hills of 40 m. The limit is the cost of reading as many origins and
directions and writing as many echoes.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.cpu_time import cpu_seconds
from swath.daemon.system import keep_freed_memory
from swath.georef.arrays import FloatArray
from swath.sim.plan.plan import parse_plan
from swath.sim.scene.scene import Scene, build_scene
from swath.sim.site import Site

RAYS = 500_000
SLOTS = 3
TARGET = 1e6
HALF_M = 600.0
PLAN = """
[flight]
name = "raycast"
[[line]]
name = "1"
from_m = [0, -500]
to_m = [0, 500]
height_m = 1250
[terrain]
relief_m = 40
"""
COUNTRY = {
    "open hills": "",
    "village": "[[terrain.village]]\ncenter_m = [0, 0]\nsize_m = [600, 600]\nhouses = 150",
    "town": "[[terrain.village]]\ncenter_m = [0, 0]\nsize_m = [1000, 1000]\nhouses = 900",
    "forest": "[[terrain.forest]]\ncenter_m = [0, 0]\nsize_m = [1000, 1000]",
}


@dataclass
class Figure:
    """One line of the table; rates are rays a second of CPU."""

    name: str
    rate: float
    target: float
    limit: float


def rate(work: Callable[[], object], repeats: int) -> float:
    """Return the median of rays a second of CPU time."""
    return RAYS / cpu_seconds(work, repeats)


def scene_of(terrain: str) -> Scene:
    """Build the scene of hills with these objects on them."""
    plan = parse_plan(PLAN + terrain, Path())
    corners = HALF_M * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return build_scene(plan, Site.at(*plan.tables.flight.origin_deg), corners)


def pulses() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return origins, directions and times of a line flown north at 60 m/s, 100 000 pulses and 40 sweeps a second."""
    time_s = np.arange(RAYS) / 100_000.0
    angle = np.radians(30.0) * np.sin(2 * np.pi * 40.0 * time_s)
    origin = np.column_stack([np.zeros(RAYS), -150.0 + 60.0 * time_s, np.full(RAYS, 1250.0)])
    return origin, np.column_stack([np.sin(angle), np.zeros(RAYS), -np.cos(angle)]), time_s


def measure(repeats: int) -> list[Figure]:
    """Measure all kinds of country."""
    origin, direction, time_s = pulses()
    number = np.arange(RAYS)

    def least() -> None:
        for values in (
            origin,
            direction,
            time_s,
            number,
            np.zeros((RAYS, 3 * SLOTS)),
            np.zeros((RAYS, SLOTS), np.uint8),
        ):
            values.copy()

    limit = rate(least, repeats)
    figures = []
    for name, terrain in COUNTRY.items():
        scene = scene_of(terrain)
        work = partial(scene.cast, origin, direction, time_s, number, 0.5e-3, 0.45, SLOTS)
        figures.append(Figure(name, rate(work, repeats), TARGET, limit))
    return figures


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5, help="measurements per figure; the median counts")
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    arguments = parser.parse_args()
    keep_freed_memory()  # as every command of swath does
    figures = measure(arguments.repeats)
    print(f"{'ray casting, one core':<30} {'rate':>9} {'asked':>8} {'limit':>9}")
    for one in figures:
        print(f"{one.name:<30} {one.rate / 1e6:>5.2f} M/s {one.target / 1e6:>4.0f} M/s {one.limit / 1e6:>5.0f} M/s")
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(figure) for figure in figures], indent=1))


if __name__ == "__main__":
    main()
