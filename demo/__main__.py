"""``make demo``: real recordings and a virtual flight on real wires into a real recorder, then points and a page.

python -m demo [--seconds 30] [--flight-seconds 60] [--keep DIR]
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

from rich.console import Console

from demo import flight, points, recordings
from demo.onlooking import shown
from demo.proof import perform


def demonstrate(console: Console, folder: Path, seconds: float, flight_seconds: float) -> Path | None:
    """Play the recordings and the flight, each in a folder of its own, and make points of the flight.

    The flight is made, and loops are compiled, while the recordings play. The console shows the flight.
    Returns the page of the points; None if anything is not as it should be.
    """
    ahead, compiling = flight.take_off(flight_seconds), points.compile_beside()
    try:
        recorded = perform(console, folder / "recordings", recordings.prepare(folder / "recordings", seconds))
        show = flight.prepare(console, folder / "flight", ahead)
        with shown(console, folder / "flight", compiling):
            flown = perform(console, folder / "flight", show)
        page = points.make_points(console, folder / "flight", compiling)
    finally:
        ahead.close()
        compiling.kill()
        compiling.wait()
    return page if recorded and flown else None


def main() -> int:
    """Run the demonstration; return 0 if everything is as it should be."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="duration of the recordings")
    parser.add_argument("--flight-seconds", type=float, default=60.0, help="duration of the flight")
    parser.add_argument(
        "--keep", type=Path, help="keep logs, points and page in this folder; default: only the page is kept"
    )
    arguments = parser.parse_args()
    console = Console(width=None if sys.stdout.isatty() else 110)
    folder = Path(tempfile.mkdtemp(prefix="swath-demo-")) if arguments.keep is None else arguments.keep.resolve()
    page = None
    try:
        page = demonstrate(console, folder, arguments.seconds, arguments.flight_seconds)
        if page is not None and arguments.keep is None:
            page = page.rename(folder / page.name)
    finally:
        if arguments.keep is None:
            shutil.rmtree(folder / "recordings", ignore_errors=True)
            shutil.rmtree(folder / "flight", ignore_errors=True)
    if page is None:
        console.print("[bold red]demonstration FAILED[/]")
        return 1
    if arguments.keep is not None:
        console.print(f"the logs are in {folder}/recordings/logs and {folder}/flight/logs", soft_wrap=True)
    console.print("[bold green]demonstration passed[/]; open the page of its points in a browser:")
    console.print(str(page), soft_wrap=True, highlight=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
