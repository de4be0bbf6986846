"""Tests that the record has what the dictionary requires, or lists it as missing, and is reproducible."""

from __future__ import annotations

import io
import json
import math
import xml.etree.ElementTree as ET
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from swath.calib.record.dictionary import BY_KEY, CLASSES, ROWS
from swath.calib.record.record import (
    IDENTITY,
    NAMESPACE,
    RecordError,
    RecordInput,
    document_json,
    document_xml,
    read_document,
    record_json,
    record_of,
    record_xml,
    with_told,
)
from swath.calib.record.values import Matrix, Plain, utc_text
from swath.georef.scanner.beams import LineGeometry
from swath.georef.scanner.calibration import INDEX
from swath.georef.scanner.sensor_model import SensorModel
from tests.calib.made_outcome import Outcome

pytestmark = pytest.mark.xdist_group("kernels")

# Taken from the dictionary: class, then its mandatory attributes.
MANDATORY = {
    "CA_CalibrationValidation": "calibrationType",
    "CA_LidarCalibrationTestfield": "lidarNObjectPoints lidarObjectPoint lidarJPlane lidarPlaneParameters",
    "CA_LidarCalComputation": "designMatrix1 designMatrix2 corrections1 corrections2 designMatrixObservations "
    "residuals misclosure designMatrixUnitLength",
    "CA_Frames": "timeRecording",
    "CA_SFrame": "thetaTarget rhoTarget",
    "CA_GeometryValidation": "validationMethod validationTime",
    "CA_PhotoFlight": "numberOfPhotoFlights flyingHeight flyingAltitudeAboveGround terrainHeight alongStripOverlap "
    "acrossStripOverlap numberOfStrips",
    "CA_InteriorOrientation": "synchronization synchronizationError referenceTemperature versionFirmware "
    "versionHardware",
    "CA_SensorSystem": "relativePosition relativeAttitude operationalTemperature",
    "CA_AuxiliaryDevice": "timeLeverarm leverarm errorLeverarm",
    "CA_GNSS": "numberSatellites registrationCycle",
    "CA_IMU": "boresightAngle dataRate attitudeAccuracy",
    "CA_TestRange": "numberControlPoints numberCheckPoints",
    "CA_PositionalError": "errorX errorY errorZ errorXY errorXYZ",
    "CA_Documentation": "certificateIdentification dataProductLevel geometricQuality stabilizedPlatform",
    "SD_Calibration": "calibrationAgency calibrationDate",
}
KEYS = {f"{owner}.{name}" for owner, names in MANDATORY.items() for name in names.split()}


def given(outcome: Outcome, **more: Any) -> RecordInput:
    """Return the input of a record for the only scanner."""
    return RecordInput(outcome.flight, outcome.features, outcome.adjusted, "left", outcome.header, **more)


def test_mandatory_attributes_are_present_or_listed_as_missing(outcome: Outcome) -> None:
    record = record_of(given(outcome))
    assert KEYS == {row.key for row in ROWS if row.obligation == "M"}
    assert KEYS <= record.values.keys() | set(record.missing)
    assert not record.values.keys() & set(record.missing)
    # No value is invented that a flight cannot supply.
    assert {
        "CA_GNSS.numberSatellites",
        "SD_Calibration.calibrationAgency",
        "CA_GeometryValidation.validationMethod",
        "CA_PositionalError.errorX",
        "CA_TestRange.numberCheckPoints",
    } <= set(record.missing)
    assert {"CA_SFrame.rhoTarget", "CA_LidarCalComputation.designMatrix1"} <= record.values.keys()
    assert {row.owner for row in ROWS} == {owner.name for owner in CLASSES}


def test_uncertain_names_are_flagged(outcome: Outcome) -> None:
    """Rows 1 to 24 of the dictionary could be checked against the standard, and none after them."""
    doubtful = {row.owner for row in ROWS if not row.confirmed}
    assert doubtful == {"CA_BFrame", "CA_LFrame", "CA_Intensity", "CA_ErrorModel"}
    assert not any(row.obligation for row in ROWS if not row.confirmed)
    root = ET.fromstring(record_xml(record_of(given(outcome))))
    flags = {
        (one.get("name"), attribute.get("name")): attribute.get("confirmed")
        for one in root.iter(f"{{{NAMESPACE}}}class")
        for attribute in one
    }
    assert flags["CA_BFrame", "leverArm"] == "false"
    assert flags["CA_SFrame", "thetaTarget"] == "true"


def from_json(text: str) -> dict[str, Any]:
    """Return the flattened JSON record: text by path."""
    document = json.loads(text)
    found: dict[str, Any] = {"id": document["id"], "version": str(document["version"])}
    found |= {key: document.get(key) for key in IDENTITY}
    found["missing"] = [f"{one['class']}.{one['name']}" for one in document["missing"]]
    for owner in document["classes"]:
        for attribute in owner["attributes"]:
            key = f"{owner['name']}.{attribute['name']}"
            for name, word in attribute.items():
                if name == "value":
                    found[key] = [str(one) for one in (word if isinstance(word, list) else [word])]
                elif name == "values":
                    found[f"{key}.rows"] = word
                elif name == "matrix":
                    found |= {f"{key}.matrix.{k}": str(v) for k, v in word.items()}
                else:
                    found[f"{key}@{name}"] = str(word).lower() if isinstance(word, bool) else word
    return found


def from_xml(text: str) -> dict[str, Any]:
    """Return the flattened XML record: text by path."""
    root = ET.fromstring(text)
    space = {"cr": NAMESPACE}
    found: dict[str, Any] = {"id": root.get("id"), "version": root.get("version")}
    found |= {key: root.get(key) for key in IDENTITY}
    missing = root.findall("cr:missing/cr:attribute", space)
    found["missing"] = [f"{one.get('class')}.{one.get('name')}" for one in missing]
    for owner in root.findall("cr:class", space):
        for attribute in owner:
            key = f"{owner.get('name')}.{attribute.get('name')}"
            found |= {f"{key}@{name}": word for name, word in attribute.attrib.items()}
            values = [one.text or "" for one in attribute.findall("cr:value", space)]
            rows = [[float(x) for x in (one.text or "").split()] for one in attribute.findall("cr:row", space)]
            found |= {key: values} if values else {}
            found |= {f"{key}.rows": rows} if rows else {}
            for matrix in attribute.findall("cr:matrix", space):
                found |= {f"{key}.matrix.{k}": v for k, v in matrix.attrib.items()}
    return found


def test_json_and_xml_have_the_same_content(outcome: Outcome) -> None:
    told = {
        "CA_GNSS.numberSatellites": 14,
        "SD_Calibration.calibrationAgency": "Geo & <Sons> «Zürich»",
        "CA_AuxiliaryDevice.leverarm": (0.12, -0.4, 1.0 / 3.0),
        "CA_AuxiliaryDevice.errorLeverarm": 0.004,
    }
    record = record_of(given(outcome, told=told, settings={"Swath": "0.1.0"}, attachment="left.npz"))
    assert from_xml(record_xml(record)) == from_json(record_json(record))
    flat = from_json(record_json(record))
    assert [flat[key] for key in IDENTITY] == ["left", "VQ-780", "S2221234", "HB-ABC/left/2026-03"]
    assert flat["CA_GNSS.numberSatellites"] == ["14"]
    assert flat["SD_Calibration.calibrationAgency"] == ["Geo & <Sons> «Zürich»"]
    assert float(flat["CA_AuxiliaryDevice.leverarm"][2]) == 1.0 / 3.0
    assert record_xml(record) == record_xml(record)
    assert "CA_GNSS.numberSatellites" not in flat["missing"]


def test_large_matrices_are_mentioned_and_attached(outcome: Outcome) -> None:
    record = record_of(given(outcome, attachment="left.npz"))
    held = io.BytesIO()
    attached: dict[str, Any] = record.arrays()
    np.savez_compressed(held, **attached)
    held.seek(0)
    arrays = np.load(held)
    flat = from_json(record_json(record))
    key = "CA_LidarCalComputation.designMatrix1"
    assert flat[f"{key}.matrix.attachment"] == "left.npz"
    assert f"{key}.rows" not in flat
    table = arrays[flat[f"{key}.matrix.array"]]
    assert table.shape == (int(flat[f"{key}.matrix.rows"]), 16)
    assert float(flat[f"{key}.matrix.rms"]) == pytest.approx(float(np.sqrt(np.mean(table**2))), rel=1e-12)
    assert flat["CA_LidarCalibrationTestfield.lidarNObjectPoints"] == [str(len(table))]
    # Small matrices are in the record completely.
    assert len(flat["CA_LidarCalComputation.corrections1.rows"][0]) == len(outcome.adjusted.names)


def test_matrices_equal_the_derivatives_of_the_sensor_model(outcome: Outcome) -> None:
    """A1 and B equal difference quotients of the sensor model itself, on the first plane's returns."""
    arrays = record_of(given(outcome)).arrays()
    group = outcome.adjusted.residuals[0]
    row = int(np.flatnonzero(group.weight > 0.0)[0])
    plane, swath = outcome.features.planes[group.feature[row]], outcome.flight.swaths[group.swath[row]]
    at = group.at[row : row + 1]
    calibration = outcome.adjusted.calibrations["left"]
    normal_e = plane.normal_t @ outcome.flight.frame.rot_t_from_e

    def off(changed: Any, rows: Any) -> float:
        model = SensorModel(changed, LineGeometry())
        rays = model.rays(rows, swath.time_ns[at], outcome.flight.trajectories[0], encoder_rate=np.zeros(1),
                          encoder_acceleration=np.zeros(1))  # fmt: skip
        return float(rays.points_e[0] @ normal_e)

    rows = swath.rows[at]
    for name, step in {"omega_rad": 1e-5, "phi_rad": 1e-5, "range_offset_m": 1e-2, "lever_arm_y_m": 1e-2}.items():
        value = calibration.value(name)
        slope = (
            off(calibration.changed(**{name: value + step}), rows)
            - off(calibration.changed(**{name: value - step}), rows)
        ) / (2 * step)
        assert arrays["designMatrix1"][0, INDEX[name]] == pytest.approx(slope, rel=1e-4, abs=1e-4)
    longer = rows.copy()
    longer["range_m"] += 0.01
    assert arrays["designMatrixObservations"][0, 6] == pytest.approx(
        (off(calibration, longer) - off(calibration, rows)) / 0.01, abs=1e-5
    )
    # Residuals v of range and angle close the misclosure: B v = e.
    share = float(np.sum(arrays["designMatrixObservations"][0, 6:] ** 2 * [0.02**2, 2e-5**2])) / group.sigma_m[row] ** 2
    closed = float(arrays["designMatrixObservations"][0] @ arrays["residuals"][0])
    assert closed == pytest.approx(group.misclosure_m[row] * share, rel=1e-9)
    np.testing.assert_allclose(arrays["misclosure"][0], -group.misclosure_m[row])
    place_t = outcome.flight.frame.t_from_e(arrays["lidarObjectPoint"][:1])
    np.testing.assert_allclose(place_t, outcome.flight.place(swath, calibration, at), atol=1e-8)
    plane_e = arrays["lidarPlaneParameters"][group.feature[row]]
    assert abs(plane_e[:3] @ arrays["lidarObjectPoint"][0] + plane_e[3]) < 0.15


def test_figures_of_the_flight_match_the_plan(outcome: Outcome) -> None:
    """The flight was at 750 m over ground at 450 m and roofs; it is level, with at most 0.6° at the wave's peak."""
    record = record_of(given(outcome))
    number = {key: value.content for key, value in record.values.items()}
    assert number["CA_PhotoFlight.terrainHeight"] == pytest.approx(450.0, abs=2.0)
    assert number["CA_PhotoFlight.flyingAltitudeAboveGround"] == pytest.approx(300.0, abs=2.0)
    assert number["CA_PhotoFlight.numberOfStrips"] == 5
    arrays = record.arrays()
    assert np.nanmax(np.abs(arrays["attitudeBodyLocal"][:, 0])) < np.radians(0.61)
    np.testing.assert_allclose(arrays["ellipsoidalHeight"], 750.0, atol=0.2)
    np.testing.assert_allclose(np.degrees(arrays["phiLocal"]), 47.18, atol=0.01)
    assert number["CA_Frames.timeRecording"] == utc_text(1_447_000_000 * 10**9)


def numbers(outcome: Outcome, **more: Any) -> dict[str, Any]:
    """Return the values by ``CLASS.attribute``, matrices as arrays."""
    values = record_of(given(outcome, **more)).values.items()
    return {key: value.content.array if isinstance(value.content, Matrix) else value.content for key, value in values}


def test_instruments_match_the_calibration(outcome: Outcome) -> None:
    """The boresight is ω, φ, κ on an installation without rotation; sigmas are the trajectory's."""
    calibration, number = outcome.adjusted.calibrations["left"], numbers(outcome)
    angles = [calibration.value(name) for name in ("omega_rad", "phi_rad", "kappa_rad")]
    turned = Rotation.from_euler("XYZ", angles).as_matrix()
    np.testing.assert_allclose(number["CA_BFrame.attitudeSensor"], turned, atol=1e-12)
    assert number["CA_SensorSystem.relativeAttitude"] == number["CA_IMU.boresightAngle"] == tuple(angles)
    assert number["CA_SensorSystem.relativePosition"] == number["CA_BFrame.leverArm"] == (0.12, -0.03, 0.28)
    np.testing.assert_allclose(np.degrees(number["CA_IMU.attitudeAccuracy"]), [0.003, 0.003, 0.006])


def test_control_matches_the_calibration(outcome: Outcome) -> None:
    number = numbers(outcome)
    points = [point for plane in outcome.features.planes for point in plane.control]
    assert number["CA_TestRange.numberControlPoints"] == len(points) == 10
    np.testing.assert_array_equal(number["CA_TestRange.controlPoint"], [point.position_t for point in points])
    off_m = [point.misclosure_m for point in outcome.adjusted.control]
    assert number["CA_PositionalError.errorZ"] == pytest.approx(math.sqrt(np.mean(np.square(off_m))))
    assert number["CA_PositionalError.errorType"] == "rootMeanSquareError"
    assert number["CA_PositionalError.quantityType"] == "mean"


def test_documentation_attributes_match_the_calibration(outcome: Outcome) -> None:
    number = numbers(outcome, settings={"Swath": "0.1.0"})
    assert number["CA_CalibrationValidation.calibrationType"] == "inFlight"
    assert number["CA_OpticsSensorGeometry.geometryCalibrationDate"] == "2026-11-21T10:15:00+00:00"
    assert number["CA_OpticsSensorGeometry.geometryCalibrationType"] == "self-calibration in flight: combined"
    assert number["CA_Distortion.selfCalibrationModel"] == "other"
    assert number["CA_Distortion.sigmaNaught"] == math.sqrt(outcome.adjusted.variance_factor)
    assert number["CA_Distortion.software"] == "Swath 0.1.0"
    assert number["CA_Distortion.propertiesAlgorithm"].startswith("Gauss–Helmert, 5 iterations")
    assert number["CA_Documentation.certificateIdentification"] == outcome.header.id
    assert number["CA_Documentation.geometricQuality"] == "CA_PositionalError"
    assert number["SD_Calibration.calibrationDate"] == "2026-11-21"


def test_errors_are_recorded_as_values_with_sigmas(outcome: Outcome) -> None:
    """Scanner errors are estimated values; trajectory errors are root mean squares of the corrections."""
    calibration, number = outcome.adjusted.calibrations["left"], numbers(outcome)
    for key, names in {
        "boresight": ("omega_rad", "phi_rad", "kappa_rad"),
        "range": ("range_offset_m",),
        "scanAngle": ("scan_angle_offset_rad",),
        "scannerAssembly": ("scan_plane_tilt_rad",),
    }.items():
        pairs = [(calibration.value(name), calibration.sigmas[INDEX[name]]) for name in names]
        np.testing.assert_array_equal(number[f"CA_ErrorModel.{key}"], pairs)
    fit = outcome.adjusted.trajectory
    assert fit is not None
    for key, corrections in (("positionBody", fit.position_l), ("attitudeBody", fit.attitude_rad)):
        np.testing.assert_allclose(number[f"CA_ErrorModel.{key}"], np.sqrt(np.mean(corrections**2, axis=0)))


def test_angles_and_ranges_match_the_returns(outcome: Outcome) -> None:
    """θ and ρ, as corrected and in the order of the residuals, give a return's place in the sensor's frame."""
    arrays, group = record_of(given(outcome)).arrays(), outcome.adjusted.residuals[0]
    rows = np.flatnonzero(group.weight > 0.0)
    assert len(arrays["thetaTarget"]) == len(arrays["rhoTarget"]) == len(rows)
    for row in (0, len(rows) // 2, len(rows) - 1):
        swath = outcome.flight.swaths[group.swath[rows[row]]]
        measured = swath.rows[group.at[rows[row]]]
        value = outcome.adjusted.calibrations["left"].value
        range_m = (1.0 + value("range_scale")) * measured["range_m"] + value("range_offset_m")
        angle = (1.0 + value("scan_angle_scale")) * (measured["encoder_rad"] - value("scan_angle_offset_rad"))
        assert arrays["rhoTarget"][row, 0] == pytest.approx(range_m, abs=1e-6)
        assert arrays["thetaTarget"][row, 0] == pytest.approx(angle, abs=1e-9)


def test_planes_are_recorded_with_their_derivatives(outcome: Outcome) -> None:
    """A2 · (s1 … s4) of a plane about its centre is the distance from it.

    G_c is that of unit normals, and δ2 leads to the adjusted planes.
    """
    record = record_of(given(outcome))
    arrays, group = record.arrays(), outcome.adjusted.residuals[0]
    planes_e = arrays["lidarPlaneParameters"]
    np.testing.assert_allclose(arrays["designMatrixUnitLength"][:, :3], 2.0 * planes_e[:, :3])
    assert not arrays["designMatrixUnitLength"][:, 3].any()
    mine = planes_e[group.feature[group.weight > 0.0]]
    across = np.einsum("nk,nk->n", arrays["designMatrix2"][:, :3], mine[:, :3])
    exact = np.einsum("nk,nk->n", arrays["lidarObjectPoint"], mine[:, :3]) + mine[:, 3]
    np.testing.assert_allclose(across, exact, atol=1e-6)
    np.testing.assert_array_equal(arrays["designMatrix2"][:, 3], 1.0)
    assert arrays["corrections2"].shape == planes_e.shape
    np.testing.assert_allclose(planes_e + arrays["corrections2"], outcome.adjusted.planes_e, rtol=1e-12)
    unknown = replace(outcome.adjusted, planes_e=np.zeros((0, 4)))
    assert "CA_LidarCalComputation.corrections2" in record_of(replace(given(outcome), adjusted=unknown)).missing


@pytest.mark.parametrize(("nodes", "whole"), [(160, True), (240, False)])
def test_a_correction_by_intensity_is_recorded(outcome: Outcome, nodes: int, whole: bool) -> None:
    """A record without a correction has no entry, and a long table is attached like other large matrices."""
    assert "CA_Intensity.intensityCorrection" not in numbers(outcome)
    table = np.linspace(0.0, 1000.0, nodes + 1), np.linspace(-0.02, 0.03, nodes + 1)
    calibration = replace(outcome.adjusted.calibrations["left"], ibrc=table)
    changed = replace(outcome, adjusted=replace(outcome.adjusted, calibrations={"left": calibration}))
    record = record_of(given(changed, attachment="left.npz"))
    np.testing.assert_array_equal(record.arrays()["intensityCorrection"], np.column_stack(table))
    flat = from_json(record_json(record))
    assert ("CA_Intensity.intensityCorrection.rows" in flat) == whole
    assert flat["CA_Intensity.intensityCorrection.matrix.attachment"] == "left.npz"


@pytest.mark.slow
@pytest.mark.parametrize("key", [row.key for row in ROWS])
def test_facts_given_by_the_user_are_recorded_in_their_class(outcome: Outcome, key: str) -> None:
    """A user's fact replaces a computed or missing value of any attribute."""
    words: dict[str, Plain] = {
        "Integer": 7,
        "Length": 0.25,
        "CA_ValidationMethod": "testfield, other",
        "CA_CalibrationType": "testRange",
    }
    told = words.get(BY_KEY[key].type, "as the papers say")
    record = record_of(given(outcome, told={key: told}))
    assert (record.values[key].content, record.values[key].note) == (told, "as told")
    assert key not in record.missing


def test_gps_time_is_written_as_utc() -> None:
    """GPS week 2000 began on 2018-05-06, 18 leap seconds ahead of UTC."""
    assert utc_text(2000 * 604_800 * 10**9) == "2018-05-05T23:59:42Z"


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"CA_GNSS.satellites": 9}, "CA_GNSS.numberSatellites"),
        ({"CA_GNSS.numberSatellites": "nine"}, "whole number"),
        ({"CA_GeometryValidation.validationMethod": "crossstrip"}, "crossStripFlight"),
        ({"CA_AuxiliaryDevice.errorLeverarm": "4 mm"}, "metres"),
    ],
)
def test_wrong_facts_are_refused_in_one_line(outcome: Outcome, told: dict[str, Any], message: str) -> None:
    with pytest.raises(RecordError, match=message) as caught:
        record_of(given(outcome, told=told))
    assert "\n" not in str(caught.value)


def test_validation_methods_may_be_several(outcome: Outcome) -> None:
    told = {
        "CA_GeometryValidation.validationMethod": "testfield, secondFlight",
        "CA_GeometryValidation.validationTime": "2026-11-21T12:00:00Z",
    }
    record = record_of(given(outcome, told=told))
    assert "CA_GeometryValidation.validationMethod" not in record.missing


VALIDATED: dict[str, Plain] = {
    "CA_GeometryValidation.validationMethod": "testfield, secondFlight",
    "CA_GeometryValidation.validationTime": "2026-11-21T12:00:00Z",
    "CA_TestRange.numberCheckPoints": 12,
}


def test_facts_added_later_are_recorded_as_if_given_at_once(outcome: Outcome) -> None:
    """A record that is read back and completed equals one with all facts from the start, in JSON and XML."""
    at_once = record_of(given(outcome, told=VALIDATED))
    written = read_document(record_json(record_of(given(outcome))), "left.record.json")
    later = with_told(written, {key: (value, "as told") for key, value in VALIDATED.items()})
    assert document_json(later) == record_json(at_once)
    assert document_xml(later) == record_xml(at_once)
    again = with_told(later, {"CA_TestRange.numberCheckPoints": (20, "of another flight")})
    (points,) = [one for owner in again["classes"] for one in owner["attributes"] if one["name"] == "numberCheckPoints"]
    assert (points["value"], points["note"]) == (20, "of another flight")
    with pytest.raises(RecordError, match=r"CA_GNSS\.numberSatellites"):
        with_told(written, {"CA_GNSS.satellites": (9, "")})


@pytest.mark.parametrize(
    "text",
    [
        "no JSON",
        "[]",
        '{"version": 2, "id": "x", "note": "", "classes": [], "missing": []}',
        '{"version": 1, "id": "x", "note": "", "classes": [{"name": "CA_GNSS"}], "missing": []}',
        '{"version": 1, "id": "x", "note": "", "classes": [], "missing": [{"class": "CA_GNSS", "name": "unknown"}]}',
    ],
)
def test_a_file_that_is_not_a_record_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(RecordError, match=r"left\.record\.json: not a calibration record") as caught:
        read_document(text, "left.record.json")
    assert "\n" not in str(caught.value)
