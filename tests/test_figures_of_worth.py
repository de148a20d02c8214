"""What pages say of `stable`, of a risk and of `p_slip` is on the card, and in the pictures."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from graspd.models import zoo
from graspd.models.trust.learner import SCALE
from tests.conftest import ROOT

WORTH: Mapping[str, Any] = zoo.card("small-session")["worth"]
"""Figures of `graspd report worth`."""
README, RESULTS, MEASURED, CHOOSING, LEARNER = (
    (ROOT / name).read_text()
    for name in (
        "README.md",
        "models/RESULTS.md",
        "deploy/MEASURED.md",
        "deploy/CHOOSING.md",
        "models/trust/learner.py",
    )
)
TABLE = r"^\| {title}.*\n\|[-| :]*\n((?:\|.*\n)+)"


def rows_of(page: str, title: str) -> list[list[str]]:
    """Cells of the one table of a page whose first titles begin so."""
    (table,) = re.findall(TABLE.format(title=re.escape(title)), page, re.MULTILINE)
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]


def percents(*fractions: float, digits: int = 1) -> list[str]:
    return [f"{100 * fraction:.{digits}f}" for fraction in fractions]


def curves() -> list[list[str]]:
    return [
        [
            name,
            *(
                f"{100 * one['slips_among_stable']:.0f} / {100 * one['coverage']:.0f}"
                for one in points
            ),
        ]
        for name, points in WORTH["curves"].items()
    ]


def test_what_stable_is_worth_stands_on_the_card() -> None:
    assert rows_of(MEASURED, "slips among `stable` / good lifts kept") == curves()
    assert rows_of(MEASURED, "warm-up, target 0.05") == [
        [str(one["warm_up"]), *risk_cells(one)] for one in WORTH["warm_up"]
    ]
    assert rows_of(MEASURED, "`p_slip` | grasps") == [
        [
            f"{one['low']:g} to {one['high']:g}",
            str(one["grasps"]),
            *percents(one["said"], one["slipped"]),
        ]
        for one in WORTH["reliability"]["parts"]
        if one["high"] <= 0.5
    ]
    above = [one for one in WORTH["reliability"]["parts"] if one["low"] >= 0.5]
    (most,) = percents(max(one["said"] - one["slipped"] for one in above))
    assert f"From 0.5 on it says at most {most} points more than slipped." in MEASURED


def risk_cells(one: Mapping[str, float]) -> list[str]:
    shares = percents(one["kept"], one["slips"], one["above"])
    return [*shares, f"{one['supervised']:.0f}"]


def test_the_page_has_the_learners_fitted_scale() -> None:
    figures = WORTH["reliability"]
    scales = f"{min(figures['scales']):.2f} to {max(figures['scales']):.2f}"
    low, middle, high = figures["sessions"]
    measured, learner = (" ".join(text.split()) for text in (MEASURED, LEARNER))
    assert figures["shipped"] == SCALE
    assert all(scales in text for text in (measured, learner))
    assert f"scaled log-odds is {figures['slope']:.2f} on the others" in learner
    assert f"so scaled is {figures['slope']:.2f} (1 is honest)" in measured
    assert f"a session {middle:.2f} in the median and {low:.2f} to {high:.2f}" in measured


def test_choosing_a_risk_quotes_the_card() -> None:
    for target, kept, slips, above, supervised in rows_of(CHOOSING, "target | good lifts"):
        several = [one for one in WORTH["risk"] if one["target"] == float(target)]
        for said, key, scale in (
            (kept, "kept", 100),
            (slips, "slips", 100),
            (above, "above", 100),
            (supervised, "supervised", 1),
        ):
            ends = [scale * choose(one[key] for one in several) for choose in (min, max)]
            digits = len(said.split(" to ")[0].partition(".")[2])
            assert said == " to ".join(f"{end:.{digits}f}" for end in ends)


def test_the_readme_has_the_sealed_day_of_the_results() -> None:
    said = rows_of(README, "model | F1 of judged")
    assert [row[1:] for row in said] == [
        row[1:] for row in rows_of(RESULTS, "model | F1 of judged")
    ]
    slips = [float(share) for share in said[0][2].split(" / ")]
    assert "a fifth of what is called `stable` slips" in " ".join(README.split())
    assert all(18.0 < share < 22.0 for share in slips)


def drawn_rows(drawing: str) -> list[list[str]]:
    """Rows of the table that a picture carries as its description: what it was drawn from."""
    text = (ROOT / "deploy" / f"{drawing}.svg").read_text()
    description = text.partition("<desc>")[2].partition("</desc>")[0]
    lines = [line for line in description.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]


def test_the_picture_of_worth_has_the_figures_of_its_table() -> None:
    drawn = drawn_rows("worth")
    assert drawn[2:] == rows_of(MEASURED, "slips among `stable` / good lifts kept")


def test_the_picture_of_run_times_matches_its_table() -> None:
    """The table in MEASURED leaves out models of fewer fingers, intervals and hot times."""
    every = {row[0]: row for row in drawn_rows("error-vs-time")}
    told = rows_of(MEASURED, "model, F1 in %")
    whole = [name for name, row in every.items() if row[1] == "ff mf th"]
    assert {row[0] for row in told} == set(whole)
    for name, known, *others in told:
        _, _, drawn_known, *drawn = every[name]
        assert drawn_known.startswith(f"{known} (")
        assert set(others) <= set(drawn)
