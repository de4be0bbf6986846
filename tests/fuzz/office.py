"""Targets for surveyors' text files: control, picked points, polygons, strip times, calibrations, facts, plans."""

from __future__ import annotations

import datetime as dt
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np

from swath.calib.calibration_file import CalibrationFileError, Header, calibration_text
from swath.calib.control.points import ControlError, in_t
from swath.calib.flight import Tangent
from swath.calib.record.record import (
    Record,
    RecordError,
    document_json,
    document_xml,
    read_document,
    record_json,
    with_told,
)
from swath.calib.record.values import Matrix, Value
from swath.calib.ties.picked import PickedError, read_picked
from swath.calib.validation.history import HistoryError, history
from swath.daemon.processing.calibration.inputs import PolygonError, read_polygons
from swath.daemon.processing.calibration.model import read_model
from swath.daemon.processing.calibration.record import facts_of
from swath.daemon.processing.control.place import place_control
from swath.daemon.processing.control.table import HEADER
from swath.daemon.processing.control.text import read_text
from swath.daemon.processing.flights.read import _given_strips
from swath.daemon.processing.validation.run import _entry, read_file
from swath.daemon.simulate.plans import FlightOptions
from swath.daemon.text_files import text_of
from swath.georef.geodesy.earth import e_from_geodetic
from swath.georef.mapping.frame import Mapping
from swath.georef.scanner.beams import GeometryError, read_fibres
from swath.georef.scanner.calibration import INDEX, BeamCorrection, Calibration, RangeOffset, nominal
from swath.georef.strips import CSV_COLUMNS, StripError
from swath.sim.plan.plan import PRESETS
from tests.fuzz.engine import Target
from tests.fuzz.texts import NUMBERS, OF_CSV, OF_JSON, OF_TOML, text_target

CSV, TOML, JSON = (*NUMBERS, *OF_CSV), (*NUMBERS, *OF_TOML), (*NUMBERS, *OF_JSON)


def office_targets() -> Iterator[tuple[str, Callable[[], Target]]]:
    """Yield the targets of office files, each with what the command does before it reads a flight."""
    yield "control-points", _control
    yield "picked-points", _picked
    yield "polygons", _polygons
    yield "strip-times", _strip_times
    yield "fibres", _fibres
    yield "calibration", _calibration
    yield "calibration-history", _histories
    yield "calibration-facts", _facts
    yield "model", _model
    yield "calibration-record", _record
    yield "plan", _plan


# --- places ---------------------------------------------------------------------------------------------------------


def _control() -> Target:
    text = f"# survey\n{HEADER}\nP1,47.5,8.9,450.123,0.01\nP2,47.501,8.902,451.5,0.02\n\nP3,47.502,8.9,449,0.01\n"
    frame, mapping = Tangent.at(e_from_geodetic(*np.array([[0.829], [0.155], [450.0]]))[0]), Mapping("EPSG:32632")

    def read(path: Path) -> Iterator[str]:
        table = read_text(text_of(path), path)
        points = in_t(place_control(table, None, mapping, np.array([[47.5, 8.9]])).points, frame)
        assert np.isfinite([point.position_t for point in points]).all()
        yield f"{len(points)} points"

    maps = (
        "Punkt;Rechtswert;Hochwert;Höhe;CQ 3D;Code\nP1;492465,1;5261234,5;450,1;0,01;G\nP2;492565,1;5261244,5;451,2;;\n"
    )
    seeds = [text.encode(), maps.encode(), b"P1 492465.1 5261234.5 450.1\nP2 492565.1 5261244.5 451.2\n"]
    return text_target("control-points", seeds, CSV, read, ControlError, mistakes_a_line=True)


def _picked() -> Target:
    head = "name,strip,x,y,z,sigma_m"
    text = f"{head}\na,1,465000.1,5261000.2,450.3,0.05\na,2,465000.2,5261000.1,450.2,0.05\n#\nb,1,1,2,3,1\n"

    def read(path: Path) -> Iterator[str]:
        for one in read_picked(text_of(path), str(path)):
            assert np.isfinite(one.place**2).all()
            assert 0.0 < one.sigma_m**2 < np.inf
            yield str(len(one.strip))

    return text_target("picked-points", [text.encode()], CSV, read, PickedError)


def _polygons() -> Target:
    text = 'WKT,name\n"POLYGON ((10 0, 20 0, 20 8, 10 8, 10 0))",roof 1\n"Polygon Z ((0 0 5, 4 0 5, 2 3 6))",roof 2\n'

    def read(path: Path) -> Iterator[str]:
        for ring in read_polygons(text_of(path), str(path)).values():
            assert np.isfinite(ring**2).all()
            yield f"{len(ring)} corners"

    return text_target("polygons", [text.encode()], CSV, read, PolygonError)


def _strip_times() -> Target:
    begin = 1_479_297_618_000_000_000
    rows = [f"{number},{begin + number * 10**11},{begin + number * 10**11 + 10**10},x" for number in range(3)]
    text = "\n".join([f"number,{','.join(CSV_COLUMNS)},note", *rows, ""])

    def read(path: Path) -> Iterator[str]:
        spans = np.array(_given_strips(str(path)), np.int64)
        assert (np.diff(spans.ravel()) >= 0).all()
        yield f"{len(spans)} strips"

    return text_target("strip-times", [text.encode()], CSV, read, StripError)


def _fibres() -> Target:
    def read(path: Path) -> Iterator[str]:
        fibres = read_fibres(path.read_bytes().decode("utf-8", "replace"), str(path))
        yield f"{fibres!r}"[:20]

    return text_target("fibres", [b"across_deg,along_deg\n-7.5,0.01\n0,-0.02\n\n7.5,0.3\n"], CSV, read, GeometryError)


# --- calibrations ---------------------------------------------------------------------------------------------------


def _made(number: int) -> Calibration:
    """Return a calibration with everything that a file can hold."""
    one = nominal("left", [0.1, -0.2, 0.3], np.eye(3)).changed(omega_rad=0.001, kappa_rad=-0.002 * number)
    at = [INDEX[name] for name in ("omega_rad", "phi_rad", "kappa_rad")]
    sigmas, correlation = np.zeros(len(INDEX)), np.eye(len(INDEX))
    sigmas[at] = 1e-5, 1e-5, 2e-5
    correlation[at[0], at[1]] = correlation[at[1], at[0]] = 0.3
    return replace(
        one,
        id=f"cal-{number}",
        method="planes",
        sigmas=sigmas,
        correlation=correlation,
        mirror_factor=2.0,
        ranges="corrected",
        refraction="none",
        ibrc=(np.array([0.0, 100.0]), np.array([0.0, 0.01])),
        range_offsets=(RangeOffset(0.01, return_slot=2), RangeOffset(-0.02, prf_hz=100_000.0)),
        facet_tilt_rad={0: 1e-4, 3: -1e-4},
        beams={0: BeamCorrection(1e-3, 0.0, 0.01)},
    )


def _texts() -> list[bytes]:
    """Return calibrations of three months; the last has no time zone, and its method is nominal."""
    texts = []
    for number in (1, 2, 3):
        created = dt.datetime(2026, number, 1, 12, tzinfo=dt.UTC)
        header = Header(f"cal-{number}", created, installation="HB-ABC/left", logs=(("a.mcap", "0" * 64),))
        texts.append(calibration_text(_made(number), header).encode())
    return texts


def _calibration() -> Target:
    def read(path: Path) -> Iterator[str]:
        one = read_file(path)
        assert np.isfinite(one.covariance()).all()
        created = dt.datetime(2026, 1, 1, tzinfo=dt.UTC)
        calibration_text(one, Header(one.id, created))  # a file that was read can be written
        yield f"{len(one.beams)} beams, {len(one.range_offsets)} offsets"
        yield f"{int((one.sigmas > 0.0).sum())} estimated"

    return text_target(
        "calibration", [_texts()[0], *_presets()], TOML, read, CalibrationFileError, mistakes_a_line=True
    )


def _presets() -> list[bytes]:
    """Return presets as short as possible."""
    keys = ("omega_deg", "phi_deg", "kappa_deg", "range_offset_m", "lever_arm_x_m", "lever_arm_y_m", "lever_arm_z_m")
    head = '[calibration]\nid = "a"\nscanner = "left"\nmethod = "nominal"\n[parameters]\n'
    return [(head + "".join(f"{key} = 0\n" for key in keys)).encode()]


def _histories() -> Target:
    seeds = _texts()

    def read(path: Path) -> Iterator[str]:
        entry = _entry(path, [])
        if entry is None:
            return
        others = []
        for number, text in enumerate(seeds):
            other = path.with_name(f"{number}.toml")
            other.write_bytes(text.replace(b"cal-", b"past-"))
            others.append(read_file(other))
        for one in history([entry, *others]):
            one.record()
            yield f"{len(one.entries)} of {one.installation[:8]}, {'moved' if one.moved else 'not moved'}"

    return text_target("calibration-history", seeds, TOML, read, HistoryError, mistakes_a_line=True)


def _model() -> Target:
    """Read a file of `--model`."""
    text = (
        'model = "full"\n[parameters]\nomega_deg = "free"\nleft.phi_deg = "fixed"\n"left.kappa_deg" = { prior = 0.1 }\n'
        "[ibrc]\nknots = [0.0, 100.0, 200.5]\nreference = 100\n[range_offset]\nreturn_slots = [2]\nmta_zones = [0, 1]\n"
        '[beam]\nestimate = ["azimuth_deg", "range_m"]\n'
    )

    def read(path: Path) -> Iterator[str]:
        tables = read_model(path)
        yield f"{tables.model}, {len(tables.parameters)} parameters"
        yield from (f"{tables.ibrc is None} {tables.range_offset is None} {tables.beam is None}",)

    return text_target("model", [text.encode()], TOML, read, mistakes_a_line=True)


# --- what is told of them -------------------------------------------------------------------------------------------


def _values() -> dict[str, Value]:
    return {
        "CA_GNSS.numberSatellites": Value(14),
        "CA_IMU.dataRate": Value("PT0.005S", "", "of imu.main"),
        "CA_AuxiliaryDevice.leverarm": Value((0.1, 0.2, -1.2), "m", "antenna"),
        "CA_BFrame.attitudeSensor": Value(Matrix.of(np.eye(3)), "", "R"),
    }


def _facts() -> Target:
    text = (
        '[CA_GNSS]\nnumberSatellites = 14\nregistrationCycle = "PT0.2S"\n[CA_IMU]\ndataRate = "PT0.005S"\n'
        "[CA_AuxiliaryDevice]\nleverarm = [0.1, 0.2, -1.2]\n[CA_TestRange]\nnumberCheckPoints = 3\n"
    )

    def read(path: Path) -> Iterator[str]:
        facts = facts_of(path)
        document = read_document(record_json(Record("cal-1", {}, ())), "record")
        whole = with_told(document, {key: (value, "as told") for key, value in facts.items()})
        read_document(document_json(whole), "record")
        ET.fromstring(document_xml(whole).encode())
        yield from facts

    return text_target("calibration-facts", [text.encode()], TOML, read)


def _record() -> Target:
    text = record_json(Record("cal-1", _values(), ("CA_GNSS.registrationCycle",), "left.npz"))

    def read(path: Path) -> Iterator[str]:
        document = read_document(text_of(path), str(path))
        whole = with_told(document, {"CA_GNSS.registrationCycle": ("PT1S", "")})
        document_json(whole).encode()
        ET.fromstring(document_xml(whole).encode())
        yield from (owner["name"] for owner in whole["classes"])

    return text_target("calibration-record", [text.encode()], JSON, read, RecordError)


# --- plans of simulated flights -------------------------------------------------------------------------------------


def _plan() -> Target:
    seeds = [(resources.files("sim") / "presets" / f"{name}.toml").read_bytes() for name in PRESETS]

    def read(path: Path) -> Iterator[str]:
        plan = FlightOptions(str(path), seed=3).load()
        yield f"{len(plan.tables.line)} lines, {len(plan.tables.scanner)} scanners"

    return text_target("plan", seeds, TOML, read)
