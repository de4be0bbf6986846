"""Defines options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

TrajectoryPoint = Annotated[
    str,
    typer.Option(
        "--trajectory-at",
        metavar="POINT",
        help="Point that the trajectory describes: body, antenna, scanner, or x,y,z from the body in metres.",
    ),
]
TrajectoryWeek = Annotated[int | None, typer.Option(help="GPS week, if the trajectory file holds none.", min=0)]
TrajectoryDatum = Annotated[
    str | None,
    typer.Option("--trajectory-datum", metavar="CRS", help='Datum of the trajectory, or "same" (as the output).'),
]
ForceTrajectory = Annotated[
    bool, typer.Option("--force-trajectory", help="Use a trajectory that contradicts the log's fixes or IMU.")
]
ForceCrs = Annotated[
    bool, typer.Option("--force-crs", help="Use a CRS outside its area of use, or with a scale error above 0.5 %.")
]
AcceptVerdict = Annotated[
    bool, typer.Option("--accept-verdict", help='Exit with code 0 even if the verdict is "Not to be used".')
]
ControlPath = Annotated[
    Path | None,
    typer.Option(
        "--control",
        metavar="FILE",
        help="Control points: text with name, E, N, H or name, lat, lon, h; GeoPackage; shapefile.",
    ),
]
ControlCrs = Annotated[
    str | None,
    typer.Option(
        "--control-crs",
        metavar="CRS",
        help="CRS of the control, such as EPSG:25832+7837; default: the file's own, or output.crs.",
    ),
]
ControlColumns = Annotated[
    str | None,
    typer.Option(
        "--control-columns",
        metavar="NAME,…",
        help="Columns of a control file without header, such as name,E,N,H,-,sigma.",
    ),
]
