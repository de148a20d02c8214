"""The table of attacks says what happened, and what did not hold ends the command with 1."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.bench.attacks import __main__ as command
from tests.bench.attacks.attack import Aim, Attack, Outcome, Plan


def _attack(name: str, *, held: bool) -> Attack:
    def run(plan: Plan) -> Outcome:
        rounds = sum(1 for _ in plan.rounds())
        assert plan.folder.is_dir()
        return Outcome(rounds, "nothing", held)

    return Attack(name, Aim.FALLS, "a knock", "knocks", run)


def _raises(_plan: Plan) -> Outcome:
    raise OSError("the door is gone")


@pytest.mark.parametrize("held", [True, False])
def test_what_does_not_hold_is_said(
    held: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        command, "attacks", lambda: [_attack("one", held=True), _attack("two", held=held)]
    )
    assert command.main(["--minutes", "0"]) == (0 if held else 1)
    printed = capsys.readouterr().out
    assert "| `one` | a knock | 1 knocks | nothing | yes |" in printed
    assert ("**no**" in printed) is not held


def test_an_attack_that_cannot_be_made_has_not_held(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    attack = Attack("gone", Aim.WHO_MAY, "a knock", "knocks", _raises)
    monkeypatch.setattr(command, "attacks", lambda: [attack])
    assert command.main(["--only", "gone", "--minutes", "0"]) == 1
    assert "OSError: the door is gone" in capsys.readouterr().out


def test_every_attack_has_a_name_of_its_own() -> None:
    names = [attack.name for attack in command.attacks()]
    assert len(names) == len(set(names))


def test_the_page_has_a_row_for_every_attack() -> None:
    page = Path(__file__).parents[2] / "deploy" / "ATTACKS.md"
    told = re.findall(r"^\| `([a-z0-9-]+)` \|", page.read_text(), re.M)
    assert told == [attack.name for attack in command.attacks()]
