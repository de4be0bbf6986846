"""Collects the tests on an emulated ARM64 only if named (``pytest tests/arm64``), as `make test-arm64` does."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.named_only import is_asked_for, limit

HERE = Path(__file__).resolve().parent
HANGS_S = 3600.0  # loops are compiled by an emulated compiler


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    return None if is_asked_for(HERE, config) else True


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    limit(HERE, items, HANGS_S)
