"""Tests Swath beside other packages and scripts with common names, and beside an earlier installation."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from tests.daemon.rig import HANGS_S

ROOT = Path(__file__).resolve().parent.parent
SOURCES = ("pyproject.toml", "README.md", "LICENSE", "swath", "calib", "daemon", "drivers", "georef", "sim")
COMPILE = """
import numpy as np
import swath
from swath.georef.air.kernels import CELLS, means
heights, out = np.array([100.0]), np.zeros(1)
means(np.zeros((CELLS, 5)), heights, heights + 100.0, out)
print(swath.__file__)
"""
RENDER = """
from swath.daemon.processing.pages.blocks import Words
from swath.daemon.processing.pages.head import PageHead
from swath.daemon.processing.pages.render import Page, html_of
page = html_of(Page("Quick look", "Points", PageHead(), [Words("a line of words")]))
print(page.count("a line of words"), page.count("@page"))
"""
OTHER_DAEMON = """
import sys
import daemon
with daemon.DaemonContext(detach_process=False, stdout=sys.stdout, stderr=sys.stderr):
    print("it works")
"""

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("install")]


class Place:
    """A virtual environment that has what Swath needs, but not Swath, and the sources of Swath beside it."""

    def __init__(self, folder: Path) -> None:
        self.sources = folder / "sources"
        self.sources.mkdir()
        for name in SOURCES:
            if (ROOT / name).is_dir():
                shutil.copytree(
                    ROOT / name, self.sources / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__")
                )
            else:
                shutil.copy(ROOT / name, self.sources)
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder / "venv"], check=True)
        self.bin = folder / "venv/bin"
        (self.packages,) = (folder / "venv/lib").glob("python3*/site-packages")
        # a .pth file's path adds its packages, but not the paths of their .pth files: Swath as a developer has it
        (self.packages / "needed.pth").write_text(sysconfig.get_path("purelib"))

    def pip(self, *arguments: str) -> None:
        """Run pip for this environment."""
        command = [sys.executable, "-m", "pip", "--python", str(self.bin / "python"), *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=HANGS_S, check=False)
        assert done.returncode == 0, done.stderr

    def install_swath(self, *options: str) -> None:
        """Install the sources."""
        self.pip("install", "-q", "--no-deps", "--force-reinstall", *options, str(self.sources))

    def install_python_daemon(self) -> None:
        """Install another project's package that is called `daemon`."""
        self.pip("install", "-q", "--force-reinstall", "python-daemon>=3")

    def run(self, program: str, *arguments: str, folder: Path | None = None) -> str:
        """Return what a program of this environment says, run in a folder."""
        own = ("PYTHONPATH", "NUMBA_CACHE_DIR")
        environment = {key: value for key, value in os.environ.items() if key not in own}
        done = subprocess.run(
            [self.bin / program, *arguments],
            cwd=folder or self.bin,
            env=environment,
            capture_output=True,
            text=True,
            timeout=HANGS_S,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout


@pytest.mark.parametrize("first", ["swath", "python-daemon"])
def test_python_daemon_and_swath_can_be_used_together(tmp_path: Path, first: str) -> None:
    place = Place(tmp_path)
    installs = [place.install_swath, place.install_python_daemon]
    for install in installs if first == "swath" else reversed(installs):
        install()
    assert place.run("python", "-c", OTHER_DAEMON) == "it works\n"
    assert len(json.loads(place.run("swath", "devices", "--json"))["devices"]) > 10


def test_scripts_named_like_the_packages_do_not_shadow_them(tmp_path: Path) -> None:
    place = Place(tmp_path)
    place.install_swath()
    folder = tmp_path / "working"
    folder.mkdir()
    for name in ("sim", "calib", "daemon", "drivers", "georef"):
        (folder / f"{name}.py").write_text("raise RuntimeError('somebody imported the script')\n")
    place.run("swath", "sim", "plan", "small", "-o", "small.png", folder=folder)
    assert (folder / "small.png").stat().st_size > 10_000
    place.run("python", "-m", "swath.daemon.cli.main", "devices", folder=folder)
    place.run("python", "-c", "import swath.calib.adjust, swath.georef.georeference", folder=folder)


def test_an_editable_installation_works_over_the_remains_of_an_ordinary_one(tmp_path: Path) -> None:
    """pip leaves the caches of compiled loops, and with them the folders that they are in.

    Pages find their templates in either installation.
    """
    place = Place(tmp_path)
    place.install_swath()
    assert place.run("python", "-c", RENDER) == "1 1\n"
    assert place.run("python", "-c", COMPILE) == f"{place.packages / 'swath/__init__.py'}\n"
    caches = place.packages / "swath/georef/air/__pycache__"
    assert list(caches.glob("*.nbi"))
    place.install_swath("--editable")
    assert list(caches.glob("*.nbi")), "the caches are gone: nothing is shown"
    assert place.run("python", "-c", COMPILE) == f"{place.sources / 'swath/__init__.py'}\n"
    assert place.run("python", "-c", RENDER) == "1 1\n"
    assert len(json.loads(place.run("swath", "devices", "--json"))["devices"]) > 10
