"""The table of attacks says what happened, and what did not hold ends the command with 1."""

from __future__ import annotations

import re

import pytest

from tests.bench.attacks.__main__ import ATTACKS, main
from tests.bench.attacks.doors import Outcome, Plan
from tests.conftest import ROOT


def raises(_plan: Plan) -> Outcome:
    raise OSError("the door is gone")


def test_an_attack_that_cannot_be_made_has_not_held(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(ATTACKS, "gone", raises)
    assert main(["--only", "gone", "--minutes", "0"]) == 1
    assert "OSError: the door is gone" in capsys.readouterr().out


def test_the_page_has_a_row_for_every_attack() -> None:
    page = (ROOT / "deploy" / "ATTACKS.md").read_text()
    assert re.findall(r"^\| `([a-z0-9-]+)` \|", page, re.M) == list(ATTACKS)
