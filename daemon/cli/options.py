"""Defines options that several commands share."""

from __future__ import annotations

from typing import Annotated

import typer

TrajectoryPoint = Annotated[
    str, typer.Option("--trajectory-at", metavar="POINT", help="body, antenna, scanner, or x,y,z from the body.")
]
TrajectoryWeek = Annotated[int | None, typer.Option(help="GPS week of a trajectory that says none.", min=0)]
TrajectoryDatum = Annotated[
    str | None, typer.Option("--trajectory-datum", metavar="CRS", help='Realisation of its positions, or "same".')
]
ForceTrajectory = Annotated[
    bool, typer.Option("--force-trajectory", help="Take a trajectory that does not agree with the log's fixes and IMU.")
]
ForceCrs = Annotated[
    bool, typer.Option("--force-crs", help="Take a CRS outside its area of use, or 0.5 % off in scale.")
]
AcceptVerdict = Annotated[
    bool, typer.Option("--accept-verdict", help="Exit 0 although trajectory or calibration are judged not to be used.")
]
