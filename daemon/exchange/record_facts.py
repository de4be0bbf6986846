"""Tells what decoded values of a topic or table are: their rate, the axis of gravity, the times of points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from swath.drivers.captures.base import CapturedUnit
from swath.drivers.captures.tables.columns import STANDARD_GRAVITY
from swath.drivers.record_frames import RowKind, Scale, decode_rows
from swath.georef.arrays import FloatArray
from swath.georef.timescales import SECOND_NS

SHARE = 0.9  # of the mean specific force that lies along one axis, so that this axis is up or down
NO_GRAVITY = 2.0  # m/s²: less on average is no specific force of a unit that stands or flies
_ROTATIONS = {"+z": "[[1, 0, 0], [0, -1, 0], [0, 0, -1]]", "-z": "[[1, 0, 0], [0, 1, 0], [0, 0, 1]]"}
_COUNTED = "its stamps count from a start, not from 1970"


@dataclass(slots=True)
class RecordFacts:
    """Facts of some decoded values.

    Attributes:
        words: for the list, after what the values are.
        lines: of the proposed section.
        usable: False: they are not proposed.
    """

    words: list[str] = field(default_factory=list)
    lines: list[str] = field(default_factory=list)
    usable: bool = True

    @property
    def text(self) -> str:
        """The words, each after a semicolon."""
        return "".join(f"; {one}" for one in self.words)


def facts_of(units: Sequence[CapturedUnit]) -> RecordFacts:
    """Return the facts of units of protocol ``records``, the first of a source."""
    found = [one for unit in units if not isinstance(one := decode_rows(unit.data), str)]
    facts = RecordFacts()
    if not found:
        return facts
    kind, scale = found[0][0], found[0][1]
    rows = np.concatenate([one[3] for one in found if one[0] is kind])
    if scale is Scale.COUNTER:
        facts.words.append(_COUNTED)
    if kind is RowKind.SAMPLE:
        _of_samples(rows, facts)
    elif kind is RowKind.FIX:
        _of_fixes(rows, facts)
    elif kind is RowKind.SOLUTION:
        if np.isnan(rows["lat_rad"]).all():
            facts.words.append("attitude and velocity only, as its frame of positions is not known")
    else:
        _of_points(rows, facts)
    return facts


def _of_samples(rows: Any, facts: RecordFacts) -> None:
    times = np.unique(rows["time_ns"])
    if len(times) > 2:
        rate_hz = SECOND_NS / float(np.median(np.diff(times)))
        facts.words.append(f"about {rate_hz:.0f} a second")
        facts.lines.append(f"rate_hz = {float(f'{min(rate_hz, 100_000.0):.3g}'):g}  # change: its nominal rate")
    mean = np.nanmean(rows["specific_force_b"], axis=0)
    size = float(np.linalg.norm(mean))
    axis = _axis(mean, size)
    if 0.9 < size < 1.1:
        facts.words.append(f"accelerations of {size:.2f}, so they are in g, though the message is to have m/s²")
        facts.lines.append('acceleration_unit = "g"')
    elif size < NO_GRAVITY:
        facts.words.append(
            f"accelerations of {size:.2f} m/s² on average, so gravity was removed from them: no trajectory can be "
            "computed with them"
        )
        facts.usable = False
        return
    if (axis and abs(size - STANDARD_GRAVITY) < NO_GRAVITY) or (axis and 0.9 < size < 1.1):
        way = "up" if axis.startswith("+") else "down"
        facts.words.append(f"gravity shows that {axis[1]} points {way}")
    rotation = _ROTATIONS.get(axis, _ROTATIONS["+z"])
    facts.lines.append(f"rotation_b_imu = {rotation}  # change: from its axes to the body's forward, right, down")


def _axis(mean: FloatArray, size: float) -> str:
    """Return the axis along which nearly all of a vector lies, with its sign; empty if there is none."""
    if not size > 0.0 or np.abs(mean).max() < SHARE * size:
        return ""
    place = int(np.abs(mean).argmax())
    return f"{'+' if mean[place] > 0 else '-'}{'xyz'[place]}"


def _of_fixes(rows: Any, facts: RecordFacts) -> None:
    if np.isnan(rows["position_cov_l"][:, 0]).all():
        facts.words.append("without sigmas")
    if np.isnan(rows["velocity_l"]).all():
        facts.words.append("without velocities")
    if not rows["valid"].any():
        facts.words.append("none valid so far")
    facts.lines.append("lever_arm_m = [0.0, 0.0, 0.0]  # change: antenna from the body's origin, forward, right, down")


def _of_points(rows: Any, facts: RecordFacts) -> None:
    span_s = float(np.ptp(rows["time_ns"])) / SECOND_NS if len(rows) else 0.0
    if span_s == 0.0:
        facts.words.append("all points of a cloud have one time, so that the motion during the cloud is not known")
    facts.words.append(
        "nothing here shows whether another program compensated their motion or turned them into another frame; "
        "such points must not be used"
    )
