"""The columns of points that are numbers of the row or of the ray: one pass over rows of 56 bytes."""

from __future__ import annotations

from swath.georef.compiled import kept
from swath.georef.records import Int64Array, StructArray
from swath.georef.scanner.kernels.types import FloatArray, PointColumns


@kept
def fill_columns(
    rows: StructArray, time_ns: Int64Array, off_nadir_rad: FloatArray, range_m: FloatArray, to: PointColumns
) -> None:
    """From rows (n,) `RETURN_DTYPE` and of rays (n,)."""
    times, angles, ranges, intensity, number, numbers, channel, zone = to
    for i in range(len(rows)):
        times[i] = time_ns[i]
        angles[i], ranges[i] = off_nadir_rad[i], range_m[i]
    for i in range(len(rows)):
        row = rows[i]
        intensity[i], channel[i] = row.intensity, row.channel
        number[i], numbers[i], zone[i] = row.return_number, row.number_of_returns, row.mta_zone
