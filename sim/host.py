"""The recording computer of the virtual aircraft: its oscillator, its wall clock and who steps it."""

from __future__ import annotations

from swath.georef.timescales import unix_ns_from_gps
from swath.sim.plan.plan import Plan

UPTIME_AT_START_NS = 600 * 1_000_000_000  # what CLOCK_MONOTONIC says at the plan's start
_NS = 1_000_000_000


class HostClock:
    """Host time as LOG_FORMAT defines it: it reads as UTC at the session's start and is never stepped after it.

    Attributes:
        wall_steps: (time_s, step_s) of the wall clock, in order of time.
    """

    def __init__(self, plan: Plan) -> None:
        self._rate = 1.0 + 1e-6 * plan.tables.host.clock_ppm
        utc_ns = unix_ns_from_gps(plan.start_gps_ns, plan.leap_seconds)
        self.start_ns = utc_ns + round(plan.tables.host.utc_offset_s * _NS)
        faults = [fault for fault in plan.tables.fault if fault.kind == "clock_step"]
        self.wall_steps = sorted((fault.at_s, fault.step_s) for fault in faults)

    def host_ns(self, time_s: float) -> int:
        """Host time (log_time) at a true time."""
        return self.start_ns + round(time_s * self._rate * _NS)

    def monotonic_ns(self, time_s: float) -> int:
        """CLOCK_MONOTONIC."""
        return self.host_ns(time_s) - self.start_ns + UPTIME_AT_START_NS

    def realtime_ns(self, time_s: float) -> int:
        """CLOCK_REALTIME, with the steps so far."""
        return self.host_ns(time_s) + sum(round(step_s * _NS) for at_s, step_s in self.wall_steps if at_s <= time_s)
