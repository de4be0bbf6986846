"""Judges the values of devices of a system that stands still: specific force, rates, fix, heading, ranges.

Whether bytes come and decode is checked elsewhere; here it is whether they can be true at rest. The limits leave room
for cheap sensors and for an aircraft that stands on its tail wheel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from swath.georef.arrays import FloatArray, SingleArray
from swath.georef.records import FixType, GnssFix, GnssHeading, ImuSamples, Record, ScannerReturns

GRAVITY_MPS2 = 9.81
GRAVITY_TOLERANCE_MPS2 = 0.3
MOVES_MPS2 = 0.5  # standard deviation of the specific force; engines and people leave less
TURNS_DEG_S = 1.0  # a mean rate that no bias of a usable gyro reaches
RATE_TOLERANCE = 0.1  # of the nominal rate: stamps of the first and last sample are those of their arrival
LEAST_SAMPLES, LEAST_SPAN_S = 20, 0.5
FEW_SATELLITES = 5
DARK_SHARE = 0.01  # of pulses with a return: a head in a hall or over a lawn has far more
BLOCK = 1 << 16
MOST_DARK = 1_000_000  # pulses in a row without a return; more is another beginning of the count
KEPT_RANGES = 2_000_000
BASELINE_TOLERANCE = 0.05  # of the distance between the antennas, and at least as many metres
AXES = ("x, forward", "y, right", "z, down")


@dataclass(slots=True)
class InertialValues:
    """Sums over the inertial samples of a device, in its own axes."""

    count: int = 0
    force: FloatArray = field(default_factory=lambda: np.zeros(3))
    force_squared: FloatArray = field(default_factory=lambda: np.zeros(3))
    rate: FloatArray = field(default_factory=lambda: np.zeros(3))
    first_ns: int = 0
    last_ns: int = 0

    def add(self, record: ImuSamples) -> None:
        """Add the samples of a record."""
        rows = record.rows
        force, rate = rows["specific_force_b"], rows["angular_rate_b"]
        finite = np.isfinite(force).all(axis=1) & np.isfinite(rate).all(axis=1)
        if not finite.any():
            return
        if not self.count:
            self.first_ns = int(rows["host_time_ns"][0])
        self.last_ns = int(rows["host_time_ns"][-1])
        self.count += int(finite.sum())
        self.force += force[finite].sum(axis=0)
        self.force_squared += np.square(force[finite]).sum(axis=0)
        self.rate += rate[finite].sum(axis=0)


@dataclass(slots=True)
class ReturnValues:
    """Counts of pulses and the ranges of a scanner.

    A spinning head numbers all its pulses, so that those without a return show as missing numbers; a line scanner
    begins a block of `BLOCK` numbers with each datagram.
    """

    in_blocks: bool = False
    pulses: int = 0
    with_return: int = 0
    ranges_m: list[SingleArray] = field(default_factory=list)
    kept: int = 0
    last_pulse: int = -MOST_DARK

    def add(self, record: ScannerReturns) -> None:
        """Add the returns of a record."""
        rows = record.rows
        if not len(rows):
            return
        numbers = np.unique(rows["pulse_id"].astype(np.int64))
        self.with_return += len(numbers)
        if self.in_blocks:
            begins = np.concatenate([[0], np.flatnonzero(np.diff(numbers // BLOCK)) + 1])
            ends = np.concatenate([begins[1:], [len(numbers)]]) - 1
            self.pulses += int((numbers[ends] - numbers[begins] + 1).sum())
        else:
            between = int(numbers[0]) - self.last_pulse
            dark = between - 1 if 0 < between < MOST_DARK else 0
            self.pulses += dark + int(numbers[-1] - numbers[0]) + 1
            self.last_pulse = int(numbers[-1])
        if self.kept < KEPT_RANGES:
            self.kept += len(rows)
            self.ranges_m.append(rows["range_m"].astype(np.float32))


class Values:
    """Collects what is judged of one device."""

    def __init__(self, *, line_scanner: bool = False) -> None:
        self._inertial = InertialValues()
        self._returns = ReturnValues(in_blocks=line_scanner)
        self._fix: GnssFix | None = None
        self._heading: GnssHeading | None = None

    def add(self, records: list[Record]) -> None:
        """Add records of the device."""
        for record in records:
            if isinstance(record, ImuSamples):
                self._inertial.add(record)
            elif isinstance(record, ScannerReturns):
                self._returns.add(record)
            elif isinstance(record, GnssFix):
                self._fix = record
            elif isinstance(record, GnssHeading) and record.valid:
                self._heading = record

    def judge(self, kind: str, config: Mapping[str, Any]) -> tuple[list[str], list[str]]:
        """Return facts and doubts of the device, a line each.

        Args:
            kind: gnss, imu, scanner or corrections.
            config: its table of the configuration.
        """
        facts: list[str] = []
        doubts: list[str] = []
        if kind == "imu" and self._inertial.count >= LEAST_SAMPLES:
            doubts += _inertial_doubts(self._inertial, config, facts)
        if kind == "gnss":
            doubts += _fix_doubts(self._fix, facts)
            doubts += _heading_doubts(self._heading, config, facts)
        if kind == "scanner" and self._returns.pulses:
            doubts += _return_doubts(self._returns, config, facts)
        return facts, doubts


def _inertial_doubts(values: InertialValues, config: Mapping[str, Any], facts: list[str]) -> Iterator[str]:
    span_s = (values.last_ns - values.first_ns) * 1e-9
    nominal_hz = float(config.get("rate_hz") or 0.0)
    if span_s >= LEAST_SPAN_S and nominal_hz > 0.0:
        rate_hz = (values.count - 1) / span_s
        facts.append(f"{rate_hz:.1f} samples/s")
        if abs(rate_hz / nominal_hz - 1.0) > RATE_TOLERANCE:
            yield f"sends {rate_hz:.1f} samples/s, but rate_hz is {nominal_hz:g}; set one like the other"
    rot_b_from_imu = np.array(config.get("rotation_b_imu", np.eye(3)), np.float64)
    mean = values.force / values.count
    varies = math.sqrt(max(0.0, float((values.force_squared / values.count - np.square(mean)).sum())))
    if varies > MOVES_MPS2:
        yield f"its specific force varies by {varies:.1f} m/s²; repeat the check while it stands still"
        return
    length, turn_deg_s = float(np.linalg.norm(mean)), math.degrees(float(np.linalg.norm(values.rate))) / values.count
    facts.append(f"specific force {length:.2f} m/s², angular rate {turn_deg_s:.2f} °/s")
    if abs(length - GRAVITY_MPS2) > GRAVITY_TOLERANCE_MPS2:
        unit = "; it looks like g: correct its unit" if 0.9 < length < 1.1 else "; check its unit and scale"
        yield f"its specific force is {length:.2f} m/s² at rest, want {GRAVITY_MPS2} ± {GRAVITY_TOLERANCE_MPS2}{unit}"
    if turn_deg_s > TURNS_DEG_S:
        yield (
            f"its angular rate is {turn_deg_s:.1f} °/s at rest, want below {TURNS_DEG_S:g}; "
            "check its unit, or let it find its biases"
        )
    if length > 0.5 * GRAVITY_MPS2:
        yield from gravity_doubts(rot_b_from_imu, mean / length)


def gravity_doubts(rot_b_from_imu: FloatArray, force_imu: FloatArray) -> Iterator[str]:
    """Yield a line if specific force at rest does not point up, along −z of the body (z is down: conventions).

    Args:
        rot_b_from_imu: (3, 3) as configured.
        force_imu: (3,) unit vector of the specific force in the IMU's axes.
    """
    force_b = rot_b_from_imu @ force_imu
    axis = int(np.argmax(np.abs(force_b)))
    positive = bool(force_b[axis] > 0.0)
    if axis == 2 and not positive:
        return
    down = -rot_b_from_imu[axis] if positive else rot_b_from_imu[axis]
    row = "[" + ", ".join(f"{value + 0.0:.7g}" for value in np.round(down, 7)) + "]"
    rest = "change the sign of row 1 or 2 too" if axis == 2 else f"choose row {axis + 1} anew"
    yield (
        f"gravity is not on the body's z: the specific force at rest points to {'+' if positive else '−'}"
        f"{AXES[axis]}, want −z, up; row 3 of rotation_b_imu must be {row}: {rest}, so that it stays a rotation"
    )


def _fix_doubts(fix: GnssFix | None, facts: list[str]) -> Iterator[str]:
    if fix is None:
        return
    name = fix.fix_type.name.lower().replace("_", " ").replace("rtk", "RTK").replace("ppp", "PPP")
    satellites = "" if fix.satellites is None else f", {fix.satellites} satellites"
    facts.append(f"fix: {name}{satellites}")
    if fix.fix_type is FixType.NONE or not fix.valid:
        yield f"has no position yet (fix {name}{satellites}); wait, and give the antenna a free view of the sky"
    elif fix.fix_type in (FixType.SIMULATED, FixType.MANUAL):
        yield f"its position is {name}, not measured; switch the receiver to measured positions"
    elif fix.satellites is not None and fix.satellites < FEW_SATELLITES:
        yield f"uses {fix.satellites} satellites only; give the antenna a free view of the sky"


def _heading_doubts(heading: GnssHeading | None, config: Mapping[str, Any], facts: list[str]) -> Iterator[str]:
    second = config.get("secondary_lever_arm_m")
    if heading is not None:
        facts.append(f"heading {math.degrees(heading.heading_rad) % 360.0:.2f}°")
    if second is None:
        return
    if heading is None:
        yield (
            "secondary_lever_arm_m is configured, but no valid heading came; enable its message, and check the "
            "second antenna"
        )
    elif heading.baseline_m:
        wanted_m = float(np.linalg.norm(np.subtract(second, config["lever_arm_m"])))
        if abs(heading.baseline_m - wanted_m) > max(BASELINE_TOLERANCE, BASELINE_TOLERANCE * wanted_m):
            yield (
                f"its antennas are {heading.baseline_m:.2f} m apart, but {wanted_m:.2f} m by lever_arm_m and "
                "secondary_lever_arm_m; measure them again"
            )


def _return_doubts(values: ReturnValues, config: Mapping[str, Any], facts: list[str]) -> Iterator[str]:
    share = values.with_return / values.pulses
    median_m = float(np.median(np.concatenate(values.ranges_m)))
    facts.append(f"{100.0 * share:.0f} % of its pulses have a return, median range {median_m:.2f} m")
    if share < DARK_SHARE:
        yield f"only {100.0 * share:.2g} % of its pulses have a return; check that its window is clean and uncovered"
    least_m, most_m = float(config.get("range_min_m", 0.0)), float(config.get("range_max_m", math.inf))
    if not least_m <= median_m <= most_m:
        yield (
            f"its median range is {median_m:.2f} m, outside range_min_m {least_m:g} to range_max_m {most_m:g}; "
            "products would leave these returns out"
        )
