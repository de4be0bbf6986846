"""Is a calibration file readable, and is it this scanner's? (CONVENTIONS, calibration file.)

The full model is read by calib; the recorder only keeps a copy, and refuses to start with the wrong one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from swath.daemon.config.tables import ScannerConfig
from swath.georef.text_encoding import decoded
from swath.georef.toml_tables import TomlError, toml_tables

CONVENTIONS_VERSION = 1
METHODS = ("nominal", "planes", "tie_points", "profiles", "control", "combined")
NEEDED_TEXTS = ("id", "scanner", "method")
NEEDED_PARAMETERS = (
    "omega_deg",
    "phi_deg",
    "kappa_deg",
    "range_offset_m",
    "lever_arm_x_m",
    "lever_arm_y_m",
    "lever_arm_z_m",
)


def check_calibration(path: Path, scanner: str, table: ScannerConfig) -> Iterator[str]:
    """Findings of a calibration file for the scanner of that name: what is wrong, what would be right."""
    try:
        document = toml_tables(decoded(path.read_bytes()))
    except UnicodeDecodeError as error:
        yield f"not TOML: {error}"
        return
    except TomlError as error:
        yield str(error)
        return
    header, parameters = document.get("calibration"), document.get("parameters")
    if not isinstance(header, dict) or not isinstance(parameters, dict):
        yield "not a calibration file; want the tables [calibration] and [parameters]"
        return
    yield from _check_header(header, scanner, table)
    for key in NEEDED_PARAMETERS:
        value = parameters.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            yield f"parameters.{key}: {'missing' if value is None else 'not a number'}; want a number"


def _check_header(header: Mapping[str, Any], scanner: str, table: ScannerConfig) -> Iterator[str]:
    missing = [key for key in NEEDED_TEXTS if not isinstance(header.get(key), str) or not header[key]]
    for key in missing:
        yield f"calibration.{key}: missing; want text in quotes"
    if "scanner" not in missing and header["scanner"] != scanner:
        yield f'calibration.scanner: is of scanner "{header["scanner"]}", want "{scanner}"'
    if "method" not in missing and header["method"] not in METHODS:
        yield f'calibration.method: got "{header["method"]}", want one of {", ".join(METHODS)}'
    version = header.get("conventions", CONVENTIONS_VERSION)
    if version != CONVENTIONS_VERSION:
        yield f"calibration.conventions: got {version}, want {CONVENTIONS_VERSION}"
    for key in ("model", "serial"):
        theirs, ours = header.get(f"scanner_{key}", ""), getattr(table, key)
        if theirs and ours and theirs != ours:
            yield f'calibration.scanner_{key}: of another head: "{theirs}", the configuration says "{ours}"'
