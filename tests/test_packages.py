"""Tests Swath beside other packages and scripts with common names, and beside an earlier installation."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.place import Place

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
