"""Reading in, judgement out: health, grip, plausibility, network, decision, in this order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from daemon.judge.decision import NO_DOUBT, WITHHELD, Case, Doubt, Limits, alone, decide
from daemon.judge.findings import (
    NO_OPINION,
    Felt,
    Opinion,
    PipelineMemory,
    Watched,
    any_of,
    electrode_name,
)
from daemon.judge.health import Health
from daemon.judge.limits import GripLimits
from daemon.judge.network import Network
from daemon.judge.plausibility import Plausibility
from daemon.judge.reasons import WATCHED_LIFT, Decision, GateChange, GateState, Reason
from daemon.trust.ledger import GraspId
from daemon.trust.risk import RiskReport
from drivers.base import JointReading, TactileReading
from models.contract import Finger, ModelError, SessionInput
from models.electrodes import Electrodes
from models.runtime import TactileModel

if TYPE_CHECKING:
    from daemon.judge.calibration import SessionCalibration
    from daemon.judge.grip import Grip
    from daemon.trust.learner import LearnerState
    from daemon.trust.trust import Trust
    from models.session_statistics import SessionState

NOT_HELD: Final = {GateState.IDLE, GateState.RELEASED}
"""Where a grasp is over."""


class Judgement(msgspec.Struct, frozen=True, gc=False, eq=False):  # noqa: PLW1641 (holds dicts)
    """What was found about one reading, or about the lack of one."""

    t_ns: int
    """Monotonic time, ns, of the reading's last byte."""
    grasp: int
    decision: Decision
    p_slip: float | None
    """After what outcomes have taught; None exactly when the decision is unknown."""
    reasons: tuple[Reason, ...]
    judged: bool = True
    """Whether the network judged, or would have judged, this very reading, because the grasp had
    settled or somebody waits; not where it only keeps a standing verdict new."""
    repaired: tuple[str, ...] = ()
    """Electrodes that were replaced before judging, such as `ff_7`."""
    session_calibrated: bool | None = None
    """Whether the session is known well enough; None for a model that needs none."""
    gate: GateState | None = None
    """None where each reading is a grasp."""
    contact: tuple[Finger, ...] | None = None
    """Fingers that touch; None where nobody looks."""
    changes: tuple[GateChange, ...] = ()
    """What the gate did at this reading, oldest first."""
    still_ms: float | None = None
    """For how long the hand has touched and kept still; None where each reading is a grasp."""
    early: bool = False
    """Whether it was judged while something might still slide slowly; only where it is known."""
    motion: dict[Finger, float | None] | None = None
    """How each finger moves, in units of its noise, None where that is not known; all None where
    nobody looks."""
    motion_limits: dict[Finger, float] | None = None
    """What it may be at most for a finger that is still."""
    p_slip_model: float | None = None
    """What the network alone says; None exactly when the decision is unknown."""
    outcomes: int = 0
    """How many `p_slip` rests on."""
    supervised: bool = False
    """Whether its lift, watched, would teach what is not known: ask for it."""
    risk: RiskReport | None = None
    """What lifts of `stable` verdicts came to; None where nothing learns and no risk is set."""
    judged_counts: NDArray[np.uint16] | None = None
    """Shape (fingers, 24): what the network judged, before any repair; None if it did not judge
    this very reading, or if electrodes of it are broken. Not compared."""

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Judgement):
            return NotImplemented
        return msgspec.structs.astuple(self)[:-1] == msgspec.structs.astuple(other)[:-1]


class Pipeline:
    """Judges readings of one hand with one model."""

    def __init__(
        self,
        model: TactileModel,
        fingers: Sequence[Finger],
        limits: Limits,
        clock: Callable[[], int],
        *,
        grip: GripLimits | None = None,
        learns: bool = True,
        needs_session: bool = False,
        trust: Trust | None = None,
    ) -> None:
        """`clock` gives monotonic ns; without `grip` each reading is a grasp.

        `trust` learns from outcomes and keeps the risk that is set. With `learns` false the session
        stays what it is; with `needs_session` nothing is judged before it is calibrated. Raises
        `ModelError` if the model is for other fingers.
        """
        if model.contract.fingers != tuple(fingers):
            raise ModelError(
                f"{model.path}: judges the fingers {', '.join(model.contract.fingers)} "
                f"in this order, the hand has {', '.join(fingers)}"
            )
        contract = model.contract
        electrodes = Electrodes(contract.seen)
        self._session: SessionCalibration | None = None
        if isinstance(contract.input, SessionInput):
            from daemon.judge.calibration import SessionCalibration  # only where it is needed

            self._session = SessionCalibration(contract.input, electrodes.centre, electrodes.spread)
        self._limits = limits
        self.clock = clock
        """Gives monotonic ns, by which readings have an age."""
        self._learns = learns
        self._needs_session = needs_session
        self._fingers = contract.fingers
        self._health = Health(len(fingers))
        self._plausibility = Plausibility(fingers, contract.seen, electrodes)
        self._network = Network(model, limits.slip_threshold)
        self.trust = trust
        """What outcomes have taught; None where nothing learns and no risk is set."""
        self.boot_id = ""
        """Of the start of the daemon, which names its grasps for ever."""
        self.grip: Grip | None = None
        """None where each reading is a grasp."""
        if grip is not None:
            from daemon.judge.grip import Grip  # only where it is needed

            self.grip = Grip(fingers, grip)
        self.memory = PipelineMemory(np.zeros(electrodes.centre.shape))
        self._latest: TactileReading | None = None
        self.on_exchange: Callable[[SessionState | None, LearnerState | None], None] | None = None
        """Called when the sensors were exchanged, with what was known of the new ones."""

    @property
    def session(self) -> SessionCalibration | None:
        """What is known of today's sensors, up to the last grasp; None if no model asks."""
        self.learn()
        return self._session

    @property
    def axis_ns(self) -> int:
        """`t_ns` less `made_ns` of the latest reading: where the time of a replay is counted from,
        0 of live readings."""
        return 0 if self._latest is None else self._latest.t_ns - self._latest.made_ns

    @property
    def on_request(self) -> bool:
        """Whether a settled grasp is judged only when somebody asks."""
        return self.grip is not None and self.grip.on_request

    def ask(self) -> None:
        """Judge the grasp at hand once it has settled: the controller waits for the verdict."""
        if self.grip is not None:
            self.grip.ask()

    def sensors_exchanged(
        self, session: SessionState | None = None, learned: LearnerState | None = None
    ) -> None:
        """Forget session, tare and grasp: the sensors are others.

        `session` and `learned` are what was known of them when they were there before. Raises
        `ValueError` for ones that are of another model.
        """
        self.memory.opinion = NO_OPINION
        self.memory.is_to_learn = False
        if self._session is not None:
            self._session.reset()
            if session is not None:
                self._session.restore(session)
        if self.trust is not None:
            self.trust.sensors_exchanged(learned)
        if self.grip is not None:
            self.grip.forget()
        if self.on_exchange is not None:
            self.on_exchange(session, learned)

    def knows(self, grasp: GraspId) -> bool:
        """Whether an outcome of a grasp would be taken."""
        return self.trust is not None and grasp in self.trust.ledger

    def outcome(self, grasp: GraspId, *, slipped: bool) -> None:
        """Take in how the lift of a grasp has ended; some 0.1 ms."""
        if self.trust is not None:
            self.trust.outcome(grasp, slipped=slipped)

    def restart(self) -> None:
        """What was said of the grasp at hand no longer counts: another model or gate goes on."""
        memory = self.memory
        memory.opinion, memory.learnt_grasp, memory.doubt = NO_OPINION, 0, NO_DOUBT
        memory.is_to_learn = False
        if self.grip is not None:
            self.grip.restart()

    def memories(self) -> dict[str, dict[str, Any]]:
        """What every part remembers between two readings, all that its next finding depends on.

        By the name of the part, in groups that a judge has wholly or, but for `judge`, not at all.
        The session is not among it.
        """
        judge = {"judge": {"judge": self.memory, "health": self._health.memory}}
        return judge if self.grip is None else judge | self.grip.memories()

    def skip(self) -> None:
        """Readings were left out before the next one: nobody knows what moved meanwhile."""
        if self.grip is not None:
            self.grip.interrupt()

    def observe_joints(self, reading: JointReading) -> None:
        """Take in joint angles."""
        if self.grip is not None:
            self.grip.observe_joints(reading)

    def judge(self, reading: TactileReading) -> Judgement:
        """Judge one reading, as what it is of its grasp. Never raises on bad data."""
        self.learn()
        self._latest = reading
        memory, grasp, counts = self.memory, None, None
        memory.readings += 1
        watched = self._health.watch(reading)
        felt = self._observe(reading, watched)
        if felt.counts is not None:
            session = None if self._session is None else self._session.now
            examined = self._plausibility.examine(felt.counts, watched.broken, session)
            memory.opinion = self._assess(self._network.judge(examined, session), felt.grasp)
            grasp = examined.grasp
            counts = None if any_of(watched.broken) else felt.counts
        elif felt.gate is not GateState.JUDGED:
            memory.opinion = NO_OPINION
        judgement = self._decide(reading.t_ns, watched.reasons, felt, memory.opinion, counts)
        self._remember(judgement.decision, felt)
        if grasp is not None and self._learns and Reason.STALE not in judgement.reasons:
            self._note(grasp, judgement.grasp)
        return judgement

    def watch(self, reading: TactileReading) -> None:
        """Take in a reading that is not to be judged: what repeats it later is not fresh."""
        self._health.watch(reading)

    def silence(self, last_t_ns: int) -> Judgement:
        """Judgement when no reading came for too long; `last_t_ns` is the last one's time."""
        if self.grip is None:
            felt = Felt(self.memory.readings, None, judged=False)
        else:
            felt = self.grip.felt(None)._replace(still_ns=None, motion=None, motion_limits=None)
        return self._decide(last_t_ns, (Reason.STALE,), felt, NO_OPINION)

    def health(self) -> dict[str, Reason]:
        """What is not well now: electrodes such as `ff_7`, fingers, joints, model, session."""
        self.learn()
        broken = self._health.electrodes()
        opinion = self.memory.opinion
        found = dict.fromkeys(opinion.repaired, Reason.ELECTRODE_IMPLAUSIBLE)
        for (finger, place), reason in broken.items():
            found[electrode_name(self._fingers[finger], place)] = reason
        if self.grip is not None:
            untared = [finger for finger in self._fingers if finger not in self.grip.tared]
            found |= dict.fromkeys(untared, Reason.NOT_TARED)
            if self.grip.joints_lost:
                found["joints"] = Reason.JOINTS_LATE
            if self.grip.joints_frozen:
                found["joints"] = Reason.JOINTS_FROZEN
        if Reason.MODEL_FAILED in opinion.reasons:
            found["model"] = Reason.MODEL_FAILED
        if self._session is not None and not self._session.calibrated:
            found["session"] = Reason.NOT_CALIBRATED
        return found

    def learn(self) -> None:
        """Take the grasp that was judged last into the session, if it is over.

        A grasp must be judged by what came before it, however often: else what is like nothing seen
        before would be seen the next time. It takes as long as judging, so the verdict goes first.
        """
        memory, grip = self.memory, self.grip
        if self._session is None or not memory.is_to_learn:
            return
        if grip is None or grip.grasp != memory.learnt_grasp or grip.state in NOT_HELD:
            memory.is_to_learn = False
            self._session.observe(memory.to_learn, slip=memory.to_learn_slip)

    def _assess(self, opinion: Opinion, grasp: int) -> Opinion:
        """The opinion with what it is worth by the outcomes that are known."""
        if self.trust is None or opinion.p_slip is None:
            return opinion
        try:
            assessment = self.trust.judge(
                GraspId(self.boot_id, grasp), opinion.p_slip, opinion.margin, self._network.features
            )
        except ValueError:
            return Opinion(None, (Reason.MODEL_FAILED,), opinion.repaired)
        return Opinion(opinion.p_slip, (), opinion.repaired, opinion.margin, assessment)

    def _remember(self, decision: Decision, felt: Felt) -> None:
        """Keep what was said of a grasp until its outcome is told."""
        assessment, stable = self.memory.opinion.assessment, decision is Decision.STABLE
        if self.trust is None or assessment is None:
            return
        if stable or felt.counts is not None:
            self.trust.note(GraspId(self.boot_id, felt.grasp), assessment, stable=stable)

    def _note(self, counts: NDArray[np.generic], grasp: int) -> None:
        """Keep a grasp for `learn`, once: as judged first, not as it changed since."""
        if self._session is not None and grasp != self.memory.learnt_grasp:
            memory, p_slip = self.memory, self.memory.opinion.p_slip
            slip = None if p_slip is None else p_slip >= self._limits.slip_threshold
            memory.learnt_grasp, memory.is_to_learn = grasp, True
            memory.to_learn, memory.to_learn_slip = counts.astype(np.float64), slip

    def _observe(self, reading: TactileReading, watched: Watched) -> Felt:
        grip = self.grip
        if grip is None:
            return Felt(self.memory.readings, None if watched.reasons else reading.counts)
        grip.observe(reading, watched)
        counts, renews = None, grip.renews
        if not watched.reasons and 0 <= self.clock() - reading.t_ns <= self._limits.max_age_ns:
            counts = grip.counts_to_judge(reading, watched)
            if counts is not None:
                grip.judged()
        return grip.felt(counts, renews=renews)

    def _decide(
        self,
        t_ns: int,
        against: tuple[Reason, ...],
        felt: Felt,
        opinion: Opinion,
        counts: NDArray[np.uint16] | None = None,
    ) -> Judgement:
        health = (*against, *opinion.reasons)
        calibrated = None if self._session is None else self._session.calibrated
        if self._needs_session and calibrated is False:
            health = (*health, Reason.NOT_CALIBRATED)
        assessment = opinion.assessment
        p_slip = opinion.p_slip if assessment is None else assessment.p_slip
        case = Case(
            p_slip=p_slip,
            health=health,
            in_contact=felt.in_contact,
            settled=felt.settled,
            gate=felt.reasons,
            # Taken last, so that a slow inference counts too.
            age_ns=self.clock() - t_ns,
            against_stable=None
            if self.trust is None or assessment is None
            else WITHHELD[self.trust.permission(GraspId(self.boot_id, felt.grasp), assessment)],
        )
        memory, made_ns = self.memory, 0 if self._latest is None else self._latest.made_ns
        judged = felt.counts is not None and p_slip is not None
        said = alone(case, self._limits) if judged else Decision.STABLE
        if said is Decision.STABLE:
            case = memory.doubt.on(case, felt.grasp, made_ns, self._limits)
        else:
            memory.doubt = Doubt(felt.grasp, made_ns, said)
        decision, reasons = decide(case, self._limits)
        known, trust, worth = decision is not Decision.UNKNOWN, self.trust, assessment or self.trust
        return Judgement(
            t_ns=t_ns,
            grasp=felt.grasp,
            decision=decision,
            p_slip=p_slip if known else None,
            reasons=reasons if len(reasons) < 2 else tuple(dict.fromkeys(reasons)),
            judged=felt.judged,
            repaired=opinion.repaired,
            session_calibrated=calibrated,
            gate=felt.gate,
            contact=felt.touching,
            changes=felt.changes,
            still_ms=None if felt.still_ns is None else felt.still_ns / 1e6,
            early=known and felt.early,
            motion=felt.motion,
            motion_limits=felt.motion_limits,
            p_slip_model=opinion.p_slip if known else None,
            outcomes=0 if worth is None else worth.outcomes,
            supervised=(
                assessment is not None
                and assessment.supervised
                and WATCHED_LIFT.issuperset(reasons)
            ),
            risk=None if trust is None else trust.report(),
            judged_counts=counts,
        )
