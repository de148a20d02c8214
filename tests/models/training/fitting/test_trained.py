"""Every kind of system is trained by one function, and takes drifted counts as it should."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import rotate

pytest.importorskip("torch", reason="needs the extra `train`")

from graspd.models.inputs import SessionBuilder, builder, raw_features
from graspd.models.training.estimators.configs import (
    Augmentation,
    BoostingConfig,
    ForestConfig,
    NetworkConfig,
    Recipe,
    SvmConfig,
)
from graspd.models.training.estimators.graphs import Fitted
from graspd.models.training.fitting.novelty import MARGIN_COUNTS, SESSION_MARGIN_COUNTS
from graspd.models.training.fitting.trained import FittedBlend, augment, fit, train
from graspd.models.training.systems.registry import (
    SYSTEMS,
    BlendConfig,
    Member,
    SessionFeatures,
    System,
    with_recipes,
)
from tests.models.training.samples import separable_counts, sessions

TINY = NetworkConfig(filters=4, hidden=8, dropout=0.2)
QUICK = Recipe(epochs=3)
BLEND = BlendConfig(
    (
        Member(SvmConfig(3.0, 0.003), weight=2.0),
        Member(ForestConfig(11, None)),
        Member(TINY, QUICK, copies=2),
    )
)
MADE = System("made", SessionFeatures(), BLEND)
SYSTEMS_MADE = {
    "svm": replace(MADE, estimator=SvmConfig(3.0, 0.003)),
    "boosting": replace(MADE, estimator=BoostingConfig(iterations=10, leaves=4)),
    "network": replace(MADE, estimator=TINY, recipe=QUICK),
    "blend": MADE,
}
FEATURES = SessionBuilder(3, 3.0)


def _features(grasps: int, seed: int = 7) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    counts, slipped = separable_counts(grasps, seed)
    raw = raw_features(separable_counts(160)[0])
    FEATURES.use(raw.mean(axis=0), raw.std(axis=0))
    return FEATURES.build_batch(counts)[0], slipped


INPUTS, SLIPPED = _features(160)
IMAGES = np.random.default_rng(3).normal(size=(20, 12, 11, 3)).astype(np.float32)


@pytest.mark.parametrize("kind", sorted(SYSTEMS_MADE))
def test_every_kind_of_system_learns_reproducibly(kind: str) -> None:
    system = SYSTEMS_MADE[kind]
    fitted = fit(system, INPUTS, SLIPPED, seed=1)
    inputs, slipped = _features(80, seed=8)
    margins = fitted.margins(inputs)
    assert margins.dtype == np.float64
    assert ((margins > 0.0) == slipped).all()
    assert fitted.parameters > 0
    assert fitted.margins(inputs[:0]).shape == (0,)
    assert np.array_equal(fit(system, INPUTS, SLIPPED, seed=1).margins(inputs), margins)


def test_a_blend_is_the_weighted_mean_of_standardised_margins() -> None:
    blend = fit(MADE, INPUTS, SLIPPED, seed=3)
    assert isinstance(blend, FittedBlend)
    svm, forest, *networks = blend.members
    assert len(networks) == 2
    assert not np.array_equal(networks[0].margins(INPUTS), networks[1].margins(INPUTS))
    inputs = _features(40, seed=8)[0]

    def standardised(member: Fitted) -> NDArray[np.float64]:
        return member.margins(inputs) / float(member.margins(INPUTS).std())

    expected = (
        2.0 * standardised(svm)
        + standardised(forest)
        + (standardised(networks[0]) + standardised(networks[1])) / 2.0
    ) / 4.0
    assert blend.margins(inputs) == pytest.approx(expected, rel=1e-9)
    assert blend.parameters == sum(member.parameters for member in blend.members)


def test_a_blend_member_with_constant_margin_gets_no_weight() -> None:
    """No leaf can hold 200 of 160 grasps, so the boosting's margin is constant."""
    useless = Member(BoostingConfig(iterations=5, leaf_grasps=200))
    blend = BlendConfig((useless, Member(SvmConfig(3.0, 0.003))))
    fitted = fit(replace(MADE, estimator=blend), INPUTS, SLIPPED, seed=0)
    alone = fit(SYSTEMS_MADE["svm"], INPUTS, SLIPPED, seed=0).margins(INPUTS)
    assert fitted.margins(INPUTS) == pytest.approx(0.5 * alone / alone.std(), rel=1e-9)


def test_a_standardised_system_sees_standardised_values() -> None:
    svm = SYSTEMS_MADE["svm"]
    stretched = 1000.0 + 37.0 * INPUTS.astype(np.float64) * np.arange(1, 79)
    stretched[:, 5] = 2000.0  # an electrode that never changes
    inputs = stretched.astype(np.float32)
    spread = stretched.std(axis=0)
    spread[5] = 1.0
    expected = ((stretched - stretched.mean(axis=0)) / spread).astype(np.float32)
    fitted = fit(replace(svm, standardise=True), inputs, SLIPPED, seed=0)
    plain = fit(svm, expected, SLIPPED, seed=0)
    assert fitted.margins(inputs) == pytest.approx(plain.margins(expected), abs=1e-4)
    assert fitted.parameters == plain.parameters + 2 * 78


def test_every_kind_of_system_by_name_can_be_trained() -> None:
    """On few grasps and for one epoch: input, estimator and recipe fit together."""
    counts, slipped = separable_counts(40)
    kinds = {
        (
            *map(type, (each.input, each.estimator, each.recipe, each.augmentation)),
            each.standardise,
        ): with_recipes(each, epochs=1)
        for each in SYSTEMS.values()
    }
    for system in kinds.values():
        if isinstance(system.input, SessionFeatures):
            inputs = _features(40)[0]
        else:
            inputs = builder(system.input, 3).build_batch(counts)[0]
        fitted = fit(system, inputs, slipped, seed=0)
        assert np.isfinite(fitted.margins(inputs)).all(), system.name


def test_augmentation_returns_each_image_unchanged_then_flipped_both_ways() -> None:
    images, slipped = augment(IMAGES, SLIPPED[:20], Augmentation(), seed=0)
    assert images.shape == (80, 12, 11, 3)
    assert images.dtype == np.float32
    assert slipped.tolist() == SLIPPED[:20].tolist() * 4
    assert np.array_equal(images[:20], IMAGES)
    for row in range(12):
        for column in range(11):
            pixel = IMAGES[:, row, column]
            assert np.array_equal(images[20:40, row, 10 - column], pixel)
            assert np.array_equal(images[40:60, 11 - row, column], pixel)


def test_rotations_go_ten_degrees_to_either_side() -> None:
    """Each finger's plane is rotated by itself here, by scipy."""
    images, _ = augment(IMAGES, SLIPPED[:20], Augmentation(), seed=0)
    planes = np.moveaxis(IMAGES, 3, 1)
    left, right = (
        [
            [rotate(plane, angle, reshape=False, mode="nearest") for plane in image]
            for image in planes
        ]
        for angle in (10.0, -10.0)
    )
    actual = np.moveaxis(images[60:], 3, 1)
    to_left, to_right = (
        np.isclose(actual, each, atol=1e-5).all((1, 2, 3)) for each in (left, right)
    )
    assert (to_left ^ to_right).all()
    assert 4 <= to_left.sum() <= 16


def test_a_session_model_maps_drifted_tables_to_one_another() -> None:
    grasps = sessions(200)
    trained = train(SYSTEMS["svm-session"], grasps, 0)
    mapped = trained.mapped(grasps.counts, grasps.table_of)
    means = [mapped[grasps.table_of == table].mean(axis=0) for table in range(3)]
    # Electrodes 17 to 20 of the first finger of the last table were recorded 800 counts lower.
    np.testing.assert_allclose(means[2], means[0], atol=1e-6)
    np.testing.assert_allclose(means[1], means[0], atol=1e-6)
    back = trained.unmapped(mapped, grasps.table_of)
    np.testing.assert_allclose(back, grasps.counts, atol=1e-6)
    assert trained.seen().margin == SESSION_MARGIN_COUNTS


def test_systems_without_session_take_counts_unchanged() -> None:
    grasps = sessions(40)
    trained = train(SYSTEMS["svm"], grasps, 0)
    np.testing.assert_array_equal(trained.mapped(grasps.counts, grasps.table_of), grasps.counts)
    assert trained.seen().margin == MARGIN_COUNTS
