"""Convert inertial samples to increments over adjoining intervals: rotation, sample rule, gaps, order.

A sample's mean rate is taken for the whole interval between the stamps, so that increment ÷ interval is the sensor's
value whatever the jitter of its stamps, and the increments add up to the elapsed time. A device that gives increments
has integrated already: its increments are used unchanged, whatever its stamps.
"""

from __future__ import annotations

from collections import Counter
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray
from swath.georef.navigation.inputs import Inertial, NavigationError
from swath.georef.timescales.gps_time import SECOND_NS

SampleRule = Literal["mean", "instant", "increment"]
StampRule = Literal["end", "middle", "start"]

DEFAULT_MAX_GAP_S = 0.5
_UNLIMITED = (float("inf"), float("inf"))
_LATE = {"end": 0.0, "middle": 0.5, "start": 1.0}  # intervals from the stamp to the interval's end
_LONG = 1.2  # intervals: a shorter step has lost no sample
_FOLLOWED = 0.05  # share of a stamp's lateness by which the regular sequence follows it
_SETTLED = 20  # samples after which the regular sequence is trusted
_BACK = 100 * SECOND_NS  # a stamp this far behind means that time itself has jumped, not a sample out of order


class Sampler:
    """Converts IMU rows and the GPS times of their stamps to `Inertial`, whatever the division of the rows.

    An interval is the difference of stamps; nominal (1 / rate) at the first sample and after a gap. A gap of up to
    `max_gap_s` is bridged: the missing intervals are made up from the samples beside it and marked. A longer gap ends
    the piece, and so does time that jumps forward. The sample after such a jump is held until the next confirms it; a
    single outlying stamp is dropped. An instant sample holds for its moment: neighbours are averaged, and its stamp
    rule has no effect.

    Args:
        rate_hz: nominal rate.
        sample: content of the rows: "mean" over the interval, value of an "instant", or "increment" that the driver
            divided by the nominal interval.
        stamp: position of the stamp in the interval.
        rot_b_from_imu: (3, 3) to the body's axes; None: the rows are in the body's axes.
        max_gap_s: longest gap bridged.
        full_scale: greatest specific force m/s² and angular rate rad/s of the unit: samples that reach it are counted
            as saturated and marked as made up. Unlimited by default.

    Attributes:
        counts: rows by their fault: not_finite, duplicate, out_of_order, time_jumped_back, stamp_outlier (all dropped),
            saturated (kept, marked); and bridged, intervals made up.
        gaps: (begin, end) GPS ns of gaps that were not bridged.
        left_out: (GPS ns of its stamp, of the end of the last sample taken, reason) of each sample dropped for its
            stamp.

    Raises:
        NavigationError: a rate that is not positive, a matrix that is not a rotation, or an unknown word.
    """

    def __init__(
        self,
        rate_hz: float,
        sample: SampleRule = "mean",
        stamp: StampRule = "end",
        rot_b_from_imu: ArrayLike | None = None,
        max_gap_s: float = DEFAULT_MAX_GAP_S,
        full_scale: tuple[float, float] = _UNLIMITED,
    ) -> None:
        if not (np.isfinite(rate_hz) and rate_hz > 0.0):
            raise NavigationError(f"rate_hz: got {rate_hz}, want the samples' rate, above 0")
        if sample not in ("mean", "instant", "increment"):
            raise NavigationError(f'sample: got "{sample}", want "mean", "instant" or "increment"')
        if stamp not in _LATE:
            raise NavigationError(f'stamp: got "{stamp}", want "end", "middle" or "start"')
        self.counts: Counter[str] = Counter()
        self.gaps: list[tuple[int, int]] = []
        self.left_out: list[tuple[int, int, str]] = []
        self._nominal_s = 1.0 / rate_hz
        self._nominal_ns = SECOND_NS / rate_hz
        self._sample = sample
        self._late_ns = 0 if sample == "instant" else round(_LATE[stamp] * self._nominal_ns)
        self._rot = _rotation(rot_b_from_imu)
        self._max_gap_ns = max(max_gap_s, 1.5 * self._nominal_s) * SECOND_NS
        self._full_scale = np.repeat(np.asarray(full_scale, dtype=np.float64), 3)
        self._last_ns: int | None = None  # end of the last sample returned
        self._last = np.zeros(6)  # values of that sample, b
        self._lag_ns = 0.0  # of its stamp behind the regular sequence
        self._settled = 0  # samples that this sequence has followed
        self._held: tuple[int, FloatArray, bool] | None = None  # the unconfirmed sample after a jump

    def feed(self, rows: StructArray, time_ns: Int64Array) -> Inertial:
        """Return samples from the next rows (n,) `IMU_DTYPE` with the GPS times (n,) of their stamps.

        Returns:
            In the body's axes; times rise over all calls.
        """
        values = np.concatenate([rows["specific_force_b"], rows["angular_rate_b"]], axis=1)
        finite = np.isfinite(values).all(axis=1)
        self._count("not_finite", int((~finite).sum()))
        values, ends_ns = values[finite], np.asarray(time_ns, dtype=np.int64)[finite] + self._late_ns
        saturated = (np.abs(values) >= self._full_scale).any(axis=1)
        self._count("saturated", int(saturated.sum()))
        if self._rot is not None:
            values = np.concatenate([values[:, :3] @ self._rot.T, values[:, 3:] @ self._rot.T], axis=1)
        if self._held is not None:
            ends_ns = np.concatenate([[self._held[0]], ends_ns])
            values = np.concatenate([self._held[1][None], values])
            saturated = np.concatenate([[self._held[2]], saturated])
            self._held = None
        kept = self._in_order(ends_ns, values, saturated)
        return self._intervals(ends_ns[kept], values[kept], saturated[kept])

    def _count(self, reason: str, number: int) -> None:
        if number:
            self.counts[reason] += number

    def _leave_out(self, end_ns: int, last_ns: int | None, reason: str) -> None:
        self._count(reason, 1)
        self.left_out.append((end_ns, end_ns if last_ns is None else last_ns, reason))

    def _in_order(self, ends_ns: Int64Array, values: FloatArray, saturated: BoolArray) -> NDArray[np.intp]:
        """Return the rows to take; count the others, and hold a row that only the next can confirm."""
        if len(ends_ns) and self._last_ns is not None:
            steps = np.diff(ends_ns, prepend=self._last_ns)
            if ((steps > 0) & (steps <= self._max_gap_ns)).all():
                return np.arange(len(ends_ns))
        kept: list[int] = []
        last, held = self._last_ns, -1
        for row, end in enumerate(ends_ns.tolist()):
            if held >= 0:
                if 0 < end - int(ends_ns[held]) <= self._max_gap_ns:
                    kept.append(held)
                    last = int(ends_ns[held])
                else:
                    self._leave_out(int(ends_ns[held]), last, "stamp_outlier")
                held = -1
            if last is not None and end <= last:
                late = last - end
                reason = "duplicate" if not late else "time_jumped_back" if late > _BACK else "out_of_order"
                self._leave_out(end, last, reason)
            elif last is None or end - last > self._max_gap_ns:
                held = row
            else:
                kept.append(row)
                last = end
        if held >= 0:
            self._held = int(ends_ns[held]), values[held], bool(saturated[held])
        return np.array(kept, dtype=np.intp)

    def _intervals(self, ends_ns: Int64Array, values: FloatArray, saturated: BoolArray) -> Inertial:
        """Return increments of rows in order, and of missing samples between them."""
        n = len(ends_ns)
        if not n:
            return Inertial(ends_ns, np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, dtype=np.bool_))
        begins = np.concatenate([[self._last_ns if self._last_ns is not None else 0], ends_ns[:-1]])
        before = np.concatenate([self._last[None], values[:-1]])
        fresh = ends_ns - begins > self._max_gap_ns
        fresh[0] |= self._last_ns is None
        opened = fresh.copy()
        opened[0] &= self._last_ns is not None
        self.gaps += [(int(begins[k]), int(ends_ns[k] - self._nominal_ns)) for k in np.flatnonzero(opened)]
        begins[fresh] = ends_ns[fresh] - round(self._nominal_ns)
        before[fresh] = values[fresh]
        self._last_ns, self._last = int(ends_ns[-1]), values[-1]
        pieces = 1 + self._missing(ends_ns - begins, fresh)
        self._count("bridged", int(pieces.sum() - n))

        row = np.repeat(np.arange(n), pieces)  # sample of each interval, and index within its gap
        piece = np.arange(len(row)) - np.repeat(np.cumsum(pieces) - pieces, pieces) + 1
        made_up = piece < pieces[row]
        own_ns = np.where(pieces > 1, round(self._nominal_ns), ends_ns - begins)
        gap_ns = ends_ns - begins - own_ns
        share_ns = gap_ns[row] * piece // np.maximum(pieces[row] - 1, 1)
        time_ns = np.where(made_up, begins[row] + share_ns, ends_ns[row])
        interval_s = np.diff(time_ns, prepend=begins[0]) / SECOND_NS
        interval_s[piece == 1] = ((time_ns - begins[row]) / SECOND_NS)[piece == 1]
        share = (piece - 0.5 * (self._sample == "instant")) / pieces[row]  # position between the two samples
        means = values[row] - (1.0 - share[:, None]) * (values - before)[row]
        length_s = interval_s if self._sample != "increment" else np.where(made_up, interval_s, self._nominal_s)
        increments = means * length_s[:, None]
        return Inertial(time_ns, interval_s, increments[:, 3:], increments[:, :3], made_up | saturated[row])

    def _missing(self, steps_ns: Int64Array, fresh: BoolArray) -> Int64Array:
        """Return (n,) samples lost before each row: whole intervals by which it is late against a regular sequence.

        That sequence follows the stamps slowly, and so distinguishes a stamp's jitter from a loss.
        """
        nominal, lag, settled, missing = self._nominal_ns, self._lag_ns, self._settled, []
        for step, begins_anew in zip(steps_ns.tolist(), fresh.tolist(), strict=True):
            if begins_anew:
                lag, settled = 0.0, 0
                missing.append(0)
                continue
            late = lag + step - nominal
            lost = int(late / nominal + (0.5 if settled >= _SETTLED else 0.15)) if step > _LONG * nominal else 0
            lost = max(lost, 0)
            ahead = late < -0.5 * nominal
            lag = 0.0 if ahead else (late - lost * nominal) * (1.0 - max(_FOLLOWED, 1.0 / (settled + 2)))
            settled = 0 if ahead else settled + 1
            missing.append(lost)
        self._lag_ns, self._settled = lag, settled
        return np.array(missing, dtype=np.int64)


def _rotation(rot_b_from_imu: ArrayLike | None) -> FloatArray | None:
    """Return the rotation matrix after checking it."""
    if rot_b_from_imu is None:
        return None
    rotation = np.asarray(rot_b_from_imu, dtype=np.float64)
    sound = rotation.shape == (3, 3) and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
    if not sound or np.linalg.det(rotation) < 0.0:
        raise NavigationError("rotation_b_imu: the rows are not a rotation, want three orthonormal right-handed rows")
    return rotation
