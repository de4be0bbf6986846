"""Finds docstrings and commit subjects that are not written as CONTRIBUTING.md asks.

    python -m tests.language [FOLDER...]

A function's docstring begins with a verb in the imperative, and every docstring has three words or more. A property's
may begin with a noun, and a test's is a sentence that says what its name does not. The verbs are listed: add one that
is missing to VERBS. A commit's subject has at most 72 characters.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("daemon", "drivers", "georef", "calib", "sim", "demo", "benchmarks", "tests")
FEWEST_WORDS = 3
LONGEST_SUBJECT = 72
SINCE = "2026-11-27T06:00+00:00"
NOUN_MAY_BEGIN = {"property", "cached_property", "setter"}
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
STATEMENTS = (ast.stmt, ast.excepthandler, ast.match_case)  # expressions, which are most of a file, hold no definitions
VERBS = set(
    """
    abandon accept accumulate act add adjust adopt advance allocate answer append apply ask assert begin bind boot
    bridge build calibrate call carry change check choose classify clear climb close collect combine compare compile
    complete compress compute concatenate connect convert copy correct count create cut decide decode decompress
    derive describe detect determine discard distribute divide do double draw drop encode end enlarge estimate
    evaluate examine expand export fail feed fill filter find finish fit flatten flush fly follow forget fork format
    forward free fuzz georeference give go group grow handle have hold ignore import improve initialise insert
    install interpolate invert iterate join judge keep label lay learn leave let limit link list listen load locate
    lock log look lower make map mark measure merge mount move multiply name navigate normalise note number open
    overwrite pack parse pass place plan play post predict prepare print process propagate provide put queue raise
    rank read receive recognise record redirect reduce refit refuse register release remove rename repair repeat
    replace replay reply report request restore return rotate run sample save say scale scan search select send
    serve set shift show skip smooth solve sort split spread start steer step stop store style sum summarise
    suppress switch sync take tell terminate test thin transform truncate try turn unpack unplug update use validate
    view wait wake warm watch whiten widen wire work wrap write yield
""".split()
)


def fault_of(node: ast.AST, docstring: str) -> str:
    """Return what is wrong with the first line of a docstring; empty if nothing is."""
    words = docstring.split("\n")[0].split()
    if len(words) < FEWEST_WORDS:
        return f"fewer than {FEWEST_WORDS} words"
    if not isinstance(node, FUNCTIONS) or node.name.startswith("test_"):
        return ""
    decorators = {getattr(one, "id", getattr(one, "attr", "")) for one in node.decorator_list}
    if decorators & NOUN_MAY_BEGIN or words[0].strip("`(),.;:").lower() in VERBS:
        return ""
    return "does not begin with a verb in the imperative"


def faults(path: Path) -> Iterator[str]:
    """Yield place, fault and first line of each docstring of a file that is at fault."""
    waiting: list[ast.AST] = [ast.parse(path.read_text())]
    while waiting:
        node = waiting.pop()
        waiting += [child for child in ast.iter_child_nodes(node) if isinstance(child, STATEMENTS)]
        if isinstance(node, (ast.ClassDef, *FUNCTIONS)):
            docstring = ast.get_docstring(node)
            fault = fault_of(node, docstring) if docstring else ""
            if docstring and fault:
                yield f"{path.relative_to(ROOT)}:{node.lineno}: {fault}: {docstring.splitlines()[0]}"


def long_subjects() -> list[str]:
    """Return the subjects of commits, as far as this clone has them, that are too long."""
    command = ["git", "log", "--format=%s", f"--since={SINCE}"]
    subjects = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    return [subject for subject in subjects if len(subject) > LONGEST_SUBJECT]


def files_of(folders: tuple[str, ...] = FOLDERS) -> list[Path]:
    """Return the Python files of folders, as far as git tracks them: tests/vm/.cache has files of other projects."""
    command = ["git", "ls-files", "-z", "--", *(f"{folder}/*.py" for folder in folders)]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [path for name in listed.split("\0") if name and (path := ROOT / name).is_file()]


def all_faults(folders: tuple[str, ...] = FOLDERS) -> list[str]:
    """Return a line for each docstring at fault in folders of the checkout."""
    return [line for path in files_of(folders) for line in faults(path)]


if __name__ == "__main__":
    found = [*all_faults(tuple(sys.argv[1:]) or FOLDERS), *long_subjects()]
    sys.stdout.write("".join(f"{line}\n" for line in found))
    sys.exit(1 if found else 0)
