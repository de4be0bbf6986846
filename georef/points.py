"""Points, the output of georeferencing, and the fates of returns that gave none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import BoolArray, ByteArray, FloatArray, Int64Array, SingleArray


def contiguous(array: NDArray[Any]) -> NDArray[Any]:
    """Return the array, or a copy if it is strided or read-only: the kernels are compiled for one kind."""
    flags = array.flags
    return array if flags.c_contiguous and flags.writeable else array.copy()


class Fate(IntEnum):
    """The fate of a return; every return that was read has exactly one."""

    GEOREFERENCED = 0
    NO_TIME = 1
    OUTSIDE_TRAJECTORY = 2
    TRAJECTORY_GAP = 3
    BELOW_RANGE_GATE = 4
    ABOVE_RANGE_GATE = 5
    MTA_GAP = 6
    MTA_AMBIGUOUS = 7
    NOT_FINITE = 8
    SKIPPED = 9


FATE_NAMES = {fate: fate.name.lower() for fate in Fate}


@dataclass(slots=True)
class Points:
    """Georeferenced returns, one row each.

    Attributes:
        time_ns: (n,) GPS time of the pulse, time_offset applied.
        points_map: (n, 3) easting, northing, height in metres; e without a mapping frame.
        sigma_map: (n, 3) one sigma along the same axes, metres; None: not computed.
        scan_angle_rad: (n,) angle of the beam from the vertical, about the horizontal direction of the nose, positive
            to the right, −π … π: LAS 1.4's, with the aircraft's roll, whatever the scanner and its mounting.
        range_m: (n,) as corrected.
        intensity: (n,) as the device gives it.
        return_number, number_of_returns: (n,).
        channel: (n,) beam or facet.
        mta_zone: (n,) pulses in air − 1; 255: unknown.
        beam_map: (n, 3) change of the coordinates, in metres, with the range: the beam's direction.
        covariance_map: (n, 6) of easting e, northing n and height h: ee en eh nn nh hh, m².
        range_sigma_m: (n,) one sigma of the range alone.
        incidence_rad: (n,) between the beam and the surface's normal, 0 … π/2.
        surface: (n,) `swath.georef.surface.planes` ``LEVEL_GROUND``, ``PLANE``, ``ROUGH``: where the incidence is from.

    The last five are None unless asked for; `swath.georef.surface.local` sets the last two.
    """

    time_ns: Int64Array
    points_map: FloatArray
    sigma_map: SingleArray | None
    scan_angle_rad: SingleArray
    range_m: SingleArray
    intensity: SingleArray
    return_number: ByteArray
    number_of_returns: ByteArray
    channel: NDArray[np.uint16]
    mta_zone: ByteArray
    beam_map: SingleArray | None = None
    covariance_map: SingleArray | None = None
    range_sigma_m: SingleArray | None = None
    incidence_rad: SingleArray | None = None
    surface: ByteArray | None = None

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.time_ns)

    def take(self, which: Any) -> Points:
        """Return rows by index array, mask or slice."""
        columns: list[Any] = [getattr(self, field.name) for field in fields(self)]
        taken: list[Any] = [None if column is None else column[which] for column in columns]
        return Points(*taken)

    @classmethod
    def empty(
        cls, count: int, *, with_sigmas: bool, with_beams: bool = False, with_covariances: bool = False
    ) -> Points:
        """Make room for n points with undefined contents."""
        return cls(
            time_ns=np.empty(count, np.int64),
            points_map=np.empty((count, 3)),
            sigma_map=np.empty((count, 3), np.float32) if with_sigmas else None,
            scan_angle_rad=np.empty(count, np.float32),
            range_m=np.empty(count, np.float32),
            intensity=np.empty(count, np.float32),
            return_number=np.empty(count, np.uint8),
            number_of_returns=np.empty(count, np.uint8),
            channel=np.empty(count, np.uint16),
            mta_zone=np.empty(count, np.uint8),
            beam_map=np.empty((count, 3), np.float32) if with_beams else None,
            covariance_map=np.empty((count, 6), np.float32) if with_covariances else None,
        )

    @classmethod
    def concatenate(cls, pieces: Sequence[Points]) -> Points:
        """Join one or more pieces in order; sigmas are kept only if all pieces have them."""
        joined: list[Any] = []
        for field in fields(cls):
            columns = [getattr(piece, field.name) for piece in pieces]
            joined.append(None if any(column is None for column in columns) else np.concatenate(columns))
        return cls(*joined)


@dataclass(slots=True)
class Rays:
    """The sensor model's results for returns; (n,) or (n, …), one row per return.

    The second half is present if axes were requested: the Jacobian and the covariance are made of it.

    Attributes:
        fate: `Fate`; other columns are undefined in rows that are not GEOREFERENCED.
        time_ns: GPS time of the pulse, time_offset applied.
        points_e: (n, 3) metres.
        origin_e: (n, 3) of the scanner.
        angle_rad: θ as corrected.
        off_nadir_rad: see `Points.scan_angle_rad`.
        range_m: ρ as corrected.
        q_e_from_b: (n, 4) attitude used, scalar first.
        epoch, share: of the trajectory: the epoch before the pulse, and the pulse's position between it and the next, 0
            … 1.
        arm_b: (n, 3) from the body's origin to the point.
        range_axis_b: (n, 3) ∂point/∂ρ.
        angle_axis_b: (n, 3) ∂point/∂θ, m/rad.
        tilt_axis_b: (n, 3) ∂point/∂Δη, m/rad; ∂point/∂elevation where returns have an elevation of their own.
        measured_m: range as measured.
        encoder_rad: encoder reading.
        encoder_rate, encoder_acceleration: rad/s, rad/s²; zero if not given.
        covariance_e: (n, 6) xx xy xz yy yz zz, m², if covariances were requested.
    """

    fate: ByteArray
    time_ns: Int64Array
    points_e: FloatArray
    origin_e: FloatArray
    angle_rad: FloatArray
    off_nadir_rad: FloatArray
    range_m: FloatArray
    q_e_from_b: FloatArray | None = None
    epoch: Int64Array | None = None
    share: FloatArray | None = None
    arm_b: FloatArray | None = None
    range_axis_b: FloatArray | None = None
    angle_axis_b: FloatArray | None = None
    tilt_axis_b: FloatArray | None = None
    measured_m: FloatArray | None = None
    encoder_rad: FloatArray | None = None
    encoder_rate: FloatArray | None = None
    encoder_acceleration: FloatArray | None = None
    covariance_e: FloatArray | None = None

    def take(self, which: BoolArray) -> Rays:
        """Return some of the rays; vectors stay stored as columns."""
        columns: dict[str, Any] = {}
        for field in fields(self):
            column = getattr(self, field.name)
            columns[field.name] = None if column is None else column.T[..., which].T
        return Rays(**columns)
