"""The learner's bounds: outcomes, values and states that could break or mislead it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import ArrayLike, NDArray

from graspd.models.trust.learner import Learner, LearnerState, sigmoid
from tests.models.trust.streams import CLIP, learn, lifts

ONE_FINGER, THREE_FINGERS = 26, 78


def test_margins_beyond_thirty_are_clipped_to_thirty() -> None:
    learner, x = Learner(2), np.array([1000.0, -1000.0])
    for margin in (30.5, 1e9):
        for sign in (1.0, -1.0):
            _, found = learner.judge(sign * margin, x)
            np.testing.assert_array_equal(found, [sign * 15.0, 1.0, *x])


def coin(random: np.random.Generator) -> bool:
    return bool(random.integers(0, 2))


def separable(random: np.random.Generator, _index: int) -> tuple[float, ArrayLike, bool]:
    slipped = coin(random)
    return 0.0, [CLIP if slipped else -CLIP] * ONE_FINGER, slipped


KINDS: dict[str, Callable[[np.random.Generator, int], tuple[float, ArrayLike, bool]]] = {
    "always the same": lambda random, _: (1.0, [0.5] * ONE_FINGER, coin(random)),
    "at the clip": lambda random, _: (
        random.choice((-1e9, 1e9)),
        random.choice((-CLIP, CLIP), ONE_FINGER),
        coin(random),
    ),
    "contradicting": lambda _, at: (5.0, np.linspace(-CLIP, CLIP, ONE_FINGER), at % 2 == 0),
    "separable": separable,
    "against the margin": lambda _, at: (-30.0, CLIP * np.eye(26)[at % ONE_FINGER], True),
    "all in turns": lambda random, at: list(KINDS.values())[at // 100 % 5](random, at),
}
"""By kind of stream: function that draws margin, inputs and outcome of a lift, by its number."""


@pytest.mark.parametrize("kind", KINDS)
def test_any_outcomes_leave_a_bounded_positive_definite_covariance(kind: str) -> None:
    random, number = np.random.default_rng(0), 2500 if kind == "all in turns" else 500
    learner = Learner(ONE_FINGER)
    assert learner.uncertainty == 1.0
    weights_prior = [0.5**2, 0.5**2] + [0.2**2] * ONE_FINGER
    for index in range(number):
        margin, inputs, slipped = KINDS[kind](random, index)
        learner.learn(learner.judge(margin, np.asarray(inputs))[1], slipped=slipped)
        if (index + 1) % (number // 50) == 0:
            mean, matrix = learner.at_told()
            prior = np.array(weights_prior + [9.009] * (len(mean) - len(weights_prior)))
            np.testing.assert_array_equal(matrix, matrix.T)
            assert (np.diag(matrix) <= prior * (1.0 + 1e-12)).all()
            assert np.linalg.eigvalsh(matrix)[0] >= 0.99 * 2e-3 * 0.009
            assert (np.abs(mean) <= 25.0 * (1.0 + 1e-12)).all()
    assert learner.outcomes == number
    assert 0.0 < learner.uncertainty < 1.0
    Learner(ONE_FINGER).restore(learner.state())


@pytest.mark.parametrize(
    ("margin", "inputs"),
    [
        (math.nan, np.zeros(3)),
        (math.inf, np.zeros(3)),
        (0.0, np.array([0.0, math.nan, 0.0])),
        (0.0, np.array([0.0, math.inf, -math.inf])),
        (0.0, np.array([0.0, 0.0, -1001.0])),
        (0.0, np.zeros(4)),
        (0.0, np.zeros(1)),
        (0.0, np.zeros((1, 3))),
    ],
)
def test_values_not_finite_or_of_another_shape_are_refused(
    margin: float, inputs: NDArray[np.float64]
) -> None:
    with pytest.raises(ValueError, match=r"not finite|of shape"):
        Learner(3).judge(margin, inputs)


@pytest.mark.parametrize("margin", [12.0, 16.0, 27.6, 30.0])
def test_one_lift_that_held_makes_no_sure_slip_stable(margin: float) -> None:
    """At a target of 0.05 nothing above three times as much is ever `stable`."""
    inputs = np.random.default_rng(1).normal(size=(20, 78))
    learner = Learner(78)
    learner.learn(learner.judge(margin, inputs[0])[1], slipped=False)
    unlike = [sigmoid(learner.judge(margin, each)[0]) for each in inputs[1:]]
    assert min(unlike) > 3 * 0.05


@pytest.mark.parametrize("true_outcomes", [0, 5, 20, 60])
def test_one_false_outcome_turns_few_unlike_slips_stable(true_outcomes: int) -> None:
    """Each slip after the true outcomes is in turn reported as held."""
    random = np.random.default_rng(2)
    axis = random.normal(size=THREE_FINGERS)
    slips = random.random(180) < 0.5
    sides = np.where(slips, 1.0, -1.0)
    inputs = 0.3 * sides[:, None] * axis + random.normal(0.0, 0.8, (180, THREE_FINGERS))
    margins = random.normal(4.0, 1.5, 180) * sides
    grasps = list(zip(margins.tolist(), inputs.astype(np.float32), slips.tolist(), strict=True))
    learner = Learner(THREE_FINGERS)
    learn(learner, grasps[:true_outcomes])
    state, others = learner.state(), grasps[true_outcomes:]
    before = np.array([learner.judge(m, x)[0] for m, x, _ in others])
    rows = inputs[true_outcomes:]
    turned = []
    for lied, (margin, x, slipped) in enumerate(others):
        if not slipped:
            continue
        learner.restore(state)
        learner.learn(learner.judge(margin, x)[1], slipped=False)
        after = np.array([learner.judge(m, x)[0] for m, x, _ in others])
        alike = np.exp(-((rows - rows[lied]) ** 2).mean(axis=1) / (2.0 * 0.5**2))
        unlike = (alike < 0.1) & slips[true_outcomes:]
        turned.append((after <= 0.0)[unlike & (before > 0.0)].mean())
    assert max(turned) < 0.1


def spoilt(state: LearnerState) -> Iterator[tuple[str, LearnerState]]:
    mean = np.frombuffer(state.mean).copy()
    size, grasps = len(mean), np.frombuffer(state.grasps)
    matrix = np.frombuffer(state.covariance).reshape(size, size)

    def changed(part: str, place: int | tuple[int, int], value: float) -> LearnerState:
        array = {"mean": mean, "covariance": matrix, "grasps": grasps}[part].copy()
        array[place] = value
        return replace(state, **{part: array.tobytes()})

    yield "values", replace(state, mean=state.mean[:-8])
    yield "values", replace(state, covariance=state.covariance[:-1])
    yield "values", replace(state, mean=state.mean + bytes(8))
    yield "values", replace(state, grasps=state.grasps[:-8])
    yield "values", replace(state, outcomes=state.outcomes - 1)
    yield "not finite", changed("mean", 2, math.nan)
    yield "not finite", changed("covariance", (1, 1), math.inf)
    yield "not finite", changed("grasps", 3, math.nan)
    yield "too large", changed("grasps", 3, 1001.0)
    yield "too large", changed("mean", 2, 25.1)
    yield "too large", changed("mean", -1, 25.1)
    yield "too large", changed("covariance", (-1, -1), -1e200)
    yield "than the prior", changed("covariance", (2, 2), 0.041)
    yield "than the prior", changed("covariance", (-1, -1), 9.01)
    yield "no covariance", changed("covariance", (2, 3), 0.01)  # not symmetric
    yield "no covariance", changed("covariance", (2, 2), -0.01)
    yield "no covariance", replace(state, covariance=(0.0 * matrix).tobytes())


def test_a_state_that_no_outcomes_lead_to_is_refused() -> None:
    learner = Learner(4)
    learn(learner, lifts(7, 4))
    before = learner.state()
    for why, state in spoilt(before):
        with pytest.raises(ValueError, match=why):
            learner.restore(state)
        assert learner.state() == before
    largest = np.frombuffer(before.mean).copy()
    largest[2] = 25.0
    learner.restore(replace(before, mean=largest.tobytes()))
