"""Completion in a shell: a real bash with the script that `swath completion` prints."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.builders import ROOT
from tests.daemon.rig import HANGS_S

LIGHT = """
import os, sys
from swath.daemon.cli.main import run_app
try:
    run_app([])
except SystemExit:
    pass
print([name for name in ("numba", "scipy", "numpy", "matplotlib", "cantools") if name in sys.modules])
"""


def test_bash_completes_commands_and_their_options(tmp_path: Path) -> None:
    program = tmp_path / "swath"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m swath.daemon.cli.main "$@"\n')
    program.chmod(0o755)
    script = """
    eval "$(swath completion bash)"
    ask() { COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _swath_completion swath; echo "${COMPREPLY[@]}"; }
    ask swath mo; ask swath recover --ke; ask swath sim fl
    """
    path = f"{tmp_path}:{os.environ['PATH']}"
    run = subprocess.run(
        ["bash", "-c", script],
        cwd=ROOT,
        env=os.environ | {"PATH": path},
        capture_output=True,
        text=True,
        timeout=HANGS_S,
        check=True,
    )
    assert (run.stdout.splitlines(), run.stderr) == (["monitor", "--keep-free-mb", "fly"], "")


def test_completing_a_command_s_name_imports_no_command() -> None:
    asked = {"COMP_WORDS": "swath mo", "COMP_CWORD": "1", "_SWATH_COMPLETE": "complete_bash"}
    run = subprocess.run(
        [sys.executable, "-c", LIGHT],
        cwd=ROOT,
        env=os.environ | asked,
        capture_output=True,
        text=True,
        timeout=HANGS_S,
        check=True,
    )
    assert run.stdout == "monitor\n[]\n"
