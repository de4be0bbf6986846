"""Keys that only one driver knows: the table ``[<kind>.<name>.options]`` and the driver's own model of it."""

from __future__ import annotations

from typing import TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from swath.drivers.parser import DeviceSettings, DriverSettingsError


class Options(BaseModel):
    """Base of a driver's own keys: a subclass has a field for each, with bounds, default and description.

    As in every table of the configuration, an unknown key is an error, and text is never converted to a number. A list
    of the file is a ``list``, a choice a ``Literal``.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


Model = TypeVar("Model", bound=Options)


def read_options(settings: DeviceSettings, model: type[Model]) -> Model:
    """Return the table ``options`` of a device, with the defaults filled in.

    Args:
        settings: of the device.
        model: the driver's own, as `Driver.options` names it.

    Raises:
        DriverSettingsError: a key or its value is wrong, as it may be in a log of another version of the driver.
    """
    try:
        return model.model_validate(dict(settings.config.get("options") or {}))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in ("options", *first["loc"]))
        more = "" if error.error_count() == 1 else f" (and {error.error_count() - 1} more)"
        raise DriverSettingsError(f"{key}: {first['msg']}{more}; correct the table options") from None
