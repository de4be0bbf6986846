"""Inputs and outputs of the kernels, as tuples that numba accesses by name."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import ByteArray, FloatArray, Int64Array, SingleArray

Two: TypeAlias = tuple[float, float]
Three: TypeAlias = tuple[float, float, float]
Six: TypeAlias = tuple[float, float, float, float, float, float]
Eight: TypeAlias = tuple[float, float, float, float, float, float, float, float]
Matrix: TypeAlias = tuple[Three, Three, Three]


class Ranging(NamedTuple):
    """Parameters from the measured range to ρ.

    Attributes:
        scale, offset_m: 1 + range_scale, range_offset.
        minimum_m, maximum_m: of ρ; returns beyond are left out.
        delta_m: (256, 256) added by return number and MTA zone; (1, 1): no such offsets.
        ibrc_intensity, ibrc_m: (k,) knots; empty: no table.
        ibrc_slope: (k − 1,) from each knot to the next.
        ibrc_bucket: (b,) the knot before each of b equal steps from the first knot on.
        ibrc_buckets_per_unit: of intensity.
    """

    scale: float
    offset_m: float
    minimum_m: float
    maximum_m: float
    delta_m: FloatArray
    ibrc_intensity: FloatArray
    ibrc_m: FloatArray
    ibrc_slope: FloatArray
    ibrc_bucket: Int64Array
    ibrc_buckets_per_unit: float


class Scanning(NamedTuple):
    """Parameters from the encoder reading to θ, and from θ to the beam.

    Attributes:
        kind, table: of the geometry (`swath.georef.scanner.kernels.beam`).
        select: how a row chooses its channel of the table.
        scale, offset_rad, latency_s, torsion_s2: of the parameters.
        rate, acceleration: (n,) of the readings; (0,): not used.
        elevation: (n,) of the returns; (0,): the table has those of the beams.
    """

    kind: int
    table: FloatArray
    select: int
    scale: float
    offset_rad: float
    latency_s: float
    torsion_s2: float
    rate: FloatArray
    acceleration: FloatArray
    elevation: FloatArray


class Mounted(NamedTuple):
    """The head's axes to b: x_b = lever_arm_b + outer · Ry(slope · θ) · (inner · x + shift).

    Attributes:
        outer: (1, 3, 3) Rx(ω) Ry(φ).
        slope: of φ with θ.
        inner, shift: (m, 3, 3), (m, 3): Rz(κ), gimbal, installation and the head's own frame; m = 1, or one per row.
        shifted: whether beams start elsewhere than at the lever arm's end; False saves a step.
        known: (m,) whether a gimbal's angles are known at the row's time.
        lever_arm_b: (1, 3).
    """

    outer: FloatArray
    slope: float
    inner: FloatArray
    shift: FloatArray
    shifted: bool
    known: ByteArray
    lever_arm_b: FloatArray


class Track(NamedTuple):
    """The trajectory, and the offsets from a pulse's stamp to its times.

    Attributes:
        time_ns, position_e, q_e_from_b, rotvec_b, max_gap_ns: of `swath.georef.trajectory.trajectory.Trajectory`.
        offset_ns, latency_ns: time_offset, imu_latency.
    """

    time_ns: Int64Array
    position_e: FloatArray
    q_e_from_b: FloatArray
    rotvec_b: FloatArray
    max_gap_ns: int
    offset_ns: float
    latency_ns: float


class Model(NamedTuple):
    """All inputs of a pass over returns."""

    ranging: Ranging
    scanning: Scanning
    mounted: Mounted
    track: Track


class Out(NamedTuple):
    """The first half of `swath.georef.points.Rays`."""

    fate: ByteArray
    time_ns: Int64Array
    points_e: FloatArray
    origin_e: FloatArray
    angle_rad: FloatArray
    off_nadir_rad: FloatArray
    range_m: FloatArray


class Axes(NamedTuple):
    """The second half, vectors as columns: (3, n), (4, n)."""

    q_e_from_b: FloatArray
    epoch: Int64Array
    share: FloatArray
    arm_b: FloatArray
    range_axis_b: FloatArray
    angle_axis_b: FloatArray
    tilt_axis_b: FloatArray


class PointColumns(NamedTuple):
    """Columns (n,) of `swath.georef.points.Points`."""

    time_ns: Int64Array
    scan_angle_rad: SingleArray
    range_m: SingleArray
    intensity: SingleArray
    return_number: ByteArray
    number_of_returns: ByteArray
    channel: NDArray[np.uint16]
    mta_zone: ByteArray
