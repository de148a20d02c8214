"""The residual: its kernel is scikit-learn's, its learning that of a dense one in long double."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from graspd.models.trust import learner as learner_module
from graspd.models.trust.learner import Learner, LearnerState, of_format_2
from graspd.models.trust.residual import GRASPS_MAX, Residual
from tests.models.trust.reference import Reference
from tests.models.trust.streams import lifts

INPUTS = 26
LENGTH = 0.5 * INPUTS**0.5
"""Length scale of the kernel: a root mean square difference of inputs of 0.5."""
SHARED, OWN = 9.0, 0.009


def grasps(number: int) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    return 0.3 * np.random.default_rng(1).normal(size=(number, INPUTS))


def test_the_prior_is_scikit_learns_kernel() -> None:
    told, shared = grasps(40), ConstantKernel(SHARED) * RBF(LENGTH)
    expected = (shared + WhiteKernel(OWN))(told)
    np.testing.assert_allclose(Residual(told).prior, expected, rtol=1e-12)
    apart = shared(told[:5], told)
    np.testing.assert_allclose([Residual(told).shared(x) for x in told[:5]], apart, rtol=1e-12)


@pytest.mark.parametrize(
    ("inputs", "kept", "spread"),
    [
        *((inputs, 128, 0.5) for inputs in (0, 1, 6, INPUTS)),
        *((INPUTS, 7, spread) for spread in (0.5, 1e-6, 100.0)),
    ],
)
def test_the_learner_equals_a_dense_computation_over_all_grasps(
    inputs: int, kept: int, spread: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Grasps nearly equal make a kernel that is nearly singular."""
    monkeypatch.setattr(learner_module, "GRASPS_MAX", kept)
    drawn = lifts(60, inputs or 1, spread=spread)
    stream = [(margin, x[:inputs], slipped) for margin, x, slipped in drawn]
    learner = Learner(inputs)
    reference = Reference([m for m, *_ in stream], np.array([x for _, x, _ in stream]))
    for grasp, (margin, x, slipped) in enumerate(stream[:40]):
        learner.learn(learner.judge(margin, x)[1], slipped=slipped)
        reference.learn(grasp, slipped)
        if grasp >= kept:
            reference.keep(list(range(grasp - kept + 1, grasp + 1)))
        for other in range(grasp + 1, len(stream), 5):
            found = learner.judge(*stream[other][:2])[0]
            assert found == pytest.approx(reference.log_odds(other), abs=1e-9)
    if kept > 40:
        expected = reference.state(list(range(40)) if inputs else [])
        mean, covariance = (each.tobytes() for each in learner.at_told())
        later = Learner(inputs)
        later.restore(of_format_2(LearnerState(40, mean, covariance, learner.state().grasps)))
        for each in (learner, later):
            for array, dense in zip(each.at_told(), expected, strict=True):
                np.testing.assert_allclose(array, dense.astype(float), rtol=0.0, atol=1e-9)


def test_rounding_of_many_outcomes_does_not_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nearly equal grasps and others alternate; outcomes depend on neither."""
    kept, number, random = 5, 1500, np.random.default_rng(3)
    monkeypatch.setattr(learner_module, "GRASPS_MAX", kept)
    spreads = np.where(np.arange(number) // 20 % 2, 1e-5, 0.5)[:, None]
    rows = (0.3 + spreads * random.normal(size=(number, 2))).astype(np.float32)
    learner, told = Learner(2), list[int]()
    state = Reference([], rows[:0]).state([])
    for grasp, slipped in enumerate((random.random(number) < 0.5).tolist()):
        window = [*told, grasp]
        reference = Reference([1.0] * len(window), rows[window])
        reference.go_on(list(range(len(told))), *state)
        found, features = learner.judge(1.0, rows[grasp])
        assert found == pytest.approx(reference.log_odds(len(told)), abs=1e-9)
        learner.learn(features, slipped=slipped)
        reference.learn(len(told), slipped)
        told = window[-kept:]
        state = reference.state(list(range(len(window)))[-kept:])


def test_a_grasp_repeated_384_times_leaves_a_valid_covariance() -> None:
    learner = Learner(INPUTS)
    x = grasps(1)[0]
    for index in range(3 * GRASPS_MAX):
        learner.learn(learner.judge(0.0, x)[1], slipped=index % 2 == 0)
    Learner(INPUTS).restore(learner.state())
    assert abs(learner.judge(0.0, x)[0]) < 1.0
