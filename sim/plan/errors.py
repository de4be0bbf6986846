"""What a user of the virtual aircraft can get wrong."""

from __future__ import annotations


class PlanError(ValueError):
    """A plan that cannot be flown; one line: the plan's key, what is wrong, what would be right.

    Args:
        key: dotted name in the plan, as ``line[2].height_m``.
        text: what is wrong and what would be right.
    """

    def __init__(self, key: str, text: str) -> None:
        super().__init__(f"{key}: {text}")
        self.key = key
