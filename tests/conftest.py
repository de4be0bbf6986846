"""Prepares what all processes of a test run share, before the first of them begins."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from typing import Any

import pytest

TESTS = Path(__file__).parent
LEAN = TESTS / "lean"
# Groups and files that take minutes on one worker, longest first: begun last, they would leave the other workers idle.
LONGEST = (
    "kernels of georef",
    "daemon/cli/test_calibrate_cli.py",
    "install",
    "test_office.py",
    "demo",
    "daemon/cli/test_georef_judged.py",
    "daemon/cli/test_plan_calibration.py",
    "calib/test_strip_functions.py",
    "daemon/cli/test_interrupted.py",
    "daemon/monitor/test_monitor.py",
    "calib/strips/test_signatures.py",
    "daemon/cli/test_georef_cli.py",
    "daemon/processing/strips/test_strips_adjust.py",
    "replay",
)

# Folders whose slow tests only compute: they measure no time and talk to no other process.
COMPUTING = (
    "calib",
    "georef",
    *("library/test_calibrate.py", "library/test_notebook.py", "library/test_processing.py"),
    *(f"daemon/processing/{name}" for name in ("calibration", "error_model", "flightplan", "history", "points")),
    *(f"daemon/processing/{name}" for name in ("quicklook", "strips", "trajectory")),
)


def prepare_processes() -> None:
    """Make interpreters started by tests start as quickly as installed ones."""
    paths = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    if str(LEAN) not in paths:
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(LEAN), *paths]))
    loaded: dict[str, Any] = sys.modules
    loaded.setdefault("asammdf", None)  # the path of this running process cannot change
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # each processor has a worker, so threads would wait
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # else each reads all modules as text
    sys.dont_write_bytecode = False


def heed_interrupts() -> None:
    """Restore SIGINT, which a background job of a shell ignores and passes on to its children."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Skip files without the mark when only the few tests marked alone are wanted, to avoid importing all others."""
    if not config.option.markexpr.startswith("alone") or collection_path.suffix != ".py":
        return None
    return True if "pytest.mark.alone" not in collection_path.read_text() else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give one worker to tests that share something made once: a fixture of their file, or loops to be compiled.

    The longest come first; the option --no-loadscope-reorder of the Makefile keeps xdist from sorting them by their
    numbers of tests. `make test` compiles most loops beforehand, and all of calib. The rest is compiled
    once for georef and once for sim; tests of whole commands find these in the cache, or compile them at the same time.
    """
    for item in items:
        if item.get_closest_marker("slow") and _name(item).startswith(COMPUTING):
            item.add_marker(pytest.mark.computing)
        marker = item.get_closest_marker("xdist_group")
        if marker is None and _shares_a_fixture(item):
            item.add_marker(pytest.mark.xdist_group(_name(item)))
        elif marker is not None and marker.args == ("kernels",):
            package = item.path.relative_to(TESTS).parts[0]
            group = _name(item) if package in ("daemon", "calib") else f"kernels of {package}"
            item.add_marker(pytest.mark.xdist_group(group))
    items.sort(key=_rank)


def _rank(item: pytest.Item) -> int:
    names = {_name(item), *(marker.args[0] for marker in item.iter_markers("xdist_group"))}
    return next((rank for rank, name in enumerate(LONGEST) if name in names), len(LONGEST))


def _name(item: pytest.Item) -> str:
    return str(item.path.relative_to(TESTS))


def _shares_a_fixture(item: pytest.Item) -> bool:
    if not isinstance(item, pytest.Function):
        return False
    module, fixtures = item.nodeid.partition("::")[0], item._fixtureinfo.name2fixturedefs.values()
    return any(one.scope == "module" and one.baseid == module for found in fixtures for one in found)


prepare_processes()
heed_interrupts()
