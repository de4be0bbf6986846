"""Tests that nothing is loaded from disk when time locks in flight, because edges would be overwritten."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
LOCK = """
import sys
import swath.daemon.recorder.run
from swath.georef.records import NamesEdge, TimeMessage, TimeScale, TimeTag
from swath.georef.timescales import PpsClock
S = 1_000_000_000
clock = PpsClock()
loaded = set(sys.modules)
for second in range(120):
    edge_ns = 10_000 * S + second * S + second % 3 * 500
    clock.add_edge(edge_ns, second)
    tag = TimeTag(TimeScale.GPS, (345_600 + second) * S, 2423)
    clock.add_message("gnss/rover", TimeMessage(edge_ns + 80_000_000, tag, NamesEdge.PREVIOUS, message="TIME"))
    clock.status(edge_ns + 300_000_000)
print(clock.status(edge_ns + 300_000_000).state.name, sorted(set(sys.modules) - loaded))
"""


def test_the_first_lock_imports_no_module() -> None:
    found = subprocess.run([sys.executable, "-c", LOCK], cwd=ROOT, capture_output=True, text=True, check=False)
    assert found.stdout == "LOCKED []\n", found.stdout + found.stderr
