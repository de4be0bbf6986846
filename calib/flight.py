"""What a calibration works with: a flight's returns by strip and scanner, and how they are placed anew.

Points stand in t: east, north, up along the axes of the ellipsoid's tangent plane at one point in the flight's middle,
a Cartesian frame fixed to the earth, so that a plane of e is a plane of t and coordinates keep their digits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from swath.georef.air.atmosphere import Air
from swath.georef.arrays import FloatArray
from swath.georef.geodesy.earth import e_from_geodetic, geodetic_from_e, rot_e_from_l
from swath.georef.points import Fate, Rays
from swath.georef.records import Int64Array, StructArray
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
    """A flight that cannot be calibrated with; one line for the user."""


@dataclass(frozen=True, eq=False)
class Tangent:
    """The frame t: x_t = rot_t_from_e · (x_e − origin_e).

    Attributes:
        origin_e: (3,) metres.
        rot_t_from_e: (3, 3); rows are east, north and up there.
    """

    origin_e: FloatArray
    rot_t_from_e: FloatArray

    @classmethod
    def at(cls, position_e: FloatArray) -> Tangent:
        """Make it with its origin on the ellipsoid below or above a place (3,)."""
        lat, lon, _ = (float(value) for value in geodetic_from_e(position_e))
        rot_t_from_e = (rot_e_from_l(np.array(lat), np.array(lon)) @ _ROT_L_FROM_ENU).T
        return cls(np.asarray(e_from_geodetic(lat, lon, 0.0), dtype=np.float64), rot_t_from_e)

    def t_from_e(self, points_e: FloatArray) -> FloatArray:
        """Return (…, 3) points."""
        turned: FloatArray = (points_e - self.origin_e) @ self.rot_t_from_e.T
        return turned

    def e_from_t(self, points_t: FloatArray) -> FloatArray:
        """Return (…, 3) points."""
        turned: FloatArray = points_t @ self.rot_t_from_e + self.origin_e
        return turned


@dataclass(frozen=True, eq=False)
class Head:
    """A scanner as it is mounted, and what is known of it before the calibration.

    Attributes:
        name: of the configuration.
        start: calibration to start from.
        geometry: of its beams.
        noise: sigmas of a single return.
        range_gate: least and greatest ρ, metres.
        mount: stages of a gimbal.
        air: of its surroundings; None: does nothing.
    """

    name: str
    start: Calibration
    geometry: Geometry
    noise: Noise = _NOISE
    range_gate: tuple[float, float] = (0.0, np.inf)
    mount: Mount = _RIGID
    air: Air | None = None

    def model(self, calibration: Calibration) -> SensorModel:
        """With a calibration.

        Raises:
            GeometryError: it has what such a scanner has not.
        """
        return SensorModel(calibration, self.geometry, self.range_gate, self.mount, self.air)


@dataclass(frozen=True, eq=False)
class Swath:
    """One scanner's returns of one strip; the arrays may be mapped from files.

    Attributes:
        name: for people, as ``03`` or ``left 03``.
        head: index in `Flight.heads`.
        strip: its number.
        flown: index in `Flight.trajectories`.
        rows: (n,) `RETURN_DTYPE`, in the order of their times.
        time_ns: (n,) GPS time of emission by the scanner's stamps.
        points_t: (n, 3) as placed by `Flight.place` with the calibrations in use.
        encoder_rate, encoder_acceleration: (n,) rad/s, rad/s²; None: the scanner's encoder does not tell.
    """

    name: str
    head: int
    strip: int
    flown: int
    rows: StructArray
    time_ns: Int64Array
    points_t: FloatArray
    encoder_rate: FloatArray | None = None
    encoder_acceleration: FloatArray | None = None

    def __len__(self) -> int:
        """Number of returns."""
        return len(self.rows)


@dataclass(frozen=True, eq=False)
class Flight:
    """All swaths of one or several logs of one installation.

    Attributes:
        frame: t.
        heads: scanners.
        trajectories: of the body, one a session, with sigmas.
        swaths: in the order of time.
    """

    frame: Tangent
    heads: tuple[Head, ...]
    trajectories: tuple[Trajectory, ...]
    swaths: tuple[Swath, ...]

    def rays(self, swath: Swath, calibration: Calibration, at: Rows = slice(None), *, with_axes: bool = True) -> Rays:
        """Return some of a swath's returns with a calibration: `swath.georef.scanner.sensor_model`, air applied."""
        head, trajectory = self.heads[swath.head], self.trajectories[swath.flown]
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
        """Return (n, 3) points in t; nan where there is none (gate, gap of the trajectory)."""
        rays = self.rays(swath, calibration, at, with_axes=False)
        points = self.frame.t_from_e(rays.points_e)
        points[rays.fate != Fate.GEOREFERENCED] = np.nan
        return points

    def placed(self, calibrations: Mapping[str, Calibration]) -> Flight:
        """Return the same with every swath's points by these calibrations, by scanner."""
        swaths = tuple(
            replace(swath, points_t=self.place(swath, calibrations[self.heads[swath.head].name]))
            for swath in self.swaths
        )
        return replace(self, swaths=swaths)

    def starts(self) -> dict[str, Calibration]:
        """Return the calibrations to start from, by scanner."""
        return {head.name: head.start for head in self.heads}


def sensor_t(flight: Flight, swath: Swath, at: Int64Array) -> FloatArray:
    """Return (n, 3) about where the scanner was when it sent returns: the body's origin at the epoch after."""
    trajectory = flight.trajectories[swath.flown]
    epoch = np.minimum(np.searchsorted(trajectory.time_ns, swath.time_ns[at]), len(trajectory) - 1)
    return flight.frame.t_from_e(trajectory.position_e[epoch])
