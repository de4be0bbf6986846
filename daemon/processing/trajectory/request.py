"""Describes what the command line asks of a trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from swath.daemon.processing.navigation.navigate import NavigationOptions


@dataclass(frozen=True, slots=True)
class TrajectoryRequest:
    """What the command line asks for.

    Attributes:
        logs, output: where from, where to.
        navigate: how.
        csv: a CSV file too.
        events: event marks go there; None: nowhere.
        page: the page of plots is made.
        overwrite: files of an earlier run are replaced.
    """

    logs: Sequence[Path]
    output: Path
    navigate: NavigationOptions = field(default_factory=NavigationOptions)
    csv: bool = False
    events: Path | None = None
    page: bool = True
    overwrite: bool = False
