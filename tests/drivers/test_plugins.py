"""Tests drivers of other packages: how they are found, refused, given their keys and kept from harming others."""

from __future__ import annotations

import ast
import copy
import dataclasses
import enum
import inspect
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import swath.drivers.interface
from swath.daemon.cli.main import run_app
from swath.daemon.config import parse_config
from swath.daemon.devices.identify import identify
from swath.daemon.doctor import other_drivers
from swath.daemon.errors import ConfigError
from swath.daemon.log.parsers import stored_config, stored_drivers
from swath.daemon.processing.setup.sources import Sources
from swath.drivers import plugins
from swath.drivers.driver import KINDS, all_drivers, find_driver, not_loaded
from swath.drivers.guard import GuardedParser, guarded
from swath.drivers.interface import (
    AIMED_RETURN_DTYPE,
    Chunk,
    ChunkBatch,
    DeviceSettings,
    DriverSettingsError,
    PacketParser,
    Parser,
    Record,
    ScannerReturns,
    StreamParser,
    TimeMessage,
)
from tests.builders import ROOT
from tests.drivers.site import ENTRIES, EXAMPLE, Site, site_at

SNAPSHOT = Path(__file__).with_name("interface-1.txt")
PAGE = ROOT / "docs/adding-a-device.md"
DECLARED = """
from swath.drivers.interface import *
class P(PacketParser):
    def parse_units(self, host_time_ns, units):
        return []
def driver(**changes):
    usual = dict(protocol="acme", kind="scanner", transports=("udp",), yields=(ScannerReturns,), summary="Acme",
                 make_parser=lambda settings: P(), aimed=True, interface=1)
    return Driver(**(usual | changes))
"""
CONFIG = """
[session]
name = "x"
directory = "logs"
[gnss.rover]
transport = "serial:/dev/ttyS9"
protocol = "example-receiver"
[gnss.rover.options]
heights = "geoid"
[scanner.left]
transport = "udp:127.0.0.1:2999"
protocol = "example-scanner"
installation = [[0, 0, 1], [0, -1, 0], [1, 0, 0]]
[scanner.left.options]
range_unit_mm = 4
"""


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with site_at(tmp_path / "site") as made:
        yield made


def lines_of(text: str) -> list[str]:
    """Return what is wrong with a configuration, without the file's name."""
    with pytest.raises(ConfigError) as caught:
        parse_config(text, Path("a.toml"))
    return [line.removeprefix("a.toml: ") for line in caught.value.lines]


class TestFinding:
    def test_drivers_of_a_package_stand_beside_those_of_swath(
        self, site: Site, capsys: pytest.CaptureFixture[str]
    ) -> None:
        site.install_example()
        assert find_driver("gnss", "nmea").package is None
        assert "swath_example" not in sys.modules, "a package was imported though its protocol was not asked for"
        assert str(find_driver("scanner", "example-scanner").package) == "swath-example 1.0"
        assert next(iter(all_drivers("scanner"))) == "example-scanner"
        assert run_app(["devices", "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        packages = {row["protocol"]: row["package"] for row in told["devices"] if row["package"]}
        assert packages == dict.fromkeys(ENTRIES, "swath-example 1.0")
        [options] = [row["options"] for row in told["devices"] if row["protocol"] == "example-receiver"]
        assert list(options) == ["heights"]
        assert options["heights"].startswith("what its heights count from")
        assert told["not_loaded"] == []
        with pytest.raises(LookupError, match=r"did you mean example-scanner\?"):
            find_driver("scanner", "exmaple-scanner")

    def test_the_list_of_commands_looks_for_no_driver(self) -> None:
        code = (
            "import sys; from swath.daemon.cli.main import run_app; run_app(['--help']); "
            "sys.exit('swath.drivers.plugins' in sys.modules)"
        )
        assert subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, check=False).returncode == 0

    def test_a_package_that_cannot_be_imported_costs_no_other_device(
        self, site: Site, capsys: pytest.CaptureFixture[str]
    ) -> None:
        site.install("acme-lidar", {"acme": "acme_lidar:DRIVER", "acme-two": "acme_lidar:DRIVER"}, "import nowhere\n")
        site.install("leaves", {"leaving": "leaves:DRIVER"}, "raise SystemExit(3)\n")
        site.install_example()
        why = (
            "package acme-lidar 1.0 is not loaded: ModuleNotFoundError: No module named 'nowhere'; install what it "
            "needs, or a version of it for this Swath, or uninstall it"
        )
        assert [(one.protocol, one.package.name) for one in not_loaded()] == [
            ("acme", "acme-lidar"),
            ("acme-two", "acme-lidar"),
            ("leaving", "leaves"),
        ]
        assert "example-scanner" in all_drivers("scanner")
        assert run_app(["devices"]) == 0
        assert f"acme: {why}\n" in capsys.readouterr().out
        assert f"protocol acme: {why}" in [finding.text for finding in other_drivers(None)]
        text = CONFIG.replace('"example-scanner"', '"acme"')
        needed = f"scanner.left.protocol: scanner protocol 'acme': {why}"
        assert lines_of(text) == [f"{needed}; meanwhile swath run records the device as it comes"]
        assert parse_config(text.replace('"acme"', '"raw"'), Path("a.toml")).scanner["left"].options

    def test_a_protocol_belongs_to_one_package(self, site: Site) -> None:
        code = DECLARED + "DRIVER = driver(protocol='nmea', kind='imu', yields=())\nACME = driver()\n"
        site.install("first", {"nmea": "first:DRIVER", "acme": "first:ACME"}, code)
        site.install("second", {"acme": "second:ACME"}, code)
        reasons = [str(one) for one in not_loaded()]
        assert reasons == [
            *(
                f"package {one} 1.0 is not loaded: first 1.0 and second 1.0 declare it; uninstall all but one"
                for one in ("first", "second")
            ),
            "package first 1.0 is not loaded: Swath itself has a protocol of this name, which is used; give the "
            "package's protocol another name",
        ]
        assert "acme" not in all_drivers("scanner")
        assert find_driver("gnss", "nmea").package is None

    @pytest.mark.parametrize(
        ("declared", "why"),
        [
            ("driver(interface=2)", "it is written for interface 2 of drivers, this Swath has 1; install a version"),
            ("driver(interface=None)", "it is written for no interface of drivers, this Swath has 1"),
            ("P", "its entry point names a ABCMeta; want a Driver"),
            ("()", "it declares no driver"),
            ("(driver(), driver())", "or two of one kind"),
            ("driver(protocol='other')", "its driver has the protocol 'other'; give the entry point the same name"),
            ("driver(kind='lidar')", "its lidar driver is of no kind; want one of gnss, imu, scanner"),
            ("driver(transports=('usb',))", r"names the transports \['usb'\]; want some of"),
            ("driver(transports=5)", "its driver cannot be read: 'int' object is not iterable"),
            ("driver(yields=(TimeMessage,))", "yields what such a device has not"),
            ("driver(options=dict)", "has options that are no subclass"),
            ("driver(future=True)", r"TypeError: Driver.__init__\(\) got an unexpected keyword argument 'future'"),
        ],
    )
    def test_a_driver_that_does_not_fit_is_refused_with_the_reason(self, site: Site, declared: str, why: str) -> None:
        site.install("acme", {"acme": "acme:DRIVER"}, f"{DECLARED}DRIVER = {declared}\n")
        [refused] = not_loaded()
        assert re.search(why, refused.reason), refused.reason
        assert "acme" not in all_drivers("scanner")

    def test_a_damaged_package_of_any_kind_leaves_swaths_own_drivers(self, site: Site) -> None:
        site.install("bad name", {"Bad Name": "nothing:X"})
        assert "single hyphens" in not_loaded()[0].reason
        site.install("other", {})
        (site.folder / "other-1.0.dist-info/entry_points.txt").write_bytes(b"[swath.drivers]\n\xff\xfe = \n")
        [fault] = not_loaded()
        assert "reinstall the damaged package" in fault.reason
        assert find_driver("gnss", "nmea")
        assert all(all_drivers(kind) for kind in KINDS)


class TestOptions:
    def test_a_drivers_own_keys_reach_its_parser(self, site: Site, tmp_path: Path) -> None:
        site.install_example()
        config = parse_config(CONFIG, tmp_path / "a.toml")
        for device in config.devices():
            parser = find_driver(device.kind, device.protocol).make_parser(device.settings)
            assert isinstance(parser, GuardedParser)
        receiver, scanner = config.devices()
        assert receiver.settings.config["options"] == {"heights": "geoid"}
        assert scanner.settings.config["options"] == {"range_unit_mm": 4}

    @pytest.mark.parametrize(
        ("old", "new", "lines"),
        [
            (
                "range_unit_mm = 4",
                'range_unt_mm = 4\nleast_intensity = "x"',
                [
                    'scanner.left.options.least_intensity: got "x", want a whole number >= 0 and <= 65535',
                    "scanner.left.options.range_unt_mm: unknown key; did you mean range_unit_mm?",
                ],
            ),
            ("range_unit_mm = 4", "range_unit_mm = 3", ["scanner.left.options.range_unit_mm: got 3, want 1, 2 or 4"]),
            ('"geoid"', '"sea"', ['gnss.rover.options.heights: got "sea", want "ellipsoid" or "geoid"']),
            (
                '"example-receiver"',
                '"nmea"',
                ["gnss.rover.options: nmea has no keys of its own; remove the table"],
            ),
            ("[gnss.rover.options]\nheights =", "options =", ['gnss.rover.options: got "geoid", want a table']),
            ("installation = [[0, 0, 1], [0, -1, 0], [1, 0, 0]]", "", ["scanner.left.installation: missing; …"]),
        ],
    )
    def test_a_wrong_key_is_one_line_with_its_path(self, site: Site, old: str, new: str, lines: list[str]) -> None:
        site.install_example()
        assert old in CONFIG
        found = [re.sub("missing; .*", "missing; …", line) for line in lines_of(CONFIG.replace(old, new))]
        assert sorted(found) == lines

    def test_a_device_inside_another_ones_stream_has_its_keys(self, site: Site) -> None:
        code = DECLARED + (
            "class O(Options):\n    rate: int\n"
            "UNIT = driver(kind='imu', transports=('serial',), yields=(ImuSamples, GnssFix), options=O, aimed=False)\n"
            "DRIVERS = (UNIT, receiver_inside(UNIT))\n"
        )
        site.install("acme", {"acme": "acme:DRIVERS"}, code)
        text = (
            '[session]\nname = "x"\n[imu.main]\ntransport = "serial:/dev/ttyS9"\nprotocol = "acme"\n'
            'options = { rate = 5 }\n[gnss.rover]\ntransport = "imu:main"\nprotocol = "acme"\n'
        )
        config = parse_config(text, Path("a.toml"))
        assert [one.settings.config["options"] for one in config.devices()] == [{"rate": 5}, {"rate": 5}]
        assert (
            lines_of(text.replace("rate = 5", "rate = 0.5"))
            == ["imu.main.options.rate: got 0.5, want a whole number"] * 2
        )
        assert (
            lines_of(text.replace("options = { rate = 5 }\n", ""))[0] == "imu.main.options.rate: missing; want a value"
        )


class TestLog:
    def test_a_log_names_the_package_that_its_reader_lacks(self, tmp_path: Path) -> None:
        with site_at(tmp_path / "site") as site:
            site.install_example()
            config = parse_config(CONFIG, tmp_path / "a.toml")
            attachments = {name: data for name, _, data in config.attachments()}
            assert list(Sources(config, attachments, ["left"]).scanner_time_parsers()) == ["scanner/left"]
            assert set(stored_drivers(attachments)[0]) == {"gnss/rover", "scanner/left"}
        missing = "is that of the package swath-example 1.0, which is not installed here; install it beside swath"
        makers, troubles = stored_drivers(attachments)
        assert makers == {}
        assert troubles == [
            f"gnss/rover: gnss protocol 'example-receiver' {missing}",
            f"scanner/left: scanner protocol 'example-scanner' {missing}",
        ]
        stored = stored_config(attachments)
        assert stored is not None
        with pytest.raises(ConfigError, match=f"gnss.rover.protocol: gnss protocol 'example-receiver' {missing}"):
            Sources(stored, attachments)
        for damaged in (b"\xff", b"[]", b'{"gnss/example-receiver": 5}'):
            assert "unknown gnss protocol" in stored_drivers(attachments | {"drivers.json": damaged})[1][0]

    def test_swaths_own_drivers_are_named_by_no_package(self, tmp_path: Path) -> None:
        text = '[session]\nname = "x"\n[gnss.rover]\ntransport = "serial:/dev/ttyS9"\nprotocol = "nmea"\n'
        assert [name for name, _, _ in parse_config(text, tmp_path / "a.toml").attachments()] == ["config.toml"]


class Raising(StreamParser):
    """Frames ten bytes of each unit, and fails on an x, on close, and in its lines for the user."""

    beams = "its own"

    def feed(self, chunk: Chunk) -> list[Record]:
        self.counters.bytes += len(chunk.data)
        self.counters.bytes_framed += 10
        if b"x" in chunk.data:
            raise ZeroDivisionError("on\nx")
        return []

    def remarks(self) -> list[str]:
        raise ValueError

    def close(self) -> list[Record]:
        raise KeyError("end")


class Returning(PacketParser):
    """Returns what the number of units tells."""

    def parse_units(self, host_time_ns: Any, units: Any) -> list[Record]:
        good = ScannerReturns(np.zeros(3, AIMED_RETURN_DTYPE))
        wrong = ScannerReturns(np.zeros(3, [("a", "f8")]))
        undeclared: Any = TimeMessage
        return [[good], [good, wrong], [good, undeclared], None][len(units) - 1]  # type: ignore[return-value]


class TestFaults:
    def test_what_a_parser_raises_is_counted_and_the_next_unit_is_read(self) -> None:
        parser = guarded(lambda settings: Raising(), "acme 1.0", ())(DeviceSettings("gnss/rover"))
        for data in (b"0123456789", b"x123456789ab", b"0123456789a"):
            assert parser.feed(Chunk("gnss/rover", 0, data)) == []
        assert (parser.counters.bytes, parser.counters.errors["driver_fault"]) == (33, 1)
        rows = np.frombuffer(b"x123456789" * 3, np.uint8).reshape(3, 10)
        assert parser.feed_batches([ChunkBatch("gnss/rover", np.zeros(3, np.int64), rows)]) == []
        assert parser.counters.errors["driver_fault"] == 4
        assert parser.close() == []
        counters = parser.counters
        assert counters.bytes == counters.bytes_framed + counters.bytes_skipped == 63
        assert parser.remarks() == [
            "gnss/rover: its driver, package acme 1.0, fails on its data and loses records: ZeroDivisionError: on x; "
            "tell the package's makers"
        ]
        assert copy.deepcopy(parser).beams == "its own"  # type: ignore[attr-defined]

    def test_only_declared_records_pass(self) -> None:
        parser = guarded(lambda settings: Returning(), "acme 1.0", (ScannerReturns,))(DeviceSettings("scanner/left"))
        for count in range(1, 5):
            units = np.zeros((count, 7), np.uint8)
            found = parser.feed_batch(ChunkBatch("scanner/left", np.zeros(count, np.int64), units))
            assert [len(record.rows) for record in found] == ([] if count == 4 else [3])  # type: ignore[union-attr]
        assert parser.counters.errors["driver_fault"] == 1 + 1 + 4
        assert parser.counters.bytes_skipped == 4 * 7

    @pytest.mark.parametrize("made", [5, ZeroDivisionError("at once"), DriverSettingsError("mend it")])
    def test_a_driver_that_makes_no_parser_is_a_wrong_setting(self, made: Any) -> None:
        def make(settings: DeviceSettings) -> Parser:
            if isinstance(made, Exception):
                raise made
            return made  # type: ignore[no-any-return]

        with pytest.raises(DriverSettingsError, match=r"package acme 1\.0, fails: (Type|ZeroDiv)|^mend it$"):
            guarded(make, "acme 1.0", ())(DeviceSettings("gnss/rover"))


class TestExample:
    """The package of docs/adding-a-device.md; tests/test_plugin_package.py installs and runs it."""

    def test_its_stream_is_recognised_where_another_protocol_is_configured(self, site: Site) -> None:
        site.install_example()
        from swath_example import receiver  # type: ignore[import-not-found]

        text = '[session]\nname = "x"\n[gnss.rover]\ntransport = "serial:/dev/ttyS9"\nprotocol = "nmea"\n'
        [entry] = parse_config(text, Path("a.toml")).devices()
        data = np.frombuffer(receiver.encode(2400, 0, 47.0, 9.0, 500.0) * 5, np.uint8)[np.newaxis]
        assert identify(entry, [ChunkBatch("gnss/rover", np.zeros(1, np.int64), data)], than=0) == "example-receiver"

    def test_it_imports_nothing_of_swath_but_the_interface(self) -> None:
        files = [*EXAMPLE.rglob("*.py")]
        assert len(files) == 4
        for path in files:
            for node in ast.walk(ast.parse(path.read_text())):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
                assert [name for name in names if name.startswith("swath.")] in ([], ["swath.drivers.interface"]), path

    def test_the_page_shows_its_files_as_they_are(self) -> None:
        page = PAGE.read_text()
        blocks = {block.strip() for block in re.findall(r"^```(?:python|toml)\n(.*?)^```$", page, re.M | re.S)}
        for name in ("pyproject.toml", "swath_example/scanner.py", "swath_example/receiver.py"):
            assert (EXAMPLE / name).read_text().strip() in blocks, f"write {name} into the page as it is"
        test = (EXAMPLE / "tests/test_swath_example.py").read_text()
        assert any(block in test for block in blocks if block.startswith("@pytest")), "show a part of the test"


def interface_lines() -> list[str]:
    """Return each name of the interface with what a driver may rely on: fields, arguments, values."""
    lines: list[str] = []
    for name in swath.drivers.interface.__all__:
        thing: Any = getattr(swath.drivers.interface, name)
        if isinstance(thing, np.dtype):
            lines += [f"{name}.{field}: {thing[field]}" for field in thing.names or ()]
        elif isinstance(thing, type) and issubclass(thing, enum.Enum):
            lines += [f"{name}.{one.name} = {one.value!r}" for one in thing]
        elif fields := getattr(thing, "_fields", ()):  # of a named tuple
            defaults = getattr(thing, "_field_defaults", {})
            lines += [name, *(f"{name}.{field}{' = …' * (field in defaults)}" for field in fields)]
        elif inspect.isclass(thing):
            lines += [f"{name}{_bases(thing)}", *(f"{name}.{line}" for line in _members(thing))]
        elif inspect.isfunction(thing):
            lines.append(f"{name}{inspect.signature(thing)}")
        elif isinstance(thing, int | str | tuple):
            lines.append(f"{name} = {thing!r}")
        else:
            lines.append(name)  # a type alias, or a kind of frames
    return lines


def _bases(thing: type) -> str:
    bases = [base.__name__ for base in thing.__bases__ if base.__module__.startswith("swath.")]
    return f"({', '.join(bases)})" if bases else ""


def _members(thing: Any) -> Iterator[str]:
    if dataclasses.is_dataclass(thing):
        for field in dataclasses.fields(thing):
            optional = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
            yield f"{field.name}: {field.type}{'' if optional else ' = …'}"
    elif thing.__name__ not in ("Options", "DriverSettingsError") and thing.__init__ is not object.__init__:
        yield f"__init__{inspect.signature(thing.__init__)}"
    for name, member in sorted(vars(thing).items()):
        if not name.startswith("_") and (inspect.isfunction(member) or isinstance(member, property)):
            yield f"{name}{'' if isinstance(member, property) else inspect.signature(member)}"


def test_the_interface_is_that_of_its_number() -> None:
    """Hold what the file says until `INTERFACE` gets another number; new names and fields are added to the file."""
    assert SNAPSHOT.name == f"interface-{swath.drivers.interface.INTERFACE}.txt"
    now, then = interface_lines(), SNAPSHOT.read_text().splitlines()
    gone = [line for line in then if line not in now]
    assert gone == [], "drivers of other packages rely on these: keep them, or raise INTERFACE and write a new file"
    assert now == then, f"write the additions into {SNAPSHOT.name}"


def test_the_page_names_the_whole_interface() -> None:
    page = PAGE.read_text()
    assert [name for name in swath.drivers.interface.__all__ if f"`{name}`" not in page] == []


def test_the_group_of_entry_points_is_the_one_of_the_page() -> None:
    assert f'[project.entry-points."{plugins.GROUP}"]' in PAGE.read_text()
