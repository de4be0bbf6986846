"""Tests the configuration: the complete example, every bad one with its lines, and the page that documents it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel

from swath.daemon.config import Config, Tables, load_config, parse_config
from swath.daemon.config.checks import same_wire
from swath.daemon.config.faults import _model_in
from swath.daemon.config.load import MAX_CONFIG_BYTES, validate
from swath.daemon.config.rotations import matrix_of_deg, rotation_problem
from swath.daemon.errors import ConfigError, ExitCode, UserError
from swath.daemon.log.directory import log_directory
from swath.daemon.log.parsers import stored_parsers
from swath.daemon.processing.setup.models import mount_of
from swath.drivers.driver import RAW, all_drivers
from swath.drivers.transports.spec import parse_transport

ROOT = Path(__file__).parents[3]
FIXTURES = ROOT / "fixtures/config"
AIRCRAFT = FIXTURES / "aircraft.toml"
BAD = sorted((FIXTURES / "bad").glob("*.toml"))


def expected_lines(path: Path) -> list[str]:
    """Return the lines that a bad file expects, from its comments."""
    words = {
        "here": str(path.parent),
        "gnss": ", ".join(sorted([*all_drivers("gnss"), RAW])),
        "scanner": ", ".join(sorted([*all_drivers("scanner"), RAW])),
        "nmea": ", ".join(all_drivers("gnss")["nmea"].transports),
    }
    lines = re.findall(r"^# expect: (.*)$", path.read_text(), flags=re.MULTILINE)
    return [f"{path}: {line.format(**words) if '{' in line else line}" for line in lines]


def _shortened(lines: list[str], expected: list[str]) -> list[str]:
    """Return lines cut where an expected one ends in …, because the rest is another library's wording."""
    begins = [line.removesuffix("…") for line in expected if line.endswith("…")]
    return [next((f"{begin}…" for begin in begins if line.startswith(begin)), line) for line in lines]


def with_session(text: str) -> str:
    return f'[session]\nname = "x"\n{text}'


class TestWholeFile:
    def test_an_empty_gimbal_is_a_rigid_mount_and_a_byte_order_mark_is_ignored(self, tmp_path: Path) -> None:
        text = with_session(
            '[scanner.left]\ntransport = "udp:0.0.0.0:2368"\nprotocol = "srep"\nmirror_factor = 1.0\n'
            "[scanner.left.gimbal]\n"
        )
        (tmp_path / "windows.toml").write_text(text, encoding="utf-8-sig")
        config = load_config(tmp_path / "windows.toml")
        assert mount_of(config.scanner["left"].gimbal).stages == ()

    def test_the_example_is_valid_and_keeps_its_values(self) -> None:
        config = load_config(AIRCRAFT)
        assert config.session.name == "thurgau-north"
        assert config.session.directory == "/var/lib/swath"
        assert config.gnss["rover"].lever_arm_m == [0.10, -0.05, -1.20]
        assert config.imu["main"].signals is not None
        assert config.imu["main"].signals.sample_ticks == "SAMPLE.ticks"
        assert config.scanner["left"].range_max_m == 3000.0
        assert config.output.epoch == 2026.9
        assert config.text == AIRCRAFT.read_text()

    def test_the_example_names_every_key(self) -> None:
        table = tomllib.loads(AIRCRAFT.read_text())
        assert set(_absent_keys(Tables, table, "")) == {  # each of these excludes a key of the example
            "gnss.*.setup.port",
            "gnss.*.options",  # these are keys of drivers that are not Swath's
            "imu.*.options",
            "scanner.*.options",
            "corrections.*.options",
            "imu.*.imu_type",
            "imu.*.source_address",
            "imu.*.units",
            "imu.*.rotation_b_imu_deg",
            "scanner.*.installation_deg",
            "imu.*.ids",
            "imu.*.extended_ids",
            "imu.*.byte_order",
            "imu.*.pps_event",
            "imu.*.altitude",
            "imu.*.acceleration_unit",
            "imu.*.solution_of",
            "scanner.*.geometry.facets",
            "scanner.*.geometry.nutation_deg",
            "scanner.*.geometry.shaft_angle_deg",
            "scanner.*.geometry.wedge_deg",
            "scanner.*.geometry.refractive_index",
            "scanner.*.geometry.prism_ratio",
            "scanner.*.geometry.file",
            "scanner.*.gimbal.stages.source",
            "attitude.xi_arcsec",
            "attitude.eta_arcsec",
            "plan.file",
            "plan.layer",
            "plan.area",
        }

    def test_a_session_alone_is_enough_and_has_the_documented_defaults(self, tmp_path: Path) -> None:
        config = parse_config(with_session(""), tmp_path / "a.toml")
        session = config.session
        assert (session.split_size_mb, session.split_minutes, session.fsync_s, session.reserve_mb) == (2048, 30, 1, 512)
        assert (session.directory, session.compression) == ("/var/lib/swath", "auto")
        assert list(config.devices()) == []
        assert config.atmosphere.pressure_hpa == 1013.25

    def test_a_relative_log_directory_is_relative_to_the_file(self, tmp_path: Path) -> None:
        config = parse_config(with_session('directory = "logs"'), tmp_path / "a.toml")
        assert config.session.directory == str(tmp_path / "logs")

    def test_integers_are_accepted_as_numbers_and_text_is_not(self, tmp_path: Path) -> None:
        assert parse_config(with_session("fsync_s = 2"), tmp_path / "a.toml").session.fsync_s == 2.0
        with pytest.raises(ConfigError, match='fsync_s: got "2", want a number'):
            parse_config(with_session('fsync_s = "2"'), tmp_path / "a.toml")

    def test_loading_a_configuration_imports_no_heavy_module(self) -> None:
        """No DBC is configured, so cantools is not needed either; georeferencing is never needed."""
        code = (
            "import sys; from pathlib import Path; from swath.daemon.config import parse_config; "
            'parse_config(\'[session]\\nname="x"\\n[scanner.left]\\ntransport="udp:0.0.0.0:2368"\\n'
            "protocol=\"srep\"\\nmirror_factor=2\\n', Path('/tmp/a.toml')); "
            "print([m for m in ('cantools', 'scipy', 'numba', 'pyproj', 'serial', 'mcap', 'rich') if m in sys.modules])"
        )
        run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
        assert run.stdout.strip() == "[]"


class TestBadFiles:
    @pytest.mark.parametrize("path", BAD, ids=[path.stem for path in BAD])
    def test_each_finding_is_one_line(self, path: Path) -> None:
        expected = expected_lines(path)
        assert expected, f"{path} says nothing of what to expect"
        with pytest.raises(ConfigError) as caught:
            load_config(path, with_plan=True)
        assert sorted(_shortened(caught.value.lines, expected)) == sorted(expected)
        assert caught.value.exit_code is ExitCode.USAGE
        assert all("\n" not in line for line in caught.value.lines)

    def test_error_for_a_nested_key_gives_its_path(self, tmp_path: Path) -> None:
        text = with_session('[imu.main]\ntransport = "can:can0"\nprotocol = "dbc"\ndbc = "a.dbc"\ngrade = "mems"\n')
        with pytest.raises(ConfigError, match=r"imu\.main\.grade: unknown key; did you mean noise\.grade\?"):
            parse_config(text, tmp_path / "a.toml")

    @pytest.mark.parametrize("name", ["gone.kml", "/", "a\\u0000.kml"])
    def test_a_plan_that_is_missing_is_missed_only_where_it_is_needed(self, tmp_path: Path, name: str) -> None:
        """In the office the plan's file is elsewhere; a log that shall hold it, and live over such a log, need it."""
        path = tmp_path / "a.toml"
        path.write_text(with_session(f'directory = "."\n[plan]\nfile = "{name}"\n'))
        config = load_config(path)
        assert [attachment for attachment, _, _ in config.attachments()] == ["config.toml"]
        assert log_directory(path) == tmp_path
        for options in ({"to_record": True}, {"with_plan": True}):
            with pytest.raises(ConfigError, match=r"plan\.file: .*give a file, relative to the configuration"):
                load_config(path, **options)

    def test_a_missing_file_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(UserError, match=r"nowhere\.toml: No such file or directory") as caught:
            load_config(tmp_path / "nowhere.toml")
        assert caught.value.exit_code is ExitCode.USAGE

    def test_a_directory_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(UserError, match="Is a directory"):
            load_config(tmp_path)

    def test_a_file_that_is_not_utf_8_is_refused(self, tmp_path: Path) -> None:
        path = tmp_path / "a.toml"
        path.write_bytes(b"[session]\nname = \xff\xfe\n")
        with pytest.raises(ConfigError, match="line 2: not UTF-8"):
            load_config(path)

    def test_a_log_given_by_mistake_is_not_read_completely(self, tmp_path: Path) -> None:
        path = tmp_path / "a.mcap"
        with path.open("wb") as stream:
            stream.truncate(MAX_CONFIG_BYTES * 1000)
        with pytest.raises(ConfigError, match="larger than"):
            load_config(path)

    def test_a_serial_device_behind_a_symbolic_link_is_the_same_device(self, tmp_path: Path) -> None:
        main, secondary = os.openpty()
        try:
            device = os.ttyname(secondary)
            link = tmp_path / "rover"
            link.symlink_to(device)
            text = with_session(
                f'[gnss.a]\ntransport = "serial:{device}"\nprotocol = "nmea"\n'
                f'[gnss.b]\ntransport = "serial:{link}"\nprotocol = "nmea"\n'
            )
            with pytest.raises(ConfigError) as caught:
                parse_config(text, tmp_path / "a.toml")
        finally:
            os.close(main)
            os.close(secondary)
        want = f"gnss.a.transport and gnss.b.transport: both use the device {device}; give each its own"
        assert caught.value.lines == [f"{tmp_path}/a.toml: {want}"]

    def test_a_pps_on_the_line_of_its_receiver_is_fine(self, tmp_path: Path) -> None:
        text = with_session(
            '[pps.main]\nsource = "serial-dcd:/dev/ttyS0"\n'
            '[gnss.a]\ntransport = "serial:/dev/ttyS0"\nprotocol = "nmea"\npps = "main"\n'
        )
        assert parse_config(text, tmp_path / "a.toml").gnss["a"].pps == "main"


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("udp:0.0.0.0:2368", "udp:0.0.0.0:2368?buffer_mb=4", True),
        ("udp:0.0.0.0:2368", "udp:192.168.1.5:2368", True),
        ("udp:192.168.1.5:2368", "udp:192.168.2.5:2368", False),
        ("udp:0.0.0.0:2368?group=239.1.2.3", "udp:0.0.0.0:2368?group=239.1.2.4", False),
        ("udp:0.0.0.0:2368?group=239.1.2.3", "udp:0.0.0.0:2368?group=239.1.2.3", True),
        ("udp:0.0.0.0:2368", "udp:0.0.0.0:2369", False),
        ("udp:0.0.0.0:2368?source=10.0.0.1", "udp:0.0.0.0:2368?source=10.0.0.2", False),
        ("udp:0.0.0.0:2368?source=10.0.0.1", "udp:0.0.0.0:2368?source=10.0.0.1", True),
        ("udp:0.0.0.0:2368?source=10.0.0.1", "udp:0.0.0.0:2368", True),
        ("udp:0.0.0.0:2368?source=10.0.0.1", "udp:10.0.0.9:2368?source=10.0.0.2", True),
        ("udp:0.0.0.0:1?group=239.1.2.3&source=10.0.0.1", "udp:0.0.0.0:1?group=239.1.2.3&source=10.0.0.2", False),
        ("udp:0.0.0.0:1?group=239.1.2.3&source=10.0.0.1", "udp:0.0.0.0:1?source=10.0.0.2", True),
        ("tcp:10.0.0.1:2368", "tcp:10.0.0.1:2368?silent_s=60", True),
        ("tcp:10.0.0.1:2368", "tcp:10.0.0.1:2369", False),
        ("can:socketcan:can0", "can:socketcan:can0?bitrate=500000", True),
        ("can:socketcan:can0", "can:socketcan:can1", False),
        ("can:udp_multicast:239.74.163.2?port=4001", "can:udp_multicast:239.74.163.2?port=4002", False),
        ("can:slcan:/dev/null", "serial:/dev/null?baud=9600", True),
        ("serial:/dev/null", "can:socketcan:can0", False),
    ],
)
def test_addresses_of_the_same_wire_are_recognised(one: str, other: str, same: bool) -> None:
    assert same_wire(parse_transport(one), parse_transport(other)) is same
    assert same_wire(parse_transport(other), parse_transport(one)) is same


def test_rotations_of_seven_digits_are_accepted_and_less_precise_ones_refused() -> None:
    assert rotation_problem([[0.7071068, -0.7071068, 0], [0.7071068, 0.7071068, 0], [0, 0, 1]]) is None
    assert rotation_problem([[0, 1, 0], [0, 0, 1], [1, 0, 0]]) is None
    assert rotation_problem([[0.7071, -0.7071, 0], [0.7071, 0.7071, 0], [0, 0, 1]]) == (
        "not a rotation: row 1 has length 0.99999041, want 1; the nearest rotation is "
        "[[0.7071068, -0.7071068, 0], [0.7071068, 0.7071068, 0], [0, 0, 1]]"
    )
    sheared = rotation_problem([[1, 0.001, 0], [0, 1, 0], [0, 0, 1]])
    assert str(sheared).endswith("the nearest rotation is [[0.9999999, 0.0005, 0], [-0.0005, 0.9999999, 0], [0, 0, 1]]")
    assert "nearest" not in str(rotation_problem([[1, 0, 0], [0, 2, 0], [0, 0, 1]]))
    assert "reflection" in str(rotation_problem([[0, 1, 0], [1, 0, 0], [0, 0, 1]]))
    assert "length 0" in str(rotation_problem([[0, 0, 0], [0, 1, 0], [0, 0, 1]]))


HALF, ROOT_3 = 0.5, 0.75**0.5


@pytest.mark.parametrize(
    ("angles_deg", "rows"),
    [  # by hand: where the device's x, y and z axes (the columns) point in forward, right, down
        ([0, 0, 0], [[1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        ([90, 0, 0], [[1, 0, 0], [0, 0, -1], [0, 1, 0]]),  # right side down: y points down, z left
        ([0, 90, 0], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),  # nose up: x points up, z forward
        ([0, 0, 90], [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),  # turned to the right: x points right, y backward
        ([0, 0, 30], [[ROOT_3, -HALF, 0], [HALF, ROOT_3, 0], [0, 0, 1]]),
        ([360, -360, -90], [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
        ([90, 0, 90], [[0, 0, 1], [1, 0, 0], [0, 1, 0]]),  # roll, then yaw about the body's z: x right, y down
        ([90, 90, 0], [[0, 1, 0], [0, 0, -1], [-1, 0, 0]]),  # roll, then pitch about the body's y: x up, y forward
    ],
)
def test_angles_of_a_mounting_turn_about_the_axes_of_the_body(
    angles_deg: list[float], rows: list[list[float]], tmp_path: Path
) -> None:
    text = with_session(
        f'[imu.main]\ntransport = "can:socketcan:can0"\nprotocol = "canmod-gps"\nrotation_b_imu_deg = {angles_deg}\n'
        '[scanner.left]\ntransport = "udp:0.0.0.0:2368"\nprotocol = "velodyne-vlp16"\n'
        f"installation_deg = {angles_deg}\n"
    )
    config = parse_config(text, tmp_path / "a.toml")
    for matrix in (config.imu["main"].rotation_b_imu, config.scanner["left"].installation):
        assert matrix is not None
        for row, wanted in zip(matrix, rows, strict=True):
            assert row == pytest.approx(wanted, abs=1e-12)
    if all(angle % 90 == 0 for angle in angles_deg):
        assert matrix_of_deg(angles_deg) == rows, "exactly"


def test_angles_of_a_mounting_beside_a_matrix_are_refused(tmp_path: Path) -> None:
    head = '[scanner.left]\ntransport = "udp:0.0.0.0:2368"\nprotocol = "velodyne-vlp16"\n'
    both = "installation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\ninstallation_deg = [0, 0, 0]\n"
    with pytest.raises(ConfigError, match=r"scanner.left: installation and installation_deg are both given; keep one"):
        parse_config(with_session(head + both), tmp_path / "a.toml")
    with pytest.raises(ConfigError, match=r'installation_deg\[1\]: got "90", want a number'):
        parse_config(with_session(head + 'installation_deg = [0, "90", 0]\n'), tmp_path / "a.toml")


@pytest.mark.parametrize(
    ("head", "key", "line"),
    [
        (
            "imu.main",
            "rotation_b_imu_deg = [400, 0, 0]",
            "400° is more than a whole turn; give -360 to 360 (40°, if it",
        ),
        (
            "scanner.l",
            "installation_deg = [0, 0, -361.5]",
            "-361.5° is more than a whole turn; give -360 to 360 (-1.5°",
        ),
        ("scanner.l", "gimbal.stages = [{angles_deg = [0, 1e7, 0]}]", "1e+07° is more than a whole turn; give -360 to"),
        (
            "scanner.l",
            'geometry = {type = "risley", wedge_deg = [3, 120]}',
            "120° is no prism's; give the angle between",
        ),
        ("scanner.l", "installation_deg = [0, nan, 0]", "got NaN, want a finite number"),
    ],
)
def test_angles_beyond_a_turn_are_refused(head: str, key: str, line: str, tmp_path: Path) -> None:
    devices = {
        "imu.main": 'transport = "can:socketcan:can0"\nprotocol = "canmod-gps"\n',
        "scanner.l": 'transport = "udp:0.0.0.0:2368"\nprotocol = "srep"\n',
    }
    with pytest.raises(ConfigError) as refused:
        parse_config(with_session(f"[{head}]\n{devices[head]}{key}\n"), tmp_path / "a.toml")
    assert line in str(refused.value)
    assert str(refused.value).startswith(f"{tmp_path / 'a.toml'}: {head}.{key.partition(' ')[0].partition('.')[0]}")


TOML_VALUES = st.recursive(
    st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=20)
    | st.datetimes()
    | st.sampled_from(
        ["serial:/dev/ttyS0", "udp:0.0.0.0:1", "can:socketcan:can0", "gnss:rover", "fixed:x", "novatel", 10**400]
    ),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)


class TestArbitraryInput:
    """Any content is valid or reported in single lines."""

    @pytest.mark.slow
    @settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])
    @given(data=st.data())
    def test_any_value_is_valid_or_reported_in_one_line(self, data: st.DataObject) -> None:
        table = tomllib.loads(AIRCRAFT.read_text())
        for _ in range(data.draw(st.integers(1, 3))):
            place: dict[str, Any] = table
            while True:
                key = data.draw(st.sampled_from(sorted(place)) if place else st.text(max_size=5))
                if not isinstance(place.get(key), dict) or (data.draw(st.booleans()) and key != "session"):
                    break
                place = place[key]
            place[data.draw(st.just(key) | st.text(max_size=8))] = data.draw(TOML_VALUES)
        lines = _findings(table)
        assert all(line.startswith(f"{AIRCRAFT}: ") and len(line.splitlines()) == 1 for line in lines)

    def test_an_endlessly_nested_file_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(ConfigError, match=r"a\.toml: not"):
            parse_config("a = " + "[" * 100_000, tmp_path / "a.toml")


class TestDevices:
    @pytest.fixture
    def config(self) -> Config:
        return load_config(AIRCRAFT)

    def test_devices_have_all_settings_of_a_recorder(self, config: Config) -> None:
        devices = {device.source: device for device in config.devices()}
        assert list(devices) == ["gnss/rover", "imu/main", "scanner/left", "corrections/base", "raw/radar"]
        imu, scanner = devices["imu/main"], devices["scanner/left"]
        assert (imu.transport.kind, imu.transport.address) == ("can", "socketcan:can0")
        assert imu.files == {"dbc": FIXTURES / "imu.dbc"}
        assert imu.settings.files == {"dbc": (FIXTURES / "imu.dbc").read_bytes()}
        assert imu.settings.config["signals"]["pps_ticks"] == "SYNC.pps_ticks"
        assert scanner.auxiliary is not None
        assert scanner.auxiliary.port == 8308
        assert scanner.pps == "main"
        assert scanner.settings.source == "scanner/left"
        assert scanner.settings.config["mirror_factor"] == 1.0

    def test_a_device_inside_a_gnss_stream_has_no_wire_of_its_own(self, tmp_path: Path) -> None:
        text = with_session(
            '[gnss.rover]\ntransport = "serial:/dev/ttyUSB0"\nprotocol = "novatel"\n'
            '[imu.main]\ntransport = "gnss:rover"\nprotocol = "novatel"\n'
        )
        devices = list(parse_config(text, tmp_path / "a.toml").devices())
        assert devices[1].transport.kind == "gnss"

    def test_attachments_are_named_as_in_the_log_format(self, config: Config) -> None:
        attachments = {name: data for name, _, data in config.attachments()}
        assert attachments == {
            "config.toml": AIRCRAFT.read_bytes(),
            "dbc/imu.dbc": (FIXTURES / "imu.dbc").read_bytes(),
            "calibration/left.toml": (FIXTURES / "left.toml").read_bytes(),
        }

    def test_a_geometry_file_keeps_its_suffix(self, tmp_path: Path) -> None:
        (tmp_path / "head-77.json").write_text("{}")
        text = with_session(
            '[scanner.left]\ntransport = "udp:0.0.0.0:1"\nprotocol = "srep"\nmirror_factor = 2\n'
            '[scanner.left.geometry]\nfile = "head-77.json"\n'
        )
        config = parse_config(text, tmp_path / "a.toml")
        assert ("geometry/left.json", "application/json", b"{}") in config.attachments()
        assert next(config.devices()).settings.files == {"geometry": b"{}"}

    def test_a_parser_can_be_made_from_the_attachments_of_a_log(self, tmp_path: Path) -> None:
        """An Ouster head's metadata is attached to every log."""
        metadata = (ROOT / "fixtures/ouster/crc_test.json").read_bytes()
        (tmp_path / "os0.json").write_bytes(metadata)
        text = with_session(
            '[scanner.roof]\ntransport = "udp:0.0.0.0:7502"\nprotocol = "ouster"\n'
            "installation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n"
            '[scanner.roof.geometry]\nfile = "os0.json"\n'
        )
        attachments = {name: data for name, _, data in parse_config(text, tmp_path / "a.toml").attachments()}
        assert attachments["geometry/roof.json"] == metadata
        parsers, troubles = stored_parsers(attachments)
        assert (list(parsers), troubles) == (["scanner/roof"], [])
        del attachments["geometry/roof.json"]
        assert stored_parsers(attachments)[1] == [
            "scanner/roof: geometry.file: missing; want the head's metadata, a JSON file"
        ]


class TestPage:
    """docs/configuration.md and the models agree."""

    PAGE = (ROOT / "docs/configuration.md").read_text()

    def test_every_key_stands_in_its_section_and_no_other(self) -> None:
        assert _page_keys(self.PAGE) == _model_keys()

    def test_bounds_and_meanings_match_the_models(self) -> None:
        for section, model in _sections(Tables, "").items():
            for key, field in model.model_fields.items():
                if _model_in(field.annotation) is not None and field.description is None:
                    continue
                row = _page_row(self.PAGE, section, key)
                assert (field.description or "").replace("|", "\\|") in row, f"[{section}] {key}"
                for item in field.metadata:
                    for attribute in ("ge", "gt", "le", "lt"):
                        bound = getattr(item, attribute, None)
                        assert bound is None or f"{bound:.10g}" in row, f"[{section}] {key}: {bound}"


def _findings(table: dict[str, Any]) -> list[str]:
    """Return what is wrong with a table; if nothing is, check that its devices are usable."""
    try:
        config = validate(table, AIRCRAFT, "")
    except ConfigError as error:
        return error.lines or ["an error without a line"]
    count = len(config.gnss) + len(config.imu) + len(config.scanner) + len(config.corrections) + len(config.raw)
    assert len(list(config.devices())) == count
    return []


def _sections(model: type[BaseModel], prefix: str) -> dict[str, type[BaseModel]]:
    """Return section names as the page writes them, and their models."""
    found: dict[str, type[BaseModel]] = {}
    for key, field in model.model_fields.items():
        inner = _model_in(field.annotation)
        if inner is None:
            continue
        name = f"{prefix}{key}"
        if str(field.annotation).startswith("dict["):
            name += ".<name>"
        found[name] = inner
        found |= _sections(inner, f"{name}.")
    return found


def _model_keys() -> dict[str, list[str]]:
    return {section: list(model.model_fields) for section, model in _sections(Tables, "").items()}


def _page_keys(page: str) -> dict[str, list[str]]:
    keys: dict[str, list[str]] = {}
    for block in re.split(r"^### ", page, flags=re.MULTILINE)[1:]:
        heading = re.match(r"\[([^\]]+)\]", block)
        if heading:
            keys[heading[1]] = re.findall(r"^\| `(\w+)` \|", block, flags=re.MULTILINE)
    return keys


def _page_row(page: str, section: str, key: str) -> str:
    block = page.split(f"### [{section}]\n", 1)[1].split("\n### ", 1)[0]
    row = re.search(rf"^\| `{key}` \|.*$", block, flags=re.MULTILINE)
    assert row, f"[{section}] {key} is not on the page"
    return row[0]


def _absent_keys(model: type[BaseModel], table: dict[str, object], prefix: str) -> list[str]:
    """Return keys of the models that a file does not use."""
    absent: list[str] = []
    for key, field in model.model_fields.items():
        if key not in table:
            absent.append(f"{prefix}{key}")
            continue
        inner, value = _model_in(field.annotation), table[key]
        if inner is None:
            continue
        if str(field.annotation).startswith("dict["):
            assert isinstance(value, dict)
            absent += _absent_keys(inner, next(iter(value.values())), f"{prefix}{key}.*.")
        elif isinstance(value, list):
            absent += _absent_keys(inner, value[0], f"{prefix}{key}.")
        else:
            assert isinstance(value, dict)
            absent += _absent_keys(inner, value, f"{prefix}{key}.")
    return absent
