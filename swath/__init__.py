"""Airborne laser scanning, from the sensors' wires to the point cloud.

``swath.open`` reads logs; ``swath.navigate``, ``swath.georeference`` and ``swath.calibrate`` process them;
``swath.error_model`` tells how sure differences of points are; ``swath.aio`` opens devices in asyncio and follows a
recorder. Below these, ``swath.georef`` georeferences,
``swath.calib`` calibrates, ``swath.drivers`` reads devices, ``swath.daemon`` records and holds the command line,
``swath.sim`` flies a virtual aircraft.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

# Where the public names stand. They are loaded when first used: the recorder imports this package, and needs none.
# Their types are in __init__.pyi.
_NAMES = {
    "swath.daemon.errors": ("SwathError",),
    "swath.logs": ("Capture", "Log", "Source", "gps_ns", "open", "read_pcap"),
    "swath.processing": ("CalibrationResult", "PointCloud", "Track", "calibrate", "georeference", "navigate"),
}
_PLACES = {name: module for module, names in _NAMES.items() for name in names}
_MODULES = ("aio", "error_model")
__all__ = ["__version__", *sorted([*_PLACES, *_MODULES])]


def __getattr__(name: str) -> Any:
    """Return a public name from the module in which it is defined."""
    if name in _MODULES:
        return importlib.import_module(f"swath.{name}")
    if name not in _PLACES:
        raise AttributeError(f"module 'swath' has no attribute {name!r}")
    return getattr(importlib.import_module(_PLACES[name]), name)


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__
