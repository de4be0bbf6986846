"""Tests in a virtual machine: only when they are asked for by name (``pytest tests/vm``), as `make test-vm` does."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Generator
from pathlib import Path

import pytest

from tests.named_only import is_asked_for, limit
from tests.vm.beside import Moment
from tests.vm.machine import BESIDE_OTHERS, stood_still

HERE = Path(__file__).resolve().parent
HANGS_S = 1500.0  # beyond it nothing is awaited; a machine has its own limit
OTHERS = 0.2  # of the processors: with more beside it the emulated machine is another
_BEGAN = pytest.StashKey[Moment]()
_FAILURES = pytest.StashKey[list[tuple[str, str, float]]]()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    return None if is_asked_for(HERE, config) else True


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    limit(HERE, items, HANGS_S)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    item.stash[_BEGAN] = Moment.here()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Beside a failure stands how much of this computer others had."""
    report = yield
    if report.failed:
        share = item.stash[_BEGAN].share_of_others()
        report.sections.append(("this computer", f"others had {share:.0%} of its processors meanwhile"))
        failures = item.config.stash.setdefault(_FAILURES, [])
        failures.append((str(item.path), "failed" if report.when == "call" else "error", share))
    return report


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Where others had much of it in all that failed, that is left for `tests.vm.__main__`."""
    BESIDE_OTHERS.unlink(missing_ok=True)
    failures = session.config.stash.get(_FAILURES, [])
    if failures and all(share > OTHERS for _, _, share in failures):
        kinds = Counter(kind for _, kind, _ in failures)
        told = {"failed": kinds["failed"], "error": kinds["error"], "paths": sorted({path for path, _, _ in failures})}
        BESIDE_OTHERS.parent.mkdir(exist_ok=True)
        BESIDE_OTHERS.write_text(json.dumps(told))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """What the proofs measured, below which of them passed."""
    reports = [report for outcome in ("passed", "failed") for report in terminalreporter.getreports(outcome)]
    measured = [report for report in reports if report.when == "call" and report.user_properties]
    if measured:
        terminalreporter.section("figures")
    for report in measured:
        told = ", ".join(f"{name} {_short(value)}" for name, value in report.user_properties)
        terminalreporter.write_line(f"{report.nodeid.removeprefix('tests/vm/')}  {told}")
    if stood_still:
        count = len(stood_still)
        terminalreporter.write_line(f"machines that stood still before their first program, powered on again: {count}")


def _short(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
