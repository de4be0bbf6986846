"""Read when base stations observed, from RINEX files, and judge whether they cover a flight.

Source: RINEX 2.11, section A.4 and table A2 (epoch record); RINEX 3.05 and 4.00, sections 6.7 and A.3: the epoch record
begins with ``>``. The time system is that of ``TIME OF FIRST OBS``, GPS time if none is named.
"""

from __future__ import annotations

import gzip
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.landing.checks import Check, home_sentence
from swath.daemon.processing.landing.command import GOOD, HOME, REMARK
from swath.georef.arrays import Int64Array
from swath.georef.timescales.gps_time import GPS_EPOCH, SECOND_NS, table_leap_seconds

LONGEST_PAUSE_NS = 30 * SECOND_NS  # between two epochs; stations with a longer interval: once and a half of it
EDGE_NS = 5 * SECOND_NS  # of the flight's begin and end that may lie beyond the first and the last epoch
LABEL = slice(60, 80)  # of a header line
BDT_S = 14  # GPS time minus that of BeiDou
OF_RINEX_3 = re.compile(rb"> (\d{4}) (\d\d| \d) (\d\d| \d) (\d\d| \d) (\d\d| \d)([ \d]{2}\d\.\d{7})  [01]")
OF_RINEX_2 = re.compile(rb" (\d\d| \d) (\d\d| \d) (\d\d| \d) (\d\d| \d) (\d\d| \d)([ \d]{2}\d\.\d{7})  [01][ \d]{3}")


@dataclass(frozen=True, slots=True, eq=False)
class BaseEpochs:
    """The observations of a station.

    Attributes:
        station: the marker's name, or that of the file.
        gps_ns: (n,) GPS times, ascending.
    """

    station: str
    gps_ns: Int64Array


def read_epochs(path: Path) -> BaseEpochs:
    """Return the epochs of an observation file, which may be packed by gzip.

    Raises:
        UserError: it cannot be read, or is no such file.
    """
    try:
        with path.open("rb") as plain:
            packed = plain.read(2) == b"\x1f\x8b"
        with gzip.open(path) if packed else path.open("rb") as file:
            lines = iter(file)
            station, version, system = _header(path, lines)
            epochs = OF_RINEX_2 if version < 3 else OF_RINEX_3
            times = [_gps_ns(found, version, system) for line in lines if (found := epochs.match(line))]
    except (OSError, EOFError) as error:
        text = f"{path}: {getattr(error, 'strerror', None) or error}; give a RINEX file"
        raise UserError(text, ExitCode.IO) from error
    except ValueError as error:
        raise UserError(f"{path}: an epoch has no date ({error}); give a RINEX file", ExitCode.DAMAGE) from error
    if not times:
        raise UserError(f"{path}: holds no epoch; give a RINEX file of observations", ExitCode.DAMAGE)
    return BaseEpochs(station, np.unique(np.array(times, np.int64)))


def _header(path: Path, lines: Iterator[bytes]) -> tuple[str, int, str]:
    """Return the station, RINEX's major version, and the time system."""
    first = next(lines, b"")
    if first[LABEL].strip() != b"RINEX VERSION / TYPE" or first[20:21] != b"O":
        packed = first[LABEL].strip().startswith(b"CRINEX")
        remedy = "unpack it with CRX2RNX" if packed else "give a RINEX file of observations"
        raise UserError(f"{path}: is no RINEX file of observations; {remedy}", ExitCode.DAMAGE)
    station, system = path.name, ""
    for line in lines:
        label = line[LABEL].strip()
        if label == b"END OF HEADER":
            break
        if label == b"MARKER NAME":
            station = line[:60].decode("latin-1").strip() or station
        elif label == b"TIME OF FIRST OBS":
            system = line[48:51].decode("latin-1").strip()
    return station, int(float(first[:9])), system


def _gps_ns(found: re.Match[bytes], version: int, system: str) -> int:
    """Return the GPS time of an epoch record; GLONASS's time in RINEX is UTC."""
    year, month, day, hour, minute = (int(part) for part in found.groups()[:5])
    if version < 3:
        year += 1900 if year >= 80 else 2000
    day_of = date(year, month, day)
    later_s = table_leap_seconds(day_of)[0] if system == "GLO" else BDT_S if system == "BDT" else 0
    seconds = (day_of - GPS_EPOCH).days * 86_400 + hour * 3600 + minute * 60 + later_s
    return seconds * SECOND_NS + round(float(found[6]) * 1e7) * (SECOND_NS // 10_000_000)


def base_check(epochs: Sequence[BaseEpochs], flown_ns: tuple[int, int]) -> Check:
    """Judge whether one station at least observed during the whole flight.

    Args:
        epochs: of each file; files of one station count together.
        flown_ns: GPS times of the flight's begin and end.
    """
    stations: dict[str, list[Int64Array]] = {}
    for one in epochs:
        stations.setdefault(one.station, []).append(one.gps_ns)
    judged = [_judged(name, np.unique(np.concatenate(times)), flown_ns) for name, times in sorted(stations.items())]
    whole = any(is_whole for is_whole, _ in judged)
    return Check("base", "Base data", GOOD if whole else REMARK, "; ".join(text for _, text in judged))


def _judged(name: str, times: Int64Array, flown_ns: tuple[int, int]) -> tuple[bool, str]:
    """Return whether a station's epochs cover a flight, and that in words."""
    begin_ns, end_ns = flown_ns
    steps = np.diff(times)
    interval_ns = float(np.median(steps)) if len(steps) else 0.0
    lacks = []
    for late_ns, words in ((times[0] - begin_ns, "begins {} s late"), (end_ns - times[-1], "ends {} s early")):
        if late_ns > max(EDGE_NS, interval_ns):
            lacks.append(words.format(f"{late_ns / SECOND_NS:,.0f}"))
    pauses = steps > max(LONGEST_PAUSE_NS, 1.5 * interval_ns)
    within = pauses & (times[1:] > begin_ns) & (times[:-1] < end_ns)
    if within.any():
        lacks.append(f"pauses, the longest of {steps[within].max() / SECOND_NS:,.0f} s")
    every = f"an epoch every {interval_ns / SECOND_NS:g} s" if len(steps) else "one epoch"
    return not lacks, f"{name}: {every}, {' and '.join(lacks) if lacks else 'the whole flight'}"


def with_base(found: Mapping[str, Any], files: Sequence[Path]) -> dict[str, Any]:
    """Return a verdict with what base stations' files say; the sentence follows.

    Raises:
        UserError: a file cannot be read, or nothing has been flown.
    """
    epochs = [read_epochs(path) for path in files]
    if not found["flown_gps_ns"]:
        raise UserError("--base: nothing has been flown yet; compare base data after the flight", ExitCode.USAGE)
    begin_ns, end_ns = found["flown_gps_ns"]
    check = asdict(base_check(epochs, (begin_ns, end_ns)))
    checks = [
        one | {"state": check["state"], "text": check["text"]} if one["code"] == "base" else one
        for one in found["checks"]
    ]
    changed = dict(found) | {"checks": checks}
    if found["state"] == HOME:
        changed["sentence"] = home_sentence([(one["state"], one["title"]) for one in checks])
    return changed
