"""Judges figures by limits: what a verdict on a flight, a calibration or a product is made of."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Generic, TypeVar

Figures = TypeVar("Figures")


class Level(IntEnum):
    """Level of a reason, and of a whole verdict."""

    GOOD = 0
    CARE = 1
    UNUSABLE = 2

    @property
    def words(self) -> str:
        """The level in words, as in a record."""
        return ("good", "usable with care", "not to be used")[self]

    @property
    def heading(self) -> str:
        """The level in words, as they begin a sentence."""
        return self.words[0].upper() + self.words[1:]


@dataclass(frozen=True, slots=True)
class Reason:
    """A reason why the judged thing is not simply good.

    Attributes:
        level: severity.
        name: name of the rule or the finding.
        what: the problem, with the figure.
        change: the remedy.
        excess: value over its limit; the worst reasons come first.
    """

    level: Level
    name: str
    what: str
    change: str
    excess: float = 1.0


@dataclass(frozen=True, slots=True)
class Verdict:
    """The judgement of a flight, a calibration or a product.

    Attributes:
        level: the worst of the reasons.
        sentence: the verdict in words.
        reasons: reasons, the worst first.
    """

    level: Level
    sentence: str
    reasons: tuple[Reason, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the verdict as values for JSON."""
        return {
            "level": self.level.name.lower(),
            "sentence": self.sentence,
            "reasons": [
                {"level": reason.level.name.lower(), "name": reason.name, "what": reason.what, "change": reason.change}
                for reason in self.reasons
            ],
        }


@dataclass(frozen=True, slots=True)
class Rule(Generic[Figures]):
    """A limit on a figure.

    Attributes:
        name: short name.
        measure: yields pairs of (what is measured, value) from the figures; None is not judged.
        care, unusable: a value above it is a reason of that level; None: no such limit.
        what: a sentence with ``{value}`` and ``{of}``.
        change: the remedy.
        shown: turns a value into what ``{value}`` stands for.
        least: True if the limits are minimum values.
    """

    name: str
    measure: Callable[[Figures], Iterator[tuple[str, float | None]]]
    care: float | None
    unusable: float | None
    what: str
    change: str
    shown: Callable[[float], float | str] = float
    least: bool = False

    def judged(self, figures: Figures) -> Iterator[Reason]:
        """Yield a reason for each value beyond a limit; nan counts as the worst."""
        for of, value in self.measure(figures):
            if value is None:
                continue
            for level, limit in ((Level.UNUSABLE, self.unusable), (Level.CARE, self.care)):
                if limit is not None and self._is_beyond(value, limit):
                    what = self.what.format(of=of, value=self.shown(value))
                    yield Reason(level, self.name, what, self.change, self._excess(value, limit))
                    break

    def _is_beyond(self, value: float, limit: float) -> bool:
        return not value >= limit if self.least else not value <= limit

    def _excess(self, value: float, limit: float) -> float:
        above, below = (limit, value) if self.least else (value, limit)
        return above / below if below > 0.0 and math.isfinite(above) else math.inf


def worst_first(reasons: Iterable[Reason]) -> tuple[Level, tuple[Reason, ...]]:
    """Return the level that reasons make together, and the reasons with the worst first."""
    ordered = tuple(sorted(reasons, key=lambda reason: (-reason.level, -reason.excess)))
    return (ordered[0].level if ordered else Level.GOOD), ordered
