"""Targets for a user's GeoTIFFs: the coarse terrain of ``[mta]``, and the ground of a simulated flight."""

from __future__ import annotations

import random
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import rasterio
from rasterio.transform import Affine

from swath.daemon.processing.setup.terrain import read_terrain
from swath.georef.geodesy.earth import e_from_geodetic, rot_e_from_l
from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import Plan, load_plan
from swath.sim.scene.terrain import build_ground
from swath.sim.site import Site
from tests.fuzz.engine import FindingError, Target
from tests.fuzz.mutation import bounds, damage
from tests.fuzz.texts import told

MIDDLE_DEG = (47.5, 8.9)
PLACE = (492_465.0, 5_260_900.0)  # of the middle in EPSG:32632
PEAK_BYTES = 64 << 20


def raster_targets() -> Iterator[tuple[str, Callable[[], Target]]]:
    """Return the targets of both readers on the same files."""
    yield "terrain", lambda: Target("terrain", _seeds(), _changed, _terrain, None, _peak)
    yield "plan-raster", lambda: Target("plan-raster", _seeds(), _changed, _ground, None, _peak)


def _peak(size: int) -> int:
    return PEAK_BYTES + 400 * size


def _seeds() -> list[bytes]:
    """Return small rasters of several layouts."""
    kinds: list[dict[str, Any]] = [
        {"dtype": "float32"},
        {"dtype": "float64", "compress": "deflate", "tiled": True, "blockxsize": 16, "blockysize": 16},
        {"dtype": "int16", "nodata": -9999, "compress": "lzw"},
    ]
    return [_raster(**kind) for kind in kinds]


def _raster(**kind: Any) -> bytes:
    transform = Affine(100.0, 0.0, PLACE[0] - 2000.0, 0.0, -100.0, PLACE[1] + 2000.0)
    rows, columns = np.mgrid[0:40, 0:40]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "dem.tif")
        size = {"driver": "GTiff", "width": 40, "height": 40, "count": 1, "crs": "EPSG:32632", "transform": transform}
        with rasterio.open(path, "w", **size, **kind) as file:
            file.write((480.0 + rows - 0.5 * columns).astype(kind["dtype"]), 1)
        return path.read_bytes()


def _changed(rng: random.Random, base: bytes) -> bytes:
    """Change usually an entry of the directory, or what follows it (TIFF 6.0, section 2)."""
    order: Literal["little", "big"] = "little" if base[:2] == b"II" else "big"
    at = int.from_bytes(base[4:8], order)
    count = int.from_bytes(base[at : at + 2], order)
    if rng.random() < 0.3 or not 0 < count < 60 or at + 2 + 12 * count > len(base):
        return damage(rng, base)
    changed = bytearray(base)
    for _ in range(rng.randrange(1, 4)):
        entry = at + 2 + 12 * rng.randrange(count)
        field = rng.choice(
            (entry, entry + 2, entry + 4, entry + 8, entry + 8, at + 6 + 12 * count + rng.randrange(600))
        )
        piece = bounds(rng)[: 2 if field < entry + 4 else 8 if field > entry + 8 else 4]
        changed[field : field + len(piece)] = piece
    return bytes(changed)


def _terrain(data: bytes) -> Iterator[str]:
    """Read the terrain, and yield what a stream of points would get from it."""

    def read() -> Iterator[str]:
        terrain = read_terrain(path)
        lat, lon = np.radians([MIDDLE_DEG[0], 90.0]), np.radians([MIDDLE_DEG[1], 0.0])
        height_m = terrain.height_at(lat, lon)
        origin_e = e_from_geodetic(lat, lon, np.array([1500.0, 1500.0]))
        range_m = terrain.predicted_m(origin_e, rot_e_from_l(lat, lon)[..., 2])
        if not (np.isnan(height_m) | np.isfinite(height_m)).all():
            raise FindingError(f"heights {height_m}")
        yield f"{np.isfinite(height_m)} {np.isfinite(range_m)}"

    with tempfile.TemporaryDirectory(prefix="swath-fuzz-") as folder:
        path = Path(folder, "dem.tif")
        path.write_bytes(data)
        return iter(told(read))


def _ground(data: bytes) -> Iterator[str]:
    """Yield what is read of a few hundred metres of ground, as at the beginning of a flight."""
    plan, site = _plan()

    def read() -> Iterator[str]:
        ground = build_ground(replace(plan, folder=Path(folder)), site, 200.0 * np.array([[-1.0, -1.0], [1.0, 1.0]]))
        if not np.isfinite(ground.z).all():
            raise FindingError("ground that is nowhere")
        yield "ground"

    with tempfile.TemporaryDirectory(prefix="swath-fuzz-") as folder:
        Path(folder, "dem.tif").write_bytes(data)
        return iter({words.partition(folder)[2][:40] or words for words in told(read, PlanError)})


@lru_cache(maxsize=1)
def _plan() -> tuple[Plan, Site]:
    flight = {"origin_deg": list(MIDDLE_DEG), "crs": "EPSG:32632"}
    plan = load_plan("small").changed(
        {"terrain": {"raster": "dem.tif", "height_m": 480.0, "cell_m": 20.0}, "flight": flight}
    )
    return plan, Site.at(*MIDDLE_DEG)
