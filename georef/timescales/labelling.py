"""Find the second of an edge by votes for an integer offset, one voter for each kind of message.

Every message gives ``offset = second − edge number`` for the edge it names. A delay of nearly one second or more would
make it name the next edge; therefore the age of the messages is checked, and voters are compared with each other.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import NamedTuple

VOTES = 15
MIN_VOTES = 5
MAJORITY = 0.8
SURE_AGE_S = 0.5  # up to this age five unanimous votes are enough
YOUNG_AGE_S = 0.12  # below this (just after an edge, or a whole second late) only if they are …
YOUNG_SPREAD_S = 0.02  # … that even, and …
LEAST_AGE_S = 0.004  # … not impossibly early
STRADDLE_MEMORY_S = 600  # edges for which a message just before an edge makes messages just after it suspect
LATE_AGE_S = 0.7  # a steady delay above this may be one second more or less
LEAP_ERROR_S = 20  # error limit of a receiver that does not know GPS − UTC yet: all of it
VOTER_FORGOTTEN_S = 60  # edges after which a silent voter no longer counts


class VoterKey(NamedTuple):
    """One kind of message of one source."""

    source: str
    message: str
    names_next: bool
    utc: bool
    bound: bool


class LeapTrust(IntEnum):
    """The credibility of the leap count behind a vote."""

    GUESSED = 0  # not from receiver, configuration or a valid table: no label rests on it
    ASSUMED = 1  # configuration or table: used until a receiver gives the count
    SAID = 2  # given by a receiver, or not needed by the message


class Said(NamedTuple):
    """A message as it votes: arrival, voter, second named, trust in its leap count."""

    host_ns: int
    key: VoterKey
    second: int
    leap: LeapTrust


class Vote(NamedTuple):
    """A vote for an offset, second − edge number.

    age_s: of the message since the edge before it; leap: trust in the leap count behind its second.
    """

    offset: int
    age_s: float
    leap: LeapTrust


class PastVote(NamedTuple):
    """A vote of the log: arrival of its message, and its voter."""

    host_ns: int
    key: VoterKey
    vote: Vote


@dataclass(frozen=True, slots=True)
class Verdict:
    """The joint result of the voters.

    Attributes:
        offset: the offset decided on, or the best guess if ambiguous; None: no voter has a majority.
        ambiguous: why it cannot be decided, empty if it can.
        basis: "bound", "vote" or "wall_clock".
        key, leap: the voter (for the log); the weakest leap count behind it.
        late: ambiguous only because all messages come late; they agree with each other.
    """

    offset: int | None = None
    ambiguous: str = ""
    basis: str = ""
    key: VoterKey | None = None
    leap: LeapTrust = LeapTrust.SAID
    late: bool = False

    @property
    def text(self) -> str:
        """The source of the verdict, for the log."""
        return self.basis if self.key is None else f"{self.key.source} {self.key.message}".strip()

    def with_leap_said(self, seconds: int) -> Verdict:
        """Return the verdict after the leap count turned out to be larger by this many seconds."""
        offset = None if self.offset is None else self.offset + seconds
        return replace(self, offset=offset, leap=LeapTrust.SAID)


class Voter:
    """The last votes of one kind of message."""

    def __init__(self, key: VoterKey) -> None:
        self.key = key
        self.votes: deque[Vote] = deque(maxlen=VOTES)
        self.last_index = -(1 << 62)
        self.offset: int | None = None
        self.late = False
        self.undecided = 0

    def add(self, index: int, vote: Vote) -> None:
        """Take a vote for edge `index`; two different ones at one edge cancel, as one message was stalled."""
        if index == self.last_index:
            if self.votes and self.votes[-1].offset != vote.offset:
                self.votes.pop()
                self._count()
            return
        self.last_index = index
        self.votes.append(vote)
        self._count()

    def shift(self, seconds: int) -> None:
        """Move the votes that rest on a leap count that no receiver had given, now that one has."""
        said = LeapTrust.SAID
        moved = [v if v.leap is said else Vote(v.offset + seconds, v.age_s, said) for v in self.votes]
        self.votes = deque(moved, maxlen=VOTES)
        self._count()

    def _count(self) -> None:
        """Set `offset` (None: no majority) and `late` from the votes."""
        votes = self.votes
        counts: dict[int, int] = {}
        for vote in votes:
            counts[vote.offset] = counts.get(vote.offset, 0) + 1
        best = max(counts, key=counts.__getitem__) if counts else 0
        agreeing = counts.get(best, 0)
        self.undecided = self.undecided + 1 if len(votes) == VOTES and agreeing < MAJORITY * VOTES else 0
        self.offset = None
        if len(votes) < MIN_VOTES or agreeing < MAJORITY * len(votes):
            return
        ages = sorted(vote.age_s for vote in votes if vote.offset == best)
        if len(votes) < VOTES and not self.key.bound and (agreeing < len(votes) or not _surely_aged(ages)):
            return
        self.offset = best
        self.late = not self.key.bound and ages[len(ages) // 2] > LATE_AGE_S


def _surely_aged(ages: list[float]) -> bool:
    """Return whether sorted ages of few votes leave no doubt about the edge before them."""
    if ages[0] >= YOUNG_AGE_S:
        return ages[-1] <= SURE_AGE_S
    return ages[0] >= LEAST_AGE_S and ages[-1] - ages[0] <= YOUNG_SPREAD_S


class Labeller:
    """The voters of one edge train and the label they gave it."""

    def __init__(self, *, keep_votes: bool = False) -> None:
        """Prepare a labeller; keep_votes: remember all votes, for `swath.georef.timescales.settling`."""
        self.voters: dict[VoterKey, Voter] = {}
        self.history: list[PastVote] = []
        self._keep_votes = keep_votes
        # votes by offset and whether a receiver gave the leap count
        self._counts: dict[VoterKey, Counter[tuple[int, bool]]] = {}
        self.label: int | None = None  # GPS second of edge 0
        self.verdict = Verdict()
        self.basis = Verdict()  # the verdict behind the label
        self.conflict = ""
        self._late_votes: dict[int, int] = {}  # by offset: the last edge that a message named just before the next one

    def vote(self, key: VoterKey, index: int, vote: Vote, host_ns: int) -> None:
        """Take one vote for edge `index` of a message that came at a host time."""
        voter = self.voters.get(key)
        if voter is None:
            voter = self.voters[key] = Voter(key)
        if index != voter.last_index:
            self._counts.setdefault(key, Counter())[vote.offset, vote.leap is LeapTrust.SAID] += 1
            if self._keep_votes:
                self.history.append(PastVote(host_ns, key, vote))
        voter.add(index, vote)
        if vote.age_s > LATE_AGE_S and not key.bound:
            self._late_votes[vote.offset] = index
            if len(self._late_votes) > VOTES:
                del self._late_votes[min(self._late_votes, key=self._late_votes.__getitem__)]

    def shift(self, seconds: int, source: str | None = None) -> None:
        """Move all votes that rest on a leap count not given by a receiver, now that one has; source: only its own."""
        moves = {key for key in self.voters if key.utc and source in (None, key.source)}
        for key in moves:
            self.voters[key].shift(seconds)
            counts = self._counts[key]
            self._counts[key] = Counter()
            for (offset, said), count in counts.items():
                self._counts[key][offset if said else offset + seconds, True] += count
        self.history = [_moved(past, seconds) if past.key in moves else past for past in self.history]
        if self.voters and len(moves) == len(self.voters):
            self._late_votes = {offset + seconds: index for offset, index in self._late_votes.items()}

    def named_by(self, source: str, offset: int, *, bound: bool) -> int:
        """Return the number of a source's votes for an offset since these edges began; bound: of bound messages."""
        return sum(
            counts[offset, said]
            for key, counts in self._counts.items()
            if key.source == source and key.bound >= bound
            for said in (False, True)
        )

    def decide(self, index: int, wall_offset: int | None, wall_leap: LeapTrust) -> Verdict:
        """Return the verdict as of edge `index`; wall_offset: the offset by a disciplined wall clock."""
        sure = [v for v in self.voters.values() if v.offset is not None and index - v.last_index <= VOTER_FORGOTTEN_S]
        bound = [v for v in sure if v.key.bound]
        if bound and all(v.offset == bound[0].offset for v in bound):
            return self._by(bound[0], "bound")
        wall = wall_offset if wall_offset in self._wall_may_say() else None
        doubt = self._doubt(sure, bound, index)
        if self.label is None and not doubt and sure and self._somebody_else(sure[0], index):
            return Verdict()
        fresh = [v for v in sure if not v.late]
        if not doubt and fresh:
            gps_scale = any(not v.key.utc for v in fresh)
            error_s = 0 if gps_scale else _leap_error_s(fresh, wall_offset)
            if error_s:
                text = f"{_name(fresh[0])} is {error_s:+d} s against the disciplined wall clock: its leap seconds?"
                return Verdict(fresh[0].offset, text)
            if wall is None or wall == fresh[0].offset or (gps_scale and wall_leap is not LeapTrust.SAID):
                return self._by(fresh[0], "vote")
            doubt = f"messages and the disciplined wall clock differ by {wall - (fresh[0].offset or 0)} s"
        if not doubt:
            return Verdict()
        if wall is not None:
            return Verdict(wall, "", "wall_clock", None, wall_leap)
        late = bool(sure) and all(v.late and v.offset == sure[0].offset for v in sure)
        return Verdict(sure[0].offset if sure else None, doubt, late=late)

    def _wall_may_say(self) -> set[int]:
        """Return the offsets that a wall clock may choose: those of messages, and the next ones for late messages."""
        said = {vote.offset for voter in self.voters.values() for vote in voter.votes}
        return said | {offset + 1 for offset in said}

    def _somebody_else(self, sure: Voter, index: int) -> bool:
        """Return whether a voter without a majority last named another second; a first label then waits for it."""
        return any(
            v.offset is None and v.votes and index - v.last_index <= MIN_VOTES and v.votes[-1].offset != sure.offset
            for v in self.voters.values()
        )

    @staticmethod
    def _by(voter: Voter, basis: str) -> Verdict:
        leap = min(vote.leap for vote in voter.votes if vote.offset == voter.offset)
        return Verdict(voter.offset, "", basis, voter.key, leap)

    def _doubt(self, sure: list[Voter], bound: list[Voter], index: int) -> str:
        """Return why the voters with a majority are not credible together; empty if they are."""
        if not sure:
            lost = [v for v in self.voters.values() if v.undecided > VOTES and index - v.last_index <= VOTES]
            return f"{lost[0].key.source} {lost[0].key.message} keeps to no second" if lost else ""
        first = sure[0]
        for other in sure:
            if other.offset != first.offset:
                difference = (other.offset or 0) - (first.offset or 0)
                return f"{_name(other)} is {difference:+d} s against {_name(first)}"
        straddled = self._late_votes.get((first.offset or 0) + 1)
        if self.label is None and not bound and straddled is not None and index - straddled <= STRADDLE_MEMORY_S:
            return f"{_name(first)} comes just after an edge, others came just before it"
        if not bound and all(v.late for v in sure):
            return f"{_name(first)} comes steadily more than {LATE_AGE_S} s after its edge"
        return ""


def _moved(past: PastVote, seconds: int) -> PastVote:
    vote = past.vote
    if vote.leap is LeapTrust.SAID:
        return past
    return past._replace(vote=Vote(vote.offset + seconds, vote.age_s, LeapTrust.SAID))


def _leap_error_s(voters: list[Voter], wall_offset: int | None) -> int:
    """Return the seconds by which UTC with a leap count not given by a receiver differs from the wall clock's.

    Only differences that leap seconds explain count, else 0: one second less is a message that came late, which the
    wall clock decides; more than `LEAP_ERROR_S` means a wrong wall clock.
    """
    if wall_offset is None or any(vote.leap is LeapTrust.SAID for voter in voters for vote in voter.votes):
        return 0
    error_s = (voters[0].offset or 0) - wall_offset
    return error_s if error_s != -1 and abs(error_s) <= LEAP_ERROR_S else 0


def _name(voter: Voter) -> str:
    return f"{voter.key.source} {voter.key.message}".strip()
