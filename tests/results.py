"""Sums up the JUnit files that pytest's runs left in a folder: the slowest tests, each run, and one closing line.

    python tests/results.py FOLDER

Exit status 1 where there is no file, or a test has failed.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

SLOWEST = 15
KINDS = {"failure": "failed", "error": "error", "skipped": "skipped"}


def outcome_of(case: ElementTree.Element) -> str:
    """Return what became of a test, in pytest's word."""
    return next((word for tag, word in KINDS.items() if case.find(tag) is not None), "passed")


def summary(folder: Path) -> tuple[list[str], bool]:
    """Return the lines that sum up all runs of a folder, and whether all tests have passed."""
    counts: Counter[str] = Counter()
    runs: dict[str, float] = {}
    cases: list[tuple[float, str]] = []
    for path in sorted(folder.glob("*.xml")):
        for suite in ElementTree.parse(path).iter("testsuite"):
            runs[path.stem] = runs.get(path.stem, 0.0) + float(suite.get("time", 0.0))
            for case in suite.iter("testcase"):
                counts[outcome_of(case)] += 1
                cases.append((float(case.get("time", 0.0)), f"{case.get('classname')}::{case.get('name')}"))
    lines = [f"{time_s:7.1f} s  {name}" for time_s, name in sorted(cases, reverse=True)[:SLOWEST]]
    lines += [f"{time_s:7.1f} s  in all: {name}" for name, time_s in runs.items()]
    words = [f"{counts[word]} {word}" for word in ("failed", "passed", "skipped", "error") if counts[word]]
    lines.append(f"==== {', '.join(words) or 'no tests ran'} in {sum(runs.values()):.2f}s ====")
    return lines, counts["passed"] > 0 and not counts["failed"] and not counts["error"]


if __name__ == "__main__":
    text, good = summary(Path(sys.argv[1]))
    sys.stdout.write("\n".join(text) + "\n")
    sys.exit(0 if good else 1)
