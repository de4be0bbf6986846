"""Builds the package of docs/adding-a-device.md, installs it beside Swath, flies with its devices, and removes it.

The devices speak by the package's own encoders: the receiver through a pty, the scanner by UDP, the pulse by a FIFO.
They move north at 60 m/s, 500 m above ground at a height of 1000 m.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from swath.georef.formats.sbet import sbet_bytes
from swath.georef.trajectory.trajectory import Trajectory
from tests.builders import ROOT
from tests.daemon.rig import HANGS_S, free_udp_port, session_table, wait_until
from tests.daemon.wires import pty, repeating, udp_sender
from tests.drivers.site import EXAMPLE
from tests.place import Place

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("install")]

SECOND_NS, WEEK_MS = 1_000_000_000, 604_800_000
GPS_MINUS_UNIX_S = 18 - 315_964_800  # by the leap seconds of 2026
LAT_DEG, LON_DEG, HEIGHT_M, GROUND_M = 47.0, 9.0, 1500.0, 1000.0
SPEED_MPS, MERIDIAN_RADIUS_M = 60.0, 6_369_700.0  # the latter at 47°, WGS 84, with the height
RECORDED_S = 12.0
MISSING = "is that of the package swath-example 1.0, which is not installed here; install it beside swath"
READ = """
import swath
log = swath.open("logs")
tables = list(log["scanner/left"].returns())
print(len(log["gnss/rover"].fixes()), sum(map(len, tables)), max(table["time_sigma_s"].max() for table in tables))
"""
READ_OTHERS = """
import swath
log = swath.open("logs")
assert any(True for _ in log["scanner/left"].units())
try:
    list(log["scanner/left"].returns())
except swath.SwathError as error:
    print(len(log["gnss/rover"].fixes()), error)
"""


def gps_ns() -> int:
    return time.time_ns() + GPS_MINUS_UNIX_S * SECOND_NS


def lat_deg(at_ns: int | np.ndarray, since_ns: int) -> Any:
    return LAT_DEG + np.degrees(SPEED_MPS * (at_ns - since_ns) / SECOND_NS / MERIDIAN_RADIUS_M)


def example(name: str) -> Any:
    """Return a module of the example, for its encoder, without a place on the path."""
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLE / f"swath_example/{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Devices:
    """The receiver, the scanner and the pulse: what each sends now."""

    def __init__(self) -> None:
        self.since_ns = gps_ns()
        self._power_on_ns = self.since_ns - 7_000_000_003  # zero of the scanner's counter
        self._receiver, self._scanner = example("receiver"), example("scanner")
        self._told_ms = self._edge_s = self._edges = 0

    def fix(self, _: int) -> bytes:
        """Return the frame of each fifth of a second, 130 ms after it."""
        ms = gps_ns() // 1_000_000
        epoch_ms = ms // 200 * 200
        if epoch_ms == self._told_ms or ms - epoch_ms < 130:
            return b""
        self._told_ms = epoch_ms
        lat = float(lat_deg(epoch_ms * 1_000_000, self.since_ns))
        data: bytes = self._receiver.encode(epoch_ms // WEEK_MS, epoch_ms % WEEK_MS, lat, LON_DEG, HEIGHT_M)
        return data

    def returns(self, number: int) -> bytes:
        """Return a datagram of 80 pulses across the flight; its last was fired a moment ago."""
        now_ns = gps_ns()
        angle_deg = np.arange(-20.0, 20.0, 0.5)
        rows = np.zeros(80, self._scanner.RETURN)
        rows["after_ns"], rows["pulse"] = np.arange(80) * 10_000, np.arange(80)
        rows["azimuth"], rows["intensity"] = np.rint(angle_deg * 100), 100
        rows["range"] = np.rint((HEIGHT_M - GROUND_M) / np.cos(np.radians(angle_deg)) / 0.004)
        edge_ns = now_ns // SECOND_NS * SECOND_NS
        counted = (edge_ns - self.since_ns) // SECOND_NS + 7
        first_ns = now_ns - 1_000_000 - self._power_on_ns
        data: bytes = self._scanner.encode(number, first_ns, edge_ns - self._power_on_ns, counted, rows)
        return data

    def pulse_to(self, fifo: int) -> Callable[[int], None]:
        """Return a job that writes each edge into a FIFO, with the time that a kernel would have stamped."""

        def write(_: int) -> None:
            second = gps_ns() // SECOND_NS
            if second != self._edge_s:
                self._edge_s, self._edges = second, self._edges + 1
                os.write(fifo, f"{(second - GPS_MINUS_UNIX_S) * SECOND_NS} {self._edges}\n".encode())

        return write

    @contextmanager
    def on_wires(self, folder: Path) -> Iterator[Path]:
        """Send on all wires; yield the configuration."""
        os.mkfifo(folder / "pps")
        fifo, port = os.open(folder / "pps", os.O_RDWR), free_udp_port()
        try:
            with pty(self.fix) as path, udp_sender(port, self.returns), repeating(self.pulse_to(fifo), 0.002):
                yield written_config(folder, path, port)
        finally:
            os.close(fifo)

    def trajectory(self) -> bytes:
        """Return an SBET of the flight so far."""
        at_ns = np.arange(self.since_ns - SECOND_NS, gps_ns() + SECOND_NS, 5_000_000)
        still = np.zeros(len(at_ns))
        velocity_l = np.tile([SPEED_MPS, 0.0, 0.0], (len(at_ns), 1))
        height, lon = np.full(len(at_ns), HEIGHT_M), np.full(len(at_ns), math.radians(LON_DEG))
        lat = np.radians(lat_deg(at_ns, self.since_ns))
        return sbet_bytes(Trajectory.from_geodetic(at_ns, lat, lon, height, velocity_l, still, still, still))


def written_config(folder: Path, port_of_receiver: str, udp_port: int) -> Path:
    path = folder / "swath.toml"
    path.write_text(
        session_table(folder / "logs")
        + f'[pps.main]\nsource = "fixed:{folder}/pps"\n'
        + f'[gnss.rover]\ntransport = "serial:{port_of_receiver}"\nprotocol = "example-receiver"\npps = "main"\n'
        + 'options = { heights = "ellipsoid" }\n'
        + f'[scanner.left]\ntransport = "udp:127.0.0.1:{udp_port}"\nprotocol = "example-scanner"\npps = "main"\n'
        + "installation = [[0, 0, 1], [0, -1, 0], [1, 0, 0]]\n"  # its x down, y left, z forward
        + "options = { range_unit_mm = 4 }\n"
    )
    return path


@dataclass
class Office:
    """An environment with the package, and commands of this checkout in it: its loops are compiled already."""

    place: Place
    folder: Path

    @property
    def environment(self) -> dict[str, str]:
        return os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "200", "NO_COLOR": "1"}

    def python(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run its Python in the folder of the flight."""
        command = [str(self.place.bin / "python"), *arguments]
        return subprocess.run(
            command,
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=HANGS_S,
            check=False,
        )

    def swath(self, *arguments: str, status: int = 0) -> str:
        """Return what a command prints, which ends with this exit code."""
        done = self.python("-m", "swath.daemon.cli.main", *arguments)
        assert done.returncode == status, done.stdout + done.stderr
        return done.stdout + done.stderr

    def record(self) -> None:
        """Run the recorder for a while, and stop it as its service does."""
        command = [str(self.place.bin / "python"), "-m", "swath.daemon.cli.main", "run", "swath.toml"]
        recorder = subprocess.Popen(command, cwd=self.folder, env=self.environment, stderr=subprocess.DEVNULL)
        try:
            wait_until(lambda: list(self.folder.glob("logs/*.mcap")), "a log")
            threading.Event().wait(RECORDED_S)
        finally:
            recorder.send_signal(signal.SIGTERM)
        assert recorder.wait(HANGS_S) == 0


@pytest.fixture(scope="module")
def office(tmp_path_factory: pytest.TempPathFactory) -> Office:
    folder = tmp_path_factory.mktemp("office")
    place = Place(folder)
    place.install_swath()
    wheels = folder / "wheels"
    source = shutil.copytree(
        EXAMPLE, folder / "source", ignore=shutil.ignore_patterns("__pycache__")
    )  # pip writes there
    place.pip("wheel", "-q", "--no-deps", "-w", str(wheels), str(source))
    [wheel] = wheels.iterdir()
    place.pip("install", "-q", "--no-deps", "--no-index", str(wheel))
    flight = folder / "flight"
    flight.mkdir()
    return Office(place, flight)


def test_the_installed_package_is_typed_and_its_own_tests_pass(office: Office, tmp_path: Path) -> None:
    listed = json.loads(office.place.run("swath", "devices", "--json"))
    assert listed["not_loaded"] == []
    packages = {row["protocol"]: row["package"] for row in listed["devices"] if row["package"]}
    assert packages == dict.fromkeys(("example-receiver", "example-scanner"), "swath-example 1.0")
    plain = ("-q", "-W", "error", "-p", "no:cacheprovider", "-c", os.devnull, str(EXAMPLE / "tests"))
    assert " passed" in office.place.run("python", "-m", "pytest", *plain, folder=tmp_path)
    command = [sys.executable, "-m", "mypy", "--strict", "--python-executable", str(office.place.bin / "python")]
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "MYPYPATH")}
    done = subprocess.run(
        [*command, "--cache-dir", str(tmp_path / "cache"), "-p", "swath_example"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=HANGS_S,
        check=False,
    )
    assert done.stdout == "Success: no issues found in 3 source files\n", done.stdout + done.stderr


def test_its_devices_are_checked_recorded_and_georeferenced_until_it_is_removed(office: Office) -> None:
    devices = Devices()
    with devices.on_wires(office.folder) as config:
        checked = json.loads(office.swath("check", "--seconds", "3", "--json", str(config)))
        assert checked["ok"], checked
        office.record()
    (office.folder / "flight.sbet").write_bytes(devices.trajectory())

    wrong = config.read_text().replace("range_unit_mm = 4", "range_unit_mm = 3")
    (office.folder / "wrong.toml").write_text(wrong)
    told = office.swath("check", "--offline", "wrong.toml", status=2)
    assert told == "swath: wrong.toml: scanner.left.options.range_unit_mm: got 3, want 1, 2 or 4\n"

    told = office.swath("info", "logs")
    assert "ScannerReturns" in told
    assert "LOCKED" in told
    assert "every unit is accounted for" in told
    fixes, returns, sigma_s = office.python("-c", READ).stdout.split()
    assert int(fixes) > 4 * RECORDED_S
    assert float(sigma_s) < 1e-6

    options = ("--trajectory", "flight.sbet", "--crs", "EPSG:32632", "--workers", "2", "--accept-verdict")
    office.swath("georef", "logs", "-o", "points", *options)
    [sidecar] = office.folder.glob("points/*.json")
    made = json.loads(sidecar.read_text())
    assert made["flights"][0]["drivers"] == {
        "gnss/example-receiver": "swath-example 1.0",
        "scanner/example-scanner": "swath-example 1.0",
    }
    [strip] = office.folder.glob("points/*.laz")
    points = laspy.read(strip)
    assert len(points) == int(returns)
    # 2.6 mm by the earth's curvature, 2 mm by the unit of ranges
    assert np.abs(np.asarray(points.z) - GROUND_M).max() < 0.008
    across_m = np.ptp(np.asarray(points.x))
    assert across_m == pytest.approx(500.0 * (np.tan(np.radians(20.0)) + np.tan(np.radians(19.5))), rel=1e-3)

    (office.place.packages / "swath_example/scanner.py").write_text("import nowhere\n")
    why = "scanner protocol 'example-scanner': package swath-example 1.0 is not loaded: ModuleNotFoundError"
    assert f"scanner.left.protocol: {why}" in office.swath("check", "--offline", str(config), status=1)
    told = office.swath("export", "logs", "tables", "--records", "csv")
    assert "gnss-rover_fixes.csv" in told
    assert f"note: scanner/left: {why}" in told
    told = office.python("-c", READ_OTHERS).stdout
    assert told.startswith(f"{fixes} scanner.left.protocol: {why}")

    office.place.pip("uninstall", "-q", "-y", "swath-example")
    told = office.swath("info", "logs")
    assert f"gnss/rover: gnss protocol 'example-receiver' {MISSING}" in told
    assert "every unit is accounted for" in told
    office.swath("export", "logs", "exported")
    assert list(office.folder.glob("exported/*/scanner-left.pcap"))
    [log] = office.folder.glob("logs/*.mcap")
    told = office.swath("georef", "logs", "-o", "more", *options, status=2)
    where = f"{log.relative_to(office.folder)}: gnss.rover.protocol"
    assert told == f"swath: {where}: gnss protocol 'example-receiver' {MISSING}\n"
    told = office.swath("check", "--offline", str(config), status=2)
    assert "unknown scanner protocol 'example-scanner'; there are: hesai-at128" in told
    assert "others need their package installed beside swath" in told
