"""TOML is read as by `tomllib`, but refused where nested so deeply that it would cost much."""

from __future__ import annotations

import tomllib
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd.drivers import toml

NESTING: dict[str, Callable[[int], str]] = {
    "keys": lambda levels: ".".join(["a"] * levels) + " = 1",
    "quoted keys": lambda levels: " . ".join(['"a"', "'b'"] * (levels // 2)) + " = 1",
    "header": lambda levels: "[" + ".".join(["a"] * levels) + "]",
    "tables": lambda levels: "[[" + ".".join(["a"] * levels) + "]]",
    "inline key": lambda levels: "a = {b = 1, " + ".".join(["a"] * levels) + " = 1}",
    "arrays": lambda levels: "a = " + "[" * levels + "]" * levels,
    "inline tables": lambda levels: "a = " + "{a = " * levels + "1" + "}" * levels,
    "both": lambda levels: "a = " + "[{a = " * (levels // 2) + "1" + "}]" * (levels // 2),
}
HIDDEN = {
    "a string": '"""\\" # "" """',
    "a comment": "# \"\"\" ''' [\n",
    "literal": "'''\\'''",
    "quotes at the end": '"""x"""""',
    "six quotes": '""""""',
}
"""Strings and a comment that a careless reader would end at the wrong place."""


@pytest.mark.parametrize("how", NESTING)
def test_eight_levels_of_nesting_are_read_and_nine_refused(how: str) -> None:
    text = "x.y = 1\n" + NESTING[how](6 if how == "inline key" else 8)
    assert toml.loads(text) == tomllib.loads(text)
    with pytest.raises(toml.NestedTooDeeplyError):
        toml.loads(NESTING[how](9 if how not in ("quoted keys", "both") else 10))


@pytest.mark.parametrize(
    "text",
    [
        "a = '../../../../../../../../../x'",
        "# a.b.c.d.e.f.g.h.i.j.k [[[[[[[[[[",
        'a = """[[[[[[[[[[\n.........."""',
        "a = '''{{{{{{{{{{\n..........'''",
        "a = [[1.5, 2.5], [3.5, 4.5], [5.5, 6.5], [7.5, 8.5], [9.5, 10.5]]",
        'a = "\\"[[[[[[[[[[........."',
        'a = """..........\\"""..........""""" # ok',
    ],
)
def test_dots_and_brackets_in_values_do_not_nest(text: str) -> None:
    assert toml.loads(text) == tomllib.loads(text)


@pytest.mark.parametrize("before", HIDDEN)
def test_deep_nesting_after_a_string_or_comment_is_refused(before: str) -> None:
    first = HIDDEN[before] if before == "a comment" else f"first = {HIDDEN[before]}"
    text = f"{first}\n{NESTING['arrays'](40)}"
    try:
        tomllib.loads(text)
    except ValueError:
        pytest.skip("nobody reads as far as that")
    with pytest.raises(toml.NestedTooDeeplyError):
        toml.loads(text)


@given(st.text("ab.[]{}=\"'#\\\n ,1", max_size=60))
def test_accepted_toml_is_parsed_as_by_tomllib(text: str) -> None:
    try:
        wanted = tomllib.loads(text)
    except ValueError:
        with pytest.raises(ValueError):  # noqa: PT011 - each has its own
            toml.loads(text)
        return
    try:
        assert toml.loads(text) == wanted
    except toml.NestedTooDeeplyError:
        assert sum(map(text.count, ".[{")) >= toml.DEPTH_MAX
