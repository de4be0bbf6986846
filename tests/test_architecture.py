"""Tests architecture rules beyond import-linter's contracts: names, lists, sizes and files of the checkout."""

from __future__ import annotations

import ast
import functools
import os
import re
import subprocess
import sys
import tomllib
from collections import Counter, defaultdict
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

import pytest

import swath

ROOT = Path(__file__).resolve().parent.parent
pytestmark = pytest.mark.xdist_group("architecture")  # one worker parses the files once
MOST_LINES = 600
SMALL_LINES = 80
MOST_MODULES = 20
PACKAGES = ("daemon", "drivers", "georef", "calib", "sim")
LARGEST_FILE_BYTES, LARGEST_RECORDING_BYTES = 2_000_000, 8_000_000
LARGEST_CHECKOUT_BYTES = 90_000_000
SHARED_OF_GEOREF = {
    "swath.georef.arrays",
    "swath.georef.records",
    "swath.georef.strip_colours",
    "swath.georef.text_encoding",
    "swath.georef.timescales",
    "swath.georef.toml_tables",
}
# Modules outside the command line that import within functions, and what they import: an extra, or a module that is
# slow to load and not needed by all users of the importing module.
IMPORTED_LATE = {
    "swath.daemon.console.rasters": {"rasterio"},
    "swath.daemon.log.directory": {"swath.daemon.config"},  # pydantic; commands given a folder read no configuration
    # matplotlib, Jinja2 and WeasyPrint, with --report only
    "swath.daemon.processing.calibration.products": {
        "swath.daemon.processing.calibration.report",
        "swath.daemon.processing.pages",
    },
    "swath.daemon.processing.flights.trajectory_choice": {"swath.georef.trajectory.turn_rates"},  # scipy.signal
    "swath.daemon.processing.live.coverage": {"rasterio"},
    "swath.daemon.processing.pages.pdf": {"weasyprint"},
    "swath.daemon.processing.records.files": {"pyarrow", "swath.daemon.processing.records.mcap"},  # and protobuf
    "swath.daemon.processing.setup.terrain": {"rasterio"},
    # matplotlib
    "swath.daemon.processing.trajectory.summary": {
        "swath.daemon.processing.pages.pdf",
        "swath.daemon.processing.trajectory.page",
    },
    "swath.daemon.processing.vector_layers": {"shapefile"},  # for shapefiles only
    "swath.daemon.simulate.plans": {"swath.sim"},  # the only import of the virtual aircraft
    "swath.daemon.system": {"psutil"},
    # asammdf, rosbags, pyarrow
    "swath.drivers.captures.can.mf4_reader": {"asammdf"},  # its absence is told as a line
    "swath.drivers.captures.opening": {
        "swath.drivers.captures.rosbag.bag",
        "swath.drivers.captures.tables",
    },
    "swath.drivers.imu.dbc.signals": {"cantools.database"},
    "swath.drivers.scanner.rows.filler": {"swath.drivers.scanner.rows.compiled"},  # numba
    "swath.drivers.scanner.velodyne.calibration": {"yaml"},
    "swath.drivers.transports.opening": {"swath.drivers.transports.can.adapter"},  # python-can
    "swath.drivers.transports.spec": {"can.interfaces"},
    "swath.sim.scene.raster": {"rasterio"},
}
PROCESSING_ONLY = {"numba", "scipy", "pyproj", "laspy", "matplotlib", "jinja2", "weasyprint", "swath.calib"}


def project() -> dict[str, Any]:
    """Return the content of pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


@functools.cache
def parsed(path: Path) -> ast.Module:
    """Return the syntax tree of a file, which several tests look at."""
    return ast.parse(path.read_text())


def tracked() -> list[Path]:
    """Return the files that git tracks, as far as they exist here."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [path for name in listed.split("\0") if name and (path := ROOT / name).is_file()]


def contract(name: str) -> dict[str, Any]:
    """Return a contract of import-linter by its name."""
    (found,) = [one for one in project()["tool"]["importlinter"]["contracts"] if one["name"] == name]
    return dict(found)


def test_the_packages_of_swath_are_links_to_the_folders_beside_it() -> None:
    assert Path(swath.__file__) == ROOT / "swath/__init__.py"
    links = {path.name: os.readlink(path) for path in (ROOT / "swath").iterdir() if path.is_symlink()}
    assert links == {name: f"../{name}" for name in PACKAGES}


def test_every_folder_of_modules_is_a_package() -> None:
    """setuptools installs packages only."""
    folders = {path.parent for name in PACKAGES for path in (ROOT / name).rglob("*.py")}
    assert [str(folder) for folder in sorted(folders) if not (folder / "__init__.py").exists()] == []


def test_data_files_of_packages_are_listed_for_installation() -> None:
    data = project()["tool"]["setuptools"]["package-data"]
    listed = {path for name in PACKAGES for pattern in data[f"swath.{name}"] for path in (ROOT / name).glob(pattern)}
    lying = {path for path in tracked() if path.relative_to(ROOT).parts[0] in PACKAGES and path.suffix != ".py"}
    assert lying <= listed, f"not installed: {sorted(str(path) for path in lying - listed)}"


def test_sim_may_import_only_the_shared_modules_of_georef() -> None:
    modules = {
        f"swath.georef.{path.stem}"
        for path in (ROOT / "georef").iterdir()
        if (path.suffix == ".py" and path.stem != "__init__") or (path / "__init__.py").exists()
    }
    forbidden = set(contract("sim does not share the mathematics it tests")["forbidden_modules"])
    assert forbidden == (modules - SHARED_OF_GEOREF) | {"swath.calib"}


def georef_modules_imported(path: Path) -> set[str]:
    """Return what a file imports from georef, as ``swath.georef.<module>``."""
    found: set[str] = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module == "swath.georef":
            found |= {f"swath.georef.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
    return {".".join(name.split(".")[:3]) for name in found if name.startswith("swath.georef.")}


def test_drivers_and_shared_modules_import_only_shared_modules_of_georef() -> None:
    shared = [ROOT / "georef/__init__.py", ROOT / "georef/records.py", *(ROOT / "georef/timescales").rglob("*.py")]
    files = [*(ROOT / "drivers").rglob("*.py"), *shared]
    others = {path.name: georef_modules_imported(path) - SHARED_OF_GEOREF for path in files}
    assert {name: modules for name, modules in others.items() if modules} == {}
    assert georef_modules_imported(ROOT / "drivers/gnss/nmea/parser.py")


def test_files_and_checkout_stay_small() -> None:
    sizes = {path: path.stat().st_size for path in tracked()}
    limits = {path: LARGEST_RECORDING_BYTES if "fixtures" in path.parts else LARGEST_FILE_BYTES for path in sizes}
    assert [str(path) for path, size in sizes.items() if size > limits[path]] == []
    assert sum(sizes.values()) <= LARGEST_CHECKOUT_BYTES


def test_no_file_contains_a_path_of_a_users_computer() -> None:
    place = re.compile(rb"(?<![\w.$}/~-])/(?:root|work|home|Users)/[\w.-]+")
    for path in tracked():
        if "fixtures" in path.relative_to(ROOT).parts:
            continue  # recordings and their sources are quoted as they are
        found = place.search(path.read_bytes())
        assert found is None, f"{path.relative_to(ROOT)}: {found.group().decode() if found else ''}"


def modules() -> dict[str, Path]:
    """Return all modules of the packages, by name."""
    return {
        f"swath.{path.relative_to(ROOT).with_suffix('')}".replace("/", ".").removesuffix(".__init__"): path
        for name in PACKAGES
        for path in (ROOT / name).rglob("*.py")
    }


@functools.cache
def imports() -> dict[str, set[str]]:
    """Return for each module those of the packages that it imports, anywhere in it and for whatever purpose."""
    known, found = modules(), {}
    for name, path in known.items():
        taken: set[str] = set()
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.Import):
                taken |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                inside = {f"{node.module}.{alias.name}" for alias in node.names}
                taken |= (inside & set(known)) or {node.module}
        found[name] = (taken & set(known)) - {name}
    return found


def test_no_module_imports_itself_through_others() -> None:
    """Imports for type checkers count too."""
    try:
        TopologicalSorter(imports()).prepare()
    except CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


def imported_in_functions(path: Path) -> set[str]:
    """Return the modules that functions of a file import."""
    functions = (ast.FunctionDef, ast.AsyncFunctionDef)
    bodies = [node for node in ast.walk(parsed(path)) if isinstance(node, functions)]
    found: set[str] = set()
    for node in (node for body in bodies for node in ast.walk(body)):
        if isinstance(node, ast.ImportFrom):
            found.add(node.module or "")
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found


def test_functions_import_only_extras_and_what_is_dear_at_start_up() -> None:
    found = {name: imported_in_functions(path) for name, path in modules().items()}
    late = {name: taken for name, taken in found.items() if taken and not name.startswith("swath.daemon.cli.")}
    packages = {
        name: {
            next((one for one in IMPORTED_LATE.get(name, ()) if f"{module}.".startswith(f"{one}.")), module)
            for module in taken
        }
        for name, taken in late.items()
    }
    assert packages == IMPORTED_LATE


def test_files_stay_within_the_line_limit() -> None:
    lines = {name: path.read_text().count("\n") for name, path in modules().items()}
    assert {name: count for name, count in lines.items() if count > MOST_LINES} == {}


def test_folders_stay_within_the_module_limit() -> None:
    """Only the folder of commands may have more, because each command has a file."""
    paths = [*modules().values(), *(ROOT / "benchmarks").rglob("*.py")]
    folders = Counter(path.parent for path in paths if path.stem != "__init__")
    crowded = {str(folder.relative_to(ROOT)): count for folder, count in folders.items() if count > MOST_MODULES}
    assert set(crowded) <= {"daemon/cli"}, crowded


def test_three_files_with_a_common_prefix_form_a_folder() -> None:
    families: dict[tuple[Path, str], set[str]] = defaultdict(set)
    for path in modules().values():
        if path.stem != "__init__":
            families[path.parent, path.stem.split("_")[0]].add(path.stem)
    assert [sorted(names) for names in families.values() if len(names) > 2] == []


def test_a_small_module_used_by_one_other_is_part_of_it() -> None:
    """Modules in different packages are exempt, because a border lies between them."""
    users: dict[str, set[str]] = defaultdict(set)
    for name, taken in imports().items():
        for one in taken:
            users[one].add(name)
    small = {
        name: user
        for name, path in modules().items()
        if path.stem != "__init__" and path.read_text().count("\n") < SMALL_LINES and len(users[name]) == 1
        for user in users[name]
        if user.split(".")[1] == name.split(".")[1]
    }
    assert small == {}


def test_every_device_has_a_page() -> None:
    from swath.drivers.driver import KINDS, all_drivers

    protocols = {protocol for kind in KINDS for protocol in all_drivers(kind)}
    pages = {path.stem for path in (ROOT / "docs/devices").glob("*.md")}
    assert protocols - pages == set()


def test_every_counter_of_a_driver_is_documented() -> None:
    """`swath info` and `swath monitor` show it only by its code."""
    sources = [path.read_text() for path in (ROOT / "drivers").rglob("*.py")]
    codes = {code for text in sources for code in re.findall(r'errors\["([a-z0-9_]+)"\]', text)}
    assert len(codes) > 25
    pages = "".join(path.read_text() for path in (ROOT / "docs/devices").glob("*.md"))
    assert {code for code in codes if f"`{code}`" not in pages} == set()


def test_links_between_pages_are_valid() -> None:
    for page in [ROOT / "README.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").rglob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.relative_to(ROOT)} links to {target}"


def test_the_index_names_every_page() -> None:
    index = (ROOT / "docs/index.md").read_text()
    pages = {str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")} - {"index.md"}
    assert {page for page in pages if f"]({page})" not in index} == set()


def imported_tests(source: str) -> set[str]:
    """Return what a file imports whose last part begins with ``test_``: modules, or names from a module."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {node.module or ""} | {alias.name for alias in node.names}
    return {name for name in names if name.split(".")[-1].startswith("test_")}


def test_no_test_imports_from_another_test() -> None:
    """Functions shared by tests are in builders.py, fixtures in conftest.py, of the nearest common folder."""
    files = [path for path in tracked() if path.is_relative_to(ROOT / "tests") and path.suffix == ".py"]
    assert Path(__file__) in files
    found = {str(path.relative_to(ROOT)): imported_tests(path.read_text()) for path in files}
    assert {name: imported for name, imported in found.items() if imported} == {}
    for statement in ("import tests.sim.test_proof", "from tests.sim.test_proof import bound", "from . import test_a"):
        assert imported_tests(statement)


def event_codes() -> set[str]:
    """Return the code of every event posted: the third argument, or the second of `add_once`."""
    place = {"post": 2, "make": 2, "add": 2, "add_once": 1}
    codes = set()
    for path in [*(ROOT / "daemon").rglob("*.py"), *(ROOT / "georef").rglob("*.py")]:
        for call in ast.walk(parsed(path)):
            if not isinstance(call, ast.Call):
                continue
            name = getattr(call.func, "attr", getattr(call.func, "id", ""))
            if name in place and len(call.args) >= place[name] + 2 - (name == "add_once"):
                argument = call.args[place[name]]
                if isinstance(argument, ast.Constant) and isinstance(argument.value, str):
                    codes.add(argument.value)
    return codes


def test_every_event_is_documented() -> None:
    codes = event_codes()
    assert len(codes) > 25
    explained = set(re.findall(r"`([a-z_]+)`", (ROOT / "docs/recording.md").read_text()))
    assert codes - explained == set()


def loaded_by(code: str) -> set[str]:
    """Return names of all modules that a new interpreter has loaded after running this code.

    Modules below packages are counted as their package.
    """
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", f"{code}; import sys; print(*sys.modules)"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    names = done.stdout.split()
    return {".".join(name.split(".")[: 2 if name.startswith("swath.") else 1]) for name in names}


def test_importing_the_recorder_loads_no_processing_module() -> None:
    loaded = loaded_by(
        "import swath.daemon.recorder.run, swath.drivers.driver as r; [r.all_drivers(k) for k in r.KINDS]"
    )
    assert "swath.daemon" in loaded
    assert loaded & (PROCESSING_ONLY | {"swath.sim"}) == set()


def test_importing_the_command_line_loads_no_processing_or_simulator_module() -> None:
    commands = sorted(f"swath.daemon.cli.{path.stem}" for path in (ROOT / "daemon/cli").glob("[a-z]*.py"))
    assert {
        "swath.daemon.cli.georef",
        "swath.daemon.cli.live",
        "swath.daemon.cli.view",
        "swath.daemon.cli.warm_up",
    } <= set(commands)
    flying = ("plans", "into_log", "on_wires", "ahead")
    loaded = loaded_by(f"import {', '.join([*commands, *(f'swath.daemon.simulate.{name}' for name in flying)])}")
    assert "swath.daemon" in loaded
    assert loaded & (PROCESSING_ONLY | {"swath.sim"}) == set()


def test_few_modules_of_the_daemon_import_the_simulator() -> None:
    """The contract that keeps the recorder light lets only these and the folder of processing import it."""
    light = contract("the recorder stays light")
    assert light["source_modules"] == ["swath.daemon", "swath.drivers"]
    assert PROCESSING_ONLY | {"swath.sim"} <= set(light["forbidden_modules"])
    libraries = ["jinja2", "laspy", "matplotlib", "numba", "pyproj", "scipy", "weasyprint"]
    processing = ["swath.calib.**", "swath.georef.**", *libraries]
    assert light["ignore_imports"] == [
        "swath.drivers.scanner.rows.compiled -> numba",
        "swath.daemon.cli.check -> swath.georef.mapping.datums",
        "swath.daemon.simulate.plans -> swath.sim.**",
        "swath.daemon.processing.calibration.plan.run -> swath.sim.**",
        "swath.daemon.processing.calibration.plan.page -> swath.sim.**",
        "swath.daemon.processing.calibration.plan.navigation -> swath.sim.**",
        *(f"swath.daemon.processing.** -> {name}" for name in processing),
    ]
