"""Both clients have the same names and constants."""

from __future__ import annotations

import inspect
import re
from dataclasses import fields, is_dataclass
from enum import Enum

from deploy.clients.python import graspd_client
from tests.clients.building import CPP

LITERALS = r""" "(?:\\.|[^"\\\n])*" | '(?:\\[^']+|[^'\\])' """
HEADER = re.sub(LITERALS, '""', (CPP / "graspd_client.hpp").read_text(), flags=re.VERBOSE)
HEADER = re.sub(r"//.*", "", HEADER)
"""The C++ header without comments and strings."""
ONLY_PYTHON = {("Client", "close")}
"""Methods that C++ lacks: a destructor closes there."""
FOR_ASYNCIO = "AsyncClient"
"""Class that only Python has, with the same names as `Client`."""
Names = dict[str, set[str]]


def in_python() -> Names:
    found: Names = {}
    for name in graspd_client.__all__:
        kind = getattr(graspd_client, name)
        if issubclass(kind, Enum):
            found[name] = {member.name.lower() for member in kind}
            continue
        own = {each for each in dir(kind) if not each.startswith("_")} - set(dir(tuple))
        held = {field.name for field in fields(kind)} if is_dataclass(kind) else set()
        found[name] = own | held
    found["Options"] = set(inspect.signature(graspd_client.Client).parameters) - {"self"}
    return found


def body(kind: str) -> str:
    """Return the text between the braces of a struct or class of the C++ header."""
    (start,) = re.finditer(rf"\b(?:struct|class) {kind}(?: final)?\b[^;{{]*{{", HEADER)
    depth = 1
    for place in range(start.end(), len(HEADER)):
        depth += {"{": 1, "}": -1}.get(HEADER[place], 0)
        if depth == 0:
            return HEADER[start.end() : place]
    raise AssertionError(f"{kind} has no end")


def minus(names: Names, left_out: set[tuple[str, str]]) -> Names:
    assert all(name in names[kind] for kind, name in left_out)
    return {
        kind: {name for name in held if (kind, name) not in left_out}
        for kind, held in names.items()
    }


def test_the_cpp_client_has_the_python_clients_names() -> None:
    python = in_python()
    assert python.pop(FOR_ASYNCIO) == python["Client"]
    for kind, names in minus(python, ONLY_PYTHON).items():
        assert names
        assert names - set(re.findall(r"\w+", body(kind))) == set(), kind


def test_both_clients_have_the_same_constants() -> None:
    python = {
        name: value
        for name, value in vars(graspd_client).items()
        if name.isupper() and not name.startswith("_")
    }
    constants: dict[str, float] = {}
    for line in re.findall(r"constexpr [\w:]+ ([A-Z]\w* = .*?);", HEADER):
        for name, value in re.findall(r"([A-Z_]+) = ([^,]+)", line):
            base, _, shift = re.sub(r"std::\w+\{(\d+)\}|'", r"\1", value).partition(" << ")
            constants[name] = int(base) << int(shift) if shift else float(base)
    assert constants == python
