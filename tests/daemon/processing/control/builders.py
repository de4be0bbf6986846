"""The same control points as programs export them, in UTM 32 and as latitudes and longitudes."""

from __future__ import annotations

import numpy as np
from pyproj import Transformer

from swath.georef.arrays import FloatArray

NAMES = ("GCP1", "GCP2", "GCP3")
LAT_LON_H = np.array([[47.4801, 8.9002, 470.123], [47.4822, 8.9053, 462.456], [47.4843, 8.9104, 455.789]])
FLIGHT = np.array([[47.481, 8.893], [47.485, 8.916]])


def utm32() -> FloatArray:
    """Return easting, northing and ellipsoidal height (3, 3) of the points."""
    to_map = Transformer.from_crs("EPSG:4979", "EPSG:32632", always_xy=True)
    lat, lon, height = LAT_LON_H.T
    return np.column_stack(to_map.transform(lon, lat, height))


def rows(template: str, places: FloatArray | None = None, *, comma: bool = False) -> str:
    """Return a line for each point, with e, n, h and name in a template; decimal commas on request."""
    lines = []
    for name, (east, north, height) in zip(NAMES, utm32() if places is None else places, strict=True):
        line = template.format(name=name, e=f"{east:.4f}", n=f"{north:.4f}", h=f"{height:.4f}")
        lines.append(line.replace(".", ",") if comma else line)
    return "\n".join(lines) + "\n"


EXPORTS = {
    "trimble-access": "Point name,Northing,Easting,Elevation,Code\n" + rows("{name},{n},{e},{h},GCP"),
    "trimble-business-center": "Point ID,Easting (Meter),Northing (Meter),Elevation (Meter),Feature Code\n"
    + rows('"{name}","{e}","{n}","{h}","GCP"'),
    "trimble-with-precisions": "Name,Code,East,North,Elev,Hz Prec,Vt Prec\n"
    + rows("{name},GCP,{e},{n},{h},0.008,0.015"),
    "leica-infinity": "Point Id;Point Class;Easting [m];Northing [m];Ellip. Height [m];CQ 3D [m];Code\n"
    + rows("{name};Measured;{e};{n};{h};0.015;GCP"),
    "leica-german": "Punkt-Nr.;Rechtswert;Hochwert;Höhe;Code\n" + rows("{name};{e};{n};{h};GCP", comma=True),
    "leica-titles": "Leica Captivate\nProject: Test field\n\nPoint ID\tEasting\tNorthing\tHeight\tAntenna Height\n"
    + rows("{name}\t{e}\t{n}\t{h}\t2.000"),
    "plain": "# of June\nname E N H\n" + rows("{name}   {e}  {n} {h}"),
    "decimal-commas-and-blanks": "Pkt Ost Nord Hoehe\n" + rows("{name} {e} {n} {h}", comma=True),
    "underscores": "gcp_id,northing_m,easting_m,height_m\n" + rows("{name},{n},{e},{h}"),
}
