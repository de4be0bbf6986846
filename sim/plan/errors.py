"""The error that reports a user's mistakes in a plan."""

from __future__ import annotations


class PlanError(ValueError):
    """Reports a plan that cannot be flown, in one line: the plan's key, the fault and the remedy.

    Args:
        key: dotted name in the plan, such as ``line[2].height_m``.
        text: the fault and the remedy.
    """

    def __init__(self, key: str, text: str) -> None:
        super().__init__(f"{key}: {text}")
        self.key = key
