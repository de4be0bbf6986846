"""Tests devices in asyncio on ptys, UDP, TCP and CAN: records, losses, back-pressure, reconnection, cancellation."""

from __future__ import annotations

import ast
import asyncio
import datetime as dt
import json
import os
import socket
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

import swath
import swath.aio
from swath.daemon.log.parts import RECORDING_SIGN
from swath.drivers.can_frames import encode_can_frame
from swath.drivers.captures.opening import read_pcap
from swath.drivers.scanner.srep.layout import SrepHeader, encode_datagram
from swath.georef.records import GnssFix, InsSolution, ScannerReturns, TimeMessage
from tests.builders import ROOT
from tests.daemon.builders import INFO, nmea_sentence, scanner, write_part
from tests.daemon.rig import Recorder, free_udp_port, one_processor, session_table
from tests.daemon.wires import pty, tcp_server, udp_sender
from tests.library.builders import examples

PULSES = 10
LIMIT_S = 60.0
GROUP = "239.74.163.7"


def epoch(second: int) -> bytes:
    """Return the messages of a receiver for one second."""
    clock = f"1015{second % 60:02}.00"
    return nmea_sentence(f"GPRMC,{clock},A,4730.0000,N,00900.0000,E,0.0,0.0,211126,,,A") + nmea_sentence(
        f"GPGGA,{clock},4730.0000,N,00900.0000,E,1,12,0.8,500.0,M,47.0,M,,"
    )


def srep(sequence: int) -> bytes:
    header = SrepHeader(sequence=sequence, flags=1, pps_count=3, pps_ticks=1_000_000, first_ticks=1_500_000)
    ticks = np.arange(PULSES)
    return encode_datagram(header, ticks * 50, ticks * 100, np.full((PULSES, 1), 9_000_000))


def send_all(port: int, datagrams: list[bytes], rest_every: int = 50) -> None:
    """Send datagrams in order, not faster than a small buffer takes."""
    with one_processor(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for number, datagram in enumerate(datagrams):
            sock.sendto(datagram, ("127.0.0.1", port))
            if number % rest_every == 0:
                time.sleep(0.001)


def threads() -> set[str]:
    return {thread.name for thread in threading.enumerate()}


async def ended(condition: Callable[[], object]) -> None:
    """Wait in the loop until something is true."""
    async with asyncio.timeout(LIMIT_S):
        while not condition():  # noqa: ASYNC110  (what is waited for happens in a wire's thread)
            await asyncio.sleep(0.01)


# ---------------------------------------------------------------------------------------------- one device


async def test_a_receiver_on_a_port_gives_its_records_one_by_one() -> None:
    """The kind follows from the protocol; leaving the block ends the thread and frees the port."""
    found: list[Any] = []
    with pty(epoch) as path:
        async with swath.aio.open(f"serial:{path}?baud=115200", protocol="nmea") as rover:
            assert rover.source == "gnss/device"
            async for record in rover.records():
                found.append(record)
                if len(found) == 6:
                    break
            status = rover.status
            again = [fix async for fix in first(rover.batches(), 2)]
            begun = time.monotonic()
        assert time.monotonic() - begun < 2.0
        assert "gnss/device" not in threads()
        async with swath.aio.open(f"serial:{path}?baud=115200", protocol="nmea") as rover:
            assert [len(unit) > 0 async for _, unit in first(rover.units(), 2)] == [True, True]
    assert {type(record) for record in found} == {GnssFix, TimeMessage}
    assert all(abs(record.host_time_ns - time.time_ns()) < 60e9 for record in found)
    assert [len(records) > 0 for records in again] == [True, True]
    assert (status.state, status.openings, status.damaged, status.last_error) == ("receiving", 1, 0, "")
    assert status.records["GnssFix"] >= 3
    assert status.bytes > 0 < status.units
    assert rover.status.state == "closed"


async def first(items: Any, count: int) -> Any:
    """Yield the first items, then leave the rest to the next reader."""
    async for item in items:
        yield item
        count -= 1
        if not count:
            return


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("udp:0.0.0.0:2368", "vlp16"), "unknown protocol 'vlp16'; did you mean velodyne-vlp16?"),
        (("udp:0.0.0.0:56300", "livox-mid360"), 'is of several kinds; add kind="imu" or kind="scanner"'),
        (("can:socketcan:can0", "nmea"), r"swath.aio.open: gnss.device.transport: .*can:"),
        (("seriell:/dev/nowhere", "nmea"), "transport 'seriell:/dev/nowhere': want serial:<path>"),
        (("udp:0.0.0.0:2368", "srep"), "swath.aio.open: scanner.device.mirror_factor: missing; srep needs it"),
        (("serial:/dev/nowhere", "nmea", "bauds"), "gnss.device.bauds: unknown key"),
    ],
)
def test_a_wrong_device_is_answered_in_a_sentence(arguments: tuple[str, ...], words: str) -> None:
    transport, protocol, *names = arguments
    options: dict[str, Any] = dict.fromkeys(names, 1)
    with pytest.raises(swath.SwathError, match=words) as caught:
        swath.aio.open(transport, protocol, **options)
    assert "\n" not in str(caught.value)


def test_a_pulse_is_opened_beside_its_device() -> None:
    device = swath.aio.open("serial:/dev/nowhere", "nmea", pps="/dev/pps7")
    assert list(device._listening.listeners) == ["pps/main", "gnss/device"]
    assert (device.status.state, device.status.time_state) == ("opening", "NO_TIME")
    with pytest.raises(swath.SwathError, match=r"pps\.main\.source: PPS source 'pps7': want /dev/pps0"):
        swath.aio.open("serial:/dev/nowhere", "nmea", pps="pps7")


def test_wrong_settings_of_the_queue_are_answered_in_a_sentence(tmp_path: Path) -> None:
    wrong: dict[str, Any] = {"overflow": "lose"}
    with pytest.raises(swath.SwathError, match="overflow 'lose': want wait or drop"):
        swath.aio.open("udp:0.0.0.0:2368", "raw", **wrong)
    with pytest.raises(swath.SwathError, match="queue_mb 0: want a positive number"):
        swath.aio.open("udp:0.0.0.0:2368", "raw", queue_mb=0)
    with pytest.raises(swath.SwathError, match=r"none\.toml: No such file or directory"):
        swath.aio.open_config(tmp_path / "none.toml")
    with pytest.raises(swath.SwathError, match="is not a directory"):
        swath.aio.follow(tmp_path / "none")


async def test_an_absent_device_is_an_error_or_waited_for(tmp_path: Path) -> None:
    link = tmp_path / "rover"
    with pytest.raises(swath.SwathError, match="rover does not exist"):
        async with swath.aio.open(f"serial:{link}", protocol="nmea"):
            pass
    async with swath.aio.open(f"serial:{link}", protocol="nmea", wait=True) as rover:
        await ended(lambda: rover.status.state == "absent")
        assert "does not exist" in rover.status.last_error
        with pytest.raises(swath.SwathError, match="does not exist"):
            await rover.send(b"log version\r\n")
        with pty(epoch) as path:
            link.symlink_to(path)
            async for received in rover.received():
                assert received.host_time_ns.tolist() == [getattr(received.record, "host_time_ns", None)]
                break
            assert rover.status.openings == 1
            await rover.send(b"log version\r\n")


async def test_a_port_that_was_unplugged_is_opened_again(tmp_path: Path) -> None:
    link = tmp_path / "rover"
    async with asyncio.timeout(LIMIT_S):
        with pty(epoch) as path:
            link.symlink_to(path)
            rover = swath.aio.open(f"serial:{link}", protocol="nmea")
            await rover.__aenter__()
            assert [1 async for _ in first(rover.records(), 3)] == [1, 1, 1]
        await ended(lambda: rover.status.state == "absent")
        link.unlink()
        with pty(epoch) as path:
            link.symlink_to(path)
            await ended(lambda: rover.status.openings == 2)
            count = rover.status.records["GnssFix"]
            await ended(lambda: rover.status.records["GnssFix"] > count)
            assert "disconnected" in rover.status.last_error or "connected" in rover.status.last_error
            await rover.__aexit__()


async def test_a_tcp_connection_that_broke_is_made_again() -> None:
    with tcp_server(epoch) as port:
        rover = swath.aio.open(f"tcp:127.0.0.1:{port}", protocol="nmea")
        await rover.__aenter__()
        assert [1 async for _ in first(rover.records(), 3)] == [1, 1, 1]
    with socket.create_server(("127.0.0.1", port), reuse_port=False) as server:
        server.settimeout(LIMIT_S)
        peer, _ = await asyncio.to_thread(server.accept)
        with peer:
            peer.sendall(epoch(59) * 3)
            await ended(lambda: rover.status.openings == 2 and rover.status.state == "receiving")
            await rover.__aexit__()


async def test_cancelling_a_task_closes_its_wire_at_once() -> None:
    port = free_udp_port()
    entered = asyncio.Event()

    async def job() -> None:
        async with swath.aio.open(f"udp:127.0.0.1:{port}", protocol="raw") as device:
            entered.set()
            async for _ in device.units():
                pass

    task = asyncio.create_task(job())
    await entered.wait()
    begun = time.monotonic()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert time.monotonic() - begun < 2.0
    assert "raw/device" not in threads()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", port))


async def test_leaving_a_loop_leaves_the_rest_of_a_reading_to_the_next() -> None:
    port, count = free_udp_port(), 100
    async with swath.aio.open(f"udp:127.0.0.1:{port}?buffer_mb=4", protocol="raw") as device:
        await asyncio.to_thread(send_all, port, [number.to_bytes(4, "big") for number in range(count)])
        got: list[int] = []
        async with asyncio.timeout(LIMIT_S):
            while len(got) < count:
                async for _, unit in device.units():
                    got.append(int.from_bytes(unit, "big"))
                    break
    assert got == list(range(count))


async def test_two_tasks_cannot_read_one_device() -> None:
    async with swath.aio.open(f"udp:127.0.0.1:{free_udp_port()}", protocol="raw") as device:
        task: asyncio.Future[Any] = asyncio.ensure_future(anext(device.units()))
        await asyncio.sleep(0.05)
        with pytest.raises(swath.SwathError, match="another task already reads from here"):
            await anext(device.blocks())
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


# ---------------------------------------------------------------------------------------------- scanners


async def test_a_scanner_gives_batches_and_every_datagram_is_in_one() -> None:
    port, count = free_udp_port(), 2000
    rows = 0
    async with swath.aio.open(
        f"udp:127.0.0.1:{port}?buffer_mb=4", protocol="srep", mirror_factor=2, queue_mb=512
    ) as scanner:
        sender = asyncio.create_task(asyncio.to_thread(send_all, port, [srep(number) for number in range(count)]))
        batches = 0
        async with asyncio.timeout(LIMIT_S):
            async for records in scanner.batches():
                batches += 1
                rows += sum(len(record.rows) for record in records if isinstance(record, ScannerReturns))
                if rows == PULSES * count:
                    break
        await sender
        status = scanner.status
    assert status.units == count
    assert (status.lost_kernel, status.dropped, status.damaged, status.errors) == (0, 0, 0, {})
    assert status.records["ScannerReturns"] == rows
    assert batches < count / 2  # single datagrams are decoded and handed over together


async def test_a_slow_reader_that_chose_to_drop_loses_the_oldest_and_they_are_counted() -> None:
    port, count = free_udp_port(), 3000
    async with swath.aio.open(
        f"udp:127.0.0.1:{port}?buffer_mb=4", "srep", mirror_factor=2, overflow="drop", queue_mb=0.1
    ) as scanner:
        await asyncio.to_thread(send_all, port, [srep(number) for number in range(count)])
        await ended(lambda: scanner.status.units == count)
        rows = 0
        while rows < PULSES * (count - scanner.status.dropped):
            async for table in scanner.tables("returns"):
                rows += len(table)
                break
        assert rows == PULSES * (count - scanner.status.dropped)
        assert 0 < scanner.status.dropped < count
        assert table.dtype.names is not None
        assert table.dtype.names[:3] == ("gps_ns", "time_sigma_s", "host_time_ns")
        with pytest.raises(swath.SwathError, match="no records 'return'; want one of: fixes"):
            await anext(scanner.tables("return"))


async def test_both_ports_of_a_head_feed_one_parser() -> None:
    """The VLP-16 tells by its position packets, on their own port, that it is locked to its PPS."""
    data, position = free_udp_port(), free_udp_port()
    recorded = list(read_pcap(ROOT / "fixtures/velodyne/mrpt_vlp16_gps.pcap.gz"))
    streams = [[unit.data for unit in recorded if len(unit.data) == length] for length in (1206, 512)]
    found: set[str] = set()
    wires: set[str] = set()
    with (
        udp_sender(data, lambda n: streams[0][n % len(streams[0])]),
        udp_sender(position, lambda n: streams[1][n % len(streams[1])]),
    ):
        async with swath.aio.open(
            f"udp:127.0.0.1:{data}?buffer_mb=1",
            protocol="velodyne-vlp16",
            auxiliary=f"udp:127.0.0.1:{position}?buffer_mb=1",
        ) as head:
            async with asyncio.timeout(LIMIT_S):
                async for record in head.records():
                    found.add(type(record).__name__)
                    if {"ScannerReturns", "TimeMessage"} <= found:
                        break
                async for block in head.blocks():
                    wires.add(block.source)
                    if len(wires) == 2:
                        break
    assert wires == {"scanner/device", "scanner/device/aux"}


# ---------------------------------------------------------------------------------------------- back-pressure


def numbered(count: int) -> bytes:
    return b"".join(b"%09d\n" % number for number in range(count))


async def collected(device: swath.aio.Device, size: int) -> bytes:
    """Read slowly until so many bytes have come."""
    got = b""
    async with asyncio.timeout(LIMIT_S):
        async for _, unit in device.units():
            got += unit
            if len(got) >= size:
                break
            await asyncio.sleep(0.002)
    return got


async def test_a_slow_reader_loses_nothing_over_tcp() -> None:
    data = numbered(100_000)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            peer, _ = server.accept()
            with peer:
                peer.sendall(data)
                peer.recv(1)  # until the other end closes

        thread = threading.Thread(target=serve)
        thread.start()
        address = f"tcp:127.0.0.1:{server.getsockname()[1]}"
        async with swath.aio.open(address, protocol="raw", queue_mb=0.05) as device:
            assert await collected(device, len(data)) == data
            assert device.status.dropped == 0
        await asyncio.to_thread(thread.join)


async def test_a_slow_reader_loses_nothing_over_a_port() -> None:
    data = numbered(20_000)
    main, secondary = os.openpty()
    tty.setraw(secondary)

    def write() -> None:
        rest = data
        while rest:
            rest = rest[os.write(main, rest[:1000]) :]

    thread = threading.Thread(target=write)
    try:
        async with swath.aio.open(f"serial:{os.ttyname(secondary)}", protocol="raw", queue_mb=0.01) as device:
            thread.start()
            assert await collected(device, len(data)) == data
        await asyncio.to_thread(thread.join)
    finally:
        os.close(main)
        os.close(secondary)


# ---------------------------------------------------------------------------------------------- CAN


@pytest.mark.parametrize(("interface", "channel"), [("virtual", "swath-aio"), ("udp_multicast", GROUP)])
async def test_frames_of_a_bus_come_and_go(interface: str, channel: str) -> None:
    keywords: dict[str, Any] = {"port": free_udp_port()} if interface == "udp_multicast" else {}
    text = "".join(f"?{key}={value}" for key, value in keywords.items())
    frames = [encode_can_frame(0x100 + number % 5, number.to_bytes(8, "little")) for number in range(100)]
    async with swath.aio.open(f"can:{interface}:{channel}{text}", protocol="raw") as device:
        with can.Bus(interface=interface, channel=channel, ignore_config=True, **keywords) as bus:
            for number in range(100):
                bus.send(can.Message(arbitration_id=0x100 + number % 5, data=number.to_bytes(8, "little"),
                                     is_extended_id=False))  # fmt: skip
            async with asyncio.timeout(LIMIT_S):
                assert [unit async for _, unit in first(device.units(), 100)] == frames
                await device.send(encode_can_frame(0x7, b"hello"))
                answer = await asyncio.to_thread(heard, bus)
            assert (answer.arbitration_id, bytes(answer.data)) == (0x7, b"hello")
            assert device.status.lost_kernel == 0


def heard(bus: can.BusABC) -> can.Message:
    """Return the next frame that another one sent; a multicast bus hears itself."""
    while (message := bus.recv(LIMIT_S)) is not None:
        if message.arbitration_id == 0x7:
            return message
    raise AssertionError("no frame came")


# ---------------------------------------------------------------------------------------------- a configuration


@contextmanager
def configured(folder: Path, tables: str) -> Iterator[Path]:
    path = folder / "swath.toml"
    path.write_text(f'[session]\nname = "aio"\ndirectory = "."\n{tables}')
    yield path


async def test_every_sensor_of_a_configuration_comes_with_its_name(tmp_path: Path) -> None:
    """A SPAN receiver has an IMU inside its stream; the scanner is absent, and is waited for."""
    data = (ROOT / "fixtures/novatel/ins1.gps").read_bytes()
    port = free_udp_port()
    found: dict[str, set[type]] = {}
    with pty(lambda number: data[number * 2000 % len(data) :][:2000]) as path:
        tables = (
            f'[gnss.rover]\ntransport = "serial:{path}"\nprotocol = "novatel"\n'
            '[imu.main]\ntransport = "gnss:rover"\nprotocol = "novatel"\n'
            f'[scanner.left]\ntransport = "udp:192.0.2.1:{port}"\nprotocol = "srep"\nmirror_factor = 2\n'
        )
        with configured(tmp_path, tables) as config:
            async with swath.aio.open_config(config, times=False) as aircraft:
                assert aircraft.sources == ["gnss/rover", "imu/main", "scanner/left"]
                async with asyncio.timeout(LIMIT_S):
                    async for source, record in aircraft.records():
                        found.setdefault(source, set()).add(type(record))
                        if len(found) == 2:
                            break
                await ended(lambda: aircraft.status("scanner/left").state == "absent")
                inside, carrier = aircraft.status("imu/main"), aircraft.status("gnss/rover")
                with pytest.raises(swath.SwathError, match="has no source 'imu/other'; it has: gnss/rover, imu/main"):
                    aircraft.status("imu/other")
                with pytest.raises(swath.SwathError, match="has no wire 'imu/main'; it has: gnss/rover, scanner/left"):
                    await aircraft.send("imu/main", b"")
    assert set(found) == {"gnss/rover", "imu/main"}
    assert found["imu/main"] == {InsSolution}
    assert (inside.units, inside.state) == (0, carrier.state) == (0, "receiving")
    assert inside.records["InsSolution"] > 0


@pytest.mark.slow
async def test_the_examples_of_the_documentation_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each goes on until it is cancelled, and has printed something by then."""
    span = (ROOT / "fixtures/novatel/ins1.gps").read_bytes()
    packets = [unit.data for unit in read_pcap(ROOT / "fixtures/velodyne/mrpt_vlp16_gps.pcap.gz")]
    packets = [packet for packet in packets if len(packet) == 1206]
    logs, (data, position) = tmp_path / "logs", (free_udp_port(), free_udp_port())
    logs.mkdir()
    monkeypatch.chdir(tmp_path)
    with (
        pty(lambda number: span[number * 2000 % len(span) :][:2000]) as path,
        pty(epoch) as other,
        udp_sender(data, lambda number: packets[number % len(packets)]),
    ):
        (tmp_path / "swath.toml").write_text(
            f'[session]\nname = "x"\ndirectory = "."\n[gnss.rover]\ntransport = "serial:{path}"\nprotocol = "novatel"\n'
        )
        tables = session_table(logs) + f'[gnss.rover]\ntransport = "serial:{other}"\nprotocol = "nmea"\n'
        places = {"/dev/ttyUSB0": path, "0.0.0.0:2368": f"127.0.0.1:{data}", "0.0.0.0:8308": f"127.0.0.1:{position}"}
        with await asyncio.to_thread(Recorder, tmp_path / "recorder", tables) as recorder:
            blocks = examples("docs/library/aio.md")
            assert len(blocks) > 5
            names: dict[str, Any] = {}
            for code, _ in blocks:
                for place, here in {**places, "/var/lib/swath": str(logs)}.items():
                    code = code.replace(place, here)
                compiled = compile(code, "docs/library/aio.md", "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
                with pytest.raises(TimeoutError):
                    await asyncio.wait_for(eval(compiled, names), 4.0)
                assert capsys.readouterr().out, code
            assert await asyncio.to_thread(recorder.stop) == 0


@pytest.mark.slow
async def test_records_have_gps_time_by_the_pulse(tmp_path: Path) -> None:
    """Pulses come at the whole seconds of this computer's clock, and the receiver names each 50 ms later."""
    fifo = tmp_path / "edges"
    os.mkfifo(fifo)
    edges = os.open(fifo, os.O_RDWR | os.O_NONBLOCK)
    main, secondary = os.openpty()
    tty.setraw(secondary)
    stop = threading.Event()

    def send() -> None:
        number = 0
        while not stop.is_set():
            second = time.time_ns() // 1_000_000_000 + 1
            time.sleep(max(0.0, second - time.time()))
            os.write(edges, f"{second * 1_000_000_000} {number}\n".encode())
            time.sleep(0.05)
            clock, date = time.strftime("%H%M%S.00 %d%m%y", time.gmtime(second)).split()
            rmc = nmea_sentence(f"GPRMC,{clock},A,4730.0000,N,00900.0000,E,0.0,0.0,{date},,,A")
            gga = nmea_sentence(f"GPGGA,{clock},4730.0000,N,00900.0000,E,1,12,0.8,500.0,M,47.0,M,,")
            os.write(main, rmc + gga)
            number += 1

    tables = (
        f'[pps.main]\nsource = "fixed:{fifo}"\n[gnss.rover]\ntransport = "serial:{os.ttyname(secondary)}"\n'
        'protocol = "nmea"\npps = "main"\nleap_seconds = 18\n'
        f'[scanner.left]\ntransport = "udp:127.0.0.1:{free_udp_port()}"\n'
        'protocol = "srep"\nmirror_factor = 2\npps = "main"\n'
    )
    thread = threading.Thread(target=send)
    thread.start()
    try:
        with configured(tmp_path, tables) as config:
            async with swath.aio.open_config(config) as aircraft, asyncio.timeout(LIMIT_S):
                while aircraft.status("pps/main").time_state != "LOCKED":
                    await anext(aircraft.batches())
                async for found in aircraft.records():
                    record, gps_ns = found.record, int(found.gps_ns[0])
                    if isinstance(record, TimeMessage) and gps_ns >= 0:
                        break
                status = aircraft.status("gnss/rover")
                pulse = aircraft.status("pps/main")
                source, fixes = await anext(aircraft.tables("fixes"))
    finally:
        stop.set()
        thread.join()
        for fd in (edges, main, secondary):
            os.close(fd)
    named = dt.datetime.fromtimestamp(int(found.host_time_ns[0]) // 1_000_000_000, dt.UTC)
    assert gps_ns == swath.gps_ns(named)  # with the 18 leap seconds of the table
    assert found.time_sigma_s.tolist() == [0.0]
    assert (status.time_state, pulse.time_state) == ("LOCKED", "LOCKED")
    assert 0.0 < pulse.time_sigma_s < 1e-3
    assert pulse.units >= 3
    assert source == "gnss/rover"
    assert (fixes["gps_ns"] > gps_ns - 5_000_000_000).all()


# ---------------------------------------------------------------------------------------------- a recorder's log


def whole(status: swath.aio.Status) -> bool:
    """Return whether every datagram that was read was decoded."""
    assert (status.damaged, status.dropped, status.errors.keys() - {"sequence_gap"}) == (0, 0, set())
    return status.records["ScannerReturns"] == PULSES * status.units > 0


@pytest.mark.slow
async def test_a_growing_log_is_followed_from_recording_to_recording(tmp_path: Path) -> None:
    """Following begins before anything is recorded, and goes on with the next recording in the directory."""
    logs, port = tmp_path / "logs", free_udp_port()
    logs.mkdir()
    with pty(epoch) as path, udp_sender(port, srep):
        tables = session_table(logs) + scanner(port) + f'[gnss.rover]\ntransport = "serial:{path}"\nprotocol = "nmea"\n'
        async with swath.aio.follow(logs) as log, asyncio.timeout(LIMIT_S):
            assert (log.sources, log.status("gnss/rover").state) == ([], "waiting")
            sessions: list[str] = []
            for number in range(2):
                with await asyncio.to_thread(Recorder, tmp_path / f"recorder-{number}", tables) as recorder:
                    found: set[tuple[str, type]] = set()
                    async for source, record in log.records():
                        found.add((source, type(record)))
                        if log.session_id in ["", *sessions]:
                            found.clear()  # what was left of the recording before
                        elif {("gnss/rover", GnssFix), ("scanner/left", ScannerReturns)} <= found:
                            break
                    sessions.append(log.session_id)
                    assert log.status("scanner/left").state == "following"
                    reported: dict[str, str] = {}
                    async for source, _, values in log.reports():  # each second
                        reported[source] = values["state"]
                        if {"gnss/rover", "scanner/left"} <= set(reported):
                            break
                    assert set(reported.values()) <= {"receiving", "opening"}
                    assert await asyncio.to_thread(recorder.stop) == 0
                await ended(lambda: log.status("gnss/rover").state == "waiting")
                await ended(lambda: whole(log.status("scanner/left")))
            assert log.sources == ["gnss/rover", "scanner/left"]
    assert "follow" not in threads()


async def test_a_log_that_cannot_be_decoded_is_an_error(tmp_path: Path) -> None:
    """The log's configuration lacks the session's name."""
    recording = tmp_path / f"{INFO.session_id}_0.mcap"
    write_part(recording)
    sign = {"session_id": INFO.session_id, "part": 0, "path": recording.name, "boot_id": "boot"}
    (tmp_path / RECORDING_SIGN).write_text(json.dumps(sign))
    with pytest.raises(swath.SwathError, match=r"_0\.mcap: config\.toml in the log: "):
        async for _ in swath.aio.follow(tmp_path, tail_s=60.0):
            pass
    assert "follow" not in threads()


# ---------------------------------------------------------------------------------------------- import


def test_the_module_loads_on_demand_and_without_processing() -> None:
    code = (
        "import swath, sys; assert 'swath.aio' not in sys.modules; swath.aio.open; "
        "swath.aio.open('udp:0.0.0.0:2368', protocol='velodyne-vlp16'); "
        "print([name for name in ('numba', 'scipy', 'pyproj', 'laspy', 'matplotlib') if name in sys.modules])"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("[]\n", "")
