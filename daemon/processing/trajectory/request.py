"""Defines the command line's request for a trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from swath.daemon.processing.navigation.navigate import NavigationOptions


@dataclass(frozen=True, slots=True)
class TrajectoryRequest:
    """The options of `swath trajectory` from the command line.

    Attributes:
        logs, output: logs that are read, and where the files go.
        navigate: options of navigation.
        csv: write a CSV file too.
        events: file for event marks; None: no file.
        page: write the page of plots.
        overwrite: replace files of an earlier run.
    """

    logs: Sequence[Path]
    output: Path
    navigate: NavigationOptions = field(default_factory=NavigationOptions)
    csv: bool = False
    events: Path | None = None
    page: bool = True
    overwrite: bool = False
