"""Batches that the parts of a scanner pass to each other: pulses, their echoes and the measurements of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import ByteArray, FloatArray, Int64Array

SURFACES = ("none", "ground", "roof", "wall", "road", "marking", "water", "leaves", "wire", "car")
NO_SURFACE, GROUND, ROOF, WALL, ROAD, MARKING, WATER, LEAVES, WIRE, CAR = range(len(SURFACES))


@dataclass(frozen=True, slots=True)
class Pulses:
    """Pulses as they leave, in order of emission.

    Attributes:
        number: (n,) count since power-on.
        time_s: (n,) true time of emission, seconds since the plan's start.
        encoder: (n,) reading of the encoder: counts (SREP), or hundredths of a degree or ticks of a spinning head.
        channel: (n,) facet or beam.
        origin_s: (n, 3) point at which the beam starts, metres, sensor frame; zeros for line scanners.
        direction_s: (n, 3) unit vectors of the true direction of the light, sensor frame.
        phi_extra_rad: (n,) amount that the pitch slope adds to φ.
    """

    number: Int64Array
    time_s: FloatArray
    encoder: Int64Array
    channel: NDArray[np.uint16]
    origin_s: FloatArray
    direction_s: FloatArray
    phi_extra_rad: FloatArray

    def __len__(self) -> int:
        """Return the number of pulses."""
        return len(self.number)


@dataclass(frozen=True, slots=True)
class Echoes:
    """Echoes of n pulses in R slots, nearest first; slots without an echo are at the end, range nan.

    Attributes:
        range_m: (n, R) true geometric distance along the beam's axis.
        reflectance: (n, R) apparent: of the surface times its share of the footprint times the cosine of incidence.
        incidence_rad: (n, R) between the beam and the surface's normal.
        surface: (n, R) index into `SURFACES`.
    """

    range_m: FloatArray
    reflectance: FloatArray
    incidence_rad: FloatArray
    surface: ByteArray


@dataclass(frozen=True, slots=True)
class Measured:
    """Measurements of echoes by the scanner's receiver; (n, R), slots as in `Echoes`, range 0: no return.

    Attributes:
        range_m: range that the device reports, before quantisation, whole (pulses in air resolved).
        intensity: 0 … 65535 (line scanners) or 0 … 255 (spinning heads), whole numbers.
        pulse_width_ns: length of the echo.
    """

    range_m: FloatArray
    intensity: FloatArray
    pulse_width_ns: FloatArray


@dataclass(frozen=True, slots=True)
class WireUnit:
    """One unit on its way to the recorder: a datagram, a CAN frame, the bytes of one read, or a PPS edge (no bytes).

    Attributes:
        time_s: true time at which the host stamps the unit, seconds since the plan's start.
        source: ``kind/name``, with ``/aux`` for a head's second port.
        data: bytes of the unit.
    """

    time_s: float
    source: str
    data: bytes
