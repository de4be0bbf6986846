"""What several swaths saw of the same: planes, tie points and control; what the adjustment takes.

All coordinates stand in t (`swath.calib.flight`). Indexes of returns are those of their swath's arrays.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from swath.georef.arrays import FloatArray
from swath.georef.records import Int64Array


@dataclass(frozen=True, eq=False)
class ControlPoint:
    """A surveyed point.

    Attributes:
        name: of the survey.
        position_t: (3,) metres.
        sigma_m: of each coordinate, or (3,) east, north, up.
    """

    name: str
    position_t: FloatArray
    sigma_m: float | FloatArray


@dataclass(frozen=True, eq=False)
class Patch:
    """The returns by which one swath saw a plane.

    Attributes:
        swath: index in `Flight.swaths`.
        at: (n,) rising indexes of its returns.
        each: returns that every one of them stands for, where a flight is planned.
    """

    swath: int
    at: Int64Array
    each: float = 1.0


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane seen by several swaths, or by one that control lies on.

    Attributes:
        name: unique.
        centre_t: (3,) near its middle; coordinates of the adjustment count from it.
        normal_t: (3,) unit, pointing up or outwards; n · (x − centre) = 0 nearly.
        patches: one a swath.
        rms_m: of its points from it, swath by swath in its own plane.
        control: surveyed points that lie on it.
        given_sigma_m: of its place along the normal, where the plane itself is surveyed; None: it is free.
        given_sigma_rad: of its direction, likewise.
        kind: roof, ground, wall, control, user; for reports.
    """

    name: str
    centre_t: FloatArray
    normal_t: FloatArray
    patches: tuple[Patch, ...]
    rms_m: float = 0.0
    control: tuple[ControlPoint, ...] = ()
    given_sigma_m: float | None = None
    given_sigma_rad: float | None = None
    kind: str = ""

    @property
    def points(self) -> int:
        """Returns on it, of all swaths."""
        return sum(len(patch.at) for patch in self.patches)


@dataclass(frozen=True, eq=False)
class Sighting:
    """A tie point as one swath shows it.

    Attributes:
        swath: index in `Flight.swaths`.
        at: index of the return nearest to it: when and under which angle it was seen.
        point_t: (3,) where it is, with the swath's points as they were placed.
        covariance_t: (3, 3) of the measurement in the points, m²; without trajectory and calibration.
    """

    swath: int
    at: int
    point_t: FloatArray
    covariance_t: FloatArray


@dataclass(frozen=True, eq=False)
class TiePoint:
    """A point seen by several swaths (NGA Eq. 55), or by one and surveyed.

    Attributes:
        name: unique.
        sightings: one a swath.
        control: its surveyed place; None: unknown.
        kind: ridge, corner, marking, picked; for reports.
    """

    name: str
    sightings: tuple[Sighting, ...]
    control: ControlPoint | None = None
    kind: str = ""


@dataclass(frozen=True, eq=False)
class Features:
    """Everything observed, from whatever method, for one adjustment; and why other candidates were not taken."""

    planes: tuple[Plane, ...] = ()
    ties: tuple[TiePoint, ...] = ()
    refused: Counter[str] = field(default_factory=Counter)

    @classmethod
    def joined(cls, pieces: Sequence[Features]) -> Features:
        """Return one after the other."""
        refused: Counter[str] = Counter()
        for piece in pieces:
            refused.update(piece.refused)
        planes = tuple(plane for piece in pieces for plane in piece.planes)
        return cls(planes, tuple(tie for piece in pieces for tie in piece.ties), refused)
