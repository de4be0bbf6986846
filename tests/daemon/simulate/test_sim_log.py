"""Tests a simulated log: it is what a recorder on board would have written, with the same bytes each time.

The flight is a stand-in, because only the way into the log is tested.
"""

from __future__ import annotations

import json
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from swath.daemon.errors import UserError
from swath.daemon.exchange.routes import Routes
from swath.daemon.log.reader import open_logs
from swath.daemon.log.wires import make_wire
from swath.daemon.replay.units import timed_units
from swath.daemon.simulate.into_log import SimReport, fly_into_log, virtual_boot_id
from tests.daemon.commands import swath
from tests.daemon.log_check import LogContent, official_counts, read_log
from tests.daemon.standin import NOT_FLOWN, PPM, SOURCES, START_NS, Clock, Standin, Unit, aircraft_config

SECONDS, SEED = 12.0, 3


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[SimReport, Path]:
    folder = tmp_path_factory.mktemp("flown")
    return fly_into_log(aircraft_config(folder), folder / "logs", Standin(SECONDS), SEED), folder / "logs"


def fly(folder: Path, flight: Standin, changes: dict[str, str] | None = None) -> LogContent:
    fly_into_log(aircraft_config(folder, changes), folder / "logs", flight, SEED)
    return read_log(folder / "logs")


def states(content: LogContent, source: str) -> list[str]:
    return [value["state"] for _, value in content.messages[f"/status/{source}"]]


def told(content: LogContent, source: str) -> list[tuple[str, str, str]]:
    """Return severity, code and text of the events of a source."""
    events = [event for _, event in content.messages["/events"]]
    return [(one["severity"], one["code"], one["text"]) for one in events if one["source"] == source]


class TestUnits:
    def test_every_unit_is_logged_with_its_timestamp_in_order(self, made: tuple[SimReport, Path]) -> None:
        report, logs = made
        content, clock = read_log(logs), Clock()
        sent: dict[str, list[Unit]] = {source: [] for source in SOURCES}
        for unit in Standin(SECONDS).units():
            sent[unit.source].append(unit)
        for source in set(SOURCES) - {"pps/main"}:
            assert content.units[source] == [(clock.host_ns(unit.time_s), unit.data) for unit in sent[source]], source
        assert report.units == {source: len(units) for source, units in sent.items()}
        assert report.returns == 40 * len(sent["scanner/left"])

    def test_edges_match_the_flight(self, made: tuple[SimReport, Path]) -> None:
        content, clock = read_log(made[1]), Clock()
        assert content.messages["/pps/main"] == [
            (
                clock.host_ns(second + 1e-6),
                {
                    "edge_time_ns": clock.host_ns(second + 1e-6),
                    "sequence": second + 1,
                    "edge": "assert",
                    "realtime_ns": clock.realtime_ns(second + 1e-6),
                },
            )
            for second in range(int(SECONDS))
        ]

    def test_channels_have_the_metadata_of_a_recorder(self, made: tuple[SimReport, Path], tmp_path: Path) -> None:
        config = aircraft_config(tmp_path)
        with made[0].paths[0].open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        channels = {one.topic: one for one in summary.channels.values()}
        for device in config.devices():
            for suffix, spec in (("", device.transport), ("/aux", device.auxiliary)):
                if spec is None or device.source in NOT_FLOWN:
                    continue
                wire = make_wire(device, spec, suffix)
                channel = channels[wire.topic]
                assert (channel.message_encoding, channel.schema_id) == (wire.encoding, 0)
                sender = {"source_address": "192.168.1.201", "source_port": channel.metadata.get("port", "")}
                assert channel.metadata == wire.metadata | (sender if spec.kind == "udp" else {})
        assert channels["/imu/main/raw"].metadata["dbc"] == "dbc/imu.dbc"

    def test_replay_plays_all_of_it_in_time_order(self, made: tuple[SimReport, Path]) -> None:
        [session] = open_logs([made[1]])
        played = list(timed_units(session, with_pps=True))
        assert Counter(unit.source for unit in played) == made[0].units
        assert all(early.time_ns <= late.time_ns for early, late in pairwise(played))


class TestRecorder:
    """The log has what a recorder writes beside the units."""

    def test_session_names_no_computer(self, made: tuple[SimReport, Path]) -> None:
        report, logs = made
        [session] = open_logs([logs])
        boot_id = virtual_boot_id("thurgau-north", SEED)
        assert report.session_id == session.session_id == f"thurgau-north-20260615T090000Z-{boot_id[:4]}"
        assert [path.name for path in report.paths] == [f"{report.session_id}_0.mcap"]
        info = session.info
        assert (info.host, info.boot_id, info.origin) == ("virtual", boot_id, "simulation")
        assert (info.realtime_ns, info.monotonic_ns) == (START_NS + 20_000_000, 20_000_000)

    def test_attachments_have_the_names_used_by_a_recorder(self, made: tuple[SimReport, Path]) -> None:
        [session] = open_logs([made[1]])
        attachments = session.attachments()
        assert sorted(attachments) == ["calibration/left.toml", "config.toml", "dbc/imu.dbc"]
        assert attachments["config.toml"] == (made[1].parent / "swath.toml").read_bytes()

    def test_the_clock_is_read_ten_times_a_second(self, made: tuple[SimReport, Path]) -> None:
        samples = read_log(made[1]).messages["/clock"]
        assert len(samples) == 10 * SECONDS + 1
        times = np.array([time_ns for time_ns, _ in samples])
        assert np.ptp(np.diff(times)) <= 1
        assert abs((times[-1] - times[0]) / (SECONDS * 1e9) - 1 - 1e-6 * PPM) < 1e-9
        for time_ns, one in samples:
            assert one["realtime_ns"] == time_ns
            assert one["monotonic_ns"] == one["monotonic_raw_ns"] == time_ns - START_NS
            assert (one["frequency_ppm"], one["status"]) == (0.0, 0x40)

    def test_statuses_come_each_second_and_account_for_all_units(self, made: tuple[SimReport, Path]) -> None:
        content = read_log(made[1])  # `read_log` compares each with the units before it
        for source in SOURCES:
            statuses = content.messages[f"/status/{source}"]
            assert len(statuses) == SECONDS + 1, source  # one more at the end
            steps = np.diff([time_ns for time_ns, _ in statuses])[:-1]
            assert np.all(np.abs(steps - 1e9) < 0.02e9), source
            assert {value["state"] for _, value in statuses} == {"receiving"}
            lost = ("lost_kernel", "lost_queue", "lost_write", "stamp_ambiguous")
            assert {value[key] for _, value in statuses for key in lost} == {0}
        assert content.messages["/status/scanner/left"][-1][1]["units"] == 100 * SECONDS

    def test_time_is_judged_as_in_flight(self, made: tuple[SimReport, Path]) -> None:
        content = read_log(made[1])
        for source in ("gnss/rover", "pps/main"):
            judged = [value["time_state"] for _, value in content.messages[f"/status/{source}"]]
            assert judged[0] == "NO_TIME"
            assert judged[-1] == "LOCKED"
            assert content.messages[f"/status/{source}"][-1][1]["time_sigma_ns"] < 2000
        assert "time_state" not in content.messages["/status/imu/main"][-1][1]

    def test_events_match_those_of_a_recorder(self, made: tuple[SimReport, Path]) -> None:
        content = read_log(made[1])
        codes = [(event["source"], event["code"]) for _, event in content.messages["/events"]]
        opened = ["pps/main", "gnss/rover", "imu/main", "scanner/left", "scanner/left/aux"]
        assert codes[0] == ("recorder", "session_started")
        assert codes[1:6] == [(source, "device_opened") for source in opened]
        assert codes[6:] == [("gnss/rover", "second_known"), ("recorder", "session_ended")]

    def test_info_recover_and_the_official_reader_find_no_fault(self, made: tuple[SimReport, Path]) -> None:
        report, logs = made
        result = swath("info", "--json", str(logs))
        assert result.returncode == 0, result.stderr
        [session] = json.loads(result.stdout)["sessions"]
        assert (session["origin"], session["damage"], session["missing_parts"]) == ("simulation", [], [])
        sources: dict[str, dict[str, Any]] = session["sources"]
        assert {name: (one["gaps"], one["account_errors"]) for name, one in sources.items()} == dict.fromkeys(
            SOURCES, (0, 0)
        )
        assert sources["scanner/left"]["decoded"]["records"]["ScannerReturns"] == report.returns
        assert sources["imu/main"]["decoded"]["records"]["ImuSamples"] == 100 * SECONDS
        assert sources["gnss/rover"]["decoded"]["records"]["TimeMessage"] == SECONDS
        assert all(not one["decoded"]["errors"] for name, one in sources.items() if name in ("gnss/rover", "imu/main"))
        assert "nothing to do" in swath("recover", str(logs)).stdout
        counts = official_counts(report.paths[0])
        assert {source: counts[f"/{source}/raw"] or counts[f"/{source}"] for source in SOURCES} == report.units
        assert not (logs / "recording.json").exists()


class TestFaults:
    """Faults of the wires and of the wall clock are reported as a recorder reports them."""

    def test_a_step_of_the_wall_clock_does_not_change_log_times(self, tmp_path: Path) -> None:
        content = fly(tmp_path, Standin(9.0, wall_steps=((4.05, 3600.0),)))
        [event] = content.events("wall_clock_stepped")
        assert event["text"] == "the wall clock was stepped by +3600.000000 s; log times are not affected"
        offsets = [value["realtime_ns"] - time_ns for time_ns, value in content.messages["/clock"]]
        assert offsets == [0] * 41 + [3600 * 10**9] * 51  # until 4.0 s; at the step, and from 4.1 s on
        edges = [value for _, value in content.messages["/pps/main"]]
        assert np.all(np.diff([edge["edge_time_ns"] for edge in edges]) < 1.001e9)
        assert [edge["realtime_ns"] - edge["edge_time_ns"] for edge in edges] == [0] * 5 + [3600 * 10**9] * 4
        assert content.messages["/status/pps/main"][-1][1]["time_state"] == "LOCKED"

    def test_an_unplugged_device_is_reported(self, tmp_path: Path) -> None:
        content = fly(tmp_path, Standin(12.0, pulled=(("gnss/rover", 5.5, 8.5),)))
        assert told(content, "gnss/rover") == [
            ("info", "device_opened", "opened"),
            ("info", "second_known", "by gnss/rover TIME"),
            ("error", "device_lost", "disconnected; waiting for it"),
            ("info", "device_opened", "opened"),
        ]
        assert states(content, "gnss/rover")[4:9] == ["receiving", "absent", "absent", "absent", "receiving"]
        assert set(states(content, "imu/main")) == {"receiving"}

    def test_a_source_that_falls_silent_and_resumes_is_reported(self, tmp_path: Path) -> None:
        content = fly(tmp_path, Standin(9.0, silent=(("scanner/left", 2.2, 7.2),)))
        assert told(content, "scanner/left") == [
            ("info", "device_opened", "opened"),
            ("warning", "silent", "no data for 4 s"),
            ("info", "resumed", "data again after 5.0 s"),
        ]
        assert states(content, "scanner/left").count("silent") == 2
        ages = [value["last_unit_age_s"] for _, value in content.messages["/status/scanner/left"]]
        assert ages[:8] == pytest.approx([0.0, 0.0, 0.8, 1.8, 2.8, 3.8, 4.8, 0.0], abs=0.03)

    def test_a_source_without_units_has_its_status(self, tmp_path: Path) -> None:
        content = fly(tmp_path, Standin(5.0, silent=(("imu/main", 0.0, 9.0),)))
        assert states(content, "imu/main") == ["receiving"] * 2 + ["silent"] * 3
        assert {value["last_unit_age_s"] for _, value in content.messages["/status/imu/main"]} == {None}


class TestParts:
    def test_the_same_flight_gives_the_same_bytes(self, made: tuple[SimReport, Path], tmp_path: Path) -> None:
        again = fly_into_log(aircraft_config(tmp_path), tmp_path / "elsewhere", Standin(SECONDS), SEED)
        assert again.paths[0].name == made[0].paths[0].name
        assert again.paths[0].read_bytes() == made[0].paths[0].read_bytes()
        other = fly_into_log(aircraft_config(tmp_path), tmp_path / "elsewhere", Standin(1.0), SEED + 1)
        assert other.session_id != again.session_id

    def test_parts_are_split_as_configured(self, tmp_path: Path) -> None:
        report = fly_into_log(
            aircraft_config(tmp_path, {"split_minutes = 30": "split_minutes = 0.05"}), tmp_path, Standin(8.0), SEED
        )
        assert [path.name for path in report.paths] == [f"{report.session_id}_{part}.mcap" for part in range(3)]
        content = read_log(*report.paths)
        assert [event["text"] for event in content.events("part_closed")] == [path.name for path in report.paths[1:]]
        assert [event["source"] for event in content.events("part_opened")] == ["recorder"] * 2
        assert len(content.units["scanner/left"]) == 800
        [session] = open_logs([tmp_path])
        assert session.missing_parts == []

    def test_an_existing_log_of_the_session_is_never_written_to(self, made: tuple[SimReport, Path]) -> None:
        report, logs = made
        before = report.paths[0].read_bytes()
        config = aircraft_config(logs.parent)
        with pytest.raises(UserError, match=f"{report.paths[0].name}: already exists"):
            fly_into_log(config, logs, Standin(SECONDS), SEED)
        assert report.paths[0].read_bytes() == before

    @pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
    def test_a_flight_that_ends_early_leaves_no_log(self, tmp_path: Path, error: type[BaseException]) -> None:
        class Broken(Standin):
            def _positions(self) -> Any:
                yield from (unit for unit in super()._positions() if unit.time_s < 2.0)
                raise error

        with pytest.raises(error):
            fly_into_log(aircraft_config(tmp_path), tmp_path / "logs", Broken(5.0), SEED)
        assert list((tmp_path / "logs").iterdir()) == []

    def test_progress_is_reported_and_ends_at_the_end(self, tmp_path: Path) -> None:
        words: list[tuple[float, int, int, int]] = []
        report = fly_into_log(
            aircraft_config(tmp_path), tmp_path / "logs", Standin(9.0), SEED, lambda *word: words.append(word)
        )
        assert len(words) == 2
        assert words == sorted(words)
        assert words[-1] == (9.0, sum(report.units.values()), report.returns, report.bytes)
        assert report.bytes == report.paths[0].stat().st_size

    def test_every_source_of_a_flight_has_a_port(self, tmp_path: Path) -> None:
        ports = Routes.of(aircraft_config(tmp_path)).ports
        assert sorted(ports) == sorted([*SOURCES, *NOT_FLOWN])
