"""The study of broken electrodes, on made-up grasps."""

from __future__ import annotations

import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

from graspd.models.training.evaluating.broken import KINDS, NUMBERS, broken_study
from graspd.models.training.systems.registry import SYSTEMS
from tests.models.training.samples import sessions


def test_dead_electrodes_cost_less_once_they_are_repaired() -> None:
    study = broken_study(SYSTEMS["svm-session"], sessions(150), seed=1)
    assert len(study["broken"]) == len(KINDS) * len(NUMBERS)
    assert study["grasps"] == 135
    # A tenth of the labels is wrong, so 90 % is the best that anybody could reach.
    assert study["sound"] > 0.8
    dead = next(b for b in study["broken"] if b["reads"] == "at 0" and b["number"] == 12)
    assert dead["unnoticed"] < dead["known"]
    assert dead["known"] > study["sound"] - 0.05
