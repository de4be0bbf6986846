"""Paints a map of the user behind live's map: squares of live's frame, filled from the user's file."""

from __future__ import annotations

import io
import threading
import zlib
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from PIL import Image

from swath.daemon.console.rasters import NODES, PIXELS, Picture, Raster
from swath.daemon.errors import one_line
from swath.daemon.processing.live.tiles import Placement

KEPT_BYTES = 16 << 20  # of finished pictures
FAR_M = 60_000.0  # from the map's place its polynomials are not good any more
QUALITY = 88


@dataclass(slots=True)
class Background:
    """Pictures of the user's map, each one made once and kept while there is room.

    Attributes:
        trouble: why some of it cannot be shown; empty: all of it can.
    """

    raster: Raster
    placement: Callable[[], Placement | None]
    trouble: str = ""
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _kept: OrderedDict[tuple[int, int, int], bytes | None] = field(default_factory=OrderedDict)
    _bytes: int = 0
    _of: Placement | None = None

    def plain(self) -> dict[str, Any]:
        """Return what the page shows of it; ``place`` changes with the map's, and is None while that is not known."""
        placement, raster = self.placement(), self.raster
        place = None if placement is None else zlib.crc32(placement.to_local.tobytes())
        return {"name": raster.name, "attribution": raster.attribution, "trouble": self.trouble, "place": place}

    def picture(self, zoom: int, x: int, y: int) -> bytes | None:
        """Return a JPEG or PNG of one square of the map, placed as those of `Painter`; None: nothing is there."""
        with self._lock:
            placement = self.placement()
            if placement is None:
                return None
            if placement is not self._of:
                self._of, self._bytes = placement, 0
                self._kept.clear()
            key = zoom, x, y
            if key not in self._kept:
                made = self._made(placement, zoom, x, y)
                self._kept[key] = made
                self._bytes += len(made or b"")
                while self._bytes > KEPT_BYTES or len(self._kept) > 4096:
                    _, old = self._kept.popitem(last=False)
                    self._bytes -= len(old or b"")
            else:
                self._kept.move_to_end(key)
            return self._kept.get(key)

    def _made(self, placement: Placement, zoom: int, x: int, y: int) -> bytes | None:
        pixel_m = 2.0**-zoom
        east, north = np.meshgrid((x * PIXELS + NODES + 0.5) * pixel_m, -(y * PIXELS + NODES + 0.5) * pixel_m)
        places = np.stack([east.ravel(), north.ravel()], axis=1)
        if np.abs(places - (placement.east_m, placement.north_m)).max() > FAR_M:
            return None
        lat_lon = placement.geodetic(places).reshape(*east.shape, 2)
        try:
            picture = self.raster.sample(lat_lon[..., 0], lat_lon[..., 1], pixel_m)
        except (OSError, ValueError) as error:
            self.trouble = one_line(f"the map's background cannot be read: {error}")
            return None
        return None if picture is None or not picture[..., 3].any() else encoded(picture, photo=self.raster.is_photo)


def encoded(picture: Picture, *, photo: bool) -> bytes:
    """Return a picture (rows, columns, 4) as JPEG if it is a photo without clear parts, else as PNG."""
    file = io.BytesIO()
    if photo and (picture[..., 3] == 255).all():
        Image.fromarray(picture[..., :3]).save(file, "JPEG", quality=QUALITY)
    else:
        Image.fromarray(picture).save(file, "PNG", compress_level=1)
    return file.getvalue()
