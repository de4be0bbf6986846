"""The truth beside a flight: the origin of every return and the aircraft's poses, in NPZ files of any length.

Columns are written to raw files during the flight and packed at its end, so memory stays flat.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from swath.georef.arrays import StructArray

RETURN_TRUTH_DTYPE = np.dtype(
    [
        ("gps_ns", "<i8"),  # true emission
        ("point_e", "<f8", (3,)),  # ECEF of the echo on the beam's axis, metres
        ("range_m", "<f8"),  # true, from the beam's origin
        ("pulse", "<i8"),  # number since power-on
        ("incidence_rad", "<f4"),
        ("strip", "<i2"),  # index of the flight line, −1 between lines
        ("channel", "<u2"),  # facet or beam
        ("return_number", "u1"),
        ("surface", "u1"),  # index into swath.sim.shots.SURFACES
    ]
)
POSE_TRUTH_DTYPE = np.dtype(
    [
        ("gps_ns", "<i8"),
        ("lat_rad", "<f8"),
        ("lon_rad", "<f8"),
        ("height_m", "<f8"),  # ellipsoidal, of the body's origin
        ("velocity_l", "<f8", (3,)),  # north, east, down
        ("roll_rad", "<f8"),
        ("pitch_rad", "<f8"),
        ("heading_rad", "<f8"),
        ("strip", "<i2"),
    ]
)


class TruthWriter:
    """Collects rows of several tables in pieces and packs them into one uncompressed NPZ.

    The NPZ has one array ``table.field`` for each field.

    Args:
        path: of the NPZ; the pieces are beside it until `finish`.
        tables: name → dtype.
    """

    def __init__(self, path: Path, tables: dict[str, np.dtype[np.void]]) -> None:
        self.path = path
        self.rows = dict.fromkeys(tables, 0)
        self._tables = tables
        self._parts: dict[tuple[str, str], IO[bytes]] = {}
        for table, dtype in tables.items():
            for field in dtype.names or ():
                self._parts[table, field] = self._part(table, field).open("wb")

    def add(self, table: str, rows: StructArray) -> None:
        """Append rows to a table; raises OSError."""
        self.rows[table] += len(rows)
        for field in self._tables[table].names or ():
            np.ascontiguousarray(rows[field]).tofile(self._parts[table, field])

    def finish(self, extra: dict[str, NDArray[Any]]) -> None:
        """Pack the columns, and further small arrays; raises OSError."""
        with zipfile.ZipFile(self.path, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for table, dtype in self._tables.items():
                for field in dtype.names or ():
                    self._pack(archive, table, field)
            for name, array in extra.items():
                with archive.open(_member(f"{name}.npy"), "w") as member:
                    np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
        self._remove_parts()

    def abandon(self) -> None:
        """Remove the pieces without packing them."""
        self._remove_parts()

    def _pack(self, archive: zipfile.ZipFile, table: str, field: str) -> None:
        self._parts[table, field].close()
        base, shape = self._tables[table][field].base, self._tables[table][field].shape
        header: dict[str, Any] = {"descr": np.lib.format.dtype_to_descr(base), "fortran_order": False}
        header["shape"] = (self.rows[table], *shape)
        with archive.open(_member(f"{table}.{field}.npy"), "w", force_zip64=True) as member:
            np.lib.format.write_array_header_1_0(member, header)
            with self._part(table, field).open("rb") as part:
                while piece := part.read(1 << 22):
                    member.write(piece)
        self._part(table, field).unlink()

    def _part(self, table: str, field: str) -> Path:
        return self.path.with_name(f".{self.path.name}.{table}.{field}.part")

    def _remove_parts(self) -> None:
        for (table, field), file in self._parts.items():
            file.close()
            self._part(table, field).unlink(missing_ok=True)


def _member(name: str) -> zipfile.ZipInfo:
    """Return an archive member of a fixed date, so that the same flight gives the same file."""
    return zipfile.ZipInfo(name, date_time=(1980, 1, 6, 0, 0, 0))
