"""Chooses the head and the wire of each kind of scanner."""

from __future__ import annotations

from typing import Protocol

from swath.georef.arrays import StructArray
from swath.sim.clocks import PulsePerSecond
from swath.sim.faults import windows
from swath.sim.flight.trajectory import Trajectory
from swath.sim.plan.plan import Plan
from swath.sim.scanners.line_heads import LineHead
from swath.sim.scanners.ouster_wire import OusterWire
from swath.sim.scanners.rosette import RosetteHead, RosetteWire
from swath.sim.scanners.spinning_heads import Os1Head, Vlp16Head
from swath.sim.scanners.srep_wire import SrepWire
from swath.sim.scanners.velodyne_wire import VelodyneWire
from swath.sim.shots import Measured, Pulses, WireUnit


class Head(Protocol):
    """The source of a scanner's pulses."""

    def pulses(self, start_s: float, stop_s: float) -> Pulses:
        """Return the pulses that leave in this time."""


class Wire(Protocol):
    """Encodes a scanner's measurements into the units that it sends."""

    def units(self, pulses: Pulses, measured: Measured, truth: StructArray) -> tuple[list[WireUnit], StructArray]:
        """Return the datagrams that are complete, and the truth of their returns."""

    def idle(self, start_s: float, stop_s: float) -> list[WireUnit]:
        """Return the units that are sent while the laser is off."""

    def close(self) -> tuple[list[WireUnit], StructArray]:
        """Return the units that are left at the end."""


def head_and_wire(plan: Plan, name: str, pps: PulsePerSecond | None, trajectory: Trajectory) -> tuple[Head, Wire]:
    """Return the head and the wire of a scanner of the plan; raises `PlanError`."""
    tables = plan.tables
    table = tables.scanner[name]
    lost_pps = windows(tables, f"scanner/{name}", "pps_lost")
    if table.kind == "vlp16":
        return Vlp16Head(table, name), VelodyneWire(plan, name, pps, trajectory, lost_pps)
    if table.kind == "os1":
        return Os1Head(table, name), OusterWire(plan, name, pps, lost_pps)
    if table.kind == "rosette":
        return RosetteHead(table, name), RosetteWire(plan, name, pps, lost_pps)
    flight = tables.flight
    wire = SrepWire(table, name, pps, tables.host, flight.seed, noise=flight.noise, lost_pps=lost_pps)
    return LineHead(table, name), wire
