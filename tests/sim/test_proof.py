"""The proof: noiseless packets, decoded by the drivers and georeferenced by `tests.sim.direct`, hit the true points.

The bound of each return is 1 mm and half the packet's own quanta carried to the ground: of range, angle and time.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings
from swath.drivers.scanner.beams import beam_points as velodyne_points
from swath.drivers.scanner.ouster.head import beam_points as ouster_points
from swath.drivers.scanner.ouster.head import read_head
from swath.drivers.scanner.velodyne.heads import VLP16
from swath.georef.arrays import FloatArray
from swath.georef.records import ChunkBatch, DeviceClockSamples, ScannerReturns
from swath.sim.companions import companion_files, config_text, default_wires
from swath.sim.fly import VirtualFlight, open_truth
from swath.sim.plan.plan import Plan, parse_plan
from tests.sim.direct import (
    TO_GEODETIC,
    Bending,
    Calibration,
    Track,
    ardc,
    beam_angle,
    corrected_range,
    flat_layers,
    ground_points,
    group_index,
    line_direction,
)

pytestmark = pytest.mark.xdist_group("kernels")  # the loops that cast rays are compiled once, by one worker


PLAN = """
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
    """What a flight left: decoded returns, when their pulses were by the packets' own clock, and the truth."""

    plan: Plan
    rows: NDArray[np.void]
    time_s: FloatArray
    truth: dict[str, NDArray[Any]]
    calibration: Calibration
    files: dict[str, bytes]

    def track(self) -> Track:
        """The true trajectory at the IMU's rate."""
        truth = self.truth
        attitude = np.stack([truth[f"trajectory.{name}_rad"] for name in ("roll", "pitch", "heading")], axis=1)
        time_s = 1e-9 * (truth["trajectory.gps_ns"] - self.plan.start_gps_ns)
        lat, lon, height = (truth[f"trajectory.{name}"] for name in ("lat_rad", "lon_rad", "height_m"))
        return Track(time_s, lat, lon, height, attitude)


def fly_and_decode(folder: Path, changes: dict[str, Any], stop_s: float = 15.5) -> Flown:
    """Fly the plan, feed the scanner's packets to its driver."""
    plan = parse_plan(PLAN, folder).changed(changes)
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
    """The scanner's packets; those of one length that follow each other together."""
    units = (unit for unit in flight.units() if unit.source.startswith("scanner/left"))
    for (source, length), alike in groupby(units, lambda unit: (unit.source, len(unit.data))):
        together = list(alike)
        host_ns = np.array([flight.host_clock.host_ns(unit.time_s) for unit in together], dtype=np.int64)
        data = np.frombuffer(b"".join(unit.data for unit in together), dtype=np.uint8)
        yield ChunkBatch(source, host_ns, data.reshape(len(together), length))


def pulse_times(flight: VirtualFlight, rows: NDArray[np.void], clock: NDArray[np.void]) -> FloatArray:
    """Seconds since the plan's start by what the packets say of their clock."""
    if (clock["pps_time_ns"] < 0).all():  # disciplined: UTC past the hour, or GPS itself
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


def disciplined_times(flight: VirtualFlight, rows: NDArray[np.void]) -> FloatArray:
    """A head's stamps modulo the hour, beside the host's time of their packets."""
    leap_ns = flight.plan.leap_seconds * 1_000_000_000
    hour_ns = 3_600_000_000_000
    expected = flight.plan.start_gps_ns - leap_ns + (rows["host_time_ns"] - flight.host_clock.host_ns(0.0))
    behind = (expected - rows["device_time_ns"] + hour_ns // 2) // hour_ns
    times: FloatArray = 1e-9 * (rows["device_time_ns"] + behind * hour_ns + leap_ns - flight.plan.start_gps_ns)
    return times


def misses(flown: Flown, points_e: FloatArray) -> FloatArray:
    """Return the distances from the truth."""
    assert np.isfinite(points_e).all()
    distances: FloatArray = np.linalg.norm(points_e - flown.truth["left.point_e"], axis=1)
    return distances


def bound(
    flown: Flown, *, range_quantum_m: float, angle_quantum_rad: float | FloatArray, time_quantum_s: float
) -> FloatArray:
    """1 mm and half of each quantum carried to the ground."""
    fastest_mps = np.linalg.norm(flown.truth["trajectory.velocity_l"], axis=1).max()
    carried = angle_quantum_rad * flown.truth["left.range_m"] + range_quantum_m + time_quantum_s * fastest_mps
    limits: FloatArray = 1e-3 + 0.5 * carried
    return limits


def line_points(flown: Flown, theta: FloatArray, direction: FloatArray) -> FloatArray:
    """Ground points of a line scanner."""
    rho = corrected_range(flown.calibration, flown.rows["range_m"], flown.rows["intensity"])
    time_s = flown.time_s + flown.calibration.value("time_offset_us")
    return ground_points(flown.calibration, flown.track(), time_s, rho[:, np.newaxis] * direction, theta)


@pytest.mark.parametrize(("refraction", "bending"), [("ardc", ardc), ("spherical", flat_layers)])
def test_points_are_recovered_through_air_that_slows_and_bends(
    tmp_path: Path, refraction: str, bending: Bending
) -> None:
    scanner = {"kind": "monogon", "half_angle_deg": 40.0, "scan_hz": 60.0}
    air = {"ranges": "vacuum", "refraction": refraction}
    line = [{"name": "1", "from_m": [-200, -20], "to_m": [200, 20], "height_m": 2450.0}]  # high: 13 mm at 40°
    flown = fly_and_decode(tmp_path, {"scanner": {"left": scanner}, "atmosphere": air, "line": line})
    calibration, track, theta = flown.calibration, flown.track(), flown.rows["encoder_rad"]
    direction = line_direction(calibration, theta)
    sensor_m, ground_m = np.full(len(theta), 2450.0), heights(flown.truth["left.point_e"])
    rho = flown.rows["range_m"] / group_index(sensor_m, ground_m)
    points_s = rho[:, np.newaxis] * direction
    limits = bound(flown, **SREP_24_BIT)
    missed = misses(flown, ground_points(calibration, track, flown.time_s, points_s, theta, bending))
    assert (missed <= limits).all(), missed.max()
    assert misses(flown, ground_points(calibration, track, flown.time_s, points_s, theta)).max() > 0.01
    uncorrected = flown.rows["range_m"][:, np.newaxis] * direction
    assert misses(flown, ground_points(calibration, track, flown.time_s, uncorrected, theta, bending)).min() > 0.4


def heights(points_e: FloatArray) -> FloatArray:
    """Return ellipsoidal heights."""
    x, y, z = points_e.T
    _, _, above_m = TO_GEODETIC.transform(x, y, z)
    return np.asarray(above_m)


def pulse_angles(flown: Flown) -> FloatArray:
    """θ of every return, its derivatives from the readings of all pulses; pulses without a return are bridged."""
    _, first, back = np.unique(flown.rows["pulse_id"], return_index=True, return_inverse=True)
    step_s = 1.0 / flown.plan.tables.scanner["left"].prf_hz
    number = np.rint((flown.time_s[first] - flown.time_s[first[0]]) / step_s).astype(int)
    steady = CubicSpline(number, flown.rows["encoder_rad"][first])(np.arange(number[-1] + 1))
    time_s = flown.time_s[0] + step_s * np.arange(number[-1] + 1)
    angles: FloatArray = beam_angle(flown.calibration, time_s, steady)[number][back]
    return angles


SREP_24_BIT = {"range_quantum_m": 1e-4, "angle_quantum_rad": 2 * 2 * np.pi / 2**24, "time_quantum_s": 1e-7}


@pytest.mark.parametrize("motion", ["sine", "triangle"])
def test_points_of_an_oscillating_mirror_are_recovered_with_every_error(tmp_path: Path, motion: str) -> None:
    true = dict(EVERY_ERROR)
    if motion == "triangle":  # at its turning points nobody knows a derivative by the readings alone
        true |= {"encoder_latency_us": 0.0, "torsion_us2": 0.0}
    scanner = {"motion": motion, "true": true, "installation": TURNED}
    scanner["ibrc"] = {"intensity": [0.0, 500.0, 2000.0, 65535.0], "correction_m": [0.02, 0.01, -0.005, -0.03]}
    flown = fly_and_decode(tmp_path, {"scanner": {"left": scanner}})
    theta = pulse_angles(flown)
    missed = misses(flown, line_points(flown, theta, line_direction(flown.calibration, theta)))
    limits = bound(flown, **SREP_24_BIT)
    assert (missed <= limits).all(), (missed.max(), np.argmax(missed - limits))
    assert missed.max() <= 2e-3


def test_points_of_a_polygon_are_recovered_with_facet_tilts(tmp_path: Path) -> None:
    true = EVERY_ERROR | {"torsion_us2": 0.0}
    facets = [{"index": 0, "tilt_deg": 0.03}, {"index": 1, "tilt_deg": -0.02}, {"index": 3, "tilt_deg": 0.01}]
    scanner = {"kind": "polygon", "facets": 4, "half_angle_deg": 35.0, "true": true, "facet": facets}
    flown = fly_and_decode(tmp_path, {"scanner": {"left": scanner}})
    calibration, facet = flown.calibration, flown.rows["channel"]
    theta = (1 + calibration.value("scan_angle_scale_ppm")) * (
        flown.rows["encoder_rad"] - calibration.value("scan_angle_offset_deg")
    ) + calibration.value("encoder_latency_us") * 4 * np.pi * 40.0  # the polygon turns evenly
    tilt = np.array([calibration.facets.get(number, 0.0) for number in range(4)])[facet]
    eta = np.full_like(theta, calibration.value("scan_plane_tilt_deg"))
    laser = np.stack([-np.sin(eta), -np.cos(eta), np.zeros_like(eta)], axis=1)
    normal = np.stack(
        [np.sin(tilt), np.cos(tilt) * np.sin((np.pi / 2 + theta) / 2), np.cos(tilt) * np.cos((np.pi / 2 + theta) / 2)],
        axis=1,
    )
    missed = misses(flown, line_points(flown, theta, mirrored(laser, normal)))
    assert set(facet.tolist()) == {0, 1, 2, 3}
    assert (missed <= bound(flown, **SREP_24_BIT)).all(), missed.max()
    flat = line_points(flown, theta, line_direction(calibration, theta))
    assert misses(flown, flat).max() > 0.3  # and the tilts were there: 2 ε cos i at 800 m


def mirrored(ray: FloatArray, normal: FloatArray) -> FloatArray:
    """Rays behind flat mirrors: a half turn about the normal, and back."""
    behind: FloatArray = -Rotation.from_rotvec(np.pi * normal).apply(ray)
    return behind


def test_points_of_a_monogon_are_recovered_with_every_error(tmp_path: Path) -> None:
    true = EVERY_ERROR | {"torsion_us2": 0.0}
    scanner = {"kind": "monogon", "half_angle_deg": 50.0, "scan_hz": 60.0, "true": true}
    flown = fly_and_decode(tmp_path, {"scanner": {"left": scanner}})
    calibration = flown.calibration
    theta = (1 + calibration.value("scan_angle_scale_ppm")) * (
        flown.rows["encoder_rad"] - calibration.value("scan_angle_offset_deg")
    ) + calibration.value("encoder_latency_us") * 2 * np.pi * 60.0
    missed = misses(flown, line_points(flown, theta, line_direction(calibration, theta)))
    assert (missed <= bound(flown, **SREP_24_BIT)).all(), missed.max()


ROUND_ERRORS = EVERY_ERROR | {
    "scan_plane_tilt_deg": 0.0,
    "pitch_slope_ppm": 0.0,
    "torsion_us2": 0.0,
    "scan_angle_scale_ppm": 0.0,
}


def shaft_angle(flown: Flown, scan_hz: float) -> FloatArray:
    """γ of a shaft that turns evenly."""
    offset = flown.calibration.value("scan_angle_offset_deg")
    latency = flown.calibration.value("encoder_latency_us") * 2 * np.pi * scan_hz
    angle: FloatArray = flown.rows["encoder_rad"] - offset + latency
    return angle


def test_points_of_a_nutating_mirror_are_recovered(tmp_path: Path) -> None:
    scanner = {"kind": "nutating", "nutation_deg": 7.0, "scan_hz": 30.0, "true": ROUND_ERRORS}
    flown = fly_and_decode(tmp_path, {"scanner": {"left": scanner}})
    gamma, psi = shaft_angle(flown, 30.0), np.radians(7.0)
    shaft, forward, right = np.array([-1, 0, 1]) / np.sqrt(2), np.array([1, 0, 1]) / np.sqrt(2), np.array([0, 1, 0])
    aside = np.cos(gamma)[:, np.newaxis] * forward + np.sin(gamma)[:, np.newaxis] * right
    laser = np.tile([1.0, 0.0, 0.0], (len(gamma), 1))
    direction = mirrored(laser, np.cos(psi) * shaft + np.sin(psi) * aside)
    missed = misses(flown, line_points(flown, np.zeros_like(gamma), direction))
    assert (missed <= bound(flown, **SREP_24_BIT)).all(), missed.max()


def test_points_of_a_risley_pair_are_recovered(tmp_path: Path) -> None:
    scanner = {"kind": "risley", "wedge_deg": [10.0, 12.0], "prism_ratio": -0.75, "scan_hz": 40.0, "true": ROUND_ERRORS}
    flown = fly_and_decode(tmp_path, {"scanner": {"left": scanner}})
    gamma = shaft_angle(flown, 40.0)
    turns = whole_turns(flown, 40.0)
    ray = np.tile([0.0, 0.0, 1.0], (len(gamma), 1))
    for angle, wedge in ((gamma, 10.0), (-0.75 * (gamma + 2 * np.pi * turns), 12.0)):
        flat = np.tile([0.0, 0.0, 1.0], (len(gamma), 1))
        sloped = Rotation.from_euler("ZY", np.stack([angle, np.full_like(angle, np.radians(wedge))], axis=1)).apply(
            flat
        )
        ray = bent(bent(ray, flat, 1 / 1.51), sloped, 1.51)
    missed = misses(flown, line_points(flown, np.zeros_like(gamma), ray))
    assert (missed <= bound(flown, **SREP_24_BIT)).all(), missed.max()


def whole_turns(flown: Flown, scan_hz: float) -> FloatArray:
    """Turns of an even shaft that its reading leaves out."""
    time_s = flown.time_s + flown.calibration.value("time_offset_us")
    turns: FloatArray = np.rint(scan_hz * time_s - flown.rows["encoder_rad"] / (2 * np.pi))
    return turns


def bent(ray: FloatArray, normal: FloatArray, ratio: float) -> FloatArray:
    """Snell's law as a turn in the plane of incidence."""
    across = np.cross(normal, ray)
    sine = np.linalg.norm(across, axis=1)
    turn = np.arcsin(ratio * sine) - np.arcsin(sine)
    axis = across / np.where(sine > 0, sine, 1.0)[:, np.newaxis]
    refracted: FloatArray = Rotation.from_rotvec(turn[:, np.newaxis] * axis).apply(ray)
    return refracted


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


@pytest.mark.parametrize("dual", [False, True])
def test_points_of_a_vlp16_are_recovered(tmp_path: Path, dual: bool) -> None:
    scanner = {"kind": "vlp16", "scan_hz": 10.0, "true": SPINNING_ERRORS, "installation": SIDEWAYS, "dual_return": dual}
    scanner |= {"range_min_m": 1.0, "range_max_m": 120.0, "reference_range_m": 60.0}
    flown = fly_and_decode(tmp_path, LOW_AND_SLOW | {"scanner": {"left": scanner}}, stop_s=1.3)
    points_s = velodyne_points(corrected_rows(flown, 10.0), VLP16.beams)
    angle_quantum_rad = np.radians(0.01) * vlp16_quanta(flown.truth["left.pulse"], groups=6 if dual else 12)
    check_spinning(flown, points_s, range_quantum_m=0.002, angle_quantum_rad=angle_quantum_rad, time_quantum_s=1e-6)


def vlp16_quanta(pulse: NDArray[np.int64], groups: int) -> FloatArray:
    """How many quanta of azimuth a firing's azimuth is good to.

    Between two groups of a packet it is interpolated: one. Behind the last group it goes on from the last two, a_n and
    a_n + t (a_n − a_n−1) for the share t of the time from group to group: 1 + 2t.
    """
    place = pulse % 32
    share = ((place // 16) * 55.296 + (place % 16) * 2.304) / 110.592  # VLP-16 manual, 9.4
    last = pulse // 32 % groups == groups - 1
    return np.where(last, 1.0 + 2.0 * share, 1.0)


def test_points_of_an_os1_are_recovered(tmp_path: Path) -> None:
    scanner = {"kind": "os1", "scan_hz": 10.0, "true": SPINNING_ERRORS, "installation": SIDEWAYS, "serial": "1"}
    scanner |= {"range_min_m": 1.0, "range_max_m": 120.0, "reference_range_m": 60.0}
    flown = fly_and_decode(tmp_path, LOW_AND_SLOW | {"scanner": {"left": scanner}}, stop_s=1.3)
    points_s = ouster_points(corrected_rows(flown, -10.0), read_head(flown.files["left.json"]))
    check_spinning(flown, points_s, range_quantum_m=0.001, angle_quantum_rad=0.0, time_quantum_s=1e-9)


def corrected_rows(flown: Flown, scan_hz: float) -> NDArray[np.void]:
    """Rows with what CONVENTIONS adds to range and azimuth."""
    rows = flown.rows.copy()
    rows["range_m"] = corrected_range(flown.calibration, rows["range_m"], rows["intensity"])
    rows["encoder_rad"] -= flown.calibration.value("scan_angle_offset_deg")
    rows["encoder_rad"] += flown.calibration.value("encoder_latency_us") * 2 * np.pi * scan_hz
    return rows


def check_spinning(flown: Flown, points_s: FloatArray, **quanta: Any) -> None:
    """Ground points of a spinning head against the truth."""
    time_s = flown.time_s + flown.calibration.value("time_offset_us")
    points = ground_points(flown.calibration, flown.track(), time_s, points_s, np.zeros(len(time_s)))
    missed, limits = misses(flown, points), bound(flown, **quanta)
    assert (missed <= limits).all(), (missed.max(), np.argmax(missed - limits))
