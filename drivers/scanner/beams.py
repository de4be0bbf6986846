"""The table of beams of a spinning head, with their origins and directions, and the points that follow from it.

One table serves all makers (frame s of CONVENTIONS: x right at azimuth 90°, y at azimuth 0, z the spin axis). Its
values are the manual's design values or come from the file that the maker delivers with the head.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from swath.georef.arrays import FloatArray, StructArray


@dataclass(frozen=True)
class BeamTable:
    """Beams by channel, each field (channels,).

    Attributes:
        elevation_deg: angle above the plane perpendicular to the spin axis.
        azimuth_deg: angle added to the head's azimuth.
        range_m: distance added to the measured range.
        right_m, forward_m, up_m: start of the beam, in axes that turn with the beam's azimuth.
    """

    elevation_deg: FloatArray
    azimuth_deg: FloatArray
    range_m: FloatArray
    right_m: FloatArray
    forward_m: FloatArray
    up_m: FloatArray

    def __len__(self) -> int:
        """Return the number of channels."""
        return len(self.elevation_deg)


def numbers(text: str) -> list[float]:
    """Parse a table of numbers separated by white space."""
    return [float(word) for word in text.split()]


def beam_table(elevation_deg: object, **others: object) -> BeamTable:
    """Make a table of the given fields, with zeros for the others."""
    elevation = np.array(elevation_deg, dtype=np.float64)
    given = {"elevation_deg": elevation, **{name: np.array(values, np.float64) for name, values in others.items()}}
    return BeamTable(**{field.name: given.get(field.name, np.zeros(len(elevation))) for field in fields(BeamTable)})


def beam_points(rows: StructArray, beams: BeamTable) -> FloatArray:
    """Return the points of returns in the maker's frame.

    The formula is that of FORMULAS 2.2 for a spinning beam with a full table, written with the beam's start as a
    vector.

    Args:
        rows: (n,) `RETURN_DTYPE`; ``encoder_rad`` is the azimuth at the channel's own firing.
        beams: table of the head.

    Returns:
        (n, 3) metres, s frame, without any calibration but the table's.
    """
    channel = rows["channel"]
    azimuth = rows["encoder_rad"] + np.radians(beams.azimuth_deg)[channel]
    elevation = np.radians(beams.elevation_deg)[channel]
    range_m = rows["range_m"] + beams.range_m[channel]
    flat = range_m * np.cos(elevation) + beams.forward_m[channel]
    right = beams.right_m[channel]
    sin, cos = np.sin(azimuth), np.cos(azimuth)
    height = range_m * np.sin(elevation) + beams.up_m[channel]
    return np.stack([flat * sin + right * cos, flat * cos - right * sin, height], axis=1)
