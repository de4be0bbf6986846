"""The file that says what a calibration estimates: ``--model FILE.toml``.

Keys are those of a calibration file (CONVENTIONS), validated as the configuration is.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BeforeValidator,
    Field,
    PlainValidator,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from swath.daemon.config.load import describe, shown
from swath.daemon.config.tables import Section
from swath.daemon.errors import ConfigError
from swath.daemon.text_files import text_of
from swath.georef.scanner.calibration import MOST, PARAMETERS
from swath.georef.toml_tables import TomlError, toml_tables

SUFFIX = ".toml"
PRIOR = "prior"
_ANY_STATE = f'want "free", "fixed" or {{ {PRIOR} = SIGMA }}, above 0 and in the unit of the key'


def _state(value: object) -> str | float:
    """``free``, ``fixed``, or the sigma of a prior in the key's unit."""
    if value in ("free", "fixed"):
        return str(value)
    sigma = value.get(PRIOR) if isinstance(value, dict) and len(value) == 1 else None
    if isinstance(sigma, int | float) and not isinstance(sigma, bool) and 0.0 < sigma <= sys.float_info.max:
        return float(sigma)
    got = f"{PRIOR} = {shown(value[PRIOR])}" if isinstance(value, dict) and PRIOR in value else shown(value)
    raise ValueError(f"got {got}, {_ANY_STATE}")


def _by_key(table: object) -> object:
    """With ``left.phi_deg`` as one key also where it stands without quotes, which TOML takes for a table in a table."""
    if not isinstance(table, dict):
        return table
    found: dict[str, Any] = {}
    for key, value in _flat("", table):
        if key in found:
            raise ValueError(f"{key} stands there twice; want it once")
        found[key] = value
    return found


def _flat(before: str, table: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    known = {parameter.key for parameter in PARAMETERS}
    for key, value in table.items():
        if isinstance(value, dict) and PRIOR not in value and key not in known:
            yield from _flat(f"{before}{key}.", value)
        else:
            yield f"{before}{key}", value


State = Annotated[str | float, PlainValidator(_state)]


class IbrcTable(Section):
    """``[ibrc]``: a range correction by intensity is estimated."""

    knots: list[float] = Field(description="rising intensities, at least two")
    reference: float | None = Field(None, description="the knot whose correction is 0; absent: the middle one")
    smoothness_m: float = Field(
        0.02, gt=0.0, le=10.0, description="sigma of a knot's distance from the line through its neighbours"
    )

    @field_validator("knots")
    @classmethod
    def _rising(cls, knots: list[float]) -> list[float]:
        if len(knots) < 2 or any(after <= before for before, after in pairwise(knots)):
            raise ValueError(f"got {shown(knots)}, want at least two rising intensities")
        return knots

    @field_validator("reference")
    @classmethod
    def _is_a_knot(cls, reference: float | None, info: ValidationInfo) -> float | None:
        knots = info.data.get("knots")
        if reference is not None and knots and reference not in knots:
            raise ValueError(f"got {reference:g}, want one of the knots {', '.join(f'{knot:g}' for knot in knots)}")
        return reference


class RangeOffsetTable(Section):
    """``[range_offset]``: range offsets of their own, beside that of all returns."""

    return_slots: list[int] = Field(default_factory=list, description="return numbers, from 1")
    mta_zones: list[int] = Field(default_factory=list, description="zones (pulses in air − 1), from 0")

    @field_validator("return_slots", "mta_zones")
    @classmethod
    def _once_each(cls, numbers: list[int], info: ValidationInfo) -> list[int]:
        first = 1 if info.field_name == "return_slots" else 0
        if len(set(numbers)) < len(numbers) or not all(first <= number <= MOST for number in numbers):
            raise ValueError(f"got {shown(numbers)}, want whole numbers from {first}, each once")
        return numbers

    @model_validator(mode="after")
    def _not_empty(self) -> Self:
        if not self.return_slots and not self.mta_zones:
            raise ValueError("is empty; want return_slots or mta_zones")
        return self


class BeamTable(Section):
    """``[beam]``: corrections of the beams of a spinning head are estimated."""

    estimate: list[Literal["azimuth_deg", "elevation_deg", "range_m"]] = Field(
        min_length=1, description='some of "azimuth_deg", "elevation_deg", "range_m"'
    )


class ModelTables(Section):
    """The file."""

    model: Literal["basic", "scanner", "full"] = Field("scanner", description="which parameters it begins from")
    parameters: Annotated[dict[str, State], BeforeValidator(_by_key)] = Field(
        default_factory=dict, description="by key, of all scanners or of one"
    )
    ibrc: IbrcTable | None = Field(None, description="the range correction by intensity")
    range_offset: RangeOffsetTable | None = Field(None, description="range offsets by return or zone")
    beam: BeamTable | None = Field(None, description="corrections of beams")


def read_model(file: Path) -> ModelTables:
    """What a file says.

    Raises:
        UserError: it cannot be read; ConfigError: all that is wrong with it, one line each.
    """
    try:
        return ModelTables.model_validate(toml_tables(text_of(file, "a TOML file")))
    except TomlError as error:
        raise ConfigError(f"{file}: {error}") from error
    except ValidationError as error:
        lines = [describe(details, ModelTables) for details in error.errors(include_url=False)]
        raise ConfigError([f"{file}: {line}" for line in lines]) from error
