"""Plugin of pytest that skips the tests which `tests.arm64.suite` leaves out, with the reason."""

from __future__ import annotations

import pytest

from tests.arm64.suite import LEFT_OUT


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip tests that cannot run here; refuse names that no longer match a test."""
    unmet = set(LEFT_OUT)
    for item in items:
        for name, reason in LEFT_OUT.items():
            if item.nodeid.startswith(name):
                item.add_marker(pytest.mark.skip(reason=reason))
                unmet.discard(name)
    if unmet:
        raise pytest.UsageError(f"tests/arm64/suite.py leaves out what is not there: {', '.join(sorted(unmet))}")
