"""In which encoding a text file of a user is: UTF-8 unless its first bytes, a byte order mark, say otherwise."""

from __future__ import annotations

import codecs

_MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32"),  # begins as UTF-16's does
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),  # "Unicode" of Windows
    (codecs.BOM_UTF16_BE, "utf-16"),
)


def encoding_of(head: bytes) -> str:
    """Return the encoding of a text by its first bytes, four at least if it has them; the mark is no part of it."""
    return next((encoding for mark, encoding in _MARKS if head.startswith(mark)), "utf-8-sig")


def decoded(data: bytes, errors: str = "strict") -> str:
    """Return the text in a file's bytes.

    Args:
        data: the file.
        errors: what becomes of bytes that are no text, as of `bytes.decode`.

    Raises:
        UnicodeDecodeError: they are none.
    """
    return data.decode(encoding_of(data[:4]), errors)
