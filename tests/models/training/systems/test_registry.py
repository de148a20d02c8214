"""The registry of systems: names, inputs, published figures, digests, hands of fewer fingers."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train`")

from graspd.models import zoo
from graspd.models.training.estimators.configs import CNN1, PublishedRecipe
from graspd.models.training.evaluating.frame import Job, judged
from graspd.models.training.systems.registry import (
    SYSTEMS,
    configuration,
    digest,
    with_recipes,
)
from tests.daemon.judge.test_fewer_fingers import HANDS
from tests.models.training.samples import sessions

ALL_DIGESTS = "0541cffd27d347520bfb49fa2ca88e4be2efca68d951727692330768eff543aa"
"""SHA-256 of each system's name and digest. Stored results are found by these: another one means
that hours of training run again."""


def test_digests_of_all_systems_are_unchanged() -> None:
    lines = [f"{name} {digest(system)[:16]}\n" for name, system in SYSTEMS.items()]
    assert hashlib.sha256("".join(lines).encode()).hexdigest() == ALL_DIGESTS


def test_each_zoo_models_card_has_its_systems_configuration() -> None:
    fields = ("input", "estimator", "recipe", "augmentation", "tables")
    for name in zoo.names():
        assert zoo.card(name)["system"] == configuration(SYSTEMS[name], *fields)


def test_published_recipes_are_those_of_the_paper() -> None:
    assert SYSTEMS["cnn1-faithful"].recipe == PublishedRecipe(
        epochs=300, batch=32, learning_rate=1e-4, decay=0.005, l2=0.01
    )
    augmented = SYSTEMS["cnn1-augmented"]
    assert augmented.recipe == PublishedRecipe(epochs=30, l2=0.015)
    assert augmented.estimator == replace(CNN1, dropout=0.25)
    assert augmented.augmentation is not None
    assert augmented.augmentation.rotation_deg == 10.0


def test_every_smaller_hand_has_a_default_system() -> None:
    whole = SYSTEMS["small-session"]
    for name, fingers in HANDS.items():
        system = SYSTEMS[name]
        assert system.fingers == fingers
        assert digest(system) != digest(whole)
        assert digest(replace(system, fingers=whole.fingers)) == digest(whole)


def test_counts_of_fingers_that_a_system_lacks_change_nothing() -> None:
    grasps = sessions(120)
    other = replace(grasps, counts=grasps.counts.copy())
    other.counts[:, 1] = 3000
    job = Job(with_recipes(SYSTEMS["small-session-ff-th"], epochs=1), "cv", 0, 0, 3)
    one, two = (judged(job, sample) for sample in (grasps, other))
    np.testing.assert_array_equal(one["margin"], two["margin"])

    whole = Job(with_recipes(SYSTEMS["small-session"], epochs=1), "cv", 0, 0, 3)
    assert one["parameters"].max() < judged(whole, grasps)["parameters"].min()
