"""Docstrings and commit subjects are written as CONTRIBUTING.md asks, and the script that looks finds what is not."""

from __future__ import annotations

import ast

import pytest

from tests.language import all_faults, fault_of, long_subjects


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
    ],
)
def test_the_first_line_of_a_docstring_is_judged(code: str, fault: str) -> None:
    node = ast.parse(code).body[0]
    assert isinstance(node, ast.FunctionDef | ast.ClassDef)
    assert fault_of(node, ast.get_docstring(node) or "") == fault


def test_docstrings_of_functions_begin_with_a_verb() -> None:
    assert all_faults() == []


def test_subjects_of_commits_are_short() -> None:
    assert long_subjects() == []
