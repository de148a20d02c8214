"""Reading in, judgement out: health, hand, plausibility, network, decision, in this order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES, Finger, electrode_name
from graspd.daemon.judge.decision import (
    HELD,
    NO_RECENT_VERDICT,
    WITHHELD,
    HandLimits,
    Limits,
    RecentVerdict,
    decide,
)
from graspd.daemon.judge.health import Health, Number
from graspd.daemon.judge.reasons import WATCHED_LIFT, Decision, GateState, Moment, Reason
from graspd.daemon.trust.lift_book import NOT_ASSESSED, GraspId, LiftBook, OutcomeStatus
from graspd.daemon.trust.trust import RiskReport
from graspd.drivers.base import JointReading, TactileReading
from graspd.models.contract import ModelError
from graspd.models.judge.grasp_judge import NO_OPINION, GraspJudge, Opinion, Refusal
from graspd.models.runtime import TactileModel
from graspd.models.trust.assessment import Assessment

if TYPE_CHECKING:
    from graspd.daemon.judge.exchange import Exchanged
    from graspd.daemon.judge.hand import HandTracker
    from graspd.daemon.trust.trust import Trust
    from graspd.models.judge.session import SessionCalibration


class Judgement(msgspec.Struct, frozen=True, gc=False):
    """Everything decided about one reading, or about its absence."""

    t_ns: int
    """Monotonic time, ns, of the reading's last byte."""
    decision: Decision
    reasons: tuple[Reason, ...]
    p_slip: float | None
    """After what outcomes have taught; None exactly when the decision is unknown."""
    moment: Moment
    """State of the grasp."""
    opinion: Opinion
    """Answer of the network for the grasp, maybe of an earlier reading."""
    assessment: Assessment | None = None
    """Worth of `opinion` now; None: without learning and without a risk."""
    risk: RiskReport | None = None
    """Outcomes of `stable` lifts before this verdict; None like `assessment`."""
    supervised: bool = False
    """True if its lift, watched, would teach what is not known: ask for it."""
    session_calibrated: bool | None = None
    """True if the session is known well enough; None for a model that needs none."""
    judged_counts: NDArray[np.uint16] | None = None
    """Shape (fingers, 24): what the network judged, before any repair; None if it did not judge
    this very reading, or if electrodes of it are broken."""


@dataclass(slots=True, eq=False)
class PipelineMemory:
    """State of the pipeline: the grasps judged so far."""

    to_learn: NDArray[np.float64]
    """Shape (fingers, 24): counts that the session is to take in; means nothing if none are."""
    is_to_learn: bool = False
    to_learn_slip: bool | None = None
    """True if they were judged to slip."""
    readings: Number = 0
    learnt_grasp: Number = 0
    """The grasp that the session took in last, or is about to."""
    opinion: Opinion = NO_OPINION
    """Answer of the network for the current grasp."""
    assessment: Assessment | None = None
    """Worth of `opinion` when it was given."""
    recent: RecentVerdict = NO_RECENT_VERDICT
    needs_session: bool = False
    """True if sensors were exchanged: nothing is judged before their session is calibrated."""


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
        """`clock` gives monotonic ns; without `hand` each reading is a grasp.

        Unless it `learns`, the session stays what it is; with `needs_session` nothing is judged
        before it is calibrated. Raises `ModelError` if the model is for other fingers.
        """
        if model.contract.fingers != tuple(fingers):
            raise ModelError(
                f"{model.path}: judges the fingers {', '.join(model.contract.fingers)} "
                f"in this order, the hand has {', '.join(fingers)}"
            )
        self._judge = GraspJudge.of(model, limits.slip_threshold)
        self._session = self._judge.session
        self._limits = limits
        self.clock = clock
        self._learns = learns
        self._needs_session = needs_session
        self._fingers = model.contract.fingers
        self._health = Health(len(fingers))
        self.trust = trust
        """Learning and risk; None: without learning and without a risk."""
        self.lifts = LiftBook() if trust is None else trust.lifts
        """Which grasps were judged, and how their lifts ended."""
        self.boot_id = ""
        """Identifies the start of the daemon in the names of its grasps."""
        self.hand: HandTracker | None = None
        """None where each reading is a grasp."""
        self.on_request = False
        """True if a settled grasp is judged only when the controller asks."""
        if hand is not None:
            from graspd.daemon.judge.hand import HandTracker  # only where it is needed

            self.hand, self.on_request = HandTracker(fingers, hand), hand.on_request
        self.memory = PipelineMemory(np.zeros((len(fingers), ELECTRODES)))
        self._latest_ns = 0, 0
        """Times `t_ns` and `made_ns` of the last reading."""
        self.on_exchange: Callable[[Exchanged | None], None] | None = None
        """Called when the sensors were exchanged, with what was known of the new ones."""

    @property
    def session(self) -> SessionCalibration | None:
        """Calibration of today's sensors up to the last grasp; None: a model without a session."""
        self.learn()
        return self._session

    @property
    def axis_ns(self) -> int:
        """Time from which a replay counts: `t_ns` less `made_ns`, 0 of live readings."""
        t_ns, made_ns = self._latest_ns
        return t_ns - made_ns

    @property
    def read_rest(self) -> Callable[[], NDArray[np.float64]] | None:
        """Gives where each electrode rests; None where each reading is a grasp."""
        hand = self.hand
        return None if hand is None else lambda: hand.rest

    def ask(self) -> None:
        """Judge the current grasp once it has settled: the controller waits for the verdict."""
        if self.hand is not None:
            self.hand.gate.ask()

    def sensors_exchanged(self, known: Exchanged | None = None) -> None:
        """Forget session, grasp and maybe the tare: the sensors are others.

        Go on from what is `known` of them. Raises `ValueError` if that is of another model.
        """
        self._forget_opinion()
        self.memory.is_to_learn = False
        self.memory.needs_session = True
        if self._session is not None:
            self._session.reset()
            if known is not None and known.session is not None:
                self._session.restore(known.session)
        if self.trust is not None:
            learned, proven = (None, 0) if known is None else (known.learned, known.proven)
            self.trust.sensors_exchanged(learned, proven)
        if self.hand is not None and known is not None and known.tared:
            self.hand.restart()
        elif self.hand is not None:
            self.hand.forget()
        if self.on_exchange is not None:
            self.on_exchange(known)

    def outcome(self, grasp: GraspId, *, slipped: bool) -> OutcomeStatus:
        """Take in how the lift of a grasp has ended; takes 1 to 3 ms."""
        if self.trust is not None:
            return self.trust.outcome(grasp, slipped=slipped)
        return self.lifts.tell(grasp, slipped=slipped)[0]

    def restart(self) -> None:
        """Discard the current grasp's verdict: its state is of another model or gate."""
        self._forget_opinion()
        self.memory.learnt_grasp, self.memory.recent = 0, NO_RECENT_VERDICT
        self.memory.is_to_learn = False
        if self.hand is not None:
            self.hand.restart()

    def memories(self) -> dict[str, dict[str, Any]]:
        """Return the state of each part of the judge but the session, by group and part.

        Groups: `judge` always, `hand` with a gate, `joints` with joint angles.
        """
        judge = {"judge": {"judge": self.memory, "health": self._health.memory}}
        return judge if self.hand is None else judge | self.hand.memories()

    def skip(self) -> None:
        """Note that readings were left out before the next one: anything may have moved."""
        if self.hand is not None:
            self.hand.interrupt()

    def observe_joints(self, reading: JointReading) -> None:
        """Take in joint angles."""
        if self.hand is not None:
            self.hand.observe_joints(reading)

    def judge(self, reading: TactileReading) -> Judgement:
        """Return the judgement of a reading: `unknown` unless its grasp has settled.

        Bad data gives `unknown`; it never raises.
        """
        memory = self.memory
        if memory.is_to_learn:
            self.learn()
        made_ns = reading.made_ns
        self._latest_ns = reading.t_ns, made_ns
        memory.readings += 1
        checked = self._health.check(reading)
        if self.hand is None:
            counts = None if checked.reasons else reading.counts
            moment = Moment(memory.readings, judges=counts is not None)
        else:
            in_time = 0 <= self.clock() - reading.t_ns <= self._limits.max_age_ns
            moment, counts = self.hand.step(made_ns, reading.counts, checked, in_time=in_time)
        grasp = None
        if counts is not None:
            examined = self._judge.examine(counts, checked.broken)
            memory.opinion, memory.assessment = self._judge.weigh(examined), None
            grasp = examined.grasp
            if checked.broken is not None:
                counts = None
        elif moment.state is not GateState.JUDGED:
            self._forget_opinion()
        assessment = self._assess(moment)
        judgement = self._decide(
            reading.t_ns, checked.reasons, moment, memory.opinion, assessment, counts
        )
        learns = self._learns and moment.steady and Reason.STALE not in judgement.reasons
        if grasp is not None and learns:
            self._keep_to_learn(grasp, moment.grasp)
        stable = judgement.decision is Decision.STABLE
        if stable or moment.judges or moment.judged:
            self._note(GraspId(self.boot_id, moment.grasp), assessment, stable=stable)
        return judgement

    def watch(self, reading: TactileReading) -> None:
        """Take in a reading that is not to be judged: what repeats it later is not fresh."""
        self._health.check(reading)

    def silence(self, last_t_ns: int) -> Judgement:
        """Return the judgement when no reading came for too long since that of `last_t_ns`."""
        if self.hand is None:
            moment = Moment(self.memory.readings, judges=False, judged=False)
        else:
            now = self.hand.moment()
            moment = now._replace(still_ms=None, motion=None, motion_limits=None)
        grasp = GraspId(self.boot_id, moment.grasp)
        assessment = None if self.trust is None else self.trust.review(grasp, None)
        return self._decide(last_t_ns, (Reason.STALE,), moment, NO_OPINION, assessment)

    def health(self) -> dict[str, Reason]:
        """Return what is not well: electrodes such as `ff_7`, fingers, joints, model, session."""
        self.learn()
        opinion = self.memory.opinion
        findings = dict.fromkeys(opinion.repaired, Reason.ELECTRODE_IMPLAUSIBLE)
        for (finger, place), reason in self._health.electrodes().items():
            findings[electrode_name(self._fingers[finger], place)] = reason
        if self.hand is not None:
            findings |= self.hand.health()
        if opinion.refusal is Refusal.MODEL_FAILED:
            findings["model"] = Reason.MODEL_FAILED
        if self._session is not None and not self._session.now.calibrated:
            findings["session"] = Reason.NOT_CALIBRATED
        return findings

    def learn(self) -> None:
        """Take the grasp that was judged last into the session, if it is over.

        A grasp is judged only by those before it. Learning takes as long as judging."""
        memory = self.memory
        if self._session is None or not memory.is_to_learn:
            return
        now = None if self.hand is None else self.hand.gate.memory
        over = GateState.IDLE, GateState.RELEASED
        if now is None or now.grasp != memory.learnt_grasp or now.state in over:
            memory.is_to_learn = False
            self._session.observe(memory.to_learn, slip=memory.to_learn_slip)

    def _forget_opinion(self) -> None:
        self.memory.opinion, self.memory.assessment = NO_OPINION, None

    def _assess(self, moment: Moment) -> Assessment | None:
        """Return what the opinion is worth by the outcomes that are known now."""
        memory, opinion, trust = self.memory, self.memory.opinion, self.trust
        if trust is None:
            return None
        grasp = GraspId(self.boot_id, moment.grasp)
        if not moment.judges or opinion.p_slip is None:
            return trust.review(grasp, memory.assessment)
        try:
            memory.assessment = trust.judge(
                grasp, opinion.p_slip, opinion.margin, self._judge.features
            )
        except ValueError:
            memory.opinion = Opinion(None, Refusal.MODEL_FAILED, opinion.repaired)
            return trust.review(grasp, None)
        return memory.assessment

    def _is_told(self, moment: Moment) -> bool:
        over = moment.state in (GateState.IDLE, GateState.RELEASED)
        return not over and self.lifts.is_told(GraspId(self.boot_id, moment.grasp))

    def _note(self, grasp: GraspId, assessment: Assessment | None, *, stable: bool) -> None:
        if self.trust is None or assessment is None:
            self.lifts.note(grasp, NOT_ASSESSED, stable=stable)
        else:
            self.trust.note(grasp, assessment, stable=stable)

    def _keep_to_learn(self, counts: NDArray[np.generic], grasp: int) -> None:
        """Keep a grasp for `learn`, once: as judged first, not as it changed since."""
        if self._session is not None and grasp != self.memory.learnt_grasp:
            memory, p_slip = self.memory, self.memory.opinion.p_slip
            slip = None if p_slip is None else p_slip >= self._limits.slip_threshold
            memory.learnt_grasp, memory.is_to_learn = grasp, True
            memory.to_learn, memory.to_learn_slip = counts.astype(np.float64), slip

    def _decide(
        self,
        t_ns: int,
        unusable: tuple[Reason, ...],
        moment: Moment,
        opinion: Opinion,
        assessment: Assessment | None,
        counts: NDArray[np.uint16] | None = None,
    ) -> Judgement:
        """Return the judgement of a reading that is `unusable` for these reasons, or for none."""
        calibrated = None if self._session is None else self._session.now.calibrated
        objections = unusable
        if opinion.refusal is not None:
            objections = (*unusable, Reason(opinion.refusal))
        if self._is_told(moment):
            objections = (*objections, Reason.OUTCOME_TOLD)
        if calibrated is False and (self._needs_session or self.memory.needs_session):
            objections = (*objections, Reason.NOT_CALIBRATED)
        p_slip, withheld = opinion.p_slip, None
        if assessment is not None:
            p_slip, withheld = assessment.p_slip, WITHHELD[assessment.permission]
        decision, reasons = decide(
            p_slip,
            objections,
            moment,
            self.clock() - t_ns,  # taken last, so that a slow inference counts too
            self._limits,
            withheld=withheld,
            recent=self._recent(p_slip, objections, withheld, moment),
        )
        supervised = assessment is not None and assessment.supervised
        if moment.fingers is not None and Reason.STALE in reasons:
            moment = moment._replace(fingers=dict.fromkeys(moment.fingers))
        return Judgement(
            t_ns=t_ns,
            decision=decision,
            reasons=reasons if len(reasons) < 2 else tuple(dict.fromkeys(reasons)),
            p_slip=None if decision is Decision.UNKNOWN else p_slip,
            moment=moment,
            opinion=opinion,
            assessment=assessment,
            risk=None if self.trust is None else self.trust.report(),
            supervised=supervised and WATCHED_LIFT.issuperset(reasons),
            session_calibrated=calibrated,
            judged_counts=counts,
        )

    def _recent(
        self,
        p_slip: float | None,
        objections: tuple[Reason, ...],
        withheld: Reason | None,
        moment: Moment,
    ) -> Decision:
        """Return an earlier decision that still counts against `stable`, and note this one."""
        memory, made_ns = self.memory, self._latest_ns[1]
        if moment.judges and p_slip is not None:
            said, _ = decide(p_slip, objections, HELD, 0, self._limits, withheld=withheld)
            if said is not Decision.STABLE:
                memory.recent = RecentVerdict(moment.grasp, made_ns, said)
                return Decision.STABLE
        return memory.recent.of(moment.grasp, made_ns, self._limits)
