"""Describes what the models find wrong in a table, in one line: key path, the value found, a correct value."""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping, Sequence
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from swath.daemon.config.tables import Tables

_SHOWN_CHARACTERS = 60

_TYPE_WANTED = {
    "float_type": "a number",
    "int_type": "a whole number",
    "string_type": "text in quotes",
    "bool_type": "true or false",
    "list_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "finite_number": "a finite number",
    "date_type": "a date, without quotes and without a time: 2025-01-31",
}
_BOUND_SIGNS = (("ge", ">="), ("gt", ">"), ("le", "<="), ("lt", "<"))


def describe(details: ErrorDetails, tables: type[BaseModel] = Tables, below: str = "") -> str:
    """Describe one finding of the models in one line: key path, the value found, a correct value.

    Args:
        details: the finding.
        tables: the model of the whole file, or of the table ``below``.
        below: key path of the table that the model is of; empty: the whole file.
    """
    location = [item for item in details["loc"] if item != "[key]"]
    kind, context = details["type"], details.get("ctx", {})
    key = ".".join(filter(None, (below, _key_path(location))))
    if details["loc"][-1:] == ("[key]",):
        return f"{key}: invalid name; want 1 to 64 characters of A-Z a-z 0-9 _ -"
    if kind == "extra_forbidden":
        return f"{key}: unknown key; {_suggestion(location, tables)}"
    field = _walk(location, tables)[1]
    if kind == "missing":
        return f"{key}: missing; want {_wanted_of_field(field)}"
    if kind == "value_error":
        return f"{key}: {context['error']}" if key else str(context["error"])
    return f"{key}: got {shown(details['input'])}, want {_wanted(kind, context, field)}"


def shown(value: object) -> str:
    """Format a value as it appears in the file, shortened."""
    if isinstance(value, Mapping):
        return "a table"
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= _SHOWN_CHARACTERS else f"{text[: _SHOWN_CHARACTERS - 1]}…"


def _key_path(location: Sequence[int | str]) -> str:
    path = ""
    for item in location:
        if isinstance(item, int):
            path += f"[{item}]"
        else:
            path += f".{item}" if path else item
    return path


def _wanted(kind: str, context: Mapping[str, Any], field: FieldInfo | None) -> str:
    if kind == "literal_error":
        return str(context["expected"]).replace("'", '"')
    if kind in ("too_short", "too_long") and kind == "too_short" and context.get("min_length") == 1:
        return "at least one"
    if kind in ("too_short", "too_long"):
        at_most = "at most " if kind == "too_long" and field is not None and not _has_fixed_length(field) else ""
        return f"{at_most}{context.get('min_length', context.get('max_length'))} values"
    if kind == "string_too_long":
        return f"at most {context['max_length']} characters"
    if kind == "string_too_short":
        return "text that is not empty"
    if kind == "multiple_of":
        return f"a multiple of {context['multiple_of']:g}"
    if kind == "string_pattern_mismatch":
        return _wanted_of_pattern(str(context["pattern"]))
    if kind in ("greater_than", "greater_than_equal", "less_than", "less_than_equal"):
        return _bounds(field) or f"{kind} {context}"
    wanted = _TYPE_WANTED.get(kind, kind)
    bounds = _bounds(field) if kind in ("float_type", "int_type") else ""
    return f"{wanted} {bounds}".rstrip()


def _has_fixed_length(field: FieldInfo) -> bool:
    """Return whether a list has one length, as a vector; lists of tables and of texts have a largest one."""
    has_most = any(getattr(item, "max_length", None) is not None for item in field.metadata)
    has_least = any(getattr(item, "min_length", None) is not None for item in field.metadata)
    return _model_in(field.annotation) is None and has_most == has_least


def _wanted_of_pattern(pattern: str) -> str:
    if r"\." in pattern:
        return "MESSAGE.signal of the DBC"
    if "gnss|imu" in pattern:
        return "kind/name of a source"
    return "1 to 64 characters of A-Z a-z 0-9 _ -"


def _wanted_of_field(field: FieldInfo | None) -> str:
    if field is None:
        return "this table"
    if field.description:
        return field.description
    model = _model_in(field.annotation)
    return f"a table with {', '.join(model.model_fields)}" if model else "a value"


def _bounds(field: FieldInfo | None) -> str:
    """Format the bounds of a field, from its own metadata, as ``>= 1 and <= 60``."""
    if field is None:
        return ""
    parts = []
    for attribute, sign in _BOUND_SIGNS:
        for item in field.metadata:
            bound = getattr(item, attribute, None)
            if bound is not None:
                parts.append(f"{sign} {bound:.10g}")
    return " and ".join(parts)


def _model_in(annotation: object) -> type[BaseModel] | None:
    """Return the model ``M`` in the annotations ``M``, ``M | None``, ``dict[str, M]`` or ``list[M]``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if get_origin(annotation) in (dict, list, Union, UnionType, Annotated):
        for argument in get_args(annotation):
            if (model := _model_in(argument)) is not None:
                return model
    return None


def _is_named(annotation: object) -> bool:
    return get_origin(annotation) is dict


def _walk(location: Sequence[int | str], tables: type[BaseModel]) -> tuple[type[BaseModel] | None, FieldInfo | None]:
    """Return the innermost model on the way to a location, and the last field passed."""
    model: type[BaseModel] | None = tables
    field: FieldInfo | None = None
    skip = False
    for item in location:
        if skip or isinstance(item, int):
            skip = False
            continue
        if model is None or item not in model.model_fields:
            return model, None
        field = model.model_fields[item]
        skip = _is_named(field.annotation)
        inner = _model_in(field.annotation)
        model = inner if inner is not None else model
    return model, field


def _suggestion(location: Sequence[int | str], tables: type[BaseModel]) -> str:
    model, _ = _walk(location[:-1], tables)
    known = dict(model.model_fields) if model is not None else {}
    key = str(location[-1])
    close = difflib.get_close_matches(key, known, n=1, cutoff=0.6)
    if close:
        return f"did you mean {close[0]}?"
    for name, field in known.items():
        below = _model_in(field.annotation)
        if below is not None and key in below.model_fields and not _is_named(field.annotation):
            return f"did you mean {name}.{key}?"
    return f"there are: {', '.join(known)}"
