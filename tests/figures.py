"""Write the figures that pages share with the models' cards: `python -m tests.figures`."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

from graspd.models import zoo

ROOT: Final = Path(__file__).parents[1]
RESULTS: Final = (ROOT / "models/RESULTS.md").read_text()
CARDS: Final = {name: zoo.card(name) for name in zoo.names()}
WORTH: Final[Mapping[str, Any]] = CARDS["small-session"]["worth"]
"""Figures of `graspd report worth` for `small-session`, on its card."""
PUBLISHED: Final = "published: loops, Keras predict"
"""Row of the published code, which runs the weights of `cnn1` and judges as graspd does."""
PROTOCOLS: Final = {
    "known objects": ("cv",),
    "other objects": ("objects", "objects-whole"),
    "another day": ("session",),
}
"""Protocols for a column with F1, by its title; the first one that the card has is used."""

Rows = list[list[str]]
"""Cells of a table."""


def table(text: str, title: str) -> tuple[list[str], Rows, tuple[int, int]]:
    """Return titles and rows of the one table in Markdown that begins with `title`, and the begin
    and end of its rows in `text`."""
    pattern = rf"^(\| {re.escape(title)}.*\|)\n\|[-| :]*\n((?:\|.*\n)+)"
    (found,) = re.finditer(pattern, text, re.MULTILINE)
    (head,), rows = _cells([found[1]]), _cells(found[2].splitlines())
    return [each.partition("[^")[0] for each in head], rows, found.span(2)


def _cells(lines: Iterable[str]) -> Rows:
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]


def _f1(titles: list[str], rows: Rows, *, spread: bool) -> Rows:
    """Return `rows` with the F1 of the models' cards, except for means over seeds in RESULTS.

    `spread`: with the standard deviations.
    """
    systems = RESULTS.partition("\n## 2. ")[2].partition("\n## ")[0]
    of_seeds = {cell.partition(" (s.e.")[0] for row in _cells(systems.splitlines()) for cell in row}
    for row in rows:
        named = re.match(r"`([\w-]+)`", row[0])
        protocols = CARDS["cnn1" if row[0] == PUBLISHED else named[1] if named else ""]["protocols"]
        for at, title in enumerate(titles):
            has = [each for each in PROTOCOLS.get(title, ()) if each in protocols]
            if has and row[at] not in {"-", *of_seeds}:
                f1 = protocols[has[0]]["spreads"]["f1"]
                row[at] = _percent(f1["mean"]) + f" +- {_percent(f1['std'])}" * spread
    return rows


def _percent(fraction: float, digits: int = 1) -> str:
    return f"{100 * fraction:.{digits}f}"


def _sealed(_titles: list[str], rows: Rows) -> Rows:
    of_results = table(RESULTS, "model | F1 of judged")[1]
    return [[row[0], *result[1:]] for row, result in zip(rows, of_results, strict=True)]


def _curves(titles: list[str], _rows: Rows) -> Rows:
    return [
        [name]
        + [
            f"{_percent(one['slips_among_stable'], 0)} / {_percent(one['coverage'], 0)}"
            for one in points
            if str(one["grasps"]) in titles
        ]
        for name, points in WORTH["curves"].items()
    ]


def _warm_up() -> str:
    one_a_warm_up = WORTH["warm_up"]
    numbers = ", ".join(str(one["warm_up"]) for one in one_a_warm_up)
    kept = ", ".join(_percent(one["kept"], 0) for one in one_a_warm_up)
    slips = ", ".join(_percent(one["slips"]) for one in one_a_warm_up)
    lifts = ", ".join(f"{one['supervised']:.0f}" for one in one_a_warm_up)
    return (
        f"With a target of 0.05 and a warm-up of {numbers} outcomes {kept} % of the good lifts are "
        f"kept, {slips} % of `stable` slip, and a session has {lifts} supervised lifts."
    )


def _reliability() -> str:
    parts = WORTH["reliability"]["parts"]
    off = [one["said"] - one["slipped"] for one in parts]
    (part,) = (one for one in parts if one["low"] == 0.05)
    return (
        f"After outcomes `p_slip` was at most {_percent(max(off))} points above the share that "
        f"slipped, and {_percent(-min(off))} below it, in {len(parts)} parts from 0 to 1; of "
        f"{part['low']:g} to {part['high']:g} it said {_percent(part['said'])} %, and "
        f"{_percent(part['slipped'])} % slipped."
    )


def _broken(titles: list[str], rows: Rows) -> Rows:
    study = CARDS["small-session"]["broken"]
    dead = {str(each["number"]): each for each in study["broken"] if each["reads"] == "at 0"}
    for row, key in zip(rows, ("unnoticed", "known"), strict=True):
        row[1:] = [_percent(dead[n][key] if n in dead else study["sound"]) for n in titles[1:]]
    return rows


def _risk(_titles: list[str], rows: Rows) -> Rows:
    """Return `rows` with least and most of each figure over the kinds of sessions, by target."""
    for row in rows:
        several = [one for one in WORTH["risk"] if one["target"] == float(row[0])]
        for at, key in enumerate(("kept", "slips", "above", "supervised"), 1):
            scale, digits = 1 if key == "supervised" else 100, int(key == "slips")
            ends = (scale * choose(one[key] for one in several) for choose in (min, max))
            row[at] = " to ".join(f"{end:.{digits}f}" for end in ends)
    return rows


TABLES: Final[Mapping[str, Mapping[str, Callable[[list[str], Rows], Rows]]]] = {
    "README.md": {
        "model | known objects": partial(_f1, spread=True),
        "model | F1 of judged": _sealed,
    },
    "deploy/MEASURED.md": {
        "model, F1 in %": partial(_f1, spread=False),
        "slips among `stable` / good lifts kept": _curves,
        "dead electrodes": _broken,
    },
    "deploy/CHOOSING.md": {"target | good lifts": _risk},
}
"""Functions from titles and rows of a table to rows by the cards; by page and first title."""
PARAGRAPHS: Final[Mapping[str, Mapping[str, Callable[[], str]]]] = {
    "deploy/MEASURED.md": {"With a target of": _warm_up, "After outcomes": _reliability}
}
"""Functions that return a paragraph by the cards; by page and first words."""


def renewed(page: str) -> str:
    """Return the text of `page`, a path below the root, with the figures of the cards."""
    text = (ROOT / page).read_text()
    for title, rows_of in TABLES[page].items():
        titles, rows, (begin, end) = table(text, title)
        lines = (f"| {' | '.join(row)} |\n" for row in rows_of(titles, rows))
        text = text[:begin] + "".join(lines) + text[end:]
    for words, written in PARAGRAPHS.get(page, {}).items():
        begin = text.index(f"\n\n{words}") + 2
        paragraph = textwrap.fill(written(), 128, break_on_hyphens=False)
        text = text[:begin] + paragraph + text[text.index("\n\n", begin) :]
    return text


if __name__ == "__main__":
    for page in TABLES:
        (ROOT / page).write_text(renewed(page))
