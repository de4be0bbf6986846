"""Measure what listening to a scanner in asyncio costs: CPU time of the listening process, and losses.

python -m benchmarks.listen [--seconds 10] [--rate 20000] [--only LINE]

A process of its own sends datagrams that begin with their number; one ``async for`` of `swath.aio` receives them. The
lines differ in what the loop asks for: raw datagrams in blocks, raw datagrams one by one, or batches of decoded returns
of a line scanner with 60 pulses in a datagram, or of a VLP-16 at the 1508 datagrams a second of its dual returns,
whatever --rate says. "turns" is how many items the ``async for`` gave.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import tempfile
import time
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import swath.aio
from benchmarks.acquire import free_port, sender
from swath.drivers.captures.opening import read_pcap
from swath.drivers.scanner.srep.layout import SrepHeader, encode_datagram
from swath.georef.records import ScannerReturns

FIXTURES = Path(__file__).parents[1] / "fixtures"
LENGTH = 1206  # of a datagram of 384 returns of a VLP-16
VLP16_HZ = 1508.0
PACKET = 100  # of the recording: any with most of its returns
LINES = ("blocks", "units", "srep", "vlp16")
SREP_PULSES = 60  # of a datagram, with one return each
SREP_DATAGRAMS = 20_000  # they begin again after these, which counts as one gap of the sequence
REST_S = 1.0  # after the last datagram


@dataclass
class Figure:
    """One line of the table."""

    name: str
    sent: int
    received: int
    lost: int
    cpu_percent: float
    turns: int
    right: bool


async def listen(line: str, rate: float, seconds: float, folder: Path) -> Figure:
    """Listen to a sender, and return what it cost."""
    port = free_port()
    kind: tuple[Any, ...] = ("udp", port, LENGTH)
    protocol, options, length = "raw", dict[str, Any](), LENGTH
    if line == "vlp16":
        packets = [unit.data for unit in read_pcap(FIXTURES / "velodyne/mrpt_vlp16_gps.pcap.gz")]
        (folder / "packet").write_bytes([packet for packet in packets if len(packet) == LENGTH][PACKET])
        kind, protocol, rate = ("vlp16", port, folder / "packet"), "velodyne-vlp16", VLP16_HZ
    elif line == "srep":
        length = _write_srep(folder / "datagrams")
        kind, protocol, options = ("file", port, length, folder / "datagrams"), "srep", {"mirror_factor": 2.0}
    found: list[Any] = []
    async with swath.aio.open(f"udp:127.0.0.1:{port}", protocol, **options) as device:
        load = sender(*kind, rate, seconds)
        began_cpu_s = time.process_time()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds + REST_S):
                async for item in _items(device, line):
                    found.append(item)
        cpu = (time.process_time() - began_cpu_s) / seconds * 100
        status = device.status
        assert load.stdout is not None
        sent = int(load.stdout.read().split()[0])
        load.wait()
    if protocol != "raw":
        right = sum(found) == status.records["ScannerReturns"] and sum(found) % status.units == 0
    else:
        right = bool(np.array_equal(np.concatenate(found), np.arange(sent)))
    name = f"{line}, {rate:,.0f} × {length} B/s"
    return Figure(name, sent, status.units, status.lost_kernel + status.dropped, cpu, len(found), right)


def _write_srep(path: Path) -> int:
    """Write datagrams of a line scanner, and return their length."""
    ticks = np.arange(SREP_PULSES)
    ranges = np.full((SREP_PULSES, 1), 9_000_000)
    datagrams = [
        encode_datagram(
            SrepHeader(
                sequence=number, flags=1, pps_count=3, pps_ticks=1_000_000, first_ticks=1_500_000 + 3000 * number
            ),
            ticks * 50,
            ticks * 100,
            ranges,
        )
        for number in range(SREP_DATAGRAMS)
    ]
    path.write_bytes(b"".join(datagrams))
    return len(datagrams[0])


async def _items(device: swath.aio.Device, line: str) -> AsyncIterator[Any]:
    """Yield the numbers of the datagrams in each item, or of its returns."""
    if line == "blocks":
        async for block in device.blocks():
            yield np.ascontiguousarray(block.units[:, :8]).view("<u8")[:, 0]
    elif line == "units":
        async for _, unit in device.units():
            yield np.frombuffer(unit[:8], "<u8")
    else:
        async for records in device.batches():
            yield sum(len(record.rows) for record in records if isinstance(record, ScannerReturns))


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of each line")
    parser.add_argument("--rate", type=float, default=20_000.0, help="datagrams a second")
    parser.add_argument("--only", choices=LINES, action="append", help="measure only this line; may be repeated")
    arguments = parser.parse_args()
    print(f"{'line':<32} {'sent':>9} {'received':>9} {'lost':>6} {'CPU %':>6} {'turns':>8}  content")
    for line in arguments.only or LINES:
        with tempfile.TemporaryDirectory() as folder:
            figure = asyncio.run(listen(line, arguments.rate, arguments.seconds, Path(folder)))
        print(
            f"{figure.name:<32} {figure.sent:>9,} {figure.received:>9,} {figure.lost:>6} {figure.cpu_percent:6.1f} "
            f"{figure.turns:>8,}  {'as sent' if figure.right else 'WRONG'}"
        )


if __name__ == "__main__":
    main()
