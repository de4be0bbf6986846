"""Prints an HTML page as PDF by the rules for paper in its style sheet."""

from __future__ import annotations

import contextlib
import io
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from matplotlib.font_manager import FontProperties, findfont

from swath.daemon.processing.pages.names import PRINTED

FACES = (("DejaVu Sans", "normal"), ("DejaVu Sans", "bold"), ("DejaVu Sans Mono", "normal"))
DATE = "SOURCE_DATE_EPOCH"
NO_PANGO = "because Pango is missing: apt-get install libpango-1.0-0 libpangoft2-1.0-0"


class PdfUnavailableError(Exception):
    """This computer lacks a library that printing needs; the message says what to install."""


def page_files(page: Path, html: str, warnings: list[str], paper: str = "") -> dict[Path, bytes]:
    """Return a page and its PDF beside it, by path; where this computer cannot make a PDF, add a warning instead.

    Args:
        page: where the page goes.
        html: its text.
        warnings: gets the warning.
        paper: text of the page that is printed; empty: the same.
    """
    files, printed = {page: html.encode()}, page.with_suffix(PRINTED)
    try:
        files[printed] = pdf_of(paper or html)
    except PdfUnavailableError as error:
        warnings.append(f"{printed}: not written, {error}; {page.name} shows the same")
    return files


def pdf_of(page: str) -> bytes:
    """Return a page as PDF on A4; the same page gives the same bytes.

    Raises:
        PdfUnavailableError: Pango, which sets the text, is not installed.
    """
    weasyprint, fonts = _printer()
    faces = weasyprint.CSS(string=_font_faces(), font_config=fonts)
    with _fixed_date():
        printed = weasyprint.HTML(string=page).write_pdf(stylesheets=[faces], font_config=fonts)
    return bytes(printed)


def _printer() -> tuple[Any, Any]:
    """Return WeasyPrint, which loads Pango when it is imported, and a set of fonts for one document.

    Where Pango is absent WeasyPrint prints advice of several lines before it raises; these are withheld.
    """
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # fontTools subsets fonts where HarfBuzz cannot
        try:
            import weasyprint
            from weasyprint.text.fonts import FontConfiguration
        except OSError as error:
            raise PdfUnavailableError(NO_PANGO) from error
        return weasyprint, FontConfiguration()


@contextlib.contextmanager
def _fixed_date() -> Iterator[None]:
    """Have fontTools, which writes the time into the fonts that it subsets, write a fixed one."""
    before = os.environ.get(DATE)
    os.environ[DATE] = "0"
    try:
        yield
    finally:
        os.environ.pop(DATE)
        if before is not None:
            os.environ[DATE] = before


def _font_faces() -> str:
    """Return rules that take the fonts from Matplotlib, so that the PDF does not depend on the computer's own."""
    rules = []
    for family, weight in FACES:
        uri = Path(findfont(FontProperties(family=family, weight=weight))).resolve().as_uri()
        rules.append(f'@font-face {{ font-family: "{family}"; font-weight: {weight}; src: url("{uri}"); }}')
    return "\n".join(rules)
