"""The list of names in the README is right, and both clients have the same bounds."""

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
"""Without comments and strings."""
README = (CPP.parent / "README.md").read_text()
ONLY_PYTHON = {("Client", "close")}
"""A destructor does that in C++."""
FOR_ASYNCIO = "AsyncClient"
"""Has what `Client` has; only Python has it."""
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


def in_readme() -> Names:
    listed = README.partition("## Names")[2].partition("\n\nOnly Python")[0]
    lines = re.sub(r"\n +", " ", listed).splitlines()
    rows = [line.removeprefix("- ").split(": ") for line in lines if line.startswith("- `")]
    return {name.strip("`"): set(re.findall(r"`(\w+)`", has)) for name, has in rows}


def minus(names: Names, left_out: set[tuple[str, str]]) -> Names:
    assert all(name in names[kind] for kind, name in left_out)
    return {
        kind: {name for name in held if (kind, name) not in left_out}
        for kind, held in names.items()
    }


def test_the_list_has_the_public_names() -> None:
    python = in_python()
    assert python.pop(FOR_ASYNCIO) == python["Client"]
    assert in_readme() == minus(python, ONLY_PYTHON)


def test_both_clients_have_the_same_bounds() -> None:
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
