"""Declare scanners: convert the optics that deflect the beam to a table for the kernel (FORMULAS 2.2).

A geometry gives the direction of the beam at a scan angle in the scanner's frame s. A new scanner is a table of these,
without code. All but spinning heads: x forward, y right, z along the beam at scan angle 0. The laser of an oscillating
or rotating mirror shines from the +y side, that of a Palmer mirror along +x.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from swath.georef.arrays import FloatArray
from swath.georef.scanner.calibration import Calibration, is_rotation
from swath.georef.scanner.kernels.beam import (
    AIMED,
    BY_CHANNEL,
    COLUMNS,
    FIBRE_BY_CHANNEL,
    FIBRE_BY_ENCODER,
    FIXED_ANGLE,
    LINE,
    NUTATING,
    ONE,
    RANGE,
    RISLEY,
    SPINNING,
)

PRISM_RATIO = -93.0 / 128.0
_NO_PLANE = ("scan_plane_tilt_rad", "pitch_slope")
_NO_ENCODER = ("encoder_latency_s", "torsion_s2")
_NO_SWING = (*_NO_PLANE, "scan_angle_scale", "torsion_s2")


class GeometryError(ValueError):
    """Raised for an impossible scanner, or a calibration with values that such a scanner does not have.

    Its text is one line for the user.
    """


@dataclass(frozen=True, eq=False)
class Deflection:
    """A geometry with a calibration, for the kernel.

    Attributes:
        kind, table: of `swath.georef.scanner.kernels.beam`; (channels, 8).
        select: how a return chooses its channel.
        rot_s_from_head, head_s: (3, 3), (3,) the head's own axes in s.
    """

    kind: int
    table: FloatArray
    select: int
    rot_s_from_head: FloatArray
    head_s: FloatArray


class Geometry(Protocol):
    """The way in which a scanner deflects its beam."""

    @property
    def without(self) -> tuple[str, ...]:
        """Parameters of the model, by their names in SI units, that such a scanner does not have."""

    def deflection(self, calibration: Calibration) -> Deflection:
        """Return the table of a geometry.

        Raises:
            GeometryError: the calibration has values that such a scanner does not have.
        """


@dataclass(frozen=True)
class LineGeometry:
    """Oscillating mirror, monogon or polygon: one plane of scan, for a polygon one per facet.

    Attributes:
        facets: of a polygon, whose number is in a return's channel; 1: not a polygon.
    """

    facets: int = 1
    without: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        """Refuse a scanner without facets with `GeometryError`."""
        if self.facets < 1:
            raise GeometryError(f"geometry.facets: got {self.facets}, want at least 1")

    def deflection(self, calibration: Calibration) -> Deflection:
        """Return the table as in `Geometry`."""
        _refuse(calibration, self.without, facets=self.facets if self.facets > 1 else 0)
        tilts = np.zeros(self.facets)
        for index, tilt_rad in calibration.facet_tilt_rad.items():
            tilts[index] = tilt_rad
        table = _line_table(np.full(self.facets, calibration.value("scan_plane_tilt_rad")), tilts)
        return Deflection(LINE, table, BY_CHANNEL if self.facets > 1 else ONE, np.eye(3), np.zeros(3))


@dataclass(frozen=True, eq=False)
class FibreGeometry:
    """Fibre array: each fibre has its own direction, a mirror only selects it.

    Attributes:
        across_rad: (fibres,) scan angle of each, positive to the right.
        along_rad: (fibres,) out of the plane of scan, positive forward.
        by_encoder: fibre k is lit at 2π k / fibres of the mirror's shaft; False: a return's channel gives it.
    """

    across_rad: FloatArray
    along_rad: FloatArray
    by_encoder: bool = True
    without: ClassVar[tuple[str, ...]] = _NO_ENCODER

    def __post_init__(self) -> None:
        """Refuse a table without rows with `GeometryError`."""
        if not len(self.across_rad) or self.across_rad.shape != self.along_rad.shape or self.across_rad.ndim != 1:
            raise GeometryError("geometry.file: needs the angles across and along of at least one fibre")

    def deflection(self, calibration: Calibration) -> Deflection:
        """Return the table as in `Geometry`."""
        _refuse(calibration, self.without)
        # a beam that leaves the plane of scan forward by ξ is a cone like that of Δη, which leaves it backward
        table = _line_table(calibration.value("scan_plane_tilt_rad") - self.along_rad, np.zeros(len(self.across_rad)))
        table[:, FIXED_ANGLE] = self.across_rad
        select = FIBRE_BY_ENCODER if self.by_encoder else FIBRE_BY_CHANNEL
        return Deflection(LINE, table, select, np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class NutatingGeometry:
    """Palmer scan: a mirror whose normal leans from its shaft; the laser shines along +x.

    Attributes:
        nutation_rad: ψ, angle of the normal from the shaft; at encoder 0 forward, so that the beam is forward by 2ψ.
        shaft_angle_rad: between shaft and laser, in the plane x, z.
    """

    nutation_rad: float
    shaft_angle_rad: float = math.pi / 4
    without: ClassVar[tuple[str, ...]] = _NO_PLANE

    def deflection(self, calibration: Calibration) -> Deflection:
        """Return the table as in `Geometry`."""
        _refuse(calibration, self.without)
        psi, beta = self.nutation_rad, self.shaft_angle_rad
        table = _table(1, math.sin(psi), math.cos(psi), math.sin(beta), math.cos(beta))
        return Deflection(NUTATING, table, ONE, np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class RisleyGeometry:
    """Two prisms with flat entries and wedged exits, lit along z; at encoder 0 both thin ends are forward.

    Attributes:
        wedge_rad: of the first and the second.
        refractive_index: of both.
        prism_ratio: turns of the second per turn of the first, whose whole turns the encoder counts.
    """

    wedge_rad: tuple[float, float]
    refractive_index: float
    prism_ratio: float = PRISM_RATIO
    without: ClassVar[tuple[str, ...]] = _NO_PLANE

    def __post_init__(self) -> None:
        """Refuse prisms that reflect the light totally at some angle with `GeometryError`."""
        index, (first, second) = self.refractive_index, map(abs, self.wedge_rad)
        leaving = math.asin(min(1.0, index * math.sin(first))) - first
        # on the last surface, of the light after the surfaces before
        steepest = second + math.asin(math.sin(leaving) / index)
        passes = max(index * math.sin(first), index * math.sin(steepest)) < 1.0
        if not passes or max(first, steepest) >= math.pi / 2:
            degrees = ", ".join(f"{math.degrees(wedge):g}" for wedge in self.wedge_rad)
            text = f"got [{degrees}], want smaller angles: the prism reflects the light totally"
            raise GeometryError(f"geometry.wedge_deg: {text}")

    def deflection(self, calibration: Calibration) -> Deflection:
        """Return the table as in `Geometry`, with the ray traced through three of the four surfaces.

        It passes the first, flat, at a right angle; then the exit of the first prism into air; and, bent towards z, the
        flat entry of the second prism, where its horizontal part shrinks by the refractive index.
        """
        _refuse(calibration, self.without)
        index, wedge = self.refractive_index, self.wedge_rad[0]
        sine = math.sin(wedge)
        leaving = math.sqrt(1.0 - (index * sine) ** 2) - index * math.cos(wedge)
        flat = leaving * sine / index
        second = (math.sin(self.wedge_rad[1]), math.cos(self.wedge_rad[1]))
        table = _table(1, flat, math.sqrt(1.0 - flat * flat), *second, index, self.prism_ratio)
        return Deflection(RISLEY, table, ONE, np.eye(3), np.zeros(3))


@dataclass(frozen=True, eq=False)
class SpinningGeometry:
    """Spinning multi-beam head in its maker's frame: x right at azimuth 90°, y at azimuth 0, z the spin axis.

    Attributes:
        elevation_deg: (channels,) above the plane perpendicular to the spin axis.
        azimuth_deg: added to the head's azimuth.
        range_m: added to the measured range.
        right_m, forward_m, up_m: where the beam starts, in axes that turn with the beam's azimuth.
    """

    elevation_deg: FloatArray
    azimuth_deg: FloatArray
    range_m: FloatArray
    right_m: FloatArray
    forward_m: FloatArray
    up_m: FloatArray
    without: ClassVar[tuple[str, ...]] = _NO_SWING

    def deflection(self, calibration: Calibration) -> Deflection:
        """Return the table as in `Geometry`."""
        count = len(self.elevation_deg)
        _refuse(calibration, self.without, channels=count)
        azimuth, elevation, range_m = _beam_corrections(calibration, count)
        elevation += np.radians(self.elevation_deg)
        azimuth += np.radians(self.azimuth_deg)
        starts = (self.right_m, self.forward_m, self.up_m)
        table = _table(count, np.sin(elevation), np.cos(elevation), azimuth, *starts, 1.0)
        table[:, RANGE] = self.range_m + range_m
        return Deflection(SPINNING, table, BY_CHANNEL, np.eye(3), np.zeros(3))


@dataclass(frozen=True, eq=False)
class OusterGeometry:
    """Ouster head in its sensor frame: its encoder turns x to y; ranges count from its axis through the beam's start.

    Attributes:
        altitude_rad, azimuth_rad: (channels,) of the metadata.
        beam_origin_m: (x, z) of the beam's start in the frame that turns with the encoder.
        sensor_from_lidar: (4, 4) homogeneous, metres.
    """

    altitude_rad: FloatArray
    azimuth_rad: FloatArray
    beam_origin_m: tuple[float, float]
    sensor_from_lidar: FloatArray
    without: ClassVar[tuple[str, ...]] = _NO_SWING

    def deflection(self, calibration: Calibration) -> Deflection:
        """Return the table as in `Geometry`: a spinning head whose azimuth falls, from y, as the encoder turns."""
        count = len(self.altitude_rad)
        _refuse(calibration, self.without, channels=count)
        azimuth, elevation, range_m = _beam_corrections(calibration, count)
        azimuth, elevation = azimuth + self.azimuth_rad, elevation + self.altitude_rad
        start, above = self.beam_origin_m
        before = math.hypot(start, above)  # part of the range before the beam's start
        right, forward = -start * np.sin(azimuth), start * np.cos(azimuth) - before * np.cos(elevation)
        up = above - before * np.sin(elevation)
        table = _table(count, np.sin(elevation), np.cos(elevation), azimuth + np.pi / 2, right, forward, up, -1.0)
        table[:, RANGE] = range_m
        rotation, shift = self.sensor_from_lidar[:3, :3], self.sensor_from_lidar[:3, 3]
        return Deflection(SPINNING, table, BY_CHANNEL, np.array(rotation), np.array(shift))


@dataclass(frozen=True)
class AimedGeometry:
    """Head that gives each return's direction by two angles, or by x, y and z: a rosette, or many beams.

    In the maker's frame with x forward, y left and z up the encoder's angle counts from x towards y, the elevation from
    the plane of both towards z: u = (cos ε cos α, cos ε sin α, sin ε). Ranges count from the frame's origin. It has no
    table of beams; the head has applied its own.
    """

    without: ClassVar[tuple[str, ...]] = (*_NO_SWING, "scan_angle_offset_rad", "encoder_latency_s")

    def deflection(self, calibration: Calibration) -> Deflection:
        """Return the table as in `Geometry`: a spinning head whose azimuth falls, from y, as the encoder turns."""
        _refuse(calibration, self.without)
        return Deflection(AIMED, _table(1, 0.0, 1.0, np.pi / 2, 0.0, 0.0, 0.0, -1.0), ONE, np.eye(3), np.zeros(3))


def line_scanner(
    kind: str | None,
    *,
    facets: int | None = None,
    nutation_deg: float | None = None,
    shaft_angle_deg: float | None = None,
    wedge_deg: Sequence[float] | None = None,
    refractive_index: float | None = None,
    prism_ratio: float | None = None,
    fibres: FibreGeometry | None = None,
) -> Geometry:
    """Return the geometry that ``[scanner.<name>.geometry]`` declares, by its keys; ``fibres`` is read from its file.

    Raises:
        GeometryError: a key is missing, or the type is unknown.
    """
    if kind in (None, "oscillating", "monogon"):
        return LineGeometry()
    if kind == "polygon" and facets is not None:
        return LineGeometry(facets)
    if kind == "nutating" and nutation_deg is not None:
        shaft_deg = 45.0 if shaft_angle_deg is None else shaft_angle_deg
        return NutatingGeometry(math.radians(nutation_deg), math.radians(shaft_deg))
    if kind == "risley" and wedge_deg is not None and refractive_index is not None:
        wedges = (math.radians(wedge_deg[0]), math.radians(wedge_deg[1]))
        return RisleyGeometry(wedges, refractive_index, PRISM_RATIO if prism_ratio is None else prism_ratio)
    if kind == "fibre" and fibres is not None:
        return fibres
    missing = {
        "polygon": "facets",
        "nutating": "nutation_deg, shaft_angle_deg",
        "risley": "wedge_deg, refractive_index, prism_ratio",
        "fibre": "file, the table of the fibres' angles",
    }
    if kind in missing:
        raise GeometryError(f'geometry: type = "{kind}" needs {missing[kind]}')
    raise GeometryError(f"geometry.type: got {kind!r}, want oscillating, monogon or one of {', '.join(missing)}")


def read_fibres(text: str, name: str) -> FibreGeometry:
    """Return a table of fibres from a file.

    Its first line is ``across_deg,along_deg``; a line per fibre follows, in the order in which the mirror lights them.

    Args:
        text: of the file.
        name: of the file, for messages.

    Raises:
        GeometryError: names the faulty line.
    """
    lines = [line.strip() for line in text.splitlines()]
    if not lines or lines[0].replace(" ", "") != "across_deg,along_deg":
        raise GeometryError(f"{name}: line 1: the header must be across_deg,along_deg")
    rows = []
    for number, line in enumerate(lines[1:], start=2):
        try:
            across, along = (float(word) for word in line.split(",")) if line else (0.0, 0.0)
        except ValueError as error:
            raise GeometryError(f"{name}: line {number}: got {line!r}, want two numbers") from error
        if line:
            rows.append((across, along))
    table = np.radians(np.array(rows, dtype=np.float64).reshape(-1, 2))
    if not len(table) or not np.isfinite(table).all():
        raise GeometryError(f"{name}: needs the two angles of at least one fibre, all finite")
    return FibreGeometry(table[:, 0].copy(), table[:, 1].copy())


def _table(count: int, *columns: FloatArray | float) -> FloatArray:
    table = np.zeros((count, COLUMNS))
    for place, column in enumerate(columns):
        table[:, place] = column
    return table


def _line_table(plane_tilt_rad: FloatArray, mirror_tilt_rad: FloatArray) -> FloatArray:
    tilts = (np.sin(plane_tilt_rad), np.cos(plane_tilt_rad), np.sin(mirror_tilt_rad), np.cos(mirror_tilt_rad))
    return _table(len(plane_tilt_rad), *tilts)


def _beam_corrections(calibration: Calibration, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return corrections (channels,) of azimuths, elevations and ranges by [[beam]]."""
    corrections = np.zeros((3, count))
    for channel, beam in calibration.beams.items():
        corrections[:, channel] = beam.azimuth_rad, beam.elevation_rad, beam.range_m
    return corrections[0], corrections[1], corrections[2]


def _refuse(calibration: Calibration, without: tuple[str, ...], *, facets: int = 0, channels: int = 0) -> None:
    """Refuse a calibration with values that such a scanner does not have, with `GeometryError`."""
    where = f"calibration of {calibration.scanner}"
    for name in without:
        if calibration.value(name) != 0.0:
            text = f"{name} is {calibration.value(name):g}, want 0: this scanner has no such error"
            raise GeometryError(f"{where}: {text}")
    if not is_rotation(calibration.installation_matrix):
        raise GeometryError(f"{where}: installation matrix: is not a rotation; it needs perpendicular rows of length 1")
    for index in calibration.facet_tilt_rad:
        if index >= facets:
            raise GeometryError(f"{where}: facet.index: got {index}, but the scanner has {facets} facets")
    for channel in calibration.beams:
        if channel >= channels:
            raise GeometryError(f"{where}: beam.channel: got {channel}, but the scanner has {channels} beams")
