"""Tests that `swath export --records` writes what a log's drivers decode, in each format the same."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet
import pytest

import swath as library
from swath.daemon.processing.records.read import LogRecords
from swath.daemon.processing.records.tables import KINDS
from tests.daemon.commands import swath
from tests.daemon.short_flight import Flown
from tests.library.builders import fly


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    return fly(tmp_path_factory.mktemp("records"), seconds=20.0)


def exported(flown: Flown, folder: Path, form: str, *options: str) -> dict[str, Path]:
    """Return the files of an export by their stems."""
    done = swath("export", str(flown.folder / "logs"), str(folder), "--records", form, "--json", *options)
    assert done.returncode == 0, done.stderr
    (session,) = json.loads(done.stdout)["sessions"]
    files = {path.stem: path for path in Path(session["folder"]).iterdir()}
    assert {path.name for path in files.values()} == set(session["rows"])
    return files


def columns_of(path: Path) -> dict[str, Any]:
    """Return a file's columns."""
    if path.suffix == ".npz":
        return dict(np.load(path))
    if path.suffix == ".csv":
        frame = pd.read_csv(path)
        return {name: frame[name].to_numpy() for name in frame.columns}
    table = pyarrow.parquet.read_table(path)
    return {name: table[name].to_numpy() for name in table.column_names}


@pytest.mark.parametrize(
    "form", [pytest.param("csv", marks=pytest.mark.slow), "parquet", pytest.param("npz", marks=pytest.mark.slow)]
)
def test_files_hold_the_tables_of_the_library(flown: Flown, tmp_path: Path, form: str) -> None:
    files = exported(flown, tmp_path, form)
    log = library.open(flown.folder / "logs")
    kinds = ("fixes", "headings", "marks", "times", "solutions")
    assert {f"gnss-rover_{kind}" for kind in kinds} | {"imu-main_samples", "scanner-left_returns"} <= set(files)
    for stem, source, kind in (
        ("imu-main_samples", "imu/main", "samples"),
        ("gnss-rover_fixes", "gnss/rover", "fixes"),
        ("scanner-left_returns", "scanner/left", "returns"),
    ):
        frame, columns = log.to_pandas(source, kind).reset_index(), columns_of(files[stem])
        assert list(columns) == list(frame.columns)
        for name, column in columns.items():
            given = frame[name].to_numpy()
            np.testing.assert_array_equal(column.astype(given.dtype), given, err_msg=f"{stem} {name}")


def test_a_source_and_a_slice_can_be_chosen(flown: Flown, tmp_path: Path) -> None:
    span = library.open(flown.folder / "logs").span_ns
    assert span is not None
    begin = span[0] + 5_000_000_000
    options = ("--source", "imu/main", "--from", str(begin), "--to", "2026-06-15T09:00:07Z")
    (path,) = exported(flown, tmp_path, "npz", *options).values()
    times = columns_of(path)["gps_ns"]
    assert begin <= times.min() < times.max() < 1465549225000000000
    assert len(times) > 100


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--records", "xls"), '--records: got "xls", want csv, parquet, npz, mcap'),
        (
            ("--records", "csv", "--source", "imu/left"),
            "has no source imu/left; it has: gnss/rover, imu/main, scanner/left",
        ),
        (
            ("--records", "csv", "--from", "nine"),
            'got "nine", want a time in UTC as 2026-06-15T09:00:05.5, or GPS nano',
        ),
        (("--source", "imu/main"), "--source, --from and --to need --records"),
    ],
)
def test_mistakes_are_answered_in_a_sentence(
    flown: Flown, tmp_path: Path, options: tuple[str, ...], words: str
) -> None:
    done = swath("export", str(flown.folder / "logs"), str(tmp_path / "out"), *options)
    assert done.returncode == 2
    assert words in done.stderr
    assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())


@pytest.mark.slow
def test_an_export_is_replaced_only_when_asked(flown: Flown, tmp_path: Path) -> None:
    exported(flown, tmp_path, "npz", "--source", "imu/main")
    again = ("export", str(flown.folder / "logs"), str(tmp_path), "--records", "npz", "--source", "gnss/rover")
    assert "already exists; choose another folder or use --overwrite" in swath(*again).stderr
    assert swath(*again, "--overwrite").returncode == 0
    (folder,) = tmp_path.iterdir()
    assert {path.name.partition("_")[0] for path in folder.iterdir()} == {"gnss-rover"}
    (folder / "notes.txt").write_text("mine")
    assert "holds other files than records" in swath(*again, "--overwrite").stderr


def test_a_receiver_may_lack_a_kind_of_records(flown: Flown) -> None:
    """Its clock was asked for the state at the last of no records."""
    records = LogRecords.of_session(flown.session())
    assert len(records._placed("gnss/rover", KINDS["headings"], [])) == 0
