"""Tests the share of processors used by other programs, which is reported with a virtual machine's failure."""

from __future__ import annotations

import subprocess
import sys

from tests.vm.beside import Moment

SPIN = "import time\nwhile time.process_time() < 0.4: pass\nprint(flush=True); input()"


def test_processor_time_of_running_and_ended_descendants_counts_as_own() -> None:
    before = Moment.here()
    inner = [sys.executable, "-c", SPIN]
    script = f"import subprocess; subprocess.run({inner!r})"
    with subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as outer:
        assert outer.stdout is not None
        outer.stdout.readline()
        alive = Moment.here()
        outer.communicate(b"\n")
    ended = Moment.here()
    assert alive.own_s - before.own_s > 0.35
    assert alive.own_s <= ended.own_s + 0.02
    assert ended.busy_s - before.busy_s > 0.35
    assert 0.0 <= before.share_of_others() < 1.0
