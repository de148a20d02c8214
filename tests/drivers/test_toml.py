"""TOML is read as `tomllib` reads it; what would cost more than its size says is not read."""

from __future__ import annotations

import contextlib
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd.drivers import toml

ROOT = Path(__file__).parents[2]
SHIPPED = [*ROOT.glob("deploy/**/*.toml"), ROOT / "pyproject.toml"]
BYTES = 128 * 1024

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
"""Where a reader that takes strings or comments for something else would lose its way."""


@pytest.mark.parametrize("how", NESTING)
def test_eight_levels_are_read_and_nine_are_not(how: str) -> None:
    text = "x.y = 1\n" + NESTING[how](6 if how == "inline key" else 8)
    assert toml.loads(text) == tomllib.loads(text)
    with pytest.raises(toml.NestedTooDeeplyError):
        toml.loads(NESTING[how](9 if how not in ("quoted keys", "both") else 10))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_what_is_shipped_is_read(path: Path) -> None:
    assert toml.loads(path.read_text()) == tomllib.loads(path.read_text())


@pytest.mark.parametrize(
    "text",
    [
        'a = "1.2.3.4.5.6.7.8.9.10"',
        "a = '../../../../../../../../../x'",
        "# a.b.c.d.e.f.g.h.i.j.k [[[[[[[[[[",
        'a = """[[[[[[[[[[\n.........."""',
        "a = '''{{{{{{{{{{\n..........'''",
        "a = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]",
        "a = [[1.5, 2.5], [3.5, 4.5], [5.5, 6.5], [7.5, 8.5], [9.5, 10.5]]",
        'a = "\\"[[[[[[[[[[........."',
        'a = """..........\\"""..........""""" # ok',
    ],
)
def test_dots_and_brackets_in_values_do_not_nest(text: str) -> None:
    assert toml.loads(text) == tomllib.loads(text)


@pytest.mark.parametrize("before", HIDDEN)
@pytest.mark.parametrize("how", ["keys", "arrays"])
def test_no_string_or_comment_hides_what_nests(before: str, how: str) -> None:
    first = HIDDEN[before] if before == "a comment" else f"first = {HIDDEN[before]}"
    text = f"{first}\n{NESTING[how](40)}"
    try:
        tomllib.loads(text)
    except ValueError:
        pytest.skip("nobody reads as far as that")
    with pytest.raises(toml.NestedTooDeeplyError):
        toml.loads(text)


@given(st.text("ab.[]{}=\"'#\\\n ,1", max_size=60))
def test_what_is_read_is_what_tomllib_reads(text: str) -> None:
    try:
        wanted = tomllib.loads(text)
    except ValueError:
        with pytest.raises(ValueError):  # noqa: PT011 - each has its own
            toml.loads(text)
        return
    try:
        assert toml.loads(text) == wanted
    except toml.NestedTooDeeplyError:
        assert _depth(wanted) > 3 or text.count(".") >= toml.DEPTH_MAX or text.count("[") > 8


def _depth(value: object) -> int:
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return 1 + max(map(_depth, inner), default=0)


COSTLY = {
    "dots": ".".join(["a"] * BYTES),
    "eight names": "\n".join(f"[a.b.c.d.e.f.g.h{n}]\na.a.a.a.a.a.a.a=1" for n in range(4000)),
    "inline": "a=[" + ",".join(["{a.b.c.d.e={a={a=1}}}"] * 5000) + "]",
    "open strings": '"""' + '\\"""' * BYTES,
    "quotes": 'a = """' + '""a' * BYTES + '"""',
    "open brackets": "a = " + "[" * BYTES,
}


@pytest.mark.parametrize("what", COSTLY)
def test_each_text_is_read_to_an_end_or_refused(what: str) -> None:
    with contextlib.suppress(ValueError):
        toml.loads(COSTLY[what][:BYTES])
