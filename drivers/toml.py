"""Read TOML written by people, at a bounded cost."""

from __future__ import annotations

import re
import tomllib
from typing import Any

DEPTH_MAX = 8
"""Most parts of a dotted key, and most nested brackets; files of graspd have three of each.

`tomllib` needs time quadratic in the first number, and stack for the second.
"""

_TOKEN = re.compile(
    r'"{3}(?:[^"\\]|\\.|"{1,2}(?!"))*+"{0,5}|'
    r"'{3}(?:[^']|'{1,2}(?!'))*+'{0,5}|"
    r'"(?:[^"\\\n]|\\.)*+"?|'
    r"'[^'\n]*+'?|"
    r"(?P<comment>\#[^\n]*+)|"
    r"(?P<open>[\[{])|(?P<close>[\]}])|(?P<dot>\.)|(?P<end>[=,\n])|"
    r"""[^"'\#\[\]{}.=,\n]++""",
    re.DOTALL,
)
"""Tokens of TOML: strings, comments, brackets, dots, and ends of keys.

A string without an end is a token too; `tomllib` refuses it.
"""


class NestedTooDeeplyError(ValueError):
    """Brackets nest deeper, or a dotted key has more parts, than `DEPTH_MAX`."""


def loads(text: str) -> dict[str, Any]:
    """Parse TOML. Raises `NestedTooDeeplyError`, or `ValueError` if it is not TOML."""
    depth = dots = 0
    for token in _TOKEN.finditer(text):
        match token.lastgroup:
            case "open":
                depth += 1
            case "close":
                depth -= 1
            case "dot":
                dots += 1
            case "end":
                dots = 0
        if depth > DEPTH_MAX or dots >= DEPTH_MAX:
            raise NestedTooDeeplyError("nested too deeply")
    return tomllib.loads(text)
