"""Tests that opened logs give records with right times, whole and in slices, and answer mistakes in a sentence."""

from __future__ import annotations

import datetime as dt
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import swath
from swath.daemon.log import chunk_index
from swath.daemon.processing.records import read
from swath.daemon.processing.records.tables import KINDS, flat_columns
from swath.drivers.scanner.beams import beam_points
from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.geodesy.quaternions import rotated
from tests.daemon.short_flight import ARM_B, MARK_AFTER_NS, Flown, S, fly_short, two_lines
from tests.library.builders import fly

ROOT = Path(__file__).resolve().parents[2]
XT16 = ROOT / "fixtures/hesai/nebula_xt16.pcap.gz"


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return fly(tmp_path_factory.mktemp("library"), seconds=30.0)


@pytest.fixture(scope="module")
def log(flown: Flown) -> swath.Log:
    return swath.open(flown.folder / "logs")


def closed(log: swath.Log) -> swath.Log:
    """Return a log after its with block."""
    with swath.open(*log.paths) as again:
        pass
    return again


def test_a_log_lists_its_sources_and_span(flown: Flown, log: swath.Log) -> None:
    assert log.sources == ["gnss/rover", "imu/main", "scanner/left"]
    assert [source.name for source in log] == log.sources
    assert log["gnss/rover"].protocol == "novatel"
    assert log.span_ns is not None
    truth = flown.truth()
    assert abs(log.span_ns[0] - truth.time_ns[0]) < S
    assert abs(log.span_ns[1] - truth.time_ns[-1]) < S
    assert len(log.sessions) == 1


def test_fixes_lie_on_the_truth_at_their_times(flown: Flown, log: swath.Log) -> None:
    fixes = log["gnss/rover"].fixes()
    placed = fixes[np.isfinite(fixes["lat_rad"]) & (fixes["antenna"] == "primary")]
    assert (placed["time_sigma_s"] == 0.0).all()
    truth = flown.truth()
    placed = placed[truth.fates(placed["gps_ns"]) == 0]
    assert len(placed) > 100
    poses = truth.poses(placed["gps_ns"])
    antenna_e = poses.position_e + rotated(poses.q_e_from_b, np.broadcast_to(ARM_B, (len(placed), 3)))
    away_e = e_from_geodetic(placed["lat_rad"], placed["lon_rad"], placed["height_m"]) - antenna_e
    sigma = np.sqrt(np.trace(placed["position_cov_l"], axis1=1, axis2=2))
    assert np.median(np.linalg.norm(away_e, axis=1) / sigma) < 2.0


def test_returns_have_the_times_of_their_pulses(flown: Flown, log: swath.Log) -> None:
    table = np.concatenate(list(log["scanner/left"].returns()))
    with np.load(flown.folder / "truth.npz") as truth:
        true_ns = truth["left.gps_ns"]
    assert len(table) == len(true_ns)
    assert (table["gps_ns"] > 0).all()
    error_s = (np.sort(table["gps_ns"]) - np.sort(true_ns)) * 1e-9
    assert np.abs(error_s).max() < 5.0 * table["time_sigma_s"].max() < 1e-5


def test_marks_headings_solutions_and_times_are_tables(log: swath.Log) -> None:
    rover = log["gnss/rover"]
    marks = rover.marks()
    assert set((marks["gps_ns"] % S).tolist()) == {MARK_AFTER_NS}
    headings = rover.headings()
    assert len(headings) > 20
    assert (headings["time_sigma_s"] == 0.0).all()
    solutions, times = rover.solutions(), rover.times()
    assert (np.diff(solutions["gps_ns"]) >= 0).all()
    assert set(times["leap_seconds"].tolist()) == {18, -1}  # -1: of messages in GPS time
    assert set((times["gps_ns"] % S).tolist()) == {0}
    assert rover.status().dtype == KINDS["status"].dtype


def test_times_by_guessed_leap_seconds_have_a_sigma_of_a_second(tmp_path: Path) -> None:
    """NMEA names UTC; in 2040 no table says how GPS time differs from it."""
    plan = two_lines("guessed", flight="seed = 5\nstart = 2040-06-15T09:00:00Z", gnss='protocol = "nmea"')
    flown = fly_short(tmp_path, plan, seconds=15.0)
    fixes = swath.open(flown.folder / "logs")["gnss/rover"].fixes()
    timed = fixes[fixes["gps_ns"] > 0]
    assert len(timed) > 10
    assert (timed["time_sigma_s"] == 1.0).all()


def test_a_slice_equals_the_part_of_the_whole(log: swath.Log) -> None:
    start = int(np.median(log["scanner/left"].table("returns")["gps_ns"]))
    stop = start + 2 * S
    for source, name in (("imu/main", "samples"), ("gnss/rover", "fixes"), ("scanner/left", "returns")):
        whole, part = log[source].table(name), log[source].table(name, start, stop)
        expected = whole[(whole["gps_ns"] >= start) & (whole["gps_ns"] < stop)]
        assert len(part) > 10
        for column, values in flat_columns(part).items():
            np.testing.assert_array_equal(values, flat_columns(expected)[column], err_msg=f"{name} {column}")


def test_a_slice_reads_only_its_chunks(flown: Flown, monkeypatch: pytest.MonkeyPatch) -> None:
    log = swath.open(flown.folder / "logs")
    assert log.span_ns is not None  # settles the clock
    asked: list[chunk_index.ChunkPlace] = []

    def reading(index: chunk_index.LogIndex, places: list[chunk_index.ChunkPlace], *rest: object) -> object:
        asked.extend(places)
        return chunk_index.read_chunks(index, places, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(read, "read_chunks", reading)
    start = log.span_ns[0] + 20 * S
    list(log["gnss/rover"].fixes(start, start + S))
    assert asked
    assert all(place.other for place in asked)
    assert max(place.end_ns for place in asked) - min(place.start_ns for place in asked) < 14 * S


def test_a_datetime_is_a_time(log: swath.Log) -> None:
    assert swath.gps_ns(dt.datetime(1980, 1, 6, tzinfo=dt.UTC)) == 0
    moment = dt.datetime(2026, 6, 15, 9, 0, 5, 250000, tzinfo=dt.timezone(dt.timedelta(hours=2)))
    assert swath.gps_ns(moment) == 1465542023250000000  # GPS week 2423, 25 223.25 s, with 18 leap seconds
    with pytest.raises(swath.SwathError, match="has no time zone"):
        log["gnss/rover"].fixes(start=dt.datetime(2026, 6, 15))  # noqa: DTZ001


@pytest.mark.slow
def test_data_frames_have_flat_columns_with_units(log: swath.Log) -> None:
    samples = log["imu/main"].samples()
    frame = log.to_pandas("imu/main")
    np.testing.assert_array_equal(frame.index, samples["gps_ns"])
    np.testing.assert_array_equal(frame["specific_force_z_mps2"], samples["specific_force_b"][:, 2])
    dataset = log.to_xarray("gnss/rover", "headings")
    np.testing.assert_array_equal(dataset["heading_rad"], log["gnss/rover"].headings()["heading_rad"])
    table = log.to_arrow("scanner/left")
    assert table.num_rows == sum(len(batch) for batch in log["scanner/left"].returns())
    covariances = [name for name in log.to_pandas("gnss/rover").columns if name.startswith("cov_")]
    assert covariances[:6] == ["cov_nn_m2", "cov_ne_m2", "cov_nd_m2", "cov_ee_m2", "cov_ed_m2", "cov_dd_m2"]


def test_raw_units_are_the_bytes_of_the_wire(log: swath.Log) -> None:
    units = list(log["scanner/left"].units())
    assert sum(unit.startswith(b"SREP") or len(unit) > 0 for _, unit in units) == len(units) > 10
    assert [time for time, _ in units] == sorted(time for time, _ in units)
    kinds = {type(record).__name__ for record in log["gnss/rover"].records()}
    assert {"GnssFix", "TimeMessage", "EventMark", "InsSolution"} <= kinds


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (lambda log: log["gnss/base"], "has no source 'gnss/base'; it has: gnss/rover, imu/main, scanner/left"),
        (lambda log: log["imu/main"].table("fixe"), "imu/main: no records 'fixe'; want one of: fixes, headings"),
        (lambda log: swath.open("/no/such/log"), "/no/such/log: no such file or directory"),
        (lambda log: swath.open(), "no path is given"),
        (lambda log: closed(log).sources, "was closed at the end of its with block; open it again"),
        (lambda log: swath.open(ROOT / "README.md"), "not a log|is not"),
        (
            lambda log: swath.read_pcap(XT16, "hesai-xt61"),
            "unknown scanner protocol 'hesai-xt61'; did you mean hesai-xt",
        ),
        (lambda log: swath.read_pcap(XT16, "hesai-xt16", beams=3), r"scanner\.head\.beams: unknown key"),
        (lambda log: swath.read_pcap(ROOT / "README.md", "hesai-xt16").xyz(), "neither pcap nor pcapng"),
        (lambda log: swath.read_pcap("/no/such.pcap", "hesai-xt16").xyz(), "/no/such.pcap: No such file"),
    ],
)
def test_mistakes_are_answered_in_a_sentence(log: swath.Log, mistake: object, words: str) -> None:
    with pytest.raises(swath.SwathError, match=words) as raised:
        mistake(log)  # type: ignore[operator]
    assert "\n" not in str(raised.value)


def test_a_capture_gives_places_in_the_heads_frame() -> None:
    capture = swath.read_pcap(XT16, protocol="hesai-xt16")
    rows = np.concatenate(list(capture.returns()))
    xyz = capture.xyz()
    assert len(xyz) == len(rows) == 86761
    assert capture.errors == {}
    beams = capture._captured._parser.beams  # type: ignore[attr-defined]
    np.testing.assert_allclose(xyz[::97], beam_points(rows[::97], beams), atol=1e-8)


def test_the_public_names_stand_in_the_stub_and_load_nothing_before_they_are_used() -> None:
    stub = (ROOT / "swath/__init__.pyi").read_text()
    for name in swath.__all__:
        assert f" as {name}\n" in stub or f"{name}: " in stub, name
        assert getattr(swath, name).__doc__ or name == "__version__", name
    assert stub.count(" as ") == len(swath.__all__) - 1
    code = "import sys, swath; assert not {'numpy', 'pydantic', 'numba'} & set(sys.modules); dir(swath)"
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="no attribute 'opne'"):
        swath.opne  # type: ignore[attr-defined]  # noqa: B018
