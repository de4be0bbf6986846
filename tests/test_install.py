"""Tests `make install` into a folder, the installed program with nothing else around it, and `make uninstall`."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

from tests.daemon.rig import HANGS_S

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("daemon", "drivers", "georef", "calib", "sim")
PROCESSING_ONLY = ("numba", "scipy", "pyproj", "laspy", "matplotlib", "jinja2", "tomlkit", "weasyprint")
PLACED = {
    "etc/chrony/conf.d/swath.conf",
    "etc/swath/swath.toml",
    "usr/lib/sysctl.d/90-swath.conf",
    "usr/lib/systemd/network/80-swath-can.network",
    "usr/lib/systemd/system/swath-console.service",
    "usr/lib/systemd/system/swath-live.service",
    "usr/lib/systemd/system/swathd@.service",
    "usr/lib/systemd/system/swath-pps@.service",
    "usr/lib/systemd/system/swathd.service",
    "usr/lib/sysusers.d/swath.conf",
    "usr/lib/tmpfiles.d/swath.conf",
    "usr/lib/udev/rules.d/90-swath.rules",
    "usr/local/bin/swath",
}

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("install")]


def make(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run make in the project's folder."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("MAKE", "DESTDIR", "PREFIX"))}
    command = ["make", "-s", *arguments]
    return subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=HANGS_S, check=False
    )


def files_below(folder: Path) -> set[str]:
    """Return all files and links, relative to the folder; the program's own folder only by its name."""
    found = set()
    for parent, folders, names in os.walk(folder):
        if Path(parent) == folder / "opt":
            found |= {f"opt/{name}" for name in folders}
            folders.clear()
        found |= {str((Path(parent) / name).relative_to(folder)) for name in names}
    return found


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the program into a root, with any Python that a service could see."""
    root = tmp_path_factory.mktemp("root")
    done = make("install", f"DESTDIR={root}", "EXTRAS=", *python_for_services())
    assert done.returncode == 0, done.stderr
    return root


def python_for_services() -> list[str]:
    """Return `PYTHON=` for make install; nothing if the default, the system's Python, will do."""
    system = Path("/usr/bin/python3")
    probe = "import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))"
    if system.exists() and subprocess.run([system, "-c", probe], capture_output=True, check=False).returncode == 0:
        return []
    return ["PYTHON=python3"]


def run_installed(root: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the installed program's Python, away from the source tree."""
    command = [str(root / "opt/swath/bin/python"), "-I", *arguments]
    return subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=HANGS_S, check=False)


def test_exactly_the_expected_files_are_installed(installed: Path) -> None:
    assert files_below(installed) == PLACED | {"opt/swath"}


def test_no_installed_file_names_the_build_folder(installed: Path) -> None:
    texts = [installed / name for name in PLACED] + sorted((installed / "opt/swath/bin").iterdir())
    for path in texts:
        if not path.is_symlink():
            assert str(installed).encode() not in path.read_bytes(), path
            assert b"swath.building" not in path.read_bytes(), path


def test_scripts_start_with_the_python_beside_them(installed: Path) -> None:
    assert (installed / "opt/swath/bin/swath").read_text().startswith("#!/opt/swath/bin/python")
    assert os.readlink(installed / "usr/local/bin/swath") == "/opt/swath/bin/swath"


def test_bare_install_imports_all_packages_and_no_processing_module(installed: Path) -> None:
    packages = ", ".join(f"swath.{name}" for name in PACKAGES)
    code = f"import importlib.util as u, {packages}; print([n for n in {PROCESSING_ONLY} if u.find_spec(n)])"
    done = run_installed(installed, "-c", code)
    assert (done.returncode, done.stdout.strip()) == (0, "[]"), done.stderr


TABLES = "swath.drivers.captures.tables."
BY_NAME = (  # compiled loops, bags of ROS, MF4
    "swath.drivers.captures.can.mf4",
    "swath.drivers.captures.rosbag.bag",
    "swath.drivers.captures.rosbag.unfinished",
    "swath.drivers.scanner.rows.compiled",
)


def wants_an_extra(name: str) -> bool:
    """Return True if a module imports what only an extra brings: these, virtual aircraft, processing, console."""
    _, package, module = [*name.split(".", 2), ""][:3]
    if package == "georef":
        return bool(module) and module.split(".")[0] not in ("records", "timescales")
    needs = ("swath.sim.", "swath.calib.", "swath.daemon.processing.", "swath.daemon.console.", TABLES)
    return name in BY_NAME or name.startswith(needs)


def test_bare_install_has_every_module_of_the_project(installed: Path) -> None:
    """Modules that need no extra can be imported without the extras."""
    names = [
        f"swath.{path.relative_to(ROOT).with_suffix('')}".replace("/", ".").removesuffix(".__init__")
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
    ]
    extra = [name for name in names if wants_an_extra(name)]
    assert len(extra) > 30
    bare = [name for name in names if name not in extra]
    absent = f"[n for n in {extra!r} if not u.find_spec(n)]"
    done = run_installed(
        installed, "-c", f"import importlib.util as u; [__import__(n) for n in {bare!r}]; print({absent})"
    )
    assert (done.returncode, done.stdout.strip()) == (0, "[]"), done.stderr


def test_bare_install_names_the_packages_needed_by_the_simulator(installed: Path, tmp_path: Path) -> None:
    done = run_installed(installed, "-m", "swath.daemon.cli.main", "sim", "fly", "small", "-o", str(tmp_path / "small"))
    assert done.returncode == 2
    assert "pip install '.[sim]'" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "small").exists()


def test_presets_are_installed(installed: Path) -> None:
    folder = "(importlib.resources.files('swath.sim') / 'presets')"
    code = f"import importlib.resources; print(sorted(path.name for path in {folder}.iterdir()))"
    done = run_installed(installed, "-c", code)
    assert "'small.toml'" in done.stdout, done.stderr


def test_templates_of_pages_are_installed(installed: Path) -> None:
    folder = "(importlib.resources.files('swath.daemon') / 'processing/pages/templates')"
    code = f"import importlib.resources; print(sorted(path.name for path in {folder}.iterdir()))"
    done = run_installed(installed, "-c", code)
    templates = (ROOT / "daemon/processing/pages/templates").iterdir()
    assert done.stdout.strip() == str(sorted(path.name for path in templates)), done.stderr


def test_bare_install_lists_its_devices(installed: Path) -> None:
    done = run_installed(installed, "-m", "swath.daemon.cli.main", "devices", "--json")
    assert done.returncode == 0, done.stderr
    assert {"ubx", "novatel", "nmea", "canmod-gps", "srep"} <= {
        row["protocol"] for row in json.loads(done.stdout)["devices"]
    }


def test_installed_example_configuration_is_valid(installed: Path) -> None:
    done = run_installed(
        installed, "-m", "swath.daemon.cli.main", "check", "--offline", str(installed / "etc/swath/swath.toml")
    )
    assert done.returncode == 0, done.stderr


def test_uninstall_leaves_the_configuration_and_the_logs(installed: Path, tmp_path: Path) -> None:
    """The root is a copy without the bulk of the program, which does not matter to what uninstall removes."""
    for name in PLACED:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        source = installed / name
        if source.is_symlink():
            (tmp_path / name).symlink_to(os.readlink(source))
        else:
            (tmp_path / name).write_bytes(source.read_bytes())
    (tmp_path / "opt/swath").mkdir(parents=True)
    (tmp_path / "opt/swath/pyvenv.cfg").touch()
    (tmp_path / "var/lib/swath").mkdir(parents=True)
    (tmp_path / "var/lib/swath/flight_0.mcap").touch()
    done = make("uninstall", f"DESTDIR={tmp_path}")
    assert done.returncode == 0, done.stderr
    assert files_below(tmp_path) == {"etc/swath/swath.toml", "var/lib/swath/flight_0.mcap"}
    assert "kept" in done.stdout


def install_files(root: Path, prefix: str) -> str:
    """Install everything except the program, which takes longest, and return what the installer printed."""
    environment = os.environ | {"DESTDIR": str(root), "PREFIX": prefix}
    command = ["sh", str(ROOT / "systemd/install.sh"), "files"]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=HANGS_S, check=True).stdout


def test_another_prefix_is_written_to_the_unit(tmp_path: Path) -> None:
    install_files(tmp_path, "/srv/lidar")
    unit = (tmp_path / "usr/lib/systemd/system/swathd.service").read_text()
    assert "ExecStart=/srv/lidar/bin/swath run /etc/swath/swath.toml" in unit
    assert "/opt/swath" not in unit
    assert os.readlink(tmp_path / "usr/local/bin/swath") == "/srv/lidar/bin/swath"


def test_an_existing_configuration_is_never_overwritten(tmp_path: Path) -> None:
    own = tmp_path / "etc/swath/swath.toml"
    own.parent.mkdir(parents=True)
    own.write_text("mine\n")
    assert "kept" in install_files(tmp_path, "/opt/swath")
    assert own.read_text() == "mine\n"


def test_a_configuration_on_an_unmounted_disk_is_not_replaced_by_the_example(tmp_path: Path) -> None:
    """Otherwise the next start would record with the example's devices."""
    link = tmp_path / "etc/swath/swath.toml"
    link.parent.mkdir(parents=True)
    link.symlink_to(tmp_path / "data/aircraft.toml")
    assert "kept" in install_files(tmp_path, "/opt/swath")
    assert link.readlink() == tmp_path / "data/aircraft.toml"


def test_modified_files_in_etc_are_kept_beside_the_new_ones(tmp_path: Path) -> None:
    assert ".old" not in install_files(tmp_path, "/opt/swath") + install_files(tmp_path, "/opt/swath")
    placed = tmp_path / "etc/chrony/conf.d/swath.conf"
    as_installed = placed.read_text()
    placed.write_text("maxslewrate 20\n")
    assert f"{placed}.old" in install_files(tmp_path, "/opt/swath")
    assert placed.read_text() == as_installed
    assert Path(f"{placed}.old").read_text() == "maxslewrate 20\n"
    placed.write_text("an earlier version's\n")
    assert f"{placed}.old2" in install_files(tmp_path, "/opt/swath")
    kept = [Path(f"{placed}.old").read_text(), Path(f"{placed}.old2").read_text()]
    assert kept == ["maxslewrate 20\n", "an earlier version's\n"], "the second does not take the first's place"


def test_a_folder_with_other_files_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "usr/lib").mkdir(parents=True)
    done = make("install", f"DESTDIR={tmp_path}", "PREFIX=/usr", *python_for_services())
    assert done.returncode != 0
    assert "holds other files" in done.stderr
    assert files_below(tmp_path) == set()


# A Python that creates a program from a script and a file at once; $1 to $3 are -m venv FOLDER.
PYTHON_OF_SCRIPTS = """#!/bin/sh
[ "$1 $2" = "-m venv" ] || exit 0
{venv}
mkdir -p "$3/bin"
echo "command = $0 -m venv $3" >"$3/pyvenv.cfg"
cat >"$3/bin/python" <<SCRIPT
{pip}
echo "#!$3/bin/python" >"$3/bin/swath"
SCRIPT
chmod 755 "$3/bin/python"
"""
BEFORE = {"opt/swath/pyvenv.cfg", "opt/swath/bin/swath", "opt/swath/lib/only_before.py"}


@pytest.fixture
def root_before(tmp_path: Path) -> Path:
    """Return a root with an installed program, and the remains of another whose building a power cut ended."""
    root = tmp_path / "root"
    for name in BEFORE | {"opt/swath.building/bin/python"}:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("before\n")
    return root


def install_with(root: Path, prefix: str = "/opt/swath", venv: str = ":", pip: str = ":") -> tuple[int, str]:
    """Run `install` with a Python that behaves as given, and return its exit status and all output."""
    python = root.parent / "python"
    python.write_text(PYTHON_OF_SCRIPTS.format(venv=venv, pip=pip))
    python.chmod(0o755)
    environment = os.environ | {"DESTDIR": str(root), "PREFIX": prefix, "PYTHON": str(python)}
    command = ["sh", str(ROOT / "systemd/install.sh"), "install"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=HANGS_S, check=False)
    return done.returncode, done.stdout + done.stderr


def all_below(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if not path.is_dir()}


@pytest.mark.parametrize(
    ("venv", "pip", "status"),
    [
        ("echo no room >&2; exit 1", ":", 1),
        (":", "echo no network >&2; exit 1", 1),
        ("kill -TERM $PPID; sleep 0.2", ":", 143),
        (":", "kill -INT $PPID; sleep 0.2", 130),
    ],
)
def test_a_failed_build_keeps_the_installed_program(root_before: Path, venv: str, pip: str, status: int) -> None:
    told = install_with(root_before, venv=venv, pip=pip)
    assert told[0] == status, told[1]
    assert all_below(root_before) == BEFORE
    assert all((root_before / name).read_text() == "before\n" for name in BEFORE)
    if status == 1:
        assert told[1].splitlines()[1:] == [
            "no room" if venv != ":" else "no network",
            f"swath: the program in {root_before}/opt/swath is unchanged",
            "swath: the program could not be installed; see the output of pip above",
        ]


def test_a_new_program_replaces_the_previous_one_completely(root_before: Path) -> None:
    in_place = f'[ -e "{root_before}/opt/swath/lib/only_before.py" ] || exit 1'
    for name, group in (("acme_lidar-1.2", "swath.drivers"), ("pygments-2.0", "console_scripts")):
        info = root_before / f"opt/swath/lib/python3.11/site-packages/{name}.dist-info"
        info.mkdir(parents=True)
        (info / "entry_points.txt").write_text(f"[{group}]\nacme = acme:DRIVER\n")
    status, told = install_with(root_before, venv=in_place, pip=in_place, prefix="/opt/swath/")
    assert status == 0, told
    named = [line for line in told.splitlines() if "drivers of" in line]
    assert named == [
        "the drivers of acme_lidar-1.2 were beside the old program; install that package again, with "
        "/opt/swath/bin/pip, before the next recording"
    ]
    assert sorted(path.name for path in (root_before / "opt").iterdir()) == ["swath"]
    assert not (root_before / "opt/swath/lib").exists()
    assert (root_before / "opt/swath/bin/swath").read_text() == "#!/opt/swath/bin/python\n"
    assert (root_before / "opt/swath/pyvenv.cfg").read_text().endswith("-m venv /opt/swath\n")


def test_a_power_cut_between_two_renames_is_repaired_by_the_next_run(root_before: Path) -> None:
    (root_before / "opt/swath").rename(root_before / "opt/swath.old")
    assert install_with(root_before, pip="exit 1")[0] == 1
    assert all_below(root_before) == BEFORE


@pytest.mark.parametrize("prefix", ["/", "swath"])
def test_a_prefix_must_be_an_absolute_path(tmp_path: Path, prefix: str) -> None:
    status, told = install_with(tmp_path / "root", prefix)
    assert (status, told.count("\n")) == (1, 1)
    assert "absolute path" in told
    assert not (tmp_path / "root").exists()


@pytest.mark.parametrize(("active", "told"), [("true", True), ("false", False)])
def test_a_running_recorder_is_reported_to_need_a_restart(tmp_path: Path, active: str, told: bool) -> None:
    (tmp_path / "systemctl").write_text(f'#!/bin/sh\n[ "$*" = "is-active --quiet swathd" ] && {active}\n')
    (tmp_path / "systemctl").chmod(0o755)
    script = "set -- files; . ./install.sh; tell_what_runs"
    environment = os.environ | {"DESTDIR": str(tmp_path / "root"), "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["sh", "-c", script], cwd=ROOT / "systemd", env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert ("systemctl restart swathd" in done.stdout) is told
