"""Carries verdicts on trajectories and calibrations along to everything that is made with them."""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.trajectory.figures import figures_of
from swath.daemon.processing.trajectory.series import Flight, separation_of, used_positions
from swath.daemon.processing.trajectory.verdict import judge
from swath.georef.records import FixType
from swath.georef.scanner.calibration import INDEX
from swath.georef.verdicts import Level, Reason

if TYPE_CHECKING:
    from swath.daemon.processing.navigation.navigate import Navigated
    from swath.daemon.processing.setup.setup import Setup
    from swath.georef.scanner.calibration import Calibration
    from swath.georef.trajectory.trajectory import Trajectory

LEVELS = {level.words: level for level in Level}
OF_TRAJECTORY, OF_POINTS = "swath.trajectory", "swath.georef"  # formats of summaries and sidecars
OF_ADJUSTMENT, ADJUSTMENT = "swath.strip-adjustment", "strip-adjustment.json"  # format and file name of its record
SOURCES = {"smoothed": "navigated", "realtime": "navigated", "as-is": "ins"}  # by a trajectory's summary
MADE_WITH = {"navigated": "a trajectory navigated from IMU and GNSS", "ins": "the device's own INS", "file": "a file"}
TRAJECTORY_ENDS = ("_trajectory.csv", "_trajectory.sbet")
REMEDY = re.compile(r"; (?=(?:calibrate|check|correct|fly|give|navigate|run|set|use) )")  # begins in a sentence here
RANGE_M = 100.0  # range at which the error of a nominal calibration is given


@dataclass(frozen=True, slots=True)
class Carried:
    """A verdict on a trajectory or a calibration that products are made with.

    Attributes:
        level: care or unusable; never good.
        sentence: which input it is about, and why; without the level's words.
    """

    level: Level
    sentence: str

    @property
    def line(self) -> str:
        """The sentence after its level, as the first line of an output."""
        return f"{self.level.words}: {self.sentence}"

    @property
    def reason(self) -> Reason:
        """The sentence as the gravest reason of a verdict, with its remedy apart."""
        what, *change = REMEDY.split(self.sentence, 1)
        return Reason(self.level, "input", what, "; ".join(change), math.inf)


def verdict_entry(carried: Sequence[Carried], *, accepted: bool) -> dict[str, Any]:
    """Return the verdict entry of a sidecar or a record."""
    level = max((one.level for one in carried), default=Level.GOOD)
    reasons = [{"level": one.level.words, "what": one.sentence} for one in carried]
    return {"level": level.words, "reasons": reasons, "accepted": accepted and level is Level.UNUSABLE}


def first_lines(entry: Mapping[str, Any]) -> list[str]:
    """Return one line for each reason of an entry, the worst first."""
    reasons = sorted(entry.get("reasons", []), key=lambda one: -LEVELS.get(one["level"], Level.GOOD))
    return [f"{one['level']}: {one['what']}" for one in reasons]


@contextmanager
def told_before(carried: Sequence[Carried], *refused: type[Exception]) -> Iterator[None]:
    """Put an unusable input's verdict before any error raised in the block: it is the likely cause.

    Errors of wrong use stay as they are.

    Args:
        carried: verdicts on the inputs.
        refused: errors besides `UserError` whose text can be shown to the user unchanged.

    Raises:
        UserError: an error was raised in the block and an input is unusable; otherwise the error itself is raised.
    """
    told: tuple[type[Exception], ...] = (UserError, *refused)
    try:
        yield
    except told as error:
        wrong_use = isinstance(error, UserError) and error.exit_code != ExitCode.PROBLEM
        bad = next((one.line for one in carried if one.level is Level.UNUSABLE), "")
        if wrong_use or not bad:
            raise
        raise UserError(f"{bad}; therefore: {error}") from error


def refusal(entry: Mapping[str, Any]) -> str:
    """Return the line with which a command exits with code 1; empty if the products are usable or
    the verdict accepted.
    """
    if entry.get("level") != Level.UNUSABLE.words or entry.get("accepted"):
        return ""
    return f"{first_lines(entry)[0]}; use --accept-verdict to accept it"


def acceptance(entry: Mapping[str, Any]) -> str:
    """Return what `refusal` says without the verdict, for a command that has printed that; empty as there."""
    return f'the verdict is "{Level.UNUSABLE.words}"; use --accept-verdict to accept it' if refusal(entry) else ""


# ---------------------------------------------------------------------- calibrations


def calibration_verdicts(setup: Setup, source: str = "") -> Iterator[Carried]:
    """Yield the verdicts on a setup's calibrations.

    Args:
        setup: the setup of a log.
        source: source of its trajectory, ``navigated``, ``ins`` or ``file``; empty if it is not known.
    """
    installation = setup.config.profile.installation
    for name, calibration in setup.calibrations.items():
        header = calibration.header
        level, reasons = LEVELS.get(str(header.get("verdict", "")), Level.GOOD), header.get("verdict_reasons")
        why = f": {reasons[0]}" if isinstance(reasons, list) and reasons else ""
        if calibration.is_nominal:
            yield Carried(Level.UNUSABLE, nominal_words(name, calibration))
        elif level is not Level.GOOD:
            yield Carried(level, f"calibration {calibration.id} of {name}{why}")
        made = str(header.get("installation", ""))
        if made and installation and made != installation:
            yield Carried(
                Level.UNUSABLE,
                f'calibration {calibration.id} of {name}: belongs to installation "{made}", the log to '
                f'"{installation}"; use the calibration of this mounting',
            )
        before = str(header.get("trajectory", ""))
        if {before, source} == {"navigated", "ins"}:
            yield Carried(
                Level.CARE,
                f"calibration {calibration.id} of {name}: was made with {MADE_WITH[before]}, this run uses "
                f"{MADE_WITH[source]}, whose alignment differs; use the same kind of trajectory (swath trajectory, "
                "--trajectory)",
            )


def nominal_words(name: str, calibration: Calibration) -> str:
    """Return a sentence on how far points may be off with a nominal (not estimated) calibration."""
    sigmas = calibration.with_plausible_sigmas().all_sigmas
    off_m = RANGE_M * math.hypot(sigmas[INDEX["omega_rad"]], sigmas[INDEX["phi_rad"]])
    return (
        f"calibration {calibration.id} of {name} is nominal: points may lie {off_m:.1f} m off at {RANGE_M:g} m of "
        "range (one sigma); run swath calibrate, or give --calibration FILE"
    )


# ---------------------------------------------------------------------- trajectories


def trajectory_entry(trajectory: Trajectory, source: str, carried: Sequence[Carried]) -> dict[str, Any]:
    """Return a record's entry on a trajectory; `file_verdicts` reads it for files beside the record."""
    first_ns, last_ns = trajectory.span
    return {
        "name": trajectory.name,
        "source": source,
        "verdict": [{"level": one.level.words, "what": one.sentence} for one in carried],
        "first_gps_ns": first_ns,
        "last_gps_ns": last_ns,
    }


def navigated_verdicts(flight: Navigated) -> Iterator[Carried]:
    """Yield the verdict on each leg that was navigated from this log."""
    for number, leg in enumerate(flight.legs, start=1):
        title = flight.session_id if len(flight.legs) == 1 else f"{flight.session_id}, leg {number}"
        smoothed = leg.solved.smoothed if flight.smooth else None
        seen = Flight(title, leg.solved.forward, smoothed, leg.setup, "", leg.noise_found())
        verdict = judge(figures_of(seen, separation_of(seen)), leg.findings)
        if verdict.level is not Level.GOOD:
            yield Carried(verdict.level, f"navigated trajectory of {title}: {_reason(verdict.as_dict())}")


def navigated_fixed_share(flight: Navigated) -> float | None:
    """Return the share of the positions that navigation used which had fixed ambiguities; None: it used none."""
    used = [used_positions(leg.solved.forward)["fix_type"] for leg in flight.legs]
    types = np.concatenate(used) if used else np.zeros(0)
    return float(np.mean(types == FixType.RTK_FIXED)) if len(types) else None


def file_fixed_share(file: Path, span_ns: tuple[int, int]) -> float | None:
    """Return the same of a trajectory's file for a span of GPS time, from the summary beside it; None: not known."""
    counts: Counter[str] = Counter()
    for beside in _beside(file):
        record = _read(beside)
        if record.get("format") != OF_TRAJECTORY:
            continue
        for leg in (leg for session in record.get("sessions", []) for leg in session.get("legs", [])):
            if leg.get("first_gps_ns", 0) <= span_ns[1] and leg.get("last_gps_ns", 1 << 62) >= span_ns[0]:
                counts.update(((leg.get("figures") or {}).get("positions") or {}).get("fix_types") or {})
        break
    return counts[FixType.RTK_FIXED.name.lower()] / counts.total() if counts.total() else None


def file_verdicts(file: Path, span_ns: tuple[int, int]) -> tuple[list[Carried], str]:
    """Return the verdicts on a trajectory's file for a span of GPS time, from the summary or sidecar beside it.

    Also return where the trajectory came from: ``navigated``, ``ins``, or ``file`` if no file beside it tells.
    """
    for beside in _beside(file):
        record = _read(beside)
        if record.get("format") == OF_TRAJECTORY:
            legs = [leg for session in record.get("sessions", []) for leg in session.get("legs", [])]
            return list(_of_legs(file, legs, span_ns)), SOURCES.get(str(record.get("solution")), "file")
        if record.get("format") in (OF_POINTS, OF_ADJUSTMENT):
            return _of_sidecar(file, record, span_ns)
    return [], "file"


def _beside(file: Path) -> list[Path]:
    named = [file.with_suffix(".json")]
    named += [
        file.with_name(file.name.removesuffix(end) + ".json") for end in TRAJECTORY_ENDS if file.name.endswith(end)
    ]
    return [*named, file.with_name(ADJUSTMENT)]


def _read(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def _of_legs(file: Path, legs: Sequence[Mapping[str, Any]], span_ns: tuple[int, int]) -> Iterator[Carried]:
    for leg in legs:
        verdict = leg.get("verdict") or {}
        level = Level.__members__.get(str(verdict.get("level", "")).upper(), Level.GOOD)
        there = leg.get("first_gps_ns", 0) <= span_ns[1] and leg.get("last_gps_ns", 1 << 62) >= span_ns[0]
        if there and level is not Level.GOOD:
            yield Carried(level, f"trajectory {file}: {_reason(verdict)}")


def _of_sidecar(file: Path, record: Mapping[str, Any], span_ns: tuple[int, int]) -> tuple[list[Carried], str]:
    """Return the verdicts on a trajectory, and its source, from the sidecar of points or the record
    of an adjustment.
    """
    carried: list[Carried] = []
    source = "file"
    for flight in record.get("flights", []):
        entry = flight.get("trajectory", {})
        if entry.get("first_gps_ns", 0) <= span_ns[1] and entry.get("last_gps_ns", 1 << 62) >= span_ns[0]:
            source = str(entry.get("source", source))
            carried += [
                Carried(LEVELS[one["level"]], f"trajectory {file}: {one['what']}")
                for one in entry.get("verdict", [])
                if one.get("level") in LEVELS
            ]
    return carried, source if source in MADE_WITH else "file"


def _reason(verdict: Mapping[str, Any]) -> str:
    """Return the worst reason of a verdict and its remedy."""
    reasons = verdict.get("reasons") or [{"what": verdict.get("sentence", "")}]
    change = reasons[0].get("change")
    return f"{reasons[0]['what']}" + (f"; {change}" if change else "")


def points_verdicts(sidecars: Sequence[Mapping[str, Any]]) -> list[Carried]:
    """Return the verdicts in the sidecars beside points, each reason once; sidecars of other software are ignored."""
    entries = [sidecar.get("verdict") for sidecar in sidecars if sidecar.get("format") == OF_POINTS]
    reasons = [one for verdict in entries if isinstance(verdict, dict) for one in verdict.get("reasons", [])]
    found = [Carried(LEVELS[one["level"]], str(one["what"])) for one in reasons if one.get("level") in LEVELS]
    return list(dict.fromkeys(found))
