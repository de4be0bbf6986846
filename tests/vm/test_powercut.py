"""Tests power cuts while a full sensor set is recorded: durable data are there, and little more is lost.

The machine notes on the host, which the cut spares, when it sent what, and when the kernel declared it durable, in its
own time. The installed service records, from its start at boot.
"""

from __future__ import annotations

import functools
import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from swath.daemon.log.reader import open_logs
from swath.daemon.log.recover import recover
from tests.vm import aircraft, machine
from tests.vm.installed import with_udev

CUTS, CUTS_LONG = 4, 50
FSYNC_S = 1.0
CHUNK_OPEN_S = 0.25
DISK_MB = 192
LOGS_ON_DISK = "/"

SENDERS = f"""\
/usr/bin/python3 {machine.GUEST}/witness.py {aircraft.LOGS} /vm/durable &
chrt -f 20 /usr/bin/python3 {aircraft.SENSORS} /vm \
    --udp 2368:300 --serial {aircraft.SENDING_PORT} --can vcan0:200 &
until [ -s /vm/durable ] && [ -s /vm/sent ]; do sleep 0.2; done
echo FLYING; wait
"""
TRACED = "trace_event=syscalls:sys_enter_fdatasync,syscalls:sys_exit_fdatasync"
WITHOUT_SYNC = "[Service]\nEnvironment=LD_PRELOAD=/usr/local/lib/nosync.so\n"


@dataclass(frozen=True)
class Synced:
    """A sync that the kernel has completed: this much of a log existed before it began."""

    began_ns: int
    ended_ns: int
    size: int
    log: str


@dataclass
class Cut:
    """What is left of a flight that ended with a power cut, its journal replayed.

    Attributes:
        begun_ns: the beginning of the last sync, whether it ended or not.
    """

    logs: Path
    turns: list[aircraft.Turn]
    syncs: list[Synced]
    begun_ns: int

    def log(self) -> Path:
        """Return the log of the flight."""
        logs = sorted(self.logs.glob("*.mcap"))
        assert len(logs) == 1, f"{len(logs)} logs: the recorder was started again in flight, the machine is starved"
        return logs[0]

    def lost_s(self) -> float:
        """Return the time, s, from the first missing unit to the cut, as far as the machine could note it."""
        found = aircraft.numbers([self.log()])
        complete = dict.fromkeys(("udp", "serial", "can"), 0)
        for kind in complete:
            there = found.get(kind, [])
            assert there == list(range(len(there))), f"{kind}: a gap within what is left"
            complete[kind] = len(there)
        kept = [turn for turn in self.turns if all(getattr(turn, kind) <= complete[kind] for kind in complete)]
        begin_ns = kept[-1].monotonic_ns if kept else self.turns[0].monotonic_ns
        return (self.turns[-1].monotonic_ns - begin_ns) * 1e-9

    def bound_s(self) -> float:
        """Return the largest loss allowed, s: sync period, 250 ms, the sync under way, and the machine's own stalls.

        The sender's notes show the stalls.
        """
        syncs_ns = [sync.ended_ns - sync.began_ns for sync in self.syncs]
        if self.syncs and self.begun_ns > self.syncs[-1].ended_ns:
            syncs_ns.append(self.turns[-1].monotonic_ns - self.begun_ns)
        sync_s = max(syncs_ns, default=0) * 1e-9
        pairs = zip(self.turns, self.turns[1:], strict=False)
        stall_s = max((after.monotonic_ns - before.monotonic_ns) * 1e-9 for before, after in pairs)
        return FSYNC_S + CHUNK_OPEN_S + sync_s + stall_s


def fly_and_cut(folder: Path, disk: Path, after_s: float, *, syncs: bool = True) -> Cut:
    """Fly once into a fresh disk, and cut the power some seconds after everything has begun."""
    overlay = aircraft.aboard(folder / "overlay")
    shared = folder / "vm"
    if not syncs:
        dropin = overlay / "etc/systemd/system/swathd.service.d/nosync.conf"
        dropin.parent.mkdir(parents=True)
        dropin.write_text(WITHOUT_SYNC)
        library = overlay / "usr/local/lib/nosync.so"
        library.write_bytes((machine.CACHE / "nosync.so").read_bytes())
    senders = SENDERS if syncs else SENDERS.replace("-s /vm/durable ", "-e /var/lib/swath/recording.json ")
    qemu = [*machine.disk(machine.make_disk(disk, DISK_MB)), *aircraft.null_modem(folder)]
    with machine.start(
        senders,
        shared=shared,
        systemd=True,
        overlay=overlay,
        layers=with_udev(),
        qemu=qemu,
        kernel=[TRACED],
        timeout_s=900,
    ) as flying:
        flying.said("FLYING", 800)
        time.sleep(after_s)
        flying.kill()
    machine.replay_journal(disk)
    logs = folder / "logs"
    machine.copy_from_disk(disk, LOGS_ON_DISK, logs)
    begun = shared / "durable.begun"
    begun_ns = [int(line) for line in begun.read_text().split("\n")[:-1]] if begun.exists() else []
    return Cut(logs, aircraft.sent(shared), synced(shared / "durable"), max(begun_ns, default=0))


def synced(path: Path) -> list[Synced]:
    """Return the records of the witness."""
    lines = path.read_text().split("\n")[:-1] if path.exists() else []
    return [Synced(int(a), int(b), int(c), d) for a, b, c, d in (line.split() for line in lines)]


def check(cut: Cut) -> dict[str, float]:
    """Check that everything durable is there and whole, that the loss is within bounds, and that recovery works."""
    path = cut.log()
    last = cut.syncs[-1]
    assert last.log == path.name
    assert path.stat().st_size >= last.size > 0
    report = recover(path)
    assert report is not None
    assert all(damage.offset >= last.size for damage in report.damage), (report.damage, last)
    recovered = path.with_suffix(".recovered.mcap")
    assert [len(session.damage) for session in open_logs([recovered])] == [0]
    assert aircraft.numbers([recovered]) == aircraft.numbers([path])
    path.with_suffix(".recovered.mcap").unlink()
    lost_s = cut.lost_s()
    assert lost_s <= cut.bound_s()
    return {"synced_bytes": last.size, "file_bytes": path.stat().st_size, "lost_s": lost_s, "bound_s": cut.bound_s()}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cuts")


@functools.cache
def flown(place: Path, number: int) -> Cut:
    """Return the flight of this number, cut at its own random moment; the first flight's disk is kept."""
    disk = place / ("first" if number == 0 else "disk")
    return fly_and_cut(place / str(number), disk, random.Random(number).uniform(1.0, 5.0))


@pytest.mark.parametrize(
    "number",
    [*range(CUTS), *(pytest.param(number, marks=pytest.mark.long) for number in range(CUTS, CUTS_LONG))],
)
def test_durable_data_survive_a_power_cut(
    place: Path, number: int, record_property: Callable[[str, object], None]
) -> None:
    for name, value in check(flown(place, number)).items():
        record_property(name, value)


def test_without_sync_more_data_are_lost(place: Path) -> None:
    """This is the control: if nothing more were lost, the machine would not lose what a real computer loses."""
    cut = fly_and_cut(place / "control", place / "disk", 6.0, syncs=False)
    logs = list(cut.logs.glob("*.mcap"))
    assert not logs or logs[0].stat().st_size == 0 or cut.lost_s() > FSYNC_S + CHUNK_OPEN_S + 1.0


def test_recording_begins_by_itself_and_recovery_follows(place: Path) -> None:
    """The disk is the one that the first of these cuts left."""
    disk, folder = place / "first", place / "0"
    old = flown(place, 0).log()
    overlay, qemu = folder / "overlay", [*machine.disk(disk), *aircraft.null_modem(folder)]
    with machine.start(
        machine.SERVE,
        shared=folder / "vm2",
        systemd=True,
        overlay=overlay,
        layers=with_udev(),
        qemu=qemu,
        timeout_s=900,
    ) as second:
        second.until(f"ls {aircraft.LOGS}/{old.stem}.recovered.mcap", 400)
        second.told("systemctl is-active swathd")
        assert second.told("systemctl show -P NRestarts swathd") == "0"
        second.told("systemctl stop swathd; sync", 200)
        second.kill()
    machine.replay_journal(disk)
    machine.copy_from_disk(disk, LOGS_ON_DISK, folder / "after")
    after = folder / "after"
    assert (after / old.name).read_bytes()[: old.stat().st_size] == old.read_bytes()
    assert aircraft.numbers([after / f"{old.stem}.recovered.mcap"]) == aircraft.numbers([old])
    (new,) = (path for path in after.glob("*.mcap") if not path.name.startswith(old.stem))
    codes = aircraft.event_codes(new)
    assert codes.index("session_started") < codes.index("log_repaired")
