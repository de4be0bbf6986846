"""Tests PPS sources: `fixed:` completely on real files and FIFOs, the kernel's and DCD without their hardware."""

from __future__ import annotations

import os
import struct
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from swath.drivers.session import Session
from swath.drivers.transports.base import PpsSource, RawEdge, TransportError
from swath.drivers.transports.pps.fixed import FixedPps
from swath.drivers.transports.pps.kernel import (
    FETCH_DATA,
    PARAMETERS,
    PPS_FETCH,
    PPS_GETCAP,
    PPS_GETPARAMS,
    PPS_SETPARAMS,
    KernelPps,
    edge_of,
)
from swath.drivers.transports.pps.serial_dcd import SerialDcdPps, edge_at_wake_up

START_NS = 1_700_000_000_000_000_000


def line(number: int) -> bytes:
    return b"%d %d\n" % (START_NS + number * 1_000_000_000 + number, number)


def edge(number: int, polarity: str = "assert") -> RawEdge:
    return RawEdge(START_NS + number * 1_000_000_000 + number, number, polarity)


def collect(source: PpsSource, count: int) -> list[RawEdge]:
    """Return edges until ``count`` came or 5 s were silent."""
    edges: list[RawEdge] = []
    while len(edges) < count:
        more = source.receive(5.0)
        if not more:
            break
        edges += more
    return edges


@pytest.fixture
def fifo(tmp_path: Path) -> Path:
    path = tmp_path / "pps"
    os.mkfifo(path)
    return path


@pytest.fixture
def source(fifo: Path) -> Iterator[FixedPps]:
    pps = FixedPps(str(fifo))
    pps.open()
    yield pps
    pps.close()


def test_file_is_read_and_followed(tmp_path: Path) -> None:
    path = tmp_path / "edges"
    path.write_bytes(line(0) + line(1) + line(2)[:9])
    pps = FixedPps(str(path), edge="clear")
    pps.open()
    assert collect(pps, 2) == [edge(0, "clear"), edge(1, "clear")]
    assert pps.receive(0.05) == []
    with path.open("ab") as file:
        file.write(line(2)[9:] + line(3))
    assert collect(pps, 2) == [edge(2, "clear"), edge(3, "clear")]
    assert pps.garbage_lines == 0
    pps.close()


def test_timestamps_keep_every_nanosecond(tmp_path: Path) -> None:
    path = tmp_path / "edges"
    path.write_text("1763704800123456789 4294967295\n")
    pps = FixedPps(str(path))
    pps.open()
    assert pps.receive(1.0) == [RawEdge(1_763_704_800_123_456_789, 4_294_967_295, "assert", kernel_stamp=True)]
    pps.close()


def test_fifo_outlives_its_writers(fifo: Path, source: FixedPps) -> None:
    for number in range(3):
        with fifo.open("wb", buffering=0) as writer:
            writer.write(line(2 * number))
            assert collect(source, 1) == [edge(2 * number)]
            writer.write(line(2 * number + 1))
            assert collect(source, 1) == [edge(2 * number + 1)]
        assert source.receive(0.05) == []
    assert source.garbage_lines == 0


def test_a_fifo_without_a_writer_is_silent_and_uses_no_cpu(source: FixedPps) -> None:
    started_s, load_s = time.monotonic(), time.process_time()
    assert source.receive(0.5) == []
    assert time.monotonic() - started_s >= 0.49
    assert time.process_time() - load_s < 0.25


def test_lines_written_in_pieces_are_joined(fifo: Path, source: FixedPps) -> None:
    with fifo.open("wb", buffering=0) as writer:
        for byte in line(7):
            writer.write(bytes([byte]))
            if byte != ord("\n"):
                assert source.receive(0.0) == []
        assert collect(source, 1) == [edge(7)]


def test_an_unfinished_line_of_one_writer_is_not_joined_to_the_next(fifo: Path, source: FixedPps) -> None:
    with fifo.open("wb", buffering=0) as writer:
        writer.write(line(1) + line(2)[:12])
        assert collect(source, 1) == [edge(1)]
    assert source.receive(0.05) == []
    with fifo.open("wb", buffering=0) as writer:
        writer.write(line(3))
        assert collect(source, 1) == [edge(3)]
    assert source.garbage_lines == 1


@pytest.mark.parametrize(
    "garbage",
    [b"\n", b"# comment\n", b"1 2 3\n", b"12\n", b"-5 3\n", b"1.5 2\n", b"9223372036854775808 1\n", b"\xff\xfe \x00\n"],
)
def test_garbage_is_counted_and_skipped(fifo: Path, source: FixedPps, garbage: bytes) -> None:
    with fifo.open("wb", buffering=0) as writer:
        writer.write(line(1) + garbage + line(2))
        assert collect(source, 2) == [edge(1), edge(2)]
    assert source.garbage_lines == 1


def test_an_unterminated_line_delays_nothing_and_is_counted_once(fifo: Path, source: FixedPps) -> None:
    with fifo.open("wb", buffering=0) as writer:
        for _ in range(20):
            writer.write(b"9" * 4000)
            assert source.receive(0.0) == []
        writer.write(b"\n" + line(4))
        assert collect(source, 1) == [edge(4)]
    assert source.garbage_lines == 1
    assert len(source._partial) == 0


def test_a_replaced_fifo_is_reopened_by_its_session(fifo: Path) -> None:
    session: Session[RawEdge] = Session(lambda: FixedPps(str(fifo)), pause=lambda _: None)
    session.receive(0.0)
    fifo.unlink()
    assert session.receive(0.1) == []
    assert "no such file" in session.last_error
    os.mkfifo(fifo)
    deadline_s = time.monotonic() + 30.0
    while session.openings < 2 and time.monotonic() < deadline_s:
        session.receive(0.0)
    with fifo.open("wb", buffering=0) as writer:
        writer.write(line(1))
        assert session.receive(5.0) == [edge(1)]
    session.close()


def test_a_truncated_file_raises_a_transport_error(tmp_path: Path) -> None:
    path = tmp_path / "edges"
    path.write_bytes(line(0) + line(1))
    pps = FixedPps(str(path))
    pps.open()
    assert len(pps.receive(1.0)) == 2
    path.write_bytes(line(2))
    with pytest.raises(TransportError, match="was cut short"):
        pps.receive(1.0)
    pps.close()


@pytest.mark.parametrize("name", ["fixed", "fifo"])
def test_close_from_another_thread_ends_a_blocked_receive(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    os.mkfifo(path) if name == "fifo" else path.write_bytes(b"")
    pps = FixedPps(str(path))
    pps.open()
    got: list[object] = []
    thread = threading.Thread(target=lambda: got.append(pps.receive(60.0)))
    thread.start()
    time.sleep(0.1)
    pps.close()
    thread.join(timeout=30.0)
    assert got == [[]]
    with pytest.raises(TransportError, match="is closed"):
        pps.receive(0.0)


@pytest.mark.parametrize(
    ("source", "says"),
    [
        (FixedPps("/nonexistent/edges"), "no such file; want a file or FIFO with lines of 'realtime_ns sequence'"),
        (FixedPps("/tmp"), "is a directory"),
        (KernelPps("/dev/pps_absent"), "no such PPS device; check that its driver is loaded"),
        (KernelPps("/dev/null"), "/dev/null: is not a PPS device; want /dev/ppsN"),
        (KernelPps("/tmp"), "/tmp: is not a PPS device; want /dev/ppsN"),
        (SerialDcdPps("/dev/ttyS_absent"), "/dev/ttyS_absent does not exist"),
        (SerialDcdPps("/dev/null"), "cannot wait for DCD"),
    ],
)
def test_error_on_opening_gives_the_reason(source: PpsSource, says: str) -> None:
    with pytest.raises(TransportError, match=says) as caught:
        source.open()
    assert "\n" not in str(caught.value)
    with pytest.raises(TransportError, match="is closed"):
        source.receive(0.0)
    source.close()


def test_error_for_an_unreadable_device_names_the_udev_rule(monkeypatch: pytest.MonkeyPatch) -> None:
    """root may open anything, so the refusal is simulated; the wording is what is tested."""

    def refuse(*_: object) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("os.open", refuse)
    with pytest.raises(TransportError) as caught:
        KernelPps("/dev/pps0").open()
    assert "/dev/pps0: not permitted" in str(caught.value)
    assert 'udev rule (KERNEL=="pps[0-9]*", GROUP="swath", MODE="0660")' in str(caught.value)


def test_a_pty_without_dcd_is_refused() -> None:
    master, slave = os.openpty()
    with pytest.raises(TransportError, match="cannot wait for DCD"):
        SerialDcdPps(os.ttyname(slave)).open()
    os.close(master)
    os.close(slave)


def test_a_kernel_source_that_vanishes_or_is_replaced_raises_a_transport_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = tmp_path / "pps0"

    def silent(fd: int, request: int, argument: bytes) -> bytes:
        """Answer an ioctl as a source that has had one edge and no more, and remains so when it is unregistered."""
        if request == PPS_FETCH and FETCH_DATA.unpack(argument)[9:11] != (0, 0):
            raise TimeoutError
        values = {
            PPS_GETCAP: (1).to_bytes(4, sys.byteorder),
            PPS_GETPARAMS: PARAMETERS.pack(1, 1, *(0,) * 6),
            PPS_FETCH: FETCH_DATA.pack(1, 0, 1_800_000_000, 0, 0, 0, 0, 0, 0, 0, 0, 0),
        }
        return values[request]

    monkeypatch.setattr("fcntl.ioctl", silent)
    for replaced, says in ((False, "no such PPS device"), (True, "was replaced by another PPS device")):
        device.write_bytes(b"")
        source = KernelPps(str(device))
        source.open()
        assert source.receive(0.1) == []
        device.rename(tmp_path / "gone")
        if replaced:
            device.write_bytes(b"")
        with pytest.raises(TransportError, match=says):
            source.receive(0.1)
        source.close()


def test_ioctl_numbers_and_layouts_match_the_kernel_header() -> None:
    """The numbers were printed by a C program with <linux/pps.h> on a 64-bit machine."""
    assert struct.calcsize("@P") == 8
    assert (PPS_GETPARAMS, PPS_SETPARAMS, PPS_GETCAP, PPS_FETCH) == (0x800870A1, 0x400870A2, 0x800870A3, 0xC00870A4)
    assert PARAMETERS.size == 40
    assert FETCH_DATA.size == 64


def test_both_edges_are_read_from_the_kernel_structure() -> None:
    """The struct pps_fdata is laid out by hand, offset by offset."""
    answer = bytearray(64)
    struct.pack_into("<II", answer, 0, 17, 16)
    struct.pack_into("<qi", answer, 8, 1_763_704_800, 123_456_789)
    struct.pack_into("<qi", answer, 24, 1_763_704_799, 223_456_790)
    assert edge_of(bytes(answer), "assert") == RawEdge(1_763_704_800_123_456_789, 17, "assert")
    assert edge_of(bytes(answer), "clear") == RawEdge(1_763_704_799_223_456_790, 16, "clear")


@pytest.mark.parametrize(
    ("before", "changes", "carrier", "expected"),
    [
        (10, 11, True, ("assert", 5)),  # the line rose and stayed high
        (11, 12, False, ("clear", 6)),
        (10, 12, False, ("assert", 5)),  # a short pulse: up and down again before the thread ran
        (10, 13, True, ("assert", 5)),
        (10, 10, True, ("assert", 5)),  # a driver that wakes readers before it counts
    ],
)
def test_a_dcd_edge_is_timed_at_wake_up(before: int, changes: int, carrier: bool, expected: tuple[str, int]) -> None:
    assert edge_at_wake_up(before, changes, carrier) == expected


def test_dcd_sequence_shows_a_missed_pulse() -> None:
    first = edge_at_wake_up(10, 12, False)
    second = edge_at_wake_up(12, 14, False)
    after_one_missed = edge_at_wake_up(16, 18, False)
    assert [first[1], second[1], after_one_missed[1]] == [5, 6, 8]


def test_lines_that_are_not_an_edge_are_counted_as_refused(tmp_path: Path) -> None:
    """A writer that sends seconds instead of nanoseconds must not look silent."""
    path = tmp_path / "edges"
    path.write_text("1700000000.5 1\n1700000001000000000 2\n1700000001.5 3\n")
    session: Session[RawEdge] = Session(lambda: FixedPps(str(path)))
    session.receive(0.0)
    assert [edge.sequence for edge in session.receive(1.0)] == [2]
    assert session.poll_counters().refused == 2
    session.close()
    assert session.poll_counters().refused == 2
