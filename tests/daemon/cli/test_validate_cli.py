"""Tests ``swath validate``: calibration files in, sentences and exit codes out, with a made flight as log."""

from __future__ import annotations

import datetime as dt
import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import typer

from swath.calib.calibration_file import Header, calibration_text
from swath.calib.record.record import NAMESPACE, Record, record_json
from swath.calib.record.values import Value
from swath.daemon.cli import validate
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.calibration.returns import KeptFlight
from swath.daemon.processing.carried_verdict import Carried
from swath.daemon.processing.validation import run as validate_run
from swath.georef.mapping.frame import Mapping
from swath.georef.scanner.calibration import INDEX, Calibration, nominal, read_calibration
from swath.georef.verdicts import Level
from tests.calib.cast_flight import Cast, cast_flight
from tests.daemon.processing.pages.builders import faults_of

pytestmark = pytest.mark.xdist_group("kernels")

LINES = ((-150, 0, 150, 0, 850), (150, 40, -150, 40, 850), (0, 150, 0, -150, 850))
PLACE = "HB-ABC/left"


def run(*arguments: str) -> None:
    """Run the command in this process."""
    app = typer.Typer()
    app.command()(validate.command)
    app(args=list(arguments), standalone_mode=False)


def file_of(
    path: Path, calibration: Calibration, month: int = 1, *, sigma_deg: float = 0.001, place: str = PLACE
) -> Path:
    """Write a calibration file of the boresight."""
    sigmas = np.zeros(len(INDEX))
    sigmas[[INDEX["omega_rad"], INDEX["phi_rad"], INDEX["kappa_rad"]]] = np.radians(sigma_deg)
    header = Header(path.stem, dt.datetime(2026, month, 1, tzinfo=dt.UTC), method="planes", installation=place)
    path.write_text(calibration_text(replace(calibration, sigmas=sigmas), header))
    return path


def boresight(phi_deg: float, scanner: str = "left") -> Calibration:
    """Return a boresight with a given pitch."""
    return nominal(scanner, np.zeros(3), np.eye(3)).changed(phi_rad=float(np.radians(phi_deg)))


# ---------------------------------------------------------------------- history


def test_a_changed_history_is_reported_drawn_and_a_problem(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "past"
    folder.mkdir()
    for month, phi in ((1, 0.10), (2, 0.1005), (3, 0.109)):
        file_of(folder / f"c{month}.toml", boresight(phi), month)
    file_of(folder / "other.toml", boresight(0.5), 4, place="elsewhere")
    (folder / "swath.toml").write_text("[session]\nname = 'x'\n")
    with pytest.raises(UserError, match=r"moved between 2026-02-01 and 2026-03-01: phi_deg \+0\.0085") as caught:
        run(str(folder / "c3.toml"), "--history", str(folder), "-o", str(tmp_path / "out"), "--json")
    assert caught.value.exit_code == ExitCode.PROBLEM
    record = json.loads(capsys.readouterr().out)
    (one,) = record["history"]
    assert [row["id"] for row in one["calibrations"]] == ["c1", "c2", "c3"]
    assert one["moved"] is True
    assert json.loads((tmp_path / "out" / "validation.json").read_text()) == record
    assert (tmp_path / "out" / "history.png").read_bytes()[:4] == b"\x89PNG"
    page = (tmp_path / "out" / "validation.html").read_text(encoding="utf-8")
    assert page.index("the boresight of left has moved") < page.index("<td>c3</td>") < page.index("image/png")
    assert "c3 of left, made 2026-03-01" in page


def test_an_unchanged_history_is_fine(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [file_of(tmp_path / f"c{month}.toml", boresight(0.1 + 0.0003 * month), month) for month in (1, 2, 3)]
    run(str(files[2]), "--history", str(files[0]), "--history", str(files[1]))
    told = capsys.readouterr().out
    assert "the boresight has not moved: 2 steps" in told
    assert "0.1009 ± 0.0010" in told


def test_a_history_without_testable_parameters_is_a_problem(tmp_path: Path) -> None:
    first = file_of(tmp_path / "c1.toml", boresight(0.1))
    with pytest.raises(
        UserError, match="drift cannot be tested, because fewer than two calibrations have sigmas"
    ) as caught:
        run(str(first), "--history", str(first), "--json")
    assert caught.value.exit_code == ExitCode.PROBLEM
    second = file_of(tmp_path / "c2.toml", boresight(0.1).changed(scan_plane_tilt_rad=1e-3), 2)
    with pytest.raises(
        UserError, match="the step between 2026-01-01 and 2026-02-01 was not tested: scan_plane_tilt_deg, held"
    ):
        run(str(second), "--history", str(first), "--json")


# ---------------------------------------------------------------------- logs


@pytest.fixture(scope="module")
def made() -> Cast:
    """Return two opposite lines and a crossing one over a village."""
    return cast_flight(lines=LINES, prf_hz=40_000.0, true={})


@pytest.fixture
def log(made: Cast, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Return a log that is read as the made flight, placed with the calibrations that are validated."""
    path = tmp_path / "flight.mcap"
    path.write_bytes(b"bytes of a log")

    def read(request: Any, folder: Path, tell: Any, check: Any = lambda sessions, setups: None) -> KeptFlight:
        text, name = request.options.calibrations.get("left", (None, ""))
        head = made.flight.heads[0]
        start = head.start if text is None else read_calibration(text, name)
        flight = replace(made.flight, heads=(replace(head, start=start),)).placed({"left": start})
        profile = SimpleNamespace(installation=PLACE, aircraft="HB-ABC", operator="Survey AG")
        logged: Any = SimpleNamespace(
            warnings=[],
            holes=[],
            log=path,
            navigated=None,
            setup=SimpleNamespace(config=SimpleNamespace(profile=profile), mapping=None),
            verdicts=[],
            span=made.flight.trajectories[0].span,
            session=SimpleNamespace(session_id="second-flight", parts=[SimpleNamespace(path=path)]),
        )
        sources = SimpleNamespace(attachments={})
        setup = SimpleNamespace(config=None, sources=sources, scanners=(), mapping=Mapping("EPSG:32632"))
        check([logged.session], [setup])
        return KeptFlight(flight, [logged], [])

    monkeypatch.setattr(validate_run, "read_flight", read)
    return path


@pytest.mark.slow
def test_an_unusable_trajectory_is_the_first_line_and_a_problem(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = cast(Any, validate_run).read_flight

    def judged(*given: Any) -> KeptFlight:
        kept: KeptFlight = plain(*given)
        cast(Any, kept.logged[0]).verdicts.append(Carried(Level.UNUSABLE, "navigated trajectory: lever arm"))
        return kept

    monkeypatch.setattr(validate_run, "read_flight", judged)
    arguments = (str(file_of(tmp_path / "good.toml", boresight(0.0))), str(log))
    with pytest.raises(UserError, match=r'^the verdict is "not to be used"; use --accept-verdict to accept it$'):
        run(*arguments)
    assert capsys.readouterr().out.splitlines()[0] == "not to be used: navigated trajectory: lever arm"
    run(*arguments, "--accept-verdict")


def test_a_true_calibration_passes(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(str(file_of(tmp_path / "good.toml", boresight(0.0))), str(log), "--json")
    record = json.loads(capsys.readouterr().out)["validation"]
    assert record["passed"] is True
    assert record["independent"] is True
    assert [one["code"] for one in record["methods"]] == ["001", "002", "003", "004", "005", "006"]
    passed = {one["method"]: one["passed"] for one in record["methods"]}
    assert passed["crossStripFlight"] is True
    assert passed["other"] is True
    assert passed["secondAltitude"] is None


@pytest.mark.slow
def test_a_wrong_calibration_fails(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [str(file_of(tmp_path / "bad.toml", boresight(0.04))), str(log)]
    with pytest.raises(UserError, match=r"the calibration does not hold: (\d) of \1 methods failed$"):
        run(*arguments, "--json")
    capsys.readouterr()
    with pytest.raises(UserError) as caught:
        run(*arguments)
    assert caught.value.message == ""  # standard output has said it
    assert "the calibration does not hold: " in capsys.readouterr().out
    assert caught.value.exit_code == ExitCode.PROBLEM


def test_the_log_used_for_the_calibration_is_not_independent(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from swath.daemon.processing.files import sha256_of

    path = file_of(tmp_path / "own.toml", boresight(0.0))
    text = path.read_text()
    assert "logs = []" in text
    path.write_text(text.replace("logs = []", f'logs = [{{ name = "x", sha256 = "{sha256_of(log)}" }}]'))
    run(str(path), str(log))
    told = capsys.readouterr().out
    assert "the calibration holds (not independent)" in told
    assert "flight.mcap: calibration own was made from this log" in told


def record_beside(path: Path, calibration_id: str) -> Path:
    """Write a record as `swath calibrate` writes it: without any result of a validation."""
    methods = ("CA_GeometryValidation.validationMethod", "CA_GeometryValidation.validationTime")
    values = {"CA_CalibrationValidation.calibrationType": Value("inFlight")}
    path.write_text(record_json(Record(calibration_id, values, (*methods, "CA_GNSS.numberSatellites"))))
    return path


def attributes_of(path: Path) -> dict[str, dict[str, Any]]:
    classes = json.loads(path.read_text())["classes"]
    return {f"{owner['name']}.{one['name']}": one for owner in classes for one in owner["attributes"]}


@pytest.mark.parametrize("phi_deg", [0.0, 0.04], ids=["holds", "does not hold"])
def test_the_validation_is_added_to_the_record_beside_the_file(log: Path, tmp_path: Path, phi_deg: float) -> None:
    file = file_of(tmp_path / "c1.toml", boresight(phi_deg))
    old = record_beside(tmp_path / "left.record.json", "c1").read_bytes()
    try:
        run(str(file), str(log), "-o", str(tmp_path / "out"))
    except UserError:
        assert phi_deg
    told = attributes_of(tmp_path / "out" / "left.record.json")
    method = told["CA_GeometryValidation.validationMethod"]
    assert method["value"] == "crossStripFlight, other"
    verdict = "does not hold" if phi_deg else "holds"
    assert method["note"].startswith(f"the calibration {verdict}")
    assert "crossStripFlight (002): planes seen by crossing strips" in method["note"]
    time = told["CA_GeometryValidation.validationTime"]
    assert dt.datetime.fromisoformat(time["value"]) <= dt.datetime.now(dt.UTC)
    assert "flight.mcap (SHA-256 " in time["note"]
    assert told["CA_CalibrationValidation.calibrationType"]["value"] == "inFlight"
    (missing,) = json.loads((tmp_path / "out" / "left.record.json").read_text())["missing"]
    assert missing["name"] == "numberSatellites"
    root = ET.fromstring((tmp_path / "out" / "left.record.xml").read_text())
    assert method["value"] in [one.text for one in root.iter(f"{{{NAMESPACE}}}value")]
    assert (tmp_path / "left.record.json").read_bytes() == old


@pytest.mark.slow
def test_another_record_can_be_named_and_that_of_another_calibration_is_unchanged(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = file_of(tmp_path / "c1.toml", boresight(0.0))
    record_beside(tmp_path / "left.record.json", "c0")
    run(str(file), str(log), "-o", str(tmp_path / "out"))
    assert "left.record.json: is the record of calibration c0" in capsys.readouterr().out
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert written == {"validation.json", "validation.html", "validation.pdf"}
    (tmp_path / "report").mkdir()
    record_beside(tmp_path / "report" / "left.record.json", "c1")
    run(str(file), str(log), "-o", str(tmp_path / "out"), "--record", str(tmp_path / "report"), "--overwrite")
    assert "CA_GeometryValidation.validationMethod" in attributes_of(tmp_path / "out" / "left.record.json")


@pytest.mark.parametrize(
    ("what", "said", "code"),
    [
        ("other", "is the record of calibration c0, but .*c1.toml is c1", ExitCode.USAGE),
        ("none", r"x\.json: not a calibration record; give the NAME\.record\.json", ExitCode.USAGE),
        ("absent", "no.json: cannot be read: No such file", ExitCode.IO),
        (
            "no output",
            "--record needs LOG… and --output DIR, because the new record holds the results from the logs",
            ExitCode.USAGE,
        ),
    ],
)
def test_an_unusable_record_is_reported_in_one_line(
    log: Path, tmp_path: Path, what: str, said: str, code: ExitCode
) -> None:
    file = file_of(tmp_path / "c1.toml", boresight(0.0))
    (tmp_path / "x.json").write_text("{}")
    paths = {
        "other": record_beside(tmp_path / "other.json", "c0"),
        "none": tmp_path / "x.json",
        "absent": tmp_path / "no.json",
    }
    output = () if what == "no output" else ("-o", str(tmp_path / "out"))
    with pytest.raises(UserError, match=said) as caught:
        run(str(file), str(log), "--record", str(paths.get(what, tmp_path)), *output)
    assert caught.value.exit_code == code
    assert "\n" not in caught.value.message
    assert not (tmp_path / "out").exists()


def control_of(made: Cast, path: Path, lower_m: float = 0.0) -> int:
    """Write a file of points on, or below, the true surface."""
    from swath.georef.geodesy.earth import geodetic_from_e

    places = made.true_t[0][20_000:180_000:8_000]
    rows = ["name,lat_deg,lon_deg,h_ellipsoidal_m,sigma_m"]
    for number, place in enumerate(places):
        lat, lon, height = geodetic_from_e(made.flight.frame.e_from_t(place))
        rows.append(f"P{number},{np.degrees(lat):.9f},{np.degrees(lon):.9f},{height - lower_m:.4f},0.02")
    path.write_text("\n".join(rows))
    return len(places)


def test_control_heights_above_the_geoid_are_refused(log: Path, made: Cast, tmp_path: Path) -> None:
    control = tmp_path / "control.csv"
    control_of(made, control, 48.0)
    with pytest.raises(UserError, match=r"control.csv: control lies 48\.0 m below the laser's ground everywhere"):
        run(str(file_of(tmp_path / "good.toml", boresight(0.0))), str(log), "--control", str(control))


def test_check_points_are_counted_in_the_record(log: Path, made: Cast, tmp_path: Path) -> None:
    """Only points that the laser reached are counted."""
    control, file = tmp_path / "control.csv", file_of(tmp_path / "c1.toml", boresight(0.0))
    given = control_of(made, control)
    record_beside(tmp_path / "left.record.json", "c1")
    run(str(file), str(log), "-o", str(tmp_path / "out"), "--control", str(control))
    told = attributes_of(tmp_path / "out" / "left.record.json")
    assert "testfield" in told["CA_GeometryValidation.validationMethod"]["value"]
    methods = json.loads((tmp_path / "out" / "validation.json").read_text())["validation"]["methods"]
    (testfield,) = [one for one in methods if one["method"] == "testfield"]
    page = (tmp_path / "out" / "validation.html").read_text(encoding="utf-8")
    figures = testfield["numbers"]
    row = f"<td>001</td><td>{figures['count']}</td><td>{100 * figures['mean_m']:+.1f}</td>".replace("-", "−")
    assert row in page
    assert '<td>003</td><td class="left">needs the log of a second flight' in page
    assert "second-flight" in page
    assert faults_of(page) == []
    assert "HB-ABC" in page
    assert page.count(">passed</span>") >= 6  # two methods, and their tests in the appendix
    assert "≤ " in page
    assert 5 < told["CA_TestRange.numberCheckPoints"]["value"] == testfield["points"] <= given


def test_too_few_control_points_within_the_swath_are_a_problem(
    log: Path, made: Cast, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All but two points belong to another site, so the requested check is impossible and the verdict reports it."""
    control = tmp_path / "control.csv"
    control_of(made, control)
    header, *lines = control.read_text().splitlines()
    away = [line.replace(",47.", ",48.") for line in lines[2:]]
    control.write_text("\n".join([header, *lines[:2], *away]))
    with pytest.raises(
        UserError, match=r"^not validated as requested: .*control: strips see control \d times only"
    ) as caught:
        run(str(file_of(tmp_path / "good.toml", boresight(0.0))), str(log), "--control", str(control), "--json")
    assert caught.value.exit_code == ExitCode.PROBLEM
    record = json.loads(capsys.readouterr().out)["validation"]
    assert record["passed"] is True
    assert record["undone"][0].startswith("control: strips see control")


def test_parameters_that_cannot_be_remeasured_are_a_problem(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(validate_run, "adjust", lambda *rest, **more: SimpleNamespace(converged=False))
    monkeypatch.setattr(validate_run, "prior_of", lambda kept: None)
    with pytest.raises(
        UserError, match="independently measured parameters: the adjustment does not converge"
    ) as caught:
        run(str(file_of(tmp_path / "good.toml", boresight(0.0))), str(log), "--anew", "--json")
    assert caught.value.exit_code == ExitCode.PROBLEM


def test_an_untestable_history_is_a_problem_even_if_logs_agree(log: Path, tmp_path: Path) -> None:
    good, other = file_of(tmp_path / "good.toml", boresight(0.0)), tmp_path / "other.toml"
    file_of(other, boresight(0.0), 2, place="elsewhere")
    with pytest.raises(
        UserError, match="drift cannot be tested, because fewer than two calibrations have sigmas"
    ) as caught:
        run(str(good), str(log), "--history", str(other), "--json")
    assert caught.value.exit_code == ExitCode.PROBLEM


def test_the_verdict_names_undetectable_errors(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(str(file_of(tmp_path / "good.toml", boresight(0.0))), str(log), "--json")
    record = json.loads(capsys.readouterr().out)["validation"]
    smallest = {one["parameter"]: one["smallest_error"] for one in record["smallest_errors"]}
    assert 0.001 < smallest["omega_deg"] < 0.05
    assert "; errors below omega " in record["sentence"]


def test_a_scanner_missing_from_the_log_is_named(log: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="has no scanner right, to which calibration right belongs"):
        run(str(file_of(tmp_path / "right.toml", boresight(0.0, "right"))), str(log))


@pytest.mark.parametrize(
    ("what", "said", "code"),
    [
        ("nothing", "nothing to validate against", ExitCode.USAGE),
        ("absent", "cannot be read: No such file", ExitCode.IO),
        ("no calibration", "calibration: missing", ExitCode.USAGE),
        ("twice", "a calibration of this scanner was already given", ExitCode.USAGE),
    ],
)
def test_wrong_usage_is_refused_in_one_line(what: str, said: str, code: ExitCode, tmp_path: Path) -> None:
    good = str(file_of(tmp_path / "good.toml", boresight(0.0)))
    (tmp_path / "config.toml").write_text("[session]\nname = 'x'\n")
    arguments = {
        "nothing": [good],
        "absent": [str(tmp_path / "no.toml"), "x.mcap"],
        "no calibration": [str(tmp_path / "config.toml"), "x.mcap"],
        "twice": [good, "x.mcap", "--also", good],
    }[what]
    with pytest.raises(UserError, match=said) as caught:
        run(*arguments)
    assert caught.value.exit_code == code
