"""Tests which line of chrony's configuration allows steps of the clock in flight, and what changes it."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from swath.daemon.doctor.clock import chrony_steps
from swath.daemon.doctor.finding import Tree
from tests.builders import SYSTEMD
from tests.daemon.doctor.builders import DEBIAN_CHRONY, write

MAIN, DROP_IN = "/etc/chrony/chrony.conf", "/etc/chrony/conf.d/swath.conf"
ALWAYS = "makestep 0.1 -1\n"


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    """Return chrony's files as installed by Debian, with our drop-in."""
    made = Tree(tmp_path)
    write(made, MAIN, DEBIAN_CHRONY)
    write(made, DROP_IN, (SYSTEMD / "chrony/swath.conf").read_text())
    return made


@pytest.mark.parametrize(
    "files",
    [
        {},
        {DROP_IN: ALWAYS},
        {MAIN: "confdir /etc/chrony/conf.d\n", "/etc/chrony/conf.d/a.conf": ALWAYS},
        {MAIN: "sourcedir /etc/mine\n", "/etc/mine/a.sources": ALWAYS},
        {MAIN: "confdir /etc/chrony/conf.d /etc/last\n", "/etc/last/swath.conf": ALWAYS},
        {MAIN: f"include {MAIN}\n! makestep 1 -1\n#makestep 1 -1\nmakestep 1\nconfdir\ninclude\n"},
    ],
)
def test_a_directive_overridden_later_has_no_effect(tree: Tree, files: dict[str, str]) -> None:
    """By chrony.conf(5), the last of two equal directives is effective."""
    for path, text in files.items():
        write(tree, path, text)
    assert list(chrony_steps(tree)) == []


@pytest.mark.parametrize(
    ("files", "winner"),
    [
        ({MAIN: DEBIAN_CHRONY.replace("makestep 1 3", "makestep 1 -1")}, MAIN),
        ({MAIN: "makestep 1 3\n  MakeStep  1 -1\nrtcsync\n"}, MAIN),
        ({MAIN: "makestep 1 3\nConfDir /etc/chrony/conf.d\n", DROP_IN: ALWAYS + "maxslewrate 100\n"}, DROP_IN),
        ({MAIN: "confdir /etc/first /etc/chrony/conf.d\n", "/etc/first/swath.conf": ALWAYS}, "/etc/first/swath.conf"),
        ({MAIN: "include /m/*.inc\n", "/m/a.inc": "makestep 1 3\n", "/m/b c.inc": ALWAYS}, "/m/b c.inc"),
    ],
)
def test_the_effective_file_is_named_and_its_remedy_loses_nothing(
    tree: Tree, files: dict[str, str], winner: str
) -> None:
    for path, text in files.items():
        write(tree, path, text)
    before = {path: path.read_text() for path in tree.root.rglob("*") if path.is_file()}
    (found,) = chrony_steps(tree)
    assert found.text.startswith(f"{winner} lets chrony step the clock at any time")
    edit, restart = found.mend.split(" && ")
    assert restart == "sudo systemctl restart chrony"
    subprocess.run(["sh", "-c", edit.removeprefix("sudo ").replace(winner, str(tree.at(winner)))], check=True)
    assert list(chrony_steps(tree)) == []
    mended = re.sub(r"(?im)^ *makestep .*$", "makestep 1 3", before[tree.at(winner)])
    after = {path: path.read_text() for path in before}
    assert after == before | {tree.at(winner): mended}
