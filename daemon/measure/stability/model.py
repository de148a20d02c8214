"""One model against its float64 reference: inputs, probabilities and verdicts, case by case."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daemon.judge.decision import HELD, Limits, decide
from daemon.judge.network import Examined, Network
from daemon.judge.pipeline import Pipeline
from daemon.judge.reasons import Decision, Reason
from daemon.measure.reference.exact import Exact, exact_input, exact_softening, exact_standard
from daemon.measure.stability.cases import StabilityCase
from drivers.base import TactileReading
from models.contract import ModelContract, SessionInput
from models.electrodes import Electrodes
from models.inputs import SessionBuilder
from models.runtime import TactileModel
from models.session_statistics import HORIZON_GRASPS, SessionState
from models.tactile_image import SPREAD_FLOOR_COUNTS

if TYPE_CHECKING:
    from daemon.measure.reference.reference import Reference

LIMITS = Limits(max_age_ns=100_000_000)
"""The daemon's own threshold, and an age that these readings do not have."""
FLOOR_MARGIN = 1e-9
"""A spread so near its floor, counts, may be taken for either side: it is refused or judged."""
THRESHOLD_PAIRS, BISECTIONS = 12, 40
"""Pairs of a stable and a slipping grasp, and steps from both to the threshold between them."""
SEASONED_GRASPS = 10**9


@dataclass(frozen=True, slots=True)
class Bounds:
    """What must hold."""

    input_relative: float = 1e-5
    """Largest error of a reading's input over the largest magnitude in that input."""
    p_slip: float = 1e-4
    """Error of a probability; a verdict further from the threshold must not flip."""


@dataclass(frozen=True, slots=True)
class CaseRow:
    """What was measured of one model on one case."""

    model: str
    case: str
    readings: int
    compared: int
    """Of these, readings of which there are an input and a probability."""
    input_error: float
    """Largest error of an input over the largest magnitude in it."""
    network_error: float
    """Largest error of `p_slip` with the daemon's own float32 input, published ones among them."""
    chain_error: float
    """Largest error of `p_slip` from the counts on, nothing rounded on the way."""
    mean_error: float
    """Mean of the same."""
    flips: int
    """Readings on the other side of the threshold than the reference."""
    verdicts: dict[str, int]
    reasons: dict[str, int]
    problems: tuple[str, ...]
    """Bounds that are broken."""


@dataclass(slots=True)
class _Said:
    """What the pipeline said of the readings of one case."""

    verdicts: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)
    inputs: list[NDArray[np.float32]] = field(default_factory=list)
    """Of the readings that got a verdict."""
    published: list[float] = field(default_factory=list)
    """Probabilities of the same."""

    def add(
        self,
        decision: Decision,
        p_slip: float | None,
        reasons: Iterable[Reason],
        model: TactileModel,
    ) -> None:
        """Take in one verdict; `model.input` still holds what it was made of."""
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


@dataclass(frozen=True, slots=True, eq=False)
class _Errors:
    """Errors of the readings of one case, shape (N,) each."""

    of_input: NDArray[np.float64]
    network: NDArray[np.float64]
    chain: NDArray[np.float64]
    bounded: NDArray[np.float64]
    """Those of the two that must keep the bound."""
    flips: int
    far: int
    """Flips further from the threshold than the bound."""


class ModelStability:
    """Measures one model."""

    def __init__(
        self,
        model: TactileModel,
        reference: Reference,
        bounds: Bounds,
        state: SessionState | None = None,
    ) -> None:
        """`reference` is of the same file; `state` is a session to go on from, if it has one."""
        self._model = model
        self._reference = reference
        self._bounds = bounds
        self._state = state
        self._name = model.path.stem
        session = self._pipeline().session
        self._session = None if session is None else session.now
        if self._session is not None and isinstance(model.inputs, SessionBuilder):
            model.inputs.use(self._session.features_mean, self._session.features_spread)
        wanted = model.contract.input
        self._standard = (
            exact_standard(wanted, state)
            if isinstance(wanted, SessionInput) and state is not None
            else None
        )

    def measure(self, cases: Iterable[StabilityCase]) -> Iterator[CaseRow]:
        """One row per case, in order."""
        # What numpy says of NaN and infinity on the way is what some cases are about.
        with np.errstate(all="ignore"):
            for case in cases:
                yield self._row(case)

    def near_threshold(self, likely: NDArray[np.uint16]) -> StabilityCase:
        """Counts (N, fingers, 24) between a stable and a slipping one of `likely`, at the edge."""
        p_slip = self._answers(likely)[2][:, 1]
        with np.errstate(all="ignore"):
            stable = likely[p_slip < LIMITS.slip_threshold][:THRESHOLD_PAIRS]
            slips = likely[p_slip >= LIMITS.slip_threshold][:THRESHOLD_PAIRS]
            found = [
                edge for pair in zip(stable, slips, strict=False) for edge in self._edge(*pair)
            ]
        counts = np.array(found, dtype=np.uint16).reshape(-1, *likely.shape[1:])
        return StabilityCase("next to the threshold", counts)

    def _edge(
        self, stable: NDArray[np.uint16], slips: NDArray[np.uint16]
    ) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """Two neighbouring readings on the line between these, on both sides of the threshold."""
        low, high = stable.astype(np.float64), slips.astype(np.float64)
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            p_slip = self._answers(np.rint(middle)[np.newaxis])[2][0, 1]
            if p_slip < LIMITS.slip_threshold:
                low = middle
            else:
                high = middle
        return np.rint(low).astype(np.uint16), np.rint(high).astype(np.uint16)

    def _row(self, case: StabilityCase) -> CaseRow:
        inputs, spreads, answers = self._answers(case.counts)
        exact, exact_spreads = exact_input(self._model.contract, case.counts, self._standard)
        both = _judgeable(spreads) & _judgeable(exact_spreads)
        found = self._errors(inputs[both], exact[both], answers[both, 1])
        said = self._verdicts(case)
        published_error, published_flips, published_far = self._published(said)
        problems = said.problems
        if case.never_judged and said.published:
            problems.append(f"{len(said.published)} verdicts on what nobody can judge")
        near = np.abs(exact_spreads - SPREAD_FLOOR_COUNTS) <= FLOOR_MARGIN
        differs = (_judgeable(spreads) != _judgeable(exact_spreads)) & ~near.any(axis=1)
        if differs.any() and not case.never_judged:
            problems.append(f"{int(differs.sum())} readings that only one side takes for flat")
        network_error = np.concatenate((found.network, published_error))
        bounded = np.concatenate((found.bounded, network_error))
        problems += self._broken(found.of_input, bounded, found.far + published_far)
        return CaseRow(
            model=self._name,
            case=case.name,
            readings=len(case.counts),
            compared=int(both.sum()),
            input_error=_largest(found.of_input),
            network_error=_largest(network_error),
            chain_error=_largest(found.chain),
            mean_error=float(found.chain.mean()) if both.any() else 0.0,
            flips=found.flips + published_flips,
            verdicts=dict(said.verdicts),
            reasons=dict(said.reasons.most_common()),
            problems=tuple(dict.fromkeys(problems)),
        )

    def _errors(
        self,
        inputs: NDArray[np.float32],
        exact: Exact,
        p_slip: NDArray[np.float64],
    ) -> _Errors:
        """Of inputs (N, *shape) and of what the network says of them (N,)."""
        same = self._reference.probabilities(inputs)[:, 1]
        chain = self._reference.probabilities(exact)[:, 1]
        # Where the answer jumps, a last bit of the input is worth a whole step of it.
        wanted = same if self._reference.is_stepped else chain
        return _Errors(
            of_input=_relative(inputs, exact),
            network=np.abs(p_slip - same),
            chain=np.abs(p_slip - chain),
            bounded=np.abs(p_slip - wanted),
            flips=int(_flipped(p_slip, chain).sum()),
            far=int(_flipped(p_slip, wanted, self._bounds.p_slip).sum()),
        )

    def _broken(
        self, input_error: NDArray[np.float64], p_error: NDArray[np.float64], far: int
    ) -> list[str]:
        """The bounds that these errors break; NaN breaks each."""
        broken, bounds = [], self._bounds
        if not (input_error < bounds.input_relative).all():
            broken.append(f"input {_largest(input_error):.1e}, bound {bounds.input_relative:.0e}")
        if not (p_error < bounds.p_slip).all():
            broken.append(f"p_slip {_largest(p_error):.1e}, bound {bounds.p_slip:.0e}")
        if far:
            broken.append(f"{far} verdicts flipped further from the threshold than the bound")
        return broken

    def _published(self, said: _Said) -> tuple[NDArray[np.float64], int, int]:
        """Errors of published probabilities, flips, and those beyond the bound."""
        if not said.published:
            return np.empty(0), 0, 0
        answers = self._reference.probabilities(np.array(said.inputs))
        wanted = answers[:, 1]
        if self._session is not None and self._session.temperature != 1.0:
            wanted = exact_softening(
                answers[:, 0], wanted, self._session.temperature, LIMITS.slip_threshold
            )
        published = np.array(said.published)
        return (
            np.abs(published - wanted),
            int(_flipped(published, wanted).sum()),
            int(_flipped(published, wanted, self._bounds.p_slip).sum()),
        )

    def _answers(
        self, counts: NDArray[np.generic]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]:
        """Inputs (N, *shape), spreads (N, fingers), probabilities (N, 2), as the daemon has them.

        Probabilities are NaN where the daemon does not ask the network.
        """
        model = self._model
        inputs = np.empty((len(counts), *model.input.shape), dtype=np.float32)
        spreads = np.empty((len(counts), len(model.contract.fingers)))
        answers = np.full((len(counts), 2), np.nan)
        for index, reading in enumerate(counts):
            spreads[index] = model.inputs.build(reading, model.input)
            inputs[index] = model.input
            if _judgeable(spreads[index : index + 1])[0]:
                answers[index] = model.run()
        return inputs, spreads, answers

    def _verdicts(self, case: StabilityCase) -> _Said:
        said = _Said()
        if not case.is_raw:
            self._judge_floats(case.counts, said)
            return said
        pipeline = self._pipeline()
        for number, counts in enumerate(case.counts.astype(np.uint16)):
            if number and not case.one_hand:
                pipeline = self._pipeline()
            faults = np.zeros(counts.shape, dtype=np.uint8)
            judgement = pipeline.judge(TactileReading(0, number, counts, faults))
            said.add(judgement.decision, judgement.p_slip, judgement.reasons, self._model)
        return said

    def _pipeline(self) -> Pipeline:
        """Each reading is a grasp, and none changes the session."""
        fingers = self._model.contract.fingers
        pipeline = Pipeline(self._model, fingers, LIMITS, lambda: 0, learns=False)
        if pipeline.session is not None and self._state is not None:
            pipeline.session.restore(self._state)
        return pipeline

    def _judge_floats(self, counts: NDArray[np.generic], said: _Said) -> None:
        """What no driver can hand over goes to the network's door, as repaired counts do."""
        network = Network(self._model, LIMITS.slip_threshold)
        for reading in counts:
            found = network.judge(Examined((), reading), self._session)
            decision, reasons = decide(found.p_slip, found.reasons, HELD, 0, LIMITS)
            said.add(decision, found.p_slip, reasons, self._model)


def seasoned_session(contract: ModelContract) -> SessionState | None:
    """A session after a billion grasps of sensors that drifted; None for a model that needs none.

    Each mean has moved by 0.3 of its spread in the training, each spread has shrunk to 0.8.
    """
    wanted = contract.input
    if not isinstance(wanted, SessionInput):
        return None
    electrodes = Electrodes(contract.seen)
    mean = np.concatenate((wanted.mean, electrodes.centre.ravel()))
    spread = np.concatenate((wanted.spread, electrodes.spread.ravel()))
    return SessionState(
        weight=HORIZON_GRASPS,
        grasps=SEASONED_GRASPS,
        mean=tuple((mean + 0.3 * spread).tolist()),
        squares=tuple((HORIZON_GRASPS * (0.8 * spread) ** 2).tolist()),
    )


def _judgeable(spreads: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Readings (N,) of which the network is asked, by spreads (N, fingers)."""
    sound = np.greater_equal(spreads, SPREAD_FLOOR_COUNTS)
    return np.array(sound.all(axis=1), dtype=np.bool_)


def _relative(inputs: NDArray[np.float32], exact: NDArray[np.longdouble]) -> NDArray[np.float64]:
    """Largest error of each input (N, ...) over the largest magnitude in it, shape (N,)."""
    axes = tuple(range(1, exact.ndim))
    scale = np.abs(exact).max(axis=axes)
    errors = np.abs(inputs - exact).max(axis=axes) / np.where(scale > 0.0, scale, 1.0)
    relative: NDArray[np.float64] = errors.astype(np.float64)
    return relative


def _flipped(
    p_slip: NDArray[np.float64], wanted: NDArray[np.float64], beyond: float = 0.0
) -> NDArray[np.bool_]:
    """Where the verdict is another one and the reference further from the threshold than this."""
    threshold = LIMITS.slip_threshold
    other = (p_slip >= threshold) != (wanted >= threshold)
    flipped: NDArray[np.bool_] = np.where(np.abs(wanted - threshold) > beyond, other, False)
    return flipped


def _largest(errors: NDArray[np.float64]) -> float:
    return float(errors.max()) if len(errors) else 0.0
