"""The file of an error model beside a run's points: JSON, with what is needed to find a point's unit."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from swath.daemon.errors import UserError
from swath.georef.arrays import FloatArray, Int64Array
from swath.georef.error_model.model import ErrorModel, ErrorModelError
from swath.georef.error_model.state import model_of_state, state_of

ENDING = ".error_model.json"
RECORD = "swath", 2  # user and number of the record in files of points


@dataclass(frozen=True, eq=False)
class ModelFile:
    """A model, and how the points of its run tell their unit and their unit of length.

    Attributes:
        channels: number of each scanner in the points' scanner channel.
        unit_m: (3,) metres in a unit of easting, northing and height.
        crs: WKT of the points.
        software, session: that wrote it, and of which flight.
    """

    model: ErrorModel
    channels: dict[str, int]
    unit_m: FloatArray
    crs: str
    software: str
    session: str

    def units_of(self, strips: Int64Array, channels: Int64Array) -> Int64Array:
        """Return the numbers (n,) of the units of points, by their source ids and scanner channels (n,).

        Raises:
            ErrorModelError: the model has no such strip or scanner.
        """
        names = {number: name for name, number in self.channels.items()}
        units = np.empty(len(strips), np.int64)
        for strip, channel in sorted(set(zip(strips.tolist(), channels.tolist(), strict=True))):
            if channel not in names:
                known = ", ".join(map(str, sorted(names)))
                raise ErrorModelError(f"the error model has no scanner channel {channel}; it has {known}")
            units[(strips == strip) & (channels == channel)] = self.model.unit_of(strip, names[channel])
        return units

    def text(self) -> str:
        """Return the content of the file, and of the record in files of points."""
        content: dict[str, Any] = {
            "software": self.software,
            "session": self.session,
            "crs": self.crs,
            "unit_m": self.unit_m.tolist(),
            "scanners": self.channels,
            **state_of(self.model),
        }
        return json.dumps(content, ensure_ascii=False) + "\n"


def read_model(path: Path) -> ModelFile:
    """Read a file.

    Raises:
        UserError: it cannot be read, or is no error model; one line.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}; swath georef --error-model writes it beside the points") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: is no error model; write it again with swath georef --error-model") from error
    return model_of_text(text, path)


def model_of_text(text: str, path: Path) -> ModelFile:
    """Return the model of a file's content; ``path`` is for errors, which are those of `read_model`."""
    try:
        content = json.loads(text)
        if not isinstance(content, Mapping):
            raise ErrorModelError("is no error model of swath georef")
        model = model_of_state(content)
        channels = {str(name): int(number) for name, number in content["scanners"].items()}
        unit_m = np.array(content["unit_m"], np.float64).reshape(3)
    except ErrorModelError as error:
        raise UserError(f"{path}: {error}") from error
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        raise UserError(
            f"{path}: is no error model: {error}; write it again with swath georef --error-model"
        ) from error
    texts = (str(content.get(name, "")) for name in ("crs", "software", "session"))
    return ModelFile(model, channels, unit_m, *texts)
