"""Collects what stands in the head of every page: when, with what and by whom the data were flown and processed."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from swath import __version__
from swath.georef.timescales.gps_time import DAY_NS, GPS_EPOCH, SECOND_NS, table_leap_seconds, utc_from_gps

if TYPE_CHECKING:
    from swath.calib.calibration_file import Header
    from swath.daemon.config.config import Config
    from swath.daemon.processing.flights.read import Flight
    from swath.daemon.processing.navigation.navigate import Navigated
    from swath.georef.scanner.calibration import Calibration

SOFTWARE = f"Swath {__version__}"
UNSAID_DATUM = "WGS 84, realisation unknown"
MOST_LOGS = 6
Span = tuple[int, int]


@dataclass(frozen=True, slots=True)
class PageHead:
    """The head of a page; what is not known is empty, and the page leaves it out.

    Attributes:
        flown: date and UTC times of the flight.
        logs: names of the sessions.
        aircraft: name of the aircraft, of ``[profile]``.
        crs: coordinate system and heights.
        calibrations: one text per calibration: id, scanner, date, verdict.
        author: who delivers the page, of ``[profile]``; empty: the software is named as the PDF's author.
        software: what made the page.
        made_with: other software that made the data, as versions.
    """

    flown: str = ""
    logs: Sequence[str] = ()
    aircraft: str = ""
    crs: str = ""
    calibrations: Sequence[str] = ()
    author: str = ""
    software: str = SOFTWARE
    made_with: Sequence[str] = ()

    def rows(self) -> list[tuple[str, str]]:
        """Return labels and texts of what is known."""
        logs = ", ".join(self.logs[:MOST_LOGS])
        logs += f" and {len(self.logs) - MOST_LOGS} more" if len(self.logs) > MOST_LOGS else ""
        others = [one for one in dict.fromkeys(self.made_with) if one.lower() != self.software.lower()]
        rows = [
            ("Flown", self.flown),
            ("Logs" if len(self.logs) > 1 else "Log", logs),
            ("Aircraft", self.aircraft),
            ("CRS", self.crs),
            *(("Calibration", one) for one in self.calibrations),
            ("By", self.author),
            ("Software", self.software + (f"; data by {', '.join(others)}" if others else "")),
        ]
        return [(label, text) for label, text in rows if text]


NOTHING_KNOWN = PageHead()
SHORT_NS = 120 * SECOND_NS  # times of shorter flights have seconds


def flown_words(spans_ns: Iterable[Span]) -> str:
    """Return the date of a flight and its UTC times from the first to the last, from spans of GPS time in ns."""
    spans = list(spans_ns)
    if not spans:
        return ""
    begin_ns, end_ns = min(one for one, _ in spans), max(one for _, one in spans)
    short = end_ns - begin_ns < SHORT_NS
    (first, begin), (last, end) = _utc_words(begin_ns, seconds=short), _utc_words(end_ns, seconds=short)
    return f"{first}, {begin} to {end} UTC" if first == last else f"{first} {begin} to {last} {end} UTC"


def _utc_words(gps_ns: int, *, seconds: bool) -> tuple[str, str]:
    """Return date and time of day of a GPS time, to the minute or the second."""
    day = dt.date.fromordinal(GPS_EPOCH.toordinal() + gps_ns // DAY_NS)
    date, of_day_ns = utc_from_gps(gps_ns, table_leap_seconds(day)[0])
    minutes, second = divmod(of_day_ns // SECOND_NS, 60)
    return date.isoformat(), f"{minutes // 60:02d}:{minutes % 60:02d}" + (f":{second:02d}" if seconds else "")


def calibration_words(scanner: str, entry: Mapping[str, Any], unsaid: str = "") -> str:
    """Return id, scanner, date and verdict of a calibration.

    Args:
        scanner: its name.
        entry: header of the calibration's file, or its entry in a sidecar.
        unsaid: verdict on an estimated calibration whose file has none.
    """
    created = entry.get("created")
    verdict = entry.get("verdict") or ("nominal, never estimated" if entry.get("method") == "nominal" else unsaid)
    words = [str(entry.get("id", "")), f"of {scanner}" if scanner else ""]
    said = [f"made {str(created)[:10]}" if created else "", str(verdict)]
    return ", ".join([" ".join(filter(None, words)), *filter(None, said)])


def calibrations_words(calibrations: Mapping[str, Calibration]) -> list[str]:
    """Return a text for each calibration by scanner."""
    return [
        calibration_words(name, {**one.header, "id": one.id, "method": one.method})
        for name, one in calibrations.items()
    ]


def headers_words(headers: Mapping[str, Header], verdict: str) -> list[str]:
    """Return a text for each new calibration by scanner, with the verdict on all of them."""
    return [
        calibration_words(name, {"id": header.id, "created": header.created, "verdict": verdict})
        for name, header in headers.items()
    ]


def crs_words(description: Mapping[str, Any]) -> str:
    """Return name, code and heights of a coordinate system, from a mapping's description or a sidecar."""
    name, code, heights = (str(description.get(key) or "") for key in ("name", "crs", "heights"))
    named = f"{name} ({code})" if name and code and name != code and len(code) < 40 else name or code
    return f"{named}; heights {heights}" if heights and not heights.startswith("none") else named


def head_of_flights(flights: Sequence[Flight], calibrations: Sequence[str] | None = None) -> PageHead:
    """Return the head of a page made from logs.

    Args:
        flights: the flights that were read.
        calibrations: texts on the calibrations; None: those that the flights' points are made with.
    """
    if calibrations is None:
        made_with = [text for flight in flights for text in calibrations_words(flight.setup.calibrations)]
        calibrations = list(dict.fromkeys(made_with))
    mapping = flights[0].setup.mapping
    return PageHead(
        flown=flown_words(flight.span for flight in flights),
        logs=[flight.session.session_id for flight in flights],
        **_profile(flight.setup.config for flight in flights),
        crs="" if mapping is None else crs_words(mapping.description()),
        calibrations=calibrations,
    )


def head_of_navigated(flight: Navigated, span_ns: Span) -> PageHead:
    """Return the head of a page about a trajectory: its coordinates are geographic, in its receiver's datum."""
    sources = flight.inputs.sources
    datum = (sources.gnss.datum if sources.gnss is not None else None) or UNSAID_DATUM
    return PageHead(
        flown=flown_words([span_ns]),
        logs=[flight.session_id],
        **_profile([sources.config]),
        crs=f"geographic, {datum}; heights above the ellipsoid" if datum != "same" else "",
    )


def _profile(configs: Iterable[Config]) -> dict[str, str]:
    profiles = [config.profile for config in configs]
    return {
        "aircraft": ", ".join(dict.fromkeys(one.aircraft for one in profiles if one.aircraft)),
        "author": ", ".join(dict.fromkeys(one.operator for one in profiles if one.operator)),
    }


def head_of_sidecars(sidecars: Iterable[Mapping[str, Any]], crs: str = "") -> PageHead:
    """Return the head of a page made from products, by the sidecars beside them.

    Args:
        sidecars: contents of the JSON files beside the points; other software's may hold anything.
        crs: coordinate system of the files; empty: as the sidecars say.
    """
    known = [sidecar for sidecar in sidecars if sidecar]
    flights = [entry for sidecar in known for entry in _dicts(sidecar.get("flights"))]
    spans = [span for entry in flights if (span := _span(entry.get("returns_gps_ns"))) is not None]
    systems = [crs_words(one) for sidecar in known if isinstance(one := sidecar.get("crs"), dict)]
    return PageHead(
        flown=flown_words(spans),
        logs=_texts(entry.get("session") for entry in flights),
        aircraft=", ".join(_texts(entry.get("aircraft") for entry in flights)),
        crs=next(iter(systems), crs),
        calibrations=_texts(
            calibration_words(name, one)
            for entry in flights
            if isinstance(calibrations := entry.get("calibrations"), dict)
            for name, one in calibrations.items()
            if isinstance(one, dict)
        ),
        author=", ".join(_texts(entry.get("operator") for entry in flights)),
        made_with=_texts(sidecar.get("software") for sidecar in known),
    )


def _dicts(entries: Any) -> list[dict[str, Any]]:
    return [entry for entry in entries if isinstance(entry, dict)] if isinstance(entries, list) else []


def _span(entry: Any) -> Span | None:
    good = isinstance(entry, list) and len(entry) == 2 and all(isinstance(end, int) and end > 0 for end in entry)
    return (entry[0], entry[1]) if good else None


def _texts(values: Iterable[Any]) -> list[str]:
    """Return the texts among values, each once."""
    return list(dict.fromkeys(str(value) for value in values if value))
