"""Judge what is known of a flight before landing: one check for each question, and the sentence that they make.

Everything here takes plain values; docs/console.md prints the rules. What is not known is said, and never good.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from swath.calib.strips.standards import QUALITY_LEVELS
from swath.daemon.config.tables import PlanWantedConfig
from swath.daemon.processing.flightplan.overlap import Pair
from swath.daemon.processing.landing.command import AGAIN, FLY_AGAIN, GOOD, HOME, OPEN, REMARK, UNKNOWN, WAIT
from swath.daemon.processing.landing.facts import LogFacts, Standing
from swath.daemon.processing.landing.tracks import FlownPairs
from swath.daemon.processing.pages.words import size_words
from swath.georef.arrays import FloatArray
from swath.georef.timescales.gps_time import SECOND_NS

SHOWN_NAMES = 20
SPARSE_REMARK, SPARSE_AGAIN = 0.05, 0.10  # of the blocks that may lie below the density, and below half of it
USUAL_LEVEL = "QL2"  # of the height differences of strips, if ``quality_level`` names none
NO_ECHO = "no echo came back: water, or a surface that swallows light"
ENOUGH_CORRECTIONS = 0.95  # of the flight


@dataclass(frozen=True, slots=True)
class Check:
    """One question and its answer.

    Attributes:
        code: name in ``verdict.json``.
        title: the question in a word or two.
        state: good; remark: usable, look at it; again: fly again; unknown; open: something that still has to be done.
        text: the answer in a sentence.
        details: more of it, a line each.
    """

    code: str
    title: str
    state: str
    text: str
    details: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class FoundGap:
    """A gap and what is known of its place.

    Attributes:
        number: from 1, the largest first.
        east_m, north_m: place in the frame ``local``.
        lat_deg, lon_deg: the same place; None: not known.
        area_m2, width_m, length_m: size.
        line: the nearest line; empty: there is no plan.
        under: lines whose swaths covered nearly all of it, so that the laser was there.
        water: no gap: pulses came here whose echo did not return.
    """

    number: int
    east_m: float
    north_m: float
    lat_deg: float | None
    lon_deg: float | None
    area_m2: float
    width_m: float
    length_m: float
    line: str = ""
    under: tuple[str, ...] = ()
    water: bool = False

    def plain(self) -> dict[str, Any]:
        """Return plain values for ``verdict.json``."""
        return asdict(self) | {"under": list(self.under), "grave": not self.under and not self.water, "text": self.text}

    @property
    def text(self) -> str:
        """The gap in words."""
        if self.water:
            return f"{size_words(self.area_m2)}, {self.width_m:.0f} m wide; {NO_ECHO}"
        where = f", nearest to line {self.line}" if self.line and not self.under else ""
        said = f"{size_words(self.area_m2)}, {self.width_m:.0f} m wide{where}"
        if self.under:
            said += f"; flown over on {_lines(self.under)} and without an echo: water, or a surface that swallows light"
        return said


@dataclass(frozen=True, slots=True)
class Covered:
    """How the area is covered.

    Attributes:
        has_area: an area is planned; without one, gaps are looked for between points only.
        wanted_m2, covered_m2: size of the area, and of its part with points.
        cell_m: side of the cells; what is narrower is not seen.
        gaps: of at least the wanted size, the largest ones.
        more: number of further gaps of that size.
        water_m2: size of the part of the area where pulses came back without an echo alone.
        waters: the largest of its pieces of at least the wanted size.
        densities: first returns on a square metre (n,) of squares within the area.
    """

    has_area: bool
    wanted_m2: float
    covered_m2: float
    cell_m: float
    gaps: tuple[FoundGap, ...] = ()
    more: int = 0
    water_m2: float = 0.0
    waters: tuple[FoundGap, ...] = ()
    densities: FloatArray = field(default_factory=lambda: np.zeros(0))


def _lines(names: Sequence[str], word: str = "line") -> str:
    """Return names of lines in words: ``lines 4, 9``; strips bear the word in their names."""
    shown = ", ".join(names[:SHOWN_NAMES])
    more = f" and {len(names) - SHOWN_NAMES} more" if len(names) > SHOWN_NAMES else ""
    if all(name.startswith("strip ") for name in names):
        return shown + more
    return f"{word}{'s' if len(names) > 1 else ''} {shown}{more}"


def of_state(lines: Mapping[str, Any], *states: str) -> list[str]:
    """Return the names of the lines in these states."""
    return [line["name"] for line in lines["lines"] if line["state"] in states]


# ---------------------------------------------------------------------------------------------- lines


def lines_check(lines: Mapping[str, Any], trouble: str) -> Check:
    """Judge the lines of ``lines.json``."""
    again, planned, flying = (of_state(lines, state) for state in ("again", "planned", "flying"))
    good, remarks = of_state(lines, "good"), of_state(lines, "remarks")
    details = [
        f"{_named(line['name'])}: {_why(line)}" for line in lines["lines"] if line["state"] in ("again", "remarks")
    ]
    said = [f"{len(good)} good", f"{len(remarks)} with remarks" if remarks else ""]
    said += [f"{_lines(again)} to be flown again" if again else "", f"{_lines(planned)} not flown" if planned else ""]
    text = ", ".join(part for part in said if part)
    if trouble:
        return Check("lines", "Lines", UNKNOWN, f"{trouble}; strips: {text}", tuple(details))
    if again or planned:
        return Check("lines", "Lines", AGAIN, text, tuple(details))
    if flying:
        return Check("lines", "Lines", OPEN, f"{text}; {_lines(flying)} is being flown", tuple(details))
    if not lines["lines"]:
        return Check("lines", "Lines", UNKNOWN, "no plan, and no strip has been flown")
    if lines["plan"] is None:
        return Check("lines", "Lines", UNKNOWN, f"{text}; no plan says whether these are all", tuple(details))
    return Check("lines", "Lines", REMARK if remarks else GOOD, text, tuple(details))


def _named(name: str) -> str:
    return name if name.startswith("strip ") else f"line {name}"


def _why(line: Mapping[str, Any]) -> str:
    overruled = line.get("overruled")
    words = [reason["text"] for reason in line["reasons"]]
    if overruled is not None:
        verdict = "accepted by the operator" if overruled["verdict"] == "accepted" else "operator: fly again"
        words.insert(0, f"{verdict}, {overruled['note']}" if overruled["note"] else verdict)
    return "; ".join(words)


# ---------------------------------------------------------------------------------------------- area


def gaps_check(lines: Mapping[str, Any], covered: Covered | None, limit_m2: float) -> Check:
    """Judge the gaps; those of a line that the operator has accepted are accepted too."""
    title = "Gaps"
    if covered is None:
        return Check("gaps", title, UNKNOWN, "no point yet")
    bare = _bare(lines, covered)
    details = [f"gap {gap.number}: {gap.text}" for gap in covered.gaps]
    details += [f"water {one.number}: {one.text}" for one in covered.waters]
    if covered.more:
        details.append(f"and {covered.more} smaller ones, whose places are not looked at")
    count = len(covered.gaps) + covered.more
    share = 100.0 * covered.covered_m2 / max(covered.wanted_m2, 1e-9)
    size = f"{size_words(covered.wanted_m2)} of the area, {share:.2f} % with points"
    found = f"{count} of {limit_m2:g} m² and more" if covered.gaps else f"none of {limit_m2:g} m² or more"
    found += f", in cells of {covered.cell_m:g} m"
    if covered.water_m2 >= limit_m2:
        found += f"; {size_words(covered.water_m2)} without an echo, as over water"
    if not covered.has_area:
        text = (
            f"{found}, between points up to 25 m apart; no area is planned, so that what is missing beside is unknown"
        )
        return Check("gaps", title, AGAIN if bare else UNKNOWN, text, tuple(details))
    state = AGAIN if bare else REMARK if covered.gaps or covered.waters else GOOD
    return Check("gaps", title, state, f"{found}; {size}", tuple(details))


def _bare(lines: Mapping[str, Any], covered: Covered) -> list[FoundGap]:
    """Return the gaps that no swath has covered and no line explains that the operator has accepted."""
    accepted = _accepted(lines)
    return [gap for gap in covered.gaps if not gap.under and gap.line not in accepted]


def _accepted(lines: Mapping[str, Any]) -> set[str]:
    return {line["name"] for line in lines["lines"] if (line.get("overruled") or {}).get("verdict") == "accepted"}


def density_check(lines: Mapping[str, Any], wanted: PlanWantedConfig, covered: Covered | None) -> Check:
    """Judge the density of first returns: of the lines alone, and of all of them together."""
    title, least = "Density", wanted.density_per_m2
    values = np.zeros(0) if covered is None else covered.densities
    if not len(values):
        return Check("density", title, UNKNOWN, "no square of the area is covered yet")
    low, middle = np.quantile(values, [0.05, 0.5]).tolist()
    measured = f"{middle:.1f} first returns per m² in the middle, 95 % of the area above {low:.1f}"
    if least is None:
        return Check("density", title, UNKNOWN, f"{measured}; [plan.wanted] density_per_m2 says not what is wanted")
    below, half = float(np.mean(values < least)), float(np.mean(values < least / 2.0))
    details = _reasons(lines, "density")
    text = f"{measured}; wanted {least:g}, less on {100 * below:.1f} %"
    grave = half > SPARSE_AGAIN or any(reason["grave"] for _, reason in _with(lines, "density"))
    state = AGAIN if grave else REMARK if below > SPARSE_REMARK or details else GOOD
    return Check("density", title, state, text, details)


def overlap_check(
    lines: Mapping[str, Any], wanted: PlanWantedConfig, differences: Mapping[str, Any], pairs: Sequence[Pair] = ()
) -> Check:
    """Judge the overlap of neighbouring lines, and say how well strips agree in height.

    Args:
        lines: as in ``lines.json``.
        wanted: what the plan wants.
        differences: figures of all strips' height differences, as in ``coverage.json``.
        pairs: neighbouring lines that have been flown.
    """
    title = "Overlap"
    said = "no two strips have been compared in height"
    rms_m = differences.get("rms_m")
    if rms_m is not None:
        said = f"heights of strips agree to {100 * rms_m:.1f} cm (RMS over {differences['cells']:,} cells)"
    least = _pair_words(pairs, wanted.overlap_percent)
    if wanted.overlap_percent is None:
        text = f"{said}; [plan.wanted] overlap_percent says not how much overlap is wanted"
        return Check("overlap", title, UNKNOWN, text, least)
    if lines["plan"] is None:
        return Check("overlap", title, UNKNOWN, f"{said}; without a plan the overlap is not judged")
    details = _reasons(lines, "overlap")
    grave = any(reason["grave"] for _, reason in _with(lines, "overlap"))
    accepted = _accepted(lines)
    lacking = [
        one
        for one in pairs
        if 100.0 * one.least < wanted.overlap_percent and one.first not in accepted and one.second not in accepted
    ]
    lacks = f"less than {wanted.overlap_percent:g} % of {_count(lacking)}" if lacking else "as wanted"
    if details:
        lacks = f"less than {wanted.overlap_percent:g} % on {len(details)} lines"
    level = next(one for one in QUALITY_LEVELS if one.name == (wanted.quality_level or USUAL_LEVEL))
    disagree = rms_m is not None and rms_m > level.overlap_m
    if disagree:
        said += f", {level.name} allows {100 * level.overlap_m:.0f} cm; calibration or trajectory may explain it"
    state = AGAIN if grave else REMARK if details or lacking or disagree else GOOD
    return Check("overlap", title, state, f"{lacks}; {said}", (*details, *least))


def _count(pairs: Sequence[Pair]) -> str:
    return f"{len(pairs)} pair{'s' if len(pairs) > 1 else ''} of lines"


def _pair_words(pairs: Sequence[Pair], wanted_percent: float | None) -> tuple[str, ...]:
    """Return the least overlap of pairs in words, the worst ones first."""
    limit = "" if wanted_percent is None else f", wanted {wanted_percent:g} %"
    ordered = sorted(pairs, key=lambda one: one.least)
    words = [
        f"lines {one.first} and {one.second}: "
        + (f"least overlap {100 * one.least:.0f} %{limit}" if one.least >= 0.0 else f"a gap{limit}")
        for one in ordered[:SHOWN_NAMES]
    ]
    if len(ordered) > SHOWN_NAMES:
        words.append(f"{_count(ordered[SHOWN_NAMES:])} more: at least {100 * ordered[SHOWN_NAMES].least:.0f} %{limit}")
    return tuple(words)


def _with(lines: Mapping[str, Any], code: str) -> list[tuple[str, Mapping[str, Any]]]:
    """Return lines and their reasons of a code, without those that the operator has accepted."""
    accepted = _accepted(lines)
    return [
        (line["name"], reason)
        for line in lines["lines"]
        for reason in line["reasons"]
        if reason["code"] == code and line["name"] not in accepted
    ]


def _reasons(lines: Mapping[str, Any], code: str) -> tuple[str, ...]:
    return tuple(f"{_named(name)}: {reason['text']}" for name, reason in _with(lines, code))


# ---------------------------------------------------------------------------------------------- the rest


def calibration_check(pairs: FlownPairs, calibration: Mapping[str, Any]) -> Check:
    """Judge whether the flight needs calibration lines, and which have been flown.

    Args:
        pairs: what was flown.
        calibration: entry of `swath.daemon.processing.carried_verdict.verdict_entry`.
    """
    said = ", ".join(
        f"{words} {'flown' if count else 'not flown'}{f' ({count})' if count > 1 else ''}"
        for words, count in (
            ("opposite lines", pairs.opposite),
            ("crossing lines", pairs.crossing),
            ("two heights", pairs.heights),
        )
    )
    reasons = [str(one["what"]) for one in calibration.get("reasons", [])]
    title = "Calibration lines"
    if not reasons:
        return Check("calibration", title, GOOD, f"the calibration in use is good; {said}")
    complete = pairs.opposite and pairs.crossing and pairs.heights
    text = f"{said}; the calibration in use is {calibration.get('level', 'not known')}"
    return Check("calibration", title, GOOD if complete else REMARK, text, tuple(reasons))


def base_check(facts: LogFacts, configured: Sequence[str]) -> Check:
    """Say what is known of base data.

    Args:
        facts: of the log.
        configured: names of ``[corrections.*]``.
    """
    title, details = "Base data", list(_fix_words(facts))
    if not configured:
        text = (
            "no [corrections] are configured: whether a base station recorded the whole flight is not known here; "
            "swath landing --base tells it by the station's files"
        )
        return Check("base", title, UNKNOWN, text, tuple(details))
    begin_ns, end_ns = facts.read_from_ns or 0, facts.newest_ns
    worst, texts = GOOD, []
    for name in configured:
        heard = facts.heard.get(f"corrections/{name}")
        if heard is None:
            worst = REMARK
            texts.append(f"{name}: nothing was recorded")
            continue
        missing_ns = max(0, heard.first_ns - begin_ns) + max(0, end_ns - heard.last_ns) + heard.paused_ns
        share = 1.0 - missing_ns / max(1, end_ns - begin_ns)
        texts.append(
            f"{name}: corrections during {100 * max(0.0, share):.0f} % of the flight, "
            f"longest pause {heard.longest_ns / SECOND_NS:.0f} s"
        )
        worst = worst if share >= ENOUGH_CORRECTIONS else REMARK
    text = "; ".join(texts) + "; observations of a base are not looked for in them"
    return Check("base", title, worst, text, tuple(details))


def _fix_words(facts: LogFacts) -> Sequence[str]:
    found = []
    for source, counts in sorted(facts.fixes.items()):
        total = counts.total()
        shares = ", ".join(f"{name} {100 * count / total:.0f} %" for name, count in counts.most_common())
        found.append(f"{source}: {shares} of {total:,} positions")
    return found


def static_check(facts: LogFacts, wanted_s: float) -> Check:
    """Judge how long the aircraft stood still before and after the flight."""
    title = "Standing still"
    if not wanted_s:
        return Check("static", title, GOOD, "[plan.wanted] static_s wants none")
    standing = max(facts.standing.values(), key=lambda one: one.before_s + one.after_s, default=Standing())
    if standing.first_ns is None:
        return Check("static", title, UNKNOWN, "no receiver has sent a position")
    before = f"{standing.before_s:.0f} s before take-off"
    if not standing.has_flown:
        return Check("static", title, OPEN, f"{before} so far; the aircraft has not flown yet")
    enough = standing.before_s >= wanted_s
    before += "" if enough else f", less than {wanted_s:g} s"
    if facts.late_ns:
        before, enough = f"before take-off not known, because swath live began later ({before})", False
    if standing.after_s >= wanted_s:
        return Check("static", title, GOOD if enough else REMARK, f"{before}; {standing.after_s:.0f} s after landing")
    if not facts.has_ended:
        text = f"{before}; after landing stand still for {wanted_s:g} s before switching off"
        return Check("static", title, OPEN if enough else REMARK, text)
    text = f"{before}; {standing.after_s:.0f} s after landing, less than {wanted_s:g} s"
    return Check("static", title, REMARK, text)


def log_check(facts: LogFacts, follower: Mapping[str, Any]) -> Check:
    """Judge whether the log is complete.

    Args:
        facts: of the log.
        follower: ``part``, ``damaged_chunks``, ``live_skipped_s`` of live.
    """
    title, state, words, details = "Log", GOOD, [], []
    part = follower.get("part")
    words.append(f"{part + 1} part{'s' if part else ''}" if isinstance(part, int) else "")
    lost = facts.lost
    if lost:
        state = REMARK
        words.append("units lost: " + ", ".join(f"{source} {count:,}" for source, count in lost.items()))
    if facts.unaccounted:
        state = REMARK
        words.append("units not accounted for: " + ", ".join(f"{s} {n:,}" for s, n in facts.unaccounted.items()))
    if follower.get("damaged_chunks"):
        state = REMARK
        words.append(f"{follower['damaged_chunks']} damaged chunks")
    if facts.errors:
        state = REMARK
        words.append(f"{facts.errors} errors among the events")
        details += facts.troubles
    troubles = [] if facts.has_ended else facts.source_troubles
    if troubles:
        state = REMARK
        details += [f"now: {words}" for words in troubles]
    if state == GOOD:
        words.append("every unit written" if facts.statuses else "")
    if facts.late_ns:
        state = UNKNOWN if state == GOOD else state
        words.append(
            f"swath live began {facts.late_ns / SECOND_NS:.0f} s or more after the recording: "
            "what was flown before is not judged here"
        )
    if follower.get("live_skipped_s"):
        state = UNKNOWN if state == GOOD else state
        words.append(f"{follower['live_skipped_s']:.0f} s were not looked at, because this computer was too slow")
    if not facts.statuses:
        state = UNKNOWN if state == GOOD else state
        words.append("the log has no account of units")
    return Check("log", title, state, "; ".join(word for word in words if word), tuple(details))


# ---------------------------------------------------------------------------------------------- the sentence


def sentence(lines: Mapping[str, Any], checks: Sequence[Check], covered: Covered | None) -> tuple[str, str]:
    """Return `HOME`, `FLY_AGAIN` or `WAIT`, and the verdict in one sentence."""
    again, planned, flying = (of_state(lines, state) for state in ("again", "planned", "flying"))
    gaps = [] if covered is None else _bare(lines, covered)
    parts = [f"Fly again: {_lines(again)}" if again else "", f"Not flown: {_lines(planned)}" if planned else ""]
    own = [gap for gap in gaps if gap.line not in {*again, *planned, *flying}]
    if own:
        beside = list(dict.fromkeys(gap.line for gap in own if gap.line))
        parts.append(f"Close gaps: {len(own)}" + (f", beside {_lines(beside)}" if beside else ""))
    density = next((one for one in checks if one.code == "density"), None)
    if density is not None and density.state == AGAIN and not again:
        parts.append("Density: too low")
    parts = [part for part in parts if part]
    if parts:
        return FLY_AGAIN, ". ".join(parts)
    if flying:
        return WAIT, f"Wait: {_lines(flying)} is being flown"
    if not lines["lines"]:
        return WAIT, "Nothing has been flown yet"
    return HOME, home_sentence([(one.state, one.title) for one in checks])


def home_sentence(checks: Sequence[tuple[str, str]]) -> str:
    """Return the sentence of a flight that may go home, by states and titles of the checks."""
    words = ["You can go home"]
    for state, said in ((REMARK, "With remarks"), (UNKNOWN, "Not known"), (OPEN, "Still to do")):
        titles = [title.lower() for one, title in checks if one == state]
        if titles:
            words.append(f"{said}: {', '.join(titles)}")
    return ". ".join(words)
