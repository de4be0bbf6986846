"""A scanner's calibration: the parameters of mounting and errors, their sigmas, and its tables.

It is read from a calibration file (CONVENTIONS, "Calibration file"), or nominal without one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from swath.georef.arrays import FloatArray
from swath.georef.toml_tables import TomlError, key_text, toml_tables

CONVENTIONS = 1  # version of docs/conventions.md
METHODS = ("nominal", "planes", "tie_points", "profiles", "control", "combined")
RANGES = ("corrected", "vacuum")
REFRACTIONS = ("none", "ardc", "spherical")
ROTATION_TOLERANCE = 1e-6
# in the units of the file: far beyond any true value, and within the range of squares
LARGEST, LEAST_SIGMA = 1e18, 1e-15
WHOLE_TURN_DEG = 360.0
MOST = 65_535  # greatest number of channels, which have 16 bits, and limit of other counts
ONE_TABLE = "give it once"
TABLES = ("calibration", "parameters", "sigma", "held_sigma", "correlation", "ibrc", "range_offset", "facet", "beam")
VERDICTS = ("good", "usable with care", "not to be used")


class CalibrationError(ValueError):
    """Raised for an unusable calibration file; its text has one line per mistake: file, key, remedy."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter of the model.

    Attributes:
        key: in calibration files.
        name: in the code, with its SI unit.
        factor: SI units per unit of the file.
        likely: one sigma, in the file's unit, of its error if it is neither measured nor calibrated.
        needed: whether a calibration file must give its value.
    """

    key: str
    name: str
    factor: float
    likely: float
    needed: bool = False

    @property
    def plausible(self) -> float:
        """One sigma, SI, of its error if it is neither measured nor calibrated."""
        return self.likely * self.factor


_DEG, _PPM, _US = math.pi / 180.0, 1e-6, 1e-6
PARAMETERS: tuple[Parameter, ...] = (
    Parameter("omega_deg", "omega_rad", _DEG, 1.0, needed=True),
    Parameter("phi_deg", "phi_rad", _DEG, 1.0, needed=True),
    Parameter("kappa_deg", "kappa_rad", _DEG, 1.0, needed=True),
    Parameter("range_offset_m", "range_offset_m", 1.0, 0.2, needed=True),
    Parameter("range_scale_ppm", "range_scale", _PPM, 50.0),
    Parameter("scan_angle_offset_deg", "scan_angle_offset_rad", _DEG, 0.02),
    Parameter("scan_angle_scale_ppm", "scan_angle_scale", _PPM, 300.0),
    Parameter("scan_plane_tilt_deg", "scan_plane_tilt_rad", _DEG, 0.02),
    Parameter("lever_arm_x_m", "lever_arm_x_m", 1.0, 0.05, needed=True),
    Parameter("lever_arm_y_m", "lever_arm_y_m", 1.0, 0.05, needed=True),
    Parameter("lever_arm_z_m", "lever_arm_z_m", 1.0, 0.05, needed=True),
    Parameter("time_offset_us", "time_offset_s", _US, 1000.0),
    Parameter("imu_latency_us", "imu_latency_s", _US, 1000.0),
    Parameter("encoder_latency_us", "encoder_latency_s", _US, 2.0),
    Parameter("torsion_us2", "torsion_s2", _US * _US, 2000.0),
    Parameter("pitch_slope_ppm", "pitch_slope", _PPM, 500.0),
)
INDEX = {parameter.name: index for index, parameter in enumerate(PARAMETERS)}  # of SI names in arrays (16,)
_INDEX_OF_KEY = {parameter.key: index for index, parameter in enumerate(PARAMETERS)}


@dataclass(frozen=True, slots=True)
class RangeOffset:
    """Metres added to ``range_offset_m`` for returns that match every field that is not None."""

    offset_m: float
    return_slot: int | None = None
    mta_zone: int | None = None
    prf_hz: float | None = None


@dataclass(frozen=True, slots=True)
class BeamCorrection:
    """Corrections added to a beam of a multi-beam head."""

    azimuth_rad: float = 0.0
    elevation_rad: float = 0.0
    range_m: float = 0.0


@dataclass(frozen=True, eq=False)
class Calibration:
    """A scanner's calibration, SI units.

    Attributes:
        id, scanner, method: of the file.
        parameters: (16,) in the order of `PARAMETERS`.
        sigmas: (16,) one sigma of the estimated ones, with the effect of possible errors of the held ones; 0: held.
        correlation: (16, 16) of the estimated and held ones together.
        installation_matrix: (3, 3) T, b from s (inside a gimbal: its innermost stage from s).
        mirror_factor: factor of the encoder's angles in the estimation; None: not given.
        ranges, refraction: the [atmosphere] settings of the estimation; None: not given.
        ibrc: intensities, rising, and metres subtracted from the range; None: no table.
        range_offsets: each added to the range offset where it matches.
        facet_tilt_rad: tilt of facets by index.
        beams: corrections of beams by channel.
        header: all of the file's table [calibration].
        held_sigmas: (16,) plausible sigmas of the held ones; 0: estimated, or not given.
    """

    id: str
    scanner: str
    method: str
    parameters: FloatArray
    sigmas: FloatArray = field(default_factory=lambda: np.zeros(len(PARAMETERS)))
    correlation: FloatArray = field(default_factory=lambda: np.eye(len(PARAMETERS)))
    installation_matrix: FloatArray = field(default_factory=lambda: np.eye(3))
    mirror_factor: float | None = None
    ranges: str | None = None
    refraction: str | None = None
    ibrc: tuple[FloatArray, FloatArray] | None = None
    range_offsets: tuple[RangeOffset, ...] = ()
    facet_tilt_rad: Mapping[int, float] = field(default_factory=dict)
    beams: Mapping[int, BeamCorrection] = field(default_factory=dict)
    header: Mapping[str, Any] = field(default_factory=dict)
    held_sigmas: FloatArray = field(default_factory=lambda: np.zeros(len(PARAMETERS)))

    @property
    def is_nominal(self) -> bool:
        """True if nothing was estimated or judged: its method is nominal, and the file has no verdict."""
        return self.method == "nominal" and "verdict" not in self.header

    def with_plausible_sigmas(self) -> Calibration:
        """Return a nominal calibration with plausible sigmas of unmeasured parameters; other calibrations unchanged."""
        if not self.is_nominal or self.all_sigmas.any():
            return self
        return replace(self, held_sigmas=np.array([parameter.plausible for parameter in PARAMETERS]))

    def value(self, name: str) -> float:
        """Return a parameter by its name in SI units, as ``omega_rad``."""
        return float(self.parameters[INDEX[name]])

    @property
    def lever_arm_b(self) -> FloatArray:
        """The vector (3,) from the body's origin to the scanner's (to the first stage of its gimbal), metres."""
        return np.array([self.value(f"lever_arm_{axis}_m") for axis in "xyz"])

    @property
    def all_sigmas(self) -> FloatArray:
        """One sigma (16,) of every parameter, estimated or held; 0: not given."""
        return self.sigmas + self.held_sigmas

    def covariance(self) -> FloatArray:
        """Return the covariance (16, 16) of the parameters, estimated and held, SI units; zero where not given."""
        sigmas = self.all_sigmas
        scaled: FloatArray = self.correlation * np.outer(sigmas, sigmas)
        return scaled

    def changed(self, **values: float) -> Calibration:
        """Return a copy with other values of some parameters, by their names in SI units."""
        parameters = self.parameters.copy()
        for name, value in values.items():
            parameters[INDEX[name]] = value
        return replace(self, parameters=parameters)


def nominal(
    scanner: str, lever_arm_b: Sequence[float] | FloatArray, installation: Sequence[Sequence[float]] | FloatArray
) -> Calibration:
    """Return the calibration to use without a file.

    Every parameter is zero but the lever arm (3,); the installation matrix T (3, 3) is as given.
    """
    parameters = np.zeros(len(PARAMETERS))
    first = INDEX["lever_arm_x_m"]
    parameters[first : first + 3] = lever_arm_b
    matrix = np.array(installation, dtype=np.float64)
    return Calibration("nominal", scanner, "nominal", parameters, installation_matrix=matrix)


def read_calibration(text: str, name: str) -> Calibration:
    """Return a calibration read from a file.

    Args:
        text: of the file.
        name: of the file, for messages.

    Raises:
        CalibrationError: one line per mistake.
    """
    try:
        document = toml_tables(text)
    except TomlError as error:
        raise CalibrationError(f"{name}: {error}") from error
    reader = _Reader(document)
    calibration = reader.calibration()
    if reader.mistakes:
        raise CalibrationError("\n".join(f"{name}: {mistake}" for mistake in reader.mistakes))
    return calibration


class _Reader:
    """Reads a document; it notes each mistake and continues with a harmless value."""

    def __init__(self, document: Mapping[str, Any]) -> None:
        self._document = document
        self.mistakes: list[str] = []

    def calibration(self) -> Calibration:
        self._known(self._document, "", TABLES)
        header = self._table("calibration", needed=True)
        self._version(header)
        parameters, _ = self._values("parameters")
        sigmas, estimated = self._sigmas("sigma")
        held_sigmas, held = self._sigmas("held_sigma")
        for index in np.flatnonzero((sigmas != 0.0) & (held_sigmas != 0.0)).tolist():
            self._wrong(f"held_sigma.{PARAMETERS[index].key}", "is also in [sigma]; give it in one of the two tables")
        if "verdict" in header:
            self._choice(header, "verdict", VERDICTS)
        return Calibration(
            id=self._text(header, "id"),
            scanner=self._text(header, "scanner"),
            method=self._choice(header, "method", METHODS) or "nominal",
            parameters=parameters,
            sigmas=sigmas,
            held_sigmas=held_sigmas,
            correlation=self._correlation(estimated | held),
            installation_matrix=self._rotation(header),
            mirror_factor=self._mirror_factor(header),
            ranges=self._choice(header, "ranges", RANGES),
            refraction=self._choice(header, "refraction", REFRACTIONS),
            ibrc=self._ibrc(),
            range_offsets=tuple(self._range_offsets()),
            facet_tilt_rad=self._facets(),
            beams=self._beams(),
            header=header,
        )

    def _wrong(self, key: str, text: str) -> None:
        self.mistakes.append(f"{key}: {text}")

    def _known(self, table: Mapping[str, Any], where: str, keys: tuple[str, ...]) -> None:
        """Note tables or keys that are unknown, such as misspelt ones, which would otherwise be ignored."""
        for key in sorted(table.keys() - set(keys)):
            self._wrong(f"{where}{key_text(key)}", f"is unknown; use {', '.join(keys)}")

    def _table(self, key: str, *, needed: bool = False) -> Mapping[str, Any]:
        table = self._document.get(key)
        if isinstance(table, dict):
            return table
        if table is not None or needed:
            self._wrong(key, f"{'missing' if table is None else 'not a table'}; add [{key}]")
        return {}

    def _text(self, header: Mapping[str, Any], key: str) -> str:
        value = header.get(key)
        if isinstance(value, str) and value.splitlines() == [value]:
            return value
        if header:
            got = "missing" if value is None else "not one line" if isinstance(value, str) and value else "not text"
            self._wrong(f"calibration.{key}", f"{got}; give text in quotes")
        return ""

    def _version(self, header: Mapping[str, Any]) -> None:
        """Note a wrong version of the conventions, which define the signs and units of the numbers."""
        value = header.get("conventions", CONVENTIONS)
        if value != CONVENTIONS:
            self._wrong("calibration.conventions", f"got {value!r}, want {CONVENTIONS}: other signs or units, perhaps")

    def _choice(self, header: Mapping[str, Any], key: str, choices: tuple[str, ...]) -> str | None:
        value = header.get(key)
        if value is None and (key != "method" or not header):
            return None
        if value not in choices:
            got = "missing" if value is None else f"got {value!r}"
            self._wrong(f"calibration.{key}", f"{got}, want one of {', '.join(choices)}")
            return None
        return str(value)

    def _number(self, table: Mapping[str, Any], key: str, where: str, default: float | None = None) -> float:
        value = table.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            got = "missing" if value is None else f"got {value!r}"
            self._wrong(f"{where}.{key}", f"{got}, want a number")
            return 0.0
        if abs(value) > LARGEST:
            self._wrong(f"{where}.{key}", f"got {value:g}, want a number, at most {LARGEST:g} either way")
            return 0.0
        if key.endswith("_deg") and "sigma" not in where and abs(value) > WHOLE_TURN_DEG:
            self._wrong(f"{where}.{key}", f"{value:g}° is more than a whole turn; give -360 to 360")
            return 0.0
        return float(value)

    def _whole(self, table: Mapping[str, Any], key: str, where: str, *, least: int = 0) -> int:
        value = table.get(key)
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= MOST:
            got = "missing" if value is None else f"got {value!r}"
            self._wrong(f"{where}.{key}", f"{got}, want a whole number from {least} to {MOST}")
            return 0
        return value

    def _values(self, section: str) -> tuple[FloatArray, set[int]]:
        """Return values (16,) in SI units, and the indices of those given."""
        table = self._table(section, needed=section == "parameters")
        values, given = np.zeros(len(PARAMETERS)), set()
        for key in sorted(table.keys() - _INDEX_OF_KEY.keys()):
            self._wrong(
                f"{section}.{key_text(key)}", "not a parameter of the model; use the keys of docs/conventions.md"
            )
        for index, parameter in enumerate(PARAMETERS):
            needed = parameter.needed and section == "parameters" and bool(table)
            if parameter.key in table or needed:
                values[index] = self._number(table, parameter.key, section) * parameter.factor
                given.add(index)
        return values, given

    def _sigmas(self, section: str) -> tuple[FloatArray, set[int]]:
        """Return sigmas (16,) in SI units, none negative or too small to be squared, and the indices of those given."""
        sigmas, given = self._values(section)
        in_units = sigmas / [parameter.factor for parameter in PARAMETERS]
        for index in np.flatnonzero((sigmas != 0.0) & (in_units < LEAST_SIGMA)).tolist():
            want = "at least 0" if sigmas[index] < 0.0 else f"0, which is held, or at least {LEAST_SIGMA:g}"
            self._wrong(f"{section}.{PARAMETERS[index].key}", f"got {in_units[index]:g}, want {want}")
        return sigmas, given

    def _correlation(self, known: set[int]) -> FloatArray:
        """Return the correlation (16, 16) from the names and the matrix of the parameters with sigmas."""
        whole = np.eye(len(PARAMETERS))
        table = self._table("correlation")
        if not table:
            return whole
        names = table.get("names")
        if not isinstance(names, list) or any(_INDEX_OF_KEY.get(str(name)) not in known for name in names):
            self._wrong("correlation.names", "must be a list of keys of [sigma] and [held_sigma]")
            return whole
        matrix = _array(table.get("matrix"), (len(names), len(names)))
        if matrix is None or len(set(names)) < len(names) or not _is_correlation(matrix):
            size = f"{len(names)} × {len(names)}"
            self._wrong("correlation.matrix", f"must be {size} numbers: symmetric, 1 on its diagonal, none below −1")
            return whole
        at = [_INDEX_OF_KEY[name] for name in names]
        whole[np.ix_(at, at)] = matrix
        return whole

    def _rotation(self, header: Mapping[str, Any]) -> FloatArray:
        key = "installation_matrix"
        if header.get(key) is None:
            return np.eye(3)
        matrix = _array(header[key], (3, 3))
        if matrix is None or not is_rotation(matrix):
            self._wrong(f"calibration.{key}", "not a rotation; give 3 × 3 numbers, perpendicular rows of length 1")
            return np.eye(3)
        return matrix

    def _mirror_factor(self, header: Mapping[str, Any]) -> float | None:
        if header.get("mirror_factor") is None:
            return None
        return self._number(header, "mirror_factor", "calibration")

    def _ibrc(self) -> tuple[FloatArray, FloatArray] | None:
        table = self._table("ibrc")
        if not table:
            return None
        intensity, correction = _array(table.get("intensity"), None), _array(table.get("correction_m"), None)
        if intensity is None or correction is None or len(intensity) != len(correction) or not len(intensity):
            self._wrong("ibrc", "needs intensity and correction_m, lists of equal length with at least one number")
            return None
        if any(after <= before for before, after in pairwise(intensity.tolist())):
            self._wrong("ibrc.intensity", "values must increase")
            return None
        return intensity, correction

    def _rows(self, key: str, columns: tuple[str, ...]) -> Iterator[tuple[str, Mapping[str, Any]]]:
        """Yield rows of an array of tables, with the place of each."""
        rows = self._document.get(key, [])
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            self._wrong(key, f"must be tables [[{key}]]")
            return
        for place, row in enumerate(rows):
            self._known(row, f"{key}[{place}].", columns)
            yield f"{key}[{place}]", row

    def _range_offsets(self) -> Iterator[RangeOffset]:
        for where, row in self._rows("range_offset", ("return_slot", "mta_zone", "prf_hz", "offset_m")):
            if not row.keys() & {"return_slot", "mta_zone", "prf_hz"}:
                self._wrong(where, "matches every return; give return_slot, mta_zone or prf_hz")
            yield RangeOffset(
                self._number(row, "offset_m", where),
                self._whole(row, "return_slot", where, least=1) if "return_slot" in row else None,
                self._whole(row, "mta_zone", where) if "mta_zone" in row else None,
                self._number(row, "prf_hz", where) if "prf_hz" in row else None,
            )

    def _facets(self) -> dict[int, float]:
        tilts: dict[int, float] = {}
        for where, row in self._rows("facet", ("index", "tilt_deg")):
            index = self._whole(row, "index", where)
            if index in tilts:
                self._wrong(f"{where}.index", f"facet {index} is given twice; {ONE_TABLE}")
            tilts[index] = math.radians(self._number(row, "tilt_deg", where))
        return tilts

    def _beams(self) -> dict[int, BeamCorrection]:
        beams: dict[int, BeamCorrection] = {}
        for where, row in self._rows("beam", ("channel", "azimuth_deg", "elevation_deg", "range_m")):
            channel = self._whole(row, "channel", where)
            if channel in beams:
                self._wrong(f"{where}.channel", f"beam {channel} is given twice; {ONE_TABLE}")
            azimuth_deg, elevation_deg, range_m = (
                self._number(row, key, where, default=0.0) for key in ("azimuth_deg", "elevation_deg", "range_m")
            )
            beams[channel] = BeamCorrection(math.radians(azimuth_deg), math.radians(elevation_deg), range_m)
        return beams


def is_rotation(matrix: FloatArray) -> bool:
    """Return whether the rows of (3, 3) are perpendicular, of length 1 and right-handed."""
    error = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    return error < ROTATION_TOLERANCE and float(np.linalg.det(matrix)) > 0.0


def _is_correlation(matrix: FloatArray) -> bool:
    symmetric = np.allclose(matrix, matrix.T, rtol=0.0, atol=1e-9) and np.allclose(np.diag(matrix), 1.0, atol=1e-9)
    return bool(symmetric) and float(np.linalg.eigvalsh(matrix).min(initial=1.0)) > -1e-6


def _array(value: object, shape: tuple[int, ...] | None) -> FloatArray | None:
    """Return numbers of this shape (None: a list of any length), none beyond `LARGEST`; else None."""
    try:
        array = np.array(value)
    except ValueError:
        return None
    if array.dtype.kind not in "if" or not (np.abs(array.astype(np.float64)) <= LARGEST).all():
        return None
    if array.ndim != 1 if shape is None else array.shape != shape:
        return None
    return array.astype(np.float64)
