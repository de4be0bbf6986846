"""Tests TOML as tables: what is accepted, and refusals in a line that names the place."""

from __future__ import annotations

import datetime as dt

import pytest

from swath.georef.toml_tables import DEEPEST, LEAST, MOST, TomlError, key_text, toml_tables


def refused(text: str) -> str:
    with pytest.raises(TomlError) as error:
        toml_tables(text)
    assert len(str(error.value).splitlines()) == 1
    return str(error.value)


def test_tables_match_the_standard_library() -> None:
    text = 'a = 1\nday = 2026-11-21\n[b]\nc = [1.5, "x"]\n[[b.d]]\ne = true\n'
    expected = {"a": 1, "day": dt.date(2026, 11, 21), "b": {"c": [1.5, "x"], "d": [{"e": True}]}}
    assert toml_tables(text) == expected
    assert toml_tables("") == {}


@pytest.mark.parametrize("number", [LEAST, MOST, 0])
def test_integers_of_64_bits_are_exact(number: int) -> None:
    assert toml_tables(f"a = {number}\nb = [{{ c = {number} }}]") == {"a": number, "b": [{"c": number}]}


@pytest.mark.parametrize("number", [LEAST - 1, MOST + 1])
def test_error_for_an_integer_beyond_64_bits_names_its_key(number: int) -> None:
    told = f"a whole number of {number.bit_length()} bits; use numbers of 64 bits"
    assert refused(f"a = {number}") == f"a: {told}"
    assert refused(f"[scanner.left]\nb = [1, [{number}]]") == f"scanner.left.b: {told}"
    assert refused(f'["two words"]\n"c\\n" = {number}') == rf'"two words"."c\n": {told}'


def test_an_integer_with_more_digits_than_python_accepts_is_refused() -> None:
    assert refused(f"a = {'9' * 5000}") == "a whole number of thousands of digits; use numbers of 64 bits"


def nested(depth: int) -> str:
    """Return a key whose list is nested to a depth; the document itself has depth 0."""
    return f"a = {'[' * depth}{']' * depth}"


def test_tables_may_be_nested_up_to_the_limit() -> None:
    assert toml_tables(nested(DEEPEST))["a"]
    assert refused(nested(DEEPEST + 1)) == f"a…: nested too deeply; nest tables at most {DEEPEST} deep"
    assert refused("[" + ".".join(["a"] * 40) + "]").startswith("a.a.a.")


@pytest.mark.parametrize("text", ["a = " + "[" * 20_000, "a = " + "{a=" * 20_000])
def test_unlimited_nesting_is_refused(text: str) -> None:
    assert refused(text) == f"not readable: nested too deeply; nest tables at most {DEEPEST} deep"


@pytest.mark.parametrize(("text", "place"), [("a = 1\nb c", "line 2"), ("a = '''\n\n", "end of document"), ("a\0", "")])
def test_error_for_invalid_toml_gives_its_position(text: str, place: str) -> None:
    message = refused(text)
    assert message.startswith("not TOML: ")
    assert place in message


@pytest.mark.parametrize(
    ("key", "text"),
    [
        *(("omega_deg", "omega_deg"), ("a-1", "a-1"), ("", '""'), ("a.b", '"a.b"'), ("a\nb", r'"a\nb"'), ("ω", '"ω"')),
        *(("\U0001f681", '"\U0001f681"'), ("\x7f", r'"\u007f"'), ("\u2028", r'"\u2028"'), ('"\\', r'"\"\\"')),
    ],
)
def test_a_quoted_key_is_read_back(key: str, text: str) -> None:
    assert key_text(key) == text
    assert len(text.splitlines()) == 1
    assert toml_tables(f"{text} = 1") == {key: 1}
