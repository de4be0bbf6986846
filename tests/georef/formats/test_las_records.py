"""Tests that extended records are appended to finished files."""

from __future__ import annotations

import io

import laspy
import pytest

from swath.georef.formats.las_header import append_evlr, encode_evlr


def empty_file() -> io.BytesIO:
    """Return a LAS 1.4 file without points, as laspy writes it."""
    stream = io.BytesIO()
    laspy.create(point_format=6, file_version="1.4").write(stream)
    return io.BytesIO(stream.getvalue())


def test_appended_records_are_read_by_laspy_in_their_order() -> None:
    stream = empty_file()
    append_evlr(stream, encode_evlr("swath", 2, b"first", "one"))
    append_evlr(stream, encode_evlr("swath", 7, bytes(70_000), "two"))
    assert stream.tell() == len(stream.getvalue())
    stream.seek(0)
    read = laspy.read(stream)
    assert [(one.user_id, one.record_id, one.description) for one in read.evlrs] == [
        ("swath", 2, "one"),
        ("swath", 7, "two"),
    ]
    assert [len(one.record_data_bytes()) for one in read.evlrs] == [5, 70_000]
    assert read.evlrs[0].record_data_bytes() == b"first"


def test_a_file_with_bytes_behind_its_records_is_refused() -> None:
    stream = empty_file()
    append_evlr(stream, encode_evlr("swath", 2, b"first", "one"))
    stream.write(b"more")
    with pytest.raises(ValueError, match="1 extended records end at byte"):
        append_evlr(stream, encode_evlr("swath", 3, b"", "two"))
