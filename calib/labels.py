"""Format numbers and names for reports."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from swath.calib.outcome import FixedParameter
from swath.georef.scanner.calibration import PARAMETERS

MINUS, THIN, SPACE = "−", "\u202f", "\u00a0"  # spaces at which no line breaks
_LABELS: dict[str, tuple[str, str]] = {  # words, symbol
    "omega_rad": ("boresight ω (roll)", "ω"),
    "phi_rad": ("boresight φ (pitch)", "φ"),
    "kappa_rad": ("boresight κ (heading)", "κ"),
    "range_offset_m": ("range offset", "Δρ"),
    "range_scale": ("range scale", "sρ"),
    "scan_angle_offset_rad": ("scan angle offset", "Δθ"),
    "scan_angle_scale": ("scan angle scale", "sθ"),
    "scan_plane_tilt_rad": ("scan plane tilt Δη", "Δη"),
    "lever_arm_x_m": ("lever arm x", "ax"),
    "lever_arm_y_m": ("lever arm y", "ay"),
    "lever_arm_z_m": ("lever arm z", "az"),
    "time_offset_s": ("time offset", "δt"),
    "imu_latency_s": ("IMU latency", "τi"),
    "encoder_latency_s": ("encoder latency", "τe"),
    "torsion_s2": ("torsion", "τt"),
    "pitch_slope": ("pitch slope", "m"),
}
_UNITS = {"deg": "°", "m": "m", "ppm": "ppm", "us": "µs", "us2": "µs²"}
_BY_NAME = {parameter.name: parameter for parameter in PARAMETERS}
_BY_KEY = {parameter.key: parameter.name for parameter in PARAMETERS}
_KEYS = re.compile(rf"\b({'|'.join(sorted(_BY_KEY, key=len, reverse=True))})\b(?:( [+−-][\d.,]+ ± [\d.,]+)(?![\d.]))?")
_NAMED = re.compile(rf"\b([\w-]+)\.({'|'.join(sorted(_LABELS, key=len, reverse=True))})\b")
_SUFFIXES = (("_rad", "°", 180.0 / math.pi), ("_m", "m", 1.0), ("_s", "µs", 1e6))


@dataclass(frozen=True, slots=True)
class Unknown:
    """An unknown of the adjustment with its name for display.

    Attributes:
        scanner: the scanner it belongs to.
        name: name of the parameter or of the table's entry.
        words, symbol: long and short names.
        unit: unit in reports; factor: units of reports per SI unit.
    """

    scanner: str
    name: str
    words: str
    symbol: str
    unit: str
    factor: float

    @property
    def is_parameter(self) -> bool:
        """True for one of the model's sixteen parameters, False for an entry of a table."""
        return self.name in _BY_NAME


def unknown(name: str) -> Unknown:
    """Return the unknown with a name as ``left.omega_rad``, ``left.ibrc.3``, ``left.beam.12.azimuth_rad``."""
    scanner, _, own = name.partition(".")
    if own in _BY_NAME:
        parameter = _BY_NAME[own]
        words, symbol = _LABELS[own]
        return Unknown(scanner, own, words, symbol, _UNITS[parameter.key.rpartition("_")[2]], 1.0 / parameter.factor)
    kind, _, rest = own.partition(".")
    words = f"{kind.replace('_', ' ').replace('ibrc', 'IBRC')} {rest.replace('.', ' ')}".strip()
    for suffix, unit, factor in _SUFFIXES:
        if own.endswith(suffix):
            return Unknown(scanner, own, words.removesuffix(suffix), rest.removesuffix(suffix), unit, factor)
    return Unknown(scanner, own, words, f"{kind[:2]}{rest}", "m", 1.0)


def words_of(scanner: str, name: str, *, several: bool) -> str:
    """Return a parameter's words, followed by its scanner if the flight has several."""
    words = unknown(f"{scanner}.{name}").words
    return f"{words} of {scanner}" if several else words


def plain(text: str, *, several: bool) -> str:
    """Replace parameter names such as ``left.omega_rad`` in a sentence by their words."""
    return _NAMED.sub(lambda found: words_of(found[1], found[2], several=several), text)


def worded(text: str) -> str:
    """Replace the keys of parameters in a sentence, such as ``omega_deg``, by their words; values get their units."""

    def words(found: re.Match[str]) -> str:
        one = unknown(f".{_BY_KEY[found[1]]}")
        return one.words + (f"{found[2]}{'' if one.unit == '°' else ' '}{one.unit}" if found[2] else "")

    return _KEYS.sub(words, text)


def is_undetermined(held: FixedParameter) -> bool:
    """Return True if a parameter is held because the flight does not determine it, not because the user fixed it."""
    return bool(held.remedy or held.with_others)


def decimals_of(sigma: float, most: int = 9) -> int:
    """Return how many decimals show two digits of a sigma."""
    if not math.isfinite(sigma) or sigma <= 0.0:
        return 4
    exponent = int(f"{sigma:.1e}".partition("e")[2])  # of the rounded sigma: 0.0996 shows as 0.10
    return min(max(1 - exponent, 0), most)


LEAST_P = 1e-6  # smaller probabilities are told as smaller than this


def p_words(value: float) -> str:
    """Return the probability of a test in words, such as ``p 0.70`` or ``p < 1e-06``."""
    if value < LEAST_P:
        return f"p < {LEAST_P:g}"
    return f"p {value:.2f}" if value >= 0.01 else f"p {value:.2g}"


def number(value: float | None, pattern: str = ".3g") -> str:
    """Format a number with a real minus sign; a dash stands for None or a number that is not finite."""
    if value is None or not math.isfinite(value):
        return "–"
    text = format(value, pattern)
    return text.replace("-", MINUS) if float(text.replace(",", "")) else text.replace("-", "")


def with_sigma(value: float, sigma: float, *, sign: bool = True) -> str:
    """Format a value and its sigma as ``+12.0 ± 1.4``: the sigma with two digits, the value to the same place."""
    pattern = f".{decimals_of(sigma)}f"
    return f"{number(value, f'+{pattern}' if sign else pattern)} ± {number(sigma, pattern)}"


def thousands(value: float, digits: int = 0) -> str:
    """Format a number with separated thousands."""
    return f"{value:,.{digits}f}".replace(",", THIN).replace("-", MINUS)


def length(metres: float | None) -> str:
    """Format a sigma or a difference: millimetres below a centimetre, centimetres below a metre."""
    if metres is None or not math.isfinite(metres):
        return "–"
    size = abs(metres)
    if size >= 1.0:
        return number(metres, ".2f") + SPACE + "m"
    if size >= 0.00995:
        return number(100.0 * metres, ".1f") + SPACE + "cm"
    return number(1000.0 * metres, ".0f" if size >= 0.00095 else ".1f") + SPACE + "mm"


def degrees(value_deg: float | None) -> str:
    """Format the sigma of a small angle in degrees."""
    if value_deg is None or not math.isfinite(value_deg):
        return "–"
    return number(value_deg, f".{max(4, decimals_of(value_deg) - 1)}f" if value_deg < 0.1 else ".2f") + "°"


def sized(name: str, value: float, *, sign: bool = False) -> str:
    """Format a sigma or a difference (SI) of an unknown, as ``left.omega_rad``, in the unit of reports."""
    one = unknown(name)
    if one.unit == "m":
        words = length(value)
        return f"+{words}" if sign and value > 0.0 else words
    size = value * one.factor
    digits = decimals_of(abs(size))
    return number(size, f"{'+' if sign else ''}.{digits}f") + ("°" if one.unit == "°" else SPACE + one.unit)


def share(value: float) -> str:
    """Format a share as a percentage; a positive share never shows as 0 %."""
    return "0 %" if value <= 0.0 else "< 0.01 %" if value < 1e-4 else f"{100.0 * value:.2f} %"


def listed(words: list[str], most: int = 6) -> str:
    """Join words as a sentence lists things."""
    shown = words if len(words) <= most else [*words[: most - 1], f"{len(words) - most + 1} more"]
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} and {shown[-1]}" if shown else ""
