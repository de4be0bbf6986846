"""Tests that the report's figures are those of its input, and that it is complete without a network."""

from __future__ import annotations

import base64
import math
import re
import sys
import time
import xml.etree.ElementTree as ET
import zlib
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swath.calib.features import Features
from swath.calib.labels import decimals_of, degrees, length, number, plain, share, unknown
from swath.calib.need import Need
from swath.calib.outcome import Adjusted, Considered, ControlFit, FixedParameter, GroupFit
from swath.calib.profiles.check import Check, Comparison
from swath.calib.summary import Finding, PairDifference, ReportInput
from swath.calib.verdict import held_words, judge
from swath.daemon.processing.calibration.products import pages
from swath.daemon.processing.calibration.report.cuts import cuts_of
from swath.daemon.processing.calibration.report.maps import plane_means_m
from swath.daemon.processing.calibration.report.page import html, paper_page, pdf
from swath.daemon.processing.calibration.report.residuals import residual_picture, seen_of
from swath.daemon.processing.calibration.report.tables import (
    control_table,
    entries_table,
    groups_table,
    held_table,
    parameter_tables,
)
from swath.daemon.processing.pages.canvas import NARROW
from swath.georef.verdicts import Level
from tests.calib.made_outcome import RISE, Outcome, made_report
from tests.daemon.processing.pages.builders import faults_of
from tests.same_bytes import numbers_of

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("kernels")]


@pytest.fixture(scope="module")
def report(outcome: Outcome) -> ReportInput:
    """Return the input of a report with every part."""
    return made_report(outcome)


@pytest.fixture(scope="module")
def page(report: ReportInput) -> str:
    """Return the text of the page."""
    return html(report)


def sound(report: ReportInput, **changes: Any) -> ReportInput:
    """Return the input of a report without its bad control point, correlated pair and undetermined parameters.

    Then the changes are applied.
    """
    adjusted = report.adjusted
    correlation = np.eye(len(adjusted.names))
    plain = replace(adjusted, control=adjusted.control[:4], correlation=correlation, held=())
    return replace(report, adjusted=replace(plain, **changes))


def test_verdict_of_a_good_calibration_is_good(report: ReportInput) -> None:
    verdict = judge(sound(report))
    assert verdict.level is Level.GOOD
    assert not verdict.reasons
    # κ is the least certain: 2.4e-5 rad; 4.1 mm; ten pairs of 1.4 to 2.6 cm
    assert re.fullmatch(
        r"Good: boresight to 0\.0014°, range offset to 4\u00a0mm; strips agree to (\d\.\d)\u00a0cm \(RMSDz\)\.",
        verdict.sentence,
    )


def test_verdict_names_undetermined_parameters(report: ReportInput) -> None:
    held = (
        FixedParameter("left", "lever_arm_z_m", "why", "control"),
        FixedParameter("left", "lever_arm_x_m", "at the user's word"),
    )
    verdict = judge(sound(report, held=held))
    assert verdict.level is Level.GOOD
    assert verdict.sentence.endswith("Not determined by this flight: lever arm z.")
    # An undetermined boresight angle is a reason for care.
    pitch = FixedParameter("left", "phi_rad", "flat ground", "slopes along track", 1e-3)
    verdict = judge(sound(report, held=(pitch,)))
    assert verdict.level is Level.CARE
    assert verdict.sentence.startswith("Usable with care: the boresight is not calibrated: boresight φ (pitch), held, ")


@pytest.mark.parametrize(("left_m", "level"), [(0.04, Level.GOOD), (0.06, Level.CARE)])
def test_a_correlated_pair_is_a_reason_unless_points_are_accurate_enough(
    report: ReportInput, left_m: float, level: Level
) -> None:
    """The error left in points includes the correlation, so if it is small, the correlation does not matter."""
    correlation = np.eye(len(report.adjusted.names))
    correlation[0, 1] = correlation[1, 0] = 0.97
    need = Need(0.05, {}, 0.1, {"left": left_m})
    verdict = judge(replace(sound(report, correlation=correlation), need=need))
    assert verdict.level is level
    assert any("hardly be separated" in reason.what for reason in verdict.reasons) is (level is Level.CARE)


@pytest.mark.parametrize(("sigma_deg", "level"), [(0.01, Level.CARE), (1.0, Level.UNUSABLE)])
def test_a_held_angle_makes_the_boresight_calibration_incomplete(
    report: ReportInput, sigma_deg: float, level: Level
) -> None:
    """This holds for the user's choice too; the held angle's plausible error decides the level and is listed."""
    held = (FixedParameter("left", "kappa_rad", "held by your choice"),)
    considered = (Considered("left", "kappa_rad", 0.0, math.radians(sigma_deg)),)
    verdict = judge(sound(report, held=held, considered=considered))
    assert verdict.level is level
    assert (
        f"the boresight is not calibrated: boresight κ (heading), held, has a plausible error of {sigma_deg:.2g}"
        in verdict.sentence
    )
    assert "Boresight to 0.0100°" in verdict.sentence or "Boresight to 1.00°" in verdict.sentence


def test_a_held_parameter_that_affects_an_estimated_one_is_named_with_its_effect(report: ReportInput) -> None:
    adjusted = report.adjusted
    considered = (
        Considered("left", "torsion_s2", 0.0, 2e-9),
        Considered("left", "encoder_latency_s", 0.0, 2e-6),
    )
    moved = np.zeros((len(adjusted.names), 2))
    moved[3] = 0.2, 1e-4
    sigmas = np.sqrt(adjusted.sigmas**2 + (moved**2).sum(axis=1))
    assert held_words(replace(adjusted, considered=considered, moved=moved, sigmas=sigmas)) == [
        "torsion, held, has a plausible error of 2000\u00a0µs², which would move range offset by 20.0\u00a0cm"
    ]


def test_a_contradiction_between_flight_and_held_parameter_is_a_reason(report: ReportInput) -> None:
    considered = (Considered("left", "torsion_s2", 0.0, 2e-9, 9e-9, 1e-9, contradicted=True),)
    verdict = judge(sound(report, considered=considered))
    assert verdict.level is Level.CARE
    assert (
        "the flight contradicts the held value of torsion: it would change the value by +9000 ± 1000\u00a0µs²"
        in verdict.sentence
    )


def test_the_verdict_follows_the_requirements(report: ReportInput) -> None:
    """An angle and the points are compared with the user's requirements."""
    need = Need(0.05, {"kappa_rad": math.radians(0.001)}, 0.1, {"left": 0.04})
    (reason,) = judge(replace(sound(report), need=need)).reasons
    assert reason.what == "boresight κ (heading) is known to 0.0014° only, where 0.0010° is required"
    assert not judge(replace(sound(report), need=replace(need, wanted={}))).reasons
    (reason,) = judge(replace(sound(report), need=replace(need, wanted={}, point_m=0.03))).reasons
    assert reason.what == "the calibration leaves 4.0\u00a0cm in points, where 3.0\u00a0cm is required"
    assert judge(replace(sound(report), need=replace(need, wanted={}, point_m=0.003))).level is Level.UNUSABLE


@pytest.mark.parametrize(
    ("sigmas", "level"),
    [
        (2.9, Level.GOOD),
        (-2.9, Level.GOOD),
        (3.0, Level.CARE),
        (-3.0, Level.CARE),
        (-8.0, Level.CARE),
        (8.25, Level.UNUSABLE),
        (-8.25, Level.UNUSABLE),
    ],
)
def test_contradicting_profiles_are_a_reason(report: ReportInput, sigmas: float, level: Level) -> None:
    """Eight pairs differ together by this many sigmas of the difference, to either side."""
    sigma = 2.0**-16
    one = Comparison("left", "omega_rad", 8, sigmas * sigma, sigma, 0.0, sigma, sigma)
    fine = replace(one, parameter="phi_rad", told=0.25, adjusted=0.25)
    verdict = judge(replace(sound(report), check=Check((), (fine, one))))
    assert verdict.level is level
    size = f"{math.degrees(abs(sigmas) * sigma):.4f}°"
    told = f"{'−' if sigmas < 0.0 else '+'}{size} from the adjustment ({'−' if sigmas < 0.0 else '+'}{abs(sigmas):.1f}"
    words = f"8 profiles put boresight ω (roll) {told} sigmas)"
    assert [reason.what for reason in verdict.reasons] == ([words] if level else [])
    assert level is Level.GOOD or verdict.sentence.startswith(f"{level.heading}: {words}. Boresight to ")


def test_findings_are_reasons(report: ReportInput) -> None:
    found = (Finding("the pre-alignment puts κ elsewhere", "fly"), Finding("worse", "stop", 2.0, unusable=True))
    verdict = judge(replace(sound(report), findings=found))
    assert (verdict.level, [reason.what for reason in verdict.reasons]) == (Level.UNUSABLE, ["worse", found[0].what])


@pytest.mark.parametrize(
    ("changes", "level", "words"),
    [
        ({"converged": False}, Level.UNUSABLE, "did not converge"),
        ({"redundancy": 4.0}, Level.UNUSABLE, "there are only 4 observations more than"),
        ({"variance_factor": 3.0}, Level.CARE, "variance factor 3"),
        ({"variance_factor": 0.1}, Level.CARE, "far smaller"),
        ({"variance_factor": math.nan}, Level.UNUSABLE, "variance factor –"),
        (
            {"sigmas": np.array([2e-4, 1e-5, 1e-5, 0.004, 1e-5, 1e-6, 1e-4])},
            Level.CARE,
            "boresight ω (roll) is known to",
        ),
        ({"sigmas": np.array([1e-5, 1e-5, 1e-5, 0.9, 1e-5, 1e-6, 1e-4])}, Level.UNUSABLE, "range offset is known to"),
        ({"groups": (GroupFit("planes", 100, 90.0, 1.0, 0.02, 8),)}, Level.CARE, "8.00 % of the observations"),
        ({"prior_sigmas": np.array([1e-4] + [np.inf] * 6)}, Level.UNUSABLE, "has moved by 43.9 times"),
        ({"control": (ControlFit("K9", 0.05, 0.01, -5.0, {}),)}, Level.CARE, "K9 (5.0\u00a0cm) is 5.0 sigmas off"),
        ({"control": (ControlFit("K9", 0.0, 0.01, 0.1, {"left.phi_rad": -2.0}),)}, Level.CARE, "moves boresight φ"),
    ],
)
def test_each_problem_is_a_reason(report: ReportInput, changes: dict[str, Any], level: Level, words: str) -> None:
    verdict = judge(sound(report, **changes))
    assert verdict.level is level
    assert words in verdict.sentence
    assert all(reason.change for reason in verdict.reasons)


def test_strips_that_agree_worse_than_before_are_a_reason(report: ReportInput) -> None:
    pair = ("01", "02")
    before, after = {pair: PairDifference(0.0, 0.02, 0.02, 0.1, 10)}, {pair: PairDifference(0.0, 0.09, 0.09, 0.3, 10)}
    words = [reason.what for reason in judge(replace(sound(report), before=before, after=after)).reasons]
    assert words[0].startswith("strips agree less well than before (2.0\u00a0cm before, 9.0\u00a0cm after)")
    assert words[1].startswith("strips differ by 9.0\u00a0cm")


def test_the_worst_comes_first(report: ReportInput) -> None:
    """Reasons of equal level are ordered by how far they exceed their limit."""
    points = tuple(ControlFit(f"K{w}", 0.01 * w, 0.01, float(w)) for w in (4, 9, 6))
    verdict = judge(sound(report, control=points, variance_factor=2.1))
    assert [reason.what.split()[2] for reason in verdict.reasons[:3]] == ["K9", "K6", "K4"]
    assert "below" not in verdict.sentence


def test_trajectory_corrections_beyond_their_sigmas_are_a_reason(report: ReportInput) -> None:
    fit = report.adjusted.trajectory
    assert fit is not None
    large = replace(fit, position_l=np.full_like(fit.position_l, 0.02) * 2.0)
    reasons = judge(sound(report, trajectory=large)).reasons
    assert [reason.what for reason in reasons] == [
        "corrections of the trajectory's positions are 1.8 times the value that its sigmas predict"
    ]


class Seen(HTMLParser):
    """Parser that collects the addresses that a page refers to, and the words that it shows."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.tags: Counter[str] = Counter()
        self.words: list[str] = []
        self._in_style = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        self._in_style = tag == "style"
        self.addresses += [value or "" for key, value in attrs if key in ("src", "href", "srcset", "data")]

    def handle_endtag(self, tag: str) -> None:
        self._in_style = False

    def handle_data(self, data: str) -> None:
        if not self._in_style:
            self.words.append(data)


def test_the_page_needs_no_network(page: str) -> None:
    seen = Seen(page)
    assert seen.addresses
    assert all(address.startswith("data:image/svg+xml;base64,") for address in seen.addresses)
    assert not seen.tags["script"] + seen.tags["link"] + seen.tags["iframe"]
    assert "@import" not in page
    assert "url(" not in page
    for address in seen.addresses:
        svg = base64.b64decode(address.partition(",")[2]).decode()
        assert ET.fromstring(svg).tag == "{http://www.w3.org/2000/svg}svg"
        assert not re.search(r"href=[\"']https?:", svg)
    assert len(page) < 5_000_000


def test_the_page_has_no_empty_heads_or_columns_and_real_minus_signs(page: str) -> None:
    assert faults_of(page) == []


def test_control_is_told_as_the_laser_above_it_as_everywhere(report: ReportInput) -> None:
    """`swath validate` and the layer of control of `swath view --gis` give laser less survey, up positive."""
    point, table = report.adjusted.control[0], control_table(report)
    assert table is not None
    assert table.heads[1] == "laser above it, cm"
    assert table.rows[0][1] == number(-100.0 * point.misclosure_m, "+.1f")
    assert table.rows[0][3] == number(-point.normalised, "+.2f")


def test_a_group_of_several_units_has_no_rms(report: ReportInput) -> None:
    groups = tuple(GroupFit(group, 400, 350.2, 1.0, 0.02, 0) for group in ("planes", "trajectory", "priors"))
    rows = groups_table(replace(report, adjusted=replace(report.adjusted, groups=groups))).rows
    assert [row[2:5:2] for row in rows] == [["350", "2.0\u00a0cm"], ["350", "–"], ["350", "–"]]


def test_a_note_that_stands_with_the_settings_is_not_repeated(report: ReportInput) -> None:
    note = "sigmas of the trajectory, correlated in time: position 60 s; 12 knots, 5 s apart"
    told = replace(report, notes=[*report.notes, note], settings={"trajectory errors": f"as given; {note}"})
    assert html(told).count("position 60\u00a0s") == 1


def test_the_page_has_all_its_parts(page: str) -> None:
    titles = re.findall(r"<h2>(.*?)</h2>", page)
    assert titles == [
        "Reasons",
        "Parameters",
        "Correlations",
        "Not determined by this flight",
        "Strips and planes",
        "Strips against each other",
        "Difference maps",
        "Profiles",
        "Roll from strips 01 and 02",
        "Residuals",
        "Normalised residuals",
        "Outliers",
        "Control",
        "Corrections of the trajectory",
        "Fit by group of observations",
        "Smallest detectable errors",
        "How it was computed",
        "Software and settings",
        "Inputs",
    ]
    words = " ".join(Seen(page).words)
    for told in ("9f" * 32, "VQ-780 S2221234", "not post-processed", "curved or rough", "Gauss–Helmert", "converged"):
        assert told in words


def test_the_same_input_gives_the_same_picture(report: ReportInput) -> None:
    """This includes the shaded columns, which are an image inside the picture."""
    first, second = residual_picture(report), residual_picture(report)
    assert first is not None
    assert second is not None
    assert first.svg(NARROW) == second.svg(NARROW)


def test_the_start_is_the_given_file_and_the_pre_alignment_has_its_own_column(report: ReportInput) -> None:
    found = report.adjusted.calibrations["left"].changed(kappa_rad=math.radians(0.58))
    (table,) = parameter_tables(replace(report, prealigned={"left": found}))
    rows = {row[0]: dict(zip(table.heads, row, strict=True)) for row in table.rows}
    kappa = rows["boresight κ (heading)"]
    assert (kappa["start"], kappa["pre-alignment"], kappa["estimate"]) == ("0.0000", "0.5800", "0.6116")
    assert rows["range offset"]["pre-alignment"] == "–"


def test_parameters_are_shown_as_in_the_file(report: ReportInput) -> None:
    (table,) = parameter_tables(report)
    rows = {row[0]: dict(zip(table.heads, row, strict=True)) for row in table.rows}
    kappa = rows["boresight κ (heading)"]
    # 0.611° and 0.4 of 2.4e-5 rad
    assert (kappa["unit"], kappa["estimate"], kappa["sigma"], kappa["start"]) == ("°", "0.6116", "0.0014", "0.0000")
    assert kappa["change / sigma"] == f"{(math.radians(0.611) + 0.4 * 2.4e-5) / 2.4e-5:.0f}"
    assert "pre-alignment" not in table.heads
    assert rows["time offset"]["estimate"] == "76"  # 0.4 · 190 µs
    assert rows["time offset"]["change / sigma"] == "0.4 ·"
    held = [table.rows[i][0] for i in sorted(table.pale)]
    assert held == ["scan plane tilt Δη", "lever arm x", "lever arm y", "lever arm z"]
    assert rows["lever arm x"]["change"] == "held"
    assert rows["lever arm z"]["change"] == "not determined"


def test_undetermined_parameters_are_shown_with_their_remedy(report: ReportInput) -> None:
    table = held_table(report)
    assert table is not None
    assert [row[0] for row in table.rows] == ["lever arm z", "scan plane tilt Δη"]
    assert table.rows[0][1:3] == ["0.13 m", "range offset (−0.97)"]
    assert table.rows[1][1] == "none"
    late = FixedParameter("left", "time_offset_s", "why", "a second speed", 9.757e-4)
    again = held_table(replace(report, adjusted=replace(report.adjusted, held=(late,))))
    assert again is not None
    assert again.rows[0][1] == "976 µs"


def test_residuals_are_shown_by_possible_causes(report: ReportInput) -> None:
    """Outliers are left out; strip 04 is 6 mm higher, as it was made."""
    seen = seen_of(report)
    kept = sum(int((one.weight > 0).sum()) for one in report.adjusted.residuals if one.group != "control")
    assert len(seen.misclosure_m) == kept
    means = [seen.misclosure_m[seen.swath == index].mean() for index in range(5)]
    assert means[3] - np.mean(means[:3]) == pytest.approx(0.006, abs=0.0015)
    assert np.abs(seen.angle_deg).max() <= 30.0
    row = int(np.flatnonzero(report.adjusted.residuals[0].weight > 0)[0])
    group = report.adjusted.residuals[0]
    first = report.flight.swaths[group.swath[row]].rows[group.at[row]]
    assert (first["range_m"], first["intensity"]) == (seen.range_m[0], seen.intensity[0])


def test_planes_are_coloured_by_the_means_of_their_strips(report: ReportInput) -> None:
    """Single returns scatter by 2 cm; strip 3 lies 6 mm above the rest."""
    means_m = plane_means_m(report)
    group = report.adjusted.residuals[0]
    mine = (group.feature == 7) & (group.weight > 0)
    strips = [group.misclosure_m[mine & (group.swath == strip)] for strip in np.unique(group.swath[mine])]
    assert means_m[7] == pytest.approx(max(abs(float(strip.mean())) for strip in strips))
    assert float(np.nanmedian(means_m)) < 0.6 * float(np.std(group.misclosure_m[group.weight > 0]))


def test_sections_show_one_roof_after_calibration(report: ReportInput) -> None:
    """Before calibration strips are metres apart; afterwards all lie on the roof's slope."""
    cuts = cuts_of(report)
    assert len(cuts) == 3

    def off_m(points: Any) -> float:
        on = np.concatenate([place[np.abs(place[:, 0]) < 3.0] for place in points.values()])
        return float(np.sqrt(np.mean((on[:, 1] + RISE * on[:, 0]) ** 2)))

    for cut in cuts:
        assert off_m(cut.after) < 0.05
        assert off_m(cut.before) > 0.3


def bare_of(report: ReportInput, **more: Any) -> ReportInput:
    """Remove planes, ties, control, trajectory corrections and strips."""
    adjusted = replace(
        report.adjusted, residuals=(), groups=(), control=(), trajectory=None, least_detectable={}, spectrum=np.zeros(0)
    )
    return ReportInput(report.flight, Features(), adjusted, {}, **more)


def test_a_report_with_little_input_is_complete_and_reproducible(report: ReportInput) -> None:
    """Only what exists is shown, the user's words are escaped, and the page is the same each time."""
    bare = bare_of(report, title="<b>A & B</b>", notes=["<script>x</script>"])
    text = html(bare)
    assert text == html(bare)
    assert "<h2>Parameters</h2>" in text
    assert "the sigmas here are too small" in text
    assert "including the trajectory's errors" not in text
    assert "<h2>Control</h2>" not in text
    assert "<script>" not in text
    assert "<h1>&lt;b&gt;A &amp; B&lt;/b&gt;</h1>" in text


def test_two_scanners_have_separate_tables(report: ReportInput) -> None:
    """Each scanner has its table, and sentences name the scanner of a parameter."""
    adjusted = report.adjusted
    right = replace(adjusted.calibrations["left"], scanner="right")
    both: Adjusted = replace(
        adjusted,
        calibrations={"left": adjusted.calibrations["left"], "right": right},
        names=(
            *adjusted.names[:3],
            "right.omega_rad",
            "right.ibrc.3",
            "right.beam.12.azimuth_rad",
            "right.range_offset_m",
        ),
        held=(FixedParameter("right", "phi_rad", "why", "slopes", math.inf, (("left.phi_rad", 0.97),)),),
    )
    two = replace(report, adjusted=both, headers={"left": report.headers["left"], "right": report.headers["left"]})
    assert [table.title for table in parameter_tables(two)] == ["Parameters of left", "Parameters of right"]
    assert "boresight φ (pitch) of right" in judge(two).sentence
    entries = entries_table(two)
    assert entries is not None
    assert [row[0] for row in entries.rows] == ["right: IBRC 3", "right: beam 12 azimuth"]
    assert "<title>Calibration of left and right, HB-ABC/left/2026-03</title>" in html(bare_of(two, title=two.heading))


def test_the_pdf_is_the_same_bytes_each_time(report: ReportInput) -> None:
    """This includes the fonts, which are cut to the characters in use and could contain the time."""
    bare = bare_of(report, notes=["$100 & <b>"])
    file = pdf(bare)
    time.sleep(1.1)
    assert pdf(bare) == file
    assert b"CreationDate" not in inflated(file)


def inflated(file: bytes) -> bytes:
    """Return a PDF's compressed streams, which contain most objects, one after the other."""
    return b"\n".join(map(zlib.decompress, re.findall(rb"stream\n(.*?)\nendstream", file, re.DOTALL)))


def test_the_pdf_has_a_title_a4_pages_and_its_fonts_within(report: ReportInput) -> None:
    file = pdf(report)
    assert file.startswith(b"%PDF-")
    objects = inflated(file)
    assert b"/Title (Calibration of left, HB-ABC/left/2026-03)" in objects
    assert 6 <= len(re.findall(rb"/Type /Page\b", objects)) <= 16
    boxes = re.findall(rb"/MediaBox \[([\d. ]+)\]", objects)
    assert {tuple(round(float(x)) for x in box.split()) for box in boxes} == {(0, 0, 595, 842)}
    used = set(re.findall(rb"/BaseFont /[A-Z]{6}\+([\w-]+)", objects))
    assert used == {b"DejaVu-Sans", b"DejaVu-Sans-Bold", b"DejaVu-Sans-Mono"}
    assert len(re.findall(rb"/FontFile2 \d", objects)) == 3


def test_what_is_printed_shows_the_numbers_of_the_page(report: ReportInput, page: str) -> None:
    assert numbers_of(paper_page(report)) == numbers_of(page)


def test_without_pango_the_page_is_written_and_a_line_says_what_to_install(
    report: ReportInput, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def dlopen(ffi: object, name: str, flags: int = 0) -> None:
        raise OSError(f"cannot load library {name!r}")

    for name in [name for name in sys.modules if name.split(".")[0] == "weasyprint"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr("cffi.FFI.dlopen", dlopen)
    warnings: list[str] = []
    files = pages(tmp_path, bare_of(report), warnings)
    assert list(files) == [tmp_path / "report.html"]
    assert warnings == [
        f"{tmp_path / 'report.pdf'}: not written, because Pango is missing: apt-get install libpango-1.0-0 "
        "libpangoft2-1.0-0; report.html shows the same"
    ]
    assert capfd.readouterr() == ("", "")


def test_numbers_are_formatted_for_readers() -> None:
    assert [length(x) for x in (1.764, 0.0181, 0.0041, 0.0004, math.nan)] == [
        "1.76\u00a0m",
        "1.8\u00a0cm",
        "4\u00a0mm",
        "0.4\u00a0mm",
        "–",
    ]
    assert degrees(0.00091) == "0.0009°"
    assert degrees(0.0137) == "0.0137°"
    assert number(-0.0001, ".2f") == "0.00"
    assert number(-1.5, "+.1f") == "−1.5"
    assert [decimals_of(x) for x in (0.0041, 18.0, 0.96)] == [4, 0, 2]
    assert [share(x) for x in (0.0, 1e-6, 0.0036)] == ["0 %", "< 0.01 %", "0.36 %"]
    assert unknown("left.ibrc.3").words == "IBRC 3"
    told = "cannot tell it from left.range_offset_m (correlation -0.9), nor left.omega_rad."
    assert plain(told, several=False) == "cannot tell it from range offset (correlation -0.9), nor boresight ω (roll)."
    assert plain("left.phi_rad", several=True) == "boresight φ (pitch) of left"
    assert unknown("right.beam.12.elevation_rad").unit == "°"
    assert unknown("left.torsion_s2").factor == pytest.approx(1e12)
