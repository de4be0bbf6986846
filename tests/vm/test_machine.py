"""The machine itself: what the other tests rely on."""

from __future__ import annotations

from pathlib import Path

from tests.vm import installed, machine


def test_status_and_words_come_back(tmp_path: Path) -> None:
    found = machine.run("uname -r; ls pyproject.toml; cat /proc/1/comm; exit 7", shared=tmp_path)
    assert found.status == 7, found
    assert found.output.splitlines()[1:] == ["pyproject.toml", "stage2"]


def test_program_is_installed_for_a_user_of_its_own(tmp_path: Path) -> None:
    command = "id swath && setpriv --reuid swath --regid swath --clear-groups swath --version && ls -ld /opt/swath"
    machine.run(command, shared=tmp_path, layers=[installed.installed()]).check()
