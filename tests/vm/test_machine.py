"""Tests the machine itself, on which the other tests rely."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from tests.vm import machine

pytestmark = pytest.mark.alone

PAUSED_AT_FIRST = """\
#!/bin/sh
mkdir {mark} 2>/dev/null && exec {qemu} -S "$@"
exec {qemu} "$@"
"""


def test_status_and_output_are_returned_by_a_machine_that_first_hung(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Path] = []
    monkeypatch.setattr(machine, "stood_still", told)
    monkeypatch.setattr(machine, "FIRST_WORD_S", 12.0)
    programs = tmp_path / "bin"
    programs.mkdir()
    qemu = programs / "qemu-system-x86_64"
    qemu.write_text(PAUSED_AT_FIRST.format(mark=tmp_path / "mark", qemu=shutil.which(qemu.name)))
    qemu.chmod(0o755)
    environment = {"PATH": f"{programs}:{os.environ['PATH']}"}
    command = "uname -r; ls pyproject.toml; cat /proc/1/comm; exit 7"
    found = machine.run(command, shared=tmp_path / "vm", environment=environment)
    assert found.status == 7, found
    assert found.output.splitlines()[1:] == ["pyproject.toml", "stage2"]
    assert told == [tmp_path / "vm"]
