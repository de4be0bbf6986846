"""Tests that the notebook of the documentation runs and finds how the scanner is mounted."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import nbformat
import pytest

from tests.library.notebook import NOTEBOOK, run

TRUTH_DEG = {"omega_rad": 0.25, "phi_rad": -0.4, "kappa_rad": 0.6}  # as the notebook's plan says
PARAMETERS = (
    "import json; print(json.dumps({name: (np.degrees(one.value), np.degrees(one.sigma)) "
    'for name, one in result.parameters.items() if one.unit == "rad"}))'
)


def read() -> Any:
    """Return the notebook as it is kept."""
    return nbformat.read(NOTEBOOK, as_version=4)


def shown(cell: Any) -> list[str]:
    """Return what a cell shows: types of pictures and tables, and texts without their numbers."""
    found = []
    for output in cell.get("outputs", []):
        text = output.text if output.output_type == "stream" else " ".join(sorted(output.data))
        found.append(re.sub(r"[-\d.]+", "0", text))
    return found


def test_the_notebook_is_small_and_names_no_place_of_a_computer() -> None:
    text = NOTEBOOK.read_text()
    assert len(text) < 300_000
    assert not re.findall(r"/tmp/|/home/|/root/|/work/|\\u001b", text)
    cells = [cell for cell in read().cells if cell.cell_type == "code"]
    assert sum("image/png" in " ".join(shown(cell)) for cell in cells) == 5
    assert {output.output_type for cell in cells for output in cell.outputs} <= {
        "stream",
        "display_data",
        "execute_result",
    }


@pytest.mark.slow
def test_the_notebook_runs_and_shows_what_it_keeps(tmp_path: Path) -> None:
    kept, notebook = read(), read()
    notebook.cells.append(nbformat.v4.new_code_cell(PARAMETERS))
    *cells, last = run(notebook, tmp_path).cells
    assert [shown(cell) for cell in cells] == [shown(cell) for cell in kept.cells]
    found = json.loads(last.outputs[0].text)
    for name, truth_deg in TRUTH_DEG.items():
        value_deg, sigma_deg = found[f"left.{name}"]
        assert abs(value_deg - truth_deg) < 4.0 * sigma_deg
        assert sigma_deg < 0.1
    assert {path.suffix for path in (tmp_path / "points").iterdir()} >= {".laz", ".json", ".sbet"}
    assert "omega_deg" in (tmp_path / "left.toml").read_text()
