"""One model against its float64 reference: inputs, probabilities and verdicts of some readings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from graspd.daemon.judge.decision import HELD, Limits, decide
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.judge.reasons import Decision, Reason
from graspd.drivers.base import TactileReading
from graspd.models import zoo
from graspd.models.contract import ModelContract, SessionInput
from graspd.models.electrodes import Electrodes
from graspd.models.inputs import SPREAD_FLOOR_COUNTS, SessionBuilder
from graspd.models.judge.grasp_judge import Examined, GraspJudge
from graspd.models.runtime import TactileModel
from graspd.models.session_statistics import HORIZON_GRASPS, SessionState
from tests.stability.exact import (
    Exact,
    Reference,
    exact_input,
    exact_softening,
    exact_standard,
)
from tests.stability.readings import Counts, Raw

INPUT_RELATIVE_MAX = 1e-5
"""Largest error of a reading's input over the largest magnitude in that input."""
P_SLIP_ERROR_MAX = 1e-4
"""Largest error of a probability. A verdict further from its threshold must not flip."""
THRESHOLD = 0.5
LIMITS = Limits(max_age_ns=100_000_000)
"""The daemon's own threshold, and an age that these readings do not have."""
FLOOR_MARGIN = 1e-9
"""A spread this near its floor, counts, may be taken for either side: refused or judged."""
THRESHOLD_PAIRS, BISECTIONS = 12, 40
"""Pairs of a stable and a slipping grasp, and steps from both to the threshold between them."""


@dataclass(frozen=True, slots=True)
class CaseRow:
    """What was measured of one model on the readings of one case."""

    readings: int
    compared: int
    """Readings of which both sides have an input and a probability."""
    input_error: float
    """Largest error of an input over the largest magnitude in it."""
    network_error: float
    """Largest error of `p_slip` with the daemon's own float32 input, published ones included."""
    chain_error: float
    """Largest error of `p_slip` from the counts on, with nothing rounded on the way."""
    mean_error: float
    flips: int
    """Readings on the other side of the threshold than the reference."""
    verdicts: dict[str, int]
    reasons: dict[str, int]
    problems: tuple[str, ...]
    """Bounds that are broken."""


@dataclass(slots=True)
class _Verdicts:
    """What the daemon said of the readings of one case."""

    verdicts: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)
    inputs: list[NDArray[np.float32]] = field(default_factory=list)
    """Inputs of the readings that got a verdict."""
    published: list[float] = field(default_factory=list)
    """Probabilities of the same readings."""

    def add(
        self,
        decision: Decision,
        p_slip: float | None,
        reasons: Iterable[Reason],
        model: TactileModel,
    ) -> None:
        """Take in one verdict, while `model.input` still holds what it was made of."""
        reasons = tuple(reasons)
        self.verdicts[decision.value] += 1
        self.reasons.update(reason.value for reason in reasons)
        if decision is Decision.UNKNOWN:
            if not reasons:
                self.problems.append("unknown without a reason")
        elif p_slip is None or not 0.0 <= p_slip <= 1.0:
            self.problems.append(f"a verdict with p_slip {p_slip}")
        else:
            self.inputs.append(model.input.copy())
            self.published.append(p_slip)


class Comparison:
    """Compares one model with its reference."""

    def __init__(
        self, model: TactileModel, reference: Reference, state: SessionState | None = None
    ) -> None:
        """`reference` is of the same file; `state` is a session to start from."""
        self.model = model
        self.reference = reference
        self._state = state
        session = self._pipeline().session
        self._session = session
        if self._session is not None and isinstance(model.inputs, SessionBuilder):
            model.inputs.use(self._session.features_mean, self._session.features_spread)
        wanted = model.contract.input
        self._standard = None
        if isinstance(wanted, SessionInput) and state is not None:
            self._standard = exact_standard(wanted, state)

    def row(self, counts: Counts, *, never_judged: bool = False, one_hand: bool = False) -> CaseRow:
        """Compare on counts (N, fingers, 24).

        `never_judged`: every verdict must be `unknown`. `one_hand`: one hand feels the readings
        one after the other; else each is the first that its pipeline sees.
        """
        # Some cases are about what numpy says of NaN and infinity on the way.
        with np.errstate(all="ignore"):
            return self._row(counts, never_judged, one_hand)

    def near_threshold(self, likely: Raw) -> Raw:
        """Return counts between a stable and a slipping one of `likely`, on both sides."""
        p_slip = self._answers(likely)[2][:, 1]
        with np.errstate(invalid="ignore"):
            stable = likely[p_slip < THRESHOLD][:THRESHOLD_PAIRS]
            slips = likely[p_slip >= THRESHOLD][:THRESHOLD_PAIRS]
        edges = [edge for pair in zip(stable, slips, strict=False) for edge in self._edge(*pair)]
        return np.array(edges, dtype=np.uint16).reshape(-1, *likely.shape[1:])

    def _edge(self, stable: Raw, slips: Raw) -> tuple[Raw, Raw]:
        low, high = stable.astype(np.float64), slips.astype(np.float64)
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            if self._answers(np.rint(middle)[np.newaxis])[2][0, 1] < THRESHOLD:
                low = middle
            else:
                high = middle
        return np.rint(low).astype(np.uint16), np.rint(high).astype(np.uint16)

    def _row(self, counts: Counts, never_judged: bool, one_hand: bool) -> CaseRow:
        inputs, spreads, answers = self._answers(counts)
        exact, exact_spreads = exact_input(self.model.contract, counts, self._standard)
        both = _judgeable(spreads) & _judgeable(exact_spreads)
        inputs, exact, p_slip = inputs[both], exact[both], answers[both, 1]
        same = self.reference.probabilities(inputs)[:, 1]
        chain = self.reference.probabilities(exact)[:, 1]
        # Where the answer jumps, the last bit of the input is worth a whole step of it.
        wanted = same if self.reference.is_stepped else chain
        said = self._verdicts(counts, one_hand)
        published = np.array(said.published)
        published_wanted = self._published_wanted(said)

        input_error = _relative(inputs, exact)
        network_error = np.concatenate((abs(p_slip - same), abs(published - published_wanted)))
        bounded = np.concatenate((abs(p_slip - wanted), network_error))
        far = _flips(p_slip, wanted, P_SLIP_ERROR_MAX)
        far += _flips(published, published_wanted, P_SLIP_ERROR_MAX)
        problems = said.problems + _broken(input_error, bounded, far)
        if never_judged and said.published:
            problems.append(f"{len(said.published)} verdicts on readings that cannot be judged")
        near_floor = np.abs(exact_spreads - SPREAD_FLOOR_COUNTS) <= FLOOR_MARGIN
        differs = (_judgeable(spreads) != _judgeable(exact_spreads)) & ~near_floor.any(axis=1)
        if differs.any() and not never_judged:
            problems.append(f"{int(differs.sum())} readings that only one side takes for flat")
        return CaseRow(
            readings=len(counts),
            compared=int(both.sum()),
            input_error=_largest(input_error),
            network_error=_largest(network_error),
            chain_error=_largest(abs(p_slip - chain)),
            mean_error=float(abs(p_slip - chain).mean()) if both.any() else 0.0,
            flips=_flips(p_slip, chain) + _flips(published, published_wanted),
            verdicts=dict(said.verdicts),
            reasons=dict(said.reasons.most_common()),
            problems=tuple(dict.fromkeys(problems)),
        )

    def _published_wanted(self, said: _Verdicts) -> NDArray[np.float64]:
        """What should have been published of these inputs."""
        if not said.inputs:
            return np.empty(0)
        answers = self.reference.probabilities(np.array(said.inputs))
        if self._session is None or self._session.temperature == 1.0:
            return answers[:, 1]
        return exact_softening(answers[:, 0], answers[:, 1], self._session.temperature, THRESHOLD)

    def _answers(
        self, counts: Counts
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]:
        """Inputs (N, *shape), spreads (N, fingers), probabilities (N, 2), as the daemon has them.

        Probabilities are NaN where the daemon does not ask the network.
        """
        model = self.model
        inputs = np.empty((len(counts), *model.input.shape), dtype=np.float32)
        spreads = np.empty((len(counts), len(model.contract.fingers)))
        answers = np.full((len(counts), 2), np.nan)
        for index, reading in enumerate(counts):
            spreads[index] = model.inputs.build(reading, model.input)
            inputs[index] = model.input
            if _judgeable(spreads[index : index + 1])[0]:
                answers[index] = model.run()
        return inputs, spreads, answers

    def _verdicts(self, counts: Counts, one_hand: bool) -> _Verdicts:
        said = _Verdicts()
        if counts.dtype != np.uint16:
            self._judge_floats(counts, said)
            return said
        pipeline = self._pipeline()
        for number, reading in enumerate(counts.astype(np.uint16)):
            if number and not one_hand:
                pipeline = self._pipeline()
            faults = np.zeros(reading.shape, dtype=np.uint8)
            judgement = pipeline.judge(TactileReading(0, number, reading, faults))
            said.add(judgement.decision, judgement.p_slip, judgement.reasons, self.model)
        return said

    def _pipeline(self) -> Pipeline:
        """A pipeline that takes each reading for a grasp and does not change the session."""
        fingers = self.model.contract.fingers
        pipeline = Pipeline(self.model, fingers, LIMITS, lambda: 0, learns=False)
        if pipeline.session is not None and self._state is not None:
            pipeline.session.restore(self._state)
        return pipeline

    def _judge_floats(self, counts: Counts, said: _Verdicts) -> None:
        """Hand to the network what no driver can hand over, as repaired counts are."""
        judge = GraspJudge.of(self.model, LIMITS.slip_threshold)
        if judge.session is not None and self._state is not None:
            judge.session.restore(self._state)
        for reading in counts:
            found = judge.judge(Examined(reading))
            refused = () if found.refusal is None else (Reason(found.refusal),)
            decision, reasons = decide(found.p_slip, refused, HELD, 0, LIMITS)
            said.add(decision, found.p_slip, reasons, self.model)


@cache
def comparison(name: str, *, seasoned: bool = False) -> Comparison:
    """Return the comparison of a model of the zoo, in a new or in a long session."""
    model = TactileModel(zoo.find(name))
    state = seasoned_session(model.contract) if seasoned else None
    return Comparison(model, Reference(model.path), state)


def seasoned_session(contract: ModelContract) -> SessionState:
    """Return a session after a billion grasps of sensors that drifted.

    Each mean has moved by 0.3 of its spread in the training, each spread has shrunk to 0.8.
    """
    wanted = contract.input
    assert isinstance(wanted, SessionInput)
    electrodes = Electrodes(contract.seen)
    mean = np.concatenate((wanted.mean, electrodes.centre.ravel()))
    spread = np.concatenate((wanted.spread, electrodes.spread.ravel()))
    return SessionState(
        weight=HORIZON_GRASPS,
        grasps=10**9,
        mean=tuple((mean + 0.3 * spread).tolist()),
        squares=tuple((HORIZON_GRASPS * (0.8 * spread) ** 2).tolist()),
    )


def _judgeable(spreads: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Readings (N,) of which the network is asked, by spreads (N, fingers)."""
    sound = np.greater_equal(spreads, SPREAD_FLOOR_COUNTS)
    return np.array(sound.all(axis=1), dtype=np.bool_)


def _relative(inputs: NDArray[np.float32], exact: Exact) -> NDArray[np.float64]:
    """Largest error of each input (N, ...) over the largest magnitude in it, shape (N,)."""
    axes = tuple(range(1, exact.ndim))
    scale = np.abs(exact).max(axis=axes)
    errors = np.abs(inputs - exact).max(axis=axes) / np.where(scale > 0.0, scale, 1.0)
    relative: NDArray[np.float64] = errors.astype(np.float64)
    return relative


def _broken(input_error: NDArray[np.float64], p_error: NDArray[np.float64], far: int) -> list[str]:
    """Return the bounds that these errors break; NaN breaks each."""
    broken = []
    if not (input_error < INPUT_RELATIVE_MAX).all():
        broken.append(f"input {_largest(input_error):.1e}, bound {INPUT_RELATIVE_MAX:.0e}")
    if not (p_error < P_SLIP_ERROR_MAX).all():
        broken.append(f"p_slip {_largest(p_error):.1e}, bound {P_SLIP_ERROR_MAX:.0e}")
    if far:
        broken.append(f"{far} verdicts flipped further from the threshold than the bound")
    return broken


def _flips(p_slip: NDArray[np.float64], wanted: NDArray[np.float64], beyond: float = 0.0) -> int:
    """Count other verdicts where the reference is further from the threshold than `beyond`."""
    other = (p_slip >= THRESHOLD) != (wanted >= THRESHOLD)
    return int((other & (np.abs(wanted - THRESHOLD) > beyond)).sum())


def _largest(errors: NDArray[np.float64]) -> float:
    return float(errors.max()) if len(errors) else 0.0
