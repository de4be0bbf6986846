"""Tests ``swath live``: live and replayed points have the same bytes; its status is right."""

from __future__ import annotations

import copy
import json
import random
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace as replaced
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import numpy as np
import pytest
from rich.text import Text

from swath.daemon.cli.live import page
from swath.daemon.cli.main import run_app
from swath.daemon.config import Config, load_config
from swath.daemon.config.tables import LiveConfig
from swath.daemon.errors import UserError
from swath.daemon.log.mcap.chunks import LogBatch
from swath.daemon.log.parts import RECORDING_SIGN
from swath.daemon.log.reader import Session, open_logs
from swath.daemon.processing.live import follow as live_follow
from swath.daemon.processing.live import session as live_module
from swath.daemon.processing.live.points import POINT_DTYPE
from swath.daemon.processing.live.session import Live, LiveSession, Told, made_session, replay
from swath.daemon.processing.live.status import LiveStatus, sentence
from swath.daemon.processing.live.tiles import Layers, TileReader
from swath.daemon.processing.points.feed import TICK_BYTES, TICK_NS
from swath.daemon.processing.setup.setup import Options, Setup
from swath.daemon.processing.warm_up import WarmUp
from swath.daemon.simulate.into_log import fly_into_log
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.points import Fate
from swath.georef.stream.clocks import DevicePlan
from swath.georef.timescales import ClockStatus, TimeState
from swath.sim.companions import companion_files, config_text, default_wires
from swath.sim.fly import VirtualFlight
from swath.sim.plan.plan import parse_plan
from tests.daemon.builders import swath
from tests.daemon.commands import ROOT
from tests.daemon.processing.live.builders import PLAN

pytestmark = pytest.mark.xdist_group("kernels")

# ---------------------------------------------------------------------------------------------- a flight

SECONDS = 7.0


class Flown:
    """A finished log of several parts, which can be made to grow again."""

    def __init__(self, folder: Path) -> None:
        plan = parse_plan(PLAN, Path())
        flight = VirtualFlight(plan, None, SECONDS)
        for name, data in companion_files(plan, flight.site, flight.scene).items():
            (folder / name).write_bytes(data)
        text = config_text(plan, default_wires(plan), "logs").replace("[session]", "[session]\nsplit_minutes = 0.035")
        text = text.replace('protocol = "novatel"', 'protocol = "novatel"\ndatum = "same"')
        # the log ends before the flight's first line begins: the plan of lines has it begin sooner
        (folder / "plan.toml").write_text(PLAN.replace("from_m = [-150, 0]", "from_m = [-650, 0]"))
        (folder / "swath.toml").write_text(text)
        self.config: Config = load_config(folder / "swath.toml")
        report = fly_into_log(self.config, folder / "logs", flight, plan.tables.flight.seed)
        self.paths = report.paths
        assert len(self.paths) >= 3

    def session(self) -> Session:
        (session,) = open_logs(self.paths)
        return session

    def setup(self) -> Setup:
        return Setup.of_log(self.session().attachments(), Options(uncertainty=False))

    def grow(self, folder: Path, seed: int) -> Iterator[None]:
        """Write the same parts again in pieces; the next part's head exists before this one's end."""
        lengths = random.Random(seed)
        session_id = self.session().session_id
        for number, path in enumerate(self.paths):
            data, at = path.read_bytes(), 0 if number == 0 else 2000
            while at < len(data) - 500:
                step = lengths.choice([7, 300, 20_000, 150_000])
                _append(folder / path.name, data[at : min(at + step, len(data) - 500)])
                if number == 0 and at == 0:
                    _write_sign(folder, session_id, 0, path)
                at += step
                yield
            if number + 1 < len(self.paths):
                following = self.paths[number + 1]
                _append(folder / following.name, following.read_bytes()[:2000])
                _write_sign(folder, session_id, number + 1, following)
                yield
            _append(folder / path.name, data[-500:])
            yield
        (folder / RECORDING_SIGN).unlink()


def _append(path: Path, data: bytes) -> None:
    with path.open("ab") as file:
        file.write(data)


def _write_sign(folder: Path, session_id: str, part: int, path: Path) -> None:
    sign = {"session_id": session_id, "part": part, "path": path.name, "boot_id": "virtual"}
    (folder / RECORDING_SIGN).write_text(json.dumps(sign))


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return Flown(tmp_path_factory.mktemp("flown"))


@pytest.fixture(scope="module")
def replayed(flown: Flown, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Told]:
    """Return the folder of a replay, with all points in ``points.npy``, and its final status."""
    folder = tmp_path_factory.mktemp("replayed")
    found = replay(flown.session(), flown.setup(), folder, LiveConfig(), folder / "points.npy")
    return folder, found


def follow_growing(flown: Flown, folder: Path, seed: int, monkeypatch: pytest.MonkeyPatch) -> list[Told]:
    """Follow the flight while it is written again, and return the final status."""
    monkeypatch.setattr(live_module, "POLL_S", 0.0)
    monkeypatch.setattr(live_module, "STATUS_S", 0.05)
    monkeypatch.setattr(live_follow, "GONE_S", 1e9)
    growth, told = flown.grow(folder, seed), list[Told]()
    run = Live(folder, LiveConfig(), told.append, points=folder / "points.npy")
    run.run(lambda: next(growth, None) is not None)
    return told


def whole_map(folder: Path) -> Layers:
    """Return all layers of a live run's map."""
    reader = TileReader(folder)
    assert reader.refresh()
    extent_m = reader.extent_m()
    assert extent_m is not None
    view = reader.view(*extent_m, reader.cell_m)
    assert view is not None
    return view.layers


class TestPoints:
    def test_all_returns_are_accounted_for(self, replayed: tuple[Path, Told]) -> None:
        folder, found = replayed
        points = np.load(folder / "points.npy")
        assert points.dtype == POINT_DTYPE
        for number, name in enumerate(("left", "right")):
            assert found["fates"][name]["georeferenced"] == found["points"][name] > 10_000
            assert np.count_nonzero(points["scanner"] == number) == found["points"][name]
        assert found["waiting"] == {"left": 0, "right": 0}
        assert (found["trouble"], found["damaged_chunks"]) == ("", 0)

    @pytest.mark.parametrize("seed", [1, 2])
    def test_a_growing_log_over_parts_gives_the_bytes_of_its_replay(
        self, flown: Flown, replayed: tuple[Path, Told], tmp_path: Path, seed: int, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        told = follow_growing(flown, tmp_path, seed, monkeypatch)
        assert told[-1]["state"] == "ended (the recording has ended)"
        assert told[-1]["live_skipped_s"] == 0.0
        assert (tmp_path / "points.npy").read_bytes() == (replayed[0] / "points.npy").read_bytes()
        assert (tmp_path / "live/lines.json").read_bytes() == (replayed[0] / "lines.json").read_bytes()
        assert json.loads((tmp_path / "live/live.json").read_text()) == told[-1]
        assert sorted({int(one["part"]) for one in told if "part" in one}) == list(range(len(flown.paths)))

    @pytest.mark.slow
    def test_a_mark_has_the_verdict_written_at_once_and_printed(self, flown: Flown, tmp_path: Path) -> None:
        """The mark comes after 3 s; without it the verdict would be 30 s old at most."""
        session = flown.session()
        run = made_session(flown.setup(), session.info, tmp_path, LiveConfig(), None, beside_recorder=True)
        marked_ns = session.info.realtime_ns + 3_000_000_000
        for batch in session.batches():
            if run.landing.facts.marked_ns is None and run.now_ns > marked_ns:
                run.landing.facts.event(run.now_ns, {"code": "mark", "text": "landing: You can go home"})
            run.take(batch, live=True)
        verdict = json.loads((tmp_path / "verdict.json").read_text())
        assert marked_ns <= verdict["log_time_ns"] < marked_ns + 2_000_000_000
        assert verdict["state"] == "again"  # whatever the mark says
        run.close(live=True)
        assert (tmp_path / "landing.pdf").read_bytes().startswith(b"%PDF-")
        assert "Fly again: line 1. Not flown: line 2." in (tmp_path / "landing.html").read_text()

    def test_bytes_do_not_depend_on_how_the_log_is_cut(
        self, flown: Flown, replayed: tuple[Path, Told], tmp_path: Path
    ) -> None:
        def cut() -> Iterator[LogBatch]:
            lengths = random.Random(3)
            for batch in flown.session().batches():
                first = 0
                while first < len(batch.log_time_ns):
                    last = first + lengths.randint(1, 30)
                    yield batch.between(first, last)
                    first = last

        replay(flown.session(), flown.setup(), tmp_path, LiveConfig(), tmp_path / "points.npy", batches=cut())
        for name in ("points.npy", "coverage.png", "lines.json", "verdict.json"):
            assert (tmp_path / name).read_bytes() == (replayed[0] / name).read_bytes(), name
        ours, theirs = (whole_map(folder) for folder in (tmp_path, replayed[0]))
        assert ours["points"].sum() > 10_000
        for name, values in ours.items():
            np.testing.assert_array_equal(values, theirs[name], err_msg=name)

    def test_points_after_skipped_chunks_are_unchanged(
        self, flown: Flown, replayed: tuple[Path, Told], tmp_path: Path
    ) -> None:
        """1.5 s of scanner chunks are skipped, as when live processing falls behind."""
        begin_ns = flown.session().info.realtime_ns + 3_000_000_000

        def with_a_hole() -> Iterator[LogBatch]:
            for batch in flown.session().batches():
                in_hole = begin_ns <= int(batch.log_time_ns[0]) < begin_ns + 1_500_000_000
                if not (in_hole and batch.channel.chunk_class == "scanner"):
                    yield batch

        replay(flown.session(), flown.setup(), tmp_path, LiveConfig(), tmp_path / "points.npy", batches=with_a_hole())
        some, everything = np.load(tmp_path / "points.npy"), np.load(replayed[0] / "points.npy")
        some, everything = some[some["scanner"] == 0], everything[everything["scanner"] == 0]
        late = some[some["time_ns"] > everything["time_ns"][0] + 5_000_000_000]
        assert 0.5 * len(everything) < len(some) < 0.9 * len(everything)
        assert len(late) > 5_000
        theirs = everything[-len(late) :]
        np.testing.assert_allclose(late["range_m"], theirs["range_m"])
        np.testing.assert_allclose(late["time_ns"], theirs["time_ns"], rtol=0, atol=100)
        np.testing.assert_allclose(late["points_map"], theirs["points_map"], rtol=0, atol=1e-4)

    def test_without_a_device_solution_and_an_imu_live_is_refused(self, flown: Flown, tmp_path: Path) -> None:
        attachments = flown.session().attachments()
        text = attachments["config.toml"].replace(b'"novatel"', b'"nmea"')
        attachments["config.toml"] = re.sub(rb"(?ms)^\[imu\..*?(?=^\[(?!imu))", b"", text)
        setup = Setup.of_log(attachments, Options(datum="same", uncertainty=False))
        with pytest.raises(UserError, match="the configuration has neither a device with an INS solution"):
            replay(flown.session(), setup, tmp_path, LiveConfig(), None)


class TestStatus:
    def test_status_gives_rates_latencies_time_and_density(self, replayed: tuple[Path, Told]) -> None:
        folder, found = replayed
        assert json.loads((folder / "live.json").read_text()) == found
        for name in ("left", "right"):
            pulse = found["latency_s"][f"scanner/{name}"]["pulse"]
            assert 0.0 < pulse["p50"] <= pulse["p95"] <= pulse["max"] < 5.0
        assert found["time"]["pps/main"]["state"] == "LOCKED"
        assert found["trajectory"]["source"] == "gnss/rover"
        coverage = json.loads((folder / "coverage.json").read_text())
        assert coverage["points"] == sum(found["points"].values())
        # two scanners with 8000 pulses/s together at 50 m/s: pulses divided by their area
        assert 0.5 < coverage["density_per_m2"]["mean"] < 20.0

    def test_the_plan_stored_in_the_log_gives_the_state_of_its_lines(self, replayed: tuple[Path, Told]) -> None:
        """The flight of 7 s, at 50 m/s, ends 250 m before x = -150 m, the begin of the line that it makes for."""
        folder, found = replayed
        lines = json.loads((folder / "lines.json").read_text())
        assert (lines["plan"], lines["current"], lines["trouble"]) == ("plan.toml", None, "")
        one, two = lines["lines"]
        assert (one["name"], one["state"], two["state"]) == ("1", "again", "planned")
        assert [(reason["code"], reason["grave"]) for reason in one["reasons"]] == [
            ("early_end", True),
            ("time", False),
        ]
        assert one["flown_from_m"] == 0.0
        assert one["flown_to_m"] == pytest.approx(250.0, abs=25.0)
        assert len(lines["geometry"]["lines"]["1"]) == 2
        steering = json.loads((folder / "steering.json").read_text())
        assert (steering["current"], steering["next"], steering["steering"]) == (None, "1", None)  # after the end
        assert steering["gps_ns"] == one["end_gps_ns"]
        assert found["lines"]["fly_again"] == ["1"]
        verdict = json.loads((folder / "verdict.json").read_text())
        assert verdict["sentence"] == "Fly again: line 1. Not flown: line 2"
        states = {check["code"]: check["state"] for check in verdict["checks"]}
        assert (states["lines"], states["base"], states["log"]) == ("again", "unknown", "good")
        assert "FLY AGAIN: 1;" in found["sentence"] + ";"
        assert found["gnss"]["gnss/rover"]["fix"] == "rtk_fixed"
        assert found["pose"]["speed_mps"] == pytest.approx(50.0, abs=1.0)

    def test_one_sentence_names_the_problem(self, replayed: tuple[Path, Told]) -> None:
        found = dict(replayed[1])
        assert "SKIPPED" not in sentence(found)
        found["live_skipped_s"] = 7.25
        found["trouble"] = "free space is down"
        found["fates"] = {"left": {"georeferenced": 5, "no_time": 3}}
        found["without_time"] = ["scanner/left: 3 of 8 returns have no time: its stamps run free"]
        told = sentence(found)
        assert "7.2 s SKIPPED, more than 5 s behind" in told
        assert told.endswith("; free space is down")
        assert "3 no time" in told
        assert "its stamps run free" in told
        assert sentence(found | {"points_file": "p.npy ends"}).endswith("; free space is down; p.npy ends")

    def test_status_is_green_only_if_all_is_well(self, replayed: tuple[Path, Told]) -> None:
        """It needs points of every scanner on time, every clock locked, nothing damaged and nothing skipped."""
        found = copy.deepcopy(replayed[1])
        found |= {"trouble": "", "live_skipped_s": 0.0, "damaged_chunks": 0, "state": "following", "without_time": []}
        found["points_per_s"] = dict.fromkeys(found["points"], 8000)
        for one in found["latency_s"].values():
            if one["pulse"]:
                one["pulse"]["p95"] = 0.4  # the flight lasts 7 s, most of which is spent waiting for the clock
        late = copy.deepcopy(found)
        late["latency_s"]["scanner/left"]["pulse"]["p95"] = 12.0
        wrong: list[Told] = [
            {},
            {"trouble": "free space is down"},
            {"points_file": "p.npy ends"},
            {"live_skipped_s": 7.25},
            {"damaged_chunks": 2},
            {"without_time": ["scanner/left: 3 of 8 returns have no time"]},
            {"points_per_s": found["points_per_s"] | {"right": 0}},
            {"time": found["time"] | {"pps/main": {"state": "LOST", "sigma_ns": None}}},
            {"latency_s": late["latency_s"]},
        ]
        styles = [str(cast(Text, page(found | one).renderables[0]).style) for one in wrong]
        assert styles == ["bold green", *["bold yellow"] * (len(wrong) - 1)]
        assert "2 chunks of the log DAMAGED" in sentence(found | {"damaged_chunks": 2})

    def test_latency_uses_the_current_clock_of_the_scanner(self) -> None:
        """The clock is queried once a second and answers differently each time here."""
        asked: list[int] = []

        def gps_from_host(clock: str, host_ns: Int64Array) -> tuple[Int64Array, FloatArray]:
            asked.append(int(host_ns[0]))
            return host_ns + 100_000_000 * len(asked), np.array([np.inf if len(asked) == 1 else 1.0])

        host = SimpleNamespace(
            plan=SimpleNamespace(devices={"scanner/left": DevicePlan("pps/main")}), gps_from_host=gps_from_host
        )
        stream: Any = SimpleNamespace(clocks=SimpleNamespace(host=host))
        status = LiveStatus(Mock(), stream, Mock())
        found: list[float | None] = []
        for tenths in (0, 1, 2, 10, 11, 12):  # no time yet, 0.2 s, and after a second 0.3 s
            now_ns = 5_000_000_000 + tenths * 100_000_000
            status._pulse.clear()
            status.note_points("left", np.array([now_ns]), now_ns)
            told = status._pulse["scanner/left"].plain() if status._pulse else None
            found.append(told["max"] if told else None)
        assert found == [None, 0.2, 0.2, 0.2, 0.3, 0.3]
        assert len(asked) == 3

    def test_returns_without_time_are_reported_with_the_reason_while_they_come(self) -> None:
        """Only returns since the last report count; at the beginning nothing has time, which is temporary."""
        counts: dict[Fate, int] = {}
        refused: dict[str, int] = {}
        locked = ClockStatus(TimeState.LOCKED, 100.0)
        host = SimpleNamespace(
            by_source={},
            plan=SimpleNamespace(devices={"scanner/left": DevicePlan("pps/main")}),
            status=lambda clock, host_ns: locked,
        )
        clocks = SimpleNamespace(host=host, refused=lambda source: refused, stamps=lambda source: None)
        stream: Any = SimpleNamespace(
            scanners=["left"],
            clocks=clocks,
            path=SimpleNamespace(covered_until_ns=7),
            fates=lambda name: counts,
            waiting=lambda name: 0,
        )
        products: Any = Mock(points=Counter(), origin=lambda: {})
        products.map.comparison.present.return_value = {}
        status = LiveStatus(Mock(), stream, products)
        said = []
        for georeferenced, no_time, past_hour in ((0, 500, 0), (1000, 500, 0), (1900, 600, 0), (1900, 900, 300)):
            counts.update({Fate.GEOREFERENCED: georeferenced, Fate.NO_TIME: no_time})
            refused["past_hour"] = past_hour
            said.append(status.plain(None, 0)["without_time"])
        assert said[1] == []
        assert said[0][0].startswith("scanner/left: 500 of 500 returns have no time: its stamps run free")
        assert said[2][0].startswith("scanner/left: 100 of 1,000 returns have no time: its stamps run free")
        assert said[3][0].startswith("scanner/left: 300 of 300 returns have no time: its stamps contradict the host's")

    def test_a_navigated_trajectory_is_not_called_a_device_solution(self) -> None:
        """The receiver's protocol has INS solutions, but this receiver sends none."""
        host = SimpleNamespace(by_source={})
        stream: Any = SimpleNamespace(
            scanners=[], clocks=SimpleNamespace(host=host), path=SimpleNamespace(covered_until_ns=7)
        )
        products: Any = Mock(points=Counter(), origin=lambda: {})
        products.map.comparison.present.return_value = {}
        setup: Any = Mock(sources=SimpleNamespace(ins_source="gnss/rover"))
        status = LiveStatus(setup, stream, products)
        assert status.plain(None, 0)["trajectory"] == {"source": "gnss/rover", "covered_until_gps_ns": 7}
        status.navigation = "aligned with dual-antenna heading"
        assert status.plain(None, 0)["trajectory"]["source"] == "navigated"

    @pytest.mark.parametrize(("made_with", "other"), [("navigated", True), ("ins", False), ("file", False)])
    def test_a_calibration_made_with_another_trajectory_source_is_reported(
        self, flown: Flown, tmp_path: Path, made_with: str, other: bool
    ) -> None:
        """Points are made with the receiver's own INS here."""
        setup = flown.setup()
        assert setup.sources.ins_source is not None
        for name, one in setup.calibrations.items():
            setup.calibrations[name] = replaced(one, method="planes", header={"trajectory": made_with})
        session = LiveSession(setup, flown.session().info, tmp_path, LiveConfig(), None)
        told = [one["what"] for one in session.verdict["reasons"]]
        assert len(told) == (len(setup.calibrations) if other else 0)
        assert all("this run uses the device's own INS, whose alignment differs" in one for one in told)

    def test_an_unwritable_folder_is_refused(self, flown: Flown, tmp_path: Path) -> None:
        (tmp_path / "file").touch()
        with pytest.raises(UserError, match=r"Not a directory|File exists"):
            replay(flown.session(), flown.setup(), tmp_path / "file", LiveConfig(), None)


class TestCommand:
    @pytest.mark.slow
    def test_live_replays_with_another_configuration(self, flown: Flown, tmp_path: Path) -> None:
        config = flown.config.path.with_name("other.toml")
        config.write_text(flown.config.text + "\n[live]\npoints_per_s = 100\ncell_m = 5.0\n")
        logs = tmp_path / "logs"
        logs.mkdir()
        for path in flown.paths:
            (logs / path.name).symlink_to(path.absolute())
        (logs / "empty.mcap").touch()  # as a power cut leaves one
        given = ("live", "--replay", str(logs), str(config), "-o", str(tmp_path), "--json")
        refused = swath(*given)
        assert refused.returncode == 1
        assert "is nominal: points may lie" in refused.stderr
        done = swath(*given, "--accept-verdict")
        assert done.returncode == 0, done.stderr
        assert f"passed over: {logs}/empty.mcap: " in done.stderr
        found = json.loads(done.stdout)
        assert found["state"] == "replayed"
        seconds = int(SECONDS) + 1
        assert 0 < found["live_mcap"]["points_written"] <= 100 * seconds
        assert json.loads((tmp_path / "coverage.json").read_text())["cell_m"] == 5.0

    @pytest.mark.parametrize(
        ("arguments", "told"),
        [
            (["--replay", "some.mcap"], "--replay needs logs and -o DIR: swath live --replay LOG… -o DIR [CONFIG]"),
            (["-o", "x"], "-o needs --replay"),
            (["a", "b"], "too many arguments; give one CONFIG or DIR"),
            (["a", "--serve-port", "8765"], "--serve-port needs --serve"),
        ],
    )
    def test_wrong_usage_is_refused_in_one_line(self, arguments: list[str], told: str) -> None:
        done = swath("live", *arguments)
        assert (done.returncode, done.stdout) == (2, "")
        assert told in done.stderr
        assert done.stderr.count("\n") == 1

    def test_an_unwritable_compilation_cache_is_reported(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
    ) -> None:
        """A service's journal contains standard error."""

        class Nothing:
            def __init__(self, *_: object, **__: object) -> None:
                pass

            def run(self, stopped: object) -> Told:
                return {"state": "ended (stopped)"}

        monkeypatch.setattr("swath.daemon.processing.warm_up.warm_up", lambda setups: WarmUp(12, 3.25, None))
        monkeypatch.setattr("swath.daemon.system.lower_priority", lambda: None)
        monkeypatch.setattr("swath.daemon.processing.live.session.Live", Nothing)
        assert run_app(["live", str(tmp_path)]) == 0
        told = capfd.readouterr()
        assert told.out == ""
        assert told.err == WarmUp(12, 3.25, None).text() + "\n"


def test_the_pages_state_the_decision_interval() -> None:
    tick = f"{TICK_NS // 1_000_000} ms"
    assert f"decisions fall every {tick}" in (ROOT / "docs/live.md").read_text()
    decision = (ROOT / "docs/decisions/0012-ticks-make-live-equal-replay.md").read_text()
    assert f"a multiple of\n  {tick}, or where {TICK_BYTES >> 20} MiB" in decision
    assert f"comes up to {tick} later" in decision
