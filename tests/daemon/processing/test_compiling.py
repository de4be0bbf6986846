"""Tests that compilations are noticed, also in worker processes, and reported once."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numba
import pytest

from swath.daemon.cli.progress import COMPILING
from swath.daemon.processing.compiling import before_compiling, compilations, mark_compiling, tell_of_workers
from tests.daemon.rig import HANGS_S

ROOT = Path(__file__).resolve().parents[3]


def compile_in_worker(flag: Any) -> None:
    """Compile a loop where a shared flag is set before."""
    mark_compiling(flag)
    numba.njit(lambda x: 5 * x)(2)


def test_compilation_is_detected() -> None:
    def twice(x: int) -> int:
        return 2 * x

    compiled: Any = numba.njit(twice)
    with compilations() as names:
        assert compiled(3) == 6
    assert any("twice" in name for name in names)
    with compilations() as names:
        assert compiled(4) == 8
    assert names == []


def test_the_function_is_called_once_and_before_compiling_begins() -> None:
    calls: list[str] = []
    with before_compiling(lambda: calls.append("begins")):
        numba.njit(lambda x: 3 * x)(2)
        numba.njit(lambda x: 4 * x)(2)
        tell_of_workers(0.0)
    assert calls == ["begins"]
    with before_compiling(lambda: calls.append("again")):
        pass
    tell_of_workers(0.0)  # the block has ended
    assert calls == ["begins"]


@pytest.mark.slow
def test_a_worker_process_marks_that_it_compiles() -> None:
    context = multiprocessing.get_context("spawn")
    flag = context.Value("d", 0.0)
    worker = context.Process(target=compile_in_worker, args=(flag,))
    worker.start()
    worker.join(HANGS_S)
    assert worker.exitcode == 0
    assert flag.value > 0.0
    calls: list[str] = []
    with before_compiling(lambda: calls.append("worker")):
        tell_of_workers(0.0)
        tell_of_workers(0.0)
    assert calls == ["worker"]


@pytest.mark.slow
def test_a_flight_on_a_new_installation_says_that_it_compiles(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    command = [sys.executable, "-m", "swath.daemon.cli.main", "sim", "fly", "small", "--seconds", "14"]
    for number, told in enumerate((1, 0)):
        flown = [*command, "-o", str(tmp_path / str(number))]
        done = subprocess.run(flown, cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
        assert done.stderr.count(COMPILING) == told
