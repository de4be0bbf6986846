"""Provides the virtual aircraft's flights, inertial units and receivers for navigation, without wires and logs.

`swath.sim.flight.trajectory` flies the path once; units and receivers draw new errors with each seed, as in
`swath.sim.imu.sensors` and `swath.sim.gnss.receiver`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import t as student

from swath.georef.arrays import BoolArray, FloatArray, StructArray
from swath.georef.navigation.inputs import ImuNoise, Inertial, Kind, Solution, imu_noise
from swath.georef.records import FixType
from swath.georef.timescales import SECOND_NS
from swath.sim.flight.trajectory import fly
from swath.sim.gnss.receiver import Receiver
from swath.sim.imu.sensors import InertialUnit, true_increments
from swath.sim.plan.plan import parse_plan
from swath.sim.plan.tables import GnssTable, ImuNoiseTable, ImuTable
from swath.sim.site import Site, e_from_geodetic, rot_e_from_ned
from tests.georef.navigation.flights import Truth, errors
from tests.georef.navigation.vehicles import BEGIN_NS, ns, observed

ARM = (0.35, -0.12, -1.1)
WHITE_M = np.array([0.01, 0.01, 0.02])
BEGIN_S = 20.0  # at rest
RATE_HZ = 200
LIKELY = (0.005, 0.995)
LASTING_H = 1e4  # a bias with so long a time constant is constant

# The sensors of fixtures/navigation/reference_flight; mGal of accelerometers are converted to mg
REFERENCE = {
    "tactical": ImuNoiseTable(
        angle_random_walk_deg_per_sqrt_h=0.04, velocity_random_walk_m_per_s_per_sqrt_h=0.03,
        gyro_bias_deg_per_h=1.0, accel_bias_mg=0.10197, gyro_bias_instability_deg_per_h=0.0,
        accel_bias_instability_mg=0.0, gyro_scale_ppm=200.0, accel_scale_ppm=200.0, misalignment_mrad=0.0,
    ),
    "mems": ImuNoiseTable(
        angle_random_walk_deg_per_sqrt_h=0.15, velocity_random_walk_m_per_s_per_sqrt_h=0.10,
        gyro_bias_deg_per_h=25.0, accel_bias_mg=0.20394, gyro_bias_instability_deg_per_h=0.0,
        accel_bias_instability_mg=0.0, gyro_scale_ppm=1000.0, accel_scale_ppm=1000.0, misalignment_mrad=0.0,
    ),
}  # fmt: skip


def reference_noise(name: str) -> ImuNoise:
    """Return the noise that a filter is to assume for `REFERENCE`; biases are drawn at power-on and stay constant."""
    table = REFERENCE[name]
    return imu_noise(
        float(table.angle_random_walk_deg_per_sqrt_h or 0.0),
        float(table.velocity_random_walk_m_per_s_per_sqrt_h or 0.0),
        float(table.gyro_bias_deg_per_h or 0.0),
        float(table.accel_bias_mg or 0.0),
        LASTING_H,
        float(table.gyro_scale_ppm or 0.0),
        float(table.accel_scale_ppm or 0.0),
    )


@dataclass(frozen=True, eq=False)
class Aircraft:
    """A simulated flight.

    Attributes:
        truth: exact increments between the ends of the samples, and the motion at any time.
        on_line: (n,) True where the sample ends on a flight line.
    """

    truth: Truth
    on_line: BoolArray

    @property
    def end_s(self) -> float:
        """Return the end of the flight in s."""
        return float(self.truth.edges[-1])


def aircraft(plan_text: str) -> Aircraft:
    """Fly a plan above a plain; of its tables only ``flight``, ``ground`` and ``line`` matter."""
    plan = parse_plan(plan_text, Path())
    trajectory = fly(plan, Site.at(*plan.tables.flight.origin_deg), lambda east_m, north_m: np.full(len(east_m), 450.0))
    unit = InertialUnit(ImuTable(rate_hz=RATE_HZ), trajectory, 0, "main", noise=False)
    edges_s = unit.ends_s(np.arange(unit.last + 1))
    exact = true_increments(trajectory, edges_s)
    truth = Truth(edges_s, exact.angle_b, exact.velocity_b, trajectory)
    return Aircraft(truth, trajectory.line_at(edges_s[1:]) >= 0)


def survey_plan(lines: int, length_m: float, *, static_s: float) -> str:
    """Return a plan from a runway over two short crossing lines to lines there and back, flown at 60 m/s."""
    ends = [((1500.0, -2500.0), (1500.0, -2000.0)), ((3000.0, -1500.0), (2500.0, -1500.0))]
    for k in range(lines):
        way = (0.0, 400.0 * k), (length_m, 400.0 * k)
        ends.append(way if k % 2 == 0 else way[::-1])
    text = f"""
[flight]
name = "seeds"
seed = 3
speed_mps = 60.0
[ground]
runway_m = [0, -4000]
heading_deg = 35.0
height_m = 450.0
static_s = {static_s}
"""
    for k, (begin, end) in enumerate(ends):
        text += f'[[line]]\nname = "{k}"\nfrom_m = {list(begin)}\nto_m = {list(end)}\nheight_m = 800\n'
    return text


def sensed(flown: Aircraft, table: ImuTable, seed: int) -> Inertial:
    """Return a unit's samples, with errors drawn from a seed; times are exact."""
    truth = flown.truth
    errors_of = InertialUnit(table, truth.flight, seed, "main", noise=True).errors
    count, rate_hz = len(truth.angle_b), table.rate_hz
    noise = np.concatenate([errors_of.of_second(second) for second in range(count // rate_hz + 1)])[1 : count + 1]
    force, rate = errors_of.matrices
    span_s = 1.0 / rate_hz
    return Inertial(
        ns(truth.edges[1:]),
        np.diff(truth.edges),
        truth.angle_b @ rate.T + span_s * noise[:, 3:],
        truth.velocity_b @ force.T + span_s * noise[:, :3],
        np.zeros(count, np.bool_),
    )


def white_fixes(flown: Aircraft, seed: int) -> StructArray:
    """Return positions of the antenna once a second, with white errors of 1, 1 and 2 cm."""
    t = np.arange(1.0, flown.end_s)
    at = flown.truth.flight.motion(t)
    place = at.position_e + at.rot_e_from_b @ np.array(ARM)
    lat, lon, _ = flown.truth.flight.geodetic(t)
    off = np.random.default_rng([seed, 77]).standard_normal((len(t), 3)) * WHITE_M
    return observed(
        Kind.POSITION, t, place + np.einsum("nij,nj->ni", rot_e_from_ned(lat, lon), off), WHITE_M, FixType.RTK_FIXED
    )


def receiver_fixes(flown: Aircraft, seed: int, rate_hz: int = 1) -> StructArray:
    """Return positions and velocities of the virtual RTK receiver, with the sigmas that it states."""
    table = GnssTable.model_validate({"protocol": "ubx", "rate_hz": rate_hz, "lever_arm_m": list(ARM)})
    epochs = Receiver(table, flown.truth.flight, seed=seed, name="rover", noise=True).epochs(
        rate_hz, int(flown.end_s - 1.0) * rate_hz
    )
    place = e_from_geodetic(epochs.lat_rad, epochs.lon_rad, epochs.height_m)
    rows = [
        observed(Kind.POSITION, epochs.time_s, place, epochs.position_sigma_l, FixType.RTK_FIXED),
        observed(Kind.VELOCITY, epochs.time_s, epochs.velocity_l, epochs.velocity_sigma_l, FixType.RTK_FIXED),
    ]
    return np.concatenate(rows)


def on_lines(flown: Aircraft, solution: Solution, step: int = 20) -> tuple[FloatArray, FloatArray]:
    """Return (6,) mean squares on the lines of errors north, east, down, roll, pitch, heading, and of their sigmas."""
    first = round((int(solution.time_ns[0]) - int(ns(flown.truth.edges[1]))) / SECOND_NS * RATE_HZ)
    at = np.flatnonzero(flown.on_line[first : first + len(solution)])[::step]
    t = (solution.time_ns[at] - BEGIN_NS) / SECOND_NS
    off = errors(flown.truth, t, solution.position_e[at], solution.velocity_e[at], solution.q_e_from_b[at])
    sigma = np.concatenate([solution.position_sigma_l[at], solution.attitude_sigma_rad[at]], axis=1)
    return (off[:, [0, 1, 2, 6, 7, 8]] ** 2).mean(axis=0), (sigma**2).mean(axis=0)


@dataclass(frozen=True, eq=False)
class Seeds:
    """RMS on the lines over many flights, of north, east, down, roll, pitch, heading, (6,) each.

    Attributes:
        measured, predicted: of all flights together, m and rad.
        low, high: the 99 % interval of the measured value if the prediction is right.
    """

    measured: FloatArray
    predicted: FloatArray
    low: FloatArray
    high: FloatArray

    @property
    def holds(self) -> BoolArray:
        """Return (6,) whether the measured values lie within their bounds."""
        return (self.low <= self.measured) & (self.measured <= self.high)


def seeds_of(squares: list[tuple[FloatArray, FloatArray]]) -> Seeds:
    """Summarise the results of `on_lines` of many flights.

    The flights' own scatter gives the uncertainty of the mean of n flights: Student's t of n − 1 degrees of freedom, of
    the logarithm, because mean squares are positive.
    """
    errors2, sigmas2 = (np.stack(column) for column in zip(*squares, strict=True))
    share = errors2 / sigmas2
    scatter = share.std(axis=0, ddof=1) / share.mean(axis=0) / np.sqrt(len(share))
    predicted = np.sqrt(sigmas2.mean(axis=0))
    low, high = (predicted * np.exp(0.5 * student.ppf(p, len(share) - 1) * scatter) for p in LIKELY)
    return Seeds(np.sqrt(errors2.mean(axis=0)), predicted, low, high)
