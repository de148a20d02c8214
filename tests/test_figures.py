"""What README and MEASURED say of a model is on its card."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import cast

import pytest

from graspd.models import zoo

ROOT = Path(__file__).parents[1]
PAGES = {name: (ROOT / name).read_text() for name in ("README.md", "deploy/MEASURED.md")}
CARDS = {name: zoo.card(name) for name in zoo.names()}
PUBLISHED = "published: loops, Keras predict"
"""The published code around the weights of `cnn1`, which judge as they do in graspd."""
PROTOCOLS = {
    "known objects": ("cv",),
    "other objects": ("objects", "objects-whole"),
    "another day": ("session",),
}
"""By title of a column."""
UNCALIBRATED = "on another day without session calibration"
FIGURE = r"(\d+(?:\.\d+)?)(?: \+- (\d+(?:\.\d+)?))?"
Cells = Mapping[str, str]
Spread = Mapping[str, float]


def tables(text: str) -> Iterator[list[Cells]]:
    """The tables of a page: their rows by title of the column, the first one's as ''."""
    for table in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        head, _, *rows = (
            [cell.strip() for cell in line.split("|")[1:-1]] for line in table.split("\n")[:-1]
        )
        titles = ["", *(title.partition("[^")[0] for title in head[1:])]  # without footnotes
        yield [dict(zip(titles, row, strict=False)) for row in rows]


def model_of(cell: str) -> str | None:
    """The model that a row is of."""
    if cell == PUBLISHED:
        return "cnn1"
    named = re.match(r"`([\w-]+)`", cell)
    return named[1] if named and named[1] in CARDS else None


def on_card(model: str, column: str) -> Spread | None:
    """F1, 0..1, of the model's card: mean and standard deviation over the folds."""
    protocols = CARDS[model]["protocols"]
    if column == UNCALIBRATED:
        session = protocols["session"]
        return cast("Spread", session["calibrated_by"].get("none", session["spreads"]["f1"]))
    for protocol in PROTOCOLS[column]:
        if protocol in protocols:
            return cast("Spread", protocols[protocol]["spreads"]["f1"])
    return None


def agrees(said: str, spread: Spread) -> bool:
    """Whether a cell's figure in % is this one, as far as it is printed."""
    figure = re.match(FIGURE, said)
    assert figure, said
    return all(
        text is None or text == f"{100 * value:.{len(text.partition('.')[2])}f}"
        for text, value in zip(figure.groups(), (spread["mean"], spread["std"]), strict=True)
    )


Told = tuple[str, str, Spread | None]
"""Where a figure stands, what it says, and F1 or another figure of the card."""


def told_of_models(page: str) -> Iterator[Told]:
    """Yield F1 of each model in a page's tables, without means over seeds, which RESULTS has."""
    results = (ROOT / "models/RESULTS.md").read_text()
    (systems,) = tables(results.partition("\n## 2. ")[2].partition("\n## ")[0])
    of_seeds = {row["`cv`"].partition(" (s.e.")[0] for row in systems}
    for table in tables(PAGES[page]):
        for row in table:
            model = model_of(row[""])
            for column in (*PROTOCOLS, UNCALIBRATED):
                if model is not None and row.get(column, "-") not in {"-", *of_seeds}:
                    yield f"{model}, {column}", row[column], on_card(model, column)


@pytest.mark.parametrize("page", PAGES)
def test_tables_of_models_say_what_the_cards_say(page: str) -> None:
    compared = list(told_of_models(page))
    assert len(compared) >= 5
    wrong = [each for each in compared if each[2] is None or not agrees(each[1], each[2])]
    assert wrong == []


def test_broken_electrodes_cost_what_the_card_says() -> None:
    study = CARDS["small-session"]["broken"]
    expected = {
        "unnoticed": {each["number"]: each["unnoticed"] for each in study["broken"][:5]},
        "repaired": {each["number"]: each["known"] for each in study["broken"][:5]},
    }
    assert {each["reads"] for each in study["broken"][:5]} == {"at 0"}
    every = (table for text in PAGES.values() for table in tables(text))
    (table,) = (table for table in every if any("unnoticed" in row[""] for row in table))
    for kind, found in expected.items():
        (row,) = (row for row in table if kind in row[""])
        said = {int(number): cell for number, cell in row.items() if number}
        assert said == {
            each: f"{100 * f1:.1f}" for each, f1 in {0: study["sound"], **found}.items()
        }


def test_a_wrong_figure_is_noticed() -> None:
    spread = CARDS["small-session"]["protocols"]["cv"]["spreads"]["f1"]
    assert agrees("92.3 +- 1.5", spread)
    assert agrees("92", spread)
    assert not agrees("92.4 +- 1.5", spread)
    assert not agrees("92.3 +- 1.4", spread)
