"""Detect the encoding of a user's text file: UTF-8 unless its first bytes, a byte order mark, state another one."""

from __future__ import annotations

import codecs

_MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32"),  # must precede UTF-16, whose mark begins with the same bytes
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),  # "Unicode" of Windows
    (codecs.BOM_UTF16_BE, "utf-16"),
)


def encoding_of(head: bytes) -> str:
    """Return the encoding of a text by its first bytes, at least four if it has them; decoding removes the mark."""
    return next((encoding for mark, encoding in _MARKS if head.startswith(mark)), "utf-8-sig")


def decoded(data: bytes, errors: str = "strict") -> str:
    """Return the text in a file's bytes.

    Args:
        data: the file's bytes.
        errors: treatment of invalid bytes, as of `bytes.decode`.

    Raises:
        UnicodeDecodeError: the bytes are not text.
    """
    return data.decode(encoding_of(data[:4]), errors)
