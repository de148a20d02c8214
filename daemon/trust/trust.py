"""What a verdict is worth: the model's opinion, corrected by outcomes, under the risk that is set.

At each reading: `judge` a grasp that the network judged, or `review` one that it judged before;
decide; `note` what was said. Tell each `outcome`.
"""

from __future__ import annotations

import hashlib
import math
import zlib
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Final, Literal

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from daemon.trust.learner import Learner, LearnerState, sigmoid
from daemon.trust.lift_book import NOT_ASSESSED, GraspId, LiftBook, LiftBookState, OutcomeStatus

MAX_BYTES: Final = 1 << 20
"""Of a state before it is compressed: of three fingers, with every outcome still out, 240 kB."""
DIGEST_BYTES: Final = 32
LOWEST: Final = -6.0
"""Log-odds of slip (0.25 %) that the threshold must not fall below: nothing is surer than that."""
STEP: Final = 1.0
"""How far an outcome moves the threshold, log-odds, per slip more or less than allowed."""

Count = Annotated[int, msgspec.Meta(ge=0)]


class Permission(StrEnum):
    """Whether a grasp may be called `stable`."""

    ALLOWED = "allowed"
    WITHHELD = "withheld"
    """Too likely to slip for the risk that is set."""
    UNPROVEN = "unproven"
    """As withheld, and too few outcomes are known: lift under supervision."""
    RISK_EXCEEDED = "risk-exceeded"
    """More slipped than the rule can make good: nothing is `stable` until the user resets it."""


@dataclass(frozen=True, slots=True)
class RiskLimits:
    """What the user sets."""

    max_slip_when_stable: float | None = None
    """Share of the `stable` lifts that may slip, 0.001..0.5; None: no rule, all is allowed."""
    warm_up: int = 0
    """Outcomes, since the start or an exchange of a sensor, before which each grasp that is not
    `stable` is to be lifted under supervision."""
    explore: float = 0.0
    """Share, 0..1, of the withheld grasps to be lifted under supervision: only their outcomes show
    that the rule is too strict."""

    def __post_init__(self) -> None:
        """Raise `ValueError` for what is out of range."""
        alpha = self.max_slip_when_stable
        if alpha is not None and not 0.001 <= alpha <= 0.5:
            raise ValueError("max_slip_when_stable must be 0.001..0.5")
        if self.warm_up < 0 or not 0.0 <= self.explore <= 1.0:
            raise ValueError("warm_up must not be negative, explore must be 0..1")


class RiskReport(msgspec.Struct, frozen=True, kw_only=True):
    """What lifts of `stable` verdicts came to, for those who decide whether to lift."""

    target: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] | None
    """`[risk] max_slip_when_stable`; null: none is set."""
    lifts: Count
    """Lifts of `stable` verdicts whose outcome was told."""
    slips: Count
    """Slips among them."""
    outstanding: Count
    """`stable` verdicts whose outcome can still come; each may add one slip to the bound."""
    bound: Annotated[float, msgspec.Meta(ge=0.0)] | None
    """What `slips` cannot exceed, but for `outstanding`; null: no risk is set."""
    warm_up_left: Count
    """Outcomes that are missing until the warm-up is over; 0 without a risk."""

    @property
    def beyond_share(self) -> float:
        """Slips that the bound allows beyond the target's share of the lifts; 0 without a bound."""
        if self.target is None or self.bound is None:
            return 0.0
        return self.bound - self.target * self.lifts


class RiskState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """State of `Risk`; see its attributes."""

    max_slip_when_stable: float | None
    theta: float
    lifts: Count
    slips: Count
    overdue: Count
    proven: Count


class Risk:
    """The online rule: `stable` only at log-odds of at most theta, which each outcome moves.

    With a = `max_slip_when_stable`, N reported `stable` lifts and S slips among them:

        S <= a N + (start - LOWEST) / STEP + (1 - a) max(1, overdue)    at every moment.

    Proof. Each reported `stable` lift adds STEP (a - y) to theta, y = 1 for a slip, else 0; all
    else that is done to theta (at most 0, at most `start` on an exchange) lowers it. So after N
    lifts theta <= start + STEP (a N - S), or S <= a N + (start - theta) / STEP. It remains to
    bound theta from below. Let `overdue` be the `stable` outcomes taken since theta was last >=
    LOWEST; each lowered it by at most STEP (1 - a), so theta >= LOWEST - overdue STEP (1 - a),
    which gives the bound. As `stable` is only said while theta >= LOWEST, all but the first of
    them were out when theta fell below it: if every outcome is told before the next `stable`,
    overdue <= 1, and each `stable` lift whose outcome is still out can add at most one. Nothing
    is assumed of data, model, learner or labels.

    Only reported lifts are covered; `slips` counts what was told, true or not.
    """

    def __init__(self, limits: RiskLimits) -> None:
        self.limits = limits
        alpha = limits.max_slip_when_stable
        # A probability of 2 a; from a quarter on any grasp that is likelier to hold than to slip.
        twice = 0.5 if alpha is None else min(2.0 * alpha, 0.5)
        self.start = max(math.log(twice / (1.0 - twice)), LOWEST)
        """Where theta starts, log-odds."""
        self.theta = self.start
        """Highest log-odds of slip that may be called `stable`."""
        self.lifts = 0
        """`stable` lifts whose outcome is known."""
        self.slips = 0
        """Slips among them."""
        self.overdue = 0
        """Outcomes of `stable` lifts that were taken since theta was last at `LOWEST` or above."""
        self.proven = 0
        """Outcomes of any lift since the start or the last exchange of a sensor."""

    @property
    def warm_up_left(self) -> int:
        """Outcomes that are missing until the warm-up is over."""
        return max(self.limits.warm_up - self.proven, 0)

    @property
    def bound(self) -> float | None:
        """What `slips` cannot exceed; each lift whose outcome is out adds one. None: no rule."""
        alpha = self.limits.max_slip_when_stable
        if alpha is None:
            return None
        late = (1.0 - alpha) * max(1, self.overdue)
        return alpha * self.lifts + (self.start - LOWEST) / STEP + late

    def decide(self, log_odds: float) -> Permission:
        """Return whether a grasp with these log-odds of slip may be called `stable`."""
        if self.limits.max_slip_when_stable is None:
            return Permission.ALLOWED
        if self.theta < LOWEST:
            return Permission.RISK_EXCEEDED
        if log_odds <= self.theta:  # false for NaN
            return Permission.ALLOWED
        return Permission.UNPROVEN if self.warm_up_left else Permission.WITHHELD

    def supervised(self, permission: Permission, seed: str, grasp: int) -> bool:
        """Return True to ask for a lift under supervision; the same for the same seed and grasp."""
        if permission is not Permission.WITHHELD:
            return permission is Permission.UNPROVEN
        digest = hashlib.blake2b(f"{seed} {grasp}".encode(), digest_size=8).digest()
        return int.from_bytes(digest) / 2.0**64 < self.limits.explore

    def take(self, *, stable: bool, slipped: bool, proves: bool) -> None:
        """Take in an outcome, and whether the grasp had been called `stable`.

        `proves` is false for lifts with former sensors: they count, but not for the warm-up.
        """
        self.proven += proves
        if not stable:
            return
        self.lifts += 1
        self.slips += slipped
        alpha = self.limits.max_slip_when_stable
        if alpha is None:
            return
        self.theta = min(self.theta + STEP * (alpha - slipped), 0.0)
        self.overdue = 0 if self.theta >= LOWEST else self.overdue + 1

    def exchanged(self) -> None:
        """Keep what slipped, not what was learned: a sensor was exchanged."""
        self.theta = min(self.theta, self.start)
        self.proven = 0

    def state(self) -> RiskState:
        """Return what `restore` needs."""
        alpha = self.limits.max_slip_when_stable
        return RiskState(alpha, self.theta, self.lifts, self.slips, self.overdue, self.proven)

    def restore(self, state: RiskState) -> None:
        """Go on from an earlier state; with another risk than now, only the warm-up counts.

        Raises `ValueError`, and changes nothing, if no outcomes lead to such a state.
        """
        if state.max_slip_when_stable != self.limits.max_slip_when_stable:
            self.proven = state.proven
            return
        moved = state.max_slip_when_stable is not None
        alpha = state.max_slip_when_stable or 0.0
        highest = min(self.start + STEP * (alpha * state.lifts - state.slips), 0.0)
        lowest = LOWEST - STEP * (1.0 - alpha) * state.overdue
        rounding = 1e-12 * (state.lifts + 10)
        if state.slips > state.lifts or state.overdue > state.lifts:
            raise ValueError("counts more slips than lifts")
        if moved and not lowest - rounding <= state.theta <= highest + rounding:
            raise ValueError("has a threshold that these outcomes do not lead to")
        if not moved and (state.theta != self.start or state.overdue):
            raise ValueError("has a threshold without a risk")
        self.theta, self.lifts, self.slips = state.theta, state.lifts, state.slips
        self.overdue, self.proven = state.overdue, state.proven


class Assessment(msgspec.Struct, frozen=True):
    """What outcomes say of one grasp, before the decision; the defaults are those of no grasp."""

    outcomes: int
    """Number of outcomes that `p_slip` rests on."""
    report: RiskReport
    p_slip: float | None = None
    """After learning, 0..1; the model's own until something was learned. None: not judged."""
    log_odds: float = 0.0
    """Log-odds of slip, after learning."""
    permission: Permission = Permission.ALLOWED
    supervised: bool = False
    """True to ask for its lift under supervision."""
    features: bytes = b""
    """Learner's features, float64, for the lift book."""


class TrustState(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"lifts": "ledger"}
):
    """All that is learned; useless with another model or other fingers."""

    version: Literal[1]
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

        `model`: digest of the model. `inputs`: its input features, 78 for three fingers. With
        `learns` false outcomes move only the risk's threshold.
        """
        self._model = model
        self._inputs = inputs
        self.learns = learns
        self._report: RiskReport | None = None
        self.learner = Learner(inputs)
        self._judging = self.learner if learns else Learner(inputs)
        """The learner by which grasps are judged; without learning, one that is never taught."""
        self.risk = Risk(limits or RiskLimits())
        self.lifts = LiftBook()

    def judge(
        self, grasp: GraspId, p_slip: float, margin: float, inputs: NDArray[np.floating]
    ) -> Assessment:
        """Assess a grasp by the model's `p_slip`, its log-odds `margin`, and its flat `inputs`.

        Raises `ValueError` for values that are not finite and for another shape: such a grasp must
        be `unknown`.
        """
        if not 0.0 <= p_slip <= 1.0:  # also true for NaN
            raise ValueError(f"{p_slip} is no probability")
        report = self.report()
        log_odds, features = self._judging.judge(margin, inputs)
        permission = self._permission(grasp, log_odds)
        return Assessment(
            outcomes=self._judging.outcomes,
            report=report,
            p_slip=sigmoid(log_odds) if self._judging.outcomes else p_slip,
            log_odds=log_odds,
            permission=permission,
            supervised=self.risk.supervised(permission, grasp.boot_id, grasp.grasp),
            features=features.astype("<f8").tobytes(),
        )

    def review(self, grasp: GraspId, former: Assessment | None) -> Assessment:
        """Return the assessment of a grasp that was judged before, None for none, as it is now.

        A grasp that was called `stable` stays allowed. Any other is allowed only if it was then and
        is by the outcomes told since.
        """
        report = self.report()
        if former is None:
            return Assessment(self._judging.outcomes, report)
        permission = former.permission
        if permission is Permission.ALLOWED and not self.lifts.is_stable(grasp):
            permission = self._permission(grasp, former.log_odds)
        if permission is former.permission and report is former.report:
            return former
        return replace(former, permission=permission, report=report)

    def _permission(self, grasp: GraspId, log_odds: float) -> Permission:
        permission = self.risk.decide(log_odds)
        has_rule = self.risk.limits.max_slip_when_stable is not None
        if has_rule and permission is Permission.ALLOWED and self.lifts.is_told(grasp):
            return Permission.WITHHELD  # its outcome is known: a second lift would not be counted
        return permission

    def note(self, grasp: GraspId, assessment: Assessment, *, stable: bool) -> None:
        """Enter the verdict on a grasp in the book. Raises `ValueError` if it was not allowed."""
        # Nothing is learned from an assessment of another model.
        is_ours = len(assessment.features) == 8 * (self._inputs + 2)
        features = assessment.features if is_ours else NOT_ASSESSED
        if stable and assessment.permission is not Permission.ALLOWED:
            raise ValueError(f"grasp {grasp.grasp} was called stable: {assessment.permission}")
        if self.lifts.note(grasp, features, stable=stable):
            self._report = None

    def outcome(self, grasp: GraspId, *, slipped: bool) -> OutcomeStatus:
        """Take in how a lift ended; only an outcome that is `TAKEN` changes more than a counter."""
        status, lift = self.lifts.tell(grasp, slipped=slipped)
        if status is OutcomeStatus.TAKEN and lift is not None:
            self.risk.take(stable=lift.stable, slipped=slipped, proves=bool(lift.features))
            if lift.features and self.learns:
                self.learner.learn(np.frombuffer(lift.features, "<f8"), slipped=slipped)
        self._report = None
        return status

    def report(self) -> RiskReport:
        """Return the outcomes of the lifts of `stable` verdicts until now."""
        if self._report is None:
            risk = self.risk
            self._report = RiskReport(
                target=risk.limits.max_slip_when_stable,
                lifts=risk.lifts,
                slips=risk.slips,
                outstanding=self.lifts.outstanding,
                bound=risk.bound,
                warm_up_left=risk.warm_up_left,
            )
        return self._report

    def sensors_exchanged(self, learned: LearnerState | None = None) -> None:
        """Learn from the start, or from `learned`. Raises `ValueError` for another model's."""
        self.learner.reset()
        if learned is not None:
            self.learner.restore(learned)
        self.risk.exchanged()
        self.lifts.exchanged()
        self._report = None

    def state(self) -> TrustState:
        """Return what `restore` needs; later outcomes do not change it."""
        parts = self.learner.state(), self.risk.state(), self.lifts.state()
        return TrustState(1, self._model, *parts)

    def fits(self, state: TrustState) -> bool:
        """Return True if a state is of this model."""
        return state.model == self._model

    def restore(self, state: TrustState) -> None:
        """Go on from an earlier state. Raises `ValueError`, and changes nothing, if it is none."""
        if not self.fits(state):
            raise ValueError("is of another model")
        learner, risk = Learner(self._inputs), Risk(self.risk.limits)
        learner.restore(state.learner)
        risk.restore(state.risk)
        self.lifts.restore(state.lifts, self._inputs + 2)
        self.learner, self.risk = learner, risk
        if self.learns:
            self._judging = learner
        self._report = None


def encode(state: TrustState) -> bytes:
    """Return a state as bytes, behind their SHA-256; takes some milliseconds."""
    data = zlib.compress(msgspec.msgpack.encode(state), 1)
    return hashlib.sha256(data).digest() + data


def decode(data: bytes) -> TrustState:
    """Reverse `encode`. Raises `ValueError` for what is too long, damaged or no state."""
    digest, content = data[:DIGEST_BYTES], data[DIGEST_BYTES:]
    if len(data) > MAX_BYTES or hashlib.sha256(content).digest() != digest:
        raise ValueError("is damaged, or nothing that was learned")
    try:
        plain = zlib.decompressobj().decompress(content, MAX_BYTES)
        return msgspec.msgpack.decode(plain, type=TrustState)
    except (zlib.error, msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"is nothing that was learned: {error}") from error
