"""Fixtures that tests of several parts of the daemon use."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """Return the folder of logs, which does not exist yet."""
    return tmp_path / "logs"
