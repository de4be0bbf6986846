"""Reads the configuration file and reports each fault in one line: file, key, the value found, a correct value."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from swath.daemon.config.checks import check_devices
from swath.daemon.config.config import Config
from swath.daemon.config.faults import describe
from swath.daemon.config.tables import Tables
from swath.daemon.errors import ConfigError, ExitCode, UserError
from swath.georef.text_encoding import decoded
from swath.georef.toml_tables import TomlError, toml_tables

MAX_CONFIG_BYTES = 4 * 1024 * 1024  # far above any real configuration; a log given by mistake is not read whole


def load_config(path: str | Path, *, to_record: bool = False, with_plan: bool = False) -> Config:
    """Read and validate a configuration file and all files that it names.

    Args:
        path: the file.
        to_record: allow devices whose driver's package cannot be loaded, and give them the protocol ``raw``; the log
            stores the flight plan, so that its files must be there.
        with_plan: the files of the flight plan must be there; otherwise nothing is missed without them.

    Raises:
        ConfigError: the configuration is wrong; it has one line for each fault.
        UserError: the file cannot be read.
    """
    file = Path(path)
    try:
        with file.open("rb") as stream:
            content = stream.read(MAX_CONFIG_BYTES + 1)
    except OSError as error:
        text = f"{file}: {error.strerror}; give the path of a configuration file"
        raise UserError(text, ExitCode.USAGE) from error
    if len(content) > MAX_CONFIG_BYTES:
        raise ConfigError(f"{file}: larger than {MAX_CONFIG_BYTES} bytes; want a TOML configuration")
    try:
        text = decoded(content)
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise ConfigError(f"{file}: line {line}: not UTF-8 text; want a TOML file") from error
    return parse_config(text, file, to_record=to_record, with_plan=with_plan)


def parse_config(text: str, path: Path, *, to_record: bool = False, with_plan: bool = False) -> Config:
    """Validate the text of a configuration whose files lie beside ``path``; options as in `load_config`.

    Raises:
        ConfigError: the configuration is wrong; it has one line for each fault.
    """
    try:
        table = toml_tables(text)
    except TomlError as error:
        raise ConfigError(f"{path}: {error}") from error
    return validate(table, path, text, to_record=to_record, with_plan=with_plan)


def validate(
    table: Mapping[str, Any], path: Path, text: str, *, to_record: bool = False, with_plan: bool = False
) -> Config:
    """Validate a parsed configuration; ``text`` is the text that it was parsed from, options as in `load_config`.

    Raises:
        ConfigError: the configuration is wrong; it has one line for each fault.
    """
    try:
        tables = Tables.model_validate(table)
    except ValidationError as error:
        lines = [describe(details) for details in error.errors(include_url=False)]
        raise ConfigError([f"{path}: {line}" for line in lines]) from error
    config = Config(tables, path, text)
    config = config.as_recorded() if to_record else config
    lines = check_devices(config, with_plan=to_record or with_plan)
    if lines:
        raise ConfigError([f"{path}: {line}" for line in lines])
    return config
