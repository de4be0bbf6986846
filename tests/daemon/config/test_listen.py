"""Tests the address of the console, and what is said of values of ``[console]`` that cannot be."""

from __future__ import annotations

from pathlib import Path

import pytest

from swath.daemon.config import load_config
from swath.daemon.config.listen import parse_listen
from swath.daemon.errors import ConfigError


@pytest.mark.parametrize("text", ["8470", "localhost:8470", "127.0.0.1:0", "127.0.0.1:99999", "1.2.3:80", ""])
def test_an_address_that_is_none_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(ValueError, match=r"such as 127\.0\.0\.1:8470"):
        parse_listen(text)


@pytest.mark.parametrize(
    ("text", "url", "is_local"),
    [
        ("127.0.0.1:8470", "http://127.0.0.1:8470/", True),
        ("[::1]:80", "http://[::1]:80/", True),
        ("0.0.0.0:8470", "https://0.0.0.0:8470/", False),
        ("192.168.1.7:443", "https://192.168.1.7:443/", False),
    ],
)
def test_what_others_reach_is_encrypted(text: str, url: str, is_local: bool) -> None:
    place = parse_listen(text)
    assert (place.url, place.is_local) == (url, is_local)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('listen = "here:80"', "console.listen: got 'here:80', want an address of this computer and a port"),
        (f"marks = {['line'] * 9}", "want at most 8 values"),
    ],
)
def test_wrong_values_are_answered_with_right_ones(tmp_path: Path, line: str, words: str) -> None:
    path = tmp_path / "swath.toml"
    path.write_text(f'[session]\nname = "a"\n[console]\n{line}\n')
    with pytest.raises(ConfigError) as refused:
        load_config(path)
    assert words in str(refused.value)
