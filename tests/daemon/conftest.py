"""Fixtures that tests of several parts of the daemon use."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from swath.daemon.cli import progress


@pytest.fixture(autouse=True)
def quick_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Suppress lines of progress caused by a slow computer; the tests of progress set their own."""
    monkeypatch.setattr(progress, "AFTER_S", math.inf)


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """Return the folder of logs, which does not exist yet."""
    return tmp_path / "logs"
