"""Tests that the numbers of ``swath info`` are those of the wire, and that a log's faults are named."""

from __future__ import annotations

import gzip
import json
import os
import subprocess
import sys
import time
import tty
from pathlib import Path

import numpy as np
import pytest

from swath.daemon.log.words import stream_faults
from swath.drivers.captures.opening import read_pcap
from swath.drivers.driver import find_driver
from swath.drivers.gnss.nmea.sentences import encode_gga
from swath.drivers.gnss.ubx.messages import RXM_RAWX, RxmRawx
from swath.drivers.parser import DeviceSettings
from swath.drivers.scanner.srep.layout import SrepHeader, encode_datagram
from swath.georef.records import ChunkBatch
from tests.daemon.builders import CAPTURE, INFO, START_NS, write_part
from tests.daemon.commands import ROOT, swath
from tests.daemon.exchange.builders import Unit, write_config, write_log
from tests.daemon.rig import Recorder, session_table

ROVER = '[gnss.rover]\ntransport = "serial:{path}?baud=921600"\nprotocol = "novatel"\n'


@pytest.mark.slow
def test_numbers_of_a_recording_match_a_direct_parse(tmp_path: Path) -> None:
    import numpy as np

    data = gzip.decompress(CAPTURE.read_bytes())[:200_000]
    link, logs = tmp_path / "rover", tmp_path / "logs"
    master, slave = os.openpty()
    tty.setraw(slave)
    link.symlink_to(os.ttyname(slave))
    with Recorder(tmp_path, session_table(logs) + ROVER.format(path=link)) as recorder:
        recorder.wait_said("gnss/rover device_opened")
        for at in range(0, len(data), 2000):
            os.write(master, data[at : at + 2000])
        time.sleep(1.3)
        assert recorder.stop() == 0, recorder.stderr()
    os.close(master)
    os.close(slave)
    result = swath("info", "--json", str(logs))
    assert result.returncode == 0, result.stdout + result.stderr
    (session,) = json.loads(result.stdout)["sessions"]
    rover = session["sources"]["gnss/rover"]
    parser = find_driver("gnss", "novatel").make_parser(DeviceSettings("gnss/rover", {}, {}))
    unit = np.frombuffer(data, np.uint8).reshape(1, -1)
    parser.feed_batch(ChunkBatch("gnss/rover", np.array([1], np.int64), unit))
    parser.close()
    assert rover["bytes"] == len(data)
    assert rover["decoded"]["messages"] == dict(parser.counters.messages)
    assert sum(rover["decoded"]["messages"].values()) > 100
    quick = json.loads(swath("info", "--quick", "--json", str(logs)).stdout)["sessions"][0]
    assert "decoded" not in quick["sources"]["gnss/rover"]


def test_messages_are_listed_and_a_silent_second_antenna_is_named(tmp_path: Path) -> None:
    """The log holds raw measurements and NMEA of a u-blox receiver, whose NMEA has no heading."""
    table = '[session]\nname = "n"\ndirectory = "logs"\n[gnss.rover]\ntransport = "serial:/dev/ttyUSB0?baud=115200"\n'
    arms = "lever_arm_m = [0.0, -0.5, 0.0]\nsecondary_lever_arm_m = [0.0, 0.5, 0.0]\n"
    config = write_config(tmp_path, f'{table}protocol = "ubx"\n{arms}')
    rawx = RXM_RAWX.encode(RxmRawx(302_400.0, 2342, 18, 0, 1))
    frames = [rawx, encode_gga(0, 0.8, 0.1, 500.0, 48.0), encode_gga(10**9, 0.8, 0.1, 500.0, 48.0)]
    write_log(tmp_path / "logs", config, [("gnss/rover", at, frame, None) for at, frame in enumerate(frames)])
    said = swath("info", str(tmp_path / "logs")).stdout
    assert "gnss/rover: 2 GnssFix, 1 TimeMessage\n  messages: 2 GGA, 1 RXM-RAWX\n" in said
    assert "note: gnss/rover: sent no heading that this program reads, although secondary_lever_arm_m" in said


@pytest.mark.parametrize("columns", [80, 120])
def test_a_missing_part_is_named_and_lines_fit_the_screen(tmp_path: Path, columns: int) -> None:
    for part in (0, 2):
        write_part(tmp_path / f"{INFO.session_id}_{part}.mcap", part=part)
    result = swath("info", str(tmp_path), COLUMNS=str(columns))
    assert result.returncode == 1, result.stderr
    assert "part 1 is missing" in result.stdout
    assert "2,400" in result.stdout
    assert max(map(len, result.stdout.splitlines())) <= columns


def test_damage_is_reported_with_its_place(tmp_path: Path) -> None:
    path = tmp_path / f"{INFO.session_id}_0.mcap"
    write_part(path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert "damage:" in swath("info", str(path)).stdout
    result = swath("info", "--json", str(path))
    assert result.returncode == 4
    (damage,) = json.loads(result.stdout)["sessions"][0]["damage"]
    assert damage["file"] == path.name
    assert damage["offset"] <= len(data) // 2 < damage["offset"] + damage["length"]


def test_the_same_log_given_twice_counts_once(tmp_path: Path) -> None:
    path = tmp_path / f"{INFO.session_id}_0.mcap"
    write_part(path)
    (session,) = json.loads(swath("info", "--json", str(path), str(tmp_path)).stdout)["sessions"]
    assert session["sources"]["scanner/left"]["units"] == 1200


@pytest.mark.slow
@pytest.mark.parametrize("command", ["info", "replay"])
def test_a_missing_log_is_reported_in_one_line(tmp_path: Path, command: str) -> None:
    (tmp_path / "text.mcap").write_text("no log")
    (tmp_path / "wire.toml").write_text(session_table(tmp_path))
    wire = ["--wire", str(tmp_path / "wire.toml")] if command == "replay" else []
    for name in ("text.mcap", "absent.mcap"):
        result = swath(command, str(tmp_path / name), *wire)
        assert result.returncode == 3, result
        assert name in result.stderr
        assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("has_status", [True, False])
@pytest.mark.parametrize(("origin", "told"), [("recording", "swath 1 on h\n"), ("import", "swath 1 on h (import)\n")])
def test_long_names_and_wide_sigmas_fit_and_unknown_values_are_omitted(
    origin: str, told: str, has_status: bool
) -> None:
    import io

    from rich.console import Console

    from swath.daemon.cli.info import _print_session

    lost = {"lost_kernel": 0, "lost_queue": 0, "lost_write": 0}
    source: dict[str, object] = {"units": 1_234_567, "bytes": 1, "rate_hz": 20000.0, "gaps": 0, "longest_gap_s": 0.0}
    source |= {"lost": lost, "account_errors": 0, "time_state": "HOLDOVER", "time_sigma_ns": 57_712.3}
    source |= {"has_status": has_status}
    source |= {"trouble": {"bus_off": 2, "error_frames": 1_500}}
    counted = {"records": {}, "messages": {}, "bad_checksums": 0, "bad_messages": 0}
    source["decoded"] = {**counted, "errors": {"error_frame": 1, "rtr_frame": 0}}
    source["mixed_senders"] = {"192.168.1.201": 2, "192.168.1.202": 3}
    numbers: dict[str, object] = {
        "missing_parts": [],
        "last_events": [],
        "marks": [{"time_ns": "soon", "text": "[x]"}],
        "damage": [],
        "notes": [],
    }
    numbers |= {"session_id": "s", "start_ns": 0, "duration_s": 1.0, "parts": [0], "bytes": 0, "software": "swath 1"}
    numbers |= {"host": "h", "origin": origin, "growing": None, "sources": {"scanner/left-front/aux": source}}
    page = io.StringIO()
    _print_session(Console(file=page, width=80), numbers)
    text = page.getvalue()
    assert told in text
    assert ("0/0/0" in text, "every unit is accounted for" in text) == (has_status, has_status)
    assert ("no status of scanner/left-front/aux: losses are unknown" in text) != has_status
    numbers["missing_parts"] = [1]
    _print_session(Console(file=page, width=80), numbers)
    assert "incomplete: units in missing parts" in page.getvalue().removeprefix(text)
    assert "every unit is accounted for" not in page.getvalue().removeprefix(text)
    assert "…" not in text
    assert "57.7µs" in text
    assert "scanner/left-front/aux: 1 × error_frame\n" in text
    assert "2 devices send to its port" in text
    assert "  ? mark: [x]\n" in text
    assert "scanner/left-front/aux: 2 bus off, 1,500 error frames" in text


def test_a_head_s_errors_stand_once_and_repeated_datagrams_degrade_it(tmp_path: Path) -> None:
    """Packets of a VLP-16's second port go to the parser of its data, for which their length is wrong."""
    table = (
        '[session]\nname = "n"\ndirectory = "logs"\n[scanner.roof]\ntransport = "udp:0.0.0.0:2368"\n'
        'auxiliary = "udp:0.0.0.0:8308"\nprotocol = "velodyne-vlp16"\ninstallation_deg = [0, 0, 0]\n'
        '[scanner.left]\ntransport = "udp:0.0.0.0:2369"\nprotocol = "srep"\nmirror_factor = 2\n'
    )
    packets = [unit.data for unit in read_pcap(ROOT / "fixtures/velodyne/mrpt_vlp16_gps.pcap.gz")]
    data = [packet for packet in packets if len(packet) == 1206]
    sent: list[Unit] = []
    for number, packet in enumerate(data[:50]):
        at = START_NS + number * 1_300_000
        header = SrepHeader(sequence=number // 2, flags=1, pps_count=3, pps_ticks=1_000_000, first_ticks=1_500_000)
        line = encode_datagram(header, np.arange(9) * 50, np.arange(9) * 100, np.full((9, 1), 9_000_000))
        sent += [("scanner/roof", at, packet, None), ("scanner/roof/aux", at, bytes(99), None)]
        sent.append(("scanner/left", at, line, None))
    write_log(tmp_path / "logs", write_config(tmp_path, table), sent)
    said = swath("info", str(tmp_path / "logs")).stdout
    assert said.count("50 × bad_length") == 1, said
    assert "scanner/left: DEGRADED: 25 repeated (" in said
    (session,) = json.loads(swath("info", "--json", str(tmp_path / "logs")).stdout)["sessions"]
    assert session["sources"]["scanner/roof/aux"]["decoded"]["errors"] == {}
    assert session["sources"]["scanner/roof"]["degraded"] == []


def test_more_than_one_damaged_message_in_a_hundred_degrades_a_stream() -> None:
    """A serial line that is too slow for its unit loses bytes (SBG-Systems/sbg_ros_driver #37)."""
    assert stream_faults({}, 4500, 25.0, 500) == ["500 damaged (10 % of its messages)"]
    assert stream_faults({}, 4500, 25.0, 45) == stream_faults({}, 0, 0.0, 1) == []


@pytest.mark.parametrize(
    ("errors", "messages", "seconds", "said"),
    [
        ({"sample_incomplete": 10, "duplicate": 5, "out_of_order": 5}, 10_000, 100.0, []),
        ({"sample_incomplete": 11}, 10_000, 100.0, ["11 incomplete (0.11 % of its messages)"]),
        ({"sample_duplicate": 6, "duplicate": 6}, 10_000, 100.0, ["12 repeated (0.12 % of its messages)"]),
        ({"out_of_order": 20}, 10_000, 100.0, ["20 out of order (0.2 % of its messages)"]),
        ({"restart": 1}, 10_000, 3600.0, []),
        ({"restart": 2}, 100_000, 100.0, ["2 restarts"]),
        ({"restart": 1}, 100_000, 60.0, ["1 restart"]),
        ({"restart": 1, "sequence_gap": 999}, 900, 3600.0, ["1 restart"]),
        ({}, 0, 0.0, []),
    ],
)
def test_restarts_and_faulty_messages_degrade_a_stream(
    errors: dict[str, int], messages: int, seconds: float, said: list[str]
) -> None:
    assert stream_faults(errors, messages, seconds) == said


def test_a_table_in_a_pipe_is_not_cut() -> None:
    environment = {key: value for key, value in os.environ.items() if key != "COLUMNS"}
    command = [sys.executable, "-m", "swath.daemon.cli.main", "devices"]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert "…" not in run.stdout
    assert max(map(len, run.stdout.splitlines())) > 80
