"""Tests that the official TypeScript reader reads written and repaired logs."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from swath.daemon.log.recover import recover
from tests.daemon.builders import write_part

SCRIPT = Path(__file__).with_name("read_with_official_typescript.mjs")
PACKAGES = ("@mcap/core", "@mcap/support", "@mcap/nodejs")


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the script beside its packages."""
    if shutil.which("npm") is None:
        pytest.fail("npm is not installed: apt-get install nodejs npm")
    folder = tmp_path_factory.mktemp("npm")
    (folder / "package.json").write_text('{"private": true}')
    installed = subprocess.run(
        ["npm", "install", "--silent", "--no-audit", "--no-fund", *PACKAGES],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert installed.returncode == 0, installed.stderr
    return Path(shutil.copy(SCRIPT, folder))


def counts(reader: Path, path: Path) -> dict[str, dict[str, int]]:
    read = subprocess.run(["node", str(reader), str(path)], capture_output=True, text=True, check=False)
    assert read.returncode == 0, read.stderr
    found: dict[str, dict[str, int]] = json.loads(read.stdout)
    return found


@pytest.mark.long
@pytest.mark.parametrize("compression", ["auto", "none", "lz4", "zstd"])
def test_long_finished_and_recovered_files_are_readable_by_every_reader(
    reader: Path, tmp_path: Path, compression: str
) -> None:
    whole = tmp_path / "whole.mcap"
    content = write_part(whole, compression=compression)
    expected = {topic: len(rows) for topic, rows in content.items()}
    found = counts(reader, whole)
    assert found["streamed"] == found["indexed"] == expected
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    report = recover(cut)
    assert report.recovered is not None
    found = counts(reader, report.recovered)
    assert found["streamed"] == found["indexed"] == dict(report.messages)
    assert sum(report.messages.values()) > 100
