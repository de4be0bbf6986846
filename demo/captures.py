"""The recordings that the demonstration plays, as timed units that all begin at zero."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import takewhile
from pathlib import Path

from swath.daemon.replay.wire_player import TimedUnit
from swath.drivers.captures.opening import CapturedUnit, read_candump, read_pcap, read_serial
from swath.drivers.driver import find_driver
from swath.drivers.parser import DeviceSettings
from swath.georef.records import Chunk, TimeMessage, TimeScale
from swath.georef.timescales import SECOND_NS, WEEK_NS

FIXTURES = Path(__file__).resolve().parent.parent / "fixtures"
GNSS = FIXTURES / "novatel" / "propak6-basic-fix.gps.gz"
GNSS_CHUNKS = FIXTURES / "novatel" / "propak6-basic-fix.chunks.csv.gz"
CAN = FIXTURES / "canmod-gps" / "3BA199E2_00000164_00000005_candump.log.gz"
SCANNER = FIXTURES / "velodyne" / "mrpt_vlp16_gps.pcap.gz"

SCANNER_DATA_PORT = 2368
SCANNER_POSITION_PORT = 8308
FASTEST_MESSAGE_NS = 50_000_000  # the edge is placed so long before the least delayed message that names its second


def gnss_units() -> Iterator[TimedUnit]:
    """Yield the chunks of a NovAtel ProPak6 as they arrived."""
    return _from_zero(read_serial(GNSS, GNSS_CHUNKS), "gnss/rover")


def can_units() -> Iterator[TimedUnit]:
    """Yield the frames of a CANmod.gps between the other traffic of its bus."""
    return _from_zero(read_candump(CAN), "imu/main")


def scanner_units(seconds: float) -> Iterator[TimedUnit]:
    """Yield a VLP-16 and its position packets: 0.4 s of recording, played over and over at its own pace."""
    once = list(read_pcap(SCANNER))
    period_ns = once[-1].time_ns - once[0].time_ns + 1_327_000  # one packet's time behind the last, VLP-16 manual 9.3
    sources = {SCANNER_DATA_PORT: "scanner/top", SCANNER_POSITION_PORT: "scanner/top/aux"}
    ports = [sources[unit.destination[1]] for unit in once if unit.destination is not None]
    for turn in range(round(seconds * SECOND_NS / period_ns) + 1):
        for unit, source in zip(once, ports, strict=True):
            yield TimedUnit(unit.time_ns - once[0].time_ns + turn * period_ns, source, unit.data)


def pps_units(seconds: float) -> Iterator[TimedUnit]:
    """Yield edges that belong to the GNSS recording: it was made without its PPS, so its own epochs place them.

    Every epoch on a whole second names an edge; the least delay between the two is taken for all.
    """
    parser = find_driver("gnss", "novatel").make_parser(DeviceSettings("gnss/rover"))
    arrival_minus_gps = []
    for unit in gnss_units():
        for record in parser.feed(Chunk("gnss/rover", unit.time_ns, unit.data)):
            if isinstance(record, TimeMessage) and record.time.scale is TimeScale.GPS and record.time.week is not None:
                gps_ns = record.time.week * WEEK_NS + record.time.time_ns
                if gps_ns % SECOND_NS == 0:
                    arrival_minus_gps.append(unit.time_ns - gps_ns)
    edge_minus_gps = min(arrival_minus_gps) - FASTEST_MESSAGE_NS
    first_ns = edge_minus_gps % SECOND_NS
    for second in range(int(seconds) + 1):
        yield TimedUnit(first_ns + second * SECOND_NS, "pps/main", b"")


def until(units: Iterable[TimedUnit], seconds: float) -> Iterator[TimedUnit]:
    """Yield the units of the first seconds."""
    return takewhile(lambda unit: unit.time_ns < seconds * SECOND_NS, units)


def _from_zero(units: Iterable[CapturedUnit], source: str) -> Iterator[TimedUnit]:
    first_ns = None
    for unit in units:
        first_ns = unit.time_ns if first_ns is None else first_ns
        yield TimedUnit(unit.time_ns - first_ns, source, unit.data)
