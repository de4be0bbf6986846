"""Builders and readers that tests of several packages use: flights with known truth, a clock, running commands."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from swath.daemon.log.reader import Session, open_logs
from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.records import (
    ChunkBatch,
    DeviceClockSamples,
    NamesEdge,
    ScannerReturns,
    TimeMessage,
    TimeScale,
    TimeTag,
)
from swath.georef.timescales import PpsClock, TimeState
from swath.sim.companions import companion_files, config_text, default_wires
from swath.sim.fly import VirtualFlight, open_truth
from swath.sim.plan.plan import Plan, parse_plan
from tests.sim.direct import Calibration, Track

ROOT = Path(__file__).parents[1]
SYSTEMD = Path(__file__).resolve().parent.parent / "systemd"


@contextmanager
def running(*words: str | Path, output: IO[str] | int = subprocess.DEVNULL) -> Iterator[subprocess.Popen[str]]:
    """Run a command of swath; kill it at the end, whatever happens."""
    command = [sys.executable, "-m", "swath.daemon.cli.main", *map(str, words)]
    with subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


TO_MAP = Transformer.from_crs("EPSG:4978", "EPSG:32632", always_xy=True)


@dataclass(frozen=True)
class Recorded:
    """A recorded flight: the log's folder, the points georeferenced in flight, and the truth of the returns."""

    logs: Path
    points: StructArray
    truth: Any

    def session(self) -> Session:
        """Return the only session of the log."""
        (session,) = open_logs([self.logs])
        return session

    def missed(self, time_ns: Int64Array, number: NDArray[Any], points_map: FloatArray) -> FloatArray:
        """Return errors of points (n, 3) in easting, northing and height, by the nearest true return of that number."""
        missed = np.empty((len(time_ns), 3))
        for slot in np.unique(number).tolist():
            of_slot = np.flatnonzero(self.truth["left.return_number"] == slot)
            there_ns = self.truth["left.gps_ns"][of_slot]
            mine = np.flatnonzero(number == slot)
            after = np.clip(np.searchsorted(there_ns, time_ns[mine]), 1, len(there_ns) - 1)
            nearest = after - (time_ns[mine] - there_ns[after - 1] < there_ns[after] - time_ns[mine])
            assert np.abs(there_ns[nearest] - time_ns[mine]).max() < 50_000  # pulses are a millisecond apart
            true = np.stack(TO_MAP.transform(*self.truth["left.point_e"][of_slot[nearest]].T), axis=1)
            missed[mine] = points_map[mine] - true
        return missed


def judged(missed: FloatArray, sigma: FloatArray) -> None:
    """Assert that the RMS of each axis is at most twice the predicted one."""
    spread = np.sqrt((missed**2).mean(axis=0) / (sigma**2).mean(axis=0))
    assert (spread < 2.0).all(), spread
    assert np.sqrt(((missed / sigma) ** 2).mean()) > 0.1
    assert (np.abs(missed) < 5.0 * sigma).mean() > 0.999


NS = 1_000_000_000
START_S = 1_479_297_618  # 2026-11-21T12:00:00Z: on the UTC hour with 18 leap seconds
HOST_0 = 5_000_000_000_000
HOST_RATE = 1.0 + 23e-6


def host_ns(true_s: FloatArray | float) -> Int64Array:
    """Return the host's time at true seconds since START_S."""
    return HOST_0 + np.rint(np.asarray(true_s, dtype=np.float64) * HOST_RATE * NS).astype(np.int64)


def host_clock(seconds: int, *, message_s: float = 0.1, keep_history: bool = True) -> PpsClock:
    """Return a locked clock of a host, which had an edge and a message every second."""
    clock = PpsClock(18, keep_history=keep_history)
    for second in range(seconds):
        edge = int(host_ns(second))
        clock.add_edge(edge, second)
        week, of_week = divmod(START_S + second, 604_800)
        tag = TimeTag(TimeScale.GPS, of_week * NS, week)
        arrival = edge + round(message_s * NS)
        clock.add_message("gnss/rover", TimeMessage(arrival, tag, NamesEdge.PREVIOUS, message="TIME"))
    assert clock.status(int(host_ns(seconds))).state is TimeState.LOCKED
    return clock


PROOF_PLAN = """
[flight]
name = "proof"
seed = 11
noise = false
turbulence = "moderate"
speed_mps = 60.0

[[line]]
name = "1"
from_m = [-200, -20]
to_m = [200, 20]
height_m = 1250

[terrain]
height_m = 450
relief_m = 40
wavelength_m = 400

[[terrain.village]]
center_m = [0, 0]
size_m = [300, 300]
houses = 12

[[terrain.forest]]
center_m = [100, 200]
size_m = [150, 100]

[host]
clock_ppm = -12.0

[imu.main]
rate_hz = 200

[scanner.left]
prf_hz = 20000
scan_hz = 40
encoder_counts = 16777216
oscillator = { offset_ppm = 3.0, drift_ppm_per_h = 2.0 }
"""
EVERY_ERROR = {
    "omega_deg": 0.25,
    "phi_deg": -0.4,
    "kappa_deg": 0.6,
    "range_offset_m": 0.35,
    "range_scale_ppm": 40.0,
    "scan_angle_offset_deg": 0.05,
    "scan_angle_scale_ppm": 300.0,
    "scan_plane_tilt_deg": 0.02,
    "lever_arm_x_m": 0.15,
    "lever_arm_y_m": -0.08,
    "lever_arm_z_m": 0.42,
    "time_offset_us": 150.0,
    "encoder_latency_us": 1.0,
    "torsion_us2": 2000.0,
    "pitch_slope_ppm": 200.0,
}
TURNED = [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]  # cables to the rear, FORMULAS 1.5


@dataclass
class Flown:
    """A flight's decoded returns, the times of their pulses by the packets' own clock, and the truth."""

    plan: Plan
    rows: StructArray
    time_s: FloatArray
    truth: dict[str, NDArray[Any]]
    calibration: Calibration
    files: dict[str, bytes]

    def track(self) -> Track:
        """Return the true trajectory at the IMU's rate."""
        truth = self.truth
        attitude = np.stack([truth[f"trajectory.{name}_rad"] for name in ("roll", "pitch", "heading")], axis=1)
        time_s = 1e-9 * (truth["trajectory.gps_ns"] - self.plan.start_gps_ns)
        lat, lon, height = (truth[f"trajectory.{name}"] for name in ("lat_rad", "lon_rad", "height_m"))
        return Track(time_s, lat, lon, height, attitude)


def fly_and_decode(folder: Path, changes: dict[str, Any], stop_s: float = 15.5) -> Flown:
    """Fly the plan and decode the scanner's packets with its driver."""
    plan = parse_plan(PROOF_PLAN, folder).changed(changes)
    path = folder / "truth.npz"
    flight = VirtualFlight(plan, open_truth(plan, path), stop_s=stop_s)
    files = companion_files(plan, flight.site, flight.scene)
    config = tomllib.loads(config_text(plan, default_wires(plan), "."))["scanner"]["left"]
    geometry = {"geometry": files["left.json"]} if "left.json" in files else {}
    parser = find_driver("scanner", config["protocol"]).make_parser(DeviceSettings("scanner/left", config, geometry))
    records = [record for batch in scanner_batches(flight) for record in parser.feed_batch(batch)] + parser.close()
    flight.finish_truth()
    assert parser.counters.bad_messages == parser.counters.bad_checksums == parser.counters.bytes_skipped == 0
    rows = np.concatenate([record.rows for record in records if isinstance(record, ScannerReturns)])
    clock = np.concatenate([record.rows for record in records if isinstance(record, DeviceClockSamples)])
    with np.load(path) as truth:
        loaded = dict(truth)
    assert len(rows) == len(loaded["left.gps_ns"]) > 5000
    time_s = pulse_times(flight, rows, clock)
    return Flown(plan, rows, time_s, loaded, Calibration.read(files["left.true.toml"].decode()), files)


def scanner_batches(flight: VirtualFlight) -> Iterator[ChunkBatch]:
    """Yield the scanner's packets; consecutive ones of one length form a batch."""
    units = (unit for unit in flight.units() if unit.source.startswith("scanner/left"))
    for (source, length), alike in groupby(units, lambda unit: (unit.source, len(unit.data))):
        together = list(alike)
        host_ns = np.array([flight.host_clock.host_ns(unit.time_s) for unit in together], dtype=np.int64)
        data = np.frombuffer(b"".join(unit.data for unit in together), dtype=np.uint8)
        yield ChunkBatch(source, host_ns, data.reshape(len(together), length))


def pulse_times(flight: VirtualFlight, rows: StructArray, clock: StructArray) -> FloatArray:
    """Return the times of pulses in seconds since the plan's start, by the clock in the packets."""
    if (clock["pps_time_ns"] < 0).all():  # a disciplined head counts UTC past the hour, or GPS time
        return disciplined_times(flight, rows)
    host_s = (clock["host_time_ns"] - flight.host_clock.host_ns(0.0)) * 1e-9
    latched = clock["pps_time_ns"] >= 0
    age_s = 1e-9 * (clock["device_time_ns"] - clock["pps_time_ns"])
    seconds = np.rint(host_s - age_s)[latched]
    edges, first = np.unique(clock["pps_time_ns"][latched], return_index=True)
    seconds = seconds[first]
    device = rows["device_time_ns"]
    k = np.clip(np.searchsorted(edges, device, side="right") - 1, 0, len(edges) - 2)
    share = (device - edges[k]) / (edges[k + 1] - edges[k])
    times: FloatArray = seconds[k] + share * (seconds[k + 1] - seconds[k])
    return times


def disciplined_times(flight: VirtualFlight, rows: StructArray) -> FloatArray:
    """Return times of pulses from stamps modulo the hour, with the hour from the host's time of their packets."""
    leap_ns = flight.plan.leap_seconds * 1_000_000_000
    hour_ns = 3_600_000_000_000
    expected = flight.plan.start_gps_ns - leap_ns + (rows["host_time_ns"] - flight.host_clock.host_ns(0.0))
    behind = (expected - rows["device_time_ns"] + hour_ns // 2) // hour_ns
    times: FloatArray = 1e-9 * (rows["device_time_ns"] + behind * hour_ns + leap_ns - flight.plan.start_gps_ns)
    return times


def bound(
    flown: Flown, *, range_quantum_m: float, angle_quantum_rad: float | FloatArray, time_quantum_s: float
) -> FloatArray:
    """Return the greatest error in metres: 1 mm and half of each quantum, carried to the ground."""
    fastest_mps = np.linalg.norm(flown.truth["trajectory.velocity_l"], axis=1).max()
    carried = angle_quantum_rad * flown.truth["left.range_m"] + range_quantum_m + time_quantum_s * fastest_mps
    limits: FloatArray = 1e-3 + 0.5 * carried
    return limits


SREP_24_BIT = {"range_quantum_m": 1e-4, "angle_quantum_rad": 2 * 2 * np.pi / 2**24, "time_quantum_s": 1e-7}
ROUND_ERRORS = EVERY_ERROR | {
    "scan_plane_tilt_deg": 0.0,
    "pitch_slope_ppm": 0.0,
    "torsion_us2": 0.0,
    "scan_angle_scale_ppm": 0.0,
}
LOW_AND_SLOW = {
    "flight": {"speed_mps": 12.0},
    "line": [{"name": "1", "from_m": [-60, -5], "to_m": [60, 5], "height_m": 540.0}],
    "terrain": {"relief_m": 5.0},
}
SPINNING_ERRORS = EVERY_ERROR | {
    "scan_angle_scale_ppm": 0.0,
    "scan_plane_tilt_deg": 0.0,
    "torsion_us2": 0.0,
    "pitch_slope_ppm": 0.0,
    "range_offset_m": 0.05,
}
SIDEWAYS = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]  # spin axis forward, azimuth 0 down


def vlp16_quanta(pulse: Int64Array, groups: int) -> FloatArray:
    """Return the number of azimuth quanta to which a firing's azimuth is known.

    Between two groups of a packet the azimuth is interpolated, which costs one quantum. After the last group it is
    extrapolated as a_n + t (a_n − a_n−1), t being the share of the time between groups, which costs 1 + 2t.
    """
    place = pulse % 32
    share = ((place // 16) * 55.296 + (place % 16) * 2.304) / 110.592  # VLP-16 manual, 9.4
    last = pulse // 32 % groups == groups - 1
    return np.where(last, 1.0 + 2.0 * share, 1.0)
