"""Tests the demonstration, shortened: what `make demo` runs must pass, and its proof must be able to fail."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import laspy
import pytest
from rich.console import Console

from demo.proof import Hashed, prove
from swath.daemon.replay.wire_player import Output, PlayReport
from tests.daemon.log_check import LogContent, read_log
from tests.daemon.rig import HANGS_S

ROOT = Path(__file__).resolve().parent.parent
pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("demo")]  # it is played once, by one worker
SOURCES = {
    "recordings": ("gnss/rover", "imu/main", "scanner/top", "scanner/top/aux"),
    "flight": ("gnss/rover", "imu/main", "scanner/left"),
}
EVERY = [(part, source) for part, sources in SOURCES.items() for source in (*sources, "pps/main")]


class Nowhere(Output):
    """Output that accepts everything and keeps nothing."""

    def send(self, data: bytes, due_realtime_ns: int) -> bool:
        return True

    def close(self) -> None:
        return None


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    folder = tmp_path_factory.mktemp("demo")
    command = [sys.executable, "-m", "demo", "--seconds", "20", "--flight-seconds", "24", "--keep", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=HANGS_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout, folder


def sent_as_logged(content: LogContent, report: PlayReport, sources: tuple[str, ...]) -> dict[str, Hashed]:
    """Return outputs that have sent exactly what is in a log."""
    outputs: dict[str, Hashed] = {source: Hashed(Nowhere()) for source in sources}
    for source, output in outputs.items():
        for _, data in content.units[source]:
            output.send(data, 0)
    report.units["pps/main"] = len(content.messages["/pps/main"])
    return outputs | {"pps/main": Hashed(Nowhere())}


def test_the_demonstration_passes_and_shows_its_results(played: tuple[str, Path]) -> None:
    text, folder = played
    assert "demonstration passed" in text
    assert text.count("every unit is accounted for") == 2
    assert text.count(" same ") == 5 + 4
    assert "http://127.0.0.1:" in text
    assert json.loads((folder / "flight/logs/live/lines.json").read_text())["plan"] == "plan.toml"
    assert text.count("LOCKED") == 4  # receiver and pulse in both parts
    for part, sources in SOURCES.items():
        content = read_log(folder / part / "logs")
        assert all(content.units[source] for source in sources)
        assert [event["severity"] for _, event in content.messages["/events"] if event["severity"] != "info"] == []


def test_its_last_line_names_the_page_of_the_points(played: tuple[str, Path]) -> None:
    text, folder = played
    page = Path(text.splitlines()[-1])
    assert page == folder / "flight/view/index.html"
    points = sum(len(laspy.read(path)) for path in (folder / "flight/points").glob("*.laz"))
    assert points > 100_000
    assert f"{points:,}".replace(",", "\u202f") in page.read_text()


@pytest.mark.parametrize(("part", "source"), EVERY)
def test_the_comparison_of_the_demonstration_fails_on_any_difference(
    played: tuple[str, Path], part: str, source: str
) -> None:
    logs = played[1] / part / "logs"
    content, report = read_log(logs), PlayReport()
    quiet = Console(quiet=True)
    outputs = sent_as_logged(content, report, SOURCES[part])
    assert prove(quiet, logs, outputs, report)
    if source == "pps/main":
        report.units[source] += 1
    else:
        outputs[source].send(b"\0", 0)
    assert not prove(quiet, logs, outputs, report)
