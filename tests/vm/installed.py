"""Makes the program as `make install` installs it, to lay over the machine's root; it is kept in .cache.

python -m tests.vm.installed    # before the tests, which otherwise wait for it
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path

from tests.vm.machine import CACHE, TREE, UDEV, with_sbin

INSTALLED = CACHE / "installed"
IMAGE = CACHE / "installed.ext4"
MB = 1 << 20
_SOURCES = ("pyproject.toml", "swath", "calib", "daemon", "drivers", "georef", "sim", "systemd")
_ACCOUNTS = ("passwd", "group", "shadow", "gshadow")


def installed() -> Path:
    """Return the layer that `make install DESTDIR=…` makes with systemd's user, made again if the program changed.

    ``SWATH_VM_KEEP=1`` in the environment takes the existing one, whatever has changed.
    """
    CACHE.mkdir(exist_ok=True)
    with (CACHE / "installed.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        state = _state()
        mark = CACHE / "installed.state"
        if mark.exists() and IMAGE.exists() and (os.environ.get("SWATH_VM_KEEP") or mark.read_text() == state):
            return INSTALLED
        mark.unlink(missing_ok=True)
        _install(INSTALLED)
        _make_image(INSTALLED, IMAGE)
        mark.write_text(state)
    return INSTALLED


def image() -> Path:
    """Return the layer as a disk for the ``layers`` of `machine.start`, because a recorder starts slower over 9p."""
    installed()
    return IMAGE


def overlay(folder: Path, config: str, *, enabled: Iterable[str] = ("swathd.service",)) -> Path:
    """Return a folder for `machine.start`'s ``overlay``: configuration, and units as `systemctl enable` leaves them."""
    (folder / "etc/swath").mkdir(parents=True, exist_ok=True)
    (folder / "etc/swath/swath.toml").write_text(config)
    units = installed() / "usr/lib/systemd/system"
    for name in enabled:
        for line in (units / name).read_text().splitlines():
            if line.startswith("WantedBy="):
                wants = folder / f"etc/systemd/system/{line.partition('=')[2]}.wants"
                wants.mkdir(parents=True, exist_ok=True)
                (wants / name).symlink_to(f"/usr/lib/systemd/system/{name}")
    return folder


def with_udev() -> list[Path]:
    """Return the layers of a machine that names its devices."""
    return [image(), UDEV]


def _install(layer: Path) -> None:
    shutil.rmtree(layer, ignore_errors=True)
    (layer / "etc").mkdir(parents=True)
    environment = {**os.environ, "DESTDIR": str(layer), "PREFIX": "/opt/swath", "PYTHON": "/usr/bin/python3"}
    for name in ("PYTHONPATH", "VIRTUAL_ENV"):
        environment.pop(name, None)
    _run(["sh", str(TREE / "systemd/install.sh"), "install"], environment)
    for name in _ACCOUNTS:
        if Path("/etc", name).exists():
            shutil.copy(Path("/etc", name), layer / "etc" / name)
    _run(["systemd-sysusers", f"--root={layer}"], environment)  # a package's script would do this, or the next start
    for path in (layer, *(one for one in layer.rglob("*") if one.is_dir() and not one.is_symlink())):
        path.chmod(0o755)


def _make_image(layer: Path, path: Path) -> None:
    """Make an image without what a read-only disk does not need: journal, checksums, blocks reserved for root."""
    path.unlink(missing_ok=True)
    # blocks of each file's content (rounded up) plus one for entries; 128 MB hold the inodes of 8 GB (1/64)
    held = sum(one.lstat().st_size // 4096 + 2 for one in layer.rglob("*")) * 4096
    without = ["-O", "^has_journal,^metadata_csum", "-m", "0"]
    _run(["mkfs.ext4", "-qF", *without, "-d", str(layer), str(path), f"{held // MB + 128}M"], with_sbin())


def _run(command: list[str], environment: dict[str, str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=900, check=False)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}{done.stderr}"


def _state() -> str:
    """Return a digest of everything that is installed, without the documentation."""
    digest = hashlib.sha256()
    for name in _SOURCES:
        root = TREE / name
        for path in sorted(root.rglob("*")) if root.is_dir() else [root]:
            if path.is_file() and "__pycache__" not in path.parts:
                digest.update(str(path.relative_to(TREE)).encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()


if __name__ == "__main__":
    image()
