"""Mistakes of a scene in the words of the file: one line for each, with its key."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from graspd.daemon.process.text import did_you_mean, printable

Section = type[BaseModel]

LINES_MAX = 20
"""Most mistakes that are listed; with more it is probably another kind of file."""
SHOWN_MAX = 80
"""Most characters of a key or value in a line."""
MESSAGE_MAX = 320
"""Most characters of an explanation, which may contain such a value."""


def lines_of(error: ValidationError, scene: Section, path: Path) -> list[str]:
    """Return a line for each mistake that pydantic found; after `LINES_MAX` the number of more."""
    mistakes = error.errors(include_url=False)
    inner = {mistake["loc"][:depth] for mistake in mistakes for depth in range(len(mistake["loc"]))}
    # A wrong item also makes its list wrong; only the item gets a line.
    single = [mistake for mistake in mistakes if mistake["loc"] not in inner]
    lines = [_line(path, scene, mistake) for mistake in single[:LINES_MAX]]
    if len(single) > LINES_MAX:
        lines.append(f"{path}: and {len(single) - LINES_MAX} more")
    return lines


def _line(path: Path, scene: Section, mistake: ErrorDetails) -> str:
    keys, section = _place(scene, tuple(mistake["loc"]))
    key = printable(".".join(keys) or "scene", SHOWN_MAX)
    if mistake["type"] == "extra_forbidden":
        return f"{path}: {key}: no such key{_suggestion(keys[-1], section)}"
    if mistake["type"] == "missing":
        return f"{path}: {key}: is missing"
    if mistake["type"] == "union_tag_not_found":
        return f"{path}: {key}.driver: is missing"
    if mistake["type"] == "union_tag_invalid":
        context = mistake["ctx"]
        drivers, tag = context["expected_tags"].replace("'", ""), context["tag"]
        return (
            f"{path}: {key}.driver: no driver '{printable(tag, SHOWN_MAX)}'"
            f"{did_you_mean(tag, drivers.split(', ')) or f'; there are: {drivers}'}"
        )
    message = mistake["msg"].removeprefix("Value error, ").replace("tuple", "list")
    message = printable(message, MESSAGE_MAX)
    given = mistake["input"]
    shown = "" if isinstance(given, dict | BaseModel) else f" (is {_shown(given)})"
    return f"{path}: {key}: {message[0].lower()}{message[1:]}{shown}"


def _shown(value: object) -> str:
    """Return a value as Python writes it, at most `SHOWN_MAX` characters. `repr` fails for long
    numbers and deep lists."""
    try:
        return printable(repr(value), SHOWN_MAX)
    except (ValueError, RecursionError):
        return "too large to show"


def _place(scene: Section, location: tuple[int | str, ...]) -> tuple[list[str], Section | None]:
    """Return the keys that lead to a location, and the section with the last of them, or None.

    The driver's name, which pydantic puts between the keys, is left out.
    """
    keys: list[str] = []
    section: Section | None = None
    inside = [scene]
    for part in map(str, location):
        of_driver = [each for each in inside if part in _tags(each)]
        if len(inside) > 1 and of_driver:
            inside = of_driver
            continue
        keys.append(part)
        section = inside[0] if len(inside) == 1 else None
        field = section.model_fields.get(part) if section else None
        inside = list(_sections(field.annotation)) if field else []
    return keys, section


def _sections(annotation: object) -> Iterator[Section]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _sections(argument)


def _tags(section: Section) -> tuple[str, ...]:
    driver = section.model_fields.get("driver")
    return get_args(driver.annotation) if driver else ()


def _suggestion(wrong: str, section: Section | None) -> str:
    keys = list(section.model_fields) if section else []
    stem = wrong.rsplit("_", 1)[0]  # for example `max_age_s` instead of `max_age_ms`
    of_unit = (f"; did you mean {name}?" for name in keys if name.rsplit("_", 1)[0] == stem)
    return did_you_mean(wrong, keys) or next(of_unit, f"; there are: {', '.join(keys)}")
