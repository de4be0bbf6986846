"""Reads a Velodyne head's own calibration: the maker's db.xml, or the YAML file that ROS makes from it.

Facts from ros-drivers/velodyne (gen_calibration.py, calibration.cpp): the XML is in degrees and centimetres, the YAML
in radians and metres; rotational corrections are subtracted from the azimuth. The beam's start and direction follow
FORMULAS 2.2, which was verified against that driver.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree

import numpy as np

from swath.drivers.parser import DriverSettingsError
from swath.drivers.scanner.beams import BeamTable, beam_table
from swath.drivers.scanner.velodyne.heads import SpinningHead

_MOST_BYTES = 256 * 1024  # ten times the file of 128 lasers
_MOST_LEVELS = 16  # a valid file has three
_KEYS = (  # key in the XML without its trailing underscore, key in the YAML, the XML's unit
    ("vertCorrection", "vert_correction", math.pi / 180),
    ("rotCorrection", "rot_correction", math.pi / 180),
    ("distCorrection", "dist_correction", 0.01),
    ("distCorrectionX", "dist_correction_x", 0.01),
    ("distCorrectionY", "dist_correction_y", 0.01),
    ("vertOffsetCorrection", "vert_offset_correction", 0.01),
    ("horizOffsetCorrection", "horiz_offset_correction", 0.01),
)


def read_calibration(data: bytes, head: SpinningHead) -> BeamTable:
    """Read the beams of a head from its calibration file.

    Raises:
        DriverSettingsError: the file is invalid or of another model, or has two-point corrections (of an HDL-64E).
    """
    if len(data) > _MOST_BYTES:
        raise DriverSettingsError(
            f"geometry.file: has {len(data)} bytes; want the file of a Velodyne head, below {_MOST_BYTES} bytes"
        )
    try:
        resolution_m, lasers = _read_xml(data) if data.lstrip()[:1] == b"<" else _read_yaml(data)
    except (ValueError, TypeError, LookupError, OverflowError, RecursionError, ElementTree.ParseError) as error:
        text = (str(error).splitlines() or [type(error).__name__])[0]
        raise DriverSettingsError(f"geometry.file: neither db.xml nor YAML of a Velodyne head: {text}") from error
    if resolution_m is not None and not math.isclose(resolution_m, head.range_unit_m, rel_tol=1e-3):
        raise DriverSettingsError(
            f"geometry.file: is of another model: distances in {resolution_m:g} m, want {head.range_unit_m:g} m"
        )
    missing = [laser for laser in range(len(head.beams)) if laser not in lasers]
    if missing:
        raise DriverSettingsError(f"geometry.file: laser {missing[0]} is missing, want 0 to {len(head.beams) - 1}")
    return _beams([lasers[laser] for laser in range(len(head.beams))])


def _beams(lasers: list[dict[str, float]]) -> BeamTable:
    value = {name: np.array([laser[name] for laser in lasers]) for _, name, _ in _KEYS}
    for name, values in value.items():
        wrong = ~np.isfinite(values) | (np.abs(values) > math.pi)
        if name in ("dist_correction_x", "dist_correction_y"):
            wrong |= values != 0
        if wrong.any():
            laser = int(np.flatnonzero(wrong)[0])
            raise DriverSettingsError(
                f"geometry.file: {name} of laser {laser} is {values[laser]}: not valid for this model"
            )
    elevation, offset = value["vert_correction"], value["vert_offset_correction"]
    return beam_table(
        np.degrees(elevation),
        azimuth_deg=-np.degrees(value["rot_correction"]),
        range_m=value["dist_correction"],
        right_m=-value["horiz_offset_correction"],
        forward_m=-offset * np.sin(elevation),
        up_m=offset * np.cos(elevation),
    )


def _read_yaml(data: bytes) -> tuple[float | None, dict[int, dict[str, float]]]:
    """Read distance resolution in metres, and corrections by laser id, from the YAML file."""
    import yaml  # imported only for such a file

    try:
        depth = 0
        for event in yaml.parse(data, yaml.SafeLoader):
            # with aliases a file of a few lines can expand to more values than fit in memory
            if isinstance(event, yaml.AliasEvent):
                raise ValueError("contains an alias; write each value out")
            # the YAML scanner's time for a token grows with its depth: 20 kB of brackets took minutes
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > _MOST_LEVELS:
                raise ValueError(f"nested more than {_MOST_LEVELS} deep; want lasers, each a table of numbers")
        table = yaml.safe_load(data)
    except yaml.YAMLError as error:
        raise ValueError(str(error).replace("\n", " ")) from error
    lasers: dict[int, dict[str, float]] = {}
    for laser in table["lasers"]:
        lasers[int(laser["laser_id"])] = {
            name: float(laser[name] if name == "vert_correction" else laser.get(name, 0.0)) for _, name, _ in _KEYS
        }
    resolution = table.get("distance_resolution")
    return None if resolution is None else float(resolution), lasers


def _read_xml(data: bytes) -> tuple[float | None, dict[int, dict[str, float]]]:
    """Read distance resolution in metres, and corrections by laser id, from the maker's file."""
    root = ElementTree.fromstring(data)
    lasers = {int(_text(px, "id_")): dict(_xml_values(px)) for px in root.iterfind("DB/points_/item/px")}
    if not lasers:
        raise ValueError("no DB/points_/item/px")
    resolution_cm = root.findtext("DB/distLSB_")
    return None if resolution_cm is None else float(resolution_cm) * 0.01, lasers


def _xml_values(px: ElementTree.Element) -> Iterator[tuple[str, float]]:
    for tag, name, unit in _KEYS:
        text = _text(px, f"{tag}_") if tag == "vertCorrection" else px.findtext(f"{tag}_", "0")
        yield name, float(text) * unit


def _text(px: ElementTree.Element, tag: str) -> str:
    text: Any = px.findtext(tag)
    if text is None:
        raise ValueError(f"a laser has no {tag}")
    return str(text)
