"""The field types and the base class of a plan's tables."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]+$", max_length=64)]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Matrix = Annotated[list[Vector], Field(min_length=3, max_length=3)]
Point = Annotated[list[float], Field(min_length=2, max_length=2)]
Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]


def none_of_empty(value: Any) -> Any:
    """Return None for an empty string, because TOML has no null."""
    return None if value == "" else value


def empty_of_none(value: str | None) -> str:
    """Return an empty string for None, the reverse of `none_of_empty`."""
    return value or ""


Wired = Annotated[Name | None, BeforeValidator(none_of_empty), PlainSerializer(empty_of_none)]


class Section(BaseModel):
    """A table of the plan."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)
