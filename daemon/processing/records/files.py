"""Writes the records of a log's sources as files of tables: CSV, Parquet, NumPy; or as one MCAP file."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swath.daemon.errors import ExitCode, UserError
from swath.daemon.log.durable import sync_tree, try_sync_directory
from swath.daemon.log.format import safe_attachment_path
from swath.daemon.processing.records.read import LogRecords
from swath.daemon.processing.records.tables import KINDS, flat_columns
from swath.daemon.written import make_folder, note_written
from swath.drivers.driver import RAW
from swath.georef.arrays import StructArray
from swath.georef.progress import Tell, silent
from swath.georef.trajectory.buffer import SOLUTION_STATUS

MCAP = "mcap"
FORMATS = ("csv", "parquet", "npz", MCAP)
RETURNS, SOLUTIONS = "returns", "solutions"
UNFINISHED = ".part"
Columns = dict[str, NDArray[Any]]


@dataclass(slots=True)
class RecordFiles:
    """Lists the files that were written.

    Attributes:
        folder: the session's folder.
        rows: number of rows by file name; of MCAP, number of messages by topic.
        notes: remarks, one line each.
    """

    folder: Path
    rows: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def write_records(
    records: LogRecords,
    directory: Path,
    form: str,
    *,
    sources: Sequence[str] = (),
    start_ns: int | None = None,
    stop_ns: int | None = None,
    overwrite: bool = False,
    tell: Tell = silent,
) -> RecordFiles:
    """Write a file per source and kind of record into ``directory/<session>``; the folder appears when it is complete.

    Args:
        records: of the session.
        directory: made if necessary.
        form: one of `FORMATS`.
        sources: ``gnss/rover``, …; empty: all.
        start_ns, stop_ns: GPS time, [start, stop); None: the log's begin or end.
        overwrite: replace the folder of an earlier run.
        tell: called with the progress.

    Raises:
        UserError: a source does not exist, the folder exists, or a library is missing.
        LogError, OSError: the log cannot be read or a file cannot be written; nothing is left then.
    """
    _refuse_unknown(records, sources)
    target = safe_attachment_path(directory, records.session.session_id)
    if target.exists() and not overwrite:
        raise UserError(f"{target}: already exists; choose another folder or use --overwrite", ExitCode.USAGE)
    if target.exists() and not all(_is_ours(one, target.name) for one in target.iterdir()):
        raise UserError(f"{target}: holds other files than records; choose another folder", ExitCode.USAGE)
    make_folder(directory)
    unfinished = target.with_name(target.name + UNFINISHED)
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir()
    written = RecordFiles(target)
    chosen = [name for name in records.sources if not sources or name in sources]
    span = (start_ns, stop_ns)
    try:
        _write_all(records, _decoded(records, chosen, written.notes), unfinished, form, span, written, tell)
        sync_tree(unfinished)
        shutil.rmtree(target, ignore_errors=True)
        unfinished.rename(target)
        note_written(target)
    except BaseException:
        shutil.rmtree(unfinished, ignore_errors=True)
        raise
    try_sync_directory(directory)
    return written


def _is_ours(path: Path, session_id: str) -> bool:
    """Return True for a file of records; a log's own parts, which are MCAP too, are none."""
    if path.is_dir() or path.suffix == ".mcap":
        return path.is_file() and path.name == f"{session_id}.mcap"
    return path.suffix[1:] in FORMATS


def _decoded(records: LogRecords, sources: Sequence[str], notes: list[str]) -> list[str]:
    """Return the sources that a driver reads; ``notes`` gets a line about each other one."""
    unread = [source for source in sources if records.protocol(source) == RAW]
    notes += [f"{source}: no driver reads it; swath export without --records writes its bytes" for source in unread]
    lacking = {source: why for source, why in records.without_driver.items() if source in sources}
    notes += [f"{source}: {why}" for source, why in lacking.items()]
    return [source for source in sources if source not in unread and source not in lacking]


def _write_all(
    records: LogRecords,
    sources: Sequence[str],
    folder: Path,
    form: str,
    span: tuple[int | None, int | None],
    written: RecordFiles,
    tell: Tell,
) -> None:
    """Write the files of all sources."""
    if form == MCAP:
        from swath.daemon.processing.records.mcap import write_mcap

        path = folder / f"{written.folder.name}.mcap"
        written.rows.update(sorted(write_mcap(records, path, sources, span, written.notes, tell).items()))
    else:
        for number, source in enumerate(sources):
            tell("records", number, len(sources), "sources")
            _write_source(records, source, folder, form, span, written)
    for source in sources:
        counters = records.counters.get(source)
        if counters is not None and counters.errors:
            refused = ", ".join(f"{count:,} {code}" for code, count in counters.errors.most_common(5))
            written.notes.append(f"{source}: not decoded: {refused}")


def _refuse_unknown(records: LogRecords, sources: Sequence[str]) -> None:
    for source in sources:
        if source not in records.sources:
            there = ", ".join(records.sources) or "none"
            raise UserError(f"{records.session.parts[0].path}: has no source {source}; it has: {there}", ExitCode.USAGE)


def _write_source(
    records: LogRecords,
    source: str,
    folder: Path,
    form: str,
    span: tuple[int | None, int | None],
    written: RecordFiles,
) -> None:
    """Write all tables of a source that have rows."""
    stem = source.replace("/", "-")
    tables = records.tables(source, [name for name in KINDS if name != RETURNS], *span)
    pieces: dict[str, Iterator[StructArray]] = {name: iter([table]) for name, table in tables.items() if len(table)}
    if records.sources[source] == "scanner":
        pieces[RETURNS] = records.returns(source, *span)
    for name, rows in pieces.items():
        path = folder / f"{stem}_{name}.{form}"
        columns: Iterator[Columns] = map(_columns, rows)
        if name == SOLUTIONS:  # what their status means is known here, and by no reader of the file
            columns = (_with_validity(one, records.protocol(source)) for one in columns)
        count = _write(path, form, columns)
        if count:
            written.rows[path.name] = count


def _with_validity(columns: Columns, protocol: str) -> Columns:
    """Return columns of INS solutions with one more, ``valid``: whether the device vouches for the solution."""
    is_solution = SOLUTION_STATUS.get(protocol)
    status = columns["status"]
    valid = np.ones(len(status), np.bool_) if is_solution is None else is_solution(status)
    return columns | {"valid": valid}


def _columns(table: StructArray) -> Columns:
    """Return a table's flat columns; values of a status are text."""
    columns = flat_columns(table)
    if "values" in columns:
        columns["values"] = np.array([str(value) for value in columns["values"]])
    return {name: np.ascontiguousarray(column) for name, column in columns.items()}


def _write(path: Path, form: str, pieces: Iterator[Columns]) -> int:
    """Write pieces of one table; return the number of rows. Without rows, there is no file."""
    if form == "npz":
        found = list(pieces)
        if found:
            columns: Any = {name: np.concatenate([piece[name] for piece in found]) for name in found[0]}
            np.savez(path, **columns)
        return sum(len(piece["gps_ns"]) for piece in found)
    count = 0
    with ExitStack() as opened:
        write: Callable[[Any], None] | None = None
        for piece in pieces:
            table = arrow().table({name: arrow().array(column) for name, column in piece.items()})
            if write is None:
                write = opened.enter_context(_arrow_file(path, form, table.schema))
            write(table)
            count += table.num_rows
    return count


@contextmanager
def _arrow_file(path: Path, form: str, schema: Any) -> Iterator[Callable[[Any], None]]:
    """Provide a function that appends Arrow tables to a file."""
    if form == "parquet":
        import pyarrow.parquet as parquet

        with parquet.ParquetWriter(path, schema) as file:
            yield file.write_table
        return
    import pyarrow.csv as csv

    with csv.CSVWriter(
        path, schema, write_options=csv.WriteOptions(quoting_style="needed", quoting_header="needed")
    ) as file:
        yield file.write_table


def arrow() -> Any:
    """Return pyarrow, of the extra ``frames``.

    Raises:
        UserError: it is not installed.
    """
    try:
        import pyarrow
    except ImportError as error:
        raise UserError("pyarrow is not installed; pip install 'swath[frames]'", ExitCode.USAGE) from error
    return pyarrow
