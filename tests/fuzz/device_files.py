"""Targets for files that a device's table names: a head's geometry, an inertial unit's DBC."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

from swath.drivers.driver import Driver, find_driver
from swath.drivers.parser import DeviceKind, DeviceSettings, DriverSettingsError
from tests.drivers.recordings import FIXTURES
from tests.fuzz.engine import Target
from tests.fuzz.mutation import damage
from tests.fuzz.recordings import settings_of
from tests.fuzz.texts import NUMBERS, OF_CSV, OF_JSON, changed_text, told

OF_XML = ("<px>", "</px>", "</item>", "<!DOCTYPE x [<!ENTITY a 'b'>]>", "&a;", "<id_>0</id_>", "<a>" * 3000, "-32.5")
OF_YAML = (
    "{}",
    "null",
    "!!python/object:os.system",
    "*a",
    "&a [*a]",
    "&a {}",
    "<<: [*a, *a]",
    "- ",
    "? ",
    "|",
    "2001-01-01",
    "[" * 300,
    "<<",
)
OF_DBC = ("BO_", "SG_", "@1+", "@0-", "0|64", "63|64", "7|0", "(0,0)", "(1e999,0)", "M", "m0", "SIG_VALTYPE_", '"x"')
WORDS = (*NUMBERS, *OF_CSV, *OF_JSON, *OF_XML, *OF_YAML, *OF_DBC)
Protocols = tuple[tuple[DeviceKind, str], ...]


def device_file_targets() -> Iterator[tuple[str, Callable[[], Target]]]:
    """Return the targets of device files, each with the drivers that read such a file."""
    hesai: Protocols = (("scanner", "hesai-xt32"), ("scanner", "hesai-qt64"), ("scanner", "hesai-qt128"))
    yield "geometry-hesai", partial(_files, "geometry-hesai", hesai)
    mirrors: Protocols = (("scanner", "hesai-at128"),)
    yield "geometry-hesai-at128", partial(_files, "geometry-hesai-at128", mirrors, _changed_and_sealed)
    robosense: Protocols = (("scanner", "robosense-rs16"), ("scanner", "robosense-rs32"))
    yield "geometry-robosense", partial(_files, "geometry-robosense", robosense)
    yield "geometry-ouster", partial(_files, "geometry-ouster", (("scanner", "ouster"),))
    heads: Protocols = (("scanner", "velodyne-vlp16"), ("scanner", "velodyne-vlp32c"))
    yield "geometry-velodyne", partial(_files, "geometry-velodyne", heads)
    yield "dbc", partial(_files, "dbc", (("imu", "dbc"),))


def _changed(rng: random.Random, base: bytes) -> bytes:
    return changed_text(rng, base, WORDS)


def _changed_and_sealed(rng: random.Random, base: bytes) -> bytes:
    """Change a file that ends in its SHA-256, and usually write the new one."""
    changed = damage(rng, base)
    if rng.random() < 0.2 or len(changed) < 32:
        return changed
    return changed[:-32] + hashlib.sha256(changed[:-32]).digest()


def _files(name: str, protocols: Protocols, changed: Callable[[random.Random, bytes], bytes] = _changed) -> Target:
    drivers = [find_driver(kind, protocol) for kind, protocol in protocols]
    examples = [(driver, settings_of(driver)) for driver in drivers]
    seeds = [content for _, found in examples for one in found for content in one.files.values()]
    key = "dbc" if name == "dbc" else "geometry"

    def run(data: bytes) -> Iterator[str]:
        seen = set()
        for driver, (settings, *_) in examples:
            made = told(partial(_made, driver, replace(settings, files={key: data})), DriverSettingsError)
            seen |= {words[:24] for words in made}
        return iter(seen)

    return Target(name, seeds or _of_velodyne(), changed, run)


def _made(driver: Driver, settings: DeviceSettings) -> Iterator[str]:
    driver.make_parser(settings)
    yield "taken"


def _of_velodyne() -> list[bytes]:
    """Return calibrations in the form of ROS and in that of the maker's viewer."""
    lasers = "".join(
        f"<item><px> <id_> {laser} </id_> <vertCorrection_> {laser - 8} </vertCorrection_>\n"
        "<rotCorrection_> 0 </rotCorrection_> <distCorrection_> 1.5 </distCorrection_></px></item>\n"
        for laser in range(16)
    )
    xml = f"<boost>\n<DB>\n<distLSB_> 0.2 </distLSB_>\n<points_>\n{lasers}</points_></DB></boost>".encode()
    return [*(path.read_bytes() for path in sorted((FIXTURES / "velodyne").glob("calib_*.yaml"))), xml]
