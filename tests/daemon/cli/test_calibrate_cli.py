"""Tests ``swath calibrate`` from logs to files: the truth within its sigmas, and mistakes in one line."""

from __future__ import annotations

import json
import math
import re
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher
from scipy.spatial import cKDTree

from swath.calib.features import Features, Plane
from swath.calib.flight import Flight
from swath.calib.planes.fit import PlaneSettings
from swath.calib.planes.search import find_planes
from swath.daemon.cli.main import run_app
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.log.reader import Session
from swath.daemon.processing.calibration import run as calibrate_run
from swath.daemon.processing.calibration.model import model_of
from swath.daemon.processing.calibration.plan.run import PlanOptions, plan_calibration
from swath.daemon.processing.calibration.returns import KeptFlight, read_flight
from swath.daemon.processing.calibration.run import refuse_no_planes
from swath.daemon.processing.flights.read import Check, GeorefOptions
from swath.daemon.processing.setup.setup import Setup
from swath.daemon.processing.warm_up import warm_calibration
from swath.georef.mapping.frame import Mapping
from swath.georef.progress import Tell
from swath.georef.scanner.calibration import Calibration, read_calibration
from swath.sim.plan.plan import parse_plan
from tests.calib.village import KNOWN, Made, judge_unusable, village

pytestmark = [pytest.mark.xdist_group("kernels"), pytest.mark.slow]

ANGLES = ("omega_rad", "phi_rad", "kappa_rad")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return village(tmp_path_factory.mktemp("village"), prf_hz=20_000.0, lines=(0, 1, 2, 3, 4))


def arguments(made: Made, output: Path, *more: str) -> list[str]:
    trajectory = made.flown.folder / "true_trajectory.csv"
    return [
        *("calibrate", str(made.flown.log), "-o", str(output), "--trajectory", str(trajectory)),
        *("--trajectory-datum", "same", "--workers", "1", *KNOWN),
        *(() if "--model" in more else ("--model", "basic")),
        *more,
    ]


def loops() -> set[str]:
    """Return calib's loops that this process has compiled or read from the cache, with their types."""
    modules = [module for name, module in sys.modules.items() if name.startswith("swath.calib.")]
    known = [one for module in modules for one in vars(module).values() if isinstance(one, Dispatcher)]
    return {f"{one.py_func.__qualname__} {types}" for one in known for types in one.overloads}


Read = Callable[[GeorefOptions, Path, Tell, Check], KeptFlight]


@pytest.fixture(scope="module")
def read_once(tmp_path_factory: pytest.TempPathFactory) -> Read:
    """Return a reading that reads the log of each trajectory once, which takes most of a command's time."""
    known: dict[Path | None, tuple[KeptFlight, Sequence[Session], Sequence[Setup]]] = {}

    def read(request: GeorefOptions, folder: Path, tell: Tell, check: Check) -> KeptFlight:
        key, opened = request.trajectory.file, []

        def noting(sessions: Sequence[Session], setups: Sequence[Setup]) -> None:
            opened.append((sessions, setups))
            check(sessions, setups)

        if key in known:
            check(*known[key][1:])
        else:
            known[key] = read_flight(request, tmp_path_factory.mktemp("returns"), tell, noting), *opened[0]
        return known[key][0]

    return read


@pytest.fixture
def read_already(read_once: Read, monkeypatch: pytest.MonkeyPatch) -> None:
    """Give commands what an earlier one read of their log."""
    monkeypatch.setattr(calibrate_run, "read_flight", read_once)


@pytest.fixture(scope="module")
def products(made: Made, read_once: Read, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the products of one run, and in ``new_loops`` the loops that a warm-up does not compile."""
    folder = tmp_path_factory.mktemp("products")
    control = made.flown.folder / "control.csv"
    facts = folder / "facts.toml"
    facts.write_text('[SD_Calibration]\ncalibrationAgency = "Geo & Sons"\n[CA_GNSS]\nnumberSatellites = 14\n')
    report = ("--report", str(folder / "report"), "--control", str(control), "--facts", str(facts))
    warm_calibration()
    warm = loops()
    assert len(warm) > 5
    logs = folder / "logs"
    logs.mkdir()
    (logs / made.flown.log.name).symlink_to(made.flown.log)
    (logs / "begun_0.mcap").touch()  # as a power cut leaves it at a part's beginning
    given = arguments(made, folder / "left.toml", *report)
    given[given.index(str(made.flown.log))] = str(logs)
    summary = Path(given[given.index("--trajectory") + 1]).with_suffix(".json")
    summary.write_text('{"format": "swath.trajectory", "solution": "smoothed", "sessions": []}')
    with patch.object(calibrate_run, "read_flight", read_once):
        assert run_app(given) == 0
    (folder / "new_loops").write_text("\n".join(sorted(loops() - warm)))
    return folder


def test_files_of_a_directory_that_are_not_logs_are_skipped_and_reported(products: Path) -> None:
    record = json.loads((products / "report" / "calibration.json").read_text())
    assert record["notes"][0] == f"skipped: {products / 'logs' / 'begun_0.mcap'}: is not an MCAP file"


def test_the_file_names_the_source_of_the_trajectory(products: Path) -> None:
    """The summary of `swath trajectory` beside the file names the source."""
    assert read_calibration((products / "left.toml").read_text(), "left.toml").header["trajectory"] == "navigated"


def refused(capsys: pytest.CaptureFixture[str], output: Path, given: list[str]) -> str:
    """Return the single error line of a command that wrote no file."""
    capsys.readouterr()
    assert run_app(given) in (1, 2, 3)
    line = capsys.readouterr().err
    assert line.startswith("swath: ")
    assert line.count("\n") == 1, line
    assert "internal error" not in line
    assert not output.exists()
    return line


def test_the_truth_is_within_the_sigmas(made: Made, products: Path) -> None:
    found = read_calibration((products / "left.toml").read_text(), "left.toml")
    for name in (*ANGLES, "range_offset_m"):
        sigma = math.sqrt(found.covariance()[list_of(name), list_of(name)])
        assert 0.0 < sigma < (0.02 if name == "range_offset_m" else math.radians(0.01)), name
        assert abs(found.value(name) - made.truth.value(name)) < 3.0 * sigma, name
    assert found.method == "combined"
    assert (found.ranges, found.refraction) == ("corrected", "none")


def test_a_calibration_made_with_other_settings_is_refused(
    made: Made, products: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (made.flown.folder / "swath.toml").read_text()
    config = made.flown.folder / "vacuum.toml"
    assert 'ranges = "corrected"' in text
    config.write_text(text.replace('ranges = "corrected"', 'ranges = "vacuum"'))
    given = ["--config", str(config), "--calibration", str(products / "left.toml"), "--trajectory-datum", "same"]
    assert run_app(["georef", str(made.flown.log), "-o", str(tmp_path / "points"), *given]) == ExitCode.USAGE
    assert 'was estimated with ranges = "corrected", [atmosphere] has "vacuum"' in capsys.readouterr().err


def list_of(name: str) -> int:
    from swath.georef.scanner.calibration import INDEX

    return INDEX[name]


def test_strips_agree_after_calibration(products: Path) -> None:
    told = json.loads((products / "report" / "calibration.json").read_text())
    before, after = (told["strips"][when]["all"]["rms_m"] for when in ("before", "after"))
    assert before > 0.3
    assert after < 0.03
    assert told["redundancy"] > 1000
    assert told["verdict"]["level"] in ("good", "care")
    assert "strips agree to" in told["verdict"]["sentence"]


def test_the_history_reads_the_file_or_else_the_record(products: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told = []
    for path in (products / "left.toml", products / "report" / "left.record.json"):
        capsys.readouterr()
        assert run_app(["history", str(path), "--json"]) == 0
        told.append(json.loads(capsys.readouterr().out)["scanners"][0]["calibrations"][0])
    of_file, of_record = told
    assert of_file["id"] == of_record["id"]
    for key in ("omega_deg", "phi_deg", "kappa_deg", "range_offset_m"):
        assert of_record["parameters"][key] == pytest.approx(of_file["parameters"][key], abs=1e-9)
        assert of_record["sigmas"].get(key) == pytest.approx(of_file["sigmas"].get(key), rel=1e-6)
    assert run_app(["history", str(products)]) == 0
    assert capsys.readouterr().out.startswith("left")


def test_report_and_record_are_written_beside_the_file(products: Path) -> None:
    page = (products / "report" / "report.html").read_text()
    assert "boresight" in page
    assert "src='http" not in page
    assert 'src="http' not in page
    assert (products / "report" / "report.pdf").read_bytes().startswith(b"%PDF")


def test_the_record_contains_the_given_facts_and_attaches_its_matrices(products: Path) -> None:
    record = json.loads((products / "report" / "left.record.json").read_text())
    attributes = {f"{owner['name']}.{one['name']}": one for owner in record["classes"] for one in owner["attributes"]}
    assert attributes["SD_Calibration.calibrationAgency"]["value"] == "Geo & Sons"
    assert attributes["CA_GNSS.numberSatellites"]["value"] == 14
    matrices = np.load(products / "report" / "left.record.npz")
    planes = attributes["CA_LidarCalComputation.corrections2"]["matrix"]
    assert planes["attachment"] == "left.record.npz"
    found = matrices[planes["array"]]
    assert found.shape == (planes["rows"], 4)
    normals = matrices["lidarPlaneParameters"][:, :3] + found[:, :3]
    assert np.abs(np.linalg.norm(normals, axis=1) - 1.0).max() < 1e-12  # the unit-length condition, exactly
    assert 0.0 < np.abs(found[:, :3]).max() < np.radians(1.0)
    told = {attribute["name"]: attribute for owner in record["classes"] for attribute in owner["attributes"]}
    design = told["designMatrix1"]["matrix"]
    assert design["attachment"] == "left.record.npz"
    with np.load(products / "report" / design["attachment"]) as arrays:
        assert arrays[design["array"]].shape == (told["lidarNObjectPoints"]["value"], 16)


def test_after_a_warm_up_no_loop_is_compiled(products: Path) -> None:
    assert (products / "new_loops").read_text() == ""


def test_calibration_of_a_navigated_flight_matches_the_sigmas_of_the_plan(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sigmas of the calibration are within a quarter of those predicted by the plan."""
    output, control = tmp_path / "left.toml", str(made.flown.folder / "control.csv")
    searches: list[tuple[PlaneSettings, Features]] = []

    def searched(flight: Flight, settings: PlaneSettings, each: Any, tell: Any) -> Features:
        searches.append((settings, find_planes(flight, settings, each, tell)))
        return searches[-1][1]

    monkeypatch.setattr(calibrate_run, "find_planes", searched)
    given = ("--model", "basic", *KNOWN, "--control", control, "--trajectory-datum", "same", "--workers", "1")
    assert run_app(["calibrate", str(made.flown.log), "-o", str(output), *given]) == 0
    assert [settings is calibrate_run.EVERY for settings, _ in searches] == [False] * (len(searches) - 1) + [True]
    part, every = (sum(plane.points for plane in features.planes) for _, features in searches[-2:])
    assert every > 1.5 * part
    (told,) = re.findall(r"^redundancy = (.+)$", output.read_text(), re.MULTILINE)
    assert float(told) == pytest.approx(every, rel=0.2)
    found = read_calibration(output.read_text(), "left.toml")
    planned = plan_calibration(
        parse_plan(made.plan, tmp_path), PlanOptions(model_of("basic", KNOWN[1], "", KNOWN[3::2]))
    )
    names = planned.predicted.names
    assert set(names) == {"left.omega_rad", "left.phi_rad", "left.kappa_rad", "left.range_offset_m"}
    for name, predicted in zip(names, planned.predicted.sigmas, strict=True):
        sigma = found.sigmas[list_of(name.removeprefix("left."))]
        assert 0.75 < predicted / sigma < 1.25, name


@pytest.mark.usefixtures("read_already")
def test_control_outside_the_points_is_refused(made: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two points are too few for the software to doubt their coordinates as a whole."""
    lines = (made.flown.folder / "control.csv").read_text().splitlines()
    points = [line.split(",") for line in lines[1:]]
    control = tmp_path / "control.csv"
    raised = [",".join((name, lat, lon, f"{float(h) + 150.0:.3f}", sigma)) for name, lat, lon, h, sigma in points[:2]]
    control.write_text("\n".join([lines[0], *raised]) + "\n")
    output = tmp_path / "left.toml"
    line = refused(capsys, output, arguments(made, output, "--control", str(control)))
    assert "control.csv: no point lies on ground where a strip has a plane" in line


def picked(made: Made, path: Path) -> Path:
    """Write forty places on roofs and ground, as the strips' points show them with the start calibration."""
    flight, truth = made.flight, made.at_truth()
    mapping = Mapping("EPSG:25832", datum="same")
    mapping.settle(flight.frame.origin_e[np.newaxis])
    trees = [cKDTree(swath.points_t) for swath in truth.swaths]
    rows = ["name,strip,x,y,z,sigma_m"]
    for number, place_t in enumerate(truth.swaths[0].points_t[:: len(truth.swaths[0]) // 40]):
        for swath, true, tree in zip(flight.swaths, truth.swaths, trees, strict=True):
            away_m, at = tree.query(place_t)
            if away_m < 0.6:
                place_e = flight.frame.e_from_t((swath.points_t[at] + place_t - true.points_t[at])[np.newaxis])
                x, y, z = mapping.map_from_e(place_e)[0]
                rows.append(f"p{number},{swath.strip},{x:.3f},{y:.3f},{z:.3f},0.02")
    path.write_text("\n".join(rows) + "\n")
    return path


@pytest.mark.usefixtures("read_already")
def test_points_picked_before_the_calibration_fit_after_it(
    made: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output, ties = tmp_path / "left.toml", picked(made, tmp_path / "ties.csv")
    control = ("--control", str(made.flown.folder / "control.csv"))
    assert run_app(arguments(made, output, "--ties", str(ties), *control)) == 0
    assert "rejected" not in capsys.readouterr().out
    found = read_calibration(output.read_text(), "left.toml")
    for name in (*ANGLES, "range_offset_m"):
        sigma = found.sigmas[list_of(name)]
        assert sigma > 0.0, name
        assert abs(found.value(name) - made.truth.value(name)) < 3.0 * sigma, name


def first_strips(made: Made, count: int, folder: Path) -> tuple[str, str]:
    """Return the option that selects the first strips only."""
    strips = folder / "strips.csv"
    spans = [f"{int(swath.time_ns[0])},{int(swath.time_ns[-1])}" for swath in made.flight.swaths[:count]]
    strips.write_text("\n".join(["start_gps_ns,end_gps_ns", *spans]) + "\n")
    return "--strips", str(strips)


def test_an_unusable_trajectory_makes_the_calibration_unusable(
    made: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The verdict is printed first and written to the file, which passes it on to everything made with it."""
    file, output = tmp_path / "flight.csv", tmp_path / "left.toml"
    file.write_bytes((made.flown.folder / "true_trajectory.csv").read_bytes())
    judge_unusable(file, "the lever arm has another sign")
    given = arguments(made, output, *first_strips(made, 3, tmp_path))
    given[given.index("--trajectory") + 1] = str(file)
    assert run_app(given) == 1
    told = capsys.readouterr()
    assert told.out.splitlines()[0] == f"not to be used: trajectory {file}: the lever arm has another sign"
    assert 'left.toml: the verdict is "not to be used"; use --accept-verdict to accept it\n' in told.err
    assert str(file) not in told.err
    header = read_calibration(output.read_text(), "left.toml").header
    assert header["verdict"] == "not to be used"
    assert "the lever arm has another sign" in header["verdict_reasons"][0]
    assert run_app([*given, "--overwrite", "--accept-verdict"]) == 0
    assert read_calibration(output.read_text(), "left.toml").header["verdict"] == "not to be used"


def test_one_strip_is_refused(made: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "left.toml"
    line = refused(capsys, output, arguments(made, output, *first_strips(made, 1, tmp_path)))
    assert "1 strip" in line


@pytest.mark.usefixtures("read_already")
def test_heights_above_the_geoid_are_refused(made: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = (made.flown.folder / "control.csv").read_text().splitlines()
    lowered = [lines[0]]
    for line in lines[1:]:
        name, lat, lon, height, sigma = line.split(",")
        lowered.append(",".join((name, lat, lon, f"{float(height) - 47.6:.4f}", sigma)))
    control = tmp_path / "control.csv"
    control.write_text("\n".join(lowered) + "\n")
    output = tmp_path / "left.toml"
    line = refused(capsys, output, arguments(made, output, "--control", str(control)))
    assert "orthometric" in line


# effect of intensity on range: linear between these and constant beyond, so knots at these fit exactly
IBRC = (("intensity", [500.0, 2000.0]), ("correction_m", [0.025, -0.05]))


@pytest.fixture(scope="module")
def by_intensity(tmp_path_factory: pytest.TempPathFactory) -> Made:
    table = "\n".join(f"{key} = {values}" for key, values in IBRC)
    folder, more = tmp_path_factory.mktemp("by_intensity"), f"[scanner.left.ibrc]\n{table}\n"
    return village(folder, prf_hz=10_000.0, lines=(0, 1, 2, 3, 4), plan_more=more)


def asked(made: Made, folder: Path, capsys: pytest.CaptureFixture[str], model: str) -> tuple[Any, Calibration]:
    """Return the JSON output and the file of a run with a model file."""
    output, file, control = folder / "left.toml", folder / "model.toml", made.flown.folder / "control.csv"
    file.write_text(model)
    capsys.readouterr()
    assert run_app(arguments(made, output, "--model", str(file), "--control", str(control), "--json")) == 0
    return json.loads(capsys.readouterr().out), read_calibration(output.read_text(), "left.toml")


@pytest.mark.usefixtures("read_already")
def test_a_model_file_can_request_the_correction_by_intensity(
    by_intensity: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    knots = [500.0, 1000.0, 1500.0, 2000.0]
    told, found = asked(by_intensity, tmp_path, capsys, f'model = "basic"\n[ibrc]\nknots = {knots}\nreference = 1000\n')
    unknowns = {one["name"]: one for one in told["unknowns"]}
    assert set(unknowns) == {
        *(f"left.{name}" for name in (*ANGLES, "range_offset_m")),
        *map("left.ibrc.{}".format, (0, 2, 3)),
    }
    assert found.ibrc is not None
    in_file = np.interp(knots, *found.ibrc).tolist()
    assert in_file[1] == 0.0
    for knot in (0, 2, 3):
        one = unknowns[f"left.ibrc.{knot}"]
        assert 0.0 < one["sigma"] < 0.01
        assert in_file[knot] == pytest.approx(one["value"], abs=1e-9)
        assert abs(one["value"] - 5e-5 * (1000.0 - knots[knot])) < 3.0 * one["sigma"], (knot, one)
    sigma = found.sigmas[list_of("range_offset_m")]
    assert abs(found.value("range_offset_m") - by_intensity.truth.value("range_offset_m")) < 3.0 * sigma
    assert told["ibrc_knots"] == knots
    assert told["model"].startswith("basic; fixed range_scale_ppm, ")
    assert told["model"].endswith("; ibrc at 500, 1000, 1500, 2000 (reference 1000), smooth to 0.02 m")
    assert "model.toml" in [one["name"] for one in told["inputs"]]


@pytest.mark.usefixtures("read_already")
def test_undetermined_tables_of_a_model_are_held_and_reported(
    by_intensity: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No return is as bright as the last knot, almost none is a second one, and all are in one zone."""
    tables = "[ibrc]\nknots = [500, 1000, 2500, 60000]\n[range_offset]\nreturn_slots = [2]\nmta_zones = [0]\n"
    told, found = asked(by_intensity, tmp_path, capsys, f'model = "basic"\n{tables}')
    held = {one["name"]: one for one in told["held"] if one["why"] != "held by your choice"}
    assert {"ibrc.3", "range_offset_slot.2", "range_offset_zone.0"} <= set(held)
    assert not [one for one in told["unknowns"] if one["name"].removeprefix("left.") in held]
    for one in held.values():
        assert one["why"]
        assert one["remedy"]
    assert "cannot separate it from left.range_offset_m" in held["range_offset_zone.0"]["why"]
    assert "Not determined by this flight: " in told["verdict"]["sentence"]
    assert found.range_offsets == ()


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--observe", "trees"), "--observe"),
        (("--fix", "phi"), "phi"),
        (("--prior", "phi_deg=much"), "--prior"),
        (("--control", "nowhere.csv"), "nowhere.csv"),
        (("--model", "all"), "--model"),
        (("--model", "nowhere.toml"), "nowhere.toml"),
        (("--scanner", "right"), "right"),
    ],
)
def test_wrong_usage_is_refused(
    made: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], said: str
) -> None:
    output = tmp_path / "left.toml"
    assert said in refused(capsys, output, arguments(made, output, *more))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "[CA_GNSS]\nnumberSatelites = 14\n",
            "facts.toml: CA_GNSS.numberSatelites: the record has no such attribute; did",
        ),
        ("[CA_GNSS]\nnumberSatellites = 1.5\n", "facts.toml: CA_GNSS.numberSatellites: got 1.5, want a whole number"),
        ("CA_GNSS = 3\n", "facts.toml: CA_GNSS: give each class a table"),
        ("[CA_GNSS\n", "facts.toml: not TOML: "),
    ],
)
def test_facts_unknown_to_the_record_are_refused_before_processing(
    made: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, said: str
) -> None:
    output, facts = tmp_path / "left.toml", tmp_path / "facts.toml"
    facts.write_text(text)
    more = ("--report", str(tmp_path / "report"), "--facts", str(facts))
    assert said in refused(capsys, output, arguments(made, output, *more))
    assert "--report" in refused(capsys, output, arguments(made, output, "--facts", str(facts)))


def test_error_names_a_wrong_line_of_control(made: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    control = tmp_path / "control.csv"
    control.write_text("name,lat_deg,lon_deg,h_ellipsoidal_m,sigma_m\nGCP1,47.18,nine,450.0,0.01\n")
    output = tmp_path / "left.toml"
    line = refused(capsys, output, arguments(made, output, "--control", str(control)))
    assert "control.csv" in line
    assert "line 2" in line


def test_control_is_read_before_the_logs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    control, output = tmp_path / "control.csv", tmp_path / "left.toml"
    control.write_text("foo,bar,baz\nA,1,2\n")
    given = ["calibrate", str(tmp_path / "no.mcap"), "-o", str(output), "--control", str(control)]
    line = refused(capsys, output, given)
    assert (
        'control.csv: line 1: no column of coordinates among "foo", "bar", "baz"; name the columns name, E, N' in line
    )


def test_strips_without_common_planes_are_refused_with_the_reason() -> None:
    refuse_no_planes("log", Features((Plane("roof 1", np.zeros(3), np.array([0.0, 0.0, 1.0]), ()),)))
    with pytest.raises(UserError, match=r"log: no two strips see a common plane \(7 too rough, 2 curved\)"):
        refuse_no_planes("log", Features(refused=Counter({"curved": 2, "too rough": 7})))


@pytest.mark.usefixtures("read_already")
def test_a_calibration_too_far_from_the_start_is_refused(
    made: Made, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "left.toml"
    line = refused(capsys, output, arguments(made, output, "--limit-deg", "0.3"))
    assert "--limit-deg" in line
