"""Tests ``swath doctor`` on a computer made of files with one fault at a time, and on this one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from swath.daemon.config import parse_config
from swath.daemon.doctor import _specs, clock, devices, disk, highest_bytes_per_s, host, needed_modules
from swath.daemon.doctor.finding import Finding, Tree, Verdict
from swath.daemon.log.host_clock import STA_UNSYNC, ClockDiscipline
from tests.builders import ROOT, SYSTEMD
from tests.daemon.builders import swath
from tests.daemon.doctor.builders import DEBIAN_CHRONY, write
from tests.daemon.rig import session_table

KEPT = ClockDiscipline(12.0, 0, 0.002)
FREE_RUNNING = ClockDiscipline(0.0, STA_UNSYNC, 16.0)
SWATH = devices.User("swath", 990, frozenset({990, 20}))
UNIT = "/usr/lib/systemd/system/swathd.service"
CPU = "/sys/devices/system/cpu/cpu0"
GOOD = {
    "/proc/sys/net/core/rmem_max": "67108864\n",
    "/proc/sys/net/ipv4/ipfrag_high_thresh": "33554432\n",
    "/proc/net/snmp": "Udp: InDatagrams NoPorts RcvbufErrors\nUdp: 100 0 0\n",
    "/proc/meminfo": "MemTotal: 8000000 kB\nMemAvailable: 4000000 kB\n",
    "/proc/sys/kernel/osrelease": "6.1.0-test\n",
    "/proc/mounts": "/dev/sda1 / ext4 rw,relatime 0 0\n/dev/sdb1 /var/lib/swath xfs rw,noatime 0 0\n",
    "/proc/300/comm": "chronyd\n",
    "/lib/modules/6.1.0-test/modules.builtin": "kernel/drivers/pps/pps_core.ko\n",
    "/lib/modules/6.1.0-test/modules.dep": "kernel/net/can/can-raw.ko.xz: kernel/net/can/can.ko.xz\n",
    "/etc/chrony/chrony.conf": DEBIAN_CHRONY,
    "/etc/passwd": "root:x:0:0:::\nswath:x:990:990:Swath recorder:/var/lib/swath:/usr/sbin/nologin\n",
    "/etc/group": "root:x:0:\ndialout:x:20:pilot,swath\nswath:x:990:\n",
    f"{CPU}/cpufreq/scaling_governor": "performance\n",
    f"{CPU}/cpufreq/scaling_driver": "acpi-cpufreq\n",
    f"{CPU}/cpuidle/state0/name": "POLL\n",
    f"{CPU}/cpuidle/state0/latency": "0\n",
    f"{CPU}/cpuidle/state0/disable": "0\n",
    f"{CPU}/cpuidle/state1/name": "C6\n",
    f"{CPU}/cpuidle/state1/latency": "133\n",
    f"{CPU}/cpuidle/state1/disable": "1\n",
    "/sys/module/usbserial/refcnt": "1\n",
    "/sys/class/tty/console/active": "tty0 ttyS1\n",
    "/sys/bus/usb-serial/devices/ttyUSB0/latency_timer": "1\n",
    "/sys/class/pps/pps0/name": "serial0\n",
    "/sys/class/pps/pps0/assert": "1800000000.000004211#77\n",
    "/sys/class/pps/pps0/clear": "0.000000000#0\n",
    "/sys/class/net/can0/flags": "0x40c1\n",
    "/sys/class/net/can0/tx_queue_len": "1000\n",
    "/sys/class/net/can0/statistics/rx_dropped": "0\n",
    "/sys/class/net/can0/statistics/rx_over_errors": "0\n",
    "/sys/class/net/eth1/operstate": "up\n",
    "/dev/ttyUSB0": "",
    "/dev/pps0": "",
}
OPEN_AS = """
import os, sys
folder, name, uid, *gids = sys.argv[1:]
os.setgroups(list(map(int, gids))); os.setgid(int(uid)); os.setuid(int(uid))
os.open(name, os.O_RDWR, dir_fd=int(folder))
"""
NOW_S = 1_800_000_000.9


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    """Return a computer without fault."""
    if os.geteuid() != 0:
        pytest.fail("this test gives files to other users: run it as root")
    made = Tree(tmp_path / "computer")
    for path, text in GOOD.items():
        write(made, path, text)
    write(made, "/etc/chrony/conf.d/swath.conf", (SYSTEMD / "chrony/swath.conf").read_text())
    write(made, UNIT, (SYSTEMD / "swathd.service").read_text())
    for device in ("/dev/ttyUSB0", "/dev/pps0"):
        made.at(device).chmod(0o660)
        os.chown(made.at(device), 0, 20)
    made.at("/var/lib/swath").mkdir(parents=True)
    os.chown(made.at("/var/lib/swath"), 990, 990)
    made.at("/var/lib/swath").chmod(0o750)
    return made


def bitrate(name: str) -> int | None:
    return 1_000_000 if name == "can0" else None


QUESTIONS: dict[str, Callable[[Tree], Iterable[Finding]]] = {
    "buffers": lambda tree: host.receive_buffers(tree, 32 << 20),
    "dropped": host.dropped_datagrams,
    "governor": host.governor,
    "idle": host.idle_states,
    "memory": host.memory,
    "modules": lambda tree: host.modules(tree, ["pps_core", "usbserial"]),
    "can_raw": lambda tree: host.modules(tree, ["can_raw"]),
    "clock": lambda tree: clock.keepers(tree, KEPT),
    "file system": lambda tree: disk.file_system(disk.mount_of(tree, Path("/var/lib/swath")), 2e9),
    "directory": lambda tree: disk.writable(tree, Path("/var/lib/swath"), devices.recording_user(tree)),
    "device": lambda tree: devices.device_file(tree, "/dev/ttyUSB0", devices.recording_user(tree)),
    "policy": lambda tree: devices.device_policy(tree, "/dev/ttyUSB0"),
    "serial": lambda tree: devices.serial_port(tree, "/dev/ttyUSB0"),
    "grabbers": devices.port_grabbers,
    "pps": lambda tree: devices.pps_device(tree, "/dev/pps0", "assert", NOW_S),
    "can": lambda tree: devices.can_interface(tree, "can0", 1_000_000, bitrate),
    "network": lambda tree: devices.network_interface(tree, "eth1"),
}
LOADED_LATER = {"can_raw"}


def worst(findings: Iterable[Finding]) -> Finding | None:
    """Return the first wrong finding, or else the first note."""
    found = sorted(findings, key=lambda one: list(Verdict).index(one.verdict), reverse=True)
    return found[0] if found and found[0].verdict is not Verdict.OK else None


@pytest.mark.parametrize(
    ("machine", "package"), [("x86_64", "linux-image-amd64"), ("aarch64", "linux-image-arm64"), ("riscv64", "riscv64")]
)
def test_a_kernel_is_named_as_debian_names_it(
    tree: Tree, machine: str, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("platform.machine", lambda: machine)
    (finding,) = host.modules(tree, ["spcp8x5"])
    assert finding.mend.endswith(package)


@pytest.mark.parametrize("question", [name for name in QUESTIONS if name not in LOADED_LATER])
def test_a_good_computer_has_no_findings(tree: Tree, question: str) -> None:
    assert worst(QUESTIONS[question](tree)) is None


@pytest.mark.parametrize(
    ("question", "path", "text", "verdict", "said", "mend"),
    [
        ("buffers", "/proc/sys/net/core/rmem_max", "212992", "wrong", "212992", "net.core.rmem_max=67108864"),
        ("buffers", "/proc/sys/net/core/rmem_max", "?", "note", "cannot be read", ""),
        (
            "buffers",
            "/proc/sys/net/ipv4/ipfrag_high_thresh",
            "4194304",
            "note",
            "4194304",
            "ipfrag_high_thresh=33554432",
        ),
        ("dropped", "/proc/net/snmp", "Udp: A RcvbufErrors\nUdp: 9 17\n", "note", "17 datagrams", "nstat"),
        ("governor", f"{CPU}/cpufreq/scaling_governor", "powersave", "wrong", "lowest frequency", "cpupower"),
        ("governor", f"{CPU}/cpufreq/scaling_governor", "ondemand", "note", "follows the load", "cpupower"),
        ("idle", f"{CPU}/cpuidle/state1/disable", "0", "note", "C6 133 µs", "cpupower idle-set -D 50"),
        ("memory", "/proc/meminfo", "MemAvailable: 100000 kB\n", "wrong", "102 MB", "stop other programs"),
        ("modules", "/lib/modules/6.1.0-test/modules.builtin", "", "wrong", "pps_core is not part", "kernel"),
        (
            "clock",
            "/proc/301/comm",
            "systemd-timesyn\n",
            "wrong",
            "both set the clock",
            "disable --now systemd-timesyncd",
        ),
        ("clock", "/proc/300/comm", "systemd-timesyn\n", "wrong", "may step", "install chrony"),
        ("clock", "/etc/chrony/chrony.conf", "makestep 0.1 -1\n", "wrong", "at any time", "makestep 1 3"),
        ("file system", "/proc/mounts", "none /var/lib/swath tmpfs rw 0 0", "wrong", "in memory", "ext4"),
        ("file system", "/proc/mounts", "a:/b /var/lib nfs4 rw 0 0", "wrong", "another computer", "ext4"),
        ("file system", "/proc/mounts", "/dev/sdb1 /var/lib vfat rw 0 0", "wrong", "no journal", "ext4"),
        ("file system", "/proc/mounts", "/dev/sdb1 /var ext4 ro 0 0", "wrong", "read-only", "remount,rw /var"),
        ("file system", "/proc/mounts", "/dev/sdb1 / ext4 rw,nobarrier 0 0", "wrong", "nobarrier", "fstab"),
        ("serial", "/sys/class/tty/console/active", "tty0 ttyUSB0", "wrong", "console", "console=ttyUSB0"),
        ("serial", "/sys/bus/usb-serial/devices/ttyUSB0/latency_timer", "16", "note", "16 ms", "echo 1"),
        (
            "grabbers",
            "/proc/400/comm",
            "ModemManager\n",
            "wrong",
            "ModemManager is running",
            "disable --now ModemManager",
        ),
        ("device", "/etc/group", "dialout:x:20:pilot\n", "wrong", "may not read", "usermod -aG dialout swath"),
        (
            "policy",
            "/usr/lib/systemd/system/swathd.service",
            "DeviceAllow=char-pps rw",
            "wrong",
            "ttyUSB",
            "edit swathd",
        ),
        ("pps", "/sys/class/pps/pps0/name", "ktimer", "wrong", "test source", "modprobe -r"),
        ("pps", "/sys/class/pps/pps0/assert", "0.000000000#0", "wrong", "never seen", "ppstest"),
        ("pps", "/sys/class/pps/pps0/assert", "1799999940.000000000#9", "wrong", "61 s ago", "ppstest"),
        ("can", "/sys/class/net/can0/flags", "0x40c0", "wrong", "down", "up type can bitrate 1000000"),
        ("can", "/sys/class/net/can0/statistics/rx_over_errors", "5", "note", "rx_over_errors 5", "ip -s link"),
        ("can", "/sys/class/net/can0/tx_queue_len", "10", "note", "10 frames", "txqueuelen 1000"),
        ("network", "/sys/class/net/eth1/operstate", "down", "wrong", "no link", "ip link set eth1 up"),
    ],
)
def test_each_fault_is_found_with_its_remedy(
    tree: Tree, question: str, path: str, text: str, verdict: str, said: str, mend: str
) -> None:
    write(tree, path, text)
    found = worst(QUESTIONS[question](tree))
    assert found is not None
    assert found.verdict == verdict
    assert said in found.text
    assert mend in found.mend


def test_powersave_of_a_load_following_driver_is_not_a_fault(tree: Tree) -> None:
    write(tree, f"{CPU}/cpufreq/scaling_governor", "powersave")
    write(tree, f"{CPU}/cpufreq/scaling_driver", "intel_pstate")
    (found,) = host.governor(tree)
    assert found.verdict is Verdict.NOTE


def test_a_loadable_driver_is_loaded_by_modprobe(tree: Tree) -> None:
    (found,) = QUESTIONS["can_raw"](tree)
    assert (found.verdict, found.text) == (Verdict.WRONG, "can_raw is not loaded")
    assert found.mend.startswith("sudo modprobe can_raw")
    write(tree, "/sys/module/can_raw/refcnt", "1")
    assert worst(QUESTIONS["can_raw"](tree)) is None


@pytest.mark.parametrize(
    ("mode", "uid", "gid", "verdict"),
    [
        (0o660, 0, 20, "ok"),
        (0o600, 990, 0, "ok"),
        (0o666, 0, 0, "ok"),
        (0o600, 0, 20, "wrong"),
        (0o660, 0, 5, "wrong"),
        (0o640, 0, 20, "wrong"),
        (0o066, 990, 20, "wrong"),  # the owner's bits count for the owner, even if others have more
    ],
)
def test_permissions_are_judged_as_by_the_kernel(tree: Tree, mode: int, uid: int, gid: int, verdict: str) -> None:
    path = tree.at("/dev/ttyUSB0")
    path.chmod(mode)
    os.chown(path, uid, gid)
    assert devices.recording_user(tree) == SWATH
    (found,) = devices.device_file(tree, "/dev/ttyUSB0", SWATH)
    assert found.verdict == verdict
    assert _kernel_lets(path, SWATH) is (verdict == "ok")


def _kernel_lets(path: Path, user: devices.User) -> bool:
    """Return True if a process of that user can open the file."""
    folder = os.open(path.parent, os.O_PATH)
    words = [sys.executable, "-c", OPEN_AS, str(folder), path.name, str(user.uid), *map(str, sorted(user.gids))]
    try:
        return subprocess.run(words, pass_fds=[folder], stderr=subprocess.DEVNULL, check=False).returncode == 0
    finally:
        os.close(folder)


def test_missing_devices_are_reported(tree: Tree) -> None:
    (device,) = devices.device_file(tree, "/dev/ttyUSB7", SWATH)
    (pps,) = devices.pps_device(tree, "/dev/pps7", "assert", NOW_S)
    (can,) = devices.can_interface(tree, "can7", None, bitrate)
    (network,) = devices.network_interface(tree, "eth7")
    assert {one.verdict for one in (device, pps, can, network)} == {Verdict.WRONG}
    assert device.text == "/dev/ttyUSB7 does not exist"
    assert pps.mend.startswith("sudo systemctl start swath-pps@ttyS0 ")


def test_a_different_bit_rate_is_corrected_by_ip_link(tree: Tree) -> None:
    found = worst(devices.can_interface(tree, "can0", 500_000, bitrate))
    assert found is not None
    assert found.text == "can0 runs at 1000000 bit/s, but 500000 is configured: no frame can be received"
    assert found.mend == "sudo ip link set can0 down && sudo ip link set can0 up type can bitrate 500000 restart-ms 100"


def test_an_unsynchronised_clock_is_noted(tree: Tree) -> None:
    tree.at("/proc/300/comm").unlink()
    (found,) = clock.keepers(tree, FREE_RUNNING)
    assert found.verdict is Verdict.NOTE
    assert "no program sets the clock" in found.text
    (found,) = clock.keepers(tree, KEPT)
    assert found.verdict is Verdict.OK


@pytest.mark.parametrize(
    ("step_ns", "slew_ppm", "verdict"),
    [(0, 12.0, "ok"), (-30_000, 0.0, "ok"), (1_000_000, 0.0, "wrong"), (-1_000_000, 0.0, "wrong"), (0, 500.0, "note")],
)
def test_steps_and_slews_are_judged(step_ns: int, slew_ppm: float, verdict: str) -> None:
    (found,) = clock.movement(step_ns, slew_ppm)
    assert found.verdict == verdict


def test_the_clocks_of_this_computer_are_watched() -> None:
    began_s = time.monotonic()
    step_ns, slew_ppm = clock.watch(0.2)
    assert time.monotonic() - began_s >= 0.2
    assert abs(slew_ppm) < 1000.0  # the kernel slews by 500 at most, an oscillator is off by less
    assert isinstance(step_ns, int)


@pytest.mark.parametrize(
    ("free", "rate", "verdict", "told"),
    [(1e12, 25e6, "ok", "11 h 06 min"), (50e9, 25e6, "wrong", "32 min"), (0.4e9, 0.2e6, "wrong", "0 s")],
)
def test_free_space_is_given_in_hours(free: float, rate: float, verdict: str, told: str) -> None:
    (found,) = disk.room(free, 512e6, rate)
    assert found.verdict == verdict
    assert told in found.text


def test_the_rate_of_the_devices_is_that_of_their_drivers(tmp_path: Path) -> None:
    head = '[scanner.l]\ntransport = "udp:0.0.0.0:2368"\nauxiliary = "udp:0.0.0.0:8308"\ninstallation_deg = [0, 0, 0]\n'
    receiver = '[gnss.r]\ntransport = "serial:/dev/ttyS0?baud=115200"\nprotocol = "ubx"\n'

    def rate(text: str) -> float:
        return highest_bytes_per_s(parse_config(f'[session]\nname = "x"\n{text}', tmp_path / "a.toml"))

    none = rate("")
    vlp16 = rate(f'{head}protocol = "velodyne-vlp16"\n') - none
    assert vlp16 == pytest.approx(2 * 754 * 1206 + 0.5e6, rel=1e-3), "dual return: 1508 packets a second, and positions"
    for protocol, mb_per_s in (
        ("robosense-helios32", 1_152_000 / 384 * 1248e-6),  # points a second in dual return, and those of a packet
        ("robosense-rs16", 576_000 / 384 * 1248e-6),
        ("livox-avia", 240_000 / 30 * 1278e-6),  # three returns, 30 pulses a packet
        ("livox-mid360", 200_000 / 96 * 1380e-6),
        ("srep", 32.2),
    ):
        more = "mirror_factor = 2\n" if protocol == "srep" else ""
        found = rate(f'{head}protocol = "{protocol}"\n{more}') - none - 0.5e6
        assert found == pytest.approx(1e6 * mb_per_s, rel=0.01), protocol
    assert rate(receiver) - none == 11_520
    assert highest_bytes_per_s(None) == 25.2e6


@pytest.mark.parametrize(
    ("rate", "sync_s", "verdict"),
    [(200e6, 0.03, "ok"), (200e6, 0.8, "note"), (200e6, 2.5, "wrong"), (30e6, 0.03, "wrong")],
)
def test_a_slow_disk_is_reported(rate: float, sync_s: float, verdict: str) -> None:
    (found,) = disk.speed(rate, sync_s, 25.2e6)
    assert found.verdict == verdict


def test_measuring_a_disk_leaves_no_files(tmp_path: Path) -> None:
    rate, longest_s = disk.measure(tmp_path, 4 << 20)
    assert rate > 0
    assert 0 < longest_s < 60
    assert list(tmp_path.iterdir()) == []


def test_a_missing_directory_is_judged_by_its_nearest_existing_folder(tree: Tree) -> None:
    (found,) = disk.writable(tree, Path("/var/lib/swath/a/b"), SWATH)
    assert found.text == "swath may write to /var/lib/swath"
    os.chown(tree.at("/var/lib/swath"), 0, 0)
    (found,) = disk.writable(tree, Path("/var/lib/swath"), SWATH)
    assert found.mend == "sudo install -d -o swath -g swath -m 0750 /var/lib/swath"


def test_a_directory_inaccessible_to_its_user_is_reported(tree: Tree) -> None:
    tree.at("/var/lib").chmod(0o750)
    (found,) = disk.writable(tree, Path("/var/lib/swath"), SWATH)
    assert (found.verdict, found.text) == (Verdict.WRONG, "swath may not enter /var/lib, which holds /var/lib/swath")
    assert found.mend.startswith("sudo chmod o+x /var/lib ")


def test_the_mount_of_a_directory_is_the_longest_containing_it(tree: Tree) -> None:
    points = [disk.mount_of(tree, Path(path)) for path in ("/var/lib/swath/x", "/var/lib/swathy", "/home")]
    assert [point.point if point else None for point in points] == ["/var/lib/swath", "/", "/"]


def test_kernel_modules_needed_by_a_configuration_are_listed(tmp_path: Path) -> None:
    config = parse_config((ROOT / "fixtures/config/aircraft.toml").read_text(), ROOT / "fixtures/config/aircraft.toml")
    assert set(needed_modules(config, _specs(config))) <= {"can_raw", "usbserial", "cdc_acm", "pps_core"}
    assert "pps_core" in needed_modules(config, _specs(config))


def test_this_computer_is_judged_by_its_own_files(tmp_path: Path) -> None:
    """The command reads the real files: each wrong finding has a remedy, and the verdict is that of the files."""
    config = tmp_path / "swath.toml"
    config.write_text(
        session_table(tmp_path / "logs")
        + f'[gnss.rover]\ntransport = "serial:{tmp_path}/absent"\nprotocol = "nmea"\n'
        + '[scanner.left]\ntransport = "udp:0.0.0.0:2368?buffer_mb=900"\nprotocol = "srep"\nmirror_factor = 1.0\n'
    )
    run = swath("doctor", str(config), "--json")
    assert run.returncode == 1, run.stderr
    found = json.loads(run.stdout)
    assert found["ok"] is False
    rows = {(row["check"], row["verdict"]): row for row in found["findings"]}
    assert rows["devices", "wrong"]["text"] == f"{tmp_path}/absent does not exist"
    limit = int(Path("/proc/sys/net/core/rmem_max").read_text())
    verdict = "wrong" if limit < 900 << 20 else "ok"
    assert str(limit) in rows["receive buffers", verdict]["text"]
    assert any(check == "disk speed" for check, _ in rows)
    assert all(row["mend"] for row in found["findings"] if row["verdict"] == "wrong")
    assert not (tmp_path / "logs").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["swath.toml"]


def test_the_page_shows_every_finding(tmp_path: Path) -> None:
    config = tmp_path / "swath.toml"
    config.write_text(session_table(tmp_path))
    run = swath("doctor", str(config), "--no-write")
    assert run.returncode in (0, 1)
    assert "not measured: switched off by --no-write" in run.stdout
    for line in run.stdout.splitlines():
        assert line.startswith(("ok    ", "note  ", "wrong ", "     "))


def test_a_wrong_configuration_is_a_usage_error(tmp_path: Path) -> None:
    config = tmp_path / "swath.toml"
    config.write_text("[session]\n")
    assert swath("doctor", str(config)).returncode == 2
