"""Reads what a calibration estimates: from a model's name or a model file, and from options that override it.

The model file is given as ``--model FILE.toml``. Its keys are those of a calibration file (CONVENTIONS), validated as
the configuration is.
"""

from __future__ import annotations

import difflib
import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
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

from swath.calib.parameters import MODELS, ParameterOptions
from swath.daemon.config.faults import describe, shown
from swath.daemon.config.tables import Section
from swath.daemon.errors import ConfigError, ExitCode, UserError, one_line
from swath.daemon.text_files import text_of
from swath.georef.scanner.calibration import MOST, PARAMETERS
from swath.georef.toml_tables import TomlError, toml_tables

SUFFIX = ".toml"

PRIOR = "prior"

_ANY_STATE = f'want "free", "fixed" or {{ {PRIOR} = SIGMA }}, above 0 and in the unit of the key'


def _state(value: object) -> str | float:
    """Return ``free``, ``fixed``, or the sigma of a prior in the key's unit."""
    if value in ("free", "fixed"):
        return str(value)
    sigma = value.get(PRIOR) if isinstance(value, dict) and len(value) == 1 else None
    if isinstance(sigma, int | float) and not isinstance(sigma, bool) and 0.0 < sigma <= sys.float_info.max:
        return float(sigma)
    got = f"{PRIOR} = {shown(value[PRIOR])}" if isinstance(value, dict) and PRIOR in value else shown(value)
    raise ValueError(f"got {got}, {_ANY_STATE}")


def _by_key(table: object) -> object:
    """Return a table with dotted keys as ``left.phi_deg`` flat, also where TOML read them without quotes as nested
    tables.
    """
    if not isinstance(table, dict):
        return table
    found: dict[str, Any] = {}
    for key, value in _flat("", table):
        if key in found:
            raise ValueError(f"{key} is given twice; give it once")
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
    """``[ibrc]``: estimate a range correction by intensity."""

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
    """``[range_offset]``: estimate separate range offsets, beside that of all returns."""

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
    """``[beam]``: estimate corrections of the beams of a spinning head."""

    estimate: list[Literal["azimuth_deg", "elevation_deg", "range_m"]] = Field(
        min_length=1, description='some of "azimuth_deg", "elevation_deg", "range_m"'
    )


class ModelTables(Section):
    """A model file's tables."""

    model: Literal["basic", "scanner", "full"] = Field("scanner", description="which parameters it begins from")
    parameters: Annotated[dict[str, State], BeforeValidator(_by_key)] = Field(
        default_factory=dict, description="by key, of all scanners or of one"
    )
    ibrc: IbrcTable | None = Field(None, description="the range correction by intensity")
    range_offset: RangeOffsetTable | None = Field(None, description="range offsets by return or zone")
    beam: BeamTable | None = Field(None, description="corrections of beams")


def read_model(file: Path) -> ModelTables:
    """Return the tables of a model file.

    Raises:
        UserError: the file cannot be read; ConfigError: it is invalid, with one line per error.
    """
    try:
        return ModelTables.model_validate(toml_tables(text_of(file, "a TOML file")))
    except TomlError as error:
        raise ConfigError(f"{file}: {error}") from error
    except ValidationError as error:
        lines = [describe(details, ModelTables) for details in error.errors(include_url=False)]
        raise ConfigError([f"{file}: {line}" for line in lines]) from error


FREE, FIXED = "free", "fixed"
# by key in files: the name used here, and SI units per unit of the key
_PARAMETERS = {parameter.key: (parameter.name, parameter.factor) for parameter in PARAMETERS}
_BEAM_PARTS = {
    "azimuth_deg": ("azimuth_rad", math.pi / 180.0),
    "elevation_deg": ("elevation_rad", math.pi / 180.0),
    "range_m": ("range_m", 1.0),
}

Known = Mapping[str, tuple[str, float]]
States = dict[tuple[str, str], str | float]  # by scanner (empty: all) and name: FREE, FIXED, or a prior's sigma, SI


def model_of(model: str, fix: str = "", free: str = "", priors: Sequence[str] = ()) -> ParameterOptions:
    """Return the options of an adjustment from a model and keys of a calibration file as ``phi_deg`` or
    ``left.phi_deg``.

    An option overrides a file's entry for the same parameter; an option for all scanners also overrides entries for
    one.

    Args:
        model: one of `swath.calib.parameters.MODELS`, or a file (`swath.daemon.processing.calibration.model`).
        fix, free: keys, separated by commas.
        priors: ``KEY=SIGMA``, each in its key's unit; for a fixed parameter, how well its value is known.

    Raises:
        UserError: there is no such model or file, a key is not a parameter, or a sigma is invalid.
    """
    tables = _tables(model)
    request = _of_tables(tables)
    known = _PARAMETERS | _entries(request)
    configured = _states(tables.parameters.items(), f"{model}: parameters.", known)
    own = _states(((key, FREE) for key in free.split(",") if key), "--free ", known)
    sigmas = _states(map(_prior, priors), "--prior ", known)
    own |= sigmas
    own |= _states(((key, FIXED) for key in fix.split(",") if key), "--fix ", known)
    left = {at: state for at, state in configured.items() if at not in own and ("", at[1]) not in own}
    states = {f"{scanner}.{name}" if scanner else name: state for (scanner, name), state in (left | own).items()}
    held = {f"{scanner}.{name}" if scanner else name: sigma for (scanner, name), sigma in sigmas.items()}
    return replace(
        request,
        fix=frozenset(name for name, state in states.items() if state == FIXED),
        free=frozenset(name for name, state in states.items() if state == FREE),
        priors={name: state for name, state in (states | held).items() if not isinstance(state, str)},
    )


def file_of(model: str) -> Path | None:
    """Return the path of a model that is given as a file; None if it is given by its name."""
    return Path(model) if model.lower().endswith(SUFFIX) else None


def of_parameters(request: ParameterOptions) -> ParameterOptions:
    """Return the options without the entries of tables: with the parameters alone."""
    entries = {name for name, _ in _entries(request).values()}
    priors = {name: sigma for name, sigma in request.priors.items() if not {name, name.partition(".")[2]} & entries}
    return ParameterOptions(request.model, request.fix, request.free, priors)


def key_of(name: str, knots: Sequence[float] = ()) -> tuple[str, float]:
    """Return the key of an unknown for people, as ``phi_deg`` or ``ibrc.2 at 1500``, and SI units per unit of it.

    Args:
        name: the unknown without its scanner, as ``phi_rad``, ``ibrc.2``, ``beam.3.azimuth_rad``.
        knots: intensities of the knots.
    """
    before, _, last = name.rpartition(".")
    if before == "ibrc" and knots:
        return f"{name} at {knots[int(last)]:g}", 1.0
    for key, (own, factor) in (_PARAMETERS | _BEAM_PARTS).items():
        if own == last:
            return f"{before}.{key}" if before else key, factor
    return name, 1.0


def in_words(request: ParameterOptions) -> str:
    """Return the model and all options in words for reports, with a file's keys and units."""
    back = {name: (key, factor) for key, (name, factor) in (_PARAMETERS | _entries(request)).items()}

    def told(name: str, sigma: float | None = None) -> str:
        scanner, own = ("", name) if name in back else (name.partition(".")[0] + ".", name.partition(".")[2])
        key, factor = back[own]
        return f"{scanner}{key}" if sigma is None else f"{scanner}{key} {sigma / factor:g}"

    lists = {
        FIXED: [told(name) for name in sorted(request.fix)],
        FREE: [told(name) for name in sorted(request.free)],
        "prior": [told(name, sigma) for name, sigma in sorted(request.priors.items())],
    }
    return "; ".join(
        [
            request.model,
            *(f"{word} {', '.join(names)}" for word, names in lists.items() if names),
            *tables_in_words(request),
        ]
    )


def tables_in_words(request: ParameterOptions) -> list[str]:
    """Return in words which entries of tables are estimated."""
    words = []
    if request.ibrc_knots:
        reference = "" if request.ibrc_reference is None else f" (reference {request.ibrc_reference:g})"
        knots = ", ".join(f"{knot:g}" for knot in request.ibrc_knots)
        words.append(f"ibrc at {knots}{reference}, smooth to {request.ibrc_smoothness_m:g} m")
    for word, numbers in (("return slot", request.range_offset_slots), ("zone", request.range_offset_zones)):
        if numbers:
            words.append(f"range offset of {word} {', '.join(map(str, numbers))}")
    if request.beams:
        words.append(f"beam {', '.join(key for key, (name, _) in _BEAM_PARTS.items() if name in request.beams)}")
    return words


def _tables(model: str) -> ModelTables:
    file = file_of(model)
    if file is not None:
        return read_model(file)
    if model not in MODELS:
        raise UserError(f'--model: got "{model}", want {", ".join(MODELS)}, or a file FILE{SUFFIX}', ExitCode.USAGE)
    return ModelTables.model_validate({"model": model})


def _of_tables(tables: ModelTables) -> ParameterOptions:
    """Return the options from all tables but the parameters."""
    request, ibrc, offsets, beam = ParameterOptions(tables.model), tables.ibrc, tables.range_offset, tables.beam
    if ibrc is not None:
        request = replace(
            request, ibrc_knots=tuple(ibrc.knots), ibrc_reference=ibrc.reference, ibrc_smoothness_m=ibrc.smoothness_m
        )
    if offsets is not None:
        slots, zones = tuple(offsets.return_slots), tuple(offsets.mta_zones)
        request = replace(request, range_offset_slots=slots, range_offset_zones=zones)
    if beam is not None:
        request = replace(request, beams=frozenset(_BEAM_PARTS[part][0] for part in beam.estimate))
    return request


def _entries(request: ParameterOptions) -> dict[str, tuple[str, float]]:
    """Return the entries of the requested tables that may have priors, in the form of `_PARAMETERS`."""
    names = [f"range_offset_slot.{slot}" for slot in request.range_offset_slots]
    names += [f"range_offset_zone.{zone}" for zone in request.range_offset_zones]
    middle, reference = len(request.ibrc_knots) // 2, request.ibrc_reference
    zero = middle if reference is None else request.ibrc_knots.index(reference)
    names += [f"ibrc.{knot}" for knot in range(len(request.ibrc_knots)) if knot != zero]
    parts = {key: one for key, one in _BEAM_PARTS.items() if one[0] in request.beams}
    beams = {f"beam.{key}": (f"beam.{name}", factor) for key, (name, factor) in parts.items()}
    return {name: (name, 1.0) for name in names} | beams


def _prior(entry: str) -> tuple[str, float]:
    key, _, value = entry.partition("=")
    try:
        sigma = float(value)
    except ValueError:
        sigma = math.nan
    if not 0.0 < sigma < math.inf:
        raise UserError(f'--prior {entry}: want KEY=SIGMA, above 0, as "phi_deg=0.01"', ExitCode.USAGE)
    return key, sigma


def _states(said: Iterable[tuple[str, str | float]], before: str, known: Known) -> States:
    """Return states by scanner and internal name; ``before`` stands before keys in messages."""
    found: States = {}
    for text, state in said:
        key = text.strip()
        scanner, _, own = ("", "", key) if key in known else key.partition(".")
        if own not in known:
            raise UserError(one_line(f"{before}{key}: unknown parameter; {_want(key, known)}"), ExitCode.USAGE)
        if isinstance(state, str) and own not in _PARAMETERS:
            raise UserError(
                f"{before}{key}: its table already requests it; give a prior, or leave it out", ExitCode.USAGE
            )
        name, factor = known[own]
        found[scanner, name] = state if isinstance(state, str) else state * factor
    return found


def _want(key: str, known: Known) -> str:
    """Return a suggestion in place of an unknown key, for all scanners or for one."""
    scanner, _, own = key.partition(".")
    for before, text in (("", key), (f"{scanner}.", own)):
        close = difflib.get_close_matches(text, known, n=1, cutoff=0.6) if text else []
        if close:
            return f"did you mean {before}{close[0]}?"
    return f"use one of {', '.join(known)}"
