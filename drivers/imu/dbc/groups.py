"""Groups the frames of one inertial sample.

A device sends one sample in several frames. `SampleGrouper` splits the sequence of frames into samples by one of three
rules, whole batches at a time, and keeps the frames of the unfinished sample for the next batch, so that the result
does not depend on where a batch ends:

- ``last``: the closing part (the one with the counter) ends a sample;
- ``first``: the opening part begins one, and the sample is complete when the next begins;
- ``repeat``: a sample ends when every part was present, or before the first part that repeats.

A sample is good when each part was present exactly once. Where the configuration gives no rule, `closing_part` derives
it from the frames: a device sends the frames of a sample one after the other and pauses before the next sample.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import BoolArray, Int64Array
from swath.georef.records import ByteRows

GroupRule = Literal["last", "first", "repeat"]
EVIDENCE = 32  # frames of each part needed to find where a sample ends
PAUSE = 3.0  # a pause between samples must exceed the next longest gap by this factor
IndexArray = NDArray[np.intp]


@dataclass(slots=True)
class Frames:
    """Frames of configured parts in the order of their arrival.

    Attributes:
        part: (n,) index of each frame's part.
        host_time_ns: (n,) host time of each frame.
        data: (n, 8 or 64) the data bytes.
    """

    part: NDArray[np.int8]
    host_time_ns: Int64Array
    data: ByteRows

    def take(self, index: NDArray[np.intp] | slice) -> Frames:
        """Return the selected frames."""
        return Frames(self.part[index], self.host_time_ns[index], self.data[index])

    def after(self, earlier: Frames) -> Frames:
        """Return these frames, appended to earlier ones."""
        if not len(earlier.part):
            return self
        return Frames(
            np.concatenate([earlier.part, self.part]),
            np.concatenate([earlier.host_time_ns, self.host_time_ns]),
            np.concatenate([earlier.data, self.data]),
        )


def no_frames(width: int) -> Frames:
    """Return an empty run of frames with ``width`` data bytes."""
    return Frames(np.empty(0, np.int8), np.empty(0, np.int64), np.empty((0, width), np.uint8))


@dataclass(slots=True)
class Samples:
    """Good samples and counts of dropped ones.

    Attributes:
        frames: the frames that `index` points into.
        index: (parts, m) index of the frame with each part of each sample.
        closed_at: (m,) index of the frame that showed the sample to be complete; ``len(frames.part)`` at the end.
        incomplete, duplicate: samples dropped because a part was missing, or came twice.
    """

    frames: Frames
    index: IndexArray
    closed_at: IndexArray
    incomplete: int
    duplicate: int


class SampleGrouper:
    """Splits frames into samples by a rule of this module."""

    def __init__(self, parts: int, rule: GroupRule, key_part: int, width: int) -> None:
        """Prepare a grouper.

        Args:
            parts: number of parts of a sample.
            rule: the rule that separates samples.
            key_part: the part that closes (last) or opens (first) a sample.
            width: data bytes of a frame.
        """
        self._parts = parts
        self._rule = rule
        self._key_part = key_part
        self._pending = no_frames(width)
        self._seen: list[int] = []

    def split(self, frames: Frames, *, at_end: bool = False) -> Samples:
        """Take the next frames; return the samples that they completed (``at_end``: with rule ``first``, the last one
        too).
        """
        frames = frames.after(self._pending)
        group, closed = self._groups(frames.part)
        if at_end and self._rule == "first" and len(group):
            closed = int(group[-1]) + 1
        done = int(np.searchsorted(group, closed, side="left"))
        samples = self._good(frames, group[:done], closed)
        self._pending = self._thin(frames.take(slice(done, None)))
        return samples

    def _groups(self, part: NDArray[np.int8]) -> tuple[IndexArray, int]:
        """Number the group of each frame in ascending order, and return how many groups are closed."""
        if self._rule == "repeat":
            return self._groups_by_repeat(part)
        key = part == self._key_part
        count = np.cumsum(key)
        closed = int(count[-1]) if len(count) else 0
        if self._rule == "last":
            return count - key, closed
        return count, closed  # group 0: frames before the first opening, closed by it

    def _groups_by_repeat(self, part: NDArray[np.int8]) -> tuple[IndexArray, int]:
        """Number groups by the rule ``repeat``: starts are chained, regular runs in one step."""
        n, parts = len(part), self._parts
        if parts == 1 or n == 0:
            return np.arange(n), n
        following = _next_start(part, parts)
        regular = following == np.arange(n) + parts
        starts = _chain(following, regular, parts)
        group = np.zeros(n, np.intp)
        group[starts[1:]] = 1
        group = np.cumsum(group)
        last_complete = len(np.unique(part[starts[-1] :])) == parts
        return group, len(starts) - (0 if last_complete else 1)

    def _good(self, frames: Frames, group: IndexArray, closed: int) -> Samples:
        """Keep the closed groups with each part exactly once; count the others."""
        part = frames.part[: len(group)]
        counts = np.bincount(group * self._parts + part, minlength=closed * self._parts).reshape(-1, self._parts)
        some, each = counts.any(axis=1), (counts > 0).all(axis=1)
        good = (counts == 1).all(axis=1)
        kept = good[group] if len(group) else np.empty(0, bool)
        index = np.empty((self._parts, int(good.sum())), np.intp)
        for number in range(self._parts):
            index[number] = np.flatnonzero(kept & (part == number))
        ends = np.searchsorted(group, np.flatnonzero(good), side="right")  # first frame after each good group
        return Samples(
            frames=frames,
            index=index,
            closed_at=ends if self._rule == "first" else ends - 1,
            incomplete=int((some & ~each).sum()),
            duplicate=int((each & ~good).sum()),
        )

    def _thin(self, pending: Frames) -> Frames:
        """Keep at most two frames of each part, which is enough to judge an unfinished sample."""
        if len(pending.part) <= 2 * self._parts:
            return pending
        keep = np.concatenate([np.flatnonzero(pending.part == number)[:2] for number in range(self._parts)])
        return pending.take(np.sort(keep))


def has_evidence(part: NDArray[np.int8], parts: int) -> bool:
    """Return whether frames (n,) of grouped parts are enough for `closing_part`; a part that never comes is not waited
    for.
    """
    counts = np.bincount(part, minlength=parts)
    return bool(counts.min() >= EVIDENCE or counts.max() >= 4 * EVIDENCE)


def closing_part(part: NDArray[np.int8], host_time_ns: Int64Array, parts: int) -> int | None:
    """Return the part before the device's pause, which closes a sample; None where no pause stands out.

    Args:
        part: (n,) parts of the grouped frames in the order of their arrival.
        host_time_ns: (n,) host times of their arrival.
        parts: number of parts of a sample.
    """
    gap_ns = np.diff(host_time_ns)
    by_part = [gap_ns[part[1:] == number] for number in range(parts)]
    if parts < 2 or min(map(len, by_part)) < 3:
        return None
    usual = np.array([float(np.median(gaps)) for gaps in by_part])
    opening, other = np.argsort(usual)[::-1][:2]
    if usual[opening] <= PAUSE * usual[other]:
        return None
    before = part[:-1][part[1:] == opening]
    return int(np.argmax(np.bincount(before, minlength=parts)))


def _next_start(part: NDArray[np.int8], parts: int) -> IndexArray:
    """Return, for a group that begins at each frame, the start of the next group (n where the group is still open)."""
    n = len(part)
    previous = np.full(n, -1, np.intp)  # the previous frame of the same part
    for number in range(parts):
        where = np.flatnonzero(part == number)
        previous[where[1:]] = where[:-1]
    return np.searchsorted(np.maximum.accumulate(previous), np.arange(n), side="left")


def _chain(following: IndexArray, regular: BoolArray, parts: int) -> IndexArray:
    """Follow the starts from frame 0; a run of groups of ``parts`` frames is one step."""
    n = len(following)
    rows = -(-n // parts)
    ends = np.full(rows * parts, rows, np.intp)  # row of the first irregular group at or after, by phase
    ends[:n] = np.where(regular, rows, np.arange(n) // parts)
    ends = np.minimum.accumulate(ends.reshape(rows, parts)[::-1], axis=0)[::-1].reshape(-1)
    pieces, start = [], 0
    while start < n:
        phase = start % parts
        stop = min(int(ends[start]) * parts + phase, n - 1 - (n - 1 - phase) % parts)
        pieces.append(np.arange(start, stop + 1, parts))
        start = int(following[stop])
    return np.concatenate(pieces)
