"""Makes virtual environments to install Swath and other packages in, as users do."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

from tests.builders import ROOT
from tests.daemon.rig import HANGS_S

SOURCES = ("pyproject.toml", "README.md", "LICENSE", "swath", "calib", "daemon", "drivers", "georef", "sim")


class Place:
    """A virtual environment that has what Swath needs, but not Swath, and the sources of Swath beside it."""

    def __init__(self, folder: Path) -> None:
        self.sources = folder / "sources"
        self.sources.mkdir()
        for name in SOURCES:
            if (ROOT / name).is_dir():
                shutil.copytree(
                    ROOT / name, self.sources / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__")
                )
            else:
                shutil.copy(ROOT / name, self.sources)
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder / "venv"], check=True)
        self.bin = folder / "venv/bin"
        (self.packages,) = (folder / "venv/lib").glob("python3*/site-packages")
        # a .pth file's path adds its packages, but not the paths of their .pth files: Swath as a developer has it
        (self.packages / "needed.pth").write_text(sysconfig.get_path("purelib"))

    def pip(self, *arguments: str) -> None:
        """Run pip for this environment."""
        command = [sys.executable, "-m", "pip", "--python", str(self.bin / "python"), *arguments]
        done = subprocess.run(command, capture_output=True, text=True, timeout=HANGS_S, check=False)
        assert done.returncode == 0, done.stderr

    def install_swath(self, *options: str) -> None:
        """Install the sources."""
        self.pip("install", "-q", "--no-deps", "--force-reinstall", *options, str(self.sources))

    def install_python_daemon(self) -> None:
        """Install another project's package that is called `daemon`."""
        self.pip("install", "-q", "--force-reinstall", "python-daemon>=3")

    def run(self, program: str, *arguments: str, folder: Path | None = None) -> str:
        """Return what a program of this environment says, run in a folder."""
        own = ("PYTHONPATH", "NUMBA_CACHE_DIR")
        environment = {key: value for key, value in os.environ.items() if key not in own}
        done = subprocess.run(
            [self.bin / program, *arguments],
            cwd=folder or self.bin,
            env=environment,
            capture_output=True,
            text=True,
            timeout=HANGS_S,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout
