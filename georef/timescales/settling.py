"""Settle the second after the flight: most messages of the whole log decide, instead of the first ones.

In flight only past messages can hold or move a label. With the whole log every kind of message has its majority; if all
kinds agree on one second, that one is adopted, and if a receiver named another for a while (UTC by a stale leap count,
wrong seconds after a cold start), those of its tags are corrected by the difference.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.georef.timescales.edge_train import EdgeTrain
from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.timescales.labelling import LATE_AGE_S, MIN_VOTES, VOTES, LeapTrust, VoterKey

JOINED_WITHIN = 0.25  # of a second: trains farther from whole seconds of each other had pulses of another phase
TAG_REACH_NS = 2 * SECOND_NS  # greatest distance of a tag from the vote nearest in arrival
SURE_SHARE = 0.75  # of messages that name one second: a smaller majority may be wrong, as with a late leap count


@dataclass(slots=True)
class TagErrors:
    """The errors of a source's tags of one scale in seconds, vote by vote.

    host_ns: (n,) arrivals, rising. error_s: (n,) whole seconds, positive: the tags are ahead.
    """

    host_ns: Int64Array
    error_s: Int64Array

    def at(self, host_ns: Int64Array) -> Int64Array:
        """Return the error (n,) of tags that arrived at host times (n,)."""
        right = np.clip(np.searchsorted(self.host_ns, host_ns), 0, len(self.host_ns) - 1)
        left = np.maximum(right - 1, 0)
        nearer = np.abs(self.host_ns[left] - host_ns) <= np.abs(self.host_ns[right] - host_ns)
        near = np.where(nearer, left, right)
        within = np.abs(self.host_ns[near] - host_ns) <= TAG_REACH_NS
        return np.where(within, self.error_s[near], 0).astype(np.int64)


@dataclass(slots=True)
class Settlement:
    """The result from the whole log.

    lines: for the user, each with the source. errors: of tags, by source and whether they are UTC. conflict: why the
    second cannot be settled; empty if it is.
    """

    lines: list[str] = field(default_factory=list)
    errors: dict[tuple[str, bool], TagErrors] = field(default_factory=dict)
    conflict: str = ""


@dataclass(slots=True)
class _Named:
    """All votes of one kind of message, as offsets of the reference train, with single stalls smoothed out."""

    host_ns: Int64Array
    offset: Int64Array
    age_s: FloatArray
    guessed: BoolArray

    def majority(self) -> int | None:
        """Return the offset that most of the messages name; None without a majority that is punctual and certain.

        A majority is more than half; certain means that its leap count is known.
        """
        counts = Counter(self.offset.tolist())
        offset, count = counts.most_common(1)[0]
        mine = self.offset == offset
        if 2 * count <= len(self.offset) or count < MIN_VOTES or np.median(self.age_s[mine]) > LATE_AGE_S:
            return None
        return None if 2 * int(self.guessed[mine].sum()) > count else offset


def settle(trains: Sequence[EdgeTrain]) -> Settlement:
    """Give all trains with continuous seconds the second that most messages name.

    Nothing changes if a wall clock named the second, if no train has one, or if kinds of messages contradict each
    other; in the last case all trains become doubtful.
    """
    found = Settlement()
    labelled = [train for train in trains if train.labeller.label is not None]
    if not labelled or any(train.labeller.basis.basis == "wall_clock" for train in labelled):
        return found
    joined = _joined(labelled)
    named = _named(joined)
    bound = {key: one for key, one in named.items() if key.bound}
    majorities = ((key, one.majority()) for key, one in (bound or named).items())
    chosen = {key: offset for key, offset in majorities if offset is not None}
    if not chosen:
        return found
    if len(set(chosen.values())) > 1:
        found.conflict = _conflict(chosen)
        for train in joined:
            train.doubt_all()
            train.labeller.conflict = found.conflict
        return found
    winner = next(iter(chosen.values()))
    for train, shift in joined.items():
        train.believe()
        train.labeller.label = winner - shift
        train.labeller.conflict = ""
    _tell(found, named, winner)
    return found


def _joined(trains: Sequence[EdgeTrain]) -> dict[EdgeTrain, int]:
    """Return the trains whose seconds are continuous with the one with most votes, and their shifts to its offsets."""
    reference = max(trains, key=lambda train: len(train.labeller.history))
    shifts: dict[EdgeTrain, int] = {}
    for train in trains:
        apart = train.index_at(train.last_knot_ns) - reference.index_at(train.last_knot_ns)
        if abs(apart - round(apart)) <= JOINED_WITHIN:
            shifts[train] = round(apart)
    return shifts


def _named(joined: dict[EdgeTrain, int]) -> dict[VoterKey, _Named]:
    columns: dict[VoterKey, list[tuple[int, int, float, bool]]] = {}
    for train, shift in joined.items():
        for past in train.labeller.history:
            guessed = past.vote.leap is LeapTrust.GUESSED
            columns.setdefault(past.key, []).append((past.host_ns, past.vote.offset + shift, past.vote.age_s, guessed))
    named: dict[VoterKey, _Named] = {}
    for key, rows in columns.items():
        if len(rows) < MIN_VOTES:
            continue
        rows.sort()
        host, offset, age, guessed_ = zip(*rows, strict=True)
        named[key] = _Named(
            np.array(host, np.int64), _smoothed(np.array(offset, np.int64)), np.array(age), np.array(guessed_, np.bool_)
        )
    return named


def _smoothed(offset: Int64Array) -> Int64Array:
    """Return the median of each value's neighbours (n,): it removes stalled messages and keeps steps in place."""
    half = min(VOTES // 2, (len(offset) - 1) // 2)
    padded = np.pad(offset, half, mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)
    median: Int64Array = np.sort(windows, axis=1)[:, half]
    return median


def _tell(found: Settlement, named: dict[VoterKey, _Named], winner: int) -> None:
    """Record the errors of tags, and a line for each source that named other seconds too."""
    widest: dict[tuple[str, bool], _Named] = {}
    for key, one in named.items():
        place = (key.source, key.utc)
        if place not in widest or len(one.offset) > len(widest[place].offset):
            widest[place] = one
    for (source, utc), one in widest.items():
        error_s = one.offset - winner
        others = Counter(error_s[error_s != 0].tolist())
        if sum(others.values()) < MIN_VOTES:
            continue
        found.errors[source, utc] = TagErrors(one.host_ns, error_s)
        agree, total = int((error_s == 0).sum()), len(error_s)
        differ = ", ".join(f"{count} name a second {error:+d} s from it" for error, count in others.most_common(3))
        doubt = "" if agree >= SURE_SHARE * total else "; the majority is small, so all times may be off by that"
        found.lines.append(
            f"{source}: {agree} of {total} messages name the second in use; {differ}; these are corrected{doubt}"
        )


def _conflict(chosen: dict[VoterKey, int]) -> str:
    (one, first), *others = chosen.items()
    other, second = next((key, offset) for key, offset in others if offset != first)
    return (
        f"over the whole log most messages {one.source} {one.message} name a second {first - second:+d} s from that "
        f"of most messages {other.source} {other.message}"
    )
