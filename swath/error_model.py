"""How sure points and differences of points are: the error model that ``swath georef --error-model`` writes.

    model = swath.error_model.read("products/flight_strip01.laz")
    model.difference(xyz_1, gps_ns_1, 1, xyz_2, gps_ns_2, 1)

Covariances are of easting, northing and height in metres, whatever the units of the points.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from swath.daemon.processing.error_model.answers import figures
from swath.daemon.processing.error_model.file import ENDING, ModelFile, read_model
from swath.daemon.processing.error_model.points import model_of
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.error_model.model import ErrorModelError

__all__ = ["ErrorModel", "ErrorModelError", "figures", "read"]


class ErrorModel:
    """The error model of one run of ``swath georef``."""

    def __init__(self, file: ModelFile) -> None:
        self._file = file

    @property
    def crs(self) -> str:
        """The WKT of the points' coordinate system."""
        return self._file.crs

    @property
    def strips(self) -> list[int]:
        """The numbers of the strips: the points' source ids."""
        return sorted({unit.strip for unit in self._file.model.units})

    @property
    def scanners(self) -> dict[str, int]:
        """The number of each scanner in the points' scanner channel."""
        return dict(self._file.channels)

    def state(self) -> dict[str, Any]:
        """Return the model as values of JSON, as docs/error-model.md describes them."""
        content: dict[str, Any] = json.loads(self._file.text())
        return content

    def covariance(self, xyz: ArrayLike, gps_ns: ArrayLike, strip: ArrayLike, channel: ArrayLike = 0) -> FloatArray:
        """Return the covariances (n, 3, 3), m², of points.

        Args:
            xyz: (n, 3) easting, northing, height as in the file.
            gps_ns: (n,) GPS time of their pulses, ns; `LAZ gps_time` + 1e9 seconds.
            strip: (n,) their source ids, or one for all.
            channel: (n,) their scanner channels, or one for all.

        Raises:
            ErrorModelError: the model has no such strip; ValueError: arrays of different lengths.
        """
        return self._file.model.covariance(*self._packed(xyz, gps_ns, strip, channel))

    def difference(
        self,
        xyz_1: ArrayLike, gps_ns_1: ArrayLike, strip_1: ArrayLike,
        xyz_2: ArrayLike, gps_ns_2: ArrayLike, strip_2: ArrayLike,
        channel_1: ArrayLike = 0, channel_2: ArrayLike = 0,
    ) -> FloatArray:  # fmt: skip
        """Return the covariances (n, 3, 3), m², of differences of first and second points, of two different returns.

        The arguments are those of `covariance`, for each side.
        """
        first = self._packed(xyz_1, gps_ns_1, strip_1, channel_1)
        return self._file.model.difference(*first, *self._packed(xyz_2, gps_ns_2, strip_2, channel_2))

    def cross_covariance(
        self,
        xyz_1: ArrayLike, gps_ns_1: ArrayLike, strip_1: ArrayLike,
        xyz_2: ArrayLike, gps_ns_2: ArrayLike, strip_2: ArrayLike,
        channel_1: ArrayLike = 0, channel_2: ArrayLike = 0,
    ) -> FloatArray:  # fmt: skip
        """Return the covariances (n, 3, 3), m², of the errors of first points with those of second ones.

        The arguments are those of `covariance`, for each side.
        """
        first = self._packed(xyz_1, gps_ns_1, strip_1, channel_1)
        return self._file.model.cross_covariance(*first, *self._packed(xyz_2, gps_ns_2, strip_2, channel_2))

    def _packed(
        self, xyz: ArrayLike, gps_ns: ArrayLike, strip: ArrayLike, channel: ArrayLike
    ) -> tuple[FloatArray, Int64Array, Int64Array]:
        places = np.asarray(xyz, np.float64).reshape(-1, 3)
        times = np.asarray(gps_ns).astype(np.int64).reshape(-1)
        if len(times) != len(places):
            raise ValueError(f"{len(places)} points have {len(times)} times; give one for each")
        strips, channels = (np.broadcast_to(np.asarray(one, np.int64), len(places)) for one in (strip, channel))
        units = self._file.units_of(strips, channels)
        return places * self._file.unit_m, times, units


def read(path: str | os.PathLike[str]) -> ErrorModel:
    """Read the error model of a LAZ file of ``swath georef --error-model``, or of the JSON file beside it.

    Raises:
        SwathError: there is none, or it cannot be read; one line.
    """
    place = Path(path)
    return ErrorModel(read_model(place) if place.name.endswith(ENDING) else model_of(place))
