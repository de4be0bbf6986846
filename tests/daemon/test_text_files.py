"""Tests text files that users name: encodings, and files that are no text."""

from __future__ import annotations

from pathlib import Path

import pytest

from swath.daemon.config import load_config
from swath.daemon.errors import ConfigError, ExitCode, UserError
from swath.daemon.processing.control.table import HEADER
from swath.daemon.processing.control.text import read_text
from swath.daemon.text_files import text_of
from swath.sim.plan.plan import load_plan
from tests.daemon.rig import session_table

ENCODINGS = ["utf-8", "utf-8-sig", "utf-16", "utf-32"]  # the latter three with a byte order mark


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_control_points_are_read_by_their_byte_order_mark(tmp_path: Path, encoding: str) -> None:
    file = tmp_path / "control.csv"
    file.write_bytes(f"{HEADER}\r\nKürbis,47.5,8.95,510.0,0.01\r\n".encode(encoding))
    assert read_text(text_of(file), file).names == ("Kürbis",)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_configurations_and_plans_are_read_by_their_byte_order_mark(tmp_path: Path, encoding: str) -> None:
    text = session_table(tmp_path / "Flüge")
    (tmp_path / "swath.toml").write_bytes(text.encode(encoding))
    assert load_config(tmp_path / "swath.toml").text == text
    plan = load_plan("small").text
    (tmp_path / "plan.toml").write_bytes(plan.encode(encoding))
    assert load_plan(tmp_path / "plan.toml").tables == load_plan("small").tables


@pytest.mark.parametrize("content", [b"\x89\xff", b"\xff\xfea\x00b", b"caf\xe9"])
def test_a_file_that_is_not_text_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    """The files are two meaningless bytes, UTF-16 that ends within a letter, and Latin-1."""
    file = tmp_path / "control.csv"
    file.write_bytes(content)
    with pytest.raises(UserError) as refused:
        text_of(file)
    assert refused.value.message == f"{file}: cannot be read: not text; want a CSV file"
    assert refused.value.exit_code == ExitCode.IO
    with pytest.raises(ConfigError, match="not UTF-8 text; want a TOML file"):
        load_config(file)
