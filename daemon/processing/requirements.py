"""Checks for packages that processing needs beside the recorder's, before any processing module is imported."""

from __future__ import annotations

import importlib.util

from swath.daemon.errors import ExitCode, UserError
from swath.drivers.extras import how_to_install

PROCESS = ("numba", "scipy", "pyproj", "laspy", "lazrs")
PAGES = ("matplotlib", "jinja2")  # for HTML pages
PRINTED_PAGES = (*PAGES, "weasyprint")  # for HTML pages that are written as PDF too
GIS = ("rasterio", "fudgeo")  # for maps and features that a GIS reads
EXTRA_OF = {
    "foxglove": "live",
    "google.protobuf": "live",
    "rosbags": "import",
    "rasterio": "gis",
    "fudgeo": "gis",
    "starlette": "console",
    "uvicorn": "console",
    "xstatic": "console",
    "cryptography": "console",
    "segno": "console",
    "PIL": "console",
    "pmtiles": "console",
}  # package: the extra that installs it, if not process


def require_installed(command: str, *others: str) -> None:
    """Refuse to run a command with `UserError` if a package is missing; the message tells how to install it."""
    missing = [name for name in (*PROCESS, *others) if not _is_installed(name)]
    if missing:
        extras = ",".join(dict.fromkeys(["process", *(EXTRA_OF.get(name, "process") for name in others)]))
        text = f"{command} needs {', '.join(missing)}, which are not installed: {how_to_install(extras)}"
        raise UserError(text, ExitCode.USAGE)


def _is_installed(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:  # of the package that holds it
        return False
