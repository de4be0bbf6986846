"""Grades of inertial units: figures in the units of data sheets, and the same in SI units.

A grade gives the values that the plan does not set under ``[imu.<name>.noise]``. Figures are one sigma; "instability"
is the greatest Allan deviation of the drifting part of a bias, which data sheets read from the floor of their curves.

- navigation: Honeywell HG9900 (brochure: 0.0035 °/h, 0.002 °/√h, 25 µg, 5 and 100 ppm). Its sheet gives no velocity
  random walk; the value here is the 8 µg/√Hz of the accelerometers in its class (iMAR iNAV-RQH).
- tactical: iMAR IMU-FSAS (0.75 °/h, 0.1 °/√h, 1 mg, 0.03 m/s/√h, 300 ppm); Honeywell HG1700 and HG1900 are similar (1
  °/h, 0.09 to 0.125 °/√h, 1 mg).
- mems: gyroscopes of an Analog Devices ADIS16488 (in run 6 °/h, 0.3 °/√h, axes to 0.05°), accelerometers of a Sensonor
  STIM300 (in run 0.05 mg, 0.07 m/s/√h); biases at turn-on and scale factors are those of a unit calibrated over
  temperature, not the sheets' repeatability over years.
- consumer: InvenSense MPU-6050 (PS-MPU-6000A 3.4: accelerometers ±50 and ±80 mg, 400 µg/√Hz, scale factors ±3 %, across
  axes ±2 %, read as limits; gyroscopes 0.005 °/s/√Hz); the gyroscopes' bias lies between the 0.1 °/s (El-Sheimy and
  Youssef 2020, Satellite Navigation 1:2) and 1 °/s (Xsens MTi-G) of such units.

The figures above come from the makers' sheets. The instabilities of the other grades, all other misalignments and the
biases and scale factors of the third grade are typical of such units and come from no sheet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from swath.sim.plan.tables import ImuNoiseTable, ImuTable

STANDARD_GRAVITY = 9.80665  # m/s², CGPM 1901
RAD = np.pi / 180.0

GRADES = {
    "navigation": ImuNoiseTable(
        angle_random_walk_deg_per_sqrt_h=0.002,
        velocity_random_walk_m_per_s_per_sqrt_h=0.005,
        gyro_bias_deg_per_h=0.0035,
        accel_bias_mg=0.025,
        gyro_bias_instability_deg_per_h=0.001,
        accel_bias_instability_mg=0.001,
        bias_correlation_h=1.0,
        gyro_scale_ppm=5.0,
        accel_scale_ppm=100.0,
        misalignment_mrad=0.01,
    ),
    "tactical": ImuNoiseTable(
        angle_random_walk_deg_per_sqrt_h=0.1,
        velocity_random_walk_m_per_s_per_sqrt_h=0.03,
        gyro_bias_deg_per_h=0.75,
        accel_bias_mg=1.0,
        gyro_bias_instability_deg_per_h=0.1,
        accel_bias_instability_mg=0.03,
        bias_correlation_h=1.0,
        gyro_scale_ppm=300.0,
        accel_scale_ppm=300.0,
        misalignment_mrad=0.1,
    ),
    "mems": ImuNoiseTable(
        angle_random_walk_deg_per_sqrt_h=0.3,
        velocity_random_walk_m_per_s_per_sqrt_h=0.07,
        gyro_bias_deg_per_h=36.0,
        accel_bias_mg=3.0,
        gyro_bias_instability_deg_per_h=6.0,
        accel_bias_instability_mg=0.05,
        bias_correlation_h=1.0,
        gyro_scale_ppm=1000.0,
        accel_scale_ppm=1000.0,
        misalignment_mrad=0.5,
    ),
    "consumer": ImuNoiseTable(
        angle_random_walk_deg_per_sqrt_h=0.5,
        velocity_random_walk_m_per_s_per_sqrt_h=0.24,
        gyro_bias_deg_per_h=1500.0,
        accel_bias_mg=80.0,
        gyro_bias_instability_deg_per_h=20.0,
        accel_bias_instability_mg=0.2,
        bias_correlation_h=1.0,
        gyro_scale_ppm=10_000.0,
        accel_scale_ppm=10_000.0,
        misalignment_mrad=10.0,
    ),
    "perfect": ImuNoiseTable(
        angle_random_walk_deg_per_sqrt_h=0.0,
        velocity_random_walk_m_per_s_per_sqrt_h=0.0,
        gyro_bias_deg_per_h=0.0,
        accel_bias_mg=0.0,
        gyro_bias_instability_deg_per_h=0.0,
        accel_bias_instability_mg=0.0,
        bias_correlation_h=1.0,
        gyro_scale_ppm=0.0,
        accel_scale_ppm=0.0,
        misalignment_mrad=0.0,
    ),
}


def noise_of(table: ImuTable) -> dict[str, float]:
    """Return every key of `ImuNoiseTable` with its value: the plan's, or the grade's if the plan does not set it."""
    return GRADES[table.grade].model_dump() | table.noise.model_dump(exclude_none=True)


@dataclass(frozen=True, slots=True)
class SensorGrade:
    """One triad, gyroscopes (base unit rad/s) or accelerometers (m/s²), in SI units, one sigma.

    Attributes:
        random_walk: white noise of the output, base unit · √s.
        bias: at turn-on, base unit.
        instability: greatest Allan deviation of the drift, base unit.
        correlation_s: longest time constant of the drift.
        scale: error of a scale factor.
        misalignment_rad: angles by which axes lean towards each other.
    """

    random_walk: float
    bias: float
    instability: float
    correlation_s: float
    scale: float
    misalignment_rad: float


def sensor_grades(table: ImuTable) -> tuple[SensorGrade, SensorGrade]:
    """Return the grades of the accelerometers and gyroscopes of a unit of the plan."""
    noise = noise_of(table)
    correlation_s, misalignment_rad = 3600.0 * noise["bias_correlation_h"], 1e-3 * noise["misalignment_mrad"]
    accelerometers = SensorGrade(
        random_walk=noise["velocity_random_walk_m_per_s_per_sqrt_h"] / 60.0,
        bias=noise["accel_bias_mg"] * 1e-3 * STANDARD_GRAVITY,
        instability=noise["accel_bias_instability_mg"] * 1e-3 * STANDARD_GRAVITY,
        correlation_s=correlation_s,
        scale=1e-6 * noise["accel_scale_ppm"],
        misalignment_rad=misalignment_rad,
    )
    gyroscopes = SensorGrade(
        random_walk=noise["angle_random_walk_deg_per_sqrt_h"] * RAD / 60.0,
        bias=noise["gyro_bias_deg_per_h"] * RAD / 3600.0,
        instability=noise["gyro_bias_instability_deg_per_h"] * RAD / 3600.0,
        correlation_s=correlation_s,
        scale=1e-6 * noise["gyro_scale_ppm"],
        misalignment_rad=misalignment_rad,
    )
    return accelerometers, gyroscopes
