"""One figure for one thing: what README, MEASURED and RESULTS say of a model is on its card."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, cast

import pytest

from graspd.models import zoo
from graspd.models.training.evaluating.findings import FINDINGS

ROOT = Path(__file__).parents[1]
PAGES = {name: (ROOT / name).read_text() for name in ("README.md", "deploy/MEASURED.md")}
RESULTS = (ROOT / "models" / "RESULTS.md").read_text()
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
CALIBRATED_BY = {
    "none": "none",
    **{f"n{grasps}": str(grasps) for grasps in (5, 10, 20, 50)},
    "all": "all",
    "running": "running",
    "running-sorted": "running, sorted",
}
"""Titles of the columns of RESULTS.md, section 3, by their name on a card."""
METRICS = ("accuracy", "precision", "recall")
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


def section(number: int) -> list[list[Cells]]:
    """The tables of a section of RESULTS.md."""
    text = RESULTS.partition(f"\n## {number}. ")[2].partition("\n## ")[0]
    assert text
    return list(tables(text))


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
    of_seeds = {row["`cv`"].partition(" (s.e.")[0] for row in section(2)[0]}
    for table in tables(PAGES[page]):
        for row in table:
            model = model_of(row[""])
            for column in (*PROTOCOLS, UNCALIBRATED):
                if model is not None and row.get(column, "-") not in {"-", *of_seeds}:
                    yield f"{model}, {column}", row[column], on_card(model, column)


def told_of_systems() -> Iterator[Told]:
    """Yield F1 of each protocol in RESULTS.md that has as many seeds as a card, which has one."""
    seeds = {(row[""], row["protocol"]): row["seeds"] for row in section(6)[0]}
    for row in section(2)[0]:
        model = model_of(row[""])
        for protocol, figures in CARDS[model]["protocols"].items() if model else ():
            said, spread = row.get(f"`{protocol}`", "-"), figures["spreads"]["f1"]
            if said != "-" and int(seeds[row[""], f"`{protocol}`"]) == spread["seeds"]:
                yield f"{model}, {protocol}", said, spread


def told_of_splits() -> Iterator[Told]:
    """Yield every figure in RESULTS.md that is of the splits of a card."""
    for row in section(6)[0]:
        model, protocol = model_of(row[""]), row["protocol"].strip("`")
        spreads = CARDS[model]["protocols"].get(protocol, {}).get("spreads") if model else None
        if spreads is not None and int(row["seeds"]) == spreads["f1"]["seeds"]:
            for metric in METRICS:
                yield f"{model}, {protocol}, {metric}", row[metric], spreads[metric]


def told_of_sessions() -> Iterator[Told]:
    """Yield F1 on another day by the number of grasps that calibrate the session."""
    calibrated = {model: row for row in section(3)[0] if (model := model_of(row[""]))}
    for model in ("cnn1-session", "small-session"):
        found = CARDS[model]["protocols"]["session"]["calibrated_by"]
        assert set(found) == set(CALIBRATED_BY)
        for each, spread in found.items():
            yield f"{model}, {each}", calibrated[model][CALIBRATED_BY[each]], spread


@pytest.mark.parametrize(
    ("told", "least"),
    [
        *((partial(told_of_models, page), 5) for page in PAGES),
        (told_of_systems, 8),
        (told_of_splits, 3 * len(METRICS)),
        (told_of_sessions, 2 * len(CALIBRATED_BY)),
    ],
)
def test_tables_of_models_say_what_the_cards_say(
    told: Callable[[], Iterator[Told]], least: int
) -> None:
    compared = list(told())
    assert len(compared) >= least
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


@pytest.mark.parametrize("page", PAGES)
def test_an_f1_in_prose_is_on_some_card(page: str) -> None:
    known = {
        f"{100 * spread['mean']:.1f}"
        for card in CARDS.values()
        for figures in card["protocols"].values()
        for spread in (figures["spreads"]["f1"], *figures["calibrated_by"].values())
    }
    known |= {f"{100 * each['every']['f1']:.1f}" for card in CARDS.values() for each in days(card)}
    prose = " ".join(line for line in PAGES[page].splitlines() if not line.startswith("|"))
    said = set(re.findall(r"\bF1 (\d+\.\d)\b", prose))
    assert said <= known


def days(card: Mapping[str, Any]) -> list[Any]:
    found = card["protocols"].get("days", {}).get("days", {})
    return list(found.values())


def test_results_of_other_days_are_those_of_the_cards() -> None:
    by_day = {
        model: row for row in section(4)[0] if (model := model_of(row[""])) and days(CARDS[model])
    }
    assert set(by_day) == {"cnn1-session", "small-session"}
    for model, row in by_day.items():
        for group, figures in CARDS[model]["protocols"]["days"]["days"].items():
            every = figures["every"]
            said = f"{100 * every['f1']:.1f} / {100 * every['slips_among_stable']:.1f}"
            assert row[group] == said


def test_results_say_each_figure_once() -> None:
    """The first sections and the findings have F1 as the table of all systems has it."""
    (paper,), (systems,), (differences,) = section(1), section(2), section(5)
    every = {
        (row[""], title): said.partition(" (s.e.")[0]
        for row in systems
        for title, said in row.items()
        if title.startswith("`") and said != "-"
    }
    for row in paper:
        ours, figure = row["ours"], row["paper"]
        if row["figure"] == "F1":
            assert every[row[""], row["protocol"]] == ours
        mean = float(ours.split(" ")[0])
        # Both are rounded, and the difference once more.
        assert float(row["difference"]) == pytest.approx(
            mean - float(figure.split(" ")[0]), abs=0.101
        )
    figures = {(key[0].strip("`"), key[1].strip("`")): said for key, said in every.items()}
    shown = {f"{system}/{protocol}": said for (system, protocol), said in figures.items()}
    shown |= {
        f"{row[''].strip('`')}/{row['protocol'].strip('`')}/difference": row["to `cnn1`"]
        for row in differences
    }
    shown |= {
        f"{row[''].strip('`')}/{row['protocol'].strip('`')}/paper": row["paper"]
        for row in paper
        if row["figure"] == "F1"
    }
    shown |= {
        f"{row[''].strip('`')}/{row['protocol'].strip('`')}/auc": f"{float(row['AUC']):.2f}"
        for row in section(6)[0]
    }
    said = [line[2:] for line in RESULTS.splitlines() if line.startswith("- **")]
    assert said == [finding.format_map(shown) for finding in FINDINGS]


def test_a_wrong_figure_is_noticed() -> None:
    spread = CARDS["small-session"]["protocols"]["cv"]["spreads"]["f1"]
    assert agrees("92.3 +- 1.5", spread)
    assert agrees("92", spread)
    assert not agrees("92.4 +- 1.5", spread)
    assert not agrees("92.3 +- 1.4", spread)
