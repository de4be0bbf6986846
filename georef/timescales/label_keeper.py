"""Keep the labels of edge trains: given once, held, doubted with an event, and moved only in a logged step."""

from __future__ import annotations

import math

from swath.georef.timescales.clock_status import EventLog, Severity
from swath.georef.timescales.coarse import WallClock
from swath.georef.timescales.edge_train import EdgeTrain
from swath.georef.timescales.gps_time import SECOND_NS, gps_ns_from_unix, utc_from_gps
from swath.georef.timescales.labelling import LeapTrust, Verdict
from swath.georef.timescales.leap_book import LeapBook, LeapChange

BASIS_RANK = {"": 0, "vote": 1, "wall_clock": 2, "bound": 3}
WALL_FRACTION_S = 0.3  # a wall clock this far off the edges' whole second decides nothing


def outranks(verdict: Verdict, basis: Verdict) -> bool:
    """Return whether a verdict may move a label with another basis: only a message bound to its edge may."""
    return verdict.basis == "bound" and basis.basis != "bound"


class LabelKeeper:
    """Applies the votes of messages and the wall clock to the labels of trains."""

    def __init__(self, leaps: LeapBook, wall: WallClock, events: EventLog) -> None:
        self._leaps = leaps
        self._wall = wall
        self._events = events

    def verdict(self, train: EdgeTrain, host_ns: int) -> Verdict:
        """Return the verdict on a train's seconds at a host time."""
        wall = self._wall.utc_offset_ns(host_ns)
        index = math.floor(train.index_at(host_ns))
        if wall is None:
            return train.labeller.decide(index, None, LeapTrust.GUESSED)
        date, _ = utc_from_gps(gps_ns_from_unix(host_ns + wall, 0), 0)
        leap = self._leaps.on("", date)
        offset = gps_ns_from_unix(host_ns + wall, leap.seconds) / SECOND_NS - train.index_at(host_ns)
        if abs(offset - round(offset)) > WALL_FRACTION_S:
            return train.labeller.decide(index, None, LeapTrust.GUESSED)
        return train.labeller.decide(index, round(offset), leap.trust)

    def decide(self, train: EdgeTrain, host_ns: int) -> None:
        """Label the train, hold its label, or record why its seconds are not certain."""
        labeller = train.labeller
        verdict = labeller.verdict = self.verdict(train, host_ns)
        if verdict.offset is None and not verdict.ambiguous:
            return
        if verdict.leap is LeapTrust.GUESSED and not verdict.ambiguous:
            self._events.add_once(
                host_ns,
                "leap_unknown",
                f"UTC only, and GPS − UTC is a guess: {self._leaps.guess_text() or 'nobody says it'}",
            )
            return
        if labeller.label is None:
            if verdict.ambiguous:
                self.set_conflict(train, host_ns, verdict.ambiguous)
            elif verdict.basis == "bound" or not self._wall.on_probation(host_ns):
                self._clear_conflict(train, host_ns)
                labeller.label, labeller.basis = verdict.offset, verdict
                self._events.add(host_ns, Severity.INFO, "second_known", f"by {verdict.text}")
        elif verdict.offset == labeller.label and (not verdict.ambiguous or verdict.late):
            if verdict.late:
                self._events.add_once(host_ns, "messages_late", verdict.ambiguous)
            else:
                self._confirm(train, host_ns, verdict)
        elif not verdict.ambiguous and outranks(verdict, labeller.basis):
            self._relabel(train, host_ns, (verdict.offset or 0) - labeller.label, f"by {verdict.text}")
            labeller.basis = verdict
            self._clear_conflict(train, host_ns)
        elif not verdict.ambiguous and (counted := self._given_up_by_its_source(train, verdict)):
            self._relabel(train, host_ns, (verdict.offset or 0) - labeller.label, counted)
            labeller.basis = verdict
            self._clear_conflict(train, host_ns)
        else:
            difference = 0 if verdict.offset is None else verdict.offset - labeller.label
            text = verdict.ambiguous or f"{verdict.text} is {difference:+d} s against the second held"
            self.set_conflict(train, host_ns, text)

    @staticmethod
    def _given_up_by_its_source(train: EdgeTrain, verdict: Verdict) -> str:
        """Return a text if the label's source has named another second in more messages; else an empty one.

        All voters with a majority agree on the other second, or the verdict would be ambiguous.
        """
        labeller, basis = train.labeller, train.labeller.basis
        if basis.key is None or verdict.offset is None or BASIS_RANK[verdict.basis] < BASIS_RANK[basis.basis]:
            return ""
        source, bound = basis.key.source, basis.basis == "bound"
        supported = labeller.named_by(source, labeller.label or 0, bound=bound)
        contradicted = labeller.named_by(source, verdict.offset, bound=bound)
        if contradicted <= supported:
            return ""
        return f"{contradicted} messages of {source} name it, {supported} named the one before"

    def _confirm(self, train: EdgeTrain, host_ns: int, verdict: Verdict) -> None:
        self._clear_conflict(train, host_ns)
        basis = train.labeller.basis
        if (BASIS_RANK[verdict.basis], verdict.leap) > (BASIS_RANK[basis.basis], basis.leap):
            train.labeller.basis = verdict

    def set_conflict(self, train: EdgeTrain, host_ns: int, text: str) -> None:
        """Mark the train's seconds as uncertain from here on."""
        if not train.doubtful:
            self._events.add(host_ns, Severity.ERROR, "second_ambiguous", text)
        train.doubtful = True
        train.labeller.conflict = text

    def _clear_conflict(self, train: EdgeTrain, host_ns: int) -> None:
        if train.doubtful:
            self._events.add(host_ns, Severity.INFO, "second_confirmed", "the contradiction has ended")
        train.doubtful = False
        train.labeller.conflict = ""

    def give_up(self, train: EdgeTrain, host_ns: int, jump_s: float) -> None:
        """Mark all seconds of ended edges as doubtful: later edges contradict them and have lasted longer."""
        train.doubt_all()
        text = f"by edges and messages that have outlived those before: time moves by {jump_s:+.1f} s"
        self._events.add(host_ns, Severity.ERROR, "relabelled", text)

    def _relabel(self, train: EdgeTrain, host_ns: int, seconds: int, why: str) -> None:
        train.labeller.label = (train.labeller.label or 0) + seconds
        text = f"all seconds since these edges began move by {seconds:+d} s, {why}"
        self._events.add(host_ns, Severity.ERROR, "relabelled", text)

    def leap_said(self, trains: list[EdgeTrain], host_ns: int, change: LeapChange) -> None:
        """Move votes and labels that rest on an assumed leap count, as a receiver has given the count.

        A count that cannot be that of the date moves only the seconds that its own messages named.
        """
        seconds = change.now - change.before
        source = change.source if change.stale else None
        for train in trains:
            train.labeller.shift(seconds, source)
            basis = train.labeller.basis
            if source is not None and (basis.key is None or basis.key.source != source):
                continue
            if train.labeller.label is not None and basis.leap is not LeapTrust.SAID:
                self._relabel(train, host_ns, seconds, "for the leap seconds the receiver says")
                train.labeller.basis = basis.with_leap_said(seconds)
