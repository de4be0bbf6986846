"""Writes a comparison of strips as lines: the verdict first, a line for each strip, then the worst pairs."""

from __future__ import annotations

from typing import Any

from swath.calib.labels import number
from swath.calib.strips.differences import PairReport
from swath.daemon.processing.strips.compare import WORST_PAIRS, Compared, Judgement, StripRow

PAIR_HEADS = ("cells", "mean", "RMSDz", "95 %", "max", "to plane", "RMS", "noise")
STRIP_HEADS = ("pairs", "cells", "above", "RMSDz", "scatter", "per m²")
WORDS = "above: mean height over the other strips; scatter: of single returns; to plane: of returns, slopes to 45°"


def comparison_lines(done: Compared, level: str | None, *, all_pairs: bool = False) -> list[str]:
    """Return a comparison as lines for people; nothing stands in two of them.

    Args:
        done: the comparison.
        level: quality level that the strips must meet; None: none is required.
        all_pairs: show every pair, not only the worst.
    """
    now = done.now
    return [
        *_verdict_lines(now, level),
        *_change_lines(now, done.before),
        *_strip_lines(now),
        *_pair_lines(now, len(now.pairs()) if all_pairs else WORST_PAIRS),
        *_effect_lines(now),
        *(now.agreement.verdicts() if now.agreement.judged else []),
        now.agreement.measure,
        WORDS,
        *now.strips.notes,
    ]


def _verdict_lines(now: Judgement, level: str | None) -> list[str]:
    """Return the verdict, the remedy of its gravest reason, and all other reasons with theirs."""
    verdict = now.verdict(level)
    first, *others = verdict.reasons or (None,)
    remedy = [f"remedy: {first.change}"] if first is not None and first.change else []
    also = [f"also: {one.what}" + (f"; {one.change}" if one.change else "") for one in others if one is not None]
    return [verdict.sentence, *remedy, *also]


def _change_lines(now: Judgement, before: Judgement | None) -> list[str]:
    if before is None or not (was := before.agreement.numbers) or not (numbers := now.agreement.numbers):
        return []
    figures = [f"RMSDz {_cm(one['rms_m'])} cm, largest {_cm(one['max_m'])} cm" for one in (was, numbers)]
    return [f"before: {figures[0]}; now: {figures[1]}"]


def _strip_lines(now: Judgement) -> list[str]:
    """Return a table of the strips, heights in centimetres."""
    return [_row("strip", *STRIP_HEADS), *map(_strip_line, now.strip_rows())]


def _strip_line(one: StripRow) -> str:
    heights = (_cm(one.above_m, sign=True), _cm(one.rms_m), _cm(one.scatter_m))
    return _row(one.name, str(one.neighbours), f"{one.cells:,}", *heights, number(one.returns_m2, ".1f"))


def _pair_lines(now: Judgement, most: int) -> list[str]:
    """Return a table of the pairs with the largest RMSDz, centimetres, and of all pairs together."""
    pairs = now.pairs()
    rows = [_pair_line(f"{first} − {second}", heights, plane) for first, second, heights, plane in pairs[:most]]
    title = f"the {most} worst of {len(pairs)} pairs, cm (--all-pairs shows all)" if most < len(pairs) else "pairs, cm"
    return [title, _row("strips", *PAIR_HEADS), *rows, _pair_line("all", now.agreement.numbers, now.report.all)]


def _pair_line(name: str, heights: dict[str, Any] | None, to_plane: PairReport | None) -> str:
    """Return a row of the table: first heights, then distances of returns from planes."""
    values = ["–"] * len(PAIR_HEADS)
    if heights is not None:
        values[:5] = [f"{heights['cells']:,}", _cm(heights["mean_m"], sign=True)] + [
            _cm(heights[key]) for key in ("rms_m", "p95_m", "max_m")
        ]
    if to_plane is not None and to_plane.distance.count:
        values[5:] = [f"{to_plane.distance.count:,}", _cm(to_plane.distance.rms_m), _cm(to_plane.noise_m)]
    return _row(name, *values)


def _effect_lines(now: Judgement) -> list[str]:
    """Return what the differences look like, without the effects that the verdict names."""
    if now.signatures is None:
        return []
    lacking = [one.effect.name for one in now.signatures.found if one.level == "not told"]
    lines = [one for one in now.signatures.lines if one not in now.wrong()]
    told = [one for one in lines if one.partition(":")[0] not in lacking]
    return [*told, *([f"not determined by these strips: {', '.join(lacking)}"] if lacking else [])]


def _cm(metres: float | None, *, sign: bool = False) -> str:
    return number(None if metres is None else 100.0 * metres, "+.1f" if sign else ".1f")


def _row(name: str, *values: str) -> str:
    return f"{name:<14}" + "".join(f"{value:>9}" for value in values)
