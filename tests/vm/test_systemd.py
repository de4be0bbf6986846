"""Tests the installed service under a real systemd: one machine from start to shutdown, each promise in turn."""

from __future__ import annotations

import datetime as dt
import json
import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.daemon.log_check import official_counts, read_log
from tests.vm import aircraft, machine
from tests.vm.installed import installed, with_udev
from tests.vm.machine import Machine

SERVICES = ("swathd.service", "swath-live.service")
LOGS = aircraft.LOGS
DISK_MB = 256
COMES_BACK_S = 400.0  # measures nothing
KILLS = 10
CONSOLE_KILLS, CONSOLE_KILLS_LONG = 5, 20
CONSOLE = "http://127.0.0.1:8470"
SESSION = "split_minutes = 1440\n"
# a device without a driver, recorded by a second recorder
TAIL = """\
[session]
name = "tail"
directory = "/var/lib/swath-tail"
reserve_mb = 16
split_minutes = 1440
[raw.tail]
transport = "udp:127.0.0.1:2369"
"""
RULES = """\
SUBSYSTEM=="tty", ATTRS{idVendor}=="0403", ATTRS{serial}=="FT4XYZ12", SYMLINK+="rover"
SUBSYSTEM=="tty", KERNEL=="ttyS1", TAG+="systemd", ENV{SYSTEMD_WANTS}+="swath-pps@ttyS1.service"
"""
USB = [
    *("-device", "qemu-xhci", "-chardev", "null,id=ftdi"),
    *("-device", "usb-serial,chardev=ftdi,serial=FT4XYZ12,always-plugged=on"),
]

# The sandbox runs another program here, which must not be mistaken for the service.
_OTHERWISE = {
    "Type": "oneshot",
    "Restart": "no",
    "WatchdogSec": "0",
    "RuntimeDirectory": "probe",
    "ExecStart": "/usr/bin/python3 /usr/local/lib/probe.py",
}


def probing_unit(unit: str) -> str:
    """Return a unit as installed, with its sandbox around the probe."""
    lines = (installed() / f"usr/lib/systemd/system/{unit}").read_text().splitlines()
    gone = ("ExecStartPre", "ExecReload", "BindsTo", "PartOf", "After", "Wants", "NotifyAccess", "RestartPrevent")
    kept = [line for line in lines if not line.startswith(gone)]
    changed = [next((f"{k}={v}" for k, v in _OTHERWISE.items() if line.startswith(f"{k}=")), line) for line in kept]
    return "\n".join(changed) + "\n"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("service")


@pytest.fixture(scope="module")
def service(place: Path) -> Iterator[Machine]:
    """Start the aircraft's computer; the receiver on its serial port stays silent."""
    overlay = aircraft.aboard(place / "overlay", session=SESSION, enabled=SERVICES)
    (overlay / "usr/local/lib/probe.py").write_bytes((machine.GUEST / "probe.py").read_bytes())
    for unit in SERVICES:
        (overlay / f"etc/systemd/system/probe-{unit}").write_text(probing_unit(unit))
    (overlay / "etc/swath/tail.toml").write_text(TAIL)
    rules = overlay / "etc/udev/rules.d/91-aircraft.rules"
    rules.parent.mkdir(parents=True)
    rules.write_text(RULES)
    disk = machine.make_disk(place / "disk", DISK_MB)
    qemu = [*machine.disk(disk), *aircraft.null_modem(place), *USB]
    running = machine.start(
        machine.SERVE,
        shared=place / "vm",
        systemd=True,
        overlay=overlay,
        layers=with_udev(),
        qemu=qemu,
        memory_mb=1536,
        timeout_s=3600,
    )
    with running:
        running.until("systemctl is-active swathd", COMES_BACK_S)
        sensors = f"chrt -f 20 /usr/bin/python3 {aircraft.SENSORS} /vm --udp 2368:300 --can vcan0:100"
        running.told(f"systemd-run -q --unit=sensors-fly {sensors}")
        yield running


def shown(service: Machine, name: str, unit: str = "swathd") -> str:
    """Return a property of a unit."""
    return service.told(f"systemctl show --timestamp=us+utc -P {name} {unit}")


def newest_log(service: Machine) -> str:
    """Return the name of the growing log."""
    name: str = json.loads(service.told(f"cat {LOGS}/recording.json"))["path"]
    return name


def next_part(service: Machine) -> str:
    """Begin a part and return its name."""
    old = newest_log(service)
    service.told("systemctl reload swathd")
    service.until(f"! grep -q {old} {LOGS}/recording.json")
    return newest_log(service)


def fetched(service: Machine, place: Path) -> Path:
    """Copy the logs in their present state to the host."""
    service.told(f"rm -rf /vm/logs; mkdir /vm/logs; cp {LOGS}/*.mcap /vm/logs/")
    return place / "vm/logs"


@pytest.fixture
def without_live(service: Machine) -> None:
    """Stop the live service, which compiles for a quarter of an hour here and slows a repair down to minutes."""
    service.told("systemctl mask --runtime --now swath-live", COMES_BACK_S)


@pytest.fixture
def with_live(service: Machine) -> None:
    """Run with the live service, as at boot."""
    service.told("systemctl unmask --runtime swath-live; systemctl start --no-block swath-live")


def test_both_services_are_enabled_and_started_at_boot(service: Machine) -> None:
    assert service.told("cat /proc/1/comm") == "systemd"
    assert service.told("systemctl is-enabled swathd swath-live").split() == ["enabled", "enabled"]
    assert shown(service, "ActiveState") == "active"
    assert shown(service, "User") == "swath"
    # swath-live starts after swathd
    service.until("systemctl show -P ActiveState swath-live | grep -E '^(activating|active)$'")


def test_readiness_is_notified_after_recording_has_begun(service: Machine) -> None:
    _, day, time_of_day, _ = shown(service, "ActiveEnterTimestamp").split()
    ready = dt.datetime.fromisoformat(f"{day}T{time_of_day}+00:00")
    begun = service.told(f"stat -c %.6W {LOGS}/{newest_log(service)}")
    assert shown(service, "NRestarts") == "0"
    assert float(begun) < ready.timestamp()
    assert shown(service, "StatusText").startswith("recording flight-")


@pytest.mark.usefixtures("without_live")
def test_devices_have_their_names_and_rights(service: Machine) -> None:
    service.until("ls /dev/rover")
    assert service.told("stat -Lc '%G %a' /dev/pps0 /dev/rover").splitlines() == ["dialout 660"] * 2
    name = Path(service.told("readlink -f /dev/rover")).name
    assert service.told(f"cat /sys/bus/usb-serial/devices/{name}/latency_timer") == "1"
    command = "modprobe dummy_hcd && modprobe g_serial idVendor=0x1546 idProduct=0x01a9 iSerialNumber=UBX7"
    service.told(command)
    service.until("ls /dev/gnss/ublox-UBX7")
    assert service.told("stat -Lc %G /dev/gnss/ublox-UBX7") == "dialout"


@pytest.mark.usefixtures("without_live")
def test_a_rule_makes_a_pps_source_of_a_serial_port(service: Machine) -> None:
    """The unit holds the line discipline while the recorder has the same port open."""
    service.until("systemctl is-active swath-pps@ttyS1 && ls /dev/pps1")
    service.told("sleep 5")  # a process started by the rule itself would have ended
    assert service.told("stat -Lc '%G %a' /dev/pps1") == "dialout 660"
    assert service.told("cat /sys/class/pps/pps1/path") == "/dev/ttyS1"
    assert shown(service, "NRestarts", "swath-pps@ttyS1") == "0"


@pytest.mark.usefixtures("without_live")
@pytest.mark.parametrize("unit", SERVICES)
def test_the_sandbox_denies_forbidden_access(service: Machine, unit: str) -> None:
    service.told(f"install -d -o swath -g swath {LOGS}/live; systemctl start probe-{unit}", COMES_BACK_S)
    found = json.loads(service.told(f"journalctl --sync; journalctl -b -o cat -t python3 -u probe-{unit} | tail -1"))
    recorder = unit == "swathd.service"
    allowed = {"unix", "live", "the configuration"}
    if recorder:
        allowed |= {"udp", "udp ipv6", "can", "/dev/pps0", "/dev/ttyS1", "the log directory", "real time"}
        allowed |= {"reading the clock's discipline"}
    else:
        allowed |= {"memory that is written and run"}
    assert {name for name, told in found.items() if told is True} == allowed, found


@pytest.mark.usefixtures("without_live")
def test_a_silent_sensor_does_not_cause_a_restart(service: Machine) -> None:
    service.until("systemctl show -P StatusText swathd | grep 'gnss/rover no data yet'")
    pid = shown(service, "MainPID")
    service.told("sleep 15")  # its watchdog waits for ten
    assert shown(service, "MainPID") == pid
    assert shown(service, "NRestarts") == "0"


@pytest.mark.usefixtures("without_live")
def test_a_port_in_use_is_waited_for(service: Machine) -> None:
    """The service cannot see the holder; it records the other devices, and the scanner once the port is free."""
    holder = "import socket, time; s = socket.socket(2, 2); s.bind(('127.0.0.1', 2368)); time.sleep(3600)"
    service.told("systemctl stop swathd", COMES_BACK_S)
    service.told(f'systemd-run -q --unit=viewer /usr/bin/python3 -c "{holder}"')
    service.until("grep -q ':0940 ' /proc/net/udp")
    service.told("systemctl start swathd", COMES_BACK_S)
    service.until("systemctl show -P StatusText swathd | grep 'scanner/left absent'", COMES_BACK_S)
    pid = shown(service, "MainPID")
    service.told("sleep 10")
    assert shown(service, "MainPID") == pid
    assert "port 2368 is in use by another program" in service.told("journalctl -b -o cat -u swathd")
    service.told("systemctl stop viewer")
    service.until("systemctl show -P StatusText swathd | grep -v scanner/left | grep ^recording", COMES_BACK_S)
    assert shown(service, "MainPID") == pid


@pytest.mark.usefixtures("without_live")
@pytest.mark.parametrize("thread", ["scanner/left", "writer"])
def test_a_hanging_thread_costs_only_a_restart(service: Machine, place: Path, thread: str) -> None:
    """systemd's watchdog ends it; the next one records at once, and repairs the old log meanwhile."""
    old, pid = next_part(service), shown(service, "MainPID")  # repairing a long log takes minutes here
    service.told("sleep 3")
    stem, fired = Path(old).stem, "journalctl -b -u swathd | grep -c 'Watchdog timeout'"
    before = int(service.shell(fired).output)
    stop = f"/usr/bin/python3 {machine.GUEST}/stop_thread.py"
    service.told(f"systemd-run -q --collect {stop} {pid} {thread}")
    service.until(f"[ $(systemctl show -P MainPID swathd) != {pid} ] && systemctl is-active swathd", COMES_BACK_S)
    assert int(service.told(fired)) == before + 1
    assert newest_log(service) != old
    service.until(f"ls {LOGS}/{stem}.recovered.mcap", COMES_BACK_S)
    service.until("systemctl show -P StatusText swathd | grep ^recording", COMES_BACK_S)
    logs = fetched(service, place)
    content = read_log(logs / newest_log(service))
    codes = [event["code"] for _, event in content.messages["/events"]]
    assert codes.index("session_started") < codes.index("log_repaired")
    assert official_counts(logs / f"{stem}.recovered.mcap")["/scanner/left/raw"] > 0


@pytest.mark.usefixtures("without_live")
def test_sighup_begins_a_part(service: Machine, place: Path) -> None:
    service.told("sleep 3")
    old = newest_log(service)
    new = next_part(service)
    assert new.rpartition("_")[0] == old.rpartition("_")[0]
    assert int(new.removesuffix(".mcap").rpartition("_")[2]) == int(old.removesuffix(".mcap").rpartition("_")[2]) + 1
    service.told("sleep 3")
    logs = fetched(service, place)
    found = aircraft.numbers([logs / old, logs / new])
    for kind in ("udp", "can"):
        assert aircraft.missing(found[kind]) == [], kind


@pytest.mark.usefixtures("without_live")
def test_a_second_recorder_records_with_its_own_configuration(service: Machine, place: Path) -> None:
    first, pid = next_part(service), shown(service, "MainPID")
    service.told("systemctl start swathd@tail", COMES_BACK_S)
    assert shown(service, "User", "swathd@tail") == "swath"
    sensors = "chrt -f 20 /usr/bin/python3 " + aircraft.SENSORS
    service.told(f"mkdir /vm/tail; systemd-run -q --unit=sensors-tail {sensors} /vm/tail --udp 2369:100 --seconds 5")
    service.until("! systemctl is-active sensors-tail")
    service.told("/opt/swath/bin/swath mark 'line 4 start' /etc/swath/tail.toml", COMES_BACK_S)
    service.told("systemctl stop swathd@tail", COMES_BACK_S)
    service.told("mkdir /vm/tail/logs; cp /var/lib/swath-tail/*.mcap /vm/tail/logs/")
    (log,) = (place / "vm/tail/logs").iterdir()
    assert aircraft.numbers([log], udp="/raw/tail/raw")["udp"] == list(range(aircraft.sent(place / "vm/tail")[-1].udp))
    codes = aircraft.event_codes(log)
    assert codes[-1] == "session_ended"
    assert "mark" in codes
    assert shown(service, "MainPID") == pid
    assert newest_log(service) == first
    found = aircraft.numbers([fetched(service, place) / first])
    for kind in ("udp", "can"):
        assert aircraft.missing(found[kind]) == [], kind


@pytest.mark.usefixtures("with_live")
def test_killing_the_live_service_repeatedly_does_not_affect_the_log(service: Machine, place: Path) -> None:
    pid, moments = shown(service, "MainPID"), random.Random(20)
    first = newest_log(service)
    processes = "/sys/fs/cgroup/system.slice/swath-live.service/cgroup.procs"  # of the warm-up, then of the service
    kill = "systemctl kill --kill-who=all -s KILL swath-live || true"
    killed = "journalctl -b -u swath-live | grep -c 'exited, code=killed, status=9/KILL'"
    before = int(service.shell(killed).output)
    for _ in range(KILLS):
        begun = f"until read -r of <{processes}; do sleep 0.1; done; sleep {moments.uniform(0, 3):.2f}"
        gone = f'while read -r now <{processes} && [ "$now" = "$of" ]; do sleep 0.1; done'
        service.told(f"{begun}; {kill}; {gone}", COMES_BACK_S)
    # each second kill hits the warm-up, whose end the unit ignores and systemd does not report
    service.until(f"[ $({killed}) = {before + KILLS // 2} ]")
    assert shown(service, "MainPID") == pid
    assert newest_log(service) == first
    service.told("sleep 2")
    found = aircraft.numbers([fetched(service, place) / first])
    for kind in ("udp", "can"):
        assert aircraft.missing(found[kind]) == [], kind


@pytest.fixture
def console(service: Machine) -> Iterator[str]:
    """Run with the console's service; return a command that prints the first snapshot that it feeds to a page."""
    failed = "{ journalctl --no-pager -b -u swath-console; exit 1; }"
    service.told(f"systemctl start swath-console || {failed}", COMES_BACK_S)
    # the feed never ends: its first snapshot is enough
    yield f"{{ curl -sN -m 60 {CONSOLE}/feed || true; }} | grep -m 1 now_ms"
    service.told("systemctl stop swath-console")


@pytest.mark.usefixtures("without_live")
def test_the_console_s_service_shows_the_recording_and_writes_marks(service: Machine, console: str) -> None:
    assert shown(service, "User", "swath-console") == "swath-console"
    assert "<title>" in service.told(f"curl -sf {CONSOLE}/")
    header = json.loads(service.told(console).removeprefix("data:"))["header"]
    assert header["state"] != "NOT RECORDING"
    asked = f"-H 'Origin: {CONSOLE}' -H 'Content-Type: application/json' -d '{{\"text\": \"from the console\"}}'"
    assert json.loads(service.told(f"curl -sf {asked} {CONSOLE}/mark"))["text"] == "from the console"


@pytest.mark.usefixtures("without_live")
@pytest.mark.parametrize("kills", [CONSOLE_KILLS, pytest.param(CONSOLE_KILLS_LONG, marks=pytest.mark.long)])
def test_killing_the_console_repeatedly_does_not_affect_the_log(
    service: Machine, place: Path, console: str, kills: int
) -> None:
    pid, first, moments = shown(service, "MainPID"), newest_log(service), random.Random(kills)
    before = int(shown(service, "NRestarts", "swath-console"))
    for number in range(1, kills + 1):
        service.told(f"sleep {moments.uniform(0, 3):.2f}; systemctl kill -s KILL swath-console")
        service.until(f"[ $(systemctl show -P NRestarts swath-console) = {before + number} ]")
    service.until(f"curl -sf -m 60 -o /dev/null {CONSOLE}/", COMES_BACK_S)
    assert json.loads(service.told(console).removeprefix("data:"))["header"]["state"] != "NOT RECORDING"
    assert (shown(service, "MainPID"), newest_log(service)) == (pid, first)
    service.told("sleep 2")
    found = aircraft.numbers([fetched(service, place) / first])
    for kind in ("udp", "can"):
        assert aircraft.missing(found[kind]) == [], kind


@pytest.mark.usefixtures("without_live")
def test_a_full_disk_ends_the_part_and_free_space_begins_another(service: Machine, place: Path) -> None:
    old = newest_log(service)
    free = f"$(( $(stat -fc '%a * %S' {LOGS}) ))"
    service.told(f"fallocate -l $(( {free} - 15000000 )) {LOGS}/filler")
    service.until("systemctl show -P StatusText swathd | grep '^NOT RECORDING'", COMES_BACK_S)
    service.told("systemctl is-active swathd")
    service.told(f"cp {LOGS}/{old} /vm/full.mcap; rm {LOGS}/filler")
    assert official_counts(place / "vm/full.mcap")["/scanner/left/raw"] > 0  # the log is complete
    service.until("systemctl show -P StatusText swathd | grep ^recording", COMES_BACK_S)
    assert newest_log(service) != old


@pytest.mark.usefixtures("with_live")
def test_shutdown_ends_the_log(service: Machine, place: Path) -> None:
    last = newest_log(service)
    restarts = int(shown(service, "NRestarts"))
    service.told("systemd-run -q --on-active=3 systemctl poweroff")
    service.qemu.wait(COMES_BACK_S)
    machine.copy_from_disk(place / "disk", "/", place / "after")
    codes = aircraft.event_codes(place / "after" / last)
    assert codes[-1] == "session_ended"
    assert official_counts(place / "after" / last)["/events"] == len(codes)
    assert restarts == 2  # both were the watchdog's
