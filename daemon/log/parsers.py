"""Makes the parsers of a log's sources from the configuration and files that the log itself stores."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from pydantic import ValidationError

from swath.daemon.config.config import DRIVERS_NAME, Config, DeviceTable, attachment_name
from swath.daemon.config.tables import Tables
from swath.daemon.errors import one_line
from swath.daemon.log.format import LogError
from swath.drivers.driver import UnknownProtocolError
from swath.drivers.parser import DriverSettingsError, Parser
from swath.georef.toml_tables import TomlError, toml_tables


def stored_config(attachments: Mapping[str, bytes]) -> Config | None:
    """Return the configuration that was used for the recording; None if the log has none.

    Raises:
        LogError: it is not a configuration of this version.
    """
    stored = attachments.get("config.toml")
    if stored is None:
        return None
    try:
        text = stored.decode()
        tables = Tables.model_validate(toml_tables(text))
    except (UnicodeDecodeError, TomlError, ValidationError) as error:
        raise LogError(f"config.toml in the log: {str(error).splitlines()[0]}") from error
    return Config(tables, Path("config.toml"), text, _recorded_with(attachments.get(DRIVERS_NAME, b"{}")))


def _recorded_with(stored: bytes) -> dict[str, str]:
    """Return name and version of packages by ``kind/protocol``; what is not of that form is passed over."""
    try:
        found = json.loads(stored)
    except ValueError:
        return {}
    entries = found.items() if isinstance(found, dict) else ()
    return {
        key: one_line(f"{value.get('package', '?')} {value.get('version', '')}").strip()
        for key, value in entries
        if isinstance(value, dict)
    }


def stored_drivers(attachments: Mapping[str, bytes]) -> tuple[dict[str, Callable[[], Parser]], list[str]]:
    """Return callables that make each source's parser, by source (``kind/name``), and a line for each obstacle.

    The callables raise DriverSettingsError if the driver cannot work with the settings.
    """
    try:
        config = stored_config(attachments)
    except LogError as error:  # of another version: the units in the log can still be counted
        return {}, [f"{error}; units are counted, not decoded"]
    if config is None:
        return {}, ["the log holds no configuration: units are counted, not decoded"]
    makers: dict[str, Callable[[], Parser]] = {}
    troubles: list[str] = []

    def contents(name: str, table: DeviceTable) -> dict[str, bytes]:
        files = {key: attachments.get(attachment_name(key, name, path)) for key, path in config.files_of(table).items()}
        return {key: data for key, data in files.items() if data is not None}

    for kind, name, table in config.device_tables():
        settings = config.settings_with(kind, name, table, contents)
        try:
            makers[settings.source] = partial(config.driver_of(kind, table).make_parser, settings)
        except UnknownProtocolError as error:
            troubles.append(f"{settings.source}: {error}")
    return makers, troubles


def stored_parsers(attachments: Mapping[str, bytes]) -> tuple[dict[str, Parser], list[str]]:
    """Return a parser for each source (``kind/name``), and a line for every source that has none."""
    makers, troubles = stored_drivers(attachments)
    parsers: dict[str, Parser] = {}
    for source, make in makers.items():
        try:
            parsers[source] = make()
        except DriverSettingsError as error:
            troubles.append(f"{source}: {error}")
    return parsers, troubles
