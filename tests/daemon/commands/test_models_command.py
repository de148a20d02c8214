"""`graspd models`: what a user reads before choosing one."""

from __future__ import annotations

import json

import pytest

from daemon.assembly.assembly import DEFAULT_MODEL
from models import zoo
from tests.daemon.processes import graspd


def test_every_model_is_listed_with_its_size_and_figures() -> None:
    result = graspd("models")
    assert result.returncode == 0, result.stderr
    for name in zoo.names():
        line = next(line for line in result.stdout.splitlines() if line.split()[:1] == [name])
        card = zoo.card(name)
        assert str(card["parameters"]) in line
        measured = {entry["protocol"]: entry for entry in card["contract"]["measured"]}
        assert f"{100 * measured['cv']['f1_mean']:.1f} +- " in line
        assert ("(default)" in line) is (name == DEFAULT_MODEL)


@pytest.mark.parametrize("name", zoo.names())
def test_a_card_says_what_a_model_is_worth_and_where_it_ends(name: str) -> None:
    result = graspd("models", name)
    assert result.returncode == 0, result.stderr
    card = zoo.card(name)
    assert card["what"] in result.stdout
    for point in card["weak_points"]:
        assert point in result.stdout
    assert f"made by: graspd train {name} --data DIR" in result.stdout
    assert "licence of the data: MIT" in result.stdout
    assert json.loads(graspd("models", name, "--json").stdout) == card


def test_a_model_that_there_is_not_lists_those_that_there_are() -> None:
    result = graspd("models", "cnn9")
    assert result.returncode == 2
    assert result.stderr.startswith("graspd: no model 'cnn9' in the zoo; there are: cnn1")
