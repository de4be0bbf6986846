"""Holds points back until the surface around them is known, so that their sigmas contain the footprint's effect.

Points wait for half a second of flight behind them, so that a cube of ground holds the returns of both sides. They
leave in the order in which they came, in pieces that depend on the log alone: a strip gives the same sigmas whoever
computes it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from swath.daemon.processing.setup.models import noise_of
from swath.daemon.processing.setup.setup import Setup
from swath.georef.points import Points
from swath.georef.surface.local import LocalSurface

HOLD_NS = 500_000_000
SURFACES = ("planes", "level_ground", "rough", "beyond_80_deg")  # counts of points; the last ones are counted twice
MOST_HELD = 2_000_000  # points; the oldest leave earlier where more would wait


class Held(NamedTuple):
    """Points of a scanner; withheld ones are no part of the surface."""

    name: str
    points: Points
    withheld: bool


class SurfaceSigmas:
    """Takes points as they are placed, and gives them back with sigmas that contain the surface.

    Args:
        setup: of the georeferencing; it says what the surface is taken to be.
    """

    def __init__(self, setup: Setup) -> None:
        options, mapping = setup.options, setup.mapping
        self._noise = {name: noise_of(setup.config.scanner[name]) for name in setup.scanners}
        self._range_sigma = options.range_sigma and options.uncertainty
        self._surfaces: dict[str, LocalSurface] = {}
        self._waits = options.surface == "planes"
        if mapping is not None:
            self._surfaces = {
                name: LocalSurface(
                    self._noise[name], mapping.unit_m, level=not self._waits, incidence=options.incidence
                )
                for name in setup.scanners
                if setup.georeferencer(name).with_beams
            }
        self._held: deque[Held] = deque()
        self._begun: set[str] = set()
        self._rows, self._newest_ns = 0, 0

    def take(self, name: str, points: Points, *, withheld: bool = False) -> None:
        """Take the next points of a scanner; ``withheld`` ones get sigmas, but are no part of the surface."""
        if not len(points):
            return
        held = Held(name, points, withheld)
        self._held.append(held)
        self._rows += len(points)
        self._newest_ns = max(self._newest_ns, int(points.time_ns[-1]))
        if name in self._begun:
            self._add(held)

    def ready(self, *, last: bool = False) -> Iterator[Held]:
        """Yield the points that have waited long enough, in the order in which they came; ``last``: all of them."""
        while self._held and (last or self._is_due()):
            if self._waits and self._held[0].name in self._surfaces.keys() - self._begun:
                self._begin(self._held[0].name)
            held = self._held.popleft()
            self._rows -= len(held.points)
            self._finish(held)
            yield held

    def counts(self) -> dict[str, dict[str, Any]]:
        """Return by scanner the surface that its points were taken to lie on."""
        return {
            name: dict(zip(SURFACES, (one.planes, one.level, one.rough, one.steep), strict=True))
            | {"cube_m": one.size_m}
            for name, one in self._surfaces.items()
        }

    def _is_due(self) -> bool:
        if not self._waits or not self._surfaces or self._rows > MOST_HELD:
            return True
        return self._newest_ns - int(self._held[0].points.time_ns[-1]) >= HOLD_NS

    def _begin(self, name: str) -> None:
        """Begin a scanner's surface with all of its points that wait."""
        mine = [held for held in self._held if held.name == name]
        own = [held.points for held in mine if not held.withheld] or [held.points for held in mine]
        self._surfaces[name].begin(Points.concatenate(own))
        self._begun.add(name)
        for held in mine:
            self._add(held)

    def _add(self, held: Held) -> None:
        if not held.withheld:
            self._surfaces[held.name].add(held.points)

    def _finish(self, held: Held) -> None:
        points = held.points
        if self._range_sigma:
            points.range_sigma_m = np.full(len(points), self._noise[held.name].range_m, np.float32)
        if held.name in self._surfaces:
            self._surfaces[held.name].apply(points, counted=not held.withheld)
