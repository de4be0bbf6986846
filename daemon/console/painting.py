"""Paints the map as pictures of 256 × 256 pixels: height, density, strip difference or age, with gaps and water."""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.daemon.png import png
from swath.daemon.processing.live.tiles import Placement, TileReader, View

PIXELS = 256
ZOOMS = range(-7, 4)  # one pixel is 2^-zoom metres wide
KEPT = 512  # pictures
GAP_M = 25.0  # a hole not wider than this between points is a gap; a wider one is not flown yet
GAP_PIXELS = 3  # or so many pixels, where these are larger
MARGIN = 28  # pixels around a picture that its gaps and shades depend on
DIFFERENCE_M = 0.15
AGE_S = 1800.0
DENSITIES = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # points per m²
LIGHT = np.array([-0.5, 0.5, 0.7071]) / np.linalg.norm([-0.5, 0.5, 0.7071])  # from north-west, half way up
DARKEST, BRIGHTEST = 0.45, 1.15  # of the brightness of level ground; beyond these the ramp's colours cannot be told
OVERVIEW = 400  # cells of the view that the range of heights is taken from

# Ramps whose lightness rises steadily, so that they order the values for the colour-blind too.
RAMPS = {
    "height": ("#30123b", "#2e3f8f", "#27658c", "#2a8a7f", "#58ab5c", "#a9c43e", "#eede5a", "#fff7c0"),
    "density": ("#5a0f1e", "#b0282e", "#e8743b", "#f4c95d", "#86b66b", "#2f8c74", "#1f5f8b"),
    "difference": ("#053061", "#2f79b5", "#8ec2dd", "#f2f2f2", "#f6b394", "#cb4b42", "#67001f"),
    "age": ("#fff7c0", "#f4c95d", "#e8743b", "#b0282e", "#5a0f1e", "#2a1a2e"),
}
GAP, WATER = (215, 25, 28, 255), (127, 179, 213, 255)
Picture = NDArray[np.uint8]


@dataclass(slots=True)
class Painter:
    """Paints pictures of a live folder's map and keeps the latest.

    One thread at a time paints, because the reader keeps what it has read.
    """

    folder: Path
    _reader: TileReader = field(init=False)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _kept: OrderedDict[tuple[Any, ...], bytes] = field(default_factory=OrderedDict)
    _steps: tuple[tuple[int, int], NDArray[np.int64]] = ((-1, -1), np.zeros((3, 0), np.int64))
    _heights: tuple[int, tuple[float, float]] = (-1, (0.0, 1.0))
    _placed: tuple[Any, Placement | None] = (None, None)

    def __post_init__(self) -> None:
        self._reader = TileReader(self.folder)

    def local_m(self, geometry: Mapping[str, Any]) -> dict[str, Any] | None:
        """Return lines and area, given in degrees as in ``lines.json``, as east and north in metres.

        None: the map's place is not known.
        """
        placement = self.placement
        if placement is None:
            return None

        def placed(places: list[list[float]]) -> list[list[float]]:
            lat_lon = np.array([place[:2] for place in places], float).reshape(-1, 2)
            found: list[list[float]] = placement.local(lat_lon).round(2).tolist()
            return found

        return {
            "lines": {name: placed(places) for name, places in geometry["lines"].items()},
            "area": [[placed(ring) for ring in polygon] for polygon in geometry["area"]],
        }

    @property
    def placement(self) -> Placement | None:
        """Place of the map on the earth, the same object while it stays there; None: not known."""
        said = self._reader.index.get("placement")
        if said != self._placed[0]:
            self._placed = said, Placement.of(self._reader.index)
        return self._placed[1]

    @property
    def generation(self) -> int:
        """Number of the map; another one has another frame."""
        return self._reader.generation

    @property
    def extent_m(self) -> tuple[float, float, float, float] | None:
        """West, south, east and north edge of the map in the frame ``local``, as of the last reading; None: no map."""
        return self._reader.extent_m()

    def legend(self) -> dict[str, Any]:
        """Return for each layer its title, its colours and the values at their ends; read what has changed.

        ``zero_m`` of the heights is that of the map's origin.
        """
        with self._lock:
            self._reader.refresh()
            low, high = self._height_range()
            title, zero_m = self._height_datum()
        low, high = low + zero_m, high + zero_m
        also = [["gap", "gap"], ["water", "no return (water)"]]
        return {
            "height": _entry(title, "height", f"{low:.0f} m", f"{high:.0f} m", also) | {"zero_m": zero_m},
            "density": _entry("points per m²", "density", "0", f"{DENSITIES[-1]:.0f} and more", also),
            "difference": _entry(
                "strip difference", "difference", f"−{100 * DIFFERENCE_M:.0f} cm", f"+{100 * DIFFERENCE_M:.0f} cm", []
            ),
            "age": _entry("age", "age", "now", f"{AGE_S / 60:.0f} min", []),
        }

    def _height_datum(self) -> tuple[str, float]:
        """Return what heights count from, in words, and the height of the frame's origin above that, m."""
        index = self._reader.index
        origin, units, crs = index.get("origin"), index.get("origin_unit_m"), str(index.get("crs", ""))
        is_given = isinstance(origin, list) and isinstance(units, list) and len(origin) == len(units) == 3
        if not is_given or "4978" in crs:  # without a map's CRS the frame is level at the first position
            return "height above the map's origin", 0.0
        assert origin is not None
        assert units is not None
        return f"height in {crs}", float(origin[2]) * float(units[2])

    def picture(self, layer: str, zoom: int, x: int, y: int) -> bytes:
        """Return a PNG of one square of the map, clear where nothing is.

        Args:
            layer: a name of `RAMPS`.
            zoom: of `ZOOMS`.
            x, y: square, to the east and to the south of the origin.
        """
        with self._lock:
            self._reader.refresh()
            newer = self._reader.sequence // 30 if layer == "age" else 0
            key = layer, zoom, x, y, self._reader.generation, self._newest(zoom, x, y), self._height_range(), newer
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
            made = self._paint(layer, zoom, x, y)
            self._kept[key] = made
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
            return made

    def _edges_m(self, zoom: int, x: int, y: int, margin: int) -> tuple[float, float, float, float]:
        pixel_m = 2.0**-zoom
        west, north = x * PIXELS - margin, -y * PIXELS + margin
        side = PIXELS + 2 * margin
        return west * pixel_m, (north - side) * pixel_m, (west + side) * pixel_m, north * pixel_m

    def _newest(self, zoom: int, x: int, y: int) -> int:
        """Return the newest step of the tiles that a picture shows."""
        west, south, east, north = self._edges_m(zoom, x, y, MARGIN)
        reader = self._reader
        key = reader.generation, reader.sequence
        if self._steps[0] != key:
            rows = [(column, row, at) for (column, row), at in reader.changed().items()]
            self._steps = key, np.array(rows, np.int64).reshape(-1, 3).T
        column, row, at = self._steps[1]
        side_m = 128 * reader.cell_m
        inside = (column * side_m < east) & ((column + 1) * side_m > west)
        inside &= (row * side_m < north) & ((row + 1) * side_m > south)
        return int(at[inside].max(initial=0))

    def _height_range(self) -> tuple[float, float]:
        """Return the 2 % and 98 % quantiles of the heights, in steps that rarely change."""
        sequence = self._reader.sequence // 10
        if self._heights[0] == sequence:
            return self._heights[1]
        extent = self._reader.extent_m()
        view = None
        if extent is not None:
            west, south, east, north = extent
            view = self._reader.view(*extent, max(east - west, north - south) / OVERVIEW, ("height_m", "points"))
        heights = np.empty(0) if view is None else view.layers["height_m"][np.isfinite(view.layers["height_m"])]
        if len(heights):
            low, high = np.quantile(heights, [0.02, 0.98])
            low, high = 5.0 * math.floor(low / 5.0), 5.0 * math.ceil(high / 5.0)
            self._heights = sequence, (float(low), float(max(high, low + 5.0)))
        return self._heights[1]

    def _paint(self, layer: str, zoom: int, x: int, y: int) -> bytes:
        edges = self._edges_m(zoom, x, y, MARGIN)
        pixel_m = 2.0**-zoom
        names = ("points", "no_return", "height_m", *(("difference_m",) if layer == "difference" else ("gps_s",)))
        view = self._reader.view(*edges, pixel_m, names)
        image: Picture = np.zeros((PIXELS, PIXELS, 4), np.uint8)
        if view is not None:
            layers = _resampled(view, edges, pixel_m)
            large = self._colours(layer, layers, view.cell_m, pixel_m)
            image = large[MARGIN:-MARGIN, MARGIN:-MARGIN]
        return png(image)

    def _colours(self, layer: str, layers: dict[str, NDArray[Any]], cell_m: float, pixel_m: float) -> Picture:
        points = layers["points"]
        covered = points > 0
        image: Picture = np.zeros((*points.shape, 4), np.uint8)
        if layer == "height":
            low, high = self._heights[1]
            image = coloured("height", (layers["height_m"] - low) / (high - low))
            light = shade(layers["height_m"], max(pixel_m, cell_m))[..., np.newaxis]
            image[..., :3] = (image[..., :3] * light).astype(np.uint8)
        elif layer == "density":
            classes = np.searchsorted(DENSITIES[1:], points / cell_m**2, side="right")
            image = coloured("density", classes / (len(DENSITIES) - 1))
        elif layer == "difference":
            part = 0.5 + 0.5 * layers["difference_m"] / DIFFERENCE_M
            image = coloured("difference", np.where(covered & np.isnan(part), 2.0, part))
            image[covered & np.isnan(layers["difference_m"])] = (150, 156, 160, 255)
            image[~covered] = 0
            return image
        else:
            newest = int(self._reader.index.get("newest_gps_s", 0)) or int(layers["gps_s"].max(initial=0))
            image = coloured("age", (newest - layers["gps_s"]) / AGE_S)
            image[~covered] = 0
            return image
        image[~covered] = 0
        water = ~covered & (layers["no_return"] > 0)
        image[water] = WATER
        reach = max(GAP_PIXELS, min(MARGIN - 1, round(GAP_M / pixel_m)))
        image[gaps(covered | water, reach)] = GAP
        return image


def _entry(title: str, ramp: str, low: str, high: str, also: list[list[str]]) -> dict[str, Any]:
    return {"title": title, "colours": list(RAMPS[ramp]), "low": low, "high": high, "also": also}


def _resampled(view: View, edges: tuple[float, float, float, float], pixel_m: float) -> dict[str, NDArray[Any]]:
    """Return the layers at the pixels' centres, rows from north to south; nothing beyond the view."""
    west, _, _, north = edges
    side = PIXELS + 2 * MARGIN
    centres = np.arange(side) + 0.5
    columns = np.floor((west + centres * pixel_m - view.west_m) / view.cell_m).astype(np.int64)
    rows = np.floor((north - centres * pixel_m - view.south_m) / view.cell_m).astype(np.int64)
    inside = ((rows >= 0) & (rows < view.shape[0]))[:, None] & ((columns >= 0) & (columns < view.shape[1]))[None, :]
    at = np.ix_(rows.clip(0, view.shape[0] - 1), columns.clip(0, view.shape[1] - 1))
    return {name: np.where(inside, values[at], _nothing(values)) for name, values in view.layers.items()}


def _nothing(values: NDArray[Any]) -> float | int:
    return math.nan if values.dtype.kind == "f" else 0


def coloured(ramp: str, part: NDArray[Any]) -> Picture:
    """Return RGBA of values from 0 to 1, by straight lines between the ramp's colours; clear where nan."""
    stops = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in RAMPS[ramp]], float)
    at = np.linspace(0.0, 1.0, len(stops))
    known = np.isfinite(part)
    values = np.where(known, part, 0.0)
    image = np.zeros((*part.shape, 4), np.uint8)
    for band in range(3):
        image[..., band] = np.rint(np.interp(values, at, stops[:, band]))
    image[..., 3] = np.where(known, 255, 0)
    return image


def shade(height_m: NDArray[Any], cell_m: float) -> NDArray[np.float64]:
    """Return how bright a surface is, up to 1, of heights whose rows run from north to south.

    The light stands where it does in the quick look, which shades by Matplotlib; the console starts without that.
    """
    filled = np.where(np.isfinite(height_m), height_m, 0.0)
    south, east = np.gradient(filled, cell_m)
    known = np.isfinite(height_m)
    known[1:-1, 1:-1] &= known[:-2, 1:-1] & known[2:, 1:-1] & known[1:-1, :-2] & known[1:-1, 2:]
    normal = np.stack([-east, south, np.ones_like(east)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    of_level = np.clip((normal @ LIGHT) / LIGHT[2], DARKEST, BRIGHTEST)
    return np.where(known, of_level, 1.0) / BRIGHTEST


def gaps(covered: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Return the empty pixels with covered ones on both sides, in a row or in a column, at most ``reach`` apart."""
    return ~covered & (_between(covered, reach) | _between(covered.T, reach).T)


def _between(covered: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    number = np.arange(covered.shape[1])
    far = 4 * covered.shape[1]
    before = np.maximum.accumulate(np.where(covered, number, -far), axis=1)
    after = np.minimum.accumulate(np.where(covered, number, far)[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(after - before - 1 <= reach)
