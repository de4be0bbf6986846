"""Tests that gpsd, fed by ``swath replay`` through a pseudo-terminal, agrees on every epoch.

gpsd decodes with its own code. Its reports to clients (TPV) are compared with our decoders, to the last digit of the
receiver's message or of gpsd's JSON, whichever is coarser.
"""

from __future__ import annotations

import datetime as dt
import gzip
import json
import math
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from swath.daemon.log.format import source_of_topic
from swath.daemon.log.parsers import stored_parsers
from swath.daemon.log.reader import open_logs
from swath.georef.records import ChunkBatch, FixType, GnssFix, TimeScale

pytestmark = pytest.mark.peers

ROOT = Path(__file__).parents[2]
BAUD = 38_400
GPS_EPOCH = dt.datetime(1980, 1, 6, tzinfo=dt.UTC)
LEAP_S = 18
STATUS = {FixType.SINGLE: 1, FixType.DIFFERENTIAL: 2, FixType.RTK_FIXED: 3, FixType.RTK_FLOAT: 4}  # of gpsd's TPV
CONFIG = """[session]
name = "peer"
directory = "{folder}/logs"
[gnss.rover]
transport = "serial:{folder}/rover?baud={baud}"
protocol = "{protocol}"
leap_seconds = 18
"""


@dataclass(frozen=True)
class Case:
    """A recording, and the resolution of its messages in degrees and metres.

    In NMEA it follows from the number of decimals of a minute.
    """

    protocol: str
    name: str
    start: str
    degrees: float
    metres: float


CASES = [
    Case("nmea", "ublox-zed-f9p-nmea", "2019-04-12T00:39:56Z", 1e-9, 1e-4),
    Case("nmea", "nmea-rtk", "2020-03-18T13:28:19Z", 1e-9, 1e-4),
    Case("ubx", "ublox-zed-f9p-hp", "2019-04-23T21:19:48Z", 1e-7, 1e-3),
]


def swath(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "swath.daemon.cli.main", *map(str, arguments)]


def recorded(folder: Path, case: Case) -> Path:
    """Import the recording as a log, at the pace of its line, and return the configuration."""
    raw = folder / "rover.bytes"
    raw.write_bytes(gzip.decompress((ROOT / "fixtures" / case.protocol / f"{case.name}.log.gz").read_bytes()))
    config = folder / "swath.toml"
    config.write_text(CONFIG.format(folder=folder, baud=BAUD, protocol=case.protocol))
    command = swath("import", config, "--source", f"gnss/rover={raw}", "--start", case.start, "-o", folder / "log")
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, cwd=ROOT)
    assert done.returncode in (0, 4), done.stderr
    return config


def utc(fix: GnssFix) -> dt.datetime:
    """Return the time of a fix."""
    if fix.time.scale is TimeScale.UTC:
        assert fix.time.date is not None
        start = dt.datetime.combine(fix.time.date, dt.time(), dt.UTC)
        return start + dt.timedelta(microseconds=fix.time.time_ns / 1000)
    assert fix.time.week is not None
    return GPS_EPOCH + dt.timedelta(weeks=fix.time.week, microseconds=fix.time.time_ns / 1000, seconds=-LEAP_S)


def our_fixes(folder: Path) -> list[GnssFix]:
    """Return the valid fixes of the log, read by our decoder."""
    (session,) = open_logs([folder / "log"])
    parsers, troubles = stored_parsers(session.attachments())
    assert not troubles
    fixes = []
    for batch in session.batches():
        if source_of_topic(batch.channel.topic) == "gnss/rover":
            records = parsers["gnss/rover"].feed_batch(ChunkBatch("gnss/rover", batch.log_time_ns, batch.units))
            fixes += [record for record in records if isinstance(record, GnssFix)]
    timed = [fix for fix in fixes if fix.time.date is not None or fix.time.week is not None]
    return [fix for fix in timed if fix.valid and fix.fix_type is not FixType.NONE and fix.lat_rad is not None]


@contextmanager
def gpsd(device: Path) -> Iterator[socket.socket]:
    """Start a gpsd that only listens to a device, and a client of it."""
    program = shutil.which("gpsd", path="/usr/sbin:/usr/local/sbin:/usr/bin:/usr/local/bin")
    assert program, "there is no gpsd: apt-get install gpsd"
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    process = subprocess.Popen([program, "-N", "-n", "-b", "-s", str(BAUD), "-S", str(port), str(device)])
    try:
        deadline = time.monotonic() + 20
        while True:
            assert process.poll() is None, f"gpsd ended with {process.returncode}"
            try:
                client = socket.create_connection(("127.0.0.1", port), timeout=30)
                break
            except OSError:
                assert time.monotonic() < deadline, "gpsd does not listen"
                time.sleep(0.05)
        with client:
            client.sendall(b'?WATCH={"enable":true,"json":true};\n')
            yield client
    finally:
        process.terminate()
        process.wait(20)


def played_to_gpsd(folder: Path, config: Path) -> list[dict[str, Any]]:
    """Play a log to gpsd, and return every TPV with a time and a position."""
    command = swath("replay", "--wire", config, "--wait", "30", folder / "log")
    player = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 30
        while not (folder / "rover").exists():
            assert player.poll() is None, player.communicate()[1]
            assert time.monotonic() < deadline, "no port to open"
            time.sleep(0.02)
        text = b""
        with gpsd(folder / "rover") as client:
            client.settimeout(0.5)
            ended_at = math.inf
            while time.monotonic() < ended_at + 2:
                if ended_at == math.inf and player.poll() is not None:
                    ended_at = time.monotonic()
                try:
                    text += client.recv(65536)
                except TimeoutError:
                    continue
        assert player.returncode == 0, player.communicate()[1]
    finally:
        player.kill()
        player.communicate()
    told = [json.loads(line) for line in text.splitlines() if line.startswith(b'{"class":"TPV"')]
    return [tpv for tpv in told if tpv["mode"] >= 2 and "time" in tpv and "lat" in tpv]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_fixes_match_gpsd(tmp_path: Path, case: Case) -> None:
    config = recorded(tmp_path, case)
    told = played_to_gpsd(tmp_path, config)
    ours = {round(utc(fix).timestamp() * 1000): fix for fix in our_fixes(tmp_path)}
    epochs = set()
    for tpv in told:
        at_ms = round(dt.datetime.fromisoformat(tpv["time"]).timestamp() * 1000)
        near = [ours[ms] for ms in (at_ms, at_ms - 1, at_ms + 1) if ms in ours]
        assert near, f"gpsd has an epoch at {tpv['time']}, we have none"
        fix = near[0]
        epochs.add(utc(fix))
        assert fix.lat_rad is not None
        assert fix.lon_rad is not None
        assert math.degrees(fix.lat_rad) == pytest.approx(tpv["lat"], rel=0, abs=case.degrees)
        assert math.degrees(fix.lon_rad) == pytest.approx(tpv["lon"], rel=0, abs=case.degrees)
        if "altHAE" in tpv:
            assert tpv["mode"] == 3
            assert fix.height_m == pytest.approx(tpv["altHAE"], rel=0, abs=case.metres)
        assert tpv.get("status", 1) == STATUS[fix.fix_type], tpv["time"]
    assert any("altHAE" in tpv for tpv in told)
    # a late client misses the first epochs; gpsd reports an epoch when the next one begins
    expected = {utc(fix) for fix in ours.values() if utc(fix) >= min(epochs)}
    assert expected - epochs <= {max(expected)}
    assert len(epochs) > len(ours) / 2
