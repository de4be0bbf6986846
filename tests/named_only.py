"""Collects folders of tests that need more than a computer with Python only if they are named."""

from __future__ import annotations

from pathlib import Path

import pytest


def is_asked_for(folder: Path, config: pytest.Config) -> bool:
    """Return True if the command line names the folder or something in it."""
    asked = [Path(config.invocation_params.dir, argument.partition("::")[0]).resolve() for argument in config.args]
    return any(path.is_relative_to(folder) for path in asked)


def limit(folder: Path, items: list[pytest.Item], hangs_s: float) -> None:
    """Set a time limit for those of the folder's tests that have none."""
    for item in items:
        if item.path.is_relative_to(folder) and item.get_closest_marker("timeout") is None:
            item.add_marker(pytest.mark.timeout(hangs_s))
