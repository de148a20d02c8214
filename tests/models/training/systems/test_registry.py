"""The registry of systems: names, inputs, published figures, digests."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import pytest

from graspd.models import zoo
from graspd.models.contract import CountsInput, ImageInput, VectorInput
from graspd.models.training.estimators.configs import (
    CNN1,
    ForestConfig,
    MlpConfig,
    PublishedRecipe,
    Recipe,
    SvmConfig,
)
from graspd.models.training.systems.registry import SYSTEMS
from graspd.models.training.systems.system import (
    BlendConfig,
    Member,
    SessionFeatures,
    configuration,
    digest,
    with_recipes,
)

ALL_DIGESTS = "0541cffd27d347520bfb49fa2ca88e4be2efca68d951727692330768eff543aa"
"""SHA-256 of each system's name and digest. Stored results are found by these: another one means
that hours of training run again."""


def test_stored_results_of_every_system_stay_valid() -> None:
    lines = [f"{name} {digest(system)[:16]}\n" for name, system in SYSTEMS.items()]
    assert hashlib.sha256("".join(lines).encode()).hexdigest() == ALL_DIGESTS


@pytest.mark.parametrize("name", zoo.names())
def test_a_model_of_the_zoo_was_made_of_the_system_of_its_name(name: str) -> None:
    fields = ("input", "estimator", "recipe", "augmentation", "tables")
    assert zoo.card(name)["system"] == configuration(SYSTEMS[name], *fields)


def test_each_system_has_its_name_and_one_sentence() -> None:
    for name, system in SYSTEMS.items():
        assert system.name == name
        assert system.description.endswith(".")
        assert "\n" not in system.description


def test_inputs_are_those_that_the_names_promise() -> None:
    for name, system in SYSTEMS.items():
        if "-session" in name:
            assert isinstance(system.input, SessionFeatures)
        elif name.endswith("-electrodes"):
            assert isinstance(system.input, CountsInput)
            assert system.standardise
        elif isinstance(system.estimator, SvmConfig | MlpConfig | ForestConfig):
            assert isinstance(system.input, VectorInput)
        else:
            assert isinstance(system.input, ImageInput)
    d3 = SYSTEMS["cnn0-d3-least-contact"].input
    assert d3 == ImageInput("D3", "least-contact", "filled-image", "channels")
    horizontal = SYSTEMS["cnn0-horizontal"].input
    assert horizontal == ImageInput("D1", "neighbour-mean", "filled-image", "horizontal")


def test_the_faithful_recipe_and_the_augmented_one_are_the_published_ones() -> None:
    assert SYSTEMS["cnn1-faithful"].recipe == PublishedRecipe(
        epochs=300, batch=32, learning_rate=1e-4, decay=0.005, l2=0.01
    )
    augmented = SYSTEMS["cnn1-augmented"]
    assert augmented.recipe == PublishedRecipe(epochs=30, l2=0.015)
    assert augmented.estimator == replace(CNN1, dropout=0.25)
    assert augmented.augmentation is not None
    assert augmented.augmentation.rotation_deg == 10.0


def test_a_digest_tells_apart_what_gives_other_results_and_nothing_else() -> None:
    cnn1 = SYSTEMS["cnn1"]
    assert digest(cnn1) == digest(replace(cnn1, name="other", description="Another.", published=()))
    others = [
        replace(cnn1, recipe=Recipe(epochs=21)),
        replace(cnn1, recipe=Recipe(input_noise=0.1)),
        replace(cnn1, estimator=replace(CNN1, dropout=0.1)),
        replace(cnn1, input=VectorInput()),
        replace(cnn1, standardise=True),
        replace(cnn1, estimator=SvmConfig(1.0, 0.1)),
        replace(cnn1, estimator=BlendConfig((Member(CNN1, Recipe()),))),
        replace(cnn1, estimator=BlendConfig((Member(CNN1, Recipe(), weight=2.0),))),
    ]
    assert len({digest(system) for system in (cnn1, *others)}) == len(others) + 1
    assert len(digest(cnn1)) == 64


def test_all_recipes_of_a_system_can_be_changed_at_once() -> None:
    small, blend = SYSTEMS["small-session"], SYSTEMS["blend-electrodes"]
    changed = with_recipes(small, epochs=2)
    assert isinstance(changed.recipe, Recipe)
    assert changed.recipe.epochs == 2
    estimator = with_recipes(blend, epochs=2).estimator
    assert isinstance(estimator, BlendConfig)
    recipes = [member.recipe for member in estimator.members if member.recipe]
    assert recipes
    assert all(recipe.epochs == 2 for recipe in recipes)
    assert with_recipes(SYSTEMS["svm"], epochs=2) == SYSTEMS["svm"]
