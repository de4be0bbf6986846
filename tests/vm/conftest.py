"""Collects the tests in a virtual machine only if named (``pytest tests/vm``), as `make test-vm` does."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import pytest

from tests.named_only import is_asked_for, limit
from tests.vm.beside import Moment
from tests.vm.machine import stood_still

HERE = Path(__file__).resolve().parent
HANGS_S = 1500.0  # no wait is longer; a machine has its own limit
_BEGAN = pytest.StashKey[Moment]()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    return None if is_asked_for(HERE, config) else True


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    limit(HERE, items, HANGS_S)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    item.stash[_BEGAN] = Moment.here()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Report with a failure how much of this computer others had, and with any test the machines that stood still."""
    report = yield
    if report.failed:
        share = item.stash[_BEGAN].share_of_others()
        report.sections.append(("this computer", f"others had {share:.0%} of its processors meanwhile"))
    if report.when == "call" and stood_still:
        report.user_properties.append(("powered_on_again", len(stood_still)))
        stood_still.clear()
    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the figures of the proofs, below the results.

    `powered_on_again` counts machines that stood still before their first program and were powered on again.
    """
    reports = [report for outcome in ("passed", "failed") for report in terminalreporter.getreports(outcome)]
    measured = [report for report in reports if report.when == "call" and report.user_properties]
    if measured:
        terminalreporter.section("figures")
    for report in measured:
        told = ", ".join(f"{name} {_short(value)}" for name, value in report.user_properties)
        terminalreporter.write_line(f"{report.nodeid.removeprefix('tests/vm/')}  {told}")


def _short(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
