"""Plan, configuration, trajectory and reader that several tests of `swath live` use."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from pyproj import CRS, Transformer

from swath.daemon.processing.live.grid import CellGrid
from swath.daemon.processing.live.tiles import Layers, TileFolder, TileReader
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.points import Points
from swath.georef.timescales.gps_time import SECOND_NS
from swath.georef.trajectory.trajectory import Trajectory
from tests.daemon.rig import session_table, wait_until

PLAN = """
[flight]
name = "live"
seed = 5
speed_mps = 50.0
[[line]]
name = "1"
from_m = [-150, 0]
to_m = [150, 0]
height_m = 520
[[line]]
name = "2"  # never reached: so that there is ground below the way to the first
from_m = [-1000, 0]
to_m = [-900, 0]
height_m = 520
[gnss.rover]
ins = true
rate_hz = 1
[scanner.left]
prf_hz = 5000
on_lines_only = false
[scanner.right]
prf_hz = 3000
on_lines_only = false
"""
PART_MINUTES = 0.035  # about two seconds


def config_of(wires: Path, folder: Path) -> str:
    """Return the configuration that reads a flight's wires; copy the files that it names into the folder."""
    wait_until((wires / "pps-main").exists, "the last of the wires")
    for path in [*wires.glob("*.true.toml"), wires / "main.dbc", wires / "plan.toml"]:
        (folder / path.name).write_bytes(path.read_bytes())
    text = (wires / "swath.toml").read_text().replace('"novatel"', '"novatel"\ndatum = "same"')
    text = text.replace(".nominal.toml", ".true.toml")
    head = session_table(folder / "logs", name='"growing"', split_minutes=PART_MINUTES)
    return text.replace(text[: text.index("[pps.main]")], head)


GPS_NS = 1_465_549_200 * SECOND_NS
LAT_DEG, LON_DEG, HEIGHT_M = 47.5, 8.9, 800.0


class Utm:
    """A mapping by PROJ alone, to UTM zone 32N unless another CRS is given."""

    def __init__(self, crs: str = "EPSG:32632", unit_m: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> None:
        self._transformer = Transformer.from_crs("EPSG:4978", crs, always_xy=True)
        self.wkt = CRS.from_user_input(crs).to_wkt()
        self.unit_m = np.array(unit_m)

    def map_from_e(self, points_e: FloatArray) -> FloatArray:
        """Return coordinates (n, 3) of the mapping frame for points (n, 3) in e."""
        return np.stack(self._transformer.transform(*points_e.T), axis=-1)


def flight(epochs: int = 11) -> Trajectory:
    """Return a level flight to the north-east at 60 m/s."""
    t = np.arange(epochs) * 0.1
    lat = np.radians(LAT_DEG) + 60.0 * np.sqrt(0.5) * t / 6_366_000
    zero = np.zeros(epochs)
    return Trajectory.from_geodetic(
        GPS_NS + (t * SECOND_NS).astype(np.int64),
        lat,
        np.full(epochs, np.radians(LON_DEG)),
        np.full(epochs, HEIGHT_M),
        np.tile([60.0, 0.0, 0.0], (epochs, 1)),
        zero,
        zero,
        np.full(epochs, np.radians(45.0)),
        position_sigma_l=np.tile([0.02, 0.03, 0.05], (epochs, 1)),
    )


def points_at(points_map: FloatArray, time_ns: Int64Array | None = None) -> Points:
    """Return points at these coordinates, without sigmas, by default a nanosecond apart."""
    n = len(points_map)
    single, byte = np.zeros(n, np.float32), np.ones(n, np.uint8)
    times = GPS_NS + np.arange(n, dtype=np.int64) if time_ns is None else time_ns
    intensity = np.arange(n, dtype=np.float32)
    return Points(times, points_map, None, single, single, intensity, byte, byte, np.zeros(n, np.uint16), byte)


def fields_of(data: bytes) -> Iterator[tuple[int, Any]]:
    """Yield field numbers and raw values of a message (protobuf encoding)."""
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return value

    while at < len(data):
        key = varint()
        kind = key & 7
        if kind == 0:
            yield key >> 3, varint()
            continue
        length = {1: 8, 5: 4}.get(kind) or varint()
        yield key >> 3, data[at : at + length]
        at += length


TYPE_DOUBLE, TYPE_STRING, TYPE_MESSAGE, TYPE_FIXED32 = 1, 9, 11, 7


class Schema:
    """A decoder of messages by a FileDescriptorSet: message types by full name, their fields by number."""

    def __init__(self, data: bytes) -> None:
        self.types: dict[str, dict[int, tuple[str, int, str, bool]]] = {}
        for _, file in fields_of(data):
            parts = list(fields_of(file))
            package = next((value.decode() for number, value in parts if number == 2), "")
            for number, value in parts:
                if number == 4:
                    self._learn(f".{package}", value)

    def _learn(self, scope: str, message: bytes) -> None:
        parts = list(fields_of(message))
        name = f"{scope}.{next(value.decode() for number, value in parts if number == 1)}"
        fields: dict[int, tuple[str, int, str, bool]] = {}
        for number, value in parts:
            if number == 2:
                field = dict(fields_of(value))
                type_name = field.get(6, b"").decode()
                fields[field[3]] = (field[1].decode(), field[5], type_name, field.get(4) == 3)
            elif number == 3:
                self._learn(name, value)
        self.types[name] = fields

    def decode(self, name: str, data: bytes) -> dict[str, Any]:
        """Return the fields of a message by name."""
        found: dict[str, Any] = {}
        for number, value in fields_of(data):
            key, kind, type_name, repeated = self.types[name][number]
            if kind == TYPE_MESSAGE:
                value = self.decode(type_name, value)
            elif kind == TYPE_DOUBLE:
                values = list(struct.unpack(f"<{len(value) // 8}d", value))
                value = values if repeated else values[0]
                if repeated:
                    found[key] = values
                    continue
            elif kind == TYPE_FIXED32:
                value = struct.unpack("<I", value)[0]
            elif kind == TYPE_STRING:
                value = value.decode()
            if repeated:
                found.setdefault(key, []).append(value)
            else:
                found[key] = value
        return found


def read_back(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Return messages by topic, each decoded by the schema that the file holds for its channel."""
    found: dict[str, list[dict[str, Any]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
            decoded = Schema(schema.data).decode(f".{schema.name}", message.data)
            found.setdefault(channel.topic, []).append(decoded | {"schema": schema.name, "log_time": message.log_time})
    return found


def read_map(folder: Path, grid: CellGrid) -> Layers:
    """Write a grid's tiles into a folder, and return all of its layers as the reader of tiles gives them."""
    folder.mkdir(exist_ok=True)
    TileFolder(folder).write(grid.take_changed(), {"cell_m": grid.cell_m})
    reader = TileReader(folder)
    assert reader.refresh()
    extent = reader.extent_m()
    assert extent is not None
    view = reader.view(*extent, grid.cell_m)
    assert view is not None
    return view.layers
