"""The third part: the flight that has just been recorded becomes points and a page to look at."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from rich.console import Console

CRS = "EPSG:32632"
PARTIAL = 1  # exit code of products that were written, but not of all returns
REMARK = (
    "The sensors were not switched on and off at one moment: returns before the first and after the last inertial "
    "sample have no trajectory. `swath georef` counts them and calls the points partial."
)
SWATH = (sys.executable, "-m", "swath.daemon.cli.main")


def compile_beside() -> subprocess.Popen[bytes]:
    """Begin to compile the loops of georeferencing, with the time that recording leaves."""
    command = ["nice", "-n", "19", *SWATH, "warm-up"]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def make_points(console: Console, folder: Path, compiling: subprocess.Popen[bytes]) -> Path | None:
    """Georeference the log of a flight with its calibration and draw the quick look; return its page, None on failure.

    The calibration is the true one that the virtual aircraft flew with, as if it had been calibrated before.
    """
    with console.status("compiling the loops of georeferencing, once on a new installation"):
        compiling.wait()
    points, view = folder / "points", folder / "view"
    calibration = f"left={folder / 'left.true.toml'}"
    georef = _run(console, "georef", folder / "logs", "-o", points, "--crs", CRS, "--calibration", calibration)
    if georef == PARTIAL:
        console.print(REMARK)
    if georef not in (0, PARTIAL) or _run(console, "view", points, "-o", view) != 0:
        return None
    return view / "index.html"


def _run(console: Console, *arguments: str | Path) -> int:
    """Show a command of the program, run it, and return its exit code."""
    words = [str(word) for word in arguments]
    console.print(f"[bold]$ swath {' '.join(words)}[/]", soft_wrap=True, highlight=False)
    return subprocess.run([*SWATH, *words], check=False).returncode
