"""Judges whether a navigated flight may be used: a table of limits on its figures, and a sentence."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Protocol

from swath.daemon.processing.trajectory.figures import ANGLES, AXES_B, AXES_L, Figures, accuracy_words
from swath.georef.verdicts import Level, Reason, Rule, Verdict, worst_first

Measure = Callable[[Figures], Iterator[tuple[str, float | None]]]


class Found(Protocol):
    """A finding of `swath.georef.navigation.diagnosis.diagnose`."""

    @property
    def code(self) -> str: ...

    @property
    def severity(self) -> str: ...

    @property
    def text(self) -> str: ...


def _one(*keys: str) -> Measure:
    """Return a measure of the figure at a path of keys."""

    def measure(figures: Figures) -> Iterator[tuple[str, float | None]]:
        value: Any = figures
        for key in keys:
            value = None if value is None else value.get(key)
        yield "", value

    return measure


def _largest(group: str, *keys: str) -> Measure:
    """Return a measure of the largest of a group's figures; it is not judged if all are unknown."""

    def measure(figures: Figures) -> Iterator[tuple[str, float | None]]:
        known = [(figures[group][key], key) for key in keys if figures[group][key] is not None]
        if known:
            value, key = max(known)
            yield key.partition("_")[0], value

    return measure


def _share(*fates: str) -> Measure:
    """Return a measure of the share of observations of each kind that met one of these fates."""

    def measure(figures: Figures) -> Iterator[tuple[str, float | None]]:
        for kind, row in figures["observations"].items():
            yield kind.replace("_", " "), sum(row[fate] for fate in fates) / max(row["seen"], 1)

    return measure


def _of_kinds(key: str, *, inverse: bool = False) -> Measure:
    """Return a measure of a figure of each kind of observation."""

    def measure(figures: Figures) -> Iterator[tuple[str, float | None]]:
        for kind, row in figures["observations"].items():
            value = row[key]
            yield kind.replace("_", " "), (1 / max(value, 1e-3) if inverse and value is not None else value)

    return measure


def _noise_found(figures: Figures) -> Iterator[tuple[str, float | None]]:
    """Yield the factors on sigmas that the innovations suggest."""
    yield from figures["noise_found"].items()


def _sensor(*names: str) -> Measure:
    """Return a measure of the largest estimate on an axis, in sigmas of the configured noise."""

    def measure(figures: Figures) -> Iterator[tuple[str, float | None]]:
        for name in names:
            for axis, row in figures["sensors"].get(name, {}).items():
                yield f"{name.replace('_', ' ')} {axis}", row["largest_over_expected"]

    return measure


def _separations(figures: Figures) -> Iterator[tuple[str, float | None]]:
    yield from (figures["separation"] or {}).items()


def _worst_separations(figures: Figures) -> Iterator[tuple[str, float | None]]:
    for name, worst in (figures["separation_worst"] or {}).items():
        yield f"{name} {worst['at_s']:.0f} s after the start", worst["value"]


def _arm(key: str) -> Measure:
    def measure(figures: Figures) -> Iterator[tuple[str, float | None]]:
        if figures["lever_arm"] is not None:
            yield from zip(AXES_B, figures["lever_arm"][key], strict=True)

    return measure


def _offset_ms(figures: Figures) -> Iterator[tuple[str, float | None]]:
    found = figures["time_offset"]
    if found is not None and found["significant"]:
        yield ("early" if found["estimate_s"] > 0 else "late"), abs(1e3 * found["estimate_s"])


NOISE = "the noise in [imu.NAME.noise] (grade, or its single keys)"
RULES: tuple[Rule[Figures], ...] = (
    Rule(
        "not finite",
        _one("not_finite"),
        0,
        0,
        "{value:.0f} epochs are not numbers",
        "look for damage in the log with swath info; navigate without the source that stops early",
    ),
    Rule(
        "missing",
        _one("missing_s"),
        0.5,
        None,
        "{value:.1f} s of the log's inertial samples are outside the trajectory",
        "the gaps listed below show when and why; remove their cause and navigate again",
    ),
    Rule(
        "missing share",
        _one("missing_share"),
        None,
        0.5,
        "{value:.0%} of the log's inertial samples are outside the trajectory",
        "the gaps listed below show when and why; remove their cause and navigate again",
    ),
    Rule(
        "positions used",
        _one("positions", "used"),
        60,
        10,
        "the filter used only {value:.0f} positions",
        "give positions that cover the flight (--gnss), or see below why they were rejected",
        least=True,
    ),
    Rule(
        "position sigma",
        _largest("sigma_p95", *(f"{axis}_m" for axis in AXES_L)),
        0.15,
        3.0,
        "5 % of the flight have a position sigma ({of}) above {value:.2f} m",
        "give post-processed positions (--gnss), or shorten the outages",
    ),
    Rule(
        "tilt sigma",
        _largest("sigma_p95", *(f"{angle}_deg" for angle in ANGLES[:2])),
        0.02,
        0.5,
        "5 % of the flight have a {of} sigma above {value:.3f}°",
        f"check {NOISE} against the data sheet; fly turns before and after the lines",
    ),
    Rule(
        "heading sigma",
        _one("sigma_p95", "heading_deg"),
        0.05,
        2.0,
        "5 % of the flight have a heading sigma above {value:.3f}°",
        "fly turns or S-curves before and after the lines, or use a second antenna",
    ),
    Rule(
        "outage",
        _one("positions", "longest_outage_s"),
        30.0,
        600.0,
        "{value:.0f} s passed without a usable position",
        "give post-processed positions (--gnss); do not use the lines of that time unless their sigma suffices",
    ),
    Rule(
        "rejected",
        _share("rejected"),
        0.02,
        0.25,
        "{value:.1%} of the {of} observations were rejected",
        "find out when this happens; check lever_arm_m, the time source and the receiver's sigmas",
    ),
    Rule(
        "inflated",
        _share("inflated", "reacquired"),
        0.05,
        0.5,
        "{value:.1%} of the {of} observations exceeded the gate and were used with a larger sigma",
        "check the receiver's sigmas, which may be too small, the lever arm and the time of each sensor",
    ),
    Rule(
        "unusable",
        _share("unusable"),
        0.02,
        0.9,
        "{value:.1%} of the {of} observations could not be used (not finite, or no sigma)",
        "let the receiver send sigmas with each solution",
    ),
    Rule(
        "innovations large",
        _of_kinds("sigma_factor"),
        1.5,
        4.0,
        "innovations of {of} are {value:.1f} times as large as their sigmas predict",
        f"check lever_arm_m, rotation_b_imu, the time source and {NOISE}",
    ),
    Rule(
        "innovations small",
        _of_kinds("sigma_factor", inverse=True),
        5.0,
        None,
        "innovations of {of} are {value:.1f} times smaller than their sigmas predict, so the sigmas here are too large",
        f"check {NOISE}",
    ),
    Rule(
        "noise found",
        _noise_found,
        5.0,
        None,
        "errors of {of} are {value:.1f} times the values that the receiver reports or that are assumed for it; "
        "the filter used the larger values",
        "check lever_arm_m and the time source: a fault there looks like noise of the receiver",
    ),
    Rule(
        "innovations correlated",
        _of_kinds("correlation"),
        0.5,
        None,
        "innovations of {of} are correlated from one to the next ({value:.2f})",
        "include slow errors in the noise model: without them the sigmas of the trajectory may be too small",
    ),
    Rule(
        "separation",
        _separations,
        2.0,
        5.0,
        "filter and smoother differ in {of} by {value:.1f} times the value that their sigmas predict",
        f"check {NOISE}; the plot of the separation shows a disturbance in the middle of the flight",
    ),
    Rule(
        "separation at worst",
        _worst_separations,
        8.0,
        None,
        "filter and smoother differ in {of} by {value:.0f} times the value that their sigmas predict, over 30 s",
        "do not use the lines of that time, or leave out its positions (--gnss): a wrong fix has this effect",
    ),
    Rule(
        "bridged share",
        _one("bridged", "share"),
        0.001,
        0.05,
        "{value:.2%} of the inertial samples are missing and were interpolated",
        "find out with swath info why samples are missing: bus load, wiring or a busy host",
    ),
    Rule(
        "bridged run",
        _one("bridged", "longest_s"),
        1.0,
        30.0,
        "inertial samples are missing for {value:.1f} s without a break",
        "do not use the lines of that time; find out with swath info why samples are missing",
    ),
    Rule(
        "bias",
        _sensor("gyro_bias", "accel_bias"),
        4.0,
        20.0,
        "{of} is {value:.1f} times the value that the noise predicts",
        f"check {NOISE}, rotation_b_imu and the units of the samples",
    ),
    Rule(
        "scale",
        _sensor("gyro_scale", "accel_scale", "gyro_misalignment", "accel_misalignment"),
        4.0,
        20.0,
        "{of} is {value:.1f} times the value that the noise predicts",
        f"check {NOISE} and the units of the samples",
    ),
    Rule(
        "lever arm moved",
        _arm("moved_m"),
        0.05,
        1.0,
        "the antenna was estimated {value:.2f} m from its place by lever_arm_m ({of})",
        "measure the lever arm again, or enter the estimate below and navigate once more",
    ),
    Rule(
        "lever arm unseen",
        _arm("sigma_over_prior"),
        0.5,
        None,
        "this flight hardly determines lever arm {of} (its sigma is {value:.0%} of the prior one)",
        "measure it instead of estimating it; only steep turns determine the vertical component",
    ),
    Rule(
        "time offset",
        _offset_ms,
        2.0,
        None,
        "GNSS stamps are {value:.1f} ms {of} against the inertial unit's; the trajectory is corrected for it",
        "correct the time at its source: pps, names_edge, stamp, or the device's delay",
    ),
)


def judge(figures: Figures, findings: Iterable[Found] = ()) -> Verdict:
    """Return the verdict on figures; findings of the diagnosis are reasons too."""
    reasons = [reason for rule in RULES for reason in rule.judged(figures)]
    reasons += [reason_of(finding) for finding in findings]
    level, ordered = worst_first(reasons)
    return Verdict(level, _sentence(level, figures, ordered), ordered)


def reason_of(finding: Found) -> Reason:
    """Return a finding as a reason; its one sentence names the problem and the remedy."""
    level = Level.UNUSABLE if finding.severity == "error" else Level.CARE
    return Reason(level, finding.code, finding.text.rstrip("."), "", float("inf"))


def _sentence(level: Level, figures: Figures, reasons: Sequence[Reason]) -> str:
    if level is Level.GOOD:
        return f"{level.heading}: {accuracy_words(figures)}."
    problems = [reason.what for reason in reasons if reason.level is level]
    more = len(reasons) - 1
    tail = f"; {more} more {'reason' if more == 1 else 'reasons'}" if more else ""
    return f"{level.heading}: {problems[0]}{tail}."
