"""The registry of systems: names, inputs, published figures, digests."""

from __future__ import annotations

from dataclasses import replace

import pytest

from models import zoo
from models.contract import CountsInput, ImageInput, VectorInput
from models.training.estimators.classical import ForestConfig, MlpConfig, SvmConfig
from models.training.estimators.networks import CNN1, build, parameter_count
from models.training.estimators.recipe import PublishedRecipe, Recipe
from models.training.systems.names import SYSTEM_NAMES
from models.training.systems.registry import SYSTEMS
from models.training.systems.system import (
    BlendConfig,
    Member,
    SessionFeatures,
    configuration,
    digest,
    with_recipes,
)

DIGESTS = {
    "cnn0": "d70ec62f176fc5d0",
    "cnn1": "fb7cb38d6d043e8d",
    "cnn2": "1c79b98a778a05d2",
    "cnn3": "b5e925b1ad49e66c",
    "cnn3-3x3": "95950a88a48c9ccf",
    "cnn1-faithful": "7ffdc5258c34e975",
    "cnn1-augmented": "9130a6065746456e",
    "cnn1-dropout": "b1dee0acbd7b5cf5",
    "cnn1-plain": "e419af5be9732338",
    "svm": "d4ba9ba7400e5920",
    "mlp": "ae0c3261c3424158",
    "rf": "b9a3fd4d84e0a23f",
    "cnn0-d1-least-contact": "d015ed9f2cb629d7",
    "cnn0-d2a-least-contact": "b1d96abbb9eae1ef",
    "cnn0-d2b-least-contact": "91ba226932557be7",
    "cnn0-d3-least-contact": "de2b6399d0e374a8",
    "cnn0-horizontal": "67c4b936b6a0c533",
    "cnn0-vertical": "0ed7d70f45f76289",
    "svm-electrodes": "51f1f8c6b94928e5",
    "blend-electrodes": "34c960d716e9e91f",
    "cnn0-electrodes": "eb858d8898f13d04",
    "small-electrodes": "791afa534dcfdfea",
    "svm-session": "18418424dbb018dc",
    "hgb-session": "55e8da68027a2237",
    "cnn1-session": "1c1bf2e2aff948d1",
    "small-session": "0c08d8572eacdc69",
    "small-session-ff": "51c0c46eb213b6ac",
    "small-session-mf": "3b561ff9c79aabc2",
    "small-session-th": "5acaf16e51f45eb7",
    "small-session-ff-mf": "3f97165bd4d6f259",
    "small-session-ff-th": "8bfe7a7239503451",
    "small-session-mf-th": "c538eb6d10d7971e",
}
"""Stored results are found by these: another digest means that hours of training run again."""


def test_stored_results_of_every_system_stay_valid() -> None:
    assert {name: digest(system)[:16] for name, system in SYSTEMS.items()} == DIGESTS


def test_their_names_are_known_without_the_training() -> None:
    assert tuple(SYSTEMS) == SYSTEM_NAMES


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


def test_the_small_session_network_has_at_most_a_hundred_thousand_parameters() -> None:
    config = SYSTEMS["small-session"].estimator
    assert not isinstance(config, SvmConfig)
    assert parameter_count(build(config, (78,))) <= 100_000  # type: ignore[arg-type]


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
