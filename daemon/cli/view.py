"""The command ``swath view``: gives a quick look at products."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from swath import __version__
from swath.daemon.errors import ExitCode, UserError, one_line
from swath.daemon.free_space import check_space
from swath.daemon.processing.requirements import GIS, PRINTED_PAGES, require_installed
from swath.daemon.written import error_words

if TYPE_CHECKING:
    from swath.daemon.processing.quicklook.run import Look

PAGE_BYTES = (3e6, 5e7)  # of the page and its pictures: at least, and at most


def command(
    paths: Annotated[
        list[Path], typer.Argument(help="LAS, LAZ or COPC files, or folders of such files.", metavar="PATH…")
    ],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Folder for the page; default: `view` beside the files."),
    ] = None,
    cell: Annotated[
        float | None,
        typer.Option(
            metavar="M",
            help="Side of a cell; default: from the point density. Strips may be compared in larger cells.",
        ),
    ] = None,
    profile: Annotated[
        str | None,
        typer.Option(metavar="X1,Y1,X2,Y2", help="Ends of the profile; default: across an overlap, or along a strip."),
    ] = None,
    gis: Annotated[
        bool, typer.Option("--gis", help="Also write maps as GeoTIFF, and lines, footprints, control as GeoPackage.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files of an earlier run.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")] = False,
) -> None:
    """Make a page with maps of height, intensity, density, sigma and strip differences, and a profile.

    Exit code 4 when a file could be read only in part.
    """
    require_installed("swath view", *PRINTED_PAGES, *(GIS if gis else ()))
    if cell is not None and not (math.isfinite(cell) and cell > 0.0):
        raise UserError(f"--cell: got {cell:g}, want metres above 0", ExitCode.USAGE)
    ends = _ends(profile)
    damaged = _make(paths, output, cell, ends, gis=gis, overwrite=overwrite, as_json=as_json)
    if damaged:
        raise typer.Exit(int(ExitCode.DAMAGE))


def _ends(text: str | None) -> list[float] | None:
    if text is None:
        return None
    try:
        ends = [float(part) for part in text.split(",")]
    except ValueError:
        ends = []
    if len(ends) != 4 or not all(math.isfinite(end) for end in ends):
        raise UserError(f"--profile: got {one_line(text)}, want x1,y1,x2,y2 in the files' coordinates", ExitCode.USAGE)
    return ends


def _make(
    paths: list[Path],
    output: Path | None,
    cell: float | None,
    ends: list[float] | None,
    *,
    gis: bool,
    overwrite: bool,
    as_json: bool,
) -> bool:
    """Read, draw, write and report; return True if a file could be read only in part."""
    from rich.console import Console

    from swath.daemon.cli.progress import progress_bar
    from swath.daemon.processing.earlier_runs import listed_files, refuse_existing, relative_to
    from swath.daemon.processing.files import aside_folder
    from swath.daemon.processing.pages.names import QUICK_LOOK, VIEW_RECORD
    from swath.daemon.processing.quicklook.page import make_page
    from swath.daemon.processing.quicklook.read import QuickLookError
    from swath.daemon.processing.quicklook.run import look_at, numbers_of
    from swath.daemon.processing.user_errors import finite

    warnings: list[str] = []
    console = Console(stderr=True, markup=False, highlight=False, soft_wrap=True)
    first = paths[0]
    folder = output or (first if first.is_dir() else first.parent) / "view"
    title = (first.resolve() if len(paths) == 1 else first.resolve().parent).name
    record = folder / VIEW_RECORD
    refuse_existing((record, folder / QUICK_LOOK), overwrite=overwrite)
    check_space(folder, "page and pictures", least_bytes=PAGE_BYTES[0], most_bytes=PAGE_BYTES[1])
    with progress_bar(compiling=True) as tell:
        try:
            look = look_at(paths, cell, ends, tell)
        except QuickLookError as error:
            raise UserError(one_line(str(error)), ExitCode.IO) from error
        try:
            with aside_folder(folder, listed_files(record)) as aside:
                page = folder / make_page(look, aside, title, warnings, tell).name
                if gis:
                    tell("GIS layers", 0, 0)
                made = [folder / path.name for path in _gis(look, aside, paths, warnings)] if gis else []
                about = {
                    "format": "swath.view",
                    "version": 1,
                    "software": f"swath {__version__}",
                    "of": relative_to(folder, (source.path for source in look.sources)),
                    "files": sorted(path.name for path in aside.iterdir()),
                }
                (aside / VIEW_RECORD).write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
        except OSError as error:
            raise UserError(one_line(error_words(error, folder)), ExitCode.IO) from error
    for line in warnings:
        console.print(one_line(f"swath: {line}"))
    damaged = False
    for source in look.sources:
        if source.damage:
            console.print(one_line(f"swath: {source.path}: {source.damage}; the page shows the readable part"))
            damaged = True
    if as_json:
        written = {"page": str(page)} | ({"gis": [str(path) for path in made]} if gis else {})
        print(json.dumps(finite(numbers_of(look)) | written, indent=2, allow_nan=False))
    else:
        print(f"{len(look.strips)} strip{'s' * (len(look.strips) != 1)}, {look.surface.points:,} points: {page}")
        for path in made:
            print(one_line(str(path)))
    return damaged


def _gis(look: Look, folder: Path, paths: list[Path], warnings: list[str]) -> list[Path]:
    """Write maps and features for GIS; return their paths."""
    from swath.daemon.processing.quicklook.gis import write_gis

    done = write_gis(look, folder, paths)
    warnings.extend(done.notes)
    return done.paths
