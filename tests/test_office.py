"""Tests the ten steps of docs/office.md: each command runs in its place and prints what the page shows."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.office import PAGE, run, shape, steps


@pytest.mark.slow
def test_every_step_of_the_office_page_prints_what_the_page_shows(tmp_path: Path) -> None:
    for step in steps(PAGE.read_text()):
        printed = [shape(line) for line in run(step.command, tmp_path)]
        assert printed == [shape(line) for line in step.printed], step.command


def test_the_page_has_ten_steps() -> None:
    numbers = [line.split()[1] for line in PAGE.read_text().splitlines() if line.startswith("## ")]
    assert numbers == [str(number) for number in range(1, 11)]
