"""The host's clock in GPS time: PPS edges give the fraction, time messages the second.

Edges pass a gate around the line's prediction (`edge_train`), the line has a realistic sigma (`line_fit`), every
message votes for a whole number of seconds (`labelling`). A label once accepted is held; a contradiction raises an
event and gives COARSE, never a silent change. All times given are on one continuous host scale (CLOCK_MONOTONIC_RAW,
see `host_timeline`).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from swath.georef.arrays import BoolArray, FloatArray, Int64Array
from swath.georef.records import NamesEdge, TimeMessage, TimeScale, TimeTag
from swath.georef.timescales.clock_status import ClockEvent, ClockStatus, EventLog, Severity, TimeState
from swath.georef.timescales.coarse import AMBIGUOUS_SIGMA_NS, COARSE_SIGMA_NS, CoarseClock, WallClock
from swath.georef.timescales.edge_train import (
    MAX_REFUSED_IN_A_ROW,
    NOISY_AFTER_EDGES,
    EdgeTrain,
    KnotTable,
    find_chain,
    forget_later,
)
from swath.georef.timescales.gps_time import (
    SECOND_NS,
    gps_ns_from_unix,
    nearest_gps_ns,
    utc_from_gps,
    whole_gps_ns,
)
from swath.georef.timescales.label_keeper import LabelKeeper, outranks
from swath.georef.timescales.labelling import LeapTrust, Said, Verdict, Vote, VoterKey
from swath.georef.timescales.leap_book import LeapBook, LeapChange, LeapSeconds, is_stale
from swath.georef.timescales.settling import Settlement, settle

DOUBT_SIGMA_NS = 1e9
BREAK_NS = SECOND_NS // 2  # two sides farther apart than this are not blended
LONG_GAP_S = 10.0  # beyond, the errors of both sides are independent; below they are equal

WHOLE_SECOND_TOLERANCE_NS = 1_000_000  # NAV-PVT's nano of an epoch on the second is about 100 µs
HOLDOVER_AFTER_NS = 5_500_000_000
LOST_SIGMA_NS = 1_000_000.0
COARSE_FOR_NS = 60 * SECOND_NS
RECENT_MESSAGES = 128
RECENT_EDGES = 24
MAX_QUANTISATION_AGE_NS = 1_100_000_000
SAME_SECOND_NS = SECOND_NS // 2
PHASE_JUMP_NS = 1_000_000
NAMED_WITHIN_NS = 2_500_000_000  # after the last edge taken, of which one may be missing; ended trains get no name
OUTLIVES = 2  # ratio of a train's edges to those of an ended one whose label it contradicts


class PpsClock:
    """Maps host time to GPS time with a sigma and a state; its input is edges and messages one by one."""

    def __init__(
        self,
        assumed_leap_seconds: int | None = None,
        names_edge: NamesEdge | None = None,
        delay_ns: int = 0,
        *,
        keep_history: bool = False,
        lost_sigma_ns: float = LOST_SIGMA_NS,
    ) -> None:
        """Prepare a clock; delay_ns: cable and capture delay, subtracted from every edge.

        assumed_leap_seconds: GPS − UTC until a receiver gives it. names_edge: override of the messages' own value.
        keep_history: one knot a second is kept for post-processing; otherwise the last quarter of an hour.
        lost_sigma_ns: HOLDOVER ends there.
        """
        self.leaps = LeapBook(assumed_leap_seconds)
        self._names_edge = names_edge
        self._delay_ns = delay_ns
        self._keep_history = keep_history
        self._lost_sigma_ns = lost_sigma_ns
        self._train: EdgeTrain | None = None
        self._candidate: EdgeTrain | None = None
        self._contradicted = False  # by the candidate; messages alone then confirm nothing
        self._former: list[EdgeTrain] = []
        self._coarse = CoarseClock()
        self._wall = WallClock()
        self._leap: LeapSeconds | None = None
        self._edges: deque[int] = deque(maxlen=RECENT_EDGES)
        self._edges_unlocked = 0
        self._messages: deque[Said] = deque(maxlen=RECENT_MESSAGES)
        self._quantisation: tuple[int, int, float] | None = None  # host ns, second, ns
        self._events = EventLog()
        self._labels = LabelKeeper(self.leaps, self._wall, self._events)
        self._settlement = Settlement()
        self._edges_used = 0
        self.edges_refused: dict[str, int] = {}
        self.messages_refused: dict[str, int] = {}

    # ---- edges

    def add_edge(self, host_ns: int, sequence: int = 0) -> None:
        """Take one edge at a host time; the kernel's sequence is ignored, as the edge's time determines its place."""
        del sequence
        host = int(host_ns) - self._delay_ns
        if self._edges and host <= self._edges[-1] and not forget_later(self._edges, self._train, host):
            self._refuse_edge("backwards")
            return
        host = self._without_quantisation(host)
        self._edges.append(host)
        train = self._train
        if train is not None:
            reason = train.offer(host)
            if reason is None:
                self._edges_used += 1
                self._drop_candidate()
                return
            self._refuse_edge(reason)
            if train.refused_in_a_row <= MAX_REFUSED_IN_A_ROW:
                return
        self._follow_candidate(host)

    def _refuse_edge(self, reason: str) -> None:
        self.edges_refused[reason] = self.edges_refused.get(reason, 0) + 1

    def _without_quantisation(self, host_ns: int) -> int:
        """Return the edge without the receiver's own error, if a message before it gave that error."""
        told = self._quantisation
        if told is None or not 0 < host_ns - told[0] <= MAX_QUANTISATION_AGE_NS:
            return host_ns
        train = self._train
        if train is not None and train.labeller.label is not None:
            named = told[1] - train.labeller.label
            if abs(train.index_at(host_ns) - named) > 0.1:
                return host_ns
        self._quantisation = None
        return host_ns - round(told[2])

    def _follow_candidate(self, host_ns: int) -> None:
        """Look for a train among the unused edges, and let it replace the current one when it may."""
        candidate = self._candidate
        if candidate is not None:
            reason = candidate.offer(host_ns)
            if candidate.refused_in_a_row <= MAX_REFUSED_IN_A_ROW:
                if reason is None:
                    self._replace_if_labelled()
                return
            self._drop_candidate()
        self._edges_unlocked += 1
        chain = find_chain(list(self._edges), self._train, noisy=self._edges_unlocked > NOISY_AFTER_EDGES)
        if chain is None:
            if self._train is None:
                self._refuse_edge("no_train_yet")
            return
        self._edges_unlocked = 0
        train = EdgeTrain(chain, self._edges, keep_history=self._keep_history)
        self._tell_recent_messages(train)
        if self._train is None or self._train.labeller.label is None:
            if self._train is not None:
                self._events.add(host_ns, Severity.WARNING, "pps_relocked", "another train of edges than before")
            self._train = train
            self._edges_used += train.used
            self._labels.decide(train, host_ns)
        else:
            self._candidate = train
            self._replace_if_labelled()

    def _tell_recent_messages(self, train: EdgeTrain) -> None:
        for said in self._messages:
            if said.host_ns >= train.first_knot_ns:
                self._vote(train, said)

    def _replace_if_labelled(self) -> None:
        """Adopt the candidate once its seconds are known and do not contradict the held ones."""
        old, new = self._train, self._candidate
        if old is None or new is None:
            return
        host = new.last_host_ns
        verdict = self._labels.verdict(new, host)
        if verdict.offset is None or verdict.ambiguous or verdict.leap is LeapTrust.GUESSED:
            return
        held = _gps_float(old, host)
        jump_ns = (verdict.offset + new.index_at(host) - held) * SECOND_NS
        contradicts = abs(jump_ns) >= SAME_SECOND_NS and not outranks(verdict, old.labeller.basis)
        if contradicts and new.used <= OUTLIVES * old.used:
            self._contradicted = True
            self._labels.set_conflict(
                old, host, f"since the edges changed messages are {jump_ns / SECOND_NS:+.1f} s off"
            )
            return
        if contradicts:
            self._labels.give_up(old, host, jump_ns / SECOND_NS)
        else:
            severity = Severity.WARNING if abs(jump_ns) >= PHASE_JUMP_NS else Severity.INFO
            self._events.add(host, severity, "pps_relocked", f"edges moved by {jump_ns / 1e6:+.3f} ms against holdover")
        new.labeller.label, new.labeller.basis = verdict.offset, verdict
        self._former.append(old)
        if not self._keep_history:
            del self._former[:-2]
        self._edges_used += new.used
        self._train = new
        self._drop_candidate()

    def _drop_candidate(self) -> None:
        self._candidate, self._contradicted = None, False

    # ---- messages

    def add_message(self, source: str, message: TimeMessage) -> None:
        """Take one time message of a source (``gnss/rover``)."""
        if not message.valid:
            self._refuse_message("invalid")
            return
        tag = message.time
        change = self.leaps.hear(source, tag)
        if change is not None:
            self._leap_changed(message.host_time_ns, change)
        fraction = (tag.time_ns + SECOND_NS // 2) % SECOND_NS - SECOND_NS // 2
        if abs(fraction) > WHOLE_SECOND_TOLERANCE_NS:
            self._refuse_message("off_second")
            return
        placed = self._place(source, tag, message.host_time_ns)
        if placed is None:
            self._refuse_message("unplaced")
            return
        gps_ns, trust = placed
        second = round(gps_ns / SECOND_NS)
        names_next = (self._names_edge or message.names_edge) is NamesEdge.NEXT
        self._note_quantisation(message, second, names_next)
        key = VoterKey(source, message.message, names_next, tag.scale is TimeScale.UTC, message.bound)
        said = Said(message.host_time_ns, key, second, trust)
        self._messages.append(said)
        self._coarse.add(said.host_ns, (second - names_next) * SECOND_NS)
        for train in (self._train, self._candidate):
            if train is not None and self._vote(train, said) and train is self._train and not self._contradicted:
                self._labels.decide(train, said.host_ns)

    def add_coarse(self, host_ns: int, gps_ns: int) -> None:
        """Take the GPS time of a host time like that of a message's arrival, to about 0.1 s, without a vote."""
        self._coarse.add(host_ns, gps_ns)

    def coarse_gps_ns(self) -> int | None:
        """Return the GPS time of the latest message, to about 0.1 s; None before the first."""
        last, offset = self._coarse.last_host_ns, self._coarse.offset_ns()
        return None if last is None or offset is None else last + offset

    def _refuse_message(self, reason: str) -> None:
        self.messages_refused[reason] = self.messages_refused.get(reason, 0) + 1

    def _place(self, source: str, tag: TimeTag, host_ns: int) -> tuple[int, LeapTrust] | None:
        """Return GPS ns of a tag and the trust in its leap count; None if it cannot be placed.

        A tag without week or date is completed by the time known so far.
        """
        if tag.scale is TimeScale.GPS and tag.week is not None:
            return whole_gps_ns(tag, None) or 0, LeapTrust.SAID
        near = self._best_guess(host_ns)
        if tag.scale is TimeScale.GPS:
            gps = None if near is None else nearest_gps_ns(tag, near, None)
            return None if gps is None else (gps, LeapTrust.SAID)
        date = tag.date
        if date is None and near is not None:
            date = utc_from_gps(near, 18)[0]
        if date is None:
            return None
        leap = self.leaps.on(source, date)
        if tag.leap_seconds is not None:
            leap = LeapSeconds(tag.leap_seconds, "receiver")
        self._leap = self.leaps.on("", date) if is_stale(leap.seconds, date) and leap.origin == "receiver" else leap
        gps = whole_gps_ns(tag, leap.seconds)
        if gps is None and near is not None:
            gps = nearest_gps_ns(tag, near, leap.seconds)
        return None if gps is None else (gps, leap.trust)

    def _best_guess(self, host_ns: int) -> int | None:
        """Return the best available GPS ns at a host time, whatever its quality."""
        train = self._train
        if train is not None and train.labeller.label is not None:
            return round(_gps_float(train, host_ns) * 1e6) * 1000
        offset = self._coarse.offset_ns()
        return None if offset is None else host_ns + offset

    def _note_quantisation(self, message: TimeMessage, second: int, names_next: bool) -> None:
        """Keep the error of the next edge, or correct the edge just taken."""
        if message.quantisation_ns == 0.0:
            return
        if names_next:
            self._quantisation = (message.host_time_ns, second, message.quantisation_ns)
            return
        train = self._train
        if train is not None and train.labeller.label == second - train.bank.knot.index:
            train.amend_last(-message.quantisation_ns)

    def _vote(self, train: EdgeTrain, said: Said) -> bool:
        """Let a message vote; the line, not the order of arrival, decides between which edges it lies.

        A receiver may pulse at any phase before it knows the time, and move its pulses afterwards: a line whose edges
        have ended must not name a second.
        """
        if train.labeller.label is None and said.host_ns - train.last_host_ns > NAMED_WITHIN_NS:
            return False
        place = train.index_at(said.host_ns)
        index = math.floor(place)
        if index < 0:
            return False
        named = index + 1 if said.key.names_next else index
        train.labeller.vote(said.key, index, Vote(said.second - named, place - index, said.leap), said.host_ns)
        return True

    def _leap_changed(self, host_ns: int, change: LeapChange) -> None:
        """Move everything that rests on an assumed leap count, in one logged step, as a receiver has given another."""
        text = f"{change.source} says GPS − UTC is {change.now} s, in use was {change.before} s"
        if change.stale:
            text += "; no count of this date: it holds for this receiver's own messages alone"
        self._events.add(host_ns, Severity.WARNING, "leap_seconds_changed", text)
        if change.said_before:
            return
        seconds = change.now - change.before
        said = LeapTrust.SAID
        source = change.source if change.stale else None

        def moved(message: Said) -> Said:
            if message.leap is said or source not in (None, message.key.source):
                return message
            return Said(message.host_ns, message.key, message.second + seconds, said)

        of_others = source is not None and any(message.key.source != source for message in self._messages)
        self._messages = deque(map(moved, self._messages), maxlen=RECENT_MESSAGES)
        if not self._coarse_is_gps() and not of_others:
            self._coarse.shift(seconds)
        trains = [train for train in (*self._former, self._train, self._candidate) if train is not None]
        self._labels.leap_said(trains, host_ns, change)

    def _coarse_is_gps(self) -> bool:
        return any(not said.key.utc for said in self._messages)

    def settle(self) -> list[str]:
        """Adopt the second that most messages of the whole log name; return lines for the user if others were named.

        It is for clocks with ``keep_history``, after all input.
        """
        self._settlement = settle(self._trains())
        if self._settlement.conflict and self._train is not None:
            self._train.labeller.conflict = self._settlement.conflict
        return self._settlement.lines

    def tag_error_s(self, source: str, host_ns: Int64Array, *, utc: bool) -> Int64Array:
        """Return the seconds (n,) by which a source's tags that arrived at host times (n,) are ahead, from `settle`."""
        errors = self._settlement.errors.get((source, utc))
        return np.zeros(len(host_ns), np.int64) if errors is None else errors.at(host_ns)

    # ---- wall clock

    def set_wall_clock(self, host_ns: int, realtime_ns: int, *, disciplined: bool, sigma_s: float) -> None:
        """Take one reading of CLOCK_REALTIME on the host scale; a disciplined, steady one decides between seconds."""
        self._wall.set(host_ns, realtime_ns, disciplined, sigma_s)

    # ---- answers

    def status(self, host_ns: int) -> ClockStatus:
        """Return state, sigma and counts at a host time."""
        state, offset, sigma = self._state(host_ns)
        train = self._train
        verdict = train.labeller.basis if train is not None else Verdict()
        return ClockStatus(
            state=state,
            sigma_ns=sigma,
            offset_ns=offset,
            drift_ppm=train.bank.knot.drift_ns_s / 1e3 if train is not None else None,
            noise_ns=train.bank.noise_ns if train is not None else None,
            source=verdict.text,
            ambiguous=train.labeller.conflict if train is not None else "",
            leap_seconds=self._leap.seconds if self._leap is not None else None,
            leap_origin=self._leap.origin if self._leap is not None else "",
            leap_doubt=self.leaps.guess_text() if self._leap is not None and self._leap.origin == "guess" else "",
            edges_used=self._edges_used,
            edges_refused=dict(self.edges_refused),
            messages_refused=dict(self.messages_refused),
        )

    def _state(self, host_ns: int) -> tuple[TimeState, int | None, float]:
        """Return state, GPS − host and sigma at a host time."""
        train = self._train
        if train is not None and train.labeller.label is not None and not train.doubtful:
            gps_ns, sigma_ns = self._gps_at(train, host_ns)
            offset = gps_ns - host_ns
            if host_ns - train.last_host_ns <= HOLDOVER_AFTER_NS:
                return TimeState.LOCKED, offset, sigma_ns
            if sigma_ns <= self._lost_sigma_ns:
                return TimeState.HOLDOVER, offset, sigma_ns
            return TimeState.LOST, offset, sigma_ns
        return self._coarse_state(host_ns)

    def _coarse_state(self, host_ns: int) -> tuple[TimeState, int | None, float]:
        ambiguous = self._train is not None and self._train.doubtful
        sigma = AMBIGUOUS_SIGMA_NS if ambiguous else COARSE_SIGMA_NS
        if self._leap is not None and not self._coarse_is_gps():
            sigma = max(sigma, self._leap.sigma_s * SECOND_NS)
        wall = self._wall.utc_offset_ns(host_ns)
        last = self._coarse.last_host_ns
        offset = self._coarse.offset_ns() if self._coarse.settled() else None
        if last is not None and offset is not None and host_ns - last <= COARSE_FOR_NS:
            return TimeState.COARSE, offset, sigma
        if wall is not None and not self._coarse.runs_at_another_rate():
            leap = self.leaps.on("", utc_from_gps(gps_ns_from_unix(host_ns + wall, 0), 0)[0])
            self._leap = self._leap or leap
            sigma = max(sigma, self._wall.sigma_ns, leap.sigma_s * SECOND_NS)
            return TimeState.COARSE, gps_ns_from_unix(wall, leap.seconds), sigma
        if last is None or offset is None:
            return TimeState.NO_TIME, None, math.inf
        return TimeState.LOST, offset, sigma + 1e-4 * (host_ns - last)

    def gps_from_host(self, host_ns: Int64Array) -> tuple[Int64Array, FloatArray]:
        """Return GPS ns (n,) and sigma ns (n,) of host times (n,), by the line forward, or between knots.

        Knots on both sides are used where later ones exist. Without time the sigma is inf and the GPS time 0.
        """
        host = np.atleast_1d(np.asarray(host_ns, dtype=np.int64))
        if not host.size:
            return host.copy(), np.zeros(0)
        if any(train.labeller.label is not None for train in self._trains()):
            return self._by_trains(host)
        _, offset, sigma = self._coarse_state(int(host.max()))
        if offset is None:
            return np.zeros_like(host), np.full(host.shape, math.inf)
        return host + offset, np.full(host.shape, sigma)

    def leap_seconds_at(self, gps_ns: int) -> int:
        """Return the best known GPS − UTC, for UTC stamps of devices that give no leap count themselves."""
        return self.leaps.on("", utc_from_gps(gps_ns, 18)[0]).seconds

    def _trains(self) -> list[EdgeTrain]:
        return [*self._former, self._train] if self._train is not None else []

    def _gps_at(self, train: EdgeTrain, host_ns: int) -> tuple[int, float]:
        """Return GPS ns and sigma at one host time; this is quick after the last knot, as in live use."""
        if host_ns >= train.last_knot_ns and not train.doubtful:
            return train.gps_ns_at(host_ns), train.sigma_at(host_ns)
        gps, sigma = self._by_trains(np.array([host_ns], dtype=np.int64))
        return int(gps[0]), float(sigma[0])

    def _by_trains(self, host: Int64Array) -> tuple[Int64Array, FloatArray]:
        return gps_of_trains([train for train in self._trains() if train.labeller.label is not None], host)

    def drain_events(self) -> list[ClockEvent]:
        """Return the events since the last call."""
        return self._events.drain()


def _gps_float(train: EdgeTrain, host_ns: int) -> float:
    """Return GPS seconds of a labelled train at a host time, to 0.3 µs."""
    return (train.labeller.label or 0) + train.index_at(host_ns)


def gps_of_trains(trains: Sequence[EdgeTrain], host_ns: Int64Array) -> tuple[Int64Array, FloatArray]:
    """Return GPS ns (n,) and sigma ns (n,) at host times (n,) from labelled trains in order of time (at least one)."""
    low, high = int(host_ns.min()), int(host_ns.max())
    chosen = _overlapping(trains, low, high)
    tables = [train.knots_between(low, high) for train in chosen]
    gps = [(table.index + (train.labeller.label or 0)) * SECOND_NS for train, table in zip(chosen, tables, strict=True)]
    table, knot_gps = _joined(tables), np.concatenate(gps)
    left = np.clip(np.searchsorted(table.host_ns, host_ns, side="right") - 1, 0, None).astype(np.int64)
    seconds = table.seconds_from(left, host_ns)
    from_left = np.rint(seconds * SECOND_NS).astype(np.int64) + knot_gps[left]
    variance = table.variance(left, seconds)
    sigma = np.sqrt(variance)
    doubt = table.doubt[left] | (chosen[-1].doubtful & (host_ns >= chosen[-1].last_knot_ns))
    right = left + 1
    inside = (right < len(knot_gps)) & (host_ns >= table.host_ns[left])
    if np.any(inside):
        _blend(table, knot_gps, host_ns, left, inside, from_left, sigma)
    return from_left, np.where(doubt, np.maximum(sigma, DOUBT_SIGMA_NS), sigma)


def _overlapping(trains: Sequence[EdgeTrain], low: int, high: int) -> list[EdgeTrain]:
    """Return the trains with knots in low … high, and the neighbours on both sides."""
    after = [train for train in trains if train.first_knot_ns > high][:1]
    before = [train for train in trains if train.last_knot_ns < low][-1:]
    within = [train for train in trains if train.last_knot_ns >= low and train.first_knot_ns <= high]
    return [*before, *within, *after]


def _joined(tables: Sequence[KnotTable]) -> KnotTable:
    if len(tables) == 1:
        return tables[0]
    return KnotTable(
        np.concatenate([table.host_ns for table in tables]),
        np.concatenate([table.index for table in tables]),
        np.concatenate([table.doubt for table in tables]),
        np.concatenate([table.numbers for table in tables]),
    )


def _blend(
    table: KnotTable,
    knot_gps: Int64Array,
    host_ns: Int64Array,
    left: Int64Array,
    inside: BoolArray,
    gps: Int64Array,
    sigma: FloatArray,
) -> None:
    """Change over from the left knot's line to the right knot's between two knots, in place."""
    k, host = left[inside], host_ns[inside]
    back = table.seconds_from(k + 1, host)
    from_right = np.rint(back * SECOND_NS).astype(np.int64) + knot_gps[k + 1]
    gap = (table.host_ns[k + 1] - table.host_ns[k]).astype(np.float64)
    share = (host - table.host_ns[k]).astype(np.float64) / gap
    apart = (from_right - gps[inside]).astype(np.float64)
    joined = np.abs(apart) <= BREAK_NS
    gps[inside] += np.where(joined, np.rint(share * apart), 0.0).astype(np.int64)
    left_sigma, right_sigma = sigma[inside] * (1.0 - share), np.sqrt(table.variance(k + 1, back)) * share
    independent = np.hypot(left_sigma, right_sigma)
    mixed = np.where(gap > LONG_GAP_S * SECOND_NS, independent, left_sigma + right_sigma)
    sigma[inside] = np.where(joined, mixed, sigma[inside])
