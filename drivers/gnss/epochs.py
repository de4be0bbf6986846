"""Gathers the messages that a receiver sends about one epoch, so that they make one fix.

The rule uses the order of messages only, not times of arrival or reads, so that the result is the same however a stream
is cut, live or in replay: an epoch is complete when every kind of message seen in the last epochs is present, or when a
message of another epoch begins. A fix therefore waits for the next epoch only if a message of its own is missing.
"""

from __future__ import annotations

from typing import Generic, TypeVar

from swath.drivers.parser import ParserCounters

PartT = TypeVar("PartT")

FORGET_AFTER_EPOCHS = 16  # a kind of message absent for so long is no longer expected


class EpochGatherer(Generic[PartT]):
    """Collects named parts under a key (time of day, iTOW) and returns complete epochs as ``{name: part}``.

    The first part of a name is kept; a later one in the same epoch is counted as ``repeated_in_epoch``, one that
    comes after the epoch was returned as ``late_in_epoch``.
    """

    def __init__(self, counters: ParserCounters) -> None:
        self.key: int | None = None
        self._errors = counters.errors
        self._parts: dict[str, PartT] = {}
        self._seen: set[str] = set()
        self._handed_over = False
        self._expected: dict[str, int] = {}  # kind: epochs since it was seen

    def add(self, key: int, name: str, part: PartT) -> list[dict[str, PartT]]:
        """Take a part; return the epochs that it completed."""
        complete = [] if key == self.key else self.end()
        self.key = key
        self._seen.add(name)
        if self._handed_over:
            self._errors["late_in_epoch"] += 1
        elif name in self._parts:
            self._errors["repeated_in_epoch"] += 1
        else:
            self._parts[name] = part
            if self._expected and self._expected.keys() <= self._parts.keys():
                complete += self._hand_over()
        return complete

    def end(self) -> list[dict[str, PartT]]:
        """End the epoch and return it, unless it was returned before."""
        complete = self._hand_over()
        if self.key is not None:
            aged = {name: age + 1 for name, age in self._expected.items() if age < FORGET_AFTER_EPOCHS}
            self._expected = aged | dict.fromkeys(self._seen, 0)
        self.key = None
        self._seen = set()
        self._handed_over = False
        return complete

    def _hand_over(self) -> list[dict[str, PartT]]:
        parts, self._parts = self._parts, {}
        self._handed_over = True
        return [parts] if parts else []
