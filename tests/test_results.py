"""Tests the closing line of all runs: its counts, and when it is a failure."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.results import summary

TESTS = """
import pytest

@pytest.fixture
def broken():
    raise RuntimeError

def test_good(): pass
def test_bad(): assert {bad}
def test_skipped(): pytest.skip("absent")
{error}
"""
ERROR = "def test_error(broken): pass"


def run_tests(folder: Path, name: str, text: str) -> None:
    """Run a file of tests, its JUnit file beside it."""
    path = folder / f"test_{name}.py"
    path.write_text(text)
    options = ["-q", "-p", "no:cacheprovider", "-c", "/dev/null", f"--rootdir={folder}"]
    command = [sys.executable, "-m", "pytest", *options, f"--junitxml={folder / name}.xml", str(path)]
    subprocess.run(command, cwd=folder, capture_output=True, check=False)


@pytest.mark.parametrize(
    ("bad", "error", "line", "good"),
    [
        ("False", ERROR, "==== 1 failed, 3 passed, 2 skipped, 1 error in", False),
        ("True", ERROR, "==== 4 passed, 2 skipped, 1 error in", False),
        ("False", "", "==== 1 failed, 3 passed, 2 skipped in", False),
        ("True", "", "==== 4 passed, 2 skipped in", True),
    ],
)
def test_outcomes_of_several_runs_are_added(tmp_path: Path, bad: str, error: str, line: str, good: bool) -> None:
    run_tests(tmp_path, "first", TESTS.format(bad=bad, error=error))
    run_tests(tmp_path, "second", TESTS.format(bad="True", error=""))
    lines, passed = summary(tmp_path)
    assert lines[-1].startswith(line)
    assert [one.split()[-1] for one in lines if " in all: " in one] == ["first", "second"]
    assert passed == good


def test_a_folder_without_runs_is_a_failure(tmp_path: Path) -> None:
    assert summary(tmp_path) == (["==== no tests ran in 0.00s ===="], False)
