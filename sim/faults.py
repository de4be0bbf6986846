"""Faults on demand: what the plan's fault list does to the units of a source on their way to the recorder."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from swath.sim.clocks import generator
from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import Plan
from swath.sim.plan.tables import FaultTable, Tables
from swath.sim.shots import WireUnit

Window = tuple[float, float]


def check_faults(tables: Tables) -> None:
    """Refuse faults that make no sense, with a `PlanError` that names the fault's key."""
    wired = {f"{kind}/{name}" for kind in ("gnss", "imu", "scanner", "pps") for name in getattr(tables, kind)}
    wired |= {f"scanner/{name}/aux" for name, table in tables.scanner.items() if table.kind == "vlp16"}
    for number, fault in enumerate(tables.fault):
        key = f"fault[{number}]"
        if (fault.kind == "clock_step") != (fault.source == "host"):
            raise PlanError(f"{key}.source", f'"{fault.source}" and kind "{fault.kind}": clock_step is of "host" only')
        if fault.source != "host" and fault.source not in wired:
            raise PlanError(
                f"{key}.source", f'the plan has no "{fault.source}"; want one of {", ".join(sorted(wired))}'
            )
        if fault.kind == "pps_spurious" and not fault.source.startswith("pps/"):
            raise PlanError(f"{key}.source", f'"{fault.source}": spurious edges are of a pps/… only')
        if fault.kind == "pps_lost" and fault.source.startswith("gnss/"):
            text = f'"{fault.source}": the receiver makes the edges; want pps/…, imu/… or scanner/…'
            raise PlanError(f"{key}.source", text)


def windows(tables: Tables, source: str, *kinds: str) -> list[Window]:
    """Return the times during which a source suffers from faults of these kinds, as (from, to)."""
    return [(f.at_s, f.at_s + f.for_s) for f in tables.fault if f.source == source and f.kind in kinds]


def with_faults(plan: Plan, units: Iterable[WireUnit]) -> Iterator[WireUnit]:
    """Return units in order of time after all faults of their sources, applied in the order of the plan."""
    stream = iter(units)
    for number, fault in enumerate(plan.tables.fault):
        # a device without edges still sends, so its units stay
        of_device = fault.kind == "pps_lost" and not fault.source.startswith("pps/")
        if fault.kind in _ACTIONS and not of_device:
            rng = generator(plan.tables.flight.seed, "fault", number)
            stream = _ACTIONS[fault.kind](stream, _Hits(fault, rng))
    return stream


class _Hits:
    """Decides which units a fault hits: those in its window, or the first unit from its time on if it has no length."""

    def __init__(self, fault: FaultTable, rng: np.random.Generator) -> None:
        self.fault, self.rng = fault, rng
        self._single = fault.for_s == 0.0

    def hit(self, unit: WireUnit) -> bool:
        """Return True if the fault hits this unit; call it once for each unit."""
        fault = self.fault
        if unit.source != fault.source or unit.time_s < fault.at_s:
            return False
        if fault.for_s == 0.0:
            single, self._single = self._single, False
            return single
        return unit.time_s < fault.at_s + fault.for_s and (fault.share >= 1.0 or self.rng.random() < fault.share)


def _dropped(units: Iterator[WireUnit], hits: _Hits) -> Iterator[WireUnit]:
    for unit in units:
        if not hits.hit(unit):
            yield unit


def _late(units: Iterator[WireUnit], hits: _Hits) -> Iterator[WireUnit]:
    """Yield the units; a delayed unit lets others pass."""
    waiting: list[tuple[float, int, WireUnit]] = []
    for number, unit in enumerate(units):
        while waiting and waiting[0][0] <= unit.time_s:
            yield heapq.heappop(waiting)[2]
        if hits.hit(unit):
            late = replace(unit, time_s=unit.time_s + hits.fault.delay_s)
            heapq.heappush(waiting, (late.time_s, number, late))
        else:
            yield unit
    yield from (heapq.heappop(waiting)[2] for _ in range(len(waiting)))


def _corrupted(units: Iterator[WireUnit], hits: _Hits) -> Iterator[WireUnit]:
    for unit in units:
        if unit.data and hits.hit(unit):
            data = bytearray(unit.data)
            data[int(hits.rng.integers(len(data)))] ^= int(hits.rng.integers(1, 256))
            unit = replace(unit, data=bytes(data))
        yield unit


def _duplicated(units: Iterator[WireUnit], hits: _Hits) -> Iterator[WireUnit]:
    for unit in units:
        yield unit
        if hits.hit(unit):
            yield unit


def _reordered(units: Iterator[WireUnit], hits: _Hits) -> Iterator[WireUnit]:
    """Yield the units; a hit unit changes places with the next one if both are of one source."""
    held: WireUnit | None = None
    for unit in units:
        if held is not None and held.source != unit.source:
            yield from (held, unit)
            held = None
        elif held is not None:
            yield replace(unit, time_s=held.time_s)
            yield replace(held, time_s=unit.time_s)
            held = None
        elif hits.hit(unit):
            held = unit
        else:
            yield unit
    if held is not None:
        yield held


def _spurious(units: Iterator[WireUnit], hits: _Hits) -> Iterator[WireUnit]:
    """Yield the units; each edge that is hit is followed by another edge within the second."""
    extra: WireUnit | None = None
    for unit in units:
        if extra is not None:
            yield extra
            extra = None
        yield unit
        if hits.hit(unit):
            extra = replace(unit, time_s=unit.time_s + float(hits.rng.uniform(0.05, 0.95)))
    if extra is not None:
        yield extra


_Action = Callable[[Iterator[WireUnit], _Hits], Iterator[WireUnit]]
_ACTIONS: dict[str, _Action] = {
    "silent": _dropped,
    "unplugged": _dropped,
    "pps_lost": _dropped,
    "late": _late,
    "corrupted": _corrupted,
    "duplicated": _duplicated,
    "reordered": _reordered,
    "pps_spurious": _spurious,
}
