"""Compares what two commits make of the same virtual flights, byte for byte.

    python -m tests.same_bytes BEFORE [AFTER] [--flights small calibration bench]

Each commit is checked out beside the other and run by this environment's Python. Compared by SHA-256: the log that
`swath sim fly` makes and the files beside it, what `swath replay` delivers to a recorder, LAZ, SBET, smrmsg, CSV, the
calibration file, and the sidecars without the version of the program. Pages are compared by the numbers in them. Exit
status 1 where anything differs.
"""

from __future__ import annotations

import argparse
import hashlib
import html
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from mcap.reader import make_reader

from tests.daemon.rig import free_udp_port

ROOT = Path(__file__).resolve().parents[1]
# the preset `bench` with a second antenna, which a straight flight needs for navigation, and a second head
TWO_HEADS = """
[gnss.rover]
secondary_lever_arm_m = [0.1, 1.15, -1.2]

[scanner.right]
kind = "oscillating"
motion = "triangle"
prf_hz = 400_000.0
scan_hz = 100.0
half_angle_deg = 30.0
return_slots = 2
pulses_per_datagram = 60
range_max_m = 1500.0
reference_range_m = 500.0
"""
WAIT_S = 60.0
SETTLE_S = 2.0


@dataclass(frozen=True)
class Flight:
    """A virtual flight, and what is done with it.

    Attributes:
        preset, more: the plan: a preset of the program and, if not empty, further tables below it.
        seconds: length; None: to its end.
        crs: coordinate reference system of the points.
        calibrates: True if the flight has the strips that a calibration needs.
    """

    preset: str
    seconds: float | None
    crs: str = "EPSG:32632"
    more: str = ""
    calibrates: bool = False


FLIGHTS = (
    Flight("small", None, calibrates=True),
    Flight("calibration", 60.0),
    Flight("bench", 16.0, "EPSG:32633", TWO_HEADS),
)


class Commit:
    """A checkout of a commit, and its program."""

    def __init__(self, name: str, folder: Path) -> None:
        self.name, self.tree = name, folder / "tree"
        subprocess.run(["git", "clone", "-q", str(ROOT), str(self.tree)], check=True)
        subprocess.run(["git", "checkout", "-q", name], cwd=self.tree, check=True)
        self.module = "swath.daemon.cli.main" if (self.tree / "swath").exists() else "daemon.cli.main"
        self.environment = os.environ | {"PYTHONPATH": str(self.tree), "OPENBLAS_NUM_THREADS": "1"}

    def start(self, *arguments: str) -> subprocess.Popen[bytes]:
        """Begin a command of the program."""
        command = [sys.executable, "-m", self.module, *arguments]
        return subprocess.Popen(command, cwd=self.tree.parent, env=self.environment, stderr=subprocess.PIPE)

    def run(self, *arguments: str) -> None:
        """Run a command to its end; a verdict (exit code 1) is no failure here, but it is written out."""
        process = self.start(*arguments)
        _, output = process.communicate()
        if process.returncode:
            sys.stderr.write(f"{self.name}: swath {' '.join(arguments)}: {output.decode()}")
        if process.returncode not in (0, 1):
            raise SystemExit(f"{self.name}: exit code {process.returncode}")


def numbers_of(text: str) -> bytes:
    """Return the numbers that a page shows, in order; pictures and styles left out."""
    shown = re.sub(r"(?s)<style.*?</style>|<script.*?</script>|data:[^\"')]+|<[^>]+>", " ", text)
    return " ".join(re.findall(r"[-−+]?\d[\d,.]*(?:e[-+]?\d+)?", html.unescape(shown))).encode()


def without_version(data: bytes) -> bytes:
    """Return a JSON file without what names the program's version, and without the time that a run took."""
    return re.sub(rb'"swath [^"]*"|"Swath": *"[^"]*"', b'""', data)


def content(path: Path) -> bytes:
    """Return what is compared of a file."""
    data = path.read_bytes()
    if path.suffix == ".html":
        return numbers_of(data.decode())
    if path.suffix == ".json":
        return without_version(data)
    if path.suffix == ".toml":
        return re.sub(rb"(?m)^(created|id) = .*$", b"", data)  # both contain the time of day
    if path.suffix == ".pdf":
        return b""  # the page beside it has the same numbers
    return data


def digests(folder: Path) -> dict[str, str]:
    """Return a digest of each file below a folder."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(content(path)).hexdigest() for path in files}


def wired(config: str, folder: Path) -> str:
    """Return a configuration with every port, bus and pulse of this computer's own."""
    text = re.sub(r'"serial:[^"?]*', lambda match: f'"serial:{folder}/rover', config)
    text = re.sub(r'"can:[^"]*"', f'"can:udp_multicast:239.74.163.2?port={free_udp_port()}"', text)
    text = re.sub(r'"udp:[^"]*"', lambda match: f'"udp:127.0.0.1:{free_udp_port()}?buffer_mb=8"', text)
    text = re.sub(r'^source = "[^"]*"', f'source = "fixed:{folder}/pps"', text, flags=re.M)
    return re.sub(r'^directory = "[^"]*"', f'directory = "{folder}/logs"', text, flags=re.M)


def delivered(commit: Commit, flight: Path, folder: Path) -> dict[str, str]:
    """Replay a log to a recorder, and return a digest of the units of each source."""
    folder.mkdir()
    config = folder / "swath.toml"
    config.write_text(wired((flight / "swath.toml").read_text(), folder))
    for path in flight.iterdir():
        if path.suffix in (".dbc", ".toml", ".json") and path.name != "swath.toml":
            (folder / path.name).write_bytes(path.read_bytes())
    (folder / "logs").mkdir()
    os.mkfifo(folder / "pps")
    recorder = commit.start("run", str(config))
    time.sleep(SETTLE_S)
    commit.run("replay", "--pace", "2", "--wire", str(config), "--wait", f"{WAIT_S:g}", str(flight))
    time.sleep(SETTLE_S)
    recorder.send_signal(signal.SIGTERM)
    _, output = recorder.communicate()
    if recorder.returncode != 0:
        raise SystemExit(f"{commit.name}: swath run: {output.decode()}")
    sums: dict[str, hashlib._Hash] = {}
    for path in sorted((folder / "logs").glob("*.mcap")):
        with path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
                if channel.topic.endswith("/raw"):
                    sums.setdefault(channel.topic, hashlib.sha256()).update(message.data)
    return {topic: one.hexdigest() for topic, one in sums.items()}


def plan_of(flight: Flight, folder: Path) -> str:
    """Return the plan as `swath sim fly` takes it; a plan with further tables is written into a folder."""
    if not flight.more:
        return flight.preset
    path = folder / "two-heads.toml"
    path.write_text((ROOT / f"sim/presets/{flight.preset}.toml").read_text() + flight.more)
    return str(path)


def made_by(commit: Commit, flight: Flight, folder: Path) -> dict[str, str]:
    """Return digests of all that a commit makes of a flight."""
    flown, products = folder / "flight", folder / "products"
    products.mkdir()
    length = [] if flight.seconds is None else ["--seconds", f"{flight.seconds:g}"]
    commit.run("sim", "fly", plan_of(flight, folder), *length, "-o", str(flown))
    found = {f"flight/{name}": digest for name, digest in digests(flown).items()}
    found |= {f"replay{topic}": digest for topic, digest in delivered(commit, flown, folder / "replay").items()}
    commit.run("georef", str(flown), "-o", str(products / "points"), "--crs", flight.crs, "--strips", "whole")
    commit.run("trajectory", str(flown), "-o", str(products / "trajectory"))
    commit.run("view", str(products / "points"), "-o", str(products / "view"))
    expected = ["*.laz", "*.sbet", "*.smrmsg", "*.csv", "*.html"]
    if flight.calibrates:
        commit.run("calibrate", str(flown), "-o", str(products / "calibrated.toml"))
        expected.append("*.toml")
    missing = [pattern for pattern in expected if not list(products.rglob(pattern))]
    if missing:
        raise SystemExit(f"{commit.name}: made no {', '.join(missing)} of {flight.preset}")
    return found | digests(products)


def main() -> int:
    """Compare two commits."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before")
    parser.add_argument("after", nargs="?", default="HEAD")
    parser.add_argument("--flights", nargs="*", default=[flight.preset for flight in FLIGHTS])
    options = parser.parse_args()
    different = 0
    with tempfile.TemporaryDirectory() as name:
        commits: list[Commit] = []
        for one in (options.before, options.after):
            (Path(name) / str(len(commits))).mkdir()
            commits.append(Commit(one, Path(name) / str(len(commits))))
        for flight in FLIGHTS:
            if flight.preset not in options.flights:
                continue
            # both are in folders of the same name, which products may contain
            found = []
            place = Path(name) / flight.preset
            for commit in commits:
                place.mkdir()
                found.append(made_by(commit, flight, place))
                place.rename(commit.tree.parent / flight.preset)
            for key in sorted({*found[0], *found[1]}):
                one, other = (each.get(key) for each in found)
                different += one != other
                sys.stdout.write(f"{'same' if one == other else 'DIFFERENT':9}  {flight.preset}  {key}\n")
                sys.stdout.flush()
    sys.stdout.write(json.dumps({"different": different}) + "\n")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
