"""Tests heads with sufficient time: the origin of a log's stamps is found before any return is placed."""

from __future__ import annotations

import datetime as dt
import json
from collections.abc import Iterable
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pytest

from swath.daemon.config import Config, parse_config
from swath.daemon.errors import UserError
from swath.daemon.exchange.captures import ImportUnit
from swath.daemon.exchange.import_ import ImportLog
from swath.daemon.exchange.routes import Routes
from swath.daemon.log.chunk_index import index_log
from swath.daemon.log.reader import open_logs
from swath.daemon.processing.head_clocks import find_stamps, stamp_lines
from swath.daemon.processing.points.clocks import read_clocks
from swath.daemon.processing.points.time_checks import refuse_no_time, time_trouble
from swath.daemon.processing.setup.setup import Setup
from swath.drivers.scanner.hesai.gps import encode_gps_packet
from swath.drivers.scanner.hesai.parser import encode_point_packet
from swath.drivers.scanner.velodyne.parser import encode_data_packet
from swath.drivers.scanner.velodyne.position import PPS_ABSENT, PPS_LOCKED, PPS_SYNCHRONIZING, encode_position_packet
from swath.georef.records import DEVICE_CLOCK_DTYPE
from swath.georef.stream.clocks import FrozenClocks
from swath.georef.timescales import StampScale

NS = 1_000_000_000
START = dt.datetime(2026, 6, 15, 9, 59, 50, tzinfo=dt.UTC)  # the hour turns ten seconds later
START_UNIX_NS = int(START.timestamp()) * NS
UNIX_MINUS_GPS_S, LEAP = 315_964_800, 18
SECONDS, LATENCY_NS = 20, 2_000_000
ROLLOVER = dt.timedelta(weeks=1024)
CLOCK_WRONG_NS = 300_000_000  # error of the recording computer, which nothing synchronised
HEAD = 'transport = "udp:0.0.0.0:2368"\ninstallation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n'
RECEIVER = (
    '[pps.main]\nsource = "/dev/pps0"\n[gnss.rover]\ntransport = "serial:/dev/ttyS0?baud=115200"\nprotocol = "nmea"\n'
    'pps = "main"\n'
)

Units = list[tuple[str, int, bytes]]  # source, time of arrival, bytes


def rmc(second: int, status: str = "A", off: dt.timedelta = dt.timedelta()) -> bytes:
    at = START + dt.timedelta(seconds=second) + off
    body = f"GPRMC,{at:%H%M%S}.00,{status},4724.0,N,00830.0,E,0.0,0.0,{at:%d%m%y},,,A"
    return f"${body}*{reduce(xor, body.encode()):02X}".encode()


def receiver() -> Units:
    """Return edges at each second and RMC 0.2 s later."""
    units: Units = []
    for second in range(SECONDS):
        edge_ns = START_UNIX_NS + second * NS
        value = {"edge_time_ns": edge_ns + CLOCK_WRONG_NS, "sequence": second}
        units.append(("pps/main", edge_ns + 1_000_000, json.dumps(value).encode()))
        units.append(("gnss/rover", edge_ns + 200_000_000, rmc(second) + b"\r\n"))
    return units


def past_hour_us(unix_us: int, *, goes_on: bool) -> int:
    """Return the time past the UTC hour, µs; with `goes_on`, past the hour in which the log began."""
    hour_us = 3_600_000_000
    return unix_us - START_UNIX_NS // 1000 // hour_us * hour_us if goes_on else unix_us % hour_us


def velodyne(off_us: int = 0, *, goes_on: bool = False) -> Units:
    """Return a data packet every 50 ms, stamped past the hour of UTC plus `off_us`."""
    units: Units = []
    for number in range(SECONDS * 20):
        unix_us = START_UNIX_NS // 1000 + number * 50_000
        stamp_us = past_hour_us(unix_us + off_us, goes_on=goes_on)
        data = encode_data_packet(stamp_us, np.arange(12) * 40, np.zeros((12, 32)), 0)
        units.append(("scanner/top", unix_us * 1000 + LATENCY_NS, data))
    return units


def positions(
    *, goes_on: bool = False, pps: int = PPS_LOCKED, status: str | None = "A", off: dt.timedelta = dt.timedelta()
) -> Units:
    """Return two position packets a second with the second's sentence: valid, void, or none if `status` is None.

    `off` is the error of the sentences' time.
    """
    units: Units = []
    for half in range(1, 2 * SECONDS):
        unix_us = START_UNIX_NS // 1000 + half * 500_000 + 250_000
        stamp_us = past_hour_us(unix_us, goes_on=goes_on)
        sentence = "" if status is None else rmc((half * 500 + 250) // 1000, status, off).decode()
        data = encode_position_packet(stamp_us, pps, sentence)
        units.append(("scanner/top/aux", unix_us * 1000 + LATENCY_NS, data))
    return units


def hesai(scale_s: int) -> Units:
    """Return a packet every 50 ms by PTP, its date and time on a scale `scale_s` ahead of UTC."""
    units: Units = []
    for number in range(SECONDS * 20):
        at = START + dt.timedelta(milliseconds=50 * number)
        data = encode_point_packet(
            at + dt.timedelta(seconds=scale_s), np.arange(8) * 18, np.zeros((8, 32)), 0, sequence=number
        )
        units.append(("scanner/top", START_UNIX_NS + number * NS // 20 + LATENCY_NS, data))
    return units


def found(folder: Path, text: str, units: Iterable[tuple[str, int, bytes]]) -> tuple[Setup, FrozenClocks]:
    """Write a log of the units; return it with its clocks."""
    config: Config = parse_config(f'[session]\nname = "heads"\ndirectory = "."\n{text}', folder / "swath.toml")
    wires = Routes.of(config).ports
    log: ImportLog | None = None
    for source, at_ns, data in sorted(units, key=lambda unit: unit[1]):
        stamped = ImportUnit(at_ns + CLOCK_WRONG_NS, wires[source], data)
        log = log or ImportLog(config, folder / "logs", stamped.time_ns)
        log.add(stamped)
    assert log is not None
    log.finish()
    (session,) = open_logs([folder / "logs"])
    setup = Setup.of_log(session.attachments())
    return setup, find_stamps(index_log(session), setup.sources, read_clocks(session, setup.sources).clocks.host)


def errors_ns(clocks: FrozenClocks, stamps_ns: list[int], locked: int | list[int]) -> tuple[list[int], float]:
    """Return errors (ns) of stamps every 50 ms over the log, placed as in a job, and the largest sigma (ns)."""
    times = START_UNIX_NS + np.arange(SECONDS * 20, dtype=np.int64) * NS // 20
    rows = np.zeros(len(times), DEVICE_CLOCK_DTYPE)
    rows["host_time_ns"], rows["device_time_ns"] = times + LATENCY_NS + CLOCK_WRONG_NS, stamps_ns
    rows["pps_time_ns"] = rows["pps_count"] = -1
    rows["locked"] = locked
    stream = clocks.for_stream()
    stream.add_samples("scanner/top", rows)
    stream.update()
    gps_ns, sigma_ns = stream.gps_from_device("scanner/top", rows["device_time_ns"], rows["host_time_ns"])
    truth = times - (UNIX_MINUS_GPS_S - LEAP) * NS
    return (gps_ns - truth).tolist(), float(sigma_ns.max())


HOURS = [(START_UNIX_NS + number * NS // 20) % (3600 * NS) for number in range(SECONDS * 20)]
VLP16 = f'[scanner.top]\n{HEAD}protocol = "velodyne-vlp16"\n'
WITH_AUX = VLP16 + 'auxiliary = "udp:0.0.0.0:8308"\n'
XT32 = f'[scanner.top]\n{HEAD}protocol = "hesai-xt32"\n'


def test_a_locked_head_without_position_packets_is_recognised_by_its_timestamps(tmp_path: Path) -> None:
    _, clocks = found(tmp_path, RECEIVER + VLP16 + 'pps = "main"\n', [*receiver(), *velodyne()])
    assert clocks.stamps["scanner/top"].scale is StampScale.HOUR
    error, sigma_ns = errors_ns(clocks, HOURS, -1)
    assert max(map(abs, error)) < 1_000
    assert sigma_ns <= 1e5
    (line,) = stamp_lines(clocks)
    assert line.startswith("scanner/top: its stamps are read as utc-hour: they count from the hour of UTC and lie 0.")


@pytest.mark.parametrize("off_us", [1_000_000, 300_000, 1_234_567_890])
def test_an_unlocked_head_runs_free(tmp_path: Path, off_us: int) -> None:
    _, clocks = found(tmp_path, RECEIVER + VLP16 + 'pps = "main"\n', [*receiver(), *velodyne(off_us)])
    assert clocks.stamps["scanner/top"].scale is StampScale.FREE
    assert stamp_lines(clocks) == []
    _, sigma_ns = errors_ns(clocks, HOURS, -1)
    assert sigma_ns > 1e6


def test_position_packets_are_the_clock_in_a_log_without_a_receiver(tmp_path: Path) -> None:
    """The recording computer is wrong by 0.3 s: the head's own seconds count, not the computer's."""
    setup, clocks = found(tmp_path, WITH_AUX, [*velodyne(), *positions()])
    plan = clocks.host.plan.devices["scanner/top"]
    assert plan.clock == "scanner/top"
    refuse_no_time(tmp_path, plan.clock, clocks.host.status(plan.clock, START_UNIX_NS + 20 * NS), setup.config)
    error, sigma_ns = errors_ns(clocks, HOURS, 1)
    assert max(map(abs, error)) < 1_000
    assert sigma_ns == 20_000.0
    (line,) = stamp_lines(clocks)
    assert "scanner/top: the log has no receiver, so GPS time comes from the head's own sentences" in line
    assert "18 leap seconds" in line


@pytest.mark.parametrize("receives", [False, True])
def test_timestamps_before_the_first_position_packet_are_judged_by_later_ones(tmp_path: Path, receives: bool) -> None:
    """The first position packet, 0.75 s after the first returns, reports that the head is locked."""
    units = [*velodyne(), *positions(), *(receiver() if receives else ())]
    text = RECEIVER + WITH_AUX + 'pps = "main"\n' if receives else WITH_AUX
    _, clocks = found(tmp_path, text, units)
    error, sigma_ns = errors_ns(clocks, HOURS, [-1] * 15 + [1] * (len(HOURS) - 15))
    assert max(map(abs, error)) < 1_000
    assert sigma_ns == 20_000.0
    assert not [line for line in stamp_lines(clocks) if "utc-hour" in line]  # the head says so itself


@pytest.mark.parametrize("off_us", [300_000, -40_000])
def test_timestamps_before_a_jump_to_lock_are_refused(tmp_path: Path, off_us: int) -> None:
    """Before the pulse sets it, the counter is 0.3 s or, by chance, 40 ms off the hour."""
    first_said_ns = min(at_ns for _, at_ns, _ in positions())
    early = [unit for unit in velodyne(off_us) if unit[1] < first_said_ns]
    units = [*early, *(unit for unit in velodyne() if unit[1] > first_said_ns), *positions(), *receiver()]
    _, clocks = found(tmp_path, RECEIVER + WITH_AUX + 'pps = "main"\n', units)
    stamps = [(hour + off_us * 1000) % (3600 * NS) for hour in HOURS[:15]] + HOURS[15:]
    error, _ = errors_ns(clocks, stamps, [-1] * 15 + [1] * (len(HOURS) - 15))
    assert max(map(abs, error[15:])) < 1_000
    assert "scanner/top" not in clocks.stamps or clocks.stamps["scanner/top"].scale is StampScale.FREE


def test_a_rollover_of_the_heads_receiver_is_corrected(tmp_path: Path) -> None:
    """Sentences are 1024 weeks old; 2006 had another count of leap seconds, which put points 4 s off in the week."""
    _, clocks = found(tmp_path, WITH_AUX, [*velodyne(), *positions(off=-ROLLOVER)])
    error, _ = errors_ns(clocks, HOURS, 1)
    assert max(map(abs, error)) < 1_000
    (line,) = clocks.remarks
    assert line.startswith(
        "scanner/top: sends the date 2006-10-30, 1 roll-over of 1024 weeks behind; corrected to 2026-06-15, because"
    )


def test_an_implausible_date_of_a_head_is_refused_and_named(tmp_path: Path) -> None:
    setup, clocks = found(tmp_path, WITH_AUX, [*velodyne(), *positions(off=-ROLLOVER - dt.timedelta(days=9))])
    (line,) = clocks.remarks
    assert line.startswith(
        "scanner/top: sends the date 2006-10-21, before 2009-01-01: probably one roll-over of 1024 weeks"
    )
    assert "connect a receiver with the right date to the head" in line
    status = clocks.host.status("scanner/top", START_UNIX_NS + 20 * NS)
    with pytest.raises(UserError, match="scanner/top: sends the date 2006-10-21"):
        refuse_no_time(tmp_path, "scanner/top", status, setup.config, clocks.remarks, clocks.trouble("scanner/top"))


def test_a_head_in_local_time_is_reported(tmp_path: Path) -> None:
    _, clocks = found(tmp_path, WITH_AUX, [*velodyne(), *positions(off=dt.timedelta(hours=2))])
    (line,) = clocks.remarks
    assert line.startswith(
        "scanner/top: its time is 2 h ahead of the recording computer's clock, as a wrong time zone would cause"
    )


def test_counters_beyond_the_hour_are_modulo_the_hour_in_both_packets(tmp_path: Path) -> None:
    units = [*velodyne(goes_on=True), *positions(goes_on=True)]
    _, clocks = found(tmp_path, WITH_AUX, units)
    error, sigma_ns = errors_ns(clocks, HOURS, 1)
    assert max(map(abs, error)) < 1_000
    assert sigma_ns == 20_000.0


def test_a_configured_hour_needs_neither_receiver_nor_position_packets(tmp_path: Path) -> None:
    _, clocks = found(tmp_path, VLP16 + 'clock = "utc-hour"\n', velodyne())
    error, _ = errors_ns(clocks, HOURS, -1)
    assert max(map(abs, error)) < 1_000
    (line, _) = stamp_lines(clocks)
    assert "from the head's own stamps, as configured, and the hour by the recording computer's clock" in line
    assert "sentences" not in line


@pytest.mark.parametrize(
    ("pps", "status", "words"),
    [
        (PPS_LOCKED, "V", r"passes on 20 sentences, all void \(no fix yet\); place the receiver's antenna under open"),
        (PPS_LOCKED, None, "passes on no NMEA sentence with a time; connect RMC"),
        (
            PPS_ABSENT,
            "V",
            "reports that no pulse reaches it; wire the receiver's PPS to it; it passes on 19 sen",
        ),
        (PPS_SYNCHRONIZING, None, r"reports that it is not locked to its pulse \(synchronizing\); wire a steady PPS"),
    ],
)
def test_a_head_without_fix_or_pulse_is_refused_with_that_reason(
    tmp_path: Path, pps: int, status: str | None, words: str
) -> None:
    setup, clocks = found(tmp_path, WITH_AUX, [*velodyne(), *positions(pps=pps, status=status)])
    plan = clocks.host.plan.devices["scanner/top"]
    state, trouble = clocks.host.status(plan.clock, START_UNIX_NS + 20 * NS), clocks.trouble(plan.clock)
    with pytest.raises(UserError, match="the log has no receiver, and the head " + words) as refused:
        refuse_no_time(tmp_path, plan.clock, state, setup.config, (), trouble)
    assert "configuration" not in refused.value.message


def test_an_unlocked_head_without_a_reason_is_not_reported_as_without_pulse(tmp_path: Path) -> None:
    """Hesai's packets have a flag but no reason."""
    text = RECEIVER + XT32 + 'auxiliary = "udp:0.0.0.0:10110"\npps = "main"\n'
    seconds = [(START_UNIX_NS + k * NS + LATENCY_NS, START + dt.timedelta(seconds=k)) for k in range(SECONDS)]
    aux = [("scanner/top/aux", at_ns, encode_gps_packet(time, locked=False)) for at_ns, time in seconds]
    _, clocks = found(tmp_path, text, [*receiver(), *hesai(0), *aux])
    assert clocks.trouble("scanner/top") == ("reports that it is not locked to its pulse; wire a steady PPS to it")


@pytest.mark.parametrize("status", ["A", "V"])
def test_a_head_without_pulse_beside_a_receiver_is_reported_as_such(tmp_path: Path, status: str) -> None:
    """The contents of the head's own sentences do not matter then."""
    units = [*receiver(), *velodyne(12_345_678), *positions(pps=PPS_ABSENT, status=status)]
    _, clocks = found(tmp_path, RECEIVER + WITH_AUX + 'pps = "main"\n', units)
    state = clocks.host.status("pps/main", START_UNIX_NS + 20 * NS)
    trouble = clocks.trouble("scanner/top")
    line = time_trouble("top", {"no_time": 9, "georeferenced": 1}, {}, state, None, trouble)
    assert line.endswith("the head reports that no pulse reaches it; wire the receiver's PPS to it")


def test_a_head_with_fix_and_pulse_gives_no_warning(tmp_path: Path) -> None:
    _, clocks = found(tmp_path, WITH_AUX, [*velodyne(), *positions()])
    assert clocks.trouble("scanner/top") == ""


def test_a_head_without_status_and_receiver_is_refused_with_the_remedy(tmp_path: Path) -> None:
    setup, clocks = found(tmp_path, VLP16, velodyne())
    plan = clocks.host.plan.devices["scanner/top"]
    status = clocks.host.status(plan.clock, START_UNIX_NS + 20 * NS)
    with pytest.raises(UserError, match=r"has no source of time; .*position packets .*scanner\.top\.clock"):
        refuse_no_time(tmp_path, plan.clock, status, setup.config)


@pytest.mark.parametrize(("beside_utc_s", "scale"), [(0, StampScale.UTC), (37, StampScale.TAI)])
@pytest.mark.parametrize("configured", [False, True])
def test_ptp_timestamps_keep_their_fraction_on_either_scale(
    tmp_path: Path, beside_utc_s: int, scale: StampScale, configured: bool
) -> None:
    """A receiver's time finds the scale; with a configured scale the stamps are complete without a receiver."""
    stamps = [START_UNIX_NS + number * NS // 20 + beside_utc_s * NS for number in range(SECONDS * 20)]
    text = f'{XT32}clock = "{scale.value}"\n' if configured else RECEIVER + XT32
    units = hesai(beside_utc_s) if configured else [*receiver(), *hesai(beside_utc_s)]
    _, clocks = found(tmp_path, text, units)
    assert clocks.stamps["scanner/top"].scale is scale
    error, sigma_ns = errors_ns(clocks, stamps, -1)
    assert max(map(abs, error)) < 1_000
    assert sigma_ns <= 1e5
