"""Writes the JSON beside a trajectory, and its page: inputs, settings and quality."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from swath import __version__
from swath.daemon.processing.files import sha256_of, utc_text, write_aside
from swath.daemon.processing.pages.head import PageHead, head_of_navigated
from swath.daemon.processing.trajectory.figures import figures_of
from swath.daemon.processing.trajectory.series import Flight, separation_of
from swath.daemon.processing.trajectory.verdict import judge
from swath.georef.mapping.frame import Mapping, MappingError

if TYPE_CHECKING:
    from swath.daemon.log.reader import Session
    from swath.daemon.processing.navigation.navigate import Navigated, NavigatedLeg
    from swath.daemon.processing.trajectory.event_marks import EventTable
    from swath.daemon.processing.trajectory.request import TrajectoryRequest
    from swath.georef.navigation.diagnosis.diagnose import Finding
    from swath.georef.navigation.inputs import Setup, Start

FORMAT = "swath.trajectory"
FORMAT_VERSION = 1


@dataclass(frozen=True, eq=False)
class Page:
    """The page of a leg."""

    flight: Flight
    findings: Sequence[Finding]
    head: PageHead

    def write(self, path: Path, written: list[tuple[Path, Path]], warnings: list[str]) -> tuple[Any, Any]:
        """Write the page and its PDF to temporary files; return verdict and figures.

        Args:
            path: place of the page.
            written: gets the temporary files with their places.
            warnings: gets a line if the PDF cannot be made.

        Raises:
            OSError: a file cannot be written.
        """
        from swath.daemon.processing.pages.pdf import page_files  # matplotlib, which other functions do not need
        from swath.daemon.processing.trajectory.page import make_page

        html, verdict, figures = make_page(self.flight, self.findings, self.head)
        for place, data in page_files(path, html, warnings).items():
            written.append((write_aside(place, partial(_put, data)), place))
        return verdict, figures

    def judge(self) -> tuple[Any, Any]:
        """Return verdict and figures without writing the page."""
        figures = figures_of(self.flight, separation_of(self.flight))
        return judge(figures, self.findings), figures


def pages_of(flights: Sequence[Navigated]) -> Iterator[Page]:
    """Yield one page per leg, in order."""
    for flight in flights:
        noise = flight.inputs.sources.noise_words()
        notes, facts = (*flight.warnings, *flight.holes), ((noise,) if noise else ())
        mapping = _mapping_of(flight)
        for number, leg in enumerate(flight.legs, start=1):
            title = flight.session_id if len(flight.legs) == 1 else f"{flight.session_id}, leg {number}"
            smoothed = leg.solved.smoothed if flight.smooth else None
            start, found = start_words(leg.start), leg.noise_found()
            page = Flight(
                title,
                leg.solved.forward,
                smoothed,
                leg.setup,
                start,
                found,
                notes,
                missing_s=flight.missing_s,
                mapping=mapping,
                facts=facts,
            )
            times_ns = leg.solved.forward.time_ns
            yield Page(page, leg.findings, head_of_navigated(flight, (int(times_ns[0]), int(times_ns[-1]))))


def _put(data: bytes, stream: IO[bytes]) -> None:
    stream.write(data)


def _mapping_of(flight: Navigated) -> Mapping | None:
    """Return the mapping of the configured products, for the map; None if there is none, or it is refused."""
    config = flight.inputs.sources.config
    if config.output.crs is None:
        return None
    datum = next((gnss.datum for gnss in config.gnss.values() if gnss.datum), None)
    try:
        return Mapping(
            config.output.crs, datum=datum, epoch=config.output.epoch, accuracy_m=config.output.datum_accuracy_m
        )
    except MappingError:
        return None


def start_words(start: Start) -> str:
    """Return in words how a leg's start was found, and its attitude."""
    how = str(getattr(start, "text", "")).partition(":")[0]  # behind it stand the sigmas again
    roll, pitch, heading = np.degrees(start.attitude_rad)
    sigma = np.degrees(start.attitude_sigma_rad)
    angles = f"roll {roll:.2f}° and pitch {pitch:.2f}° (± {max(sigma[:2]):.2f}°), heading {heading % 360.0:.2f}°"
    return f"{how}{'; ' if how else ''}{angles.replace('-', '−')} (± {sigma[2]:.2f}°)"


def summary_head(
    request: TrajectoryRequest,
    solution: str,
    sessions: Sequence[Session],
    holes: Sequence[str],
    warnings: Sequence[str],
) -> dict[str, Any]:
    """Return the part that every summary has: software, inputs, missing data, options."""
    wanted = request.navigate.inputs
    outside = wanted.positions
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "software": f"swath {__version__}",
        "complete": not holes,
        "holes": list(holes),
        "warnings": list(warnings),
        "solution": solution,
        "point": "body",
        "logs": [
            {"name": part.path.name, "sha256": sha256_of(part.path)} for session in sessions for part in session.parts
        ],
        "positions": None if outside is None else {"name": outside.name, "sha256": sha256_of(outside)},
        "options": {
            "imu": wanted.imu,
            "gnss": wanted.gnss,
            "ins": wanted.ins,
            "week": wanted.week,
            "lever_arm_m": None if wanted.arm_b is None else list(wanted.arm_b),
            "config": None if wanted.config is None else wanted.config.path.name,
            "start_deg": None
            if request.navigate.attitude_rad is None
            else list(np.degrees(request.navigate.attitude_rad)),
        },
    }


def summary_of_run(
    request: TrajectoryRequest,
    flights: Sequence[Navigated],
    verdicts: Sequence[Any],
    figures: Sequence[Any],
    events: EventTable | None,
) -> dict[str, Any]:
    """Return the summary of a run, without the names of the files."""
    judged = iter(zip(verdicts, figures, strict=True))
    head = summary_head(
        request,
        "smoothed" if request.navigate.smooth else "realtime",
        [flight.inputs.session for flight in flights],
        [line for flight in flights for line in flight.holes],
        [line for flight in flights for line in flight.warnings],
    )
    return head | {
        "events": None if events is None else dict(sorted(events.fates.items())),
        "verdict": _worst(verdicts),
        "sessions": [_session(flight, judged) for flight in flights],
    }


def _worst(verdicts: Sequence[Any]) -> dict[str, Any]:
    """Return the verdict on the whole run: that of the worst leg, with the parts that `swath
    georef` and others repeat.
    """
    worst = max(verdicts, key=lambda verdict: verdict.level)
    return {"level": worst.level.name.lower(), "sentence": worst.sentence}


def _session(flight: Navigated, judged: Iterator[tuple[Any, Any]]) -> dict[str, Any]:
    inputs = flight.inputs
    by, sigma_s = inputs.imu_time
    return {
        "session": flight.session_id,
        "start": utc_text(inputs.session.info.realtime_ns),
        "recorder": inputs.session.info.software,
        "origin": inputs.session.info.origin or "recording",
        "installation": inputs.sources.config.profile.installation,
        "imu": {
            "source": inputs.sources.imu_source,
            "samples": dict(sorted(inputs.samples.items())),
            "time_by": by,
            "time_sigma_s": sigma_s,
            "rate_hz": inputs.sources.imu.rate_hz,
            "sample": inputs.sources.imu.sample,
            "stamp": inputs.sources.imu.stamp,
            "rotation_b_imu": inputs.sources.rot_b_from_imu.tolist(),
            "grade": inputs.sources.imu.noise.grade,
            "noise_by_grade": inputs.sources.noise_by_grade,
            "noise_words": inputs.sources.noise_words(),
        },
        "gnss": {
            "source": inputs.sources.gnss_source,
            "datum": None if inputs.sources.gnss is None else inputs.sources.gnss.datum,
            "observations": dict(sorted(inputs.observed.items())),
            "refused": dict(sorted(inputs.refused.items())),
            "sigmas_assumed": dict(sorted(inputs.assumed.items())),
        },
        "missing": [
            {"begin_gps_ns": part.begin_ns, "end_gps_ns": part.end_ns, "seconds": part.seconds, "reason": part.why}
            for part in flight.missing
        ],
        "legs": [_leg(leg, *next(judged)) for leg in flight.legs],
    }


def _setup(setup: Setup) -> dict[str, Any]:
    """Return all values of a setup by name."""
    return {field.name: _plain(getattr(setup, field.name)) for field in dataclasses.fields(setup)}


def _leg(leg: NavigatedLeg, verdict: Any, figures: Any) -> dict[str, Any]:
    return {
        "first_gps_ns": int(leg.solved.forward.time_ns[0]),
        "last_gps_ns": int(leg.solved.forward.time_ns[-1]),
        "start": {"words": start_words(leg.start)} | _plain(leg.start),
        "setup": _setup(leg.setup),
        "noise_found": leg.noise_found(),
        "findings": _plain(leg.findings),
        "verdict": verdict.as_dict(),
        "figures": figures,
    }


def _plain(value: Any) -> Any:
    """Return a value as JSON allows it: arrays as lists, dataclasses as objects, non-finite numbers as null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(record: dict[str, Any], stream: IO[bytes]) -> None:
    """Write a summary as JSON text."""
    stream.write((json.dumps(_plain(record), indent=2, ensure_ascii=False) + "\n").encode())
