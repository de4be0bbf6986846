"""Tests the user's map behind live's: placed to a pixel by PROJ's account, and refused in one line if it is none."""

from __future__ import annotations

import io
import math
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from PIL import Image
from pmtiles.tile import Compression, TileType, zxy_to_tileid
from pmtiles.writer import Writer
from pyproj import Transformer

from swath.daemon.console import background as background_module
from swath.daemon.console.background import Background
from swath.daemon.console.rasters import MOST_TILE_PIXELS, Raster, as_text, open_raster
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.live.frame import LocalFrame
from swath.daemon.processing.live.tiles import Placement
from tests.daemon.commands import swath
from tests.daemon.console.builders import (
    WEB_ZOOM,
    WORLD_M,
    as_file,
    colours_of,
    console,
    web_tiles,
    write_map,
    write_mbtiles,
)
from tests.daemon.processing.live.builders import Utm, flight


@pytest.fixture(scope="module")
def frame() -> LocalFrame:
    return LocalFrame(flight().position_e[0], Utm())


@pytest.fixture
def opened() -> Iterator[Callable[[Path], Raster]]:
    """Give what opens a map, and closes it after the test."""
    with ExitStack() as stack:

        def open_one(path: Path) -> Raster:
            return stack.enter_context(closing(open_raster(path)))

        yield open_one


def placed(frame: LocalFrame) -> Placement:
    found = Placement.of({"placement": frame.placement()})
    assert found is not None
    return found


def write_pmtiles(path: Path, frame: LocalFrame, kind: TileType = TileType.WEBP) -> None:
    with path.open("wb") as file:
        writer: Any = Writer(file)
        for (column, row), pixels in sorted(web_tiles(frame).items(), key=lambda one: zxy_to_tileid(WEB_ZOOM, *one[0])):
            writer.write_tile(zxy_to_tileid(WEB_ZOOM, column, row), as_file(pixels, "WEBP"))
        head = {"tile_type": kind, "tile_compression": Compression.NONE, "min_zoom": WEB_ZOOM, "max_zoom": WEB_ZOOM}
        lowest = {"min_lon_e7": 0, "min_lat_e7": 0, "max_lon_e7": 0, "max_lat_e7": 0, "center_zoom": WEB_ZOOM,
                  "center_lon_e7": 0, "center_lat_e7": 0}  # fmt: skip
        writer.finalize(head | lowest, {"attribution": "© Maps"})


def write_geotiff(path: Path, frame: LocalFrame, projection: str, **about: object) -> rasterio.Affine:
    """Write a map of 1200 by 1000 pixels of 0.8 m that is turned by 10° in its CRS, around the frame's origin."""
    x, y = Transformer.from_crs("EPSG:32632", projection).transform(*frame.origin[:2])
    cos, sin = 0.8 * math.cos(math.radians(10.0)), 0.8 * math.sin(math.radians(10.0))
    at = rasterio.Affine(cos, sin, x - 600 * cos - 500 * sin, sin, -cos, y - 600 * sin + 500 * cos)
    across, down = np.meshgrid(np.arange(1200.0), np.arange(1000.0))
    bands = np.moveaxis(colours_of(across, down), -1, 0).astype(np.uint8)
    whole: dict[str, Any] = {
        "width": 1200,
        "height": 1000,
        "count": 3,
        "dtype": "uint8",
        "crs": projection,
        "transform": at,
    } | about
    with rasterio.open(path, "w", driver="GTiff", **whole) as file:
        file.write(bands[: file.count].astype(file.dtypes[0]))
        file.update_tags(TIFFTAG_COPYRIGHT="© Maps")
    return at


def places(zoom: int, x: int, y: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return east and north in the frame of the pixels' centres of a square."""
    steps = (np.arange(256) + 0.5) * 2.0**-zoom
    side_m = 256 * 2.0**-zoom
    east, north = np.meshgrid(x * side_m + steps, -y * side_m - steps)
    return east, north


def shown(background: Background, zoom: int, x: int, y: int) -> NDArray[np.float64]:
    data = background.picture(zoom, x, y)
    assert data is not None, background.trouble
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGBA"), float)


def assert_in_place(picture: NDArray[np.float64], columns: NDArray[np.float64], rows: NDArray[np.float64]) -> None:
    """Assert that each pixel has the colour of the place (from pixels' edges) that PROJ gives it, to a pixel."""
    assert (picture[..., 3] == 255).all()
    error = np.abs(picture[..., :3] - colours_of(columns - 0.5, rows - 0.5))
    assert error[..., :2].max() < 1.0
    assert error[..., 2].max() < 1.5


@pytest.mark.parametrize("write", [write_mbtiles, write_pmtiles])
def test_tiles_are_placed_as_proj_places_them(
    tmp_path: Path,
    opened: Callable[[Path], Raster],
    frame: LocalFrame,
    write: Callable[[Path, LocalFrame], None],
) -> None:
    write(tmp_path / "map", frame)
    raster = opened(tmp_path / "map")
    assert (raster.name, raster.attribution) == ("map", "© Maps")
    to_web = Transformer.from_crs("EPSG:32632", "EPSG:3857")
    at, pixels = placed(frame), 256 << WEB_ZOOM
    for square in ((0, 0, -1), (0, -1, 0), (2, 3, -2)):
        east, north = places(*square)
        x, y = to_web.transform(frame.origin[0] + east, frame.origin[1] + north)
        picture = shown(Background(raster, lambda: at), *square)
        assert_in_place(picture, (0.5 + x / WORLD_M) * pixels, (0.5 - y / WORLD_M) * pixels)


@pytest.mark.parametrize("crs", ["EPSG:2056", "EPSG:32632", "EPSG:32633"])
def test_a_geotiff_is_placed_as_proj_places_it_even_turned(
    tmp_path: Path, opened: Callable[[Path], Raster], frame: LocalFrame, crs: str
) -> None:
    at = write_geotiff(tmp_path / "map.tif", frame, crs)
    raster = opened(tmp_path / "map.tif")
    assert raster.attribution == "© Maps"
    raster.is_photo = False  # so that colours are exact
    place = placed(frame)
    for square in ((0, 0, -1), (1, -1, 0)):
        east, north = places(*square)
        geodetic = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
        lon, lat = geodetic.transform(frame.origin[0] + east, frame.origin[1] + north)
        x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(lon, lat)
        inverse = ~at
        columns, rows = (inverse.a * x + inverse.b * y + inverse.c), (inverse.d * x + inverse.e * y + inverse.f)
        assert_in_place(shown(Background(raster, lambda: place), *square), columns, rows)


def test_beyond_the_map_and_far_from_its_place_nothing_is_painted(
    tmp_path: Path, opened: Callable[[Path], Raster], frame: LocalFrame
) -> None:
    write_mbtiles(tmp_path / "map", frame)
    place: Placement | None = None
    background = Background(opened(tmp_path / "map"), lambda: place)
    assert background.picture(0, 0, 0) is None  # live has not said where its map lies
    assert background.plain()["place"] is None
    place = placed(frame)
    assert background.picture(0, 0, 0) is not None
    assert background.picture(0, 40, 0) is None
    assert background.picture(-7, 0, 0) is None  # more tiles than one picture may join
    assert background.picture(-7, 9, 0) is None
    edge = shown(background, -1, 1, 0)  # 512 to 1024 m to the east
    assert {0.0, 255.0} == set(np.unique(edge[..., 3]))
    assert background.trouble == ""


def test_pictures_that_are_kept_are_bounded(
    tmp_path: Path, opened: Callable[[Path], Raster], frame: LocalFrame, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(background_module, "KEPT_BYTES", 200_000)
    write_mbtiles(tmp_path / "map", frame)
    place = placed(frame)
    background = Background(opened(tmp_path / "map"), lambda: place)
    for x in range(-8, 8):
        background.picture(2, x, 0)
    assert sum(len(data or b"") for data in background._kept.values()) <= 200_000
    assert background._bytes == sum(len(data or b"") for data in background._kept.values())


def write_other_base(path: Path, frame: LocalFrame) -> None:
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE gpkg_contents (name text)")
    base.close()


def write_large_tile(path: Path, frame: LocalFrame) -> None:
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE metadata (name text, value text)")
        base.execute("CREATE TABLE tiles (zoom_level integer, tile_column integer, tile_row integer, tile_data blob)")
        large = as_file(np.zeros((MOST_TILE_PIXELS * 2, MOST_TILE_PIXELS * 2, 3), np.uint8), "PNG")
        base.execute("INSERT INTO tiles VALUES (0, 0, 0, ?)", (large,))
    base.close()


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda path, frame: None, "No such file"),
        (lambda path, frame: path.write_text("<svg>"), "neither MBTiles, PMTiles nor GeoTIFF"),
        (write_other_base, "no such table: metadata"),
        (lambda path, frame: path.write_bytes(b"SQLite format 3\0" + b"x" * 500), "no MBTiles"),
        (lambda path, frame: write_mbtiles(path, frame, "pbf"), "holds pbf and not pictures"),
        (write_large_tile, "2048 by 2048 pixels"),
        (lambda path, frame: write_pmtiles(path, frame, TileType.MVT), "holds MVT and not pictures"),
        (lambda path, frame: path.write_bytes(b"PMTiles\3" + b"\xff" * 200), "cannot be read"),
        (lambda path, frame: path.write_bytes(b"II*\0" + b"\xff" * 200), "no GeoTIFF"),
        (lambda path, frame: write_geotiff(path, frame, "EPSG:2056", crs=None), "gdal_edit.py -a_srs"),
        (lambda path, frame: write_geotiff(path, frame, "EPSG:2056", dtype="uint16"), "gdal_translate -ot Byte"),
    ],
)
def test_a_file_that_is_no_map_is_refused_with_what_would_be_right(
    tmp_path: Path, frame: LocalFrame, write: Callable[[Path, LocalFrame], None], words: str
) -> None:
    path = tmp_path / "map"
    write(path, frame)
    with pytest.raises(UserError) as refused:
        open_raster(path)
    assert words in str(refused.value)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)
    assert refused.value.exit_code == ExitCode.USAGE


def test_a_large_geotiff_needs_overviews(tmp_path: Path, frame: LocalFrame) -> None:
    sparse = {"width": 9000, "height": 16, "sparse_ok": True, "crs": "EPSG:2056", "count": 3, "dtype": "uint8"}
    with rasterio.open(
        tmp_path / "map.tif",
        "w",
        driver="GTiff",
        **sparse,
        transform=rasterio.Affine(1.0, 0.0, 2.7e6, 0.0, -1.0, 1.2e6),
    ):
        pass
    with pytest.raises(UserError, match="gdaladdo"):
        open_raster(tmp_path / "map.tif")


def test_tiles_that_are_damaged_leave_holes_and_are_told(
    tmp_path: Path, opened: Callable[[Path], Raster], frame: LocalFrame
) -> None:
    path = tmp_path / "map"
    write_mbtiles(path, frame)
    place = placed(frame)
    background = Background(opened(path), lambda: place)
    with sqlite3.connect(path) as base:
        base.execute("UPDATE tiles SET tile_data = ?", (b"nothing",))
    base.close()
    assert background.picture(0, 0, 0) is None
    assert "cannot be read" in background.plain()["trouble"]


def test_tiles_are_read_from_a_folder_that_may_not_be_written_to(
    tmp_path: Path, opened: Callable[[Path], Raster], frame: LocalFrame, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A database with a write-ahead log, as some programs leave it; root may write everywhere, so that it is told."""
    path = tmp_path / "map"
    write_mbtiles(path, frame)
    base = sqlite3.connect(path)
    base.execute("PRAGMA journal_mode = wal")
    base.close()
    monkeypatch.setattr("swath.daemon.console.rasters.os.access", lambda *_: False)
    before = sorted(tmp_path.iterdir())
    place = placed(frame)
    assert Background(opened(path), lambda: place).picture(0, 0, 0) is not None
    assert sorted(tmp_path.iterdir()) == before  # no log of SQLite beside it


def test_an_attribution_becomes_text() -> None:
    assert as_text('<a href="https://e.x/">© A&amp;B</a>\n<script>alert(1)</script>') == "© A&B alert(1)"
    assert len(as_text("x" * 5000)) == 200


def test_the_console_serves_the_map_by_numbers_alone(tmp_path: Path, frame: LocalFrame) -> None:
    live = tmp_path / "live"
    one = np.ones((128, 128), np.uint32)
    write_map(live, {(0, 0): {"points": one}}, placement=frame.placement())
    write_mbtiles(tmp_path / "map.mbtiles", frame)
    with console(tmp_path, "--background", tmp_path / "map.mbtiles") as (asked, _):
        found = asked.snapshot()["background"]
        assert (found["name"], found["attribution"], found["trouble"]) == ("map.mbtiles", "© Maps", "")
        assert isinstance(found["place"], int)
        picture = asked.get("/background/0/0/-1.png")
        assert (picture.status, picture.headers["content-type"]) == (200, "image/png")
        assert asked.get("/background/0/90/0.png").status == 204
        for path in ("/background/map.mbtiles", "/background/0/0/..%2fmap.mbtiles", "/background/9/0/0.png"):
            assert asked.get(path).status == 404, path


def test_a_wrong_map_ends_the_console_as_a_wrong_configuration_does(tmp_path: Path) -> None:
    (tmp_path / "swath.toml").write_text(
        '[session]\nname = "a"\ndirectory = "."\n[raw.camera]\ntransport = "udp:127.0.0.1:9"\n'
        '[console]\nbackground = "swath.toml"\n'
    )
    run = swath("console", str(tmp_path / "swath.toml"))
    assert run.returncode == 2
    assert run.stderr.count("\n") == 1
    assert f"[console] background: {tmp_path}/swath.toml: is neither MBTiles" in run.stderr
