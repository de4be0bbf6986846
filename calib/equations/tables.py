"""Inputs and outputs of the loops over rows, as named tuples that numba understands."""

from __future__ import annotations

from typing import NamedTuple

from swath.georef.arrays import ByteArray, FloatArray, Int64Array, StructArray
from swath.georef.scanner.kernels.types import Track

STATES, OF_PLANE = 8, 3  # columns of a row


class Beam(NamedTuple):
    """A batch's part of `swath.georef.points.Rays` of one swath, with vectors as columns, and its rows."""

    rows: StructArray
    fate: ByteArray
    time_ns: Int64Array
    points_e: FloatArray
    angle_rad: FloatArray
    range_m: FloatArray
    q_e_from_b: FloatArray
    epoch: Int64Array
    arm_b: FloatArray
    range_axis_b: FloatArray
    angle_axis_b: FloatArray
    tilt_axis_b: FloatArray
    encoder_rad: FloatArray
    encoder_rate: FloatArray
    encoder_acceleration: FloatArray


class Head(NamedTuple):
    """A scanner with its calibration.

    Attributes:
        at, kind, argument: (m,) of its unknowns (`swath.calib.parameters.Unknowns.of_head`).
        value: (16,) of its calibration.
        outer: (1, 3, 3) Rx(ω) Ry(φ).
        spin_b: (1, 3) a spinning head's axis.
        before_m: part of the range before the beam's start; nan: the start turns with the beam.
        nodes: (d,) intensities of its range correction; by_knot: (k, d) derivatives of that by its knots.
        range_m, angle_rad, elevation_rad, time_s, divergence_rad: sigmas of a return, and its beam; the elevation's
            is 0 where returns have none.
    """

    at: Int64Array
    kind: Int64Array
    argument: Int64Array
    value: FloatArray
    outer: FloatArray
    spin_b: FloatArray
    before_m: float
    nodes: FloatArray
    by_knot: FloatArray
    range_m: float
    angle_rad: float
    elevation_rad: float
    time_s: float
    divergence_rad: float


class Planes(NamedTuple):
    """Planes in e: (q, 3) normals, centres and two directions in each plane; (q,) offsets."""

    normal_e: FloatArray
    centre_e: FloatArray
    first_e: FloatArray
    second_e: FloatArray
    offset: FloatArray


class Knots(NamedTuple):
    """Trajectory states at knots.

    Attributes:
        time_ns: (k,).
        state: (k, 6) shift and turn in e.
        first: position of the first state among all unknowns.
        walk: (k,) variance of the attitude's random walk to the next knot, rad².
    """

    time_ns: Int64Array
    state: FloatArray
    first: int
    walk: FloatArray


class Sigmas(NamedTuple):
    """Sigmas of a trajectory whose errors are not estimated; otherwise empty, (0, 3).

    Attributes:
        position_l: (n, 3) north, east, down.
        attitude: (n, 3) roll, pitch, heading.
    """

    position_l: FloatArray
    attitude: FloatArray


class Groups(NamedTuple):
    """Runs of rows of one plane between two knots.

    Attributes:
        begin, end: (g,) in the batch.
        plane, before, after: (g,) indexes; knots −1: none.
        place_before, place_after: (g,) places of the knots' states in the plane's own list of unknowns.
        channel: (g,) −1: any.
    """

    begin: Int64Array
    end: Int64Array
    plane: Int64Array
    before: Int64Array
    after: Int64Array
    place_before: Int64Array
    place_after: Int64Array
    channel: Int64Array


class Sums(NamedTuple):
    """Normal equations before planes are eliminated.

    Attributes:
        normal, right: (u, u), (u,) of parameters and states.
        mixed: (entries, 3) plane by plane, one row for each unknown in the plane's list; first: (q,) where each begins.
        plane, plane_right: (q, 3, 3), (q, 3).
        square: (1,) Σ p f².
        counts: (1,) number of rows.
    """

    normal: FloatArray
    right: FloatArray
    mixed: FloatArray
    first: Int64Array
    plane: FloatArray
    plane_right: FloatArray
    square: FloatArray
    counts: Int64Array


class RowDiagnostics(NamedTuple):
    """Diagnostics of the rows (n,) of a batch.

    Attributes:
        misclosure: (n,) f.
        variance: (n,) M; with MODE_LOOK M + c, where c is the variance of the error that a row shares with its run.
        along: (n,) n · beam.
        spread: (n,) A Q Aᵀ.
        cofactor: (g, c, c) Q of the groups.
        design: (n, c + 1).
    """

    misclosure: FloatArray
    variance: FloatArray
    along: FloatArray
    spread: FloatArray
    cofactor: FloatArray
    design: FloatArray


class Task(NamedTuple):
    """A batch of one swath: its returns, their runs, and the data that place them.

    Attributes:
        rot_l_from_e: (3, 3) at one position on the way; used only where the trajectory's own sigmas count.
    """

    beam: Beam
    groups: Groups
    head: Head
    planes: Planes
    knots: Knots
    sigmas: Sigmas
    track: Track
    rot_l_from_e: FloatArray
