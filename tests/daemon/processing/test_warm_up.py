"""Tests that after ``swath warm-up`` nothing is compiled or read from the cache."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from swath.daemon.cli.main import INTERRUPTED
from swath.daemon.processing.warm_up import WarmUp, cache_folder
from tests.builders import ROOT
from tests.daemon.builders import swath
from tests.daemon.rig import HANGS_S

pytestmark = pytest.mark.xdist_group("kernels")

ALL_SIGNATURES = """
import gc, json, sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher

def signatures():
    known = (one for one in gc.get_objects() if isinstance(one, Dispatcher))
    return {f"{one.py_func.__qualname__} {signature}" for one in known for signature in one.overloads}
"""

FLY = (
    ALL_SIGNATURES
    + """
from swath.daemon.config.tables import LiveConfig
from swath.daemon.processing.live.session import replay
from swath.daemon.processing.compiling import compilations
from swath.daemon.processing.warm_up import get_ready, warm_up
from tests.daemon.processing.live.test_live import Flown

folder = Path(sys.argv[1])
flown = Flown(folder)
warm_up()
setup = flown.setup()
get_ready(setup)
kept = gc.get_freeze_count()
gc.unfreeze()  # else they are listed no more
before = signatures()
with compilations() as names:
    found = replay(flown.session(), setup, folder / "live", LiveConfig(), None)
print(json.dumps({"new": sorted(signatures() - before), "compiled": names, "known": len(before), "kept": kept,
                  "points": sum(found["points"].values())}))
"""
)

NO_CACHE = """
import numpy as np
from swath.daemon.processing.live.grid import CellGrid
from swath.daemon.processing.warm_up import WarmUp, cache_folder
from tests.daemon.processing.live.builders import points_at
from tests.drivers.scanner.rows.test_compiled import random_slots, returns_table
from swath.drivers.scanner.rows.compiled import fill

grid = CellGrid(1.0)
grid.add(points_at(np.zeros((3, 3))), np.zeros(3), np.ones(3))
made = random_slots(1, None, 1)
print(cache_folder(), grid.points, fill(made, returns_table(made.content.size)) > 500)
"""


def run_python(text: str, *arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", text, *(str(argument) for argument in arguments)]
    return subprocess.run(
        command, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True, timeout=HANGS_S, check=False
    )


@pytest.mark.slow
def test_after_a_warm_up_a_flight_compiles_nothing(tmp_path: Path) -> None:
    """The first pulse takes as long as the thousandth: nothing is compiled, and no cache is read."""
    done = run_python(FLY, tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["new"] == []
    assert found["compiled"] == []
    assert found["known"] > 15
    assert found["kept"] > 100_000, "what the garbage collector would go through while points are made"
    assert found["points"] > 20_000


@pytest.mark.slow
@pytest.mark.parametrize(
    ("signum", "code"), [(signal.SIGTERM, -signal.SIGTERM), (signal.SIGINT, INTERRUPTED)], ids=lambda one: str(one)
)
def test_live_announces_compilation_and_can_be_interrupted(tmp_path: Path, signum: int, code: int) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    command = [sys.executable, "-m", "swath.daemon.cli.main", "live", str(tmp_path)]
    with subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True) as live:
        assert live.stderr is not None
        try:
            assert (
                live.stderr.readline()
                == "compiling; this takes a minute or more. Run `swath warm-up` before a flight to avoid it\n"
            )
            live.send_signal(signum)
            assert live.wait(HANGS_S) == code
            rest = live.stderr.read()
        finally:
            live.kill()
    assert "loops compiled" not in rest, "it has not compiled all of them first"


@pytest.mark.slow
@pytest.mark.skipif(
    tuple(int(part) for part in numba.__version__.split(".")[:2]) < (0, 62), reason="its caches cannot be taken away"
)
def test_without_a_cache_folder_loops_are_compiled_in_memory(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    nowhere = str(tmp_path / "file/cache")
    done = run_python(NO_CACHE, NUMBA_CACHE_DIR=nowhere, NUMBA_CACHE_LOCATOR_CLASSES="_UserProvidedCacheLocator")
    assert done.stdout.split() == ["None", "3", "True"], done.stderr


def test_warm_up_reports_the_cache_folder_or_its_absence(tmp_path: Path) -> None:
    folder = cache_folder()
    assert folder is not None
    assert folder.is_dir()
    assert WarmUp(12, 3.25, tmp_path).text() == f"12 loops compiled in 3.2 s; kept in {tmp_path}"
    assert "already" in WarmUp(0, 0.5, tmp_path).text()
    assert "compiles in memory; set NUMBA_CACHE_DIR" in WarmUp(12, 3.25, None).text()


@pytest.mark.slow
def test_a_wrong_configuration_is_refused_in_one_line(tmp_path: Path) -> None:
    config = tmp_path / "swath.toml"
    config.write_text('[session]\nname = "a"\nspeed = 3\n')
    done = swath("warm-up", str(config))
    assert done.returncode == 2
    assert done.stderr.startswith("swath: ")
    assert "speed" in done.stderr
