"""Tests every command and configuration in README.md, or names the test that does."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from swath.daemon.cli.main import make_app
from swath.daemon.config import load_config
from tests.daemon.rig import HANGS_S, Recorder, session_table

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    """Return the fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", README, flags=re.MULTILINE | re.DOTALL)


def commands() -> list[str]:
    """Return every command line of the README: those after a prompt, and those in the text."""
    prompted = [line[2:] for block in blocks("console") for line in block.splitlines() if line.startswith("$ ")]
    inline = re.findall(
        r"`((?:sudo |make |swath |systemctl |pip )[^`]*)`", re.sub(r"^```.*?^```$", "", README, flags=re.M | re.S)
    )
    return list(dict.fromkeys(prompted + inline))


def run(*command: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a command in the project's folder, and check that it succeeds."""
    words = [str(word) for word in command]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=HANGS_S, check=False)
    assert done.returncode == 0, f"{words}: {done.stderr}"
    return done


def swath(*arguments: str | Path) -> str:
    """Run `swath` as installed from here, and return what it printed."""
    return run(sys.executable, "-m", "swath.daemon.cli.main", *arguments).stdout


def make_target(name: str, *what_it_runs: str) -> Callable[[Path], None]:
    """Check the dry run of a make target, because `make test` cannot run itself."""

    def check(_: Path) -> None:
        planned = run("make", "-n", name).stdout
        for words in what_it_runs:
            assert words in planned

    return check


def run_devices(_: Path) -> None:
    assert "velodyne-vlp16" in swath("devices")


def aircraft_of_readme(folder: Path) -> Path:
    """Write the README's configuration to a file, and return its path."""
    (text,) = blocks("toml")
    path = folder / "swath.toml"
    path.write_text(text)
    return path


def run_check_offline(folder: Path) -> None:
    assert "valid; 4 sources: pps/main, gnss/rover, imu/main, scanner/left" in swath(
        "check", "--offline", aircraft_of_readme(folder)
    )


def run_check(folder: Path) -> None:
    """Run the check without the aircraft's devices and clock: each is reported as wrong, with exit status 1."""
    command = [
        sys.executable,
        "-m",
        "swath.daemon.cli.main",
        "check",
        "--seconds",
        "0.2",
        str(aircraft_of_readme(folder)),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=HANGS_S, check=False)
    assert done.returncode == 1, done.stderr
    assert "/dev/pps0" in done.stdout
    assert "/dev/ttyUSB0" in done.stdout


def record_a_little(folder: Path) -> Path:
    """Record a log of a second without any device, and return its folder."""
    logs = folder / "logs"
    config = folder / "record.toml"
    config.write_text(f'[session]\nname = "readme"\ndirectory = "{logs}"\nreserve_mb = 1\n')
    swath("run", "--seconds", "1.2", config)
    return logs


def run_info(folder: Path) -> None:
    assert "readme" in swath("info", record_a_little(folder))


def run_recover(folder: Path) -> None:
    swath("recover", record_a_little(folder))


def run_setup(folder: Path) -> None:
    """Run setup without --apply; test_device_setup.py runs it with --apply against simulators."""
    said = swath("setup", aircraft_of_readme(folder))
    assert "LOG TIMEB ONTIME 1" in said
    assert "nothing was sent" in said


def run_doctor(folder: Path) -> None:
    """Run the doctor, which may find faults of this computer: exit status 1, with remedies."""
    command = [sys.executable, "-m", "swath.daemon.cli.main", "doctor", str(aircraft_of_readme(folder))]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=HANGS_S, check=False)
    assert done.returncode in (0, 1), done.stderr
    assert "receive buffers" in done.stdout


def run_offload(folder: Path) -> None:
    with tempfile.TemporaryDirectory(dir="/dev/shm", prefix="swath-") as usb:  # another disk that need not be mounted
        said = swath("offload", record_a_little(folder), usb)
        assert "safe to delete: 1 log" in said
        assert Path(usb, "SHA256SUMS").exists()


def run_beside_a_recorder(folder: Path) -> None:
    with Recorder(folder, session_table(folder / "logs")) as recorder:
        assert "recording" in swath("monitor", "--once", recorder.config)
        assert "line 4 start" in swath("mark", "line 4 start", recorder.config)
        assert recorder.stop() == 0


def point_to_the_page(_: Path) -> None:
    """Check that the commands exist; test_import.py and test_export.py prove what they do."""
    assert {"import", "export"} <= set(getattr(get_command(make_app(None)), "commands", {}))


def run_points(folder: Path) -> None:
    """Fly into a log, and make points of it and the page that shows them."""
    swath("sim", "fly", "small", "--seconds", "24", "-o", folder / "small")
    calibration = folder / "small/left.true.toml"  # the log contains the nominal calibration
    crs = ("--crs", "EPSG:32632")
    said = swath("georef", folder / "small", "-o", folder / "points", *crs, "--calibration", calibration)
    assert "complete: " in said
    assert "points" in swath("view", folder / "points")
    assert (folder / "points/view/index.html").stat().st_size > 100_000


def runs_with_georef(_: Path) -> None:
    """Check that the commands exist; `run_points` runs them."""
    assert {"sim", "view"} <= set(getattr(get_command(make_app(None)), "commands", {}))


def extra_is_there(_: Path) -> None:
    """Check the extra's list, because pip would download it; the tests of processing prove that it is enough."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    wanted = {"numba", "scipy", "pyproj", "laspy", "matplotlib", "jinja2", "tomlkit", "weasyprint", "pyshp"}
    assert {re.split(r"[\[><=]", line)[0] for line in extras["process"]} == wanted


def pango_is_installed(_: Path) -> None:
    """Check that set-up lists the packages; the tests of PDF reports run with those that `make test` installs."""
    assert "libpango-1.0-0 libpangoft2-1.0-0" in (ROOT / "systemd/setup.sh").read_text()


def live_unit_is_there(_: Path) -> None:
    """Check that the unit exists; test_systemd.py proves that it is right, test_live.py what it runs."""
    assert "WantedBy=swathd.service" in (ROOT / "systemd/swath-live.service").read_text()


def unit_is_there(_: Path) -> None:
    """Check that the unit exists, because systemctl would act on this computer; test_systemd.py proves it right."""
    assert (ROOT / "systemd/swathd.service").read_text().count("[Install]\nWantedBy=multi-user.target") == 1


def group_may_read(_: Path) -> None:
    """Check the folder's mode, because usermod would change this computer; test_systemd.py proves the rest."""
    assert "d /var/lib/swath 0750 swath swath -" in (ROOT / "systemd/tmpfiles/swath.conf").read_text()


EXERCISED: dict[str, Callable[[Path], None]] = {
    "make demo": make_target("demo", "-m demo"),
    "make test": make_target("test", "ruff check", "mypy", "lint-imports", "-m pytest"),
    "make test-slow": make_target("test-slow", '-m "slow and not long'),
    "sudo make install": make_target("install", "install.sh install"),  # done for real in test_install.py
    "sudo make uninstall": make_target("uninstall", "install.sh uninstall"),
    "swath devices": run_devices,
    "swath check --offline /etc/swath/swath.toml": run_check_offline,
    "sudo swath check /etc/swath/swath.toml": run_check,
    "swath setup /etc/swath/swath.toml": run_setup,
    "sudo swath setup --apply": run_setup,
    "sudo swath doctor /etc/swath/swath.toml": run_doctor,
    "swath monitor": run_beside_a_recorder,
    'swath mark "line 4 start"': run_beside_a_recorder,
    "swath import": point_to_the_page,
    "swath export": point_to_the_page,
    "swath offload /var/lib/swath /mnt/usb": run_offload,
    "swath info /var/lib/swath": run_info,
    "sudo -u swath swath recover /var/lib/swath": run_recover,
    "sudo usermod -aG swath $USER": group_may_read,
    "python3 -m venv office && office/bin/pip install '.[process]'": extra_is_there,
    ". office/bin/activate": extra_is_there,
    "sudo apt-get install libpango-1.0-0 libpangoft2-1.0-0": pango_is_installed,
    "swath georef /mnt/usb -o thurgau-north --crs EPSG:32632": run_points,
    "swath view thurgau-north": runs_with_georef,
    "swath sim fly small -o small": runs_with_georef,
    "sudo systemctl enable --now swath-live": live_unit_is_there,
    "sudo systemctl enable --now swathd": unit_is_there,
    "systemctl status swathd": unit_is_there,
}


@pytest.mark.slow
@pytest.mark.parametrize("line", commands())
def test_each_command_of_the_readme_works(line: str, tmp_path: Path) -> None:
    EXERCISED[line](tmp_path)


def test_exactly_the_commands_of_the_readme_are_exercised() -> None:
    assert set(commands()) - set(EXERCISED) == set(), "say in EXERCISED how these are tested"
    assert set(EXERCISED) - set(commands()) == set()


def test_commands_that_need_root_are_written_with_sudo() -> None:
    """Root opens devices; only the logs' owner makes a copy that the group may read."""
    for page in (ROOT / "README.md", ROOT / "docs/installation.md", ROOT / "docs/recording.md"):
        for line in re.findall(r"^\$ (.*\bswath (?:recover|doctor|setup|check)\b.*)", page.read_text(), re.M):
            if "--offline" in line or (line.startswith("swath setup") and "--apply" not in line):
                continue
            assert line.startswith("sudo -u swath swath" if " recover " in line else "sudo swath"), page.name


def test_the_first_two_commands_set_everything_up() -> None:
    assert commands()[:2] == ["make demo", "make test"]
    assert blocks("console")[0] == "$ make demo\n$ make test\n"


def test_the_configuration_of_the_readme_is_a_complete_aircraft(tmp_path: Path) -> None:
    config = load_config(aircraft_of_readme(tmp_path))
    assert [device.source for device in config.devices()] == ["gnss/rover", "imu/main", "scanner/left"]


def test_commands_named_in_the_pages_exist() -> None:
    known = set(getattr(get_command(make_app(None)), "commands", {}))
    for page in sorted((ROOT / "docs").glob("*.md")):
        for name in re.findall(r"(?:`|\$ )swath ([a-z-]+)\b", page.read_text()):
            assert name in known, f"{page.name}: there is no `swath {name}`"


def options(command: Any, name: str = "swath") -> Iterator[tuple[str, list[str]]]:
    """Yield each option of a command and of those below it, with its spellings and the word that turns it off."""
    for below, found in getattr(command, "commands", {}).items():
        yield from options(found, f"{name} {below}")
    for parameter in command.params:
        written = [word for word in (*parameter.opts, *parameter.secondary_opts) if word.startswith("--")]
        if written and parameter.name != "help":
            yield name, written


def test_every_option_is_documented() -> None:
    pages = README + "".join(page.read_text() for page in (ROOT / "docs").rglob("*.md"))
    stands = set(re.findall(r"(?<![\w-])--[a-z][a-z0-9-]*", pages))
    known = options(get_command(make_app(None)))
    assert [f"{name} {words[0]}" for name, words in known if stands.isdisjoint(words)] == []


def test_make_help_lists_every_target() -> None:
    listed = {line.split()[1] for line in run("make", "--no-print-directory", "help").stdout.splitlines()}
    tests = {"test", "test-slow", "test-peers", "test-vm", "test-vm-long", "test-arm64", "test-long"}
    tests |= {"soak", "soak-short", "fuzz", "pictures", "test-computing"}
    assert listed == {"help", "demo", "lint", "bench", "bench-calibration", "install", "uninstall", "clean"} | tests


def test_make_is_installed() -> None:
    assert shutil.which("make") is not None, "apt-get install make"
