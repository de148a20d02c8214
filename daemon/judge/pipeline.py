"""Reading in, judgement out: health, grip, plausibility, network, decision, in this order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daemon.judge.decision import Case, Limits, decide
from daemon.judge.health import Health, Watched
from daemon.judge.network import Network
from daemon.judge.plausibility import Plausibility
from daemon.judge.reasons import GateState, Outcome, Reason
from drivers.base import JointReading, TactileReading
from models.contract import Finger, ModelError, SessionInput
from models.electrodes import Electrodes
from models.inputs import SessionBuilder
from models.runtime import TactileModel

if TYPE_CHECKING:
    from daemon.judge.calibration import SessionCalibration
    from daemon.judge.gate import GateChange
    from daemon.judge.grip import Grip, GripLimits


@dataclass(frozen=True, slots=True)
class Judgement:
    """What was found about one reading, or about the lack of one."""

    t_ns: int
    """Monotonic time, ns, of the reading's last byte."""
    grasp: int
    outcome: Outcome
    p_slip: float | None
    """None exactly when the outcome is unknown."""
    reasons: tuple[Reason, ...]
    judged: bool = True
    """Whether the network judged, or would have judged, this very reading."""
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
    judged_counts: NDArray[np.uint16] | None = field(default=None, compare=False, repr=False)
    """Shape (fingers, 24): what the network judged, before any repair; None if it did not judge
    this very reading, or if electrodes of it are broken."""


@dataclass(frozen=True, slots=True)
class Opinion:
    """What the network said of a grasp, and what stands against its being asked."""

    p_slip: float | None
    reasons: tuple[Reason, ...]
    repaired: tuple[str, ...] = ()


NO_OPINION = Opinion(None, ())


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
    ) -> None:
        """`clock` gives monotonic ns; without `grip` each reading is a grasp.

        With `learns` false the session stays what it is; with `needs_session` nothing is judged
        before it is calibrated. Raises `ModelError` if the model is for other fingers.
        """
        if model.contract.fingers != tuple(fingers):
            raise ModelError(
                f"{model.path}: judges the fingers {', '.join(model.contract.fingers)} "
                f"in this order, the hand has {', '.join(fingers)}"
            )
        electrodes = Electrodes(model.contract.seen)
        self._session = _session(model, electrodes)
        self._limits = limits
        self._clock = clock
        self._learns = learns
        self._needs_session = needs_session
        self._fingers = tuple(fingers)
        self._health = Health(len(fingers))
        self._plausibility = Plausibility(model.contract.seen, electrodes, self._session)
        self._network = Network(model, self._session, limits.slip_threshold)
        self.grip = None if grip is None else _grip(fingers, grip)
        """None where each reading is a grasp."""
        self._readings = 0
        self._learnt_grasp = 0
        self._to_learn: NDArray[np.generic] | None = None
        self._opinion = NO_OPINION
        self._latest: TactileReading | None = None
        self.on_exchange: Callable[[], None] | None = None
        """Done when the sensors were exchanged."""

    @property
    def session(self) -> SessionCalibration | None:
        """With all that was judged; None for a model that needs none."""
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
        """The controller wants to know."""
        if self.grip is not None:
            self.grip.ask()

    def sensors_exchanged(self) -> None:
        """What is known of the sensors, and of what they hold, no longer counts."""
        self._opinion = NO_OPINION
        self._to_learn = None
        if self._session is not None:
            self._session.reset()
        if self.grip is not None:
            self.grip.forget()
        if self.on_exchange is not None:
            self.on_exchange()

    def skip(self) -> None:
        """Readings were left out before the next one: nobody knows what moved meanwhile."""
        if self.grip is not None:
            self.grip.interrupt()

    def turn(self, reading: JointReading) -> None:
        """Take in joint angles."""
        if self.grip is not None:
            self.grip.turn(reading)

    def judge(self, reading: TactileReading) -> Judgement:
        """Judge one reading, as what it is of its grasp. Never raises on bad data."""
        self.learn()
        self._readings += 1
        self._latest = reading
        watched = self._health.watch(reading)
        counts = self._counts_to_judge(reading, watched)
        judged = counts is not None or self.grip is None
        grasp = judged_counts = None
        if counts is not None:
            self._opinion, grasp = self._consider(counts, watched)
            judged_counts = None if np.count_nonzero(watched.broken) else counts
            if self.grip is not None:
                self.grip.judged()
        elif self.grip is None or self.grip.state is not GateState.JUDGED:
            self._opinion = NO_OPINION
        judgement = self._judgement(
            reading.t_ns, watched.reasons, self._opinion, judged=judged, counts=judged_counts
        )
        if grasp is not None and self._learns and Reason.STALE not in judgement.reasons:
            self._note(grasp, judgement.grasp)
        return judgement

    def silence(self, last_t_ns: int) -> Judgement:
        """Judgement when no reading came for too long; `last_t_ns` is the last one's time."""
        return self._judgement(last_t_ns, (Reason.STALE,), NO_OPINION, judged=False)

    def health(self) -> dict[str, Reason]:
        """What is not well now: electrodes such as `ff_7`, fingers, joints, model, session."""
        self.learn()
        broken = self._health.electrodes()
        found = dict.fromkeys(self._opinion.repaired, Reason.ELECTRODE_IMPLAUSIBLE)
        found |= {self._name(*place): reason for place, reason in broken.items()}
        if self.grip is not None:
            untared = [finger for finger in self._fingers if finger not in self.grip.tared]
            found |= dict.fromkeys(untared, Reason.NOT_TARED)
            if self.grip.joints_lost:
                found["joints"] = Reason.JOINTS_LATE
        if Reason.MODEL_FAILED in self._opinion.reasons:
            found["model"] = Reason.MODEL_FAILED
        if self._session is not None and not self._session.calibrated:
            found["session"] = Reason.NOT_CALIBRATED
        return found

    def _counts_to_judge(
        self, reading: TactileReading, watched: Watched
    ) -> NDArray[np.uint16] | None:
        """The counts, if this reading is one to judge."""
        if self.grip is None:
            return None if watched.reasons else reading.counts
        self.grip.feel(reading, watched)
        if watched.reasons or not 0 <= self._age_ns(reading.t_ns) <= self._limits.max_age_ns:
            return None
        return self.grip.counts_to_judge(reading, watched)

    def _consider(
        self, counts: NDArray[np.uint16], watched: Watched
    ) -> tuple[Opinion, NDArray[np.generic] | None]:
        """What the network says of counts (fingers, 24), and what the session may learn."""
        findings = self._plausibility.examine(counts, watched.broken)
        p_slip, reasons = None, findings.reasons
        if not reasons:
            p_slip, reasons = self._network.judge(findings.counts)
        repaired = [] if findings.repaired is None else np.argwhere(findings.repaired).tolist()
        names = tuple(self._name(finger, place) for finger, place in repaired)
        return Opinion(p_slip, reasons, names), findings.grasp

    def _note(self, counts: NDArray[np.generic], grasp: int) -> None:
        """Remember to learn a grasp, as it was before the lift and not as it changed since."""
        if self._session is not None and grasp != self._learnt_grasp:
            self._learnt_grasp = grasp
            self._to_learn = counts

    def learn(self) -> None:
        """Take what was judged last into the session; at the latest the next reading does it.

        That takes as long as judging, so it waits until the verdict is out; and a grasp must be
        judged by what came before it.
        """
        if self._session is not None and self._to_learn is not None:
            counts, self._to_learn = self._to_learn, None
            self._session.observe(counts)

    def _judgement(
        self,
        t_ns: int,
        against: tuple[Reason, ...],
        opinion: Opinion,
        *,
        judged: bool,
        counts: NDArray[np.uint16] | None = None,
    ) -> Judgement:
        grip = self.grip
        health = (*against, *opinion.reasons)
        calibrated = None if self._session is None else self._session.calibrated
        if self._needs_session and calibrated is False:
            health = (*health, Reason.NOT_CALIBRATED)
        case = Case(
            p_slip=opinion.p_slip,
            health=health,
            in_contact=grip is None or grip.in_contact,
            settled=grip is None or grip.settled,
            gate=() if grip is None else grip.reasons,
            # Taken last, so that a slow inference counts too.
            age_ns=self._age_ns(t_ns),
        )
        outcome, reasons = decide(case, self._limits)
        return Judgement(
            t_ns=t_ns,
            grasp=self._readings if grip is None else grip.grasp,
            outcome=outcome,
            p_slip=None if outcome is Outcome.UNKNOWN else opinion.p_slip,
            reasons=tuple(dict.fromkeys(reasons)),
            judged=judged,
            repaired=opinion.repaired,
            session_calibrated=calibrated,
            gate=None if grip is None else grip.state,
            contact=None if grip is None else grip.touching,
            changes=() if grip is None else tuple(grip.take_changes()),
            judged_counts=counts,
        )

    def _age_ns(self, t_ns: int) -> int:
        return self._clock() - t_ns

    def _name(self, finger: int, electrode: int) -> str:
        return f"{self._fingers[finger]}_{electrode + 1}"


def _grip(fingers: Sequence[Finger], limits: GripLimits) -> Grip:
    """Imported only where the scene has a gate."""
    from daemon.judge.grip import Grip

    return Grip(fingers, limits)


def _session(model: TactileModel, electrodes: Electrodes) -> SessionCalibration | None:
    """Imported only where the model has a session."""
    wanted, inputs = model.contract.input, model.inputs
    if not (isinstance(wanted, SessionInput) and isinstance(inputs, SessionBuilder)):
        return None
    from daemon.judge.calibration import SessionCalibration

    return SessionCalibration(wanted, inputs, electrodes.centre, electrodes.spread)
