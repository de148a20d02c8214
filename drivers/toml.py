"""TOML that people write, read at a bounded cost."""

from __future__ import annotations

import re
import tomllib
from typing import Any

DEPTH_MAX = 8
"""Names of a key with dots, and brackets within each other. What graspd reads has three of each;
`tomllib` takes time and memory by the square of the first, and a stack for the second."""

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
"""Strings, comments, brackets, dots, and what ends a key. `tomllib` stops at an open string too."""


class NestedTooDeeplyError(ValueError):
    """The text nests more deeply than anything that graspd reads."""


def loads(text: str) -> dict[str, Any]:
    """Parse TOML. Raises `NestedTooDeeplyError`, and `ValueError` for what is none."""
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
