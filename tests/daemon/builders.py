"""Builders and readers that several tests of the daemon use: commands, logs, devices' wires, files of points."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import reduce
from operator import xor

from tests.builders import ROOT
from tests.daemon.rig import HANGS_S

CAPTURE = ROOT / "fixtures/novatel/propak6-basic-fix.gps.gz"


def swath(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command line as a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "swath.daemon.cli.main", *arguments],
        cwd=ROOT,
        env=os.environ | {"COLUMNS": "100", "NO_COLOR": "1"} | environment,
        capture_output=True,
        text=True,
        timeout=HANGS_S,
        check=False,
    )


def run_python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process with an additional statement."""
    head = "import sys; import swath.daemon.cli.main as cli\n"
    return subprocess.run(
        [sys.executable, "-c", head + code],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=HANGS_S,
        check=False,
    )


def nmea_sentence(body: str) -> bytes:
    """Return a sentence with its checksum (NMEA 0183: exclusive or of the bytes between $ and *)."""
    return f"${body}*{reduce(xor, body.encode()):02X}\r\n".encode()
