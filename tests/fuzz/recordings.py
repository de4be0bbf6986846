"""Finds a driver's settings and its device's recordings by its page and its folder in fixtures/.

The settings are those of the example in ``docs/devices/<protocol>.md``. A file that they name is found among the
driver's fixtures by its name, or else by its suffix.
"""

from __future__ import annotations

import gzip
import re
import tomllib
from itertools import accumulate
from pathlib import Path

from swath.daemon.config.config import Config
from swath.daemon.config.tables import Tables
from swath.drivers.can_frames import encode_can_frame
from swath.drivers.captures.opening import read_candump, read_pcap
from swath.drivers.driver import Driver, all_drivers
from swath.drivers.imu.dbc.parser import DbcParser
from swath.drivers.parser import DeviceSettings, Parser
from swath.drivers.transports.base import TransportError
from tests.drivers.recordings import FIXTURES
from tests.drivers.srep_cases import split_datagrams
from tests.drivers.vnb import read_messages

PAGES = FIXTURES.parent / "docs/devices"
MOST_OF_A_FILE_BYTES = 256 * 1024
MOST_UNITS = 3000
MOST_VARIANTS = 4
NO_RECORDING = {".md", ".json", ".jsonl", ".csv", ".npz", ".pcd", ".chk", ".ascii", ".golden", ".dbc", ".toml", ".xml"}


def folders_of(driver: Driver) -> list[Path]:
    """Return folders of fixtures of the driver and of its family, the nearest first."""
    names = accumulate(driver.protocol.split("-"), lambda head, part: f"{head}-{part}")
    return [folder for name in reversed(list(names)) if (folder := FIXTURES / name).is_dir()]


def _files_of(driver: Driver) -> list[Path]:
    return [path for folder in folders_of(driver) for path in sorted(folder.iterdir()) if path.is_file()]


def _suffix(path: Path) -> str:
    return path.with_suffix("").suffix if path.suffix == ".gz" else path.suffix


def _content(path: Path) -> bytes:
    return gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()


def settings_of(driver: Driver) -> list[DeviceSettings]:
    """Return the settings of the page's example, one for each file that could be the one it names."""
    source = f"{driver.kind}/fuzz"
    file = PAGES / f"{driver.protocol}.md"
    assert file.is_file(), f"{driver.protocol}: write docs/devices/{file.name} first: its example is fuzzed"
    page = file.read_text()
    for block in re.findall(r"^```toml\n(.*?)^```", page, re.M | re.S):
        config = Config(Tables.model_validate({"session": {"name": "fuzz"}, **tomllib.loads(block)}), Path("x"), block)
        for kind, name, table in config.device_tables():
            if kind == driver.kind and table.protocol == driver.protocol:
                named = {key: path for key, path in config.files_of(table).items() if key != "calibration"}
                values = config.settings_with(kind, name, table, lambda *_: {}).config
                variants = [DeviceSettings(source, values)]
                for key, path in named.items():
                    contents = _candidates(driver, path)
                    variants += [DeviceSettings(source, values, {key: content}) for content in contents]
                    variants = variants if not driver.needs else variants[1:]
                return variants
    return [DeviceSettings(source)]


def _candidates(driver: Driver, path: Path) -> list[bytes]:
    there = [*_files_of(driver), *sorted((FIXTURES / "config").iterdir())]
    named = [one for one in there if one.name.removesuffix(".gz") == path.name]
    alike = [one for one in there if _suffix(one) == path.suffix]
    return [_content(one) for one in (named or alike)[:MOST_VARIANTS]]


def streams_of(driver: Driver) -> list[bytes]:
    """Return what a serial device sent, one item per file; for a receiver also foreign messages between."""
    others = [FIXTURES / "rtcm3", FIXTURES / "nmea"] if driver.kind == "gnss" else []
    paths = _files_of(driver) + [path for folder in others for path in sorted(folder.iterdir())[:6]]
    found = [path for path in paths if _suffix(path).lower() not in NO_RECORDING and path.suffix != ".pcap"]
    streams = [b"".join(read_messages(path)) if _suffix(path) == ".vnb" else _content(path) for path in found]
    return [stream[:MOST_OF_A_FILE_BYTES] for stream in streams]


def is_on_can(driver: Driver) -> bool:
    """Return whether the device, or the unit that holds it, is on a CAN bus."""
    if "imu" in driver.transports and driver.kind == "gnss":
        driver = all_drivers("imu")[driver.protocol]
    return "can" in driver.transports


def packets_of(driver: Driver, parser: Parser) -> list[list[bytes]]:
    """Return datagrams or CAN frames, a list for each recording.

    A CAN unit without a recording gets frames under its identifiers.
    """
    read = read_candump if is_on_can(driver) else read_pcap
    found = []
    for path in _files_of(driver):
        if _suffix(path).lower() in NO_RECORDING:
            continue
        units: list[bytes] = []
        try:
            for unit in read(path):
                units.append(unit.data)
                if len(units) == MOST_UNITS:
                    break
        except TransportError:
            pass
        if not units and driver.protocol == "srep" and path.suffix == ".bin":
            units = split_datagrams(path.read_bytes())
        if units:
            found.append(units)
    return found or [_frames_of_map(parser)]


def _frames_of_map(parser: Parser) -> list[bytes]:
    assert isinstance(parser, DbcParser), "a driver without a recording"
    parts = parser._map.parts
    return [
        encode_can_frame(part.can_id & 0x1FFF_FFFF, bytes([cycle, 0] * 4), extended=part.can_id >> 31 == 1)
        for cycle in range(20)
        for part in parts
    ]
