"""Write LAZ 1.4: pack georeferenced points into records in one compiled pass, and compress these with LASzip.

LAS 1.4-R15, point format 6; time is adjusted standard GPS time. The bytes depend on the points and their order, never
on their division into batches.
"""

from __future__ import annotations

import datetime as dt
import math
from dataclasses import dataclass
from typing import Any, BinaryIO

import lazrs
import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import ByteArray, FloatArray, Int64Array, SingleArray, StructArray
from swath.georef.compiled import jit_cached, jit_inline
from swath.georef.formats.las_header import (
    COVARIANCE_FIELDS,
    INCIDENCE_FIELDS,
    INCIDENCE_SCALE_DEG,
    POINT_FORMAT,
    RANGE_SIGMA_FIELDS,
    SIGMA_FIELDS,
    SIGMA_SCALE_M,
    LasHeader,
    point_dtype,
)
from swath.georef.points import Points

ADJUSTED_GPS_EPOCH_S = 1_000_000_000
SCAN_ANGLE_UNIT_RAD = math.radians(0.006)
MAX_SCANNER_CHANNEL = 3
BLOCK = 1 << 15  # points packed at a time: they stay in the cache until they are compressed
_WITHHELD = 1 << 2
_LARGEST = 2_147_483_647
_TURN = 2.0 * math.pi
_PER_SCAN_ANGLE_UNIT = 1.0 / SCAN_ANGLE_UNIT_RAD
_AXES = ("easting", "northing", "height")


class LasError(ValueError):
    """Raised for points that a LAS file cannot hold."""


@dataclass(frozen=True, slots=True)
class LasSettings:
    """Settings shared by all files of a run.

    Attributes:
        wkt: coordinate system.
        offset: (3,) easting, northing, height near the points.
        scale: (3,) unit of the coordinates' integers, in the units of the coordinate system.
        sigmas: whether three sigmas follow each point, uint16 of 0.1 mm.
        incidence, range_sigma, covariances: whether these follow too: incidence and kind of surface, the range's sigma,
            six covariances.
        creation_date: date of the flight.
        software, system_identifier: names for the header.
        provenance: see `LasHeader`.
    """

    wkt: str
    offset: tuple[float, float, float]
    scale: tuple[float, float, float] = (0.001, 0.001, 0.001)
    sigmas: bool = True
    incidence: bool = False
    range_sigma: bool = False
    covariances: bool = False
    creation_date: dt.date = dt.date(1980, 1, 6)
    software: str = "swath"
    system_identifier: str = ""
    provenance: str = ""

    def header(self, strip: int) -> LasHeader:
        """Return the header of a strip's file."""
        asked = (
            (self.sigmas, SIGMA_FIELDS),
            (self.incidence, INCIDENCE_FIELDS),
            (self.range_sigma, RANGE_SIGMA_FIELDS),
            (self.covariances, COVARIANCE_FIELDS),
        )
        return LasHeader(
            scale=np.array(self.scale),
            offset=np.array(self.offset),
            extra=tuple(field for wanted, fields in asked if wanted for field in fields),
            wkt=self.wkt,
            creation_date=self.creation_date,
            software=self.software,
            system_identifier=self.system_identifier,
            file_source_id=min(strip, 65535),
            provenance=self.provenance,
        )


@dataclass(slots=True)
class Clipped:
    """Counts of points with a value larger than its field, which holds its largest value instead.

    Attributes:
        sigma: a sigma of 6.5535 m or more.
        sigma_unknown: a sigma that is not a number; the file holds 6.5535 m.
        intensity: an intensity above 65535.
    """

    sigma: int = 0
    sigma_unknown: int = 0
    intensity: int = 0


class PointPacker:
    """Packs points into records as a file holds them, and keeps the header's statistics.

    Args:
        header: of the file; its counts and extremes grow.
        point_source_id: strip, 1 … 65535.
    """

    def __init__(self, header: LasHeader, point_source_id: int) -> None:
        self.header = header
        self._source = point_source_id
        self._per_unit = 1.0 / header.scale
        self._clipped = np.zeros(3, np.int64)
        self._records = np.zeros(BLOCK, header.dtype)
        self._extra = frozenset(field.name for field in header.extra)
        usual = tuple(field for field in header.extra if field in SIGMA_FIELDS)
        self._more = len(usual) < len(header.extra)
        self._usual = np.zeros(BLOCK, point_dtype(usual)) if self._more else self._records  # as the loops know them

    @property
    def clipped(self) -> Clipped:
        """The counts of clipped values so far."""
        return Clipped(*self._clipped.tolist())

    def pack(
        self, points: Points, first: int, *, scanner: int = 0, intensity_factor: float = 1.0, withheld: bool = False
    ) -> StructArray:
        """Return records of at most `BLOCK` points from ``first`` on; the next call overwrites them.

        Raises:
            LasError: coordinates are beyond the range of the scale.
        """
        last = min(first + BLOCK, len(points))
        records = self._usual[: last - first]
        flags = (_WITHHELD if withheld else 0) | min(scanner, MAX_SCANNER_CHANNEL) << 4
        head = self.header
        wrong = _pack(
            records, first, points.time_ns, points.points_map, points.scan_angle_rad, points.intensity,
            points.return_number, points.number_of_returns, points.channel, head.offset, self._per_unit,
            intensity_factor, flags, self._source, head.minimum, head.maximum, head.count_by_return, self._clipped,
        )  # fmt: skip
        if wrong >= 0:
            raise LasError(self._out_of_bounds(points.points_map[wrong]))
        if "sigma_easting" in self._extra:
            if points.sigma_map is None:
                raise LasError("the points have no sigmas, but the file stores sigmas; open it with sigmas=False")
            _pack_sigmas(records, first, points.sigma_map, self._clipped)
        if self._more:
            records = self._with_more(records, points, slice(first, last))
        head.count += len(records)
        return records

    def _with_more(self, usual: StructArray, points: Points, rows: slice) -> StructArray:
        """Return records with the columns that are rarely asked for; an incidence that is not a number becomes 0."""
        n, size = len(usual), usual.dtype.itemsize
        records = self._records[:n]
        records.view(np.uint8).reshape(n, -1)[:, :size] = usual.view(np.uint8).reshape(n, size)
        if "incidence_angle" in self._extra:
            if points.incidence_rad is None or points.surface is None:
                raise LasError("the points have no incidence, but the file stores it; open it with incidence=False")
            angle = np.degrees(points.incidence_rad[rows]) / INCIDENCE_SCALE_DEG
            records["incidence_angle"], records["surface"] = np.rint(np.nan_to_num(angle)), points.surface[rows]
        if "sigma_range" in self._extra:
            if points.range_sigma_m is None:
                raise LasError("the points have no range sigma, but the file stores it; open it with range_sigma=False")
            records["sigma_range"] = np.rint(np.minimum(points.range_sigma_m[rows] / SIGMA_SCALE_M, 65535.0))
        if "covariance_ee" in self._extra:
            if points.covariance_map is None:
                raise LasError(
                    "the points have no covariances, but the file stores them; open it with covariances=False"
                )
            for column, field in enumerate(COVARIANCE_FIELDS):
                records[field.name] = points.covariance_map[rows, column]
        return records

    def _out_of_bounds(self, point: FloatArray) -> str:
        head = self.header
        inside = np.abs((point - head.offset) * self._per_unit) <= _LARGEST - 1
        axis = int(np.argmin(inside))
        reach = _LARGEST * float(head.scale[axis])
        return (
            f"{_AXES[axis]} {point[axis]:.3f} exceeds the range of a LAS file of scale {head.scale[axis]:g}, "
            f"{reach:,.0f} on either side of {head.offset[axis]:,.0f}; set a larger scale or another coordinate system"
        )


class LasWriter:
    """Writes one LAZ file, in bounded memory.

    Args:
        stream: seekable, empty; the caller closes it.
        settings: of the run.
        strip: its number, which is the point source id.
    """

    def __init__(self, stream: BinaryIO, settings: LasSettings, strip: int) -> None:
        self.header = settings.header(strip)
        self._packer = PointPacker(self.header, strip)
        self._stream = stream
        extra = self.header.dtype.itemsize - 30
        self._laszip = lazrs.LazVlr.new_for_compression(POINT_FORMAT, extra)
        stream.write(self.header.encode(self._laszip.record_data()))
        self._compressor: Any = lazrs.LasZipCompressor(stream, self._laszip)

    @property
    def clipped(self) -> Clipped:
        """The counts of clipped values so far."""
        return self._packer.clipped

    def write(self, points: Points, *, scanner: int = 0, intensity_factor: float = 1.0, withheld: bool = False) -> None:
        """Append points to the file.

        Args:
            points: any number.
            scanner: number of the scanner, 0 …; numbers beyond 3 are written as 3.
            intensity_factor: intensities are multiplied by it, and rounded.
            withheld: whether the points are marked as not to be used.

        Raises:
            LasError: coordinates are beyond the range of the scale; the file cannot be finished then.
            OSError: from the stream.
        """
        for first in range(0, len(points), BLOCK):
            records = self._packer.pack(
                points, first, scanner=scanner, intensity_factor=intensity_factor, withheld=withheld
            )
            self._compressor.compress_many(records.view(np.uint8))

    def close(self) -> None:
        """Finish the points and write the header that describes them."""
        self._compressor.done()
        self._stream.seek(0)
        self._stream.write(self.header.encode(self._laszip.record_data()))
        self._stream.seek(0, 2)


@jit_cached
def _pack(
    out: Any, first: int, time_ns: Int64Array, points_map: FloatArray, angle_rad: SingleArray, intensity: SingleArray,
    number: ByteArray, of: ByteArray, beam: NDArray[np.uint16], offset: FloatArray, per_unit: FloatArray,
    intensity_factor: float, flags: int, source: int, least: FloatArray, largest: FloatArray,
    by_return: Int64Array, clipped: Int64Array,
) -> int:  # fmt: skip
    """Pack as many points as there are records; return the row of a point that is out of bounds, or −1."""
    off_x, off_y, off_z = offset
    per_x, per_y, per_z = per_unit
    low_x, low_y, low_z = least
    high_x, high_y, high_z = largest
    clip = 0
    for j in range(len(out)):
        i = first + j
        record = out[j]
        x = np.rint((points_map[i, 0] - off_x) * per_x)
        y = np.rint((points_map[i, 1] - off_y) * per_y)
        z = np.rint((points_map[i, 2] - off_z) * per_z)
        if not (abs(x) <= 2147483647.0 and abs(y) <= 2147483647.0 and abs(z) <= 2147483647.0):
            return i
        record.x, record.y, record.z = np.int32(x), np.int32(y), np.int32(z)
        low_x, low_y, low_z = min(low_x, x), min(low_y, y), min(low_z, z)
        high_x, high_y, high_z = max(high_x, x), max(high_y, y), max(high_z, z)
        strength = np.rint(intensity[i] * intensity_factor)
        clip += strength > 65535.0
        record.intensity = np.uint16(min(max(strength, 0.0), 65535.0))
        slot, slots = min(number[i], 15), min(of[i], 15)
        by_return[slot] += 1
        record.returns = np.uint8(slot | slots << 4)
        record.flags, record.point_source_id = np.uint8(flags), np.uint16(source)
        record.classification, record.user_data = np.uint8(0), np.uint8(min(beam[i], 255))
        angle = float(angle_rad[i])
        if abs(angle) > math.pi:
            angle -= _TURN * np.rint(angle / _TURN)
        record.scan_angle = np.int16(np.rint(angle * _PER_SCAN_ANGLE_UNIT))
        second = time_ns[i] // 1_000_000_000
        record.gps_time = (second - ADJUSTED_GPS_EPOCH_S) + (time_ns[i] - second * 1_000_000_000) / 1e9
    least[0], least[1], least[2] = low_x, low_y, low_z
    largest[0], largest[1], largest[2] = high_x, high_y, high_z
    clipped[2] += clip
    return -1


@jit_inline
def _clip_sigmas(record: Any, east: float, north: float, height: float, clipped: Int64Array) -> None:
    if east != east or north != north or height != height:
        clipped[1] += 1
    else:
        clipped[0] += 1
    if not east < 65534.5:
        record.sigma_easting = np.uint16(65535)
    if not north < 65534.5:
        record.sigma_northing = np.uint16(65535)
    if not height < 65534.5:
        record.sigma_height = np.uint16(65535)


@jit_cached
def _pack_sigmas(out: Any, first: int, sigma_map: SingleArray, clipped: Int64Array) -> None:
    """Write three sigmas of each record; a sigma that is not a number becomes the largest value."""
    per = 1.0 / SIGMA_SCALE_M
    for j in range(len(out)):
        i = first + j
        record = out[j]
        east, north, height = sigma_map[i, 0] * per, sigma_map[i, 1] * per, sigma_map[i, 2] * per
        record.sigma_easting = np.uint16(min(east, 65535.0) + 0.5)
        record.sigma_northing = np.uint16(min(north, 65535.0) + 0.5)
        record.sigma_height = np.uint16(min(height, 65535.0) + 0.5)
        if not (east < 65534.5 and north < 65534.5 and height < 65534.5):
            _clip_sigmas(record, east, north, height, clipped)
