"""Features that several swaths saw: planes, tie points and control, the input of the adjustment.

All coordinates are in t (`swath.calib.flight`). Indexes of returns are those of their swath's arrays.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from swath.georef.arrays import FloatArray, Int64Array


@dataclass(frozen=True, eq=False)
class ControlPoint:
    """A surveyed control point.

    Attributes:
        name: name in the survey.
        position_t: (3,) metres.
        sigma_m: sigma of each coordinate, or (3,) east, north, up.
    """

    name: str
    position_t: FloatArray
    sigma_m: float | FloatArray


@dataclass(frozen=True, eq=False)
class Patch:
    """The returns of one swath on a plane.

    Attributes:
        swath: index in `Flight.swaths`.
        at: (n,) rising indexes of its returns.
        each: number of real returns that each listed one represents, where a flight is planned.
    """

    swath: int
    at: Int64Array
    each: float = 1.0


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane that several swaths saw, or one swath if control lies on the plane.

    Attributes:
        name: unique.
        centre_t: (3,) near its middle; origin of the plane's coordinates in the adjustment.
        normal_t: (3,) unit, pointing up or outwards; n · (x − centre) = 0 nearly.
        patches: one per swath.
        rms_m: distance of its points from it, each swath relative to its own fitted plane.
        control: surveyed points that lie on it.
        given_sigma_m: sigma of its place along the normal, where the plane itself is surveyed; None: it is free.
        given_sigma_rad: sigma of its direction, likewise.
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
        """Number of returns on the plane, of all swaths."""
        return sum(len(patch.at) for patch in self.patches)


@dataclass(frozen=True, eq=False)
class Sighting:
    """A tie point as one swath shows it.

    Attributes:
        swath: index in `Flight.swaths`.
        at: index of the nearest return, which gives the time and angle of the sighting.
        point_t: (3,) its position among the swath's points as they were placed.
        covariance_t: (3, 3) of the measurement in the points, m²; without trajectory and calibration.
    """

    swath: int
    at: int
    point_t: FloatArray
    covariance_t: FloatArray


@dataclass(frozen=True, eq=False)
class TiePoint:
    """A point that several swaths saw (NGA Eq. 55), or a surveyed one that at least one swath saw.

    Attributes:
        name: unique.
        sightings: one per swath.
        control: its surveyed position; None: unknown.
        kind: ridge, corner, marking, picked; for reports.
    """

    name: str
    sightings: tuple[Sighting, ...]
    control: ControlPoint | None = None
    kind: str = ""


@dataclass(frozen=True, eq=False)
class Features:
    """All observations for one adjustment, from any method, and counts of refused candidates by reason."""

    planes: tuple[Plane, ...] = ()
    ties: tuple[TiePoint, ...] = ()
    refused: Counter[str] = field(default_factory=Counter)

    @classmethod
    def joined(cls, pieces: Sequence[Features]) -> Features:
        """Concatenate the features of several pieces, in order."""
        refused: Counter[str] = Counter()
        for piece in pieces:
            refused.update(piece.refused)
        planes = tuple(plane for piece in pieces for plane in piece.planes)
        return cls(planes, tuple(tie for piece in pieces for tie in piece.ties), refused)
