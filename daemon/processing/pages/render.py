"""Renders HTML pages from their templates: one file each, with its style sheet, that needs no network."""

from __future__ import annotations

from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

STYLE_SHEET = "page.css"


@cache
def environment() -> Environment:
    """Return the environment of the templates beside this module; it escapes all text and refuses undefined names."""
    loader = PackageLoader("swath.daemon.processing.pages", "templates")
    made = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    style, _, _ = loader.get_source(made, STYLE_SHEET)
    made.globals["style"] = Markup(style)
    return made


def render(template: str, **values: Any) -> str:
    """Return the HTML text of a page; the same values give the same text.

    Raises:
        jinja2.UndefinedError: the template uses a value that is not given.
    """
    return environment().get_template(template).render(values)
