"""The public names of both clients, and of the table of names in their README, are the same."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

from deploy.clients.python import graspd_client
from tests.clients.building import CPP

LITERALS = r""" "(?:\\.|[^"\\\n])*" | '(?:\\[^']+|[^'\\])' """
HEADER = re.sub(LITERALS, '""', (CPP / "graspd_client.hpp").read_text(), flags=re.VERBOSE)
HEADER = re.sub(r"//.*", "", HEADER)
"""Without comments and strings."""
README = (CPP.parent / "README.md").read_text()
ONLY_PYTHON = {("Client", "close")}
"""A destructor does that in C++."""
ONLY_CPP = {("Options", "warn")}
"""The standard library's logger in Python."""
Names = dict[str, set[str]]


def body(text: str, at: int) -> str:
    """What the braces hold that open first after a place."""
    begin = text.index("{", at) + 1
    depth = 1
    for end in range(begin, len(text)):
        depth += {"{": 1, "}": -1}.get(text[end], 0)
        if depth == 0:
            return text[begin:end]
    raise ValueError("a brace is not closed")


def without(text: str, opens: str, closes: str) -> str:
    """A text without what such brackets hold, however deep: they stay, empty."""
    kept, depth = "", 0
    for letter in text:
        depth -= letter == closes
        kept += letter if depth == 0 else ""
        depth += letter == opens
    return kept


def namespace() -> str:
    """What `namespace graspd` holds but for its `detail`."""
    whole = body(HEADER, HEADER.index("namespace graspd {"))
    detail = body(whole, whole.index("namespace detail {"))
    return whole.replace(detail, "")


def members(held: str) -> set[str]:
    """The public names of a struct or class, operators and constructors left out."""
    public = re.sub(r"private:.*", "", held, flags=re.DOTALL)
    flat = without(without(without(public, "{", "}"), "<", ">"), "(", ")")
    calls = set(re.findall(r"^    \w[^=\n]*?\b(\w+)\(\)", flat, re.MULTILINE))
    constructors = {name for name in calls if name[0].isupper()}
    declared = re.findall(r"^    [\w:<>]+ (\w[^;\n]*);", flat, re.MULTILINE)
    parts = [part for line in declared for part in line.split(",") if "(" not in line.split("=")[0]]
    found = {re.split(r"[={]", part)[0].strip() for part in parts}
    return (found | calls) - constructors - {"bool"}


def in_cpp() -> Names:
    public = namespace()
    found: Names = {}
    for declared in re.finditer(r"^(?:struct|class|enum class) (\w+)", public, re.MULTILINE):
        held = body(public, declared.start())
        is_enum = declared[0].startswith("enum")
        found[declared[1]] = set(re.findall(r"[a-z]\w*", held)) if is_enum else members(held)
    return found


def in_python() -> Names:
    found: Names = {}
    for name in graspd_client.__all__:
        kind = getattr(graspd_client, name)
        if issubclass(kind, Enum):
            found[name] = {member.name.lower() for member in kind}
            continue
        own = {each for each in vars(kind) if not each.startswith("_")}
        held = {field.name for field in fields(kind)} if is_dataclass(kind) else set()
        found[name] = own | held
    found["Options"] = parameters(graspd_client.Client)
    return found


def parameters(function: Callable[..., Any]) -> set[str]:
    return set(inspect.signature(function).parameters) - {"self"}


def in_readme() -> Names:
    table = README.partition("## Names")[2].partition("\n\nOnly Python")[0]
    rows = [row.split("|")[1:4] for row in table.splitlines() if row.startswith("| `")]
    return {name.strip(" `"): set(re.findall(r"`(\w+)`", has)) for name, _, has in rows}


def minus(names: Names, left_out: set[tuple[str, str]]) -> Names:
    assert all(name in names[kind] for kind, name in left_out)
    return {
        kind: {name for name in held if (kind, name) not in left_out}
        for kind, held in names.items()
    }


def test_both_clients_have_the_same_public_names() -> None:
    assert minus(in_cpp(), ONLY_CPP) == minus(in_python(), ONLY_PYTHON)


def test_the_table_has_the_public_names() -> None:
    assert in_readme() == minus(in_python(), ONLY_PYTHON)


def test_the_methods_take_the_same_arguments() -> None:
    client = body(HEADER, HEADER.index("\nclass Client {"))
    for name in ("verdict", "may_i_lift", "tell"):
        declared = re.search(rf"^    \w+ {name}\((.*?)\) {{", client, re.MULTILINE | re.DOTALL)
        assert declared is not None
        flat = without(without(declared[1], "<", ">"), "{", "}")
        cpp = [each.partition("=")[0].split()[-1].strip("&") for each in flat.split(",")]
        python = list(inspect.signature(getattr(graspd_client.Client, name)).parameters)
        assert cpp == python[1:]


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
