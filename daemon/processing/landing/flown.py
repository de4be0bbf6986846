"""Keeps what a prediction of the calibration needs of a flight: poses, and how each scanner looked; live writes it."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from swath.daemon.processing.landing.command import FLOWN
from swath.daemon.processing.landing.tracks import Track
from swath.daemon.processing.live.files import replace_file
from swath.georef.arrays import FloatArray, Int64Array, StructArray
from swath.georef.compiled import jit_cached
from swath.georef.trajectory.trajectory import Poses

POSE_NS = 200_000_000  # between two poses that are kept: 12 MB for five hours
COLUMNS = ("position_e", "q_e_from_b", "velocity_e", "position_sigma_l", "attitude_sigma_rad")


@dataclass(slots=True)
class Looked:
    """How a scanner looked.

    Attributes:
        half_rad: largest angle of a return from the middle of its scan.
        pulses: with a return.
        seconds: log time during which returns came.
    """

    half_rad: float = 0.0
    pulses: int = 0
    seconds: float = 0.0


@dataclass
class FlownTrack:
    """Poses of a flight, and what its scanners did."""

    scanners: dict[str, Looked] = field(default_factory=dict)
    _times: list[Int64Array] = field(default_factory=list)
    _columns: dict[str, list[FloatArray]] = field(default_factory=lambda: {name: [] for name in COLUMNS})

    def poses(self, times: Int64Array, poses: Poses) -> None:
        """Take poses at GPS times (n,)."""
        kept = np.flatnonzero(times % POSE_NS == 0)
        if len(kept):
            self._times.append(times[kept])
            for name, column in self._columns.items():
                column.append(getattr(poses, name)[kept])

    def returns(self, name: str, rows: StructArray) -> int:
        """Take a scanner's rows (n,), some of which may be pulses without a return; return the number of returns."""
        half_rad, pulses, returns = _look(rows)
        if returns:
            looked = self.scanners.setdefault(name, Looked())
            looked.half_rad = max(looked.half_rad, half_rad)
            looked.pulses += pulses
        return int(returns)

    def tick(self, names: list[str], seconds: float) -> None:
        """Note that returns of scanners came during a tick."""
        for name in names:
            if name in self.scanners:
                self.scanners[name].seconds += seconds

    def save(self, folder: Path, tracks: list[Track]) -> None:
        """Write all that into a folder, for `swath.daemon.processing.landing.predict`.

        Raises:
            OSError: it cannot be written.
        """
        if not self._times or not tracks:
            return
        names = sorted(self.scanners)
        looked = [self.scanners[name] for name in names]
        columns: dict[str, Any] = {name: np.concatenate(column) for name, column in self._columns.items()}
        file = io.BytesIO()
        np.savez(
            file,
            time_ns=np.concatenate(self._times),
            strips=np.array([(one.begin_ns, one.end_ns) for one in tracks], np.int64),
            scanners=np.array(names),
            half_rad=np.array([one.half_rad for one in looked]),
            rate_hz=np.array([one.pulses / max(one.seconds, 1e-9) for one in looked]),
            **columns,
        )
        replace_file(folder / FLOWN, file.getvalue())


@jit_cached
def _look(rows: Any) -> tuple[float, int, int]:
    """Return the largest angle from the middle of the scan, and the numbers of first returns and of all returns."""
    half_rad, pulses, returns = 0.0, 0, 0
    for i in range(len(rows)):
        if rows[i].number_of_returns == 0:
            continue
        returns += 1
        if rows[i].return_number <= 1:
            pulses += 1
        half_rad = max(half_rad, abs((rows[i].encoder_rad + math.pi) % (2.0 * math.pi) - math.pi))
    return half_rad, pulses, returns
