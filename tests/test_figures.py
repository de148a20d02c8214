"""Pages have the figures of the models' cards, and pictures those of the tables."""

from __future__ import annotations

import pytest

from graspd.models.trust.learner import SCALE
from tests.figures import ROOT, TABLES, WORTH, Rows, renewed, table

MEASURED = (ROOT / "deploy/MEASURED.md").read_text()


@pytest.mark.parametrize("page", TABLES)
def test_a_pages_figures_are_those_of_the_models_cards(page: str) -> None:
    assert (ROOT / page).read_text() == renewed(page), "write it: python -m tests.figures"


def test_the_learners_scale_is_the_one_fitted_in_the_card() -> None:
    assert WORTH["reliability"]["shipped"] == SCALE


def drawn(drawing: str, title: str) -> Rows:
    """Return the rows of the table, beginning with `title`, in deploy/`drawing`.svg."""
    return table((ROOT / "deploy" / f"{drawing}.svg").read_text(), title)[1]


def test_the_picture_worth_svg_has_the_figures_of_its_table() -> None:
    title = "slips among `stable` / good lifts kept"
    titles, rows, _ = table(MEASURED, title)
    every, points, _ = table((ROOT / "deploy/worth.svg").read_text(), title)
    shown = [every.index(title) for title in titles[1:]]
    assert [[row[0], *(row[at] for at in shown)] for row in points] == rows


def test_the_picture_of_run_times_has_its_tables_figures() -> None:
    """The table in MEASURED leaves out models of fewer fingers, intervals and hot times."""
    every = {row[0]: row for row in drawn("error-vs-time", "model")}
    rows = table(MEASURED, "model, F1 in %")[1]
    assert {row[0] for row in rows} == {name for name in every if every[name][1] == "ff mf th"}
    for name, known, *others in rows:
        _, _, drawn_known, *cells = every[name]
        assert drawn_known.startswith(f"{known} (")
        assert set(others) <= set(cells)
