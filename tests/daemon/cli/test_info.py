"""Tests that the numbers of ``swath info`` are those of the wire, and that a log's faults are named."""

from __future__ import annotations

import gzip
import json
import os
import time
import tty
from pathlib import Path

import pytest

from swath.drivers.driver import find_driver
from swath.drivers.gnss.nmea.sentences import encode_gga
from swath.drivers.gnss.ubx.messages import RXM_RAWX, RxmRawx
from swath.drivers.parser import DeviceSettings
from swath.georef.records import ChunkBatch
from tests.daemon.builders import CAPTURE, INFO, write_part
from tests.daemon.commands import swath
from tests.daemon.exchange.builders import write_config, write_log
from tests.daemon.rig import Recorder, session_table

ROVER = '[gnss.rover]\ntransport = "serial:{path}?baud=921600"\nprotocol = "novatel"\n'


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
    assert "  ? mark: [x]\n" in text
    assert "scanner/left-front/aux: 2 bus off, 1,500 error frames" in text
