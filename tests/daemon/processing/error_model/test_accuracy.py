"""Tests the error model of a run from log to answer: `swath georef --error-model`, `swath accuracy`."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from pyproj import Transformer

import swath
from swath.daemon.cli.main import run_app
from swath.daemon.errors import ExitCode
from swath.daemon.processing.error_model.file import ENDING, read_model
from swath.daemon.processing.navigation.navigate import NavigationOptions, navigate_session
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.error_model.build import joint_turned
from swath.georef.error_model.state import model_of_state
from tests.daemon.short_flight import Flown, fly_short, two_lines

pytestmark = [pytest.mark.xdist_group("kernels"), pytest.mark.slow]

SIGMAS = ("sigma_easting", "sigma_northing", "sigma_height")


@dataclass(frozen=True)
class Run:
    """A flight, and its points with their error model."""

    flown: Flown
    folder: Path

    @property
    def strips(self) -> list[Path]:
        return sorted(self.folder.glob("*.laz"))

    @property
    def model(self) -> Path:
        return next(self.folder.glob(f"*{ENDING}"))

    def sidecar(self) -> dict[str, Any]:
        read: dict[str, Any] = json.loads(Path(str(self.model).replace(ENDING, ".json")).read_text())
        return read


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    plan = two_lines(
        "sure",
        flight="seed = 3\nlead_s = 3.0",
        norths_m=(0.0, 200.0),
        gnss='grade = "rtk"\nlever_arm_m = [0.4, -0.25, -1.2]',
        prf_hz=3000,
    )
    flown, folder = fly_short(tmp_path_factory.mktemp("sure"), plan), tmp_path_factory.mktemp("points")
    # the model takes footprints on level ground, and so do the points that it is compared with
    assert run_app(georef(flown, folder, "--error-model", "--surface", "level")) == ExitCode.OK
    return Run(flown, folder)


def georef(flown: Flown, folder: Path, *more: str) -> list[str]:
    """Return the arguments of `swath georef`, with the scanner's noise as the virtual one has it."""
    config = flown.changed(
        "sure.toml", **{"[scanner.left]\n": "[scanner.left]\nrange_sigma_m = 0.015\nangle_sigma_deg = 0.0001\n"}
    ).path
    own = ("--config", str(config), "--calibration", str(flown.folder / "left.true.toml"), "--workers", "1")
    return ["georef", str(flown.log), "-o", str(folder), "--crs", "EPSG:32632", *own, *more]


def told_by(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> Any:
    """Return what a command prints as JSON."""
    capsys.readouterr()
    assert run_app([*arguments, "--json"]) == ExitCode.OK
    return json.loads(capsys.readouterr().out)


def points_of(run: Run, count: int) -> tuple[FloatArray, Int64Array, Int64Array, FloatArray]:
    """Return places, GPS times, strips and sigmas of some points of all strips."""
    rng, columns = np.random.default_rng(1), []
    for path in run.strips:
        las = laspy.read(path)
        some = np.sort(rng.integers(0, len(las), count))
        time_ns = np.rint((np.asarray(las.gps_time)[some] + 1e9) * 1e9).astype(np.int64)
        sigma = np.stack([np.asarray(las[name])[some] for name in SIGMAS], axis=1)
        columns.append((las.xyz[some], time_ns, np.asarray(las.point_source_id)[some].astype(np.int64), sigma))
    places, times, strips, sigmas = (np.concatenate(column) for column in zip(*columns, strict=True))
    return places, times, strips, sigmas


def test_the_model_s_sigmas_are_those_of_the_points(run: Run) -> None:
    """The points' own sigmas come from the trajectory's sigmas alone, without the correlations of its components."""
    places, times, strips, sigmas = points_of(run, 400)
    model = read_model(run.model).model
    covariance = model.covariance(places, times, np.array([model.unit_of(strip) for strip in strips.tolist()]))
    ratio = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)) / sigmas
    np.testing.assert_allclose(ratio.mean(axis=0), 1.0, atol=0.05)
    assert (np.abs(ratio - 1.0) < 0.25).all()


def rigorous(joint: FloatArray, first: int, second: int, beam: FloatArray, beam_2: FloatArray) -> FloatArray:
    """Return the covariance (3, 3) of the difference of two beams' ends by a joint covariance in the map's axes."""

    def effect(beam: FloatArray) -> FloatArray:
        x, y, z = beam
        return np.hstack([np.eye(3), [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]])

    both = np.zeros((3, len(joint)))
    both[:, 6 * second : 6 * second + 6] += effect(beam_2)
    both[:, 6 * first : 6 * first + 6] -= effect(beam)
    found: FloatArray = both @ joint @ both.T
    return found


def test_differences_are_as_sure_as_the_smoother_s_joint_covariance_says(run: Run) -> None:
    """Without noise, and with a known calibration, the smoother's chain gives every difference's variance."""
    state = json.loads(run.model.read_text())
    for unit in state["units"]:
        unit.update(noise=[0.0, 0.0, 0.0], calibration=[])
    model = model_of_state(state)
    navigated = navigate_session(run.flown.session(), NavigationOptions())
    times = np.concatenate([unit.post_ns for unit in model.units])
    times = np.unique((times[:, np.newaxis] + np.array([0, 200_000_000])).ravel())
    chain = navigated.legs[0].solved.error_chain(times)
    assert len(chain) == len(times)
    joint = joint_turned(chain.covariance(), np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]))
    spans = [(one.post_ns[0], one.post_ns[-1]) for one in model.units]
    within = [[first <= at <= last for first, last in spans] for at in chain.time_ns]
    unit_of = [one.index(True) if any(one) else -1 for one in within]
    rng = np.random.default_rng(4)
    ratios: dict[str, list[FloatArray]] = {"near": [], "strip": [], "across": []}
    for _ in range(4000):
        i, j = rng.choice(np.flatnonzero(np.array(unit_of) >= 0), 2, replace=False).tolist()
        beams = np.stack([rng.uniform(-250.0, 250.0, 2), rng.uniform(-250.0, 250.0, 2), [-500.0, -500.0]], axis=1)
        places = []
        for at, beam in zip((i, j), beams, strict=True):
            unit = model.units[unit_of[at]]
            body = [np.interp(chain.time_ns[at], unit.post_ns, unit.position_m[:, axis]) for axis in range(3)]
            places.append(np.array([body + beam]))
        when = chain.time_ns[[i]], chain.time_ns[[j]]
        told = model.difference(places[0], when[0], unit_of[i], places[1], when[1], unit_of[j])[0]
        exact = rigorous(joint, i, j, *beams)
        kind = "across" if unit_of[i] != unit_of[j] else ("near" if abs(when[0][0] - when[1][0]) < 10**9 else "strip")
        ratios[kind].append(np.diag(told) / np.diag(exact))
    for kind, found in ratios.items():
        assert len(found) > 30, kind
        np.testing.assert_array_less(0.8, np.mean(found, axis=0), kind)
        np.testing.assert_array_less(np.mean(found, axis=0), 1.25, kind)


def test_true_errors_of_differences_are_of_the_size_that_is_told(run: Run) -> None:
    """One flight has few independent errors of the trajectory: the mean square is known to a factor of two only."""
    truth: dict[str, Any] = dict(np.load(run.flown.folder / "truth.npz"))
    to_map: Any = Transformer.from_crs("EPSG:4978", "EPSG:32632", always_xy=True)
    expected = np.stack(to_map.transform(*truth["left.point_e"].T), axis=1)
    order = np.lexsort((truth["left.return_number"], truth["left.gps_ns"]))
    model, squares = read_model(run.model).model, []
    rng = np.random.default_rng(2)
    for path in run.strips:
        las = laspy.read(path)
        mine = np.lexsort((np.asarray(las.return_number), np.asarray(las.gps_time)))
        time_ns = np.rint((np.asarray(las.gps_time)[mine] + 1e9) * 1e9).astype(np.int64)
        at = np.searchsorted(truth["left.gps_ns"][order], time_ns - 500)
        places, error = las.xyz[mine], las.xyz[mine] - expected[order][at]
        assert np.abs(error).max() < 1.0
        first = rng.integers(0, len(mine) - 20_000, 3000)
        second = first + rng.integers(1, 20_000, 3000)
        unit = model.unit_of(int(las.point_source_id[0]))
        covariance = model.difference(places[first], time_ns[first], unit, places[second], time_ns[second], unit)
        apart = error[first] - error[second]
        squares.append(np.einsum("ni,nij,nj->n", apart, np.linalg.inv(covariance), apart) / 3.0)
    assert 0.5 < np.concatenate(squares).mean() < 2.0


def test_the_sidecar_names_the_model_and_what_its_fit_leaves(run: Run) -> None:
    told = run.sidecar()
    entry = told["error_model"]
    assert entry["file"] == run.model.name
    assert run.model.name in told["files"]
    assert entry["units"] == 2
    assert entry["trajectory"] == "joint covariance of the smoother"
    for fitted in entry["correlation_in_time"].values():
        # no function is negative, as the heading's own correlation is after a turn; tilts in the map's axes left 0.33
        assert fitted["residual"]["rms"] < 0.15
    assert run.model.stat().st_size < 40_000


def test_a_place_is_answered_for_each_strip_there(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    places, _, strips, sigmas = points_of(run, 400)
    k = int(np.flatnonzero(strips == 1)[200])
    east, north, _ = places[k]
    told = told_by(["accuracy", *map(str, run.strips), "--at", f"{east},{north}"], capsys)
    (mine,) = [one for one in told if one["strip"] == 1]
    np.testing.assert_allclose(mine["xyz"], places[k], atol=1e-6)
    np.testing.assert_allclose(mine["sigma_m"], sigmas[k], rtol=0.25)
    assert mine["ce90_m"] > mine["ellipse"]["major_m"] > mine["ellipse"]["minor_m"] > 0.0
    assert run_app(["accuracy", *map(str, run.strips), "--at", f"{east},{north}"]) == ExitCode.OK
    assert "sigma: easting" in capsys.readouterr().out


def test_a_difference_is_surer_than_its_points(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    places, _, strips, _ = points_of(run, 400)
    first, second = np.flatnonzero(strips == 1)[100], np.flatnonzero(strips == 2)[100]
    names = list(map(str, run.strips))
    there = [f"{east},{north}" for east, north, _ in places[[first, first + 1, second]]]
    own = told_by(["accuracy", *names, "--between", there[0], there[1]], capsys)
    far = told_by(["accuracy", *names, "--between", there[0], there[2]], capsys)
    (alone, *_) = told_by(["accuracy", names[0], "--at", there[0]], capsys)
    assert own["first"]["strip"] == own["second"]["strip"]
    assert own["sigma_m"][0] < 0.7 * alone["sigma_m"][0] * np.sqrt(2.0)
    assert own["length_m"] == pytest.approx(np.linalg.norm(own["difference_m"]))
    assert far["first"]["strip"] != far["second"]["strip"] or far["sigma_m"] != own["sigma_m"]


def test_pairs_of_a_table_are_answered_row_by_row(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, two = (path.name for path in run.strips)
    table, answers = run.folder / "pairs.csv", tmp_path / "answers.csv"
    rows = [(one, 700, two, 5), (two, 5, one, 700), (one, 9, one, 9), (one, 3, one, 4)]
    table.write_text("file_1,point_1,file_2,point_2\n" + "".join(f"{a},{b},{c},{d}\n" for a, b, c, d in rows))
    assert run_app(["accuracy", "--pairs", str(table), "-o", str(answers)]) == ExitCode.OK
    assert capsys.readouterr().out == f"4 pairs: {answers}\n"
    with answers.open(newline="") as file:
        told = list(csv.DictReader(file))
    assert [(row["file_1"], int(row["point_1"]), row["file_2"], int(row["point_2"])) for row in told] == rows
    sigmas = np.array([[float(row[name]) for name in SIGMAS] for row in told])
    np.testing.assert_array_equal(sigmas[0], sigmas[1])
    np.testing.assert_array_equal(sigmas[2], 0.0)
    assert (sigmas[3] < sigmas[0]).all()
    model = read_model(run.model).model
    las = [laspy.read(path) for path in run.strips]
    places = [np.asarray(las[0].xyz[700:701]), np.asarray(las[1].xyz[5:6])]
    times = [np.rint((np.asarray(las[k].gps_time[[at]]) + 1e9) * 1e9).astype(np.int64) for k, at in ((0, 700), (1, 5))]
    units = [model.unit_of(1), model.unit_of(2)]
    covariance = model.difference(places[0], times[0], units[0], places[1], times[1], units[1])[0]
    np.testing.assert_allclose(sigmas[0], np.sqrt(np.diag(covariance)), atol=1e-6)
    assert float(told[0]["covariance_easting_height"]) == pytest.approx(covariance[0, 2], rel=1e-5)
    assert run_app(["accuracy", "--pairs", str(table), "-o", str(answers)]) == ExitCode.USAGE
    table.unlink()


def without_model(path: Path, copy: Path) -> Path:
    """Copy a file of points without its extended records."""
    las = laspy.read(path)
    las.evlrs = None
    las.write(copy)
    return copy


def test_the_model_travels_with_the_points(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A file answers alone as beside its model, and so does its copy by another program."""
    east, north, _ = points_of(run, 400)[0][200]
    asked = ["--at", f"{east},{north}"]
    there = told_by(["accuracy", str(run.strips[0]), *asked], capsys)
    alone, again = tmp_path / "alone.laz", tmp_path / "again.laz"
    alone.write_bytes(run.strips[0].read_bytes())
    laspy.read(alone).write(again)
    for copy in (alone, again):
        assert told_by(["accuracy", str(copy), *asked], capsys) == [one | {"file": copy.name} for one in there]
    with laspy.open(alone) as reader:
        (record,) = reader.evlrs
    assert (record.user_id, record.record_id) == ("swath", 2)
    assert record.record_data_bytes().decode() == run.model.read_text()
    (strip,) = [one for one in run.sidecar()["strips"] if one["file"] == run.strips[0].name]
    assert strip["bytes"] == run.strips[0].stat().st_size
    assert run_app(georef(run.flown, tmp_path / "copc", "--error-model", "--copc")) == ExitCode.OK
    (first, *_) = sorted((tmp_path / "copc").glob("*.copc.laz"))
    (other,) = told_by(["accuracy", str(first), *asked], capsys)
    np.testing.assert_allclose(other["covariance_m2"], there[0]["covariance_m2"], rtol=1e-6)
    with laspy.open(first) as reader:
        assert [(one.user_id, one.record_id) for one in reader.evlrs] == [("copc", 1000), ("swath", 2)]


def test_python_answers_as_the_command_does(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    places, times, strips, _ = points_of(run, 400)
    first, second = np.flatnonzero(strips == 1)[200], np.flatnonzero(strips == 2)[200]
    model = swath.error_model.read(run.strips[0])
    assert model.strips == [1, 2]
    assert model.scanners == {"left": 0}
    assert model.state() == swath.error_model.read(run.model).state() == json.loads(run.model.read_text())
    (told, *_) = told_by(["accuracy", str(run.strips[0]), "--at", f"{places[first][0]},{places[first][1]}"], capsys)
    found = model.covariance(places[first], times[[first]], 1)
    np.testing.assert_allclose(found[0], told["covariance_m2"], rtol=1e-6, atol=1e-9)  # times to 256 ns
    assert swath.error_model.figures(found[0])["ce90_m"] == pytest.approx(told["ce90_m"], rel=1e-6)
    sides = (places[first], times[[first]], strips[[first]], places[second], times[[second]], strips[[second]])
    crossed, apart = model.cross_covariance(*sides), model.difference(*sides)
    alone = found + model.covariance(places[second], times[[second]], 2)
    np.testing.assert_allclose(apart, alone - crossed - crossed.transpose(0, 2, 1), atol=1e-12)
    with pytest.raises(swath.error_model.ErrorModelError, match="has no strip 9; it has 1, 2"):
        model.covariance(places[first], times[[first]], 9)
    with pytest.raises(swath.error_model.ErrorModelError, match="has no scanner channel 2; it has 0"):
        model.covariance(places[first], times[[first]], 1, channel=2)
    with pytest.raises(ValueError, match="1 points have 2 times"):
        model.covariance(places[first], times[:2], 1)
    with pytest.raises(swath.SwathError, match="no such file"):
        swath.error_model.read(run.folder / "none.laz")


def test_wrong_questions_get_one_line(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names, table = list(map(str, run.strips)), tmp_path / "pairs.csv"
    lone = without_model(run.strips[0], tmp_path / "lone.laz")
    table.write_text(f"file_1,point_1,file_2,point_2\n{names[0]},1,{names[1]},99999999\n")
    headless = tmp_path / "headless.csv"
    headless.write_text("a,b\n1,2\n")
    answers = ["-o", str(tmp_path / "answers.csv")]
    for arguments, told in (
        ([], "give one of --at E,N, --between E,N E,N, --volume FILE and --pairs CSV"),
        ([*names, "--at", "1,2", "--pairs", str(table)], "give one of"),
        ([*names, "--at", "1"], "want easting and northing"),
        ([*names, "--at", "1,2"], "no point lies within 2 m of 1.000, 2.000; the nearest is"),
        (["--at", "1,2"], "needs LAZ"),
        (["--pairs", str(table)], "needs -o CSV"),
        ([str(tmp_path / "none.laz"), "--at", "1,2"], "no such file"),
        ([str(lone), "--at", "1,2"], "has no error model in it, nor NAME.error_model.json beside it"),
        (["--pairs", str(table), *answers], "has no row 99999999; its"),
        (["--pairs", str(headless), *answers], "has no column file_1"),
        (["--pairs", str(tmp_path / "none.csv"), *answers], "No such file"),
    ):
        capsys.readouterr()
        assert run_app(["accuracy", *arguments]) in (ExitCode.USAGE, ExitCode.PROBLEM), arguments
        said = capsys.readouterr().err
        assert told in said, said
        assert said.count("\n") == 1, said


def test_a_model_of_another_run_is_refused(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = without_model(run.strips[0], tmp_path / run.strips[0].name)
    model = tmp_path / run.model.name
    state = json.loads(run.model.read_text())
    first = state["units"][0]
    for holder, change, told in (
        (first, {"strip": 7}, "has no strip 1; it has 2, 7"),
        (first, {"strip": 1, "start_gps_ns": 0, "end_gps_ns": 1}, "at other times than its error model"),
        (state, {"version": 9}, "version 9; this program reads"),
    ):
        holder.update(change)
        model.write_text(json.dumps(state))
        capsys.readouterr()
        assert run_app(["accuracy", str(points), "--at", "492523,5258655"]) == ExitCode.PROBLEM
        assert told in capsys.readouterr().err


def test_without_sigmas_there_is_no_model(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A trajectory that comes from elsewhere gives sigmas, and its correlations in time are assumed."""
    (csv_file,) = run.folder.glob("*_trajectory.csv")
    true = ("--trajectory", str(csv_file), "--trajectory-datum", "same")
    capsys.readouterr()
    assert run_app(georef(run.flown, tmp_path, *true, "--error-model", "--json")) == ExitCode.OK
    entry = json.loads(capsys.readouterr().out)["error_model"]
    assert entry["trajectory"] == "sigmas of the file"
    assert entry["correlation_in_time"]["height"] == {
        "a": 1.0,
        "alpha": 0.0,
        "beta": 0.0,
        "tau_s": 60.0,
        "assumed": True,
    }
    assert run_app(georef(run.flown, tmp_path, *true, "--overwrite")) == ExitCode.OK
    assert not list(tmp_path.glob(f"*{ENDING}"))
