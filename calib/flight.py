"""The flight that a calibration works with: returns by strip and scanner, and functions that place them anew.

Points are in t: east, north, up along the axes of the ellipsoid's tangent plane at one point in the flight's middle.
That is a Cartesian frame fixed to the earth, so a plane in e is a plane in t, and coordinates stay small enough to keep
their digits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from swath.georef.air.atmosphere import Air
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.geodesy.earth import e_from_geodetic, geodetic_from_e, rot_e_from_l
from swath.georef.points import Fate, Rays
from swath.georef.scanner.beams import Geometry
from swath.georef.scanner.calibration import Calibration
from swath.georef.scanner.mount import Mount
from swath.georef.scanner.sensor_model import SensorModel
from swath.georef.scanner.uncertainty import Noise
from swath.georef.trajectory.trajectory import Trajectory

Rows = Any  # slice, index array or mask of a swath's returns

_ROT_L_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_RIGID, _NOISE = Mount(), Noise()


class FlightError(ValueError):
    """A flight that cannot be used for calibration; the message is one line for the user."""


@dataclass(frozen=True, eq=False)
class Tangent:
    """The frame t, with x_t = rot_t_from_e · (x_e − origin_e).

    Attributes:
        origin_e: (3,) metres.
        rot_t_from_e: (3, 3); rows are east, north and up there.
    """

    origin_e: FloatArray
    rot_t_from_e: FloatArray

    @classmethod
    def at(cls, position_e: FloatArray) -> Tangent:
        """Create the frame with its origin on the ellipsoid below or above a position (3,)."""
        lat, lon, _ = (float(value) for value in geodetic_from_e(position_e))
        rot_t_from_e = (rot_e_from_l(np.array(lat), np.array(lon)) @ _ROT_L_FROM_ENU).T
        return cls(np.asarray(e_from_geodetic(lat, lon, 0.0), dtype=np.float64), rot_t_from_e)

    def t_from_e(self, points_e: FloatArray) -> FloatArray:
        """Transform points (…, 3) from e to t."""
        turned: FloatArray = (points_e - self.origin_e) @ self.rot_t_from_e.T
        return turned

    def e_from_t(self, points_t: FloatArray) -> FloatArray:
        """Transform points (…, 3) from t to e."""
        turned: FloatArray = points_t @ self.rot_t_from_e + self.origin_e
        return turned


@dataclass(frozen=True, eq=False)
class Head:
    """A scanner as mounted, with the knowledge of it before the calibration.

    Attributes:
        name: name in the configuration.
        start: calibration to start from.
        geometry: geometry of its beams.
        noise: sigmas of a single return.
        range_gate: least and greatest ρ, metres.
        mount: stages of a gimbal.
        air: the air around it; None: the air has no effect.
    """

    name: str
    start: Calibration
    geometry: Geometry
    noise: Noise = _NOISE
    range_gate: tuple[float, float] = (0.0, np.inf)
    mount: Mount = _RIGID
    air: Air | None = None

    def model(self, calibration: Calibration) -> SensorModel:
        """Return the sensor model with a calibration.

        Raises:
            GeometryError: the calibration has parameters that such a scanner does not have.
        """
        return SensorModel(calibration, self.geometry, self.range_gate, self.mount, self.air)


@dataclass(frozen=True, eq=False)
class Swath:
    """One scanner's returns of one strip; the arrays may be mapped from files.

    Attributes:
        name: for display, as ``03`` or ``left 03``.
        head: index in `Flight.heads`.
        strip: its number.
        trajectory_index: index in `Flight.trajectories`.
        rows: (n,) `RETURN_DTYPE`, in the order of their times.
        time_ns: (n,) GPS time of emission by the scanner's stamps.
        points_t: (n, 3) as placed by `Flight.place` with the calibrations in use.
        encoder_rate, encoder_acceleration: (n,) rad/s, rad/s²; None: the scanner's encoder does not report them.
    """

    name: str
    head: int
    strip: int
    trajectory_index: int
    rows: StructArray
    time_ns: Int64Array
    points_t: FloatArray
    encoder_rate: FloatArray | None = None
    encoder_acceleration: FloatArray | None = None

    def __len__(self) -> int:
        """Return the number of returns."""
        return len(self.rows)


@dataclass(frozen=True, eq=False)
class Flight:
    """All swaths of one or several logs of one installation.

    Attributes:
        frame: the frame t.
        heads: scanners.
        trajectories: of the body, one per session, with sigmas.
        swaths: in the order of time.
    """

    frame: Tangent
    heads: tuple[Head, ...]
    trajectories: tuple[Trajectory, ...]
    swaths: tuple[Swath, ...]

    def rays(self, swath: Swath, calibration: Calibration, at: Rows = slice(None), *, with_axes: bool = True) -> Rays:
        """Compute rays of a swath's returns with a calibration (`swath.georef.scanner.sensor_model`) and air."""
        head, trajectory = self.heads[swath.head], self.trajectories[swath.trajectory_index]
        model = head.model(calibration)
        count = len(swath.time_ns[at])
        rate = np.zeros(count) if swath.encoder_rate is None else swath.encoder_rate[at]
        acceleration = np.zeros(count) if swath.encoder_acceleration is None else swath.encoder_acceleration[at]
        rays = model.rays(
            swath.rows.take(at) if isinstance(at, np.ndarray) and at.dtype != bool else swath.rows[at],
            swath.time_ns[at],
            trajectory,
            encoder_rate=rate,
            encoder_acceleration=acceleration,
            with_axes=with_axes,
        )
        if head.air is not None:
            head.air.apply(rays.origin_e, rays.points_e)
        return rays

    def place(self, swath: Swath, calibration: Calibration, at: Rows = slice(None)) -> FloatArray:
        """Return points (n, 3) in t; nan for returns that cannot be placed (gate, gap of the trajectory)."""
        rays = self.rays(swath, calibration, at, with_axes=False)
        points = self.frame.t_from_e(rays.points_e)
        points[rays.fate != Fate.GEOREFERENCED] = np.nan
        return points

    def placed(self, calibrations: Mapping[str, Calibration]) -> Flight:
        """Return a flight whose points of every swath are placed with these calibrations, given by scanner."""
        swaths = tuple(
            replace(swath, points_t=self.place(swath, calibrations[self.heads[swath.head].name]))
            for swath in self.swaths
        )
        return replace(self, swaths=swaths)

    def starts(self) -> dict[str, Calibration]:
        """Return the calibrations to start from, by scanner."""
        return {head.name: head.start for head in self.heads}


def sensor_t(flight: Flight, swath: Swath, at: Int64Array) -> FloatArray:
    """Return the scanner's approximate positions (n, 3) at returns: the body's origin at the next epoch."""
    trajectory = flight.trajectories[swath.trajectory_index]
    epoch = np.minimum(np.searchsorted(trajectory.time_ns, swath.time_ns[at]), len(trajectory) - 1)
    return flight.frame.t_from_e(trajectory.position_e[epoch])
