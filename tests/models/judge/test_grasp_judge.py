"""One model's opinion: which grasps it does not get, and its probability, margin and softening."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.drivers.twins.grasps import synthetic
from graspd.models import zoo
from graspd.models.contract import SessionInput, Sharpness
from graspd.models.judge.grasp_judge import Examined, GraspJudge, Refusal
from graspd.models.judge.session import SessionCalibration
from graspd.models.runtime import TactileModel
from tests.daemon.fakes import FakeModel

COUNTS = np.random.default_rng(1).integers(1000, 3000, (3, 24)).astype(np.uint16)


def logit(probability: float) -> float:
    return math.log(probability / (1.0 - probability))


class Answers(FakeModel):
    """Model that answers each grasp with the probabilities `p_stable` and `p_slip`."""

    def __init__(self, p_stable: float, p_slip: float) -> None:
        super().__init__()
        self.both = p_stable, p_slip

    def run(self) -> tuple[float, float]:
        return self.both


def judge_of(model: FakeModel, threshold: float = 0.5) -> GraspJudge:
    return GraspJudge.of(model, threshold)  # type: ignore[arg-type]


def session(temperature: float) -> SessionCalibration:
    """A session without grasps; `temperature`: its divisor of the network's log-odds."""
    softens = (Sharpness(0.0, temperature),)
    takes = SessionInput((0.0,) * 78, (1.0,) * 78, 5.0, 1.0, 20.0, softens)
    return SessionCalibration(takes, np.ones((3, 24)), np.ones((3, 24)))


@pytest.mark.parametrize(("equal", "refusal"), [(19, None), (20, Refusal.NEVER_SEEN)])
def test_two_fingers_with_the_counts_of_one_sensor_are_refused(
    equal: int, refusal: Refusal | None
) -> None:
    """Of two live sensors at most 2 counts of 24 are equal."""
    judge = judge_of(FakeModel())
    counts = COUNTS.copy()
    counts[2, :equal] = counts[0, :equal]
    assert judge.examine(counts).refusal == refusal


@pytest.mark.parametrize("p_slip", [0.0, 0.01, 0.2, 0.5, 0.8, 0.99, 1.0])
def test_a_margin_is_the_finite_log_odds_of_slip(p_slip: float) -> None:
    opinion = judge_of(FakeModel(p_slip)).judge(Examined(COUNTS))
    assert (opinion.p_slip, opinion.refusal) == (p_slip, None)
    # A sure answer counts as one of 1e-12 beside it.
    assert opinion.margin == pytest.approx(logit(min(max(p_slip, 1e-12), 1.0 - 1e-12)), rel=1e-4)


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
def test_out_of_range_probabilities_or_sums_unlike_one_are_refused(
    p_stable: float, p_slip: float, sound: bool
) -> None:
    opinion = judge_of(Answers(p_stable, p_slip)).judge(Examined(COUNTS))
    assert opinion.p_slip == (p_slip if sound else None)
    assert opinion.refusal == (None if sound else Refusal.MODEL_FAILED)


@pytest.mark.parametrize("threshold", [0.3, 0.8])
@pytest.mark.parametrize("p_slip", [0.05, 0.4, 0.6])
@pytest.mark.parametrize("temperature", [1.0, 2.0, 5.0])
def test_a_young_session_moves_probabilities_towards_the_threshold(
    threshold: float, p_slip: float, temperature: float
) -> None:
    judge = judge_of(FakeModel(p_slip), threshold)
    judge.session = session(temperature)
    opinion = judge.judge(Examined(COUNTS))
    assert opinion.p_slip is not None
    expected = logit(threshold) + (logit(p_slip) - logit(threshold)) / temperature
    assert logit(opinion.p_slip) == pytest.approx(expected)
    assert temperature > 1.0 or opinion.p_slip == p_slip, "to the bit where nothing is softened"
    assert opinion.margin == pytest.approx(logit(p_slip)), "the margin is that of the network"


def test_a_refused_grasp_is_not_passed_to_the_network() -> None:
    model = FakeModel()
    opinion = judge_of(model).judge(Examined(COUNTS, Refusal.NEVER_SEEN, ("ff_1",), COUNTS))
    assert (opinion.p_slip, opinion.refusal, opinion.repaired) == (
        *(None, Refusal.NEVER_SEEN),
        ("ff_1",),
    )
    assert model.runs == 0


@pytest.mark.parametrize(
    ("finger", "swing", "broken", "flat"),
    [(0, 70, 0, False), (0, 69, 0, True), (1, 70, 12, False), (2, 69, 12, True)],
)
def test_a_finger_that_reads_about_the_same_everywhere_is_flat(
    finger: int, swing: int, broken: int, flat: bool
) -> None:
    """Up and down by 70 around a mean is a standard deviation of 70."""
    counts, mask = COUNTS.copy(), np.zeros((3, 24), dtype=np.bool_)
    counts[finger] = 2000 + swing * (-1) ** np.arange(24)
    counts[finger, :broken] = 0
    mask[finger, :broken] = True
    assert (judge_of(FakeModel()).examine(counts, mask).refusal is Refusal.FLAT) == flat


@pytest.mark.parametrize(("swing", "flat"), [(0, True), (2, False)])
def test_a_grasp_with_a_finger_without_spread_is_not_judged(swing: int, flat: bool) -> None:
    """`swing`: standard deviation of the finger, counts. `flat`: True if the grasp is refused."""
    counts, model = COUNTS.copy(), FakeModel(0.2)
    counts[1] = 2000 + swing * (-1) ** np.arange(24)
    opinion = judge_of(model).judge(Examined(counts))
    assert (opinion.p_slip, opinion.refusal) == ((None, Refusal.FLAT) if flat else (0.2, None))
    assert model.runs == (0 if flat else 1)


def test_a_session_model_gets_features_standardised_by_its_session() -> None:
    judge = GraspJudge.of(TactileModel(zoo.find("small-session")))
    judge.session = known = session(1.0)
    known.features_mean, known.features_spread = np.arange(78.0), np.linspace(1.0, 900.0, 78)
    assert judge.judge(Examined(COUNTS)).p_slip is not None
    z = (COUNTS - COUNTS.mean(axis=1, keepdims=True)) / COUNTS.std(axis=1, keepdims=True)
    features = np.concatenate((z.ravel(), COUNTS.mean(axis=1), COUNTS.std(axis=1)))
    expected = (features - np.arange(78.0)) / np.linspace(1.0, 900.0, 78)
    asked = judge.features
    assert asked.shape == (78,)
    clip = np.abs(asked).max()  # as the model's card says
    np.testing.assert_allclose(asked, np.clip(expected, -clip, clip), rtol=1e-5, atol=1e-6)
    assert (np.abs(expected) < clip).sum() > 60
    assert judge_of(FakeModel()).features.shape == (0,)


NOTHING = np.zeros((3, 24), dtype=np.bool_)
# Of different fingers and apart, so that none explains another.
WRONG = ((0, 3), (1, 9), (2, 20))
BROKEN = ((0, 14), (1, 20))


@pytest.fixture(scope="module")
def cnn1() -> GraspJudge:
    return GraspJudge.of(TactileModel(zoo.find("cnn1")))


@pytest.fixture(scope="module")
def grasp(cnn1: GraspJudge) -> NDArray[np.uint16]:
    """A grasp that is judged without repair, shape (3, 24)."""
    drawn = synthetic.draw(synthetic.read_model(), np.random.default_rng(1), 50)
    for counts in drawn.counts.reshape(50, 3, 24):
        found = cnn1.examine(counts, NOTHING)
        if found.refusal is None and not found.repaired:
            return np.asarray(counts, dtype=np.uint16)
    raise AssertionError("no grasp is like those of the training")


@pytest.mark.parametrize("known", [0, 1, 2])
@pytest.mark.parametrize(("wrong", "judged"), [(0, True), (1, True), (2, True), (3, False)])
def test_two_electrodes_may_contradict_besides_those_known_to_be_broken(
    cnn1: GraspJudge, grasp: NDArray[np.uint16], known: int, wrong: int, judged: bool
) -> None:
    counts, broken = grasp.copy(), NOTHING.copy()
    for place in WRONG[:wrong]:
        counts[place] = counts[place] + 1500 if counts[place] < 2000 else counts[place] - 1500
    for place in BROKEN[:known]:
        counts[place] = 0
        broken[place] = True
    found = cnn1.examine(counts, broken)
    assert found.refusal == (None if judged else Refusal.NEVER_SEEN)
    if judged:
        names = {f"{('ff', 'mf', 'th')[f]}_{e + 1}" for f, e in (*WRONG[:wrong], *BROKEN[:known])}
        assert set(found.repaired) == names
        repaired = np.zeros((3, 24), dtype=np.bool_)
        for place in (*WRONG[:wrong], *BROKEN[:known]):
            repaired[place] = True
        assert (found.counts[~repaired] == grasp[~repaired]).all()
        errors = np.abs(found.counts[repaired].astype(float) - grasp[repaired])
        assert (errors < 400).all(), "what the others let expect is near what was there"
        assert found.grasp is not None


@pytest.fixture(scope="module")
def of_sessions() -> GraspJudge:
    return GraspJudge.of(TactileModel(zoo.find("small-session")))


@pytest.mark.parametrize(
    ("stretched", "known", "judged", "learned"),
    [
        (1.0, {}, True, True),
        (1.0, {"odd": True}, False, True),  # near the training, but the session is odd
        (1.6, {}, False, True),  # up to twice as far a session learns from what it cannot judge
        (4.0, {}, False, False),
        (4.0, {"calibrated": False}, False, True),  # a young one learns from all
    ],
)
def test_a_session_learns_up_to_twice_the_distance_it_judges(
    of_sessions: GraspJudge,
    stretched: float,
    known: dict[str, bool],
    judged: bool,
    learned: bool,
) -> None:
    seen = TactileModel(zoo.find("small-session")).contract.seen
    centre = np.array(seen.centre)
    # One deviation of the training, of 0.9 of the distance up to which it is judged.
    spread = np.linalg.inv(seen.whitening_matrix()).T
    direction = np.random.default_rng(2).normal(size=72)
    direction *= 0.9 * seen.distance_max * np.sqrt(72) / np.linalg.norm(direction)
    counts = np.clip(centre + stretched * (direction @ spread.T).reshape(3, 24), 1, 4094)
    session = of_sessions.session
    assert session is not None
    session.calibrated, session.odd = known.get("calibrated", True), known.get("odd", False)
    found = of_sessions.examine(np.rint(counts).astype(np.uint16), NOTHING)
    assert found.refusal == (None if judged else Refusal.NEVER_SEEN)
    assert (found.grasp is not None) == learned
