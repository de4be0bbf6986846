"""The file of an error model beside a run's points: JSON, with what is needed to find a point's unit."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from swath.daemon.errors import UserError
from swath.georef.arrays import FloatArray
from swath.georef.error_model.model import ErrorModel, ErrorModelError
from swath.georef.error_model.state import model_of_state, state_of

ENDING = ".error_model.json"


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

    def write(self, path: Path) -> None:
        """Write the file; OSError where that fails."""
        content: dict[str, Any] = {
            "software": self.software,
            "session": self.session,
            "crs": self.crs,
            "unit_m": self.unit_m.tolist(),
            "scanners": self.channels,
            **state_of(self.model),
        }
        path.write_text(json.dumps(content, ensure_ascii=False) + "\n", encoding="utf-8")


def read_model(path: Path) -> ModelFile:
    """Read a file.

    Raises:
        UserError: it cannot be read, or is no error model; one line.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content, Mapping):
            raise ErrorModelError("is no error model of swath georef")
        model = model_of_state(content)
        channels = {str(name): int(number) for name, number in content["scanners"].items()}
        unit_m = np.array(content["unit_m"], np.float64).reshape(3)
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}; swath georef --error-model writes it beside the points") from error
    except ErrorModelError as error:
        raise UserError(f"{path}: {error}") from error
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        raise UserError(
            f"{path}: is no error model: {error}; write it again with swath georef --error-model"
        ) from error
    texts = (str(content.get(name, "")) for name in ("crs", "software", "session"))
    return ModelFile(model, channels, unit_m, *texts)
