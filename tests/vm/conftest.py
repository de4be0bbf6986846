"""Tests in a virtual machine: only when they are asked for by name (``pytest tests/vm``), as `make test-vm` does."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.named_only import is_asked_for, limit

HERE = Path(__file__).resolve().parent
HANGS_S = 1500.0  # beyond it nothing is awaited; a machine has its own limit
STEP_S = 0.05


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    return None if is_asked_for(HERE, config) else True


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    limit(HERE, items, HANGS_S)


@pytest.fixture(autouse=True)
def _own_stalls() -> Iterator[None]:
    """Beside a failure stands how long this computer did not come to its work: the machine stood as long."""
    stopped, longest_s = threading.Event(), 0.0

    def watch() -> None:
        nonlocal longest_s
        before_s = time.monotonic()
        while not stopped.wait(STEP_S):
            now_s = time.monotonic()
            longest_s, before_s = max(longest_s, now_s - before_s - STEP_S), now_s

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    yield
    stopped.set()
    thread.join()
    sys.stdout.write(f"this computer stood still for up to {longest_s:.2f} s\n")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """What the proofs measured, below which of them passed."""
    reports = [report for outcome in ("passed", "failed") for report in terminalreporter.getreports(outcome)]
    measured = [report for report in reports if report.when == "call" and report.user_properties]
    if measured:
        terminalreporter.section("figures")
    for report in measured:
        told = ", ".join(f"{name} {_short(value)}" for name, value in report.user_properties)
        terminalreporter.write_line(f"{report.nodeid.removeprefix('tests/vm/')}  {told}")


def _short(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
