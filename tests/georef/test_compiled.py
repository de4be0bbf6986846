"""Tests that compiled loops are cached between processes, and never outlive their source text."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import swath.georef

INNER = """from swath.georef.compiled import jit_inline


@jit_inline
def inner(x: float) -> float:
    return {factor} * x
"""
OUTER = """from swath.georef.compiled import jit_cached
import pytest

from swath.georef.inner import inner


@jit_cached
def outer(x: float) -> float:
    return inner(x)


print(outer(1.0), sum(outer.stats.cache_hits.values()))
"""


@pytest.mark.slow
def test_a_kernel_changed_in_another_file_is_compiled_anew(tmp_path: Path) -> None:
    package = tmp_path / "swath/georef"
    package.mkdir(parents=True)
    (tmp_path / "swath/__init__.py").touch()
    shutil.copy(Path(str(swath.georef.__file__)).parent / "compiled.py", package)
    (package / "__init__.py").touch()
    (package / "outer.py").write_text(OUTER)

    def run(factor: float) -> str:
        (package / "inner.py").write_text(INNER.format(factor=factor))
        environment = os.environ | {
            "PYTHONPATH": str(tmp_path),
            "PYTHONDONTWRITEBYTECODE": "1",  # Python would mistake a file of equal length and second for the same
            "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        }
        command = [sys.executable, "-c", "import swath.georef.outer"]
        done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    assert run(2.0) == "2.0 0"
    assert run(2.0) == "2.0 1"
    assert run(3.0) == "3.0 0"


@pytest.mark.slow
def test_a_kernel_is_compiled_without_a_writable_cache_folder(tmp_path: Path) -> None:
    package = tmp_path / "swath/georef"
    package.mkdir(parents=True)
    (tmp_path / "swath/__init__.py").touch()
    shutil.copy(Path(str(swath.georef.__file__)).parent / "compiled.py", package)
    (package / "__init__.py").touch()
    (package / "inner.py").write_text(INNER.format(factor=4.0))
    (package / "outer.py").write_text(OUTER.replace(", sum(outer.stats.cache_hits.values())", ""))
    environment = os.environ | {"PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": "/proc/nowhere"}
    done = subprocess.run(
        [sys.executable, "-c", "import swath.georef.outer"],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.stdout.strip() == "4.0", done.stderr


@pytest.mark.slow
def test_a_loop_that_cannot_be_stored_runs_all_the_same(tmp_path: Path) -> None:
    """Several commands at once compile the same loops on a new installation; numba may then refuse to store one."""
    script = tmp_path / "kernel.py"
    script.write_text(
        "from numba.core.compiler import CompileResult\n"
        "from swath.georef.compiled import jit_cached\n\n"
        "def refuse(self):\n    raise RuntimeError('no compiled object yet')\n\n"
        "CompileResult._reduce = refuse\n\n"
        "@jit_cached\ndef twice(x):\n    return 2.0 * x\n\n"
        "print(twice(1.5))\n"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    done = subprocess.run([sys.executable, str(script)], env=environment, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("3.0\n", "")
