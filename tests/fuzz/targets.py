"""Lists all targets by name."""

from __future__ import annotations

from collections.abc import Callable

from tests.fuzz.asked import asked_targets
from tests.fuzz.device_files import device_file_targets
from tests.fuzz.engine import Target
from tests.fuzz.exports import export_targets
from tests.fuzz.files import file_targets
from tests.fuzz.followed import followed_targets
from tests.fuzz.logs import log_targets
from tests.fuzz.office import office_targets
from tests.fuzz.office_files import office_file_targets
from tests.fuzz.parsers import parser_targets
from tests.fuzz.rasters import raster_targets


def all_targets() -> dict[str, Callable[[], Target]]:
    """Return a function that builds each target: parsers of every driver, and readers of all other foreign input."""
    return {
        **dict(parser_targets()),
        **dict(log_targets()),
        **dict(followed_targets()),
        **dict(file_targets()),
        **dict(export_targets()),
        **dict(device_file_targets()),
        **dict(asked_targets()),
        **dict(office_targets()),
        **dict(office_file_targets()),
        **dict(raster_targets()),
    }
