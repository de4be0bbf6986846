"""Judge a pass over a line moment by moment, and a line by the best of its passes.

Every check has a limit, a time for which it must be exceeded before it counts, and what makes it grave. The rules stand
in `RULES`; docs/flight-plan.md prints them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from swath.daemon.config.tables import PlanConfig
from swath.daemon.processing.flightplan.moments import STEP_S
from swath.georef.arrays import BoolArray, FloatArray, Int64Array, StructArray

INF = math.inf
BRIDGE_S = 0.5  # a limit that is kept for less than this within an excess does not end it
EDGE_S = 0.3  # silence at the begin or end of a line counts from here on
END_S, END_M = 0.5, 15.0  # of a line's begin or end that may be missing, whichever is more
END_STEPS = 1.2  # a moment stands for the way to the next one, which may be off the line
MEAN_S = 1.0  # over which density and height above ground are averaged
LEAST_SHARE = 0.6  # of pulses with a return: with fewer, as over water, the density says nothing
CELL_M, MOST_CELLS = 10.0, 2_000


@dataclass(frozen=True, slots=True)
class Rule:
    """When an excess counts.

    Attributes:
        code: name in ``lines.json``.
        remark_s: an excess of this length is a remark.
        again_s: an excess of this length means that the line must be flown again.
        twice_s: so does an excess of twice the limit of this length.
        share: so does an excess on more than this share of the line.
    """

    code: str
    remark_s: float
    again_s: float = INF
    twice_s: float = INF
    share: float = INF


RULES = (
    Rule("laser_off", 1.0, again_s=1.0),
    Rule("no_returns", 2.0),
    Rule("time", 1.0),
    Rule("gnss", 2.0, again_s=30.0),
    Rule("bank", 0.5, twice_s=0.5, share=0.1),
    Rule("cross_track", 1.0, twice_s=1.0, share=0.1),
    Rule("height", 1.0, twice_s=1.0, share=0.1),
    Rule("speed", 1.0, twice_s=1.0, share=0.1),
    Rule("density", 1.0, twice_s=1.0, share=0.1),
    Rule("losses", 0.0),
)
PLACE = {rule.code: place for place, rule in enumerate(RULES)}
LASER_OFF = 1 << PLACE["laser_off"]


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits for one line; nan: not checked."""

    cross_track_m: float
    height_m: float
    speed_mps: float
    bank_rad: float
    wanted_speed_mps: float
    wanted_above_m: float
    density_per_m2: float

    @classmethod
    def of(cls, config: PlanConfig, speed_mps: float = math.nan) -> Limits:
        """Return the limits of a configuration, for a line with its own planned speed."""
        tolerance, wanted = config.tolerance, config.wanted
        return cls(
            tolerance.cross_track_m,
            tolerance.height_m,
            tolerance.speed_mps,
            math.radians(tolerance.bank_deg),
            speed_mps if not math.isnan(speed_mps) else _or_nan(wanted.speed_mps),
            _or_nan(wanted.height_above_ground_m),
            _or_nan(wanted.density_per_m2),
        )


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


@dataclass(slots=True)
class Reason:
    """Why a line is not simply good.

    Attributes:
        code: of a rule, or ``late_start``, ``early_end``, ``gap``, ``overlap``.
        is_grave: the line must be flown again for it.
        text: a sentence for people.
        value, limit: the worst value and its limit, in the unit of the text; nan: there is none.
        from_m, to_m: extent along the line, in the line's own direction.
        from_gps_ns, to_gps_ns: of the pass that counts there; 0: none.
    """

    code: str
    is_grave: bool
    text: str
    value: float
    limit: float
    from_m: float
    to_m: float
    from_gps_ns: int = 0
    to_gps_ns: int = 0

    def plain(self) -> dict[str, Any]:
        """Return plain values for ``lines.json``."""
        return {
            "code": self.code,
            "grave": self.is_grave,
            "text": self.text,
            "value": _rounded(self.value),
            "limit": _rounded(self.limit),
            "from_m": _rounded(self.from_m),
            "to_m": _rounded(self.to_m),
            "from_gps_ns": self.from_gps_ns or None,
            "to_gps_ns": self.to_gps_ns or None,
        }


def _rounded(value: float) -> float | None:
    return round(value, 2) if math.isfinite(value) else None


@dataclass(slots=True, eq=False)
class Judged:
    """A pass that was judged.

    Attributes:
        rows: its moments (n,).
        remark, again: (n,) bits of the rules by which a moment is remarked, or has to be flown again.
        value: by code, (n,) what was measured.
        limit: by code.
    """

    rows: StructArray
    remark: Int64Array
    again: Int64Array
    value: dict[str, FloatArray] = field(default_factory=dict)
    limit: dict[str, float] = field(default_factory=dict)


def judge(rows: StructArray, limits: Limits) -> Judged:
    """Judge the moments (n,) of a pass in the order of time."""
    judged = Judged(rows, np.zeros(len(rows), np.int64), np.zeros(len(rows), np.int64))
    for code, (value, limit, ratio) in _measured(rows, limits).items():
        rule = RULES[PLACE[code]]
        judged.value[code], judged.limit[code] = value, limit
        bit = 1 << PLACE[code]
        over = ratio > 1.0
        edge_s = EDGE_S if code == "laser_off" else INF
        judged.remark[_lasting(over, rule.remark_s, edge_s)] |= bit
        for mask, least_s in ((over, rule.again_s), (ratio > 2.0, rule.twice_s)):
            if least_s < INF:
                judged.again[_lasting(mask, least_s, edge_s)] |= bit
    return judged


def _measured(rows: StructArray, limits: Limits) -> dict[str, tuple[FloatArray, float, FloatArray]]:
    """Return by code what was measured (n,), its limit, and how many times the limit that is (n,)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        off = (rows["silent"] + rows["untimed"]) * 1.0
        found = {
            "laser_off": (off, 0.0, np.where(off > 0, INF, 0.0)),
            "no_returns": (rows["empty"] * 1.0, 0.0, np.where(rows["empty"] > 0, 1.5, 0.0)),
            "time": (rows["time"] * 1.0, 0.0, np.where(rows["time"] > 0, 1.5, 0.0)),
            "gnss": (rows["fix"] * 1.0, 0.0, np.where(rows["is_fixed_enough"] == 0, 1.5, 0.0)),
            "losses": (rows["lost"] * 1.0, 0.0, np.where(rows["lost"] > 0, 1.5, 0.0)),
        }
        bank = np.abs(rows["roll_rad"])
        found["bank"] = np.degrees(bank), math.degrees(limits.bank_rad), bank / limits.bank_rad
        across = rows["across_m"]
        found["cross_track"] = across, limits.cross_track_m, np.abs(across) / limits.cross_track_m
        height = _height_error(rows, limits)
        found["height"] = height, limits.height_m, np.abs(height) / limits.height_m
        if not math.isnan(limits.wanted_speed_mps):
            faster = rows["speed_mps"] - limits.wanted_speed_mps
            found["speed"] = faster, limits.speed_mps, np.abs(faster) / limits.speed_mps
        if not math.isnan(limits.density_per_m2):
            density = density_of(rows)
            found["density"] = density, limits.density_per_m2, limits.density_per_m2 / density
    return {code: (value, limit, np.nan_to_num(ratio, nan=0.0)) for code, (value, limit, ratio) in found.items()}


def _height_error(rows: StructArray, limits: Limits) -> FloatArray:
    """Return (n,) height above the planned one: ellipsoidal if the plan has it, else above ground; nan: no plan."""
    wanted = np.where(np.isnan(rows["planned_above_m"]), limits.wanted_above_m, rows["planned_above_m"])
    above = _mean(rows["above_m"]) - wanted
    error: FloatArray = np.where(np.isnan(rows["planned_m"]), above, rows["height_m"] - rows["planned_m"])
    return error


def density_of(rows: StructArray) -> FloatArray:
    """Return (n,) first returns on a square metre of the swath, over a second; nan where it says nothing."""
    width = rows["right_m"] - rows["left_m"]
    density = _mean(rows["returns"] * 1.0) / (_mean(width) * _mean(rows["speed_mps"]) * STEP_S)
    says = (rows["silent"] + rows["empty"] + rows["untimed"]) == 0
    says &= (rows["pulses"] < 0) | (rows["returns"] >= LEAST_SHARE * rows["pulses"])
    found: FloatArray = np.where(says, density, math.nan)
    return found


def _mean(values: FloatArray) -> FloatArray:
    """Return means over `MEAN_S` about each moment, of the values that are known."""
    half = round(MEAN_S / STEP_S) // 2
    known = ~np.isnan(values)
    sums = np.concatenate([[0.0], np.cumsum(np.where(known, values, 0.0))])
    counts = np.concatenate([[0], np.cumsum(known)])
    places = np.arange(len(values))
    first, last = np.maximum(places - half, 0), np.minimum(places + half + 1, len(values))
    mean: FloatArray = (sums[last] - sums[first]) / np.maximum(counts[last] - counts[first], 1)
    return np.where(counts[last] > counts[first], mean, math.nan)


def _lasting(mask: BoolArray, least_s: float, edge_s: float) -> BoolArray:
    """Return the mask without runs shorter than a time; those at either end count from ``edge_s`` on.

    Pauses shorter than `BRIDGE_S` do not end a run.
    """
    found = np.zeros(len(mask), np.bool_)
    if not mask.any():
        return found
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    joined: list[list[int]] = []
    for start, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if joined and (start - joined[-1][1]) * STEP_S < BRIDGE_S:
            joined[-1][1] = end
        else:
            joined.append([start, end])
    for start, end in joined:
        touches = start == 0 or end == len(mask)
        if (end - start) * STEP_S >= (min(edge_s, least_s) if touches else least_s) - 1e-9:
            found[start:end] = True
    return found


# ---------------------------------------------------------------------------------------------- lines


@dataclass(frozen=True, slots=True, eq=False)
class LineVerdict:
    """The verdict on a line by all its passes.

    Attributes:
        reasons: what is wrong, the gravest first.
        flown: (cells,) True where the line was flown with the laser on.
        cell_m: length of a cell.
        left_m, right_m: (cells,) edges of the swath from the line, in its own direction; nan: unknown.
        across_m: (cells,) where it was flown.
    """

    reasons: list[Reason]
    flown: BoolArray
    cell_m: float
    left_m: FloatArray
    right_m: FloatArray
    across_m: FloatArray

    @property
    def is_again(self) -> bool:
        """True if the line must be flown again."""
        return any(reason.is_grave for reason in self.reasons)


def judge_line(passes: Sequence[Judged], length_m: float) -> LineVerdict:
    """Judge a line by its passes: on each piece of it the best one counts.

    Args:
        passes: judged passes, at least one, each with moments.
        length_m: of the line.
    """
    cell_m = max(CELL_M, length_m / MOST_CELLS)
    count = max(1, math.ceil(length_m / cell_m - 1e-9))
    cells = [_Cells(one, count, cell_m) for one in passes]
    best = np.argmax(np.stack([one.score for one in cells]), axis=0)
    chosen = _Chosen(cells, best)
    covered = chosen.take("flown") & (chosen.take("again") & LASER_OFF == 0)
    speed_mps = float(np.median(passes[-1].rows["speed_mps"]))
    is_reverse = bool(passes[-1].rows["along_m"][0] > passes[-1].rows["along_m"][-1])
    margin_m = max(END_M, END_S * speed_mps)
    reasons = _uncovered(chosen, covered, cell_m, length_m, margin_m, is_reverse=is_reverse)
    reasons += [reason for rule in RULES if (reason := _reason(rule, chosen, covered, cell_m, length_m)) is not None]
    reasons.sort(key=lambda reason: not reason.is_grave)
    left, right, across = (chosen.take(name) for name in ("left_m", "right_m", "across_m"))
    return LineVerdict(reasons, covered, cell_m, left, right, across)


class _Cells:
    """A pass by pieces of its line."""

    def __init__(self, judged: Judged, count: int, cell_m: float) -> None:
        rows = judged.rows
        self.judged, self.count = judged, count
        along = rows["along_m"].copy()
        if len(along) > 1:  # a line ends between two moments
            along[0] += (along[0] - along[1]) * END_STEPS
            along[-1] += (along[-1] - along[-2]) * END_STEPS
        self.cell = np.clip((along / cell_m).astype(np.int64), 0, count - 1)
        step = np.diff(rows["gps_ns"]) <= round(5 * STEP_S * 1e9)
        self._low, self._high = np.minimum(self.cell[:-1], self.cell[1:]), np.maximum(self.cell[:-1], self.cell[1:])
        self.flown = self._spread(step)
        self.flown[self.cell] = True
        self.remark, self.again = np.zeros(count, np.int64), np.zeros(count, np.int64)
        for bits, told in ((self.remark, judged.remark), (self.again, judged.again)):
            for place in range(len(RULES)):
                flagged = told & (1 << place) != 0
                if flagged.any():
                    spread = self._spread(flagged[:-1] & flagged[1:] & step)
                    spread[self.cell[flagged]] = True
                    bits[spread] |= 1 << place
        self.score = np.where(self.flown, 3 - (self.remark != 0) - (self.again != 0), 0)
        turned = rows["along_m"][-1] < rows["along_m"][0]
        left, right = (-rows["right_m"], -rows["left_m"]) if turned else (rows["left_m"], rows["right_m"])
        self.across_m = self._filled(rows["across_m"])
        self.left_m, self.right_m = self._filled(left + rows["across_m"]), self._filled(right + rows["across_m"])

    def _spread(self, steps: BoolArray) -> BoolArray:
        """Return the cells that steps between moments cover."""
        change = np.zeros(self.count + 1, np.int64)
        np.add.at(change, self._low[steps], 1)
        np.add.at(change, self._high[steps] + 1, -1)
        covered: BoolArray = np.cumsum(change[:-1]) > 0
        return covered

    def _filled(self, values: FloatArray) -> FloatArray:
        known = ~np.isnan(values)
        if not known.any():
            return np.full(self.count, math.nan)
        order = np.argsort(self.cell[known], kind="stable")
        filled: FloatArray = np.interp(np.arange(self.count), self.cell[known][order], values[known][order])
        return np.where(self.flown, filled, math.nan)

    def rows_of(self, mask: BoolArray) -> BoolArray:
        """Return the moments that lie in the masked cells."""
        within: BoolArray = mask[self.cell]
        return within


class _Chosen:
    """The best pass of each cell."""

    def __init__(self, cells: Sequence[_Cells], best: Int64Array) -> None:
        self.cells, self.best = cells, best

    def take(self, name: str) -> Any:
        return np.stack([getattr(one, name) for one in self.cells])[self.best, np.arange(len(self.best))]

    def span(self, mask: BoolArray) -> tuple[int, int]:
        """Return the GPS times of the first and the last moment in the masked cells; 0 if there is none."""
        times = [one.judged.rows["gps_ns"][one.rows_of(mask & (self.best == place))] for place, one in self._places()]
        found = np.concatenate(times) if times else np.empty(0, np.int64)
        return (int(found.min()), int(found.max())) if len(found) else (0, 0)

    def values(self, code: str, mask: BoolArray) -> FloatArray:
        """Return what was measured in the masked cells where the rule is broken."""
        found = []
        for place, one in self._places():
            if code in one.judged.value:
                inside = one.rows_of(mask & (self.best == place)) & (one.judged.remark >> PLACE[code] & 1 == 1)
                found.append(one.judged.value[code][inside])
        return np.concatenate(found) if found else np.empty(0)

    def _places(self) -> list[tuple[int, _Cells]]:
        return list(enumerate(self.cells))


def _runs(mask: BoolArray) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _uncovered(
    chosen: _Chosen, covered: BoolArray, cell_m: float, length_m: float, margin_m: float, *, is_reverse: bool
) -> list[Reason]:
    """Return why pieces of the line have no points: flown too late or too early, or not, or with the laser off."""
    reasons: list[Reason] = []
    lost = 0
    worst: tuple[float, int, int] | None = None
    for start, end in _runs(~covered):
        size_m = min(end * cell_m, length_m) - start * cell_m
        from_m, to_m = start * cell_m, min(end * cell_m, length_m)
        if size_m <= margin_m + cell_m:
            continue
        if start == 0 and end == len(covered):
            reasons.append(_nothing(chosen, length_m))
        elif start == 0 or end == len(covered):
            is_late = (start == 0) != is_reverse
            text = f"begins {size_m:.0f} m late" if is_late else f"ends {size_m:.0f} m early"
            code = "late_start" if is_late else "early_end"
            reasons.append(Reason(code, True, text, size_m, margin_m, from_m, to_m))
        else:
            lost += 1
            worst = max(worst or (0.0, 0, 0), (size_m, start, end))
    if worst is not None:
        size_m, start, end = worst
        mask = np.zeros(len(covered), np.bool_)
        mask[start:end] = True
        is_silent = bool((chosen.take("again")[mask] & LASER_OFF).any())
        more = f", and {lost - 1} more" if lost > 1 else ""
        code, what = _silence(chosen, mask) if is_silent else ("gap", "not flown")
        text = f"{what} from {start * cell_m:.0f} to {min(end * cell_m, length_m):.0f} m{more}"
        times = chosen.span(mask)
        reasons.append(Reason(code, True, text, size_m, margin_m, start * cell_m, min(end * cell_m, length_m), *times))
    return reasons


def _silence(chosen: _Chosen, mask: BoolArray) -> tuple[str, str]:
    """Return code and text for cells without points: most of the moments there have returns without time, or none."""
    untimed = count = 0
    for place, one in enumerate(chosen.cells):
        inside = one.rows_of(mask & (chosen.best == place))
        untimed += int((one.judged.rows["untimed"][inside] > 0).sum())
        count += int(inside.sum())
    return ("time", "returns without time") if 2 * untimed > count else ("laser_off", "no returns")


def _nothing(chosen: _Chosen, length_m: float) -> Reason:
    mask = np.ones(len(chosen.best), np.bool_)
    code, what = _silence(chosen, mask)
    return Reason(code, True, f"{what} on the whole line", length_m, 0.0, 0.0, length_m, *chosen.span(mask))


def _reason(rule: Rule, chosen: _Chosen, covered: BoolArray, cell_m: float, length_m: float) -> Reason | None:
    """Return the reason of one rule; None if it is kept. Pieces without points have their own."""
    if rule.code == "laser_off":
        return None
    bit = 1 << PLACE[rule.code]
    mask = (chosen.take("remark") & bit != 0) & covered
    if not mask.any():
        return None
    values = chosen.values(rule.code, mask)
    if not len(values):
        return None
    limit = next(one.judged.limit[rule.code] for one in chosen.cells if rule.code in one.judged.limit)
    value = float(values.min() if rule.code in ("density", "gnss") else values[np.argmax(np.abs(values))])
    size_m = float(mask.sum()) * cell_m
    is_grave = bool((chosen.take("again")[mask] & bit).any()) or size_m > rule.share * length_m
    places = np.flatnonzero(mask)
    from_m, to_m = float(places[0]) * cell_m, min(float(places[-1] + 1) * cell_m, length_m)
    text = _text(rule.code, value, limit, values)
    text = f"{text}, {from_m:.0f} to {to_m:.0f} m" if size_m < 0.98 * length_m else f"{text}, on the whole line"
    return Reason(rule.code, is_grave, text, value, limit, from_m, to_m, *chosen.span(mask))


def _text(code: str, value: float, limit: float, values: FloatArray) -> str:
    seconds = f"{len(values) * STEP_S:.0f} s"
    side, level = ("right" if value > 0 else "left"), ("high" if value > 0 else "low")
    texts: Mapping[str, str] = {
        "no_returns": f"no pulse came back for {seconds}, as over water",
        "time": f"time not locked for {seconds}",
        "gnss": f"{'no GNSS position' if value <= 0 else 'GNSS not fixed'} for {seconds}",
        "bank": f"bank {value:.0f}° over the limit of {limit:g}°",
        "cross_track": f"{abs(value):.0f} m {side} of the line, over {limit:g} m",
        "height": f"{abs(value):.0f} m too {level}, over {limit:g} m",
        "speed": f"{abs(value):.0f} m/s too {'fast' if value > 0 else 'slow'}, over {limit:g} m/s",
        "density": f"density {value:.1f} per m² below {limit:g}",
        "losses": f"{values.sum():.0f} units of a scanner lost",
    }
    return texts[code]
