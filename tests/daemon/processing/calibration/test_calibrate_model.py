"""Tests what a calibration estimates by a file and by options that override it, and mistakes in one line."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import pytest

from swath.calib.parameters import ParameterOptions
from swath.daemon.errors import ExitCode, UserError
from swath.daemon.processing.calibration.model import (
    file_of,
    in_words,
    key_of,
    model_of,
    of_parameters,
    tables_in_words,
)

PAGE = Path(__file__).resolve().parents[4] / "docs/calibration.md"
DEG = math.pi / 180.0
WHOLE = """
model = "full"
[parameters]
phi_deg = "free"
time_offset_us = "fixed"
"left.kappa_deg" = { prior = 0.02 }
right.omega_deg = "fixed"
range_scale_ppm = { prior = 20 }
range_offset_slot.2 = { prior = 0.01 }
"left.ibrc.0" = { prior = 0.03 }
"beam.azimuth_deg" = { prior = 0.05 }
[ibrc]
knots = [0, 64, 128.5, 192, 255]
reference = 64
smoothness_m = 0.05
[range_offset]
return_slots = [1, 2]
mta_zones = [0, 3]
[beam]
estimate = ["azimuth_deg", "elevation_deg", "range_m"]
"""
BOTH = 'model = "basic"\n[parameters]\nphi_deg = { prior = 0.1 }\n"left.kappa_deg" = "fixed"\nomega_deg = "fixed"\n'


def file(folder: Path, text: str) -> str:
    path = folder / "model.toml"
    path.write_text(text)
    return str(path)


def refused(*given: Any) -> str:
    with pytest.raises(UserError) as ended:
        model_of(*given)
    assert "\n" not in ended.value.message
    return ended.value.message


def test_a_file_can_set_every_option(tmp_path: Path) -> None:
    assert model_of(file(tmp_path, WHOLE)) == ParameterOptions(
        "full",
        fix=frozenset(["time_offset_s", "right.omega_rad"]),
        free=frozenset(["phi_rad"]),
        priors={
            "left.kappa_rad": 0.02 * DEG,
            "range_scale": 20 * 1e-6,
            "range_offset_slot.2": 0.01,
            "left.ibrc.0": 0.03,
            "beam.azimuth_rad": 0.05 * DEG,
        },
        ibrc_knots=(0.0, 64.0, 128.5, 192.0, 255.0),
        ibrc_reference=64.0,
        ibrc_smoothness_m=0.05,
        beams=frozenset(["azimuth_rad", "elevation_rad", "range_m"]),
        range_offset_slots=(1, 2),
        range_offset_zones=(0, 3),
    )


def test_the_example_of_the_page_is_valid(tmp_path: Path) -> None:
    (example,) = re.findall(r"^```toml\n(.*?)^```$", PAGE.read_text(), re.M | re.S)
    request = model_of(file(tmp_path, example))
    assert request.priors == {"left.kappa_rad": 0.02 * DEG, "range_offset_slot.2": 0.03}
    assert request.ibrc_reference in request.ibrc_knots
    assert request.range_offset_slots
    assert request.range_offset_zones
    assert len(request.beams) == 3


def test_an_empty_file_gives_the_default_model(tmp_path: Path) -> None:
    assert model_of(file(tmp_path, "")) == ParameterOptions("scanner") == model_of("scanner")
    assert model_of(file(tmp_path, "[ibrc]\nknots = [1, 2]")) == ParameterOptions("scanner", ibrc_knots=(1.0, 2.0))
    assert (file_of("scanner"), file_of("model.TOML")) == (None, Path("model.TOML"))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("", "", []), {"fix": ["left.kappa_rad", "omega_rad"], "priors": {"phi_rad": 0.1}}),
        (("phi_deg", "", []), {"fix": ["left.kappa_rad", "omega_rad", "phi_rad"]}),
        (("", "omega_deg,kappa_deg", []), {"free": ["omega_rad", "kappa_rad"], "priors": {"phi_rad": 0.1}}),
        (
            ("", "", ["left.phi_deg=0.2", "left.kappa_deg=0.3"]),
            {"fix": ["omega_rad"], "priors": {"phi_rad": 0.1, "left.phi_rad": 0.2, "left.kappa_rad": 0.3}},
        ),
    ],
)
def test_options_override_the_file(
    tmp_path: Path, options: tuple[str, str, list[str]], expected: dict[str, object]
) -> None:
    """An option for all scanners also overrides the file's setting of a single one."""
    found = model_of(file(tmp_path, BOTH), *options)
    assert {"fix": found.fix, "free": found.free} == {"fix": set(), "free": set()} | {
        word: set(names) for word, names in expected.items() if isinstance(names, list)
    }
    assert {name: round(sigma / DEG, 9) for name, sigma in found.priors.items()} == expected.get("priors", {})
    assert found.model == "basic"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("model = 'basic", "model.toml: not TOML: "),
        ('model = "all"', 'model.toml: model: got "all", want "basic", "scanner" or "full"'),
        ("[parameter]", "model.toml: parameter: unknown key; did you mean parameters?"),
        ("[beams]\nestimate = []", "model.toml: beams: unknown key; did you mean beam?"),
        ("[parameters]\nphi_dg = 'free'", "model.toml: parameters.phi_dg: unknown parameter; did you mean phi_deg?"),
        (
            "[parameters]\nleft.phi = 'free'",
            "model.toml: parameters.left.phi: unknown parameter; did you mean left.phi_d",
        ),
        ("[parameters]\nphi_deg = 'fre'", 'parameters.phi_deg: got "fre", want "free", "fixed" or { prior = SIGMA }'),
        ("[parameters]\nphi_deg = { prior = 0 }", "parameters.phi_deg: got prior = 0, want "),
        ("[parameters]\nphi_deg = { priro = 0.1 }", "parameters.phi_deg: got a table, want "),
        ("[parameters]\nphi_deg = { prior = true }", "parameters.phi_deg: got prior = true, want "),
        ("[parameters]\nphi_deg = 0.1", "parameters.phi_deg: got 0.1, want "),
        ("[parameters]\n'ibrc.1' = { prior = 0.1 }", "parameters.ibrc.1: unknown parameter; use one of omega_deg"),
        (
            "[parameters]\n'ibrc.1' = { prior = 0.1 }\n[ibrc]\nknots = [1, 2]",
            "parameters.ibrc.1: unknown parameter; did you mean ibrc.0?",  # that is the reference
        ),
        (
            "[parameters]\n'range_offset_slot.1' = 'free'\n[range_offset]\nreturn_slots = [1]",
            "parameters.range_offset_slot.1: its table already requests it; give a prior, or leave it out",
        ),
        (
            "[parameters]\nphi_deg = { prior = 1" + 400 * "0" + " }",
            "parameters.phi_deg.prior: a whole number of 1329 bits",
        ),
        (
            "[parameters]\nleft.phi_deg = 'free'\n'left.phi_deg' = 'fixed'",
            "model.toml: parameters: left.phi_deg is given twice; give it once",
        ),
        ('[parameters]\n"a\\nb" = "free"', "parameters.a b: unknown parameter; use one of"),
        ("parameters = 1", "model.toml: parameters: got 1, want a table"),
        ("[ibrc]", "model.toml: ibrc.knots: missing; want rising intensities, at least two"),
        ("[ibrc]\nknots = [1]", "ibrc.knots: got [1.0], want at least two rising intensities"),
        ("[ibrc]\nknots = [1, 1]", "ibrc.knots: got [1.0, 1.0], want at least two rising intensities"),
        ("[ibrc]\nknots = [1, 'two']", 'ibrc.knots[1]: got "two", want a number'),
        ("[ibrc]\nknots = [1, 1" + 400 * "0" + "]", "ibrc.knots: a whole number of 1329 bits"),
        ("[ibrc]\nknots = [1, inf]", "ibrc.knots[1]: got Infinity, want a finite number"),
        ("[ibrc]\nknots = [1, 5]\nreference = 2", "ibrc.reference: got 2, want one of the knots 1, 5"),
        ("[ibrc]\nknots = [1, 5]\nsmoothness_m = 0", "ibrc.smoothness_m: got 0, want > 0 and <= 10"),
        ("[ibrc]\nknots = [1, 5]\nsmooth_m = 0.1", "ibrc.smooth_m: unknown key; did you mean smoothness_m?"),
        (
            "[ibrc]\nintensity = [1, 5]\nknots = [1, 5]",
            "ibrc.intensity: unknown key; there are: knots, reference, smoo",
        ),
        ("[range_offset]", "model.toml: range_offset: is empty; want return_slots or mta_zones"),
        ("[range_offset]\nreturn_slots = [0]", "range_offset.return_slots: got [0], want whole numbers from 1"),
        (
            "[range_offset]\nmta_zones = [1, 1]",
            "range_offset.mta_zones: got [1, 1], want whole numbers from 0, each on",
        ),
        ("[range_offset]\nmta_zones = [1.5]", "range_offset.mta_zones[0]: got 1.5, want a whole number"),
        ("[range_offset]\nreturn_slot = [1]", "range_offset.return_slot: unknown key; did you mean return_slots?"),
        ("[beam]\nestimate = ['range']", 'beam.estimate[0]: got "range", want "azimuth_deg", "elevation_deg" or "ran'),
        ("[beam]\nestimate = []", "beam.estimate: got [], want at least one"),
    ],
)
def test_each_mistake_in_a_file_is_reported_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    assert said in refused(file(tmp_path, text))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (("all",), '--model: got "all", want basic, scanner, full, or a file FILE.toml'),
        (("nowhere.toml",), "nowhere.toml: cannot be read: No such file"),
        (("basic", "phi"), "--fix phi: unknown parameter; did you mean phi_deg?"),
        (("basic", "", "left.fie"), "--free left.fie: unknown parameter; use one of omega_deg"),
        (("basic", "", "", ["phi_deg=much"]), "--prior phi_deg=much: want KEY=SIGMA, above 0"),
        (("basic", "", "", ["phi_deg=-1"]), "--prior phi_deg=-1: want KEY=SIGMA, above 0"),
        (("basic", "", "", ["ibrc.1=1"]), "--prior ibrc.1: unknown parameter"),
    ],
)
def test_each_mistake_in_options_is_reported_in_one_line(given: tuple[object, ...], said: str) -> None:
    assert said in refused(*given)


def test_all_mistakes_of_a_file_are_reported_at_once(tmp_path: Path) -> None:
    with pytest.raises(UserError) as ended:
        model_of(file(tmp_path, 'model = "all"\n[ibrc]\nknots = [2]\n'))
    assert len(ended.value.message.splitlines()) == 2
    assert ended.value.exit_code == ExitCode.USAGE


def test_nested_tables_are_refused_in_one_line(tmp_path: Path) -> None:
    deep = "[parameters]\n" + 2000 * "a." + "b = 'free'"
    assert "nested too deeply; nest tables at most 32 deep" in refused(file(tmp_path, deep))


def test_a_file_that_is_not_text_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "model.toml").write_bytes(b"\xff\xfe\x00")
    assert "model.toml: cannot be read: not text; want a TOML file" in refused(str(tmp_path / "model.toml"))


def test_options_are_described_by_the_keys_of_files(tmp_path: Path) -> None:
    request = model_of(file(tmp_path, WHOLE))
    told = in_words(request)
    assert told.startswith("full; fixed right.omega_deg, time_offset_us; free phi_deg; prior beam.azimuth_deg 0.05, ")
    assert "left.kappa_deg 0.02" in told
    assert "range_scale_ppm 20" in told
    assert "ibrc at 0, 64, 128.5, 192, 255 (reference 64), smooth to 0.05 m" in told
    assert told.endswith(
        "range offset of return slot 1, 2; range offset of zone 0, 3; beam azimuth_deg, elevation_deg, range_m"
    )
    assert in_words(ParameterOptions("basic")) == "basic"
    alone = of_parameters(request)
    assert tables_in_words(alone) == []
    assert set(alone.priors) == {"left.kappa_rad", "range_scale"}
    assert (alone.model, alone.fix, alone.free) == (request.model, request.fix, request.free)


def test_unknowns_are_named_as_in_files() -> None:
    assert key_of("phi_rad") == ("phi_deg", DEG)
    assert key_of("ibrc.1", (10.0, 2500.0)) == ("ibrc.1 at 2500", 1.0)
    assert key_of("beam.3.azimuth_rad") == ("beam.3.azimuth_deg", DEG)
    assert key_of("beam.3.range_m") == ("beam.3.range_m", 1.0)
    assert key_of("range_offset_slot.2") == ("range_offset_slot.2", 1.0)
