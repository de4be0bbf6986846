"""The machine itself: what the other tests rely on."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from tests.vm import installed, machine

PAUSED_AT_FIRST = """\
#!/bin/sh
mkdir {mark} 2>/dev/null && exec {qemu} -S "$@"
exec {qemu} "$@"
"""


def test_status_and_words_come_back(tmp_path: Path) -> None:
    found = machine.run("uname -r; ls pyproject.toml; cat /proc/1/comm; exit 7", shared=tmp_path)
    assert found.status == 7, found
    assert found.output.splitlines()[1:] == ["pyproject.toml", "stage2"]


def test_program_is_installed_for_a_user_of_its_own(tmp_path: Path) -> None:
    command = "id swath && setpriv --reuid swath --regid swath --clear-groups swath --version && ls -ld /opt/swath"
    machine.run(command, shared=tmp_path, layers=[installed.installed()]).check()


def test_one_that_stands_still_is_powered_on_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Path] = []
    monkeypatch.setattr(machine, "stood_still", told)
    monkeypatch.setattr(machine, "FIRST_WORD_S", 12.0)
    programs = tmp_path / "bin"
    programs.mkdir()
    qemu = programs / "qemu-system-x86_64"
    qemu.write_text(PAUSED_AT_FIRST.format(mark=tmp_path / "mark", qemu=shutil.which(qemu.name)))
    qemu.chmod(0o755)
    environment = {"PATH": f"{programs}:{os.environ['PATH']}"}
    found = machine.run("echo awake", shared=tmp_path / "vm", environment=environment).check()
    assert found.output == "awake\n"
    assert told == [tmp_path / "vm"]
