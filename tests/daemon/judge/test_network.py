"""Probability, margin and softening of one model's answer, by the logistic function alone."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from graspd.daemon.judge.calibration import Calibration
from graspd.daemon.judge.network import Examined, Network, Plausibility
from graspd.daemon.judge.reasons import Reason
from graspd.models import zoo
from graspd.models.electrodes import Electrodes
from graspd.models.runtime import TactileModel
from tests.daemon.fakes import FINGERS, FakeModel, seen_box

COUNTS = np.random.default_rng(1).integers(1000, 3000, (3, 24)).astype(np.uint16)


def logit(probability: float) -> float:
    return math.log(probability / (1.0 - probability))


class Answers(FakeModel):
    """Says both probabilities as it is told."""

    def __init__(self, p_stable: float, p_slip: float) -> None:
        super().__init__()
        self.both = p_stable, p_slip

    def run(self) -> tuple[float, float]:
        return self.both


def session(temperature: float) -> Calibration:
    nothing, shape = np.zeros(0), np.ones((3, 24))
    return Calibration(
        *(nothing, nothing, shape, shape, shape, shape),
        calibrated=True,
        odd=False,
        temperature=temperature,
    )


@pytest.mark.parametrize("p_slip", [0.01, 0.2, 0.5, 0.8, 0.99])
def test_a_margin_is_the_log_odds_of_slip(p_slip: float) -> None:
    opinion = Network(FakeModel(p_slip), 0.5).judge(Examined((), COUNTS))  # type: ignore[arg-type]
    assert (opinion.p_slip, opinion.reasons) == (p_slip, ())
    assert opinion.margin == pytest.approx(logit(p_slip))


@pytest.mark.parametrize(("p_slip", "sign"), [(0.0, -1), (1.0, 1)])
def test_a_sure_answer_has_the_margin_of_one_in_a_million_millions(
    p_slip: float, sign: int
) -> None:
    opinion = Network(FakeModel(p_slip), 0.5).judge(Examined((), COUNTS))  # type: ignore[arg-type]
    assert opinion.p_slip == p_slip
    assert opinion.margin == pytest.approx(sign * 12 * math.log(10))


@pytest.mark.parametrize(
    ("p_stable", "p_slip", "sound"),
    [
        (0.5, 0.5009, True),  # float32 rounds, but not by a thousandth
        (0.5, 0.4991, True),
        (0.5, 0.5011, False),
        (0.5, 0.4989, False),
        (1.0, 0.0, True),
        (0.0, 1.0, True),
        (-0.0001, 1.0, False),
        (1.0001, 0.0, False),
        (0.0, 1.0001, False),
        (1.0, -0.0001, False),
        (math.nan, 0.5, False),
        (0.5, math.nan, False),
    ],
)
def test_probabilities_are_in_0_to_1_and_sum_to_one(
    p_stable: float, p_slip: float, sound: bool
) -> None:
    network = Network(Answers(p_stable, p_slip), 0.5)  # type: ignore[arg-type]
    opinion = network.judge(Examined((), COUNTS))
    assert opinion.p_slip == (p_slip if sound else None)
    assert opinion.reasons == (() if sound else (Reason.MODEL_FAILED,))


@pytest.mark.parametrize("threshold", [0.3, 0.5, 0.8])
@pytest.mark.parametrize("p_slip", [0.05, 0.4, 0.6, 0.95])
@pytest.mark.parametrize("temperature", [1.0, 2.0, 5.0])
def test_a_young_session_is_less_sure_and_on_the_same_side(
    threshold: float, p_slip: float, temperature: float
) -> None:
    network = Network(FakeModel(p_slip), threshold)  # type: ignore[arg-type]
    opinion = network.judge(Examined((), COUNTS), session(temperature))
    assert opinion.p_slip is not None
    expected = logit(threshold) + (logit(p_slip) - logit(threshold)) / temperature
    assert logit(opinion.p_slip) == pytest.approx(expected)
    assert temperature > 1.0 or opinion.p_slip == p_slip, "to the bit where nothing is softened"
    assert opinion.margin == pytest.approx(logit(p_slip)), "the margin is that of the network"


def test_what_speaks_against_a_reading_keeps_it_from_the_network() -> None:
    model = FakeModel()
    opinion = Network(model, 0.5).judge(Examined((Reason.SATURATED,), COUNTS, ("ff_1",)))  # type: ignore[arg-type]
    assert (opinion.p_slip, opinion.reasons, opinion.repaired) == (
        *(None, (Reason.SATURATED,)),
        ("ff_1",),
    )
    assert model.runs == 0


@pytest.mark.parametrize("finger", range(3))
@pytest.mark.parametrize(
    ("swing", "broken", "flat"), [(70, 0, False), (69, 0, True), (70, 12, False), (69, 12, True)]
)
def test_a_finger_that_reads_about_the_same_everywhere_is_flat(
    finger: int, swing: int, broken: int, flat: bool
) -> None:
    """Up and down by 70 around a mean is a standard deviation of 70."""
    counts, mask = COUNTS.copy(), np.zeros((3, 24), dtype=np.bool_)
    counts[finger] = 2000 + swing * (-1) ** np.arange(24)
    counts[finger, :broken] = 0
    mask[finger, :broken] = True
    seen = seen_box(3)
    found = Plausibility(FINGERS, Electrodes(seen)).examine(counts, mask)
    assert (Reason.FLAT in found.reasons) == flat


@pytest.mark.parametrize(("swing", "flat"), [(0, True), (2, False)])
def test_a_finger_without_an_image_is_not_judged(swing: int, flat: bool) -> None:
    """Its electrodes differ by less than a count (standard deviation)."""
    counts, model = COUNTS.copy(), FakeModel(0.2)
    counts[1] = 2000 + swing * (-1) ** np.arange(24)
    opinion = Network(model, 0.5).judge(Examined((), counts))  # type: ignore[arg-type]
    assert (opinion.p_slip, opinion.reasons) == ((None, (Reason.FLAT,)) if flat else (0.2, ()))
    assert model.runs == (0 if flat else 1)


def test_a_session_model_is_asked_about_what_its_session_standardises() -> None:
    network = Network(TactileModel(zoo.find("small-session")), 0.5)
    known = dataclasses.replace(
        session(1.0), features_mean=np.arange(78.0), features_spread=np.linspace(1.0, 900.0, 78)
    )
    assert network.judge(Examined((), COUNTS), known).p_slip is not None
    z = (COUNTS - COUNTS.mean(axis=1, keepdims=True)) / COUNTS.std(axis=1, keepdims=True)
    features = np.concatenate((z.ravel(), COUNTS.mean(axis=1), COUNTS.std(axis=1)))
    expected = (features - np.arange(78.0)) / np.linspace(1.0, 900.0, 78)
    asked = network.features
    assert asked.shape == (78,)
    clip = np.abs(asked).max()  # as the model's card says
    np.testing.assert_allclose(asked, np.clip(expected, -clip, clip), rtol=1e-5, atol=1e-6)
    assert (np.abs(expected) < clip).sum() > 60
    assert Network(FakeModel(), 0.5).features.shape == (0,)  # type: ignore[arg-type]
