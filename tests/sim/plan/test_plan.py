"""Tests plans: what is loaded, refusals in one line, and the page that documents every key."""

from __future__ import annotations

import datetime as dt
import re
import tomllib
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from swath.sim.plan.errors import PlanError
from swath.sim.plan.plan import PRESETS, Plan, load_plan, parse_plan
from swath.sim.plan.tables import Tables
from swath.sim.shots import SURFACES
from swath.sim.truth import POSE_TRUTH_DTYPE, RETURN_TRUTH_DTYPE

PAGE = (Path(__file__).parents[3] / "docs/simulation.md").read_text()
SHORT = """
[flight]
name = "short"
{flight}

[[line]]
name = "one"
from_m = [-500.0, 0.0]
to_m = [500.0, 0.0]
height_m = 900.0
{line}

{more}
"""


def text_of(flight: str = "", line: str = "", more: str = "") -> str:
    return SHORT.format(flight=flight, line=line, more=more)


def refused(text: str) -> PlanError:
    """Return the error of a plan, and check that it is one line."""
    with pytest.raises(PlanError) as caught:
        parse_plan(text, Path())
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(f"{caught.value.key}: ")
    return caught.value


class TestLoading:
    def test_a_plan_with_one_line_gets_the_documented_defaults(self) -> None:
        plan = parse_plan(text_of(), Path("/somewhere"))
        assert plan.folder == Path("/somewhere")
        assert plan.tables.ground is None
        assert plan.tables.flight.start == dt.datetime(2026, 6, 15, 9, tzinfo=dt.UTC)
        assert list(plan.tables.pps) == ["main"]
        assert plan.tables.scanner["left"].kind == "oscillating"
        assert plan.tables.scanner["left"].nominal.range_offset_m == 0.0

    def test_the_start_is_gps_time_with_the_leap_seconds_of_its_day(self) -> None:
        """GPS week 1903 began on 2016-06-26; five days and 18 s later UTC was 2016-07-01T00:00:01 (17 leap seconds)."""
        plan = parse_plan(text_of(flight="start = 2016-07-01T02:00:01+02:00"), Path())
        assert plan.leap_seconds == 17
        assert plan.start_gps_ns == (1903 * 604_800 + 5 * 86_400 + 18) * 1_000_000_000

    def test_a_file_is_loaded_with_its_folder(self, tmp_path: Path) -> None:
        (tmp_path / "mine.toml").write_text(text_of())
        plan = load_plan(tmp_path / "mine.toml")
        assert plan.folder == tmp_path
        assert plan.text == text_of()

    def test_a_file_with_the_name_of_a_preset_has_precedence(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(tmp_path)
        assert load_plan("small").tables.flight.name == "small"
        Path("small").write_text(text_of())
        assert load_plan("small").tables.flight.name == "short"

    def test_an_empty_text_disconnects_a_pps(self) -> None:
        plan = parse_plan(text_of(more='[gnss.rover]\npps = ""'), Path())
        assert plan.tables.gnss["rover"].pps is None
        other = plan.with_seed(5)
        assert other.tables.gnss["rover"].pps is None
        assert parse_plan(other.text, Path()).tables == other.tables


class TestRefusals:
    @pytest.mark.parametrize(
        ("text", "key", "words"),
        [
            (text_of(flight="sped_mps = 50.0"), "flight.sped_mps", "unknown key"),
            (text_of(line="higth_m = 50.0"), "line[0].higth_m", "unknown key"),
            (text_of(flight='speed_mps = "50"'), "flight.speed_mps", "got '50', want a valid number"),
            (text_of(flight='bank_max_deg = "25 deg"'), "flight.bank_max_deg", "got '25 deg', want a valid number"),
            (text_of(flight="bank_max_rad = 0.4"), "flight.bank_max_rad", "unknown key"),
            (text_of(flight="bank_max_deg = 75.0"), "flight.bank_max_deg", "got 75.0, want less than or equal to 60"),
            (text_of(flight="speed_mps = nan"), "flight.speed_mps", "got nan, want"),
            (text_of(flight="origin_deg = [47.5]"), "flight.origin_deg", "at least 2 items"),
            (text_of(flight='turbulence = "stormy"'), "flight.turbulence", "got 'stormy', want 'none', 'light'"),
            (text_of(more='[imu.main]\ngrade = "toy"'), "imu.main.grade", "got 'toy', want 'navigation'"),
            (text_of(more='[gnss.rover]\ngrade = "dgps"'), "gnss.rover.grade", "got 'dgps', want 'rtk'"),
            (text_of(more='[scanner.left]\nkind = "galvo"'), "scanner.left.kind", "got 'galvo', want 'oscillating'"),
            (
                text_of(more='[[fault]]\nsource = "gnss/rover"\nkind = "tired"\nat_s = 1.0'),
                "fault[0].kind",
                "got 'tired', want 'silent'",
            ),
            (
                text_of(more='[[fault]]\nsource = "rover"\nkind = "silent"\nat_s = 1.0'),
                "fault[0].source",
                "got 'rover', want",
            ),
            (text_of(more='[[terrain.building]]\nroof = "round"'), "terrain.building[0].center_m", "is missing"),
            (text_of(more='[gnss."two words"]'), "gnss.two words.[key]", "got 'two words', want"),
            (
                text_of(flight="start = 2026-06-15T09:00:00"),
                "flight.start",
                "has no UTC offset; write UTC as 2026-06-15",
            ),
            ('[flight]\nname = "none"', "line", "is missing"),
            ('line = []\n[flight]\nname = "none"', "line", "at least 1 item"),
            (text_of().replace("height_m = 900.0", ""), "line[0].height_m", "is missing"),
            ("[flight\n", "plan", "not TOML: "),
        ],
    )
    def test_each_mistake_is_one_line_that_names_the_key(self, text: str, key: str, words: str) -> None:
        error = refused(text)
        assert error.key == key
        assert words in str(error)

    def test_error_for_a_missing_file_lists_the_presets(self, tmp_path: Path) -> None:
        with pytest.raises(PlanError, match=r"nowhere\.toml: No such file or directory; give .* small, calibration"):
            load_plan(tmp_path / "nowhere.toml")

    def test_a_file_that_is_not_utf_8_is_refused(self, tmp_path: Path) -> None:
        (tmp_path / "plan.toml").write_bytes(b"\xfd[flight]")
        with pytest.raises(PlanError, match="is not UTF-8"):
            load_plan(tmp_path / "plan.toml")

    def test_a_folder_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(PlanError, match="Is a directory"):
            load_plan(tmp_path)


class TestChanges:
    def plan(self) -> Plan:
        more = "[scanner.left]\nprf_hz = 50_000.0\n[scanner.left.true]\nomega_deg = 0.3"
        return parse_plan(text_of(more=more), Path())

    def test_another_seed_changes_only_the_seed(self) -> None:
        plan = self.plan()
        other = plan.with_seed(99)
        assert other.tables.flight.seed == 99
        assert other.tables.model_dump() == plan.changed({"flight": {"seed": 99}}).tables.model_dump()
        assert other.changed({"flight": {"seed": 1}}).tables == plan.tables
        assert plan.tables.flight.seed == 1

    def test_tables_are_merged_and_lists_replaced(self) -> None:
        line = {"name": "two", "from_m": [0.0, 0.0], "to_m": [0.0, 900.0], "height_m": 800.0}
        changed = self.plan().changed({"scanner": {"left": {"true": {"phi_deg": 0.1}}}, "line": [line]})
        scanner = changed.tables.scanner["left"]
        assert (scanner.prf_hz, scanner.true.omega_deg, scanner.true.phi_deg) == (50_000.0, 0.3, 0.1)
        assert [line.name for line in changed.tables.line] == ["two"]

    def test_the_text_of_a_changed_plan_reads_back_as_that_plan(self) -> None:
        facet = [{"index": 0, "tilt_deg": -0.01}, {"index": 1, "tilt_deg": 1e-7}]
        installation = [[1, 0.0, 0.0], [0.0, 0.5, 0.1 + 0.2], [0.0, 1e-7, 1.0]]
        left = {"kind": "polygon", "model": 'a "b" \\ µ\x7f', "facet": facet, "installation": installation}
        changed = self.plan().changed({"scanner": {"left": left}})
        again = parse_plan(changed.text, Path())
        assert (again.tables, again.start_gps_ns) == (changed.tables, changed.start_gps_ns)

    def test_a_change_is_validated_like_a_file(self) -> None:
        with pytest.raises(PlanError, match=r"^flight\.speed_mps: got 5\.0, want greater than or equal to 10$"):
            self.plan().changed({"flight": {"speed_mps": 5.0}})


# ------------------------------------------------------------------------------------------------ the page

UNITS = {  # endings of keys, the longest first
    "_deg_per_sqrt_h": "°/√h",
    "_m_per_s_per_sqrt_h": "m/s/√h",
    "_deg_per_h": "°/h",
    "_ppm_per_h": "ppm/h",
    "_per_ha": "1/ha",
    "_percent": "%",
    "_mrad": "mrad",
    "_mps": "m/s",
    "_ppm": "ppm",
    "_hpa": "hPa",
    "_deg": "°",
    "_us2": "µs²",
    "_km": "km",
    "_nm": "nm",
    "_hz": "Hz",
    "_ns": "ns",
    "_us": "µs",
    "_ms": "ms",
    "_mg": "mg",
    "_m": "m",
    "_s": "s",
    "_c": "°C",
    "_h": "h",
}
BOUNDS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}


def sections(model: type[BaseModel] = Tables, prefix: str = "") -> dict[str, type[BaseModel]]:
    """Return the headings that the page must have, with the tables that they describe."""
    found: dict[str, type[BaseModel]] = {}
    for key, field in model.model_fields.items():
        inner, outer = model_in(field.annotation), str(field.annotation)
        if inner is None:
            continue
        name = f"{prefix}{key}.<name>" if outer.startswith("dict[") else prefix + key
        heading = f"[[{name}]]" if outer.startswith("list[") else f"[{name}]"
        found[heading] = inner
        found |= sections(inner, f"{name}.")
    return found


def model_in(annotation: Any) -> type[BaseModel] | None:
    """Return the table in an annotation, or None."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    inner = (model_in(part) for part in typing.get_args(annotation))
    return next((part for part in inner if part is not None), None)


def row_of(key: str, field: FieldInfo) -> str:
    """Return the row of a key on the page."""
    unit = next((unit for ending, unit in UNITS.items() if key.endswith(ending)), "")
    meaning = (field.description or "").replace("|", "\\|")
    return f"| `{key}` | {type_of(field)} | {unit} | {default_of(field)} | {meaning} |"


def type_of(field: FieldInfo) -> str:
    bounds = [
        f"{sign} {getattr(item, name):.10g}"
        for item in field.metadata
        for name, sign in BOUNDS.items()
        if getattr(item, name, 2**63) != 2**63  # the page does not state a seed's bound
    ]
    return f"{words(field.annotation, field.metadata)} {' and '.join(bounds)}".strip()


def words(annotation: Any, metadata: Sequence[Any] = ()) -> str:
    """Describe a type in words."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return words(arguments[0], [inner for outer in arguments[1:] for inner in getattr(outer, "metadata", [outer])])
    if origin is typing.Literal:
        return " \\| ".join(f"`{value}`" for value in arguments)
    if type(None) in arguments:
        return words(next(part for part in arguments if part is not type(None)), metadata)
    if origin is list:
        length = next((item.max_length for item in metadata if hasattr(item, "max_length")), None)
        inner = words(arguments[0])
        if inner == "number":
            return f"{length} numbers" if length else "numbers"
        return f"{length} × {inner}" if length else f"list of {inner}"
    plain = {float: "number", int: "integer", bool: "`true` \\| `false`", str: "text", dt.datetime: "date and time"}
    return plain[annotation]


def default_of(field: FieldInfo) -> str:
    """Return a key's default as TOML."""
    value = field.get_default(call_default_factory=True)
    if value is PydanticUndefined:
        return "**needed**"
    if value is None:
        return "absent"
    if value == np.eye(3).tolist():
        return "identity"
    if isinstance(value, list):
        return f"`{value}`".replace("'", '"')
    if isinstance(value, dt.datetime):
        return f"`{value.isoformat()}`".replace("+00:00", "Z")
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f"`{value:.10g}`" if isinstance(value, (int, float)) else f"`{value}`" if value else '`""`'


def tables_of_page() -> dict[str, str]:
    """Return the page's headings with the text below each; a heading may name several tables."""
    found = {}
    for block in re.split(r"^### ", PAGE, flags=re.MULTILINE)[1:]:
        heading, _, text = block.partition("\n")
        for name in re.findall(r"`(\[+[^\]]+\]+)`", heading):
            found[name] = re.split(r"^## ", text, flags=re.MULTILINE)[0]
    return found


class TestPage:
    """docs/simulation.md and the tables agree."""

    def test_every_table_has_a_heading_and_every_heading_a_table(self) -> None:
        assert set(tables_of_page()) == set(sections())

    @pytest.mark.parametrize("heading", list(sections()))
    def test_rows_match_the_keys_of_the_table(self, heading: str) -> None:
        _, _, table = tables_of_page()[heading].partition("| key | type and bounds | unit | default | meaning |\n")
        rows = re.findall(r"^\| `\w+` \|.*$", table, flags=re.MULTILINE)
        fields = sections()[heading].model_fields
        assert rows == [row_of(key, field) for key, field in fields.items() if model_in(field.annotation) is None]

    def test_every_key_has_a_meaning(self) -> None:
        for heading, model in sections().items():
            for key, field in model.model_fields.items():
                assert field.description or model_in(field.annotation) is not None, f"{heading} {key}"

    def test_every_preset_is_named(self) -> None:
        for preset in PRESETS:
            assert re.search(rf"^\| `{preset}` \|", PAGE, flags=re.MULTILINE)

    def test_the_truth_is_described_field_by_field(self) -> None:
        truth = PAGE.split("\n## The truth\n", 1)[1].split("\n## ", 1)[0]
        for dtype in (POSE_TRUTH_DTYPE, RETURN_TRUTH_DTYPE):
            for name in dtype.names or ():
                assert f"`{name}`" in truth, name
        for surface in SURFACES:
            assert surface in truth, surface

    def test_examples_are_valid_plans(self) -> None:
        blocks = re.findall(r"^```toml\n(.*?)^```$", PAGE, flags=re.MULTILINE | re.DOTALL)
        whole = [block for block in blocks if "[flight]" in block]
        assert whole
        for block in blocks:
            text = block if block in whole else f"{whole[0]}\n{block}"
            assert set(tomllib.loads(text))
            parse_plan(text, Path())
