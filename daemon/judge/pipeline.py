"""Reading in, judgement out: health, hand, plausibility, network, decision, in this order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from graspd.biotac import Finger, electrode_name
from graspd.daemon.judge.decision import (
    HELD,
    NOTHING_HELD,
    WITHHELD,
    HandLimits,
    HoldDown,
    Limits,
    decide,
)
from graspd.daemon.judge.health import Health
from graspd.daemon.judge.reasons import OPEN, WATCHED_LIFT, Decision, GateState, Moment, Reason
from graspd.daemon.trust.lift_book import NOT_ASSESSED, GraspId, LiftBook, OutcomeStatus
from graspd.drivers.base import JointReading, TactileReading
from graspd.models.contract import ModelError
from graspd.models.judge.grasp_judge import NO_OPINION, Examined, GraspJudge, Opinion, Refusal
from graspd.models.runtime import TactileModel
from graspd.models.trust.assessment import Assessment
from graspd.models.trust.risk import RiskOutcomes

if TYPE_CHECKING:
    from graspd.daemon.judge.every_reading import EveryReading
    from graspd.daemon.judge.exchange import Exchanged
    from graspd.daemon.judge.hand import HandTracker
    from graspd.daemon.trust.trust import Trust
    from graspd.models.session_statistics import SessionState


class Judgement(msgspec.Struct, frozen=True, gc=False):
    """Everything decided about one reading, or about its absence."""

    t_ns: int
    """Monotonic time, ns, of the reading's last byte."""
    decision: Decision
    reasons: tuple[Reason, ...]
    p_slip: float | None
    """Probability of slip after learning from outcomes; None exactly if the decision is unknown."""
    moment: Moment
    """State of the grasp."""
    opinion: Opinion
    """Answer of the network for the grasp, maybe of an earlier reading."""
    assessment: Assessment | None = None
    """Assessment of `opinion` by the outcomes known now; None: no learning and no risk."""
    risk: RiskOutcomes | None = None
    """Outcomes of `stable` lifts before this verdict; None like `assessment`."""
    supervised: bool = False
    """True if the outcome of a supervised lift would teach the learner: ask for one."""
    session_calibrated: bool | None = None
    """True if the session is known well enough; None for a model that needs none."""
    judged_counts: NDArray[np.uint16] | None = None
    """Shape (fingers, 24): what the network judged, before any repair; None if it did not judge
    this very reading, or if electrodes of it are broken."""


class Pipeline:
    """Judges readings of one hand with one model."""

    def __init__(
        self,
        model: TactileModel,
        fingers: Sequence[Finger],
        limits: Limits,
        clock: Callable[[], int],
        *,
        hand: HandLimits | None = None,
        learns: bool = True,
        needs_session: bool = False,
        trust: Trust | None = None,
    ) -> None:
        """`clock` returns monotonic ns. `hand` None: without a gate, so each reading is a grasp.

        `learns` False: the session takes in no grasps. `needs_session`: nothing is judged before
        the session is calibrated. `trust`: what outcomes teach; None: nothing, and no risk.
        Raises `ModelError` if the model is for other fingers.
        """
        if model.contract.fingers != tuple(fingers):
            raise ModelError(
                f"{model.path}: judges the fingers {', '.join(model.contract.fingers)} "
                f"in this order, the hand has {', '.join(fingers)}"
            )
        self._judge = GraspJudge.of(model, limits.slip_threshold)
        self.session = self._judge.session
        """Calibration of today's sensors up to the last `learn`; None: the model has no session."""
        self._limits = limits
        self.clock = clock
        self._learns = learns
        self.needs_session = needs_session
        """True if nothing is judged before the session is calibrated."""
        self._fingers = model.contract.fingers
        self._health = Health(len(fingers), stream=hand is not None)
        self.trust = trust
        """Learning and risk; None: without learning and without a risk."""
        self.lifts = LiftBook() if trust is None else trust.lifts
        """Which grasps were judged, and how their lifts ended."""
        self.boot_id = ""
        """Id of this start of the daemon; it is part of the name of each grasp."""
        self.hand: HandTracker | EveryReading
        """Says when a grasp is to be judged."""
        if hand is None:
            from graspd.daemon.judge.every_reading import EveryReading

            self.hand = EveryReading()
        else:
            from graspd.daemon.judge.hand import HandTracker

            self.hand = HandTracker(fingers, hand)
        self.read_rest = self.hand.read_rest
        """Function that returns the resting counts, shape (fingers, 24); None: a table has none."""
        self._moment = self.hand.silent()
        """Moment of the last reading."""
        self._opinion = NO_OPINION
        """Answer of the network for the current grasp."""
        self._assessment: Assessment | None = None
        """Assessment of `_opinion` when it was given."""
        self._held = NOTHING_HELD
        self._to_learn: tuple[Examined, Opinion] | None = None
        """Grasp that the session is to take in, as it was judged first. None: none."""
        self._learnt_grasp = 0
        """Number of the last grasp that the session took in, or is about to."""
        self._late: bool | None = None
        """Argument of `expect_late` for the next reading. None: the reading's age decides."""
        self.on_exchange: Callable[[Exchanged], None] | None = None
        """Called when the sensors were exchanged, with what was known of the new ones."""

    @property
    def on_request(self) -> bool:
        """True if the first judgement of a settled grasp waits until the controller asks."""
        return self.hand.on_request

    def session_then(self) -> SessionState | None:
        """Return the session's state as if the current grasp were over; None: no session."""
        session = self.session
        if session is None:
            return None
        state = session.state()
        if self._to_learn is None:
            return state
        try:
            self._judge.observe(*self._to_learn)
            return session.state()
        finally:
            session.restore(state)

    def ask(self) -> None:
        """Ask for a judgement of the current grasp once it has settled."""
        self.hand.ask()

    def expect_late(self, *, judged: bool) -> None:
        """Treat the next replayed reading as late. `judged`: the network ran when it was live."""
        self._late = judged

    def sensors_exchanged(self, known: Exchanged | None = None) -> None:
        """Forget session, grasp, learning and, unless `known.tared`, the tare: new sensors.

        From then on nothing is judged before the session is calibrated. `known`: what is known of
        the new sensors, to start from; None: nothing. Raises `ValueError`, half done, if that is
        of another model; then call it again without.
        """
        if known is None:
            # A scene that keeps no session never needs it.
            from graspd.daemon.judge.exchange import NOTHING_KNOWN

            known = NOTHING_KNOWN
        self._forget_opinion()
        self._to_learn = None
        self.needs_session = True
        if self.session is not None:
            self.session.reset()
            if known.session is not None:
                self.session.restore(known.session)
        if self.trust is not None:
            self.trust.sensors_exchanged(known.learned, known.proven, known.budget)
        if known.tared:
            self.hand.restart()
        else:
            self.hand.forget()
        if self.on_exchange is not None:
            self.on_exchange(known)

    def outcome(self, grasp: GraspId, *, slipped: bool) -> OutcomeStatus:
        """Note how the lift of a grasp ended; return whether it is taken. Takes 0.5 to 1 ms."""
        if self.trust is not None:
            return self.trust.outcome(grasp, slipped=slipped)
        return self.lifts.tell(grasp, slipped=slipped)[0]

    def skip(self) -> None:
        """Note that readings were left out before the next one, so the grasp must settle again."""
        self.hand.interrupt()

    def observe_joints(self, reading: JointReading) -> None:
        """Take in joint angles; if they are `interrupted`, the grasp must settle again."""
        if reading.interrupted:
            self.skip()
        self.hand.observe_joints(reading)

    def judge(self, reading: TactileReading) -> Judgement:
        """Return the judgement of a reading: `unknown` unless its grasp has settled.

        Bad data gives `unknown`, never an exception.
        """
        if reading.interrupted:
            self.skip()
        if self._to_learn is not None:
            self.learn()
        checked, made_ns = self._health.check(reading), reading.made_ns
        in_time = self._late
        if in_time is None:
            in_time = 0 <= self.clock() - reading.t_ns <= self._limits.max_age_ns
        moment, counts = self.hand.step(made_ns, reading.counts, checked, in_time=in_time)
        self._moment = moment
        examined = None
        if counts is not None:
            examined = self._judge.examine(counts, checked.broken)
            self._opinion, self._assessment = self._judge.judge(examined), None
            if checked.broken is not None:
                counts = None
        elif moment.state is not GateState.JUDGED:
            self._forget_opinion()
        lift = GraspId(self.boot_id, moment.grasp)
        worth, risk = self._assess(lift, self._opinion if moment.judges else NO_OPINION)
        judgement = self._conclude(
            reading.t_ns, made_ns, checked.reasons, lift, moment, self._opinion, worth, risk, counts
        )
        self._late = None
        if examined is not None and moment.steady and Reason.STALE not in judgement.reasons:
            self._keep_to_learn(examined, moment.grasp)
        stable = judgement.decision is Decision.STABLE
        if stable or moment.judges:
            self._note(lift, worth, stable=stable, judged=moment.judged)
        return judgement

    def silence(self, last_t_ns: int) -> Judgement:
        """Return the judgement when no reading has come for too long after the last, of
        `last_t_ns`."""
        moment = self.hand.silent()
        lift = GraspId(self.boot_id, moment.grasp)
        worth, risk = None, None
        if self.trust is not None:
            worth, risk = self.trust.assess(lift, NO_OPINION, self._judge.features, None)
        return self._conclude(last_t_ns, 0, (Reason.STALE,), lift, moment, NO_OPINION, worth, risk)

    def health(self) -> dict[str, Reason]:
        """Return the reason of each part that has a problem, by its name: of an electrode, such as
        `ff_7`, a finger, `joints`, `model` or `session`."""
        findings = dict.fromkeys(self._opinion.repaired, Reason.ELECTRODE_IMPLAUSIBLE)
        for (finger, place), reason in self._health.electrodes().items():
            findings[electrode_name(self._fingers[finger], place)] = reason
        findings |= self.hand.health()
        if self._opinion.refusal is Refusal.MODEL_FAILED:
            findings["model"] = Reason.MODEL_FAILED
        if self.session is not None and not self.session.calibrated:
            findings["session"] = Reason.NOT_CALIBRATED
        return findings

    def learn(self) -> None:
        """Take the grasp that was judged last into the session, if it is over.

        A grasp is judged only by the grasps before it. Learning takes as long as judging."""
        now = self._moment
        is_over = now.state is None or now.state in OPEN or now.grasp != self._learnt_grasp
        if self._to_learn is not None and is_over:
            self._judge.observe(*self._to_learn)
            self._to_learn = None

    def _keep_to_learn(self, examined: Examined, grasp: int) -> None:
        """Keep a grasp for `learn` as it was judged first; later calls for it have no effect."""
        has_grasp = self.session is not None and examined.grasp is not None
        if self._learns and has_grasp and grasp != self._learnt_grasp:
            self._to_learn, self._learnt_grasp = (examined, self._opinion), grasp

    def _forget_opinion(self) -> None:
        self._opinion, self._assessment = NO_OPINION, None

    def _assess(
        self, grasp: GraspId, opinion: Opinion
    ) -> tuple[Assessment | None, RiskOutcomes | None]:
        """Return the assessment of the grasp by the outcomes known now, and those of `stable`
        lifts; None, None: no learning and no risk.

        `opinion`: the network's answer to this reading. If it cannot be assessed, it counts as
        `MODEL_FAILED`.
        """
        if self.trust is None:
            return None, None
        features = self._judge.features
        try:
            worth, risk = self.trust.assess(grasp, opinion, features, self._assessment)
        except ValueError:
            self._opinion = Opinion(None, Refusal.MODEL_FAILED, opinion.repaired)
            return self.trust.assess(grasp, NO_OPINION, features, None)
        if opinion.p_slip is not None:
            self._assessment = worth
        return worth, risk

    def _note(
        self, grasp: GraspId, worth: Assessment | None, *, stable: bool, judged: bool
    ) -> None:
        if self.trust is None or worth is None:
            self.lifts.note(grasp, NOT_ASSESSED, stable=stable, judged=judged)
        else:
            self.trust.note(grasp, worth, stable=stable, judged=judged)

    def _conclude(
        self,
        t_ns: int,
        made_ns: int,
        unusable: tuple[Reason, ...],
        lift: GraspId,
        moment: Moment,
        opinion: Opinion,
        worth: Assessment | None,
        risk: RiskOutcomes | None,
        counts: NDArray[np.uint16] | None = None,
    ) -> Judgement:
        """Return the judgement of a reading that ended at `t_ns` and was made at `made_ns`.

        `unusable`: reasons against using it. `lift`: name of the grasp. `worth`: its assessment;
        None: the network's opinion stands. `counts`: `judged_counts`. A judgement that is not
        `stable` is kept as `HoldDown` of later ones.
        """
        calibrated = None if self.session is None else self.session.calibrated
        objections = unusable
        if opinion.refusal is not None:
            objections = (*unusable, Reason(opinion.refusal))
        if moment.state not in OPEN and self.lifts.is_told(lift):
            objections = (*objections, Reason.OUTCOME_TOLD)
        if calibrated is False and self.needs_session:
            objections = (*objections, Reason.NOT_CALIBRATED)
        p_slip, withheld, held = opinion.p_slip, None, NOTHING_HELD
        if worth is not None:
            p_slip, withheld = worth.p_slip, WITHHELD[worth.permission]
        if p_slip is not None:
            held = self._held.at(moment.grasp, made_ns)
            if moment.judges:
                said, _ = decide(p_slip, objections, HELD, 0, self._limits, withheld=withheld)
                if said is not Decision.STABLE:
                    until_ns = made_ns + self._limits.steady_ns
                    self._held, held = HoldDown(moment.grasp, until_ns, said), NOTHING_HELD
        # The age is taken last, so that it includes a slow inference.
        age_ns = self.clock() - t_ns if self._late is None else self._limits.max_age_ns + 1
        decision, reasons = decide(
            p_slip, objections, moment, age_ns, self._limits, withheld=withheld, held=held
        )
        supervised = worth is not None and worth.supervised
        if moment.fingers is not None and Reason.STALE in reasons:
            moment = moment._replace(fingers=dict.fromkeys(moment.fingers))
        return Judgement(
            t_ns=t_ns,
            decision=decision,
            reasons=reasons if len(reasons) < 2 else tuple(dict.fromkeys(reasons)),
            p_slip=None if decision is Decision.UNKNOWN else p_slip,
            moment=moment,
            opinion=opinion,
            assessment=worth,
            risk=risk,
            supervised=supervised and WATCHED_LIFT.issuperset(reasons),
            session_calibrated=calibrated,
            judged_counts=counts,
        )
