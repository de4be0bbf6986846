"""A whole flight: combines the plan's parts and yields every source's units in order of time."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from swath.georef.arrays import FloatArray, StructArray
from swath.sim.atmosphere import Air
from swath.sim.clocks import HostClock, PulsePerSecond, generator
from swath.sim.companions import control_points_e
from swath.sim.faults import Window, check_faults, windows, with_faults
from swath.sim.flight.trajectory import Trajectory, fly
from swath.sim.gnss.receiver import Receiver
from swath.sim.gnss.wire import GnssWire
from swath.sim.imu.sensors import InertialUnit
from swath.sim.imu.wire import ImuWire
from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import Plan
from swath.sim.preview.coverage import corners, refuse_ranges
from swath.sim.scanners.assembly import head_and_wire
from swath.sim.scanners.calibration_files import check_latencies
from swath.sim.scanners.ranging import Ranging
from swath.sim.scanners.scan import Scanner
from swath.sim.scene.scene import build_scene
from swath.sim.shots import SURFACES, WireUnit
from swath.sim.site import Site
from swath.sim.truth import POSE_TRUTH_DTYPE, RETURN_TRUTH_DTYPE, TruthWriter

BLOCK_S = 1.0


def open_truth(plan: Plan, path: Path) -> TruthWriter:
    """Open the truth file of a flight; raises OSError."""
    tables = {"trajectory": POSE_TRUTH_DTYPE} | dict.fromkeys(plan.tables.scanner, RETURN_TRUTH_DTYPE)
    return TruthWriter(path, tables)


class VirtualFlight:
    """A plan that is ready to be flown, once.

    Args:
        plan: of the flight.
        truth: writer of the truth; None discards it.
        stop_s: time at which the flight ends early.

    Attributes:
        site, scene, trajectory, host_clock: parts of the flight.
        duration_s: of the flight.
        sources: ``kind/name`` of everything that sends, with ``/aux`` for second ports.
        unplugged: (source, from, to) of ports that disappear.
        returns: number of returns in the packets so far.

    Raises:
        PlanError: the plan cannot be flown.
    """

    def __init__(self, plan: Plan, truth: TruthWriter | None = None, stop_s: float = math.inf) -> None:
        tables, flight = plan.tables, plan.tables.flight
        check_faults(tables)
        check_latencies(tables)
        self.plan, self._truth = plan, truth
        self.site = Site.at(*flight.origin_deg)
        self.scene = build_scene(plan, self.site, corners(plan))
        self.trajectory: Trajectory = fly(plan, self.site, self.scene.ground_m)
        refuse_ranges(plan, self.scene.ground_m)
        self.duration_s = min(self.trajectory.end_s, stop_s)
        self.host_clock = HostClock(plan)
        self.returns = 0
        self._pulses = {
            name: PulsePerSecond(table, flight.seed, name, noise=flight.noise) for name, table in tables.pps.items()
        }
        self._gnss = {name: self._receiver(name) for name in tables.gnss}
        self._units = {
            name: InertialUnit(table, self.trajectory, flight.seed, name, noise=flight.noise)
            for name, table in tables.imu.items()
        }
        self._imu = {name: self._imu_wire(name) for name in tables.imu}
        self._scanners: dict[str, Scanner] = {name: self._scanner(name) for name in tables.scanner}
        second_ports = [f"scanner/{name}/aux" for name, table in tables.scanner.items() if table.kind == "vlp16"]
        kinds = ("gnss", "imu", "scanner", "pps")
        named = [f"{kind}/{name}" for kind in kinds for name in getattr(tables, kind)]
        self.sources = tuple(sorted(named + second_ports))
        self.unplugged = [(source, *window) for source in self.sources for window in self._windows(source, "unplugged")]

    @property
    def wall_steps(self) -> list[tuple[float, float]]:
        """Steps of the host's wall clock, as (time_s, step_s)."""
        return self.host_clock.wall_steps

    def units(self) -> Iterator[WireUnit]:
        """Return every unit of every source, in order of time, with the plan's faults."""
        streams: list[Iterator[WireUnit]] = [self._edges(name) for name in self.plan.tables.pps]
        streams += [self._blocks(wire) for wire in self._gnss.values()]
        streams += [self._blocks(wire) for wire in self._imu.values()]
        streams += [self._scans(name) for name in self.plan.tables.scanner]
        faulty = (with_faults(self.plan, stream) for stream in streams)
        return heapq.merge(*faulty, key=lambda unit: unit.time_s)

    def finish_truth(self) -> None:
        """Write the rest of the truth and pack it; raises OSError."""
        if self._truth is None:
            return
        self._add_poses(self._truth)
        extra = {
            "surfaces": np.array(SURFACES),
            "lines": np.array([line.name for line in self.plan.tables.line]),
            "control_e": control_points_e(self.plan, self.site, self.scene),
        }
        for name, unit in self._units.items():
            extra |= {f"imu.{name}.{key}": values for key, values in unit.drawn().items()}
        self._truth.finish(extra)

    # ------------------------------------------------------------------ parts

    def _receiver(self, name: str) -> GnssWire:
        table, flight = self.plan.tables.gnss[name], self.plan.tables.flight
        receiver = Receiver(table, self.trajectory, seed=flight.seed, name=name, noise=flight.noise)
        return GnssWire(self.plan, name, receiver, self._pulse(f"gnss.{name}", table.pps))

    def _imu_wire(self, name: str) -> ImuWire:
        table, host = self.plan.tables.imu[name], self.plan.tables.host
        lost_pps = self._windows(f"imu/{name}", "pps_lost")
        return ImuWire(self._units[name], self._pulse(f"imu.{name}", table.pps), host.can_jitter_us, lost_pps)

    def _scanner(self, name: str) -> Scanner:
        tables, flight = self.plan.tables, self.plan.tables.flight
        table = tables.scanner[name]
        pulse = self._pulse(f"scanner.{name}", table.pps)
        head, wire = head_and_wire(self.plan, name, pulse, self.trajectory)
        air = Air(tables.atmosphere, table.wavelength_nm)
        ranging = Ranging(table, air, flight.seed, name, flight.noise)
        place = self.trajectory, self.scene, self.site
        return Scanner(name, table, head, ranging, wire, *place, air, self.plan.start_gps_ns)

    def _pulse(self, key: str, name: str | None) -> PulsePerSecond | None:
        if name is None:
            return None
        if name not in self._pulses:
            known = ", ".join(sorted(self._pulses)) or "none"
            raise PlanError(f"{key}.pps", f"the plan has no [pps.{name}]; it has: {known}")
        return self._pulses[name]

    def _windows(self, source: str, *kinds: str) -> list[Window]:
        return windows(self.plan.tables, source, *kinds)

    # ------------------------------------------------------------------ streams

    def _edges(self, name: str) -> Iterator[WireUnit]:
        """Yield PPS edges at the times that the host stamps on them."""
        host, flight = self.plan.tables.host, self.plan.tables.flight
        sigma_s = 1e-6 * host.pps_jitter_us if flight.noise else 0.0
        rng = generator(flight.seed, "host", "pps", name)
        for second in range(math.floor(self.duration_s) + 1):
            edge_s = float(self._pulses[name].edges(np.array([second]))[0])
            yield WireUnit(edge_s + sigma_s * float(rng.standard_normal()), f"pps/{name}", b"")

    def _blocks(self, wire: GnssWire | ImuWire) -> Iterator[WireUnit]:
        for start in range(math.ceil(self.duration_s / BLOCK_S)):
            yield from wire.units(start * BLOCK_S, min((start + 1) * BLOCK_S, self.duration_s))

    def _scans(self, name: str) -> Iterator[WireUnit]:
        for units, truth in self._scanners[name].work(self.duration_s):
            self.returns += len(truth)
            if self._truth is not None and len(truth):
                self._truth.add(name, truth)
            yield from units

    def _add_poses(self, truth: TruthWriter) -> None:
        """Write the body's poses at the highest rate of the IMUs."""
        rate_hz = max((table.rate_hz for table in self.plan.tables.imu.values()), default=100)
        count = math.floor(self.duration_s * rate_hz) + 1
        for first in range(0, count, 1 << 16):
            truth.add("trajectory", self._poses(np.arange(first, min(first + (1 << 16), count)) / rate_hz))

    def _poses(self, time_s: FloatArray) -> StructArray:
        rows = np.zeros(len(time_s), POSE_TRUTH_DTYPE)
        trajectory = self.trajectory
        rows["gps_ns"] = self.plan.start_gps_ns + np.rint(1e9 * time_s).astype(np.int64)
        rows["lat_rad"], rows["lon_rad"], rows["height_m"] = trajectory.geodetic(time_s)
        rows["roll_rad"], rows["pitch_rad"], rows["heading_rad"] = trajectory.attitude(time_s)
        rows["velocity_l"] = trajectory.velocity_l(time_s)
        rows["strip"] = trajectory.line_at(time_s)
        return rows
