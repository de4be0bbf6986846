"""Runs the notebook of the documentation; ``python -m tests.library.notebook`` runs it and keeps what it shows."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path
from typing import Any
from unittest.mock import patch

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[2]
NOTEBOOK = ROOT / "docs/library/flight.ipynb"
LIMIT_S = 600


def run(notebook: Any, folder: Path) -> Any:
    """Run a notebook's cells in a folder, with this interpreter and the ``swath`` beside it; return it with outputs.

    Raises:
        CellExecutionError: a cell fails.
    """
    ours = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    with patch.dict(os.environ, ours):
        client = NotebookClient(
            notebook, timeout=LIMIT_S, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
        )
        client.execute()
    for cell in notebook.cells:
        cell.metadata = {}
        cell.outputs = [one for one in cell.get("outputs", []) if one.get("name") != "stderr"]
        if cell.cell_type != "code":
            del cell["outputs"]
    return notebook


def main() -> None:
    """Run the notebook and write it back with its outputs."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        run(notebook, Path(folder))
    nbformat.write(notebook, NOTEBOOK)


if __name__ == "__main__":
    main()
