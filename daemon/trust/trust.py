"""Assessment of grasps: the model's opinion, corrected by outcomes, under the configured risk. At
each reading: `assess` the grasp, decide, and `note` the decision. Report each `outcome`."""

from __future__ import annotations

import hashlib
import zlib
from typing import Final

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from graspd.daemon.trust.lift_book import (
    GraspId,
    LiftBook,
    LiftBookState,
    OutcomeStatus,
)
from graspd.models.judge.grasp_judge import Opinion
from graspd.models.trust.assessment import Assessment, assess
from graspd.models.trust.learner import Learner, LearnerState, of_format_2
from graspd.models.trust.risk import Permission, Risk, RiskLimits, RiskOutcomes, RiskState

VERSION: Final = 3
"""Format of a state. Format 2 held weights and residual as `Learner.at_told` returns them, format
1 no residual."""
MAX_BYTES: Final = 1 << 20
"""Largest uncompressed state, bytes; three fingers with no outcome known yet take 620 kB."""
DIGEST_BYTES: Final = 32


class FormatError(ValueError):
    """A state has another format: another version of graspd wrote it."""


class _Versioned(msgspec.Struct, frozen=True):
    version: int


class TrustState(_Versioned, frozen=True, forbid_unknown_fields=True):
    """State of learner, risk and lift book. It fits only its model and fingers."""

    model: str
    learner: LearnerState
    risk: RiskState
    lifts: LiftBookState


class Trust:
    """Learner, risk and lift book of one hand with one model."""

    def __init__(
        self, model: str, inputs: int, limits: RiskLimits | None = None, *, learns: bool = True
    ) -> None:
        """Start with no outcome.

        `model`: digest of the model. `inputs`: number of its input features, 78 for three fingers.
        `limits` None: no risk. With `learns` false outcomes move only the risk's budget.
        """
        self._model = model
        self.learns = learns
        self.learner = Learner(inputs)
        self._judging = self.learner if learns else Learner(inputs)
        """Learner that corrects judgements; without learning, one that never learns."""
        self.risk = Risk(limits or RiskLimits())
        self.lifts = LiftBook()

    def assess(
        self,
        grasp: GraspId,
        opinion: Opinion,
        inputs: NDArray[np.floating],
        former: Assessment | None,
    ) -> tuple[Assessment, RiskOutcomes]:
        """Return the assessment of a grasp, and what `report` returns.

        `opinion`, `inputs`: the network's answer to this reading, and its input features. Without
        an answer the `former` assessment is reviewed. Raises `ValueError` as `judge` does.
        """
        if opinion.p_slip is None:
            worth = self.review(grasp, former)
        else:
            worth = self.judge(grasp, opinion.p_slip, opinion.margin, inputs)
        book = self.lifts
        return worth, self.risk.figures(book.outstanding, book.announced, book.awaited)

    def judge(
        self, grasp: GraspId, p_slip: float, margin: float, inputs: NDArray[np.floating]
    ) -> Assessment:
        """Return the assessment of a grasp, by the function `assess` of graspd.models.trust.

        `p_slip`, `margin`, `inputs`: probability and log-odds of slip by the network, its inputs.
        Raises `ValueError` for values that no network gives.
        """
        awaited = self.lifts.awaited_besides(grasp)
        return assess(self._judging, self.risk, p_slip, margin, inputs, name=grasp, awaited=awaited)

    def review(self, grasp: GraspId, former: Assessment | None) -> Assessment:
        """Return the `former` assessment of a grasp, but allowed only if the risk still allows it.

        A grasp that was called `stable` stays allowed; one that was not allowed stays so. `former`
        None: it was not assessed yet; return an assessment without probability.
        """
        if former is None:
            return Assessment(self._judging.outcomes)
        if former.permission is not Permission.ALLOWED or self.lifts.is_stable(grasp):
            return former
        permission = self.risk.decide(former.log_odds, self.lifts.awaited_besides(grasp))
        return former if permission is former.permission else replace(former, permission=permission)

    def note(
        self, grasp: GraspId, assessment: Assessment, *, stable: bool, judged: bool = False
    ) -> None:
        """Enter a grasp's verdict, as `LiftBook.note` does; an announced lift that leaves the book
        without an outcome counts as a slip. Raises `ValueError` if `stable` is not allowed."""
        if stable and assessment.permission is not Permission.ALLOWED:
            raise ValueError(f"grasp {grasp.grasp} was called stable: {assessment.permission}")
        if self.lifts.note(grasp, assessment.features, stable=stable, judged=judged):
            self.risk.take_untold()

    def outcome(self, grasp: GraspId, *, slipped: bool) -> OutcomeStatus:
        """Take in the outcome of a lift; only status `TAKEN` changes more than a counter."""
        status, lift = self.lifts.tell(grasp, slipped=slipped)
        if status is OutcomeStatus.TAKEN and lift is not None:
            self.risk.take(stable=lift.stable, slipped=slipped, proves=bool(lift.features))
            if lift.features and self.learns:
                self.learner.learn(np.frombuffer(lift.features, "<f8"), slipped=slipped)
        return status

    def report(self) -> RiskOutcomes:
        """Return numbers of `stable` lifts with and without outcome, of slips, and the bound."""
        book = self.lifts
        return self.risk.figures(book.outstanding, book.announced, book.awaited)

    def sensors_exchanged(
        self, learned: LearnerState | None = None, proven: int = 0, budget: float | None = None
    ) -> None:
        """Start learning again for new sensors. Raises `ValueError` if `learned` does not fit.

        `learned`: what was learned with these sensors before; None: nothing. `proven`: number of
        their known outcomes, for the warm-up. `budget`: number of slips that the risk still allowed
        with them; None: not known.
        """
        self.learner.reset()
        if learned is not None:
            self.learner.restore(learned)
        self.risk.exchanged(proven, budget)
        self.lifts.exchanged()

    def state(self) -> TrustState:
        """Return what `restore` needs; later outcomes do not change it."""
        parts = self.learner.state(), self.risk.state(), self.lifts.state()
        return TrustState(VERSION, self._model, *parts)

    def fits(self, state: TrustState) -> bool:
        """Return True if a state is of the same model, by its digest."""
        return state.model == self._model

    def restore(self, state: TrustState) -> None:
        """Continue from an earlier state. Raises `ValueError`, and changes nothing, if it does not
        fit."""
        if not self.fits(state):
            raise ValueError("is of another model")
        learner, risk = Learner(self.learner.inputs), Risk(self.risk.limits)
        learner.restore(state.learner)
        risk.restore(state.risk)
        self.lifts.restore(state.lifts, learner.inputs + 2)
        if state.risk.max_slip_when_stable != risk.limits.max_slip_when_stable:
            self.lifts.withdraw()
        self.learner, self.risk = learner, risk
        if self.learns:
            self._judging = learner


def encode(state: TrustState) -> bytes:
    """Return the SHA-256 and the compressed bytes of a state; takes some milliseconds."""
    data = zlib.compress(msgspec.msgpack.encode(state), 1)
    return hashlib.sha256(data).digest() + data


def decode(data: bytes) -> TrustState:
    """Reverse `encode`. Raises `ValueError` for wrong data, `FormatError` for an unknown format."""
    digest, content = data[:DIGEST_BYTES], data[DIGEST_BYTES:]
    if len(data) > MAX_BYTES or hashlib.sha256(content).digest() != digest:
        raise ValueError("is damaged, or nothing that was learned")
    try:
        plain = zlib.decompressobj().decompress(content, MAX_BYTES)
        _check(msgspec.msgpack.decode(plain, type=_Versioned).version)
        return of_this_format(msgspec.msgpack.decode(plain, type=TrustState))
    except (zlib.error, msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"is nothing that was learned: {error}") from error


def of_this_format(state: TrustState) -> TrustState:
    """Return a state, converted if of format 2. Raises `ValueError`; `FormatError` for others."""
    _check(state.version)
    if state.version == VERSION:
        return state
    return replace(state, version=VERSION, learner=of_format_2(state.learner))


def _check(version: int) -> None:
    if version not in (2, VERSION):
        raise FormatError(f"is of format {version}; this graspd reads 2 and {VERSION}")
