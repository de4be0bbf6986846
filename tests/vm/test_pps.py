"""Tests PPS of the kernel: simulated faulty edges, and a receiver at a real 16550 with its pulse on DCD."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from swath.georef.timescales.gps_time import SECOND_NS
from tests.daemon.log_check import LogContent, read_log
from tests.vm.aboard_time import second_told
from tests.vm.crew import GnssReceiver, aboard, embark, facts
from tests.vm.machine import DCD_SHIM, MODULES, Machine
from tests.vm.seconds import labelled, states_between, wrong_seconds

pytestmark = pytest.mark.alone


def test_pps_seconds_are_never_wrong_whatever_happens_to_the_edges(tmp_path: Path) -> None:
    aboard(tmp_path, "aboard_time", "edges", MODULES / "pps_sim.ko", seconds=90)
    told = facts(tmp_path, "told")
    content = read_log(tmp_path / "logs")
    logs = tmp_path / "logs"
    moments = labelled(logs)
    assert sum(moment.state == "LOCKED" for moment in moments) > 200
    assert wrong_seconds(moments, lambda moment: moment.monotonic_ns + told["utc_minus_monotonic_ns"]) == []
    # the recorder's own messages
    assert "HOLDOVER" in states_between(logs, told["lost"] + 6 * SECOND_NS, told["back"])
    assert "LOCKED" in states_between(logs, told["back"] + 2 * SECOND_NS, told["gone"])
    assert "HOLDOVER" in states_between(logs, told["gone"] + 6 * SECOND_NS, told["returned"])
    assert "LOCKED" in states_between(logs, told["returned"] + 2 * SECOND_NS, told["end"])
    assert [event["source"] for event in content.events("device_lost")] == ["pps/main"]
    assert len([event for event in content.events("device_opened") if event["source"] == "pps/main"]) == 2
    # edges have the kernel's stamps, not those of a reader that slept
    edges = [value for _, value in content.messages["/pps/main"]]
    offsets = sorted(min(edge["realtime_ns"] % SECOND_NS, -edge["realtime_ns"] % SECOND_NS) for edge in edges)
    assert offsets[len(offsets) // 2] < 5_000_000


KINDS = ("ldisc", "dcd")
RECORDED_S = 45.0  # uneven edges, which never agree for five seconds, get their second after 24 edges


@contextmanager
def at_serial_port(folder: Path, kind: str) -> Iterator[tuple[GnssReceiver, Machine]]:
    """Wire a receiver to the second serial line of a machine that records it."""
    folder.mkdir(exist_ok=True)
    with GnssReceiver(folder / "dcd") as receiver:
        wired = ["-chardev", f"serial,id=gnss,path={receiver.port}", "-device", "isa-serial,chardev=gnss,index=1"]
        environment = {"LD_PRELOAD": str(DCD_SHIM), "DCD_FILE": str(folder / "dcd")}
        seconds = RECORDED_S + 40
        with embark(
            folder, "aboard_time", "serial", kind, RECORDED_S, qemu=wired, environment=environment, seconds=seconds
        ) as machine:
            yield receiver, machine


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, list[int]]]:
    """Return folder and pulses of each kind; both machines run at the same time, because they mostly wait."""
    folders = {kind: tmp_path_factory.mktemp(kind) for kind in KINDS}
    with ExitStack() as stack:
        running = {kind: stack.enter_context(at_serial_port(folders[kind], kind)) for kind in KINDS}
        for _, machine in running.values():
            machine.wait().check()
        return {kind: (folders[kind], receiver.pulses_utc_s) for kind, (receiver, _) in running.items()}


def assert_pulses_are_named(logs: Path, pulses_utc_s: list[int], ahead_ns: int) -> None:
    """Assert that every pulse is a recorded edge, and that its second is that of the world outside.

    The emulated port reads DCD every 10 ms only, which is too uneven for LOCKED, so COARSE seconds count too. Nothing
    uses the machine's wall clock: the recorder has the second from NMEA. ``ahead_ns`` is the machine's clock minus the
    outside's.
    """
    content = read_log(logs)
    edges = [value for _, value in content.messages["/pps/main"] if value["edge"] == "assert"]
    seconds = [round((edge["realtime_ns"] - ahead_ns) / SECOND_NS) for edge in edges]
    assert len(seconds) >= 15
    assert seconds == list(range(seconds[0], seconds[0] + len(seconds)))
    assert set(seconds) <= set(pulses_utc_s)
    assert [edge["sequence"] - edges[0]["sequence"] for edge in edges] == list(range(len(edges)))
    assert last_losses(content, "pps/main") == last_losses(content, "gnss/rover") == [0, 0, 0]
    told = [line for line in content.data("gnss/rover").splitlines() if line.startswith(b"$GPZDA")]
    expected = [line for second in pulses_utc_s for line in second_told(second).splitlines() if b"ZDA" in line]
    assert expected.index(told[1]) + len(told) - 1 <= len(expected)
    assert told[1:] == expected[expected.index(told[1]) :][: len(told) - 1]  # the first may be cut
    clock = content.messages["/clock"][0][1]
    moments = labelled(logs)
    assert len(moments) > 100
    outside_ns = clock["realtime_ns"] - clock["monotonic_ns"] - ahead_ns
    errors = [moment.utc_ns - moment.monotonic_ns - outside_ns for moment in moments]
    assert max(abs(error) for error in errors) < 0.5 * SECOND_NS


def last_losses(content: LogContent, source: str) -> list[int]:
    status = content.messages[f"/status/{source}"][-1][1]
    return [status[key] for key in ("lost_kernel", "lost_queue", "lost_write")]


@pytest.mark.parametrize("kind", KINDS)
def test_pps_on_dcd_of_a_16550_works_with_nmea_on_the_same_port(
    recorded: dict[str, tuple[Path, list[int]]], kind: str
) -> None:
    folder, pulses_utc_s = recorded[kind]
    assert_pulses_are_named(folder / "logs", pulses_utc_s, facts(folder, "told")["ahead_ns"])
