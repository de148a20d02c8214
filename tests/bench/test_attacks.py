"""The table of attacks says what happened, and what did not hold ends the command with 1."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest

from tests.bench.attacks.__main__ import ATTACKS, main
from tests.bench.attacks.doors import Outcome, Plan
from tests.conftest import ROOT


def attack(*, held: bool) -> Callable[[Plan], Outcome]:
    def run(plan: Plan) -> Outcome:
        rounds = sum(1 for _ in plan.rounds())
        assert plan.folder.is_dir()
        return Outcome(rounds, "nothing", held)

    return run


def raises(_plan: Plan) -> Outcome:
    raise OSError("the door is gone")


@pytest.mark.parametrize("held", [True, False])
def test_what_does_not_hold_is_said(
    held: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(ATTACKS, "one", attack(held=True))
    monkeypatch.setitem(ATTACKS, "two", attack(held=held))
    only = ["--only", "one", "--only", "two"]
    assert main([*only, "--minutes", "0"]) == (0 if held else 1)
    printed = capsys.readouterr().out
    assert "| `one` | 1 | nothing | yes |" in printed
    assert ("**no**" in printed) is not held


def test_an_attack_that_cannot_be_made_has_not_held(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(ATTACKS, "gone", raises)
    assert main(["--only", "gone", "--minutes", "0"]) == 1
    assert "OSError: the door is gone" in capsys.readouterr().out


def test_the_page_has_a_row_for_every_attack() -> None:
    page = (ROOT / "deploy" / "ATTACKS.md").read_text()
    assert re.findall(r"^\| `([a-z0-9-]+)` \|", page, re.M) == list(ATTACKS)
