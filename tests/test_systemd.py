"""Tests the unit and the files installed with it by systemd's own checkers."""

from __future__ import annotations

import configparser
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.builders import SYSTEMD
from tests.daemon.rig import HANGS_S

UNIT = SYSTEMD / "swathd.service"
LIVE = SYSTEMD / "swath-live.service"
CONSOLE = SYSTEMD / "swath-console.service"
PPS = SYSTEMD / "swath-pps@.service"
HARDENING = [
    "CapabilityBoundingSet", "AmbientCapabilities", "NoNewPrivileges", "ProtectSystem", "ProtectHome",
    "PrivateTmp", "PrivateMounts", "ProtectKernelTunables", "ProtectKernelModules", "ProtectKernelLogs",
    "ProtectControlGroups", "ProtectHostname", "ProtectProc", "ProcSubset", "PrivateUsers",
    "RestrictNamespaces", "RestrictSUIDSGID", "LockPersonality", "RemoveIPC", "KeyringMode", "DevicePolicy",
    "SystemCallArchitectures", "SystemCallErrorNumber", "RestrictRealtime", "UMask", "User", "Group",
]  # fmt: skip


def run_tool(*command: str | Path) -> subprocess.CompletedProcess[str]:
    """Run one of systemd's tools; its absence is a failure that says what to install."""
    if shutil.which(str(command[0])) is None:
        pytest.fail(f"{command[0]} is missing: apt-get install systemd")
    return subprocess.run([str(word) for word in command], capture_output=True, text=True, timeout=HANGS_S, check=False)


def unit_values(key: str, unit: Path = UNIT) -> list[str]:
    """Return all values of a key of the unit, in order."""
    return re.findall(rf"^{key}=(.*)$", unit.read_text(), flags=re.MULTILINE)


@pytest.fixture
def unit_with_program(tmp_path: Path) -> Path:
    """Return the unit with a program that exists, because the checker looks for it; the live unit is beside it."""
    program = tmp_path / "opt/swath/bin/swath"
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    for unit in (UNIT, LIVE):
        (tmp_path / unit.name).write_text(unit.read_text().replace("/opt/swath", str(tmp_path / "opt/swath")))
    return tmp_path / UNIT.name


def test_the_unit_passes_verification(unit_with_program: Path) -> None:
    found = run_tool("systemd-analyze", "verify", "--man=no", unit_with_program)
    assert (found.returncode, found.stderr, found.stdout) == (0, "", "")


def test_verification_detects_an_unknown_key(unit_with_program: Path) -> None:
    unit_with_program.write_text(unit_with_program.read_text().replace("WatchdogSec=", "WatchdogSecs="))
    assert "WatchdogSecs" in run_tool("systemd-analyze", "verify", "--man=no", unit_with_program).stderr


def test_exposure_is_at_most_two() -> None:
    found = run_tool("systemd-analyze", "security", "--offline=true", "--threshold=20", "--no-pager", UNIT)
    level = re.search(r"Overall exposure level for swathd\.service: ([0-9.]+)", found.stdout)
    assert level is not None, found.stderr
    assert float(level.group(1)) <= 2.0
    assert found.returncode == 0


class TestLive:
    """The live georeferencer's unit is checked beside the recorder's."""

    def test_the_unit_passes_verification(self, unit_with_program: Path) -> None:
        found = run_tool("systemd-analyze", "verify", "--man=no", unit_with_program.with_name(LIVE.name))
        assert (found.returncode, found.stderr, found.stdout) == (0, "", "")

    def test_exposure_is_at_most_one(self) -> None:
        found = run_tool("systemd-analyze", "security", "--offline=true", "--threshold=10", "--no-pager", LIVE)
        assert "Overall exposure level for swath-live.service" in found.stdout, found.stderr
        assert found.returncode == 0, found.stdout

    def test_the_unit_depends_on_the_recorder_and_not_the_reverse(self) -> None:
        for key in ("BindsTo", "PartOf", "After"):
            assert unit_values(key, LIVE) == ["swathd.service"], key
        assert "swath-live" not in UNIT.read_text()
        assert unit_values("WantedBy", LIVE) == ["swathd.service"]

    def test_the_unit_yields_to_everything_else(self) -> None:
        assert unit_values("Nice", LIVE) == ["10"]
        assert unit_values("IOSchedulingClass", LIVE) == ["idle"]
        assert unit_values("CPUSchedulingPolicy", LIVE) == ["other"]
        assert int(unit_values("OOMScoreAdjust", LIVE)[0]) > int(unit_values("OOMScoreAdjust")[0])

    def test_the_unit_may_write_only_beside_the_logs_and_into_its_cache(self) -> None:
        assert unit_values("ProtectSystem", LIVE) == ["strict"]
        assert unit_values("StateDirectory", LIVE) == ["swath/live"]
        assert unit_values("ReadWritePaths", LIVE) == []
        [cache] = unit_values("CacheDirectory", LIVE)
        assert f"NUMBA_CACHE_DIR=/var/cache/{cache}" in unit_values("Environment", LIVE)
        assert f"cache=/var/cache/{cache}" in (SYSTEMD / "install.sh").read_text().splitlines()

    def test_the_unit_compiles_before_it_starts(self) -> None:
        [before] = unit_values("ExecStartPre", LIVE)
        assert before == "-/opt/swath/bin/swath warm-up /etc/swath/swath.toml"
        assert unit_values("MemoryDenyWriteExecute", LIVE) == ["no"]
        assert unit_values("RestartPreventExitStatus", LIVE) == ["2"]

    def test_the_unit_is_hardened_like_the_recorder_except_where_unneeded(self) -> None:
        """Every restriction of the recorder's unit applies to this unit too, as strictly or more strictly."""
        for name in HARDENING:
            assert unit_values(name, LIVE) == unit_values(name) != [], name
        assert unit_values("DeviceAllow", LIVE) == []
        assert unit_values("PrivateNetwork", LIVE) == ["yes"]
        assert unit_values("SystemCallFilter", LIVE) == [*unit_values("SystemCallFilter")[:2], "mincore"]

    def test_the_unit_may_query_the_page_cache(self) -> None:
        """mincore(2) is in no group of systemd's; where it is not permitted, all pages look cold."""
        allowed: set[str] = set()
        waiting = [word for line in unit_values("SystemCallFilter", LIVE) if line[0] != "~" for word in line.split()]
        while waiting:
            name = waiting.pop()
            allowed.add(name)
            if name.startswith("@"):
                listed = run_tool("systemd-analyze", "--no-pager", "syscall-filter", name).stdout.splitlines()[1:]
                waiting += [line.strip() for line in listed if line.strip() and not line.strip().startswith("#")]
        assert {"mincore", "mmap", "pread64", "statx"} <= allowed


class TestPps:
    """The unit that holds the kernel's PPS line discipline on a serial port."""

    def test_the_unit_passes_verification(self, tmp_path: Path) -> None:
        program = tmp_path / "ldattach"
        program.write_text("#!/bin/sh\n")
        program.chmod(0o755)
        unit = tmp_path / "swath-pps@ttyS0.service"
        unit.write_text(PPS.read_text().replace("/usr/sbin/ldattach", str(program)))
        found = run_tool("systemd-analyze", "verify", "--man=no", unit)
        assert (found.returncode, found.stderr, found.stdout) == (0, "", "")

    def test_exposure_is_at_most_one_half(self, tmp_path: Path) -> None:
        unit = tmp_path / "swath-pps@ttyS0.service"
        unit.write_text(PPS.read_text())
        found = run_tool("systemd-analyze", "security", "--offline=true", "--threshold=5", "--no-pager", unit)
        assert "Overall exposure level for swath-pps@ttyS0.service" in found.stdout, found.stderr
        assert "/dev/ttyS0:rw" in found.stdout
        assert found.returncode == 0, found.stdout

    def test_the_unit_stays_in_the_foreground_while_its_port_exists(self) -> None:
        """Only ldattach's option --debug keeps it in the foreground."""
        assert unit_values("ExecStart", PPS) == ["/usr/sbin/ldattach --debug PPS /dev/%I"]
        assert unit_values("Type", PPS) == ["exec"]
        assert unit_values("BindsTo", PPS) == ["dev-%i.device"]
        assert unit_values("Restart", PPS) == ["always"]

    def test_the_unit_is_hardened_like_the_recorder(self) -> None:
        for name in HARDENING:
            assert unit_values(name, PPS) == unit_values(name) != [], name
        assert unit_values("DeviceAllow", PPS) == ["/dev/%I rw"]
        assert unit_values("SystemCallFilter", PPS) == unit_values("SystemCallFilter")[:2]
        (module,) = unit_values("Wants", PPS)
        assert module == "modprobe@pps_ldisc.service"
        assert module in unit_values("After", PPS)[0].split()

    def test_the_unit_is_started_by_the_example_rule(self) -> None:
        (rule,) = [line for line in _udev_examples() if "ttyS0" in line]
        (wanted,) = re.findall(r'ENV\{SYSTEMD_WANTS\}\+="([^"]*)"', rule)
        assert wanted == PPS.name.replace("@", "@ttyS0")
        assert 'TAG+="systemd"' in rule


class TestConsole:
    """The unit of the operator's console."""

    def test_the_unit_passes_verification(self, tmp_path: Path) -> None:
        unit = tmp_path / CONSOLE.name
        unit.write_text(CONSOLE.read_text().replace("/opt/swath/bin/swath", "/bin/true"))
        found = run_tool("systemd-analyze", "verify", "--man=no", unit)
        assert (found.returncode, found.stderr, found.stdout) == (0, "", "")

    def test_exposure_is_at_most_two(self) -> None:
        found = run_tool("systemd-analyze", "security", "--offline=true", "--threshold=20", "--no-pager", CONSOLE)
        assert "Overall exposure level for swath-console.service" in found.stdout, found.stderr
        assert found.returncode == 0, found.stdout

    def test_the_unit_is_hardened_like_live_and_writes_its_tokens_only(self) -> None:
        for name in HARDENING:
            if name not in ("UMask", "User", "RestrictAddressFamilies"):
                assert unit_values(name, CONSOLE) == unit_values(name, LIVE) != [], name
        assert unit_values("MemoryDenyWriteExecute", CONSOLE) == ["yes"]
        assert unit_values("StateDirectory", CONSOLE) == ["swath-console"]
        assert unit_values("ReadWritePaths", CONSOLE) == []
        assert unit_values("User", CONSOLE) == ["swath-console"]
        assert unit_values("Group", CONSOLE) == ["swath"]
        assert "BindsTo" not in CONSOLE.read_text()


def test_the_second_recorder_is_the_first_with_places_of_its_own(tmp_path: Path) -> None:
    """Apart from comments, the two units have no other difference."""

    def lines(unit: Path) -> list[str]:
        return [line for line in unit.read_text().splitlines() if not line.startswith("#")]

    second = lines(SYSTEMD / "swathd@.service")
    assert len(second) == len(lines(UNIT))
    assert [line for line in second if line not in lines(UNIT)] == [
        "Description=Swath recorder %i",
        "RequiresMountsFor=/var/lib/swath-%i",
        "ExecStart=/opt/swath/bin/swath run /etc/swath/%i.toml",
        "StateDirectory=swath-%i",
        "RuntimeDirectory=swath-%i",
        "WorkingDirectory=/var/lib/swath-%i",
    ]
    program = tmp_path / "opt/swath/bin/swath"
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    text = (SYSTEMD / "swathd@.service").read_text().replace("/opt/swath", str(tmp_path / "opt/swath"))
    (tmp_path / "swathd@tail.service").write_text(text)
    done = run_tool("systemd-analyze", "verify", "--man=no", tmp_path / "swathd@tail.service")
    assert (done.returncode, done.stderr) == (0, "")


def test_no_rule_starts_a_program() -> None:
    """By udev(7), what RUN starts is killed when the event has been handled, in the background or not."""
    assert not [line for line in _udev_rules() + _udev_examples() if "RUN" in line]


def test_the_service_has_no_capability_and_is_not_root() -> None:
    assert unit_values("CapabilityBoundingSet") == [""]
    assert unit_values("AmbientCapabilities") == [""]
    assert unit_values("NoNewPrivileges") == ["yes"]
    assert unit_values("User") == ["swath"]


def test_only_a_wrong_configuration_is_not_retried() -> None:
    assert unit_values("RestartPreventExitStatus") == ["2"]
    assert unit_values("Restart") == ["always"]
    assert unit_values("StartLimitIntervalSec") == ["0"]


def test_the_recovering_child_may_become_idle_and_read_the_clock() -> None:
    """Unusual system calls of the recorder are allowed by name; the last filter line wins."""
    last = unit_values("SystemCallFilter")[-1].split()
    assert set(last) >= {"adjtimex", "ioprio_set", "setpriority", "sched_setscheduler"}


def test_drivers_of_the_allowed_devices_are_loaded_before_the_devices_are_named() -> None:
    """By systemd.resource-control(5), a class that /proc/devices lacks at the start is left out of the policy."""
    module_of = {"char-ttyUSB": "usbserial", "char-ttyACM": "cdc_acm", "char-pps": "pps_core"}
    built_in = {"char-ttyS", "char-ttyAMA"}
    allowed = {value.split()[0] for value in unit_values("DeviceAllow")}
    needed = {f"modprobe@{module_of[name]}.service" for name in allowed - built_in}
    for key in ("Wants", "After"):
        assert needed <= {unit for value in unit_values(key) for unit in value.split()}, key


def test_users_are_created(tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    found = run_tool("systemd-sysusers", f"--root={tmp_path}", SYSTEMD / "sysusers/swath.conf")
    assert found.returncode == 0, found.stderr
    assert re.search(
        r"^swath:[^:]*:\d+:\d+:Swath recorder:/var/lib/swath:", (tmp_path / "etc/passwd").read_text(), re.M
    )
    assert re.search(r"^dialout:[^:]*:\d+:swath$", (tmp_path / "etc/group").read_text(), re.M)


def test_directories_are_created(tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    run_tool("systemd-sysusers", f"--root={tmp_path}", SYSTEMD / "sysusers/swath.conf")
    found = run_tool("systemd-tmpfiles", "--create", f"--root={tmp_path}", SYSTEMD / "tmpfiles/swath.conf")
    assert (found.returncode, found.stderr) == (0, "")
    assert (tmp_path / "var/lib/swath").stat().st_mode & 0o777 == 0o750
    assert (tmp_path / "etc/swath").is_dir()


def test_can_interfaces_come_up_at_the_configured_rate() -> None:
    network = configparser.ConfigParser()
    network.optionxform = str  # type: ignore[assignment,method-assign]
    network.read(SYSTEMD / "network/80-swath-can.network")
    assert network["Match"]["Type"] == "can"
    assert network["CAN"] == {"BitRate": "1000000", "RestartSec": "100ms"}


def test_receive_buffers_may_be_as_large_as_scanners_need() -> None:
    text = (SYSTEMD / "sysctl/90-swath.conf").read_text()
    assert re.search(r"^net\.core\.rmem_max = 67108864$", text, re.M)


def test_the_wall_clock_is_stepped_at_start_only() -> None:
    lines = (SYSTEMD / "chrony/swath.conf").read_text().splitlines()
    assert [line for line in lines if not line.startswith("#")] == ["makestep 1 3", "maxslewrate 100"]


# man udev: KEY op "value", the operators each key takes
_UDEV_TERM = re.compile(
    r'(?P<key>(?:SUBSYSTEM|KERNEL|DRIVER|ATTRS?\{\w+\}|ENV\{\w+\}|GROUP|MODE|SYMLINK|TAG))(?P<op>==|!=|\+=|=)"[^"]*"'
)


def _udev_rules() -> list[str]:
    lines = (SYSTEMD / "udev/90-swath.rules").read_text().splitlines()
    return [line for line in lines if line and not line.startswith("#")]


@pytest.mark.parametrize("rule", _udev_rules())
def test_udev_rules_match_and_assign(rule: str) -> None:
    terms = rule.split(", ")
    matches = [_UDEV_TERM.fullmatch(term) for term in terms]
    assert all(matches), rule
    operators = [match.group("op") for match in matches if match]
    assert operators == sorted(operators, key=lambda op: op not in ("==", "!=")), "matches stand before assignments"
    assert any(op in ("=", "+=") for op in operators), "a rule that does nothing"


@pytest.mark.parametrize("serial", ["", "FT4XYZ12"])
def test_every_named_device_has_one_link_that_ends_in_what_tells_it_apart(serial: str) -> None:
    """By-id links of u-blox receivers in public configurations have no serial number."""
    named = {"ID_SERIAL_SHORT": serial, "ID_PATH": "pci-0000:00:14.0-usb-0:1:1.0", "ID_USB_INTERFACE_NUM": "00"}
    for vendor, beginning in (("1546", "gnss/ublox-"), ("152a", "gnss/septentrio-"), ("0403", "adapter/")):
        links = []
        for rule in _udev_rules():
            terms = [match for term in rule.split(", ") if (match := _UDEV_TERM.fullmatch(term))]
            fields = [(match["key"], match["op"], match[0].partition('"')[2][:-1]) for match in terms]
            if ("ATTRS{idVendor}", "==", vendor) not in fields or any(
                key == "ATTRS{idProduct}" for key, _, _ in fields
            ):
                continue
            wanted = [
                (key[4:-1], op, value) for key, op, value in fields if key.startswith("ENV{ID_") and op in ("==", "!=")
            ]
            if all((named.get(key, "") == value) == (op == "==") for key, op, value in wanted):
                links += [value for key, _, value in fields if key == "SYMLINK"]
        assert len(links) == (1 if serial or vendor != "0403" else 0)
        for link in links:
            expanded = re.sub(r"\$env\{(\w+)\}", lambda match: named[match[1]], link)
            assert expanded.startswith(beginning)
            assert len(expanded) > len(beginning)


def _udev_examples() -> list[str]:
    lines = (SYSTEMD / "udev/90-swath.rules").read_text().splitlines()
    return [line[1:] for line in lines if line.startswith("#SUBSYSTEM")]


def test_example_rules_are_as_valid_as_the_active_ones() -> None:
    examples = _udev_examples()
    assert len(examples) == 2
    assert all(_UDEV_TERM.fullmatch(term) for line in examples for term in line.split(", "))
