"""Tests in a virtual machine: only when they are asked for by name (``pytest tests/vm``), as `make test-vm` does."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.named_only import is_asked_for, limit

HERE = Path(__file__).resolve().parent
HANGS_S = 1500.0  # beyond it nothing is awaited; a machine has its own limit


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    return None if is_asked_for(HERE, config) else True


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    limit(HERE, items, HANGS_S)
