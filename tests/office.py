"""Runs the commands of docs/office.md in order, and can write their output into the page.

python -m tests.office        writes the page's outputs anew
"""

from __future__ import annotations

import glob
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "office.md"
BLOCK = re.compile(r"(?ms)^```console\n(.*?)^```$")
COLUMNS = "130"
NUMBER = re.compile(r"[+−-]?\d[\d,.]*")
IDENTITY = re.compile(r"-[0-9a-f]{4}\b")  # of a session or a calibration


@dataclass(frozen=True)
class Step:
    """A command of the page, and what the page says that it prints."""

    command: str
    printed: list[str]


def steps(page: str) -> list[Step]:
    """Return the commands of the page in their order."""
    found: list[Step] = []
    for block in BLOCK.findall(page):
        for line in block.splitlines():
            if line.startswith("$ "):
                found.append(Step(line[2:], []))
            elif line:
                found[-1].printed.append(line)
    return found


def run(command: str, folder: Path, codes: Sequence[int] = (0,)) -> list[str]:
    """Run a command of the page in a folder, and return the lines that it prints; `codes`: expected exit codes."""
    words = [path for word in shlex.split(command) for path in (_expanded(word, folder) if "*" in word else [word])]
    if words[0] == "cp":
        shutil.copy(folder / words[1], folder / words[2])
        return []
    assert words[0] == "swath", command
    program = [sys.executable, "-m", "swath.daemon.cli.main", *words[1:]]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": COLUMNS}
    done = subprocess.run(program, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode in codes, f"{command}: exit code {done.returncode}\n{done.stdout}{done.stderr}"
    return [line.rstrip() for line in done.stdout.splitlines() if line.strip()]


def _expanded(word: str, folder: Path) -> list[str]:
    found = sorted(glob.glob(word, root_dir=folder))
    assert found, f"{word}: no such file"
    return found


def shape(line: str) -> str:
    """Return a line with a placeholder for each number and each identity, blanks joined."""
    return " ".join(NUMBER.sub("#", IDENTITY.sub("-#", line)).split())


def written(page: str, printed_by: Callable[[str], list[str]]) -> str:
    """Return the page with the outputs that a function gives for its commands."""

    def block(match: re.Match[str]) -> str:
        commands = [line for line in match[1].splitlines() if line.startswith("$ ")]
        texts = ["\n".join([command, *printed_by(command[2:])]) for command in commands]
        return "```console\n" + "\n".join(texts) + "\n```"

    return BLOCK.sub(block, page)


def main() -> None:
    """Write the outputs anew."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        PAGE.write_text(written(PAGE.read_text(), lambda command: run(command, folder)))


if __name__ == "__main__":
    main()
