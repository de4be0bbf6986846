"""``make demo``: real recordings, then a virtual flight, on real wires into a real recorder; proof of every byte.

python -m demo [--seconds 30] [--flight-seconds 60] [--keep DIR]
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

from rich.console import Console

from demo import flight, recordings
from demo.proof import perform


def demonstrate(console: Console, folder: Path, seconds: float, flight_seconds: float) -> bool:
    """Both parts, each in a folder of its own; the second is got ready during the first."""
    ahead = flight.take_off(flight_seconds)
    try:
        recorded = perform(console, folder / "recordings", recordings.prepare(folder / "recordings", seconds))
        flown = perform(console, folder / "flight", flight.prepare(console, folder / "flight", ahead))
    finally:
        ahead.close()
    return recorded and flown


def main() -> int:
    """The demonstration; 0 when everything is as it should be."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=30.0, help="duration of the recordings")
    parser.add_argument("--flight-seconds", type=float, default=60.0, help="duration of the flight")
    parser.add_argument("--keep", type=Path, help="keep the logs in this folder; default: remove them at the end")
    arguments = parser.parse_args()
    console = Console(width=None if sys.stdout.isatty() else 110)
    folder = Path(tempfile.mkdtemp(prefix="swath-demo-")) if arguments.keep is None else arguments.keep.resolve()
    try:
        good = demonstrate(console, folder, arguments.seconds, arguments.flight_seconds)
    finally:
        if arguments.keep is None:
            shutil.rmtree(folder)
    if arguments.keep is not None:
        console.print(f"the logs are in {folder}/recordings/logs and {folder}/flight/logs")
    console.print("[bold green]demonstration passed[/]" if good else "[bold red]demonstration FAILED[/]")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
