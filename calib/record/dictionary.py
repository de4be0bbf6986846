"""The data dictionary of a calibration record: ISO/TS 19159-2 for lidar, ISO/TS 19159-1 where it applies.

Names are the standards'. Rows 1 to 24 of the dictionary of ISO/TS 19159-2 (Annex B) were available. Rows after these,
or found in its clauses only, are marked as not confirmed: the class, the name, the obligation or the type is our
interpretation.
"""

from __future__ import annotations

from dataclasses import dataclass

LIDAR, OPTICAL = "ISO/TS 19159-2", "ISO/TS 19159-1"


@dataclass(frozen=True, slots=True)
class Row:
    """One attribute of the dictionary.

    Attributes:
        standard, owner, name: standard, class, and name of the attribute.
        obligation: M mandatory, O optional, "" not stated.
        occurrence: greatest number; "" not stated.
        type: of the standard.
        meaning: in a few words.
        confirmed: name, obligation, occurrence and type are so in the dictionary.
    """

    standard: str
    owner: str
    name: str
    obligation: str
    occurrence: str
    type: str
    meaning: str
    confirmed: bool = True

    @property
    def key(self) -> str:
        """Key of the attribute, ``CLASS.attribute``."""
        return f"{self.owner}.{self.name}"


@dataclass(frozen=True, slots=True)
class Class:
    """A class of the dictionary: the class it specialises, and whether its name is confirmed."""

    standard: str
    name: str
    specialises: str
    confirmed: bool = True
    note: str = ""


CLASSES: tuple[Class, ...] = (
    Class(OPTICAL, "CA_CalibrationValidation", "MD_CoverageDescription"),
    Class(LIDAR, "CA_LidarCalibrationTestfield", "CA_LidarCalibration"),
    Class(LIDAR, "CA_LidarCalComputation", "CA_LidarCalibration"),
    Class(LIDAR, "CA_Frames", "CA_LidarTransformation"),
    Class(LIDAR, "CA_SFrame", "CA_Frames"),
    Class(LIDAR, "CA_BFrame", "CA_Frames"),
    Class(LIDAR, "CA_LFrame", "CA_Frames", False, "local level frame of 6.2; the class's name is not in the copy"),
    Class(LIDAR, "CA_Intensity", "CA_Lidar", False, "named in 6.4 only"),
    Class(LIDAR, "CA_ErrorModel", "CA_Lidar", False, "errors of 6.5; the class's name is not in the copy"),
    Class(OPTICAL, "CA_GeometryValidation", "CA_CalibrationValidation"),
    Class(OPTICAL, "CA_PhotoFlight", ""),
    Class(OPTICAL, "CA_OpticsSensorGeometry", ""),
    Class(OPTICAL, "CA_InteriorOrientation", ""),
    Class(OPTICAL, "CA_SensorSystem", ""),
    Class(OPTICAL, "CA_AuxiliaryDevice", ""),
    Class(OPTICAL, "CA_GNSS", ""),
    Class(OPTICAL, "CA_IMU", ""),
    Class(OPTICAL, "CA_TestRange", ""),
    Class(OPTICAL, "CA_PositionalError", ""),
    Class(OPTICAL, "CA_Distortion", ""),
    Class(OPTICAL, "CA_Documentation", ""),
    Class(OPTICAL, "SD_Calibration", "", note="of ISO 19130-1, as ISO/TS 19159-1 uses it"),
)

_N, _MN = "N", "M×N"


def _of(standard: str, owner: str, *rows: tuple[str, str, str, str, str], confirmed: bool = True) -> tuple[Row, ...]:
    return tuple(Row(standard, owner, *row, confirmed) for row in rows)


ROWS: tuple[Row, ...] = (
    *_of(
        OPTICAL,
        "CA_CalibrationValidation",
        ("calibrationType", "M", "1", "CA_CalibrationType", "laboratory, testRange, inSitu, onboard, vicarious, …"),
    ),
    *_of(
        LIDAR,
        "CA_LidarCalibrationTestfield",
        ("lidarNObjectPoints", "M", "1", "Integer", "number of points i"),
        ("lidarObjectPoint", "M", _N, "DirectPosition", "x_pi"),
        ("lidarJPlane", "M", "1", "Integer", "number of planes j"),
        ("lidarPlaneParameters", "M", "4×N", "Real", "s1 … s4 of Eq. 17"),
    ),
    *_of(
        LIDAR,
        "CA_LidarCalComputation",
        ("designMatrix1", "M", _MN, "Real", "A1"),
        ("designMatrix2", "M", _MN, "Real", "A2"),
        ("corrections1", "M", _N, "Real", "δ1"),
        ("corrections2", "M", _N, "Real", "δ2"),
        ("designMatrixObservations", "M", _MN, "Real", "B"),
        ("residuals", "M", _N, "Real", "v"),
        ("misclosure", "M", _N, "Real", "w"),
        ("designMatrixUnitLength", "M", _MN, "Real", "G_c"),
    ),
    *_of(LIDAR, "CA_Frames", ("timeRecording", "M", "1", "DateTime", "time of emission or reception")),
    *_of(
        LIDAR,
        "CA_SFrame",
        ("thetaTarget", "M", "1", "Angle", "θ, from z_s, anticlockwise about x_s"),
        ("rhoTarget", "M", "1", "Length", "ρ"),
    ),
    *_of(
        LIDAR,
        "CA_BFrame",
        ("attitudeSensor", "", "", "SD_Attitude", "R_s^b, boresight"),
        ("leverArm", "", "", "DirectPosition", "x_s^b"),
        confirmed=False,
    ),
    *_of(
        LIDAR,
        "CA_LFrame",
        ("attitudeBodyLocal", "", "", "SD_Attitude", "attitude of the body"),
        ("phiLocal", "", "", "Angle", "latitude"),
        ("lambdaLocal", "", "", "Angle", "longitude"),
        ("ellipsoidalHeight", "", "", "Length", "height"),
        ("nRadius", "", "", "Length", "radius of curvature in the prime vertical"),
        confirmed=False,
    ),
    *_of(
        LIDAR,
        "CA_Intensity",
        ("intensityCorrection", "", "", "Real", "range correction by intensity"),
        confirmed=False,
    ),
    *_of(
        LIDAR,
        "CA_ErrorModel",
        ("positionBody", "", "", "Length", "Δx_b"),
        ("attitudeBody", "", "", "Angle", "Δr, Δp, Δy"),
        ("boresight", "", "", "Angle", "Δω, Δφ, Δκ"),
        ("range", "", "", "Length", "Δρ"),
        ("scanAngle", "", "", "Angle", "Δθ"),
        ("scannerAssembly", "", "", "Angle", "Δη"),
        confirmed=False,
    ),
    *_of(
        OPTICAL,
        "CA_GeometryValidation",
        ("validationMethod", "M", _N, "CA_ValidationMethod", "testfield 001 … other 006 (6.8 of part 2)"),
        ("validationTime", "M", "1", "DateTime", "when it was validated"),
    ),
    *_of(
        OPTICAL,
        "CA_PhotoFlight",
        ("numberOfPhotoFlights", "M", "", "Integer", "flights"),
        ("flyingHeight", "M", "", "Length", "above the ellipsoid"),
        ("flyingAltitudeAboveGround", "M", "", "Length", "above ground"),
        ("terrainHeight", "M", "", "Length", "above the ellipsoid"),
        ("alongStripOverlap", "M", "", "Real", "of images along a strip"),
        ("acrossStripOverlap", "M", "", "Real", "of strips"),
        ("numberOfStrips", "M", "", "Integer", "strips"),
    ),
    *_of(
        OPTICAL,
        "CA_OpticsSensorGeometry",
        ("geometryCalibrationDate", "O", _N, "DateTime", "when"),
        ("geometryCalibrationType", "O", _N, "CharacterString", "how"),
    ),
    *_of(
        OPTICAL,
        "CA_InteriorOrientation",
        ("synchronization", "M", "", "DateTime", "of the sensor's clock"),
        ("synchronizationError", "M", "", "DateTime", "its error"),
        ("referenceTemperature", "M", "", "CA_Temperature", "temperature it holds for"),
        ("versionFirmware", "M", "", "CharacterString", "firmware"),
        ("versionHardware", "M", "", "CharacterString", "hardware"),
    ),
    *_of(
        OPTICAL,
        "CA_SensorSystem",
        ("relativePosition", "M", "", "DirectPosition", "of the sensor on the platform"),
        ("relativeAttitude", "M", "", "SD_Attitude", "of the sensor on the platform"),
        ("operationalTemperature", "M", "", "CA_TemperatureRange", "range of use"),
    ),
    *_of(
        OPTICAL,
        "CA_AuxiliaryDevice",
        ("timeLeverarm", "M", "", "DateTime", "when the lever arm was measured"),
        ("leverarm", "M", "", "DirectPosition", "from the GNSS point to the sensor's"),
        ("errorLeverarm", "M", "", "Length", "its error"),
    ),
    *_of(
        OPTICAL,
        "CA_GNSS",
        ("numberSatellites", "M", "", "Integer", "satellites, at least 4"),
        ("registrationCycle", "M", "", "DateTime", "interval of positions"),
    ),
    *_of(
        OPTICAL,
        "CA_IMU",
        ("boresightAngle", "M", "", "SD_Attitude", "boresight"),
        ("dataRate", "M", "", "DateTime", "interval of samples"),
        ("attitudeAccuracy", "M", "", "Angle", "sigma of attitude"),
    ),
    *_of(
        OPTICAL,
        "CA_TestRange",
        ("controlPoint", "O", _N, "DirectPosition", "control"),
        ("checkPoint", "O", _N, "DirectPosition", "check points"),
        ("numberControlPoints", "M", "", "Integer", "number of control points"),
        ("numberCheckPoints", "M", "", "Integer", "number of check points"),
        ("positionalError", "O", _N, "CA_PositionalError", "of the points"),
    ),
    *_of(
        OPTICAL,
        "CA_PositionalError",
        ("errorX", "M", "", "Length", "east"),
        ("errorY", "M", "", "Length", "north"),
        ("errorZ", "M", "", "Length", "up"),
        ("errorXY", "M", "", "Length", "horizontal"),
        ("errorXYZ", "M", "", "Length", "in space"),
        ("pointType", "", "", "CA_PointType", "kind of points"),
        ("errorType", "", "", "CA_ErrorType", "standardDeviation, rootMeanSquareError, other"),
        ("quantityType", "", "", "CA_QuantityType", "minimum, maximum, mean, other"),
    ),
    *_of(
        OPTICAL,
        "CA_Distortion",
        ("selfCalibrationModel", "", "", "CA_SelfCalibrationModel", "brown, fraser, …, none, other"),
        ("sigmaNaught", "", "", "Length", "sigma of unit weight"),
        ("software", "", "", "CharacterString", "software"),
        ("propertiesAlgorithm", "", "", "CharacterString", "method"),
    ),
    *_of(
        OPTICAL,
        "CA_Documentation",
        ("certificateIdentification", "M", "", "MD_Identifier", "id of the certificate"),
        ("dataProductLevel", "M", "", "CA_DataProductLevel", "rawData, level0 … level4, other"),
        ("geometricQuality", "M", "", "CA_PositionalError", "quality"),
        ("stabilizedPlatform", "M", "", "CharacterString", "whether the platform is stabilised"),
    ),
    *_of(
        OPTICAL,
        "SD_Calibration",
        ("calibrationAgency", "M", "", "CI_ResponsibleParty", "who calibrated"),
        ("calibrationDate", "M", "", "Date", "when"),
    ),
)
BY_KEY = {row.key: row for row in ROWS}
VALIDATION_METHODS = {  # codes of ISO/TS 19159-2, 6.8
    "testfield": "001",
    "crossStripFlight": "002",
    "secondFlight": "003",
    "secondAltitude": "004",
    "measurementActualParameters": "005",
    "other": "006",
}
CALIBRATION_TYPES = ("laboratory", "testRange", "inSitu", "onboard", "inFlight", "vicarious", "cross", "other")
