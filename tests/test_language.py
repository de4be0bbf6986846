"""Tests that docstrings and commit subjects are as CONTRIBUTING.md asks, and that the script finds others."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests import language
from tests.language import ROOT, all_faults, fault_of, faults, files_of, long_subjects


@pytest.mark.parametrize(
    ("code", "fault"),
    [
        ("def f():\n    'Return the trajectory; it never changes.'", ""),
        ("def f():\n    'Of a trajectory, its name.'", "does not begin with a verb in the imperative"),
        ("def f():\n    'The name of it.'", "does not begin with a verb in the imperative"),
        ("def f():\n    'Return it.'", "fewer than 3 words"),
        ("@property\ndef f():\n    'The name in words.'", ""),
        ("class C:\n    'A strip of returns.'", ""),
        ("class C:\n    'A strip.'", "fewer than 3 words"),
        ("def test_f():\n    'The manual has the value.'", ""),
        ("def test_f():\n    'By hand.'", "fewer than 3 words"),
        ("@pytest.fixture\ndef f():\n    'A log of two parts.'", "does not begin with a verb in the imperative"),
        ("class TestC:\n    'A log is read.'", ""),
    ],
)
def test_the_first_line_of_a_docstring_is_judged(code: str, fault: str) -> None:
    node = ast.parse(code).body[0]
    assert isinstance(node, ast.FunctionDef | ast.ClassDef)
    assert fault_of(node, ast.get_docstring(node) or "") == fault


def test_the_files_looked_at_are_those_of_the_project() -> None:
    """A virtual machine's cache below tests/vm has Python files of other projects, which git does not track."""
    files = {path.relative_to(ROOT).as_posix() for path in files_of()}
    assert {"daemon/cli/main.py", "tests/test_language.py", "tests/vm/machine.py"} <= files
    assert not any(name.startswith("tests/vm/.cache/") for name in files)


def test_a_fault_is_reported_with_its_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(language, "ROOT", tmp_path)
    (tmp_path / "builders.py").write_text(
        "def log():\n    'A log of two parts.'\n\n\ndef test_f():\n    'A log is read.'\n"
    )
    place = "builders.py:1: does not begin with a verb in the imperative: A log of two parts."
    assert list(faults(tmp_path / "builders.py")) == [place]


def test_docstrings_of_functions_begin_with_a_verb() -> None:
    assert all_faults() == []


def test_subjects_of_commits_are_short() -> None:
    assert long_subjects() == []
