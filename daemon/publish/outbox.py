"""Make messages from judgements, send them, and count late verdicts."""

from __future__ import annotations

import math
import sys
import time
import uuid
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, Protocol

import onnxruntime

from graspd.biotac import Finger
from graspd.daemon import version
from graspd.daemon.judge.decision import JOINTS_LATE_NS
from graspd.daemon.judge.pipeline import Judgement, Pipeline
from graspd.daemon.judge.reasons import Decision, GateChange, Moment, Reason
from graspd.daemon.publish.messages import (
    DECISION_CODE,
    GateMessage,
    LearnerHealth,
    Lifts,
    OutcomeMessage,
    RiskReport,
    State,
    Status,
    Tactile,
    Verdict,
    encode,
)
from graspd.daemon.trust.lift_book import Report
from graspd.drivers.base import TactileReading

if TYPE_CHECKING:
    from graspd.daemon.trust.trust import Trust

SHA_DIGITS = 12
BUCKET_RATIO = 1.02
"""Ratio of a bucket's two ends, so percentiles are exact to 2 %."""
FLOOR_US = 0.1
"""Lower end of the first bucket, us; shorter durations count in it too."""
BUCKETS = math.ceil(math.log(1e8 / FLOOR_US) / math.log(BUCKET_RATIO)) + 1
"""Number of buckets, up to 100 s."""
OUTAGE_PERIODS = 10
"""Number of periods without a reading that count as silence instead of jitter."""


class LatencyHistogram:
    """Histogram of durations, us, with buckets of equal ratio, in constant memory."""

    def __init__(self) -> None:
        self.buckets = [0] * BUCKETS
        self.count = 0
        self.max_us = 0.0

    def add(self, duration_us: float) -> None:
        index = 0
        if duration_us > FLOOR_US:
            index = int(math.log(duration_us / FLOOR_US) / math.log(BUCKET_RATIO))
        self.buckets[index if index < BUCKETS else -1] += 1
        self.count += 1
        if duration_us > self.max_us:
            self.max_us = duration_us

    def quantile_us(self, fraction: float) -> float:
        """Return the quantile at `fraction`, 0..1, of the durations, us; 0 if there are none."""
        rank = math.ceil(fraction * self.count)
        below = 0
        for index, durations in enumerate(self.buckets):
            below += durations
            if below >= rank and durations:
                return min(FLOOR_US * BUCKET_RATIO ** (index + 1), self.max_us)
        return 0.0

    def spread_us(self) -> dict[Literal["p50", "p99", "max"], float]:
        return {"p50": self.quantile_us(0.5), "p99": self.quantile_us(0.99), "max": self.max_us}


class Deadlines:
    """Counts late verdicts and the jitter of readings since the start."""

    def __init__(self) -> None:
        self.jitter = LatencyHistogram()
        """Differences of the time between two readings and the driver's period, us."""
        self.late = 0
        """Number of readings whose verdict came more than a period after their last byte."""
        self.worst_age_ms = 0.0
        """Longest time from a reading's last byte to its verdict, ms."""
        self._last_seq = -1
        self._last_ns = 0

    def add(self, reading: TactileReading, age_ms: float, period_ns: int | None) -> None:
        """Count a reading whose verdict came `age_ms` after its last byte.

        `period_ns`: time between two readings of the sensor, ns; None: not known, and neither late
        verdicts nor jitter are counted.
        """
        if age_ms > self.worst_age_ms:
            self.worst_age_ms = age_ms
        if period_ns is not None:
            self.late += age_ms * 1e6 > period_ns
            elapsed_ns = reading.t_ns - self._last_ns
            in_a_row = reading.seq == self._last_seq + 1 and self._last_seq >= 0
            if in_a_row and elapsed_ns < OUTAGE_PERIODS * period_ns:
                self.jitter.add(abs(elapsed_ns - period_ns) / 1e3)
        self._last_seq, self._last_ns = reading.seq, reading.t_ns


class Output(Protocol):
    """Takes finished messages: sockets, a recorder."""

    def send(self, topic: bytes, payload: bytes) -> None:
        """Pass one message on, without blocking."""

    def wanted(self, topic: bytes) -> bool:
        """Return True if a message of this topic is to be sent now."""


class Outbox:
    """Makes, numbers and sends the messages of one run of the daemon."""

    def __init__(
        self,
        hand: str,
        fingers: Sequence[Finger],
        model: str,
        model_sha256: str,
        outputs: Sequence[Output],
        clock: Callable[[], int] = time.monotonic_ns,
        wall_clock: Callable[[], float] = time.time,
        *,
        boot_id: str | None = None,
    ) -> None:
        """`hand`: its name in the topics. `model`, `model_sha256`: name and checksum of the model.
        `outputs`: get each message. `clock` returns monotonic ns, `wall_clock` seconds since 1970.

        `boot_id`: id of this start in all messages; None: a new one.
        """
        self._latency = LatencyHistogram()
        self._deadlines = Deadlines()
        self._decisions: Counter[Decision] = Counter()
        self._reasons: Counter[Reason] = Counter()
        self._repaired: Counter[str] = Counter()
        kinds = "verdict", "gate", "tactile", "outcome", "status"
        self._topics = {kind: f"{kind}.{hand}".encode() for kind in kinds}
        self._sent: Counter[str] = Counter()
        self._fingers = tuple(fingers)
        self._model = model
        self._model_sha = model_sha256[:SHA_DIGITS]
        self._outputs = tuple(outputs)
        self._clock = clock
        self._wall_clock = wall_clock
        self.boot_id = uuid.uuid4().hex if boot_id is None else boot_id
        self._versions = {
            "graspd": version(),
            "onnxruntime": onnxruntime.__version__,
            "python": sys.version.split()[0],
        }

    def verdict(
        self,
        judgement: Judgement,
        received_ns: int,
        silence_ns: int,
        reading: TactileReading | None = None,
        period_ns: int | None = None,
    ) -> tuple[Verdict, bytes]:
        """Send the changes of the gate, then the verdict; return the verdict, plain and encoded.

        `received_ns`: when the driver handed the reading over, monotonic. `silence_ns`: time
        without a message after which subscribers must count the grasp as unknown. `reading`: the
        judged one, None after silence. `period_ns`: period of its sensor, by which it counts as
        late; None: not known.
        """
        moment, worth = judgement.moment, judgement.assessment
        valid = judgement.decision is not Decision.UNKNOWN
        for change in moment.changes:
            self._gate_change(judgement.t_ns, moment, change)
        now_ns = self._clock()
        latency_us = max(now_ns - received_ns, 0) / 1e3
        age_ms = max(now_ns - judgement.t_ns, 0) / 1e6
        message = Verdict(
            **self._head("verdict"),
            t_mono_ns=judgement.t_ns,
            grasp=moment.grasp,
            verdict=judgement.decision,
            verdict_code=DECISION_CODE[judgement.decision],
            p_slip=judgement.p_slip,
            valid=valid,
            reasons=list(judgement.reasons),
            age_ms=age_ms,
            latency_us=latency_us,
            repaired=list(judgement.opinion.repaired),
            session_calibrated=judgement.session_calibrated,
            judged=moment.judged,
            gate=moment.state,
            contact=None if moment.touching is None else list(moment.touching),
            silence_ms=silence_ns / 1e6,
            model=self._model,
            model_sha=self._model_sha,
            p_slip_model=judgement.opinion.p_slip if valid else None,
            outcomes=0 if worth is None else worth.outcomes,
            supervised=judgement.supervised,
            risk=None if judgement.risk is None else RiskReport(*judgement.risk),
            early=(valid or judgement.supervised) and moment.early,
            still_ms=moment.still_ms,
            motion=moment.motion,
            motion_limits=moment.motion_limits,
            fingers=moment.fingers,
        )
        self._latency.add(latency_us)
        if reading is not None:
            self._deadlines.add(reading, age_ms, period_ns)
        self._decisions[judgement.decision] += 1
        if judgement.reasons:
            self._reasons.update(judgement.reasons)
        if judgement.opinion.repaired:
            self._repaired.update(judgement.opinion.repaired)
        payload = encode(message)
        self._send("verdict", payload)
        return message, payload

    def outcome(self, report: Report) -> None:
        """Send how the lift of a grasp ended."""
        boot_id, grasp = report.grasp
        message = OutcomeMessage(
            **self._head("outcome"),
            t_mono_ns=self._clock(),
            grasp=grasp,
            outcome="slip" if report.outcome == "slip" else "stable",
            object=report.object_name,
            grasp_boot_id=None if boot_id == self.boot_id else boot_id,
        )
        self._send("outcome", encode(message))

    def tactile(self, reading: TactileReading, joints: Mapping[str, tuple[int, float]]) -> None:
        """Send a reading to the outputs whose `wanted` is True now.

        `joints`: time, ns, and value, rad, of the newest angle of each joint; none is sent late.
        """
        topic = self._topics["tactile"]
        wanting = [output for output in self._outputs if output.wanted(topic)]
        if not wanting:
            return
        message = Tactile(
            **self._head("tactile"),
            t_mono_ns=reading.t_ns,
            fingers=list(self._fingers),
            counts=reading.counts.tolist(),
            faults=reading.faults.tolist(),
            joints={
                name: angle_rad
                for name, (made_ns, angle_rad) in joints.items()
                if abs(reading.made_ns - made_ns) <= JOINTS_LATE_NS
            },
        )
        payload = encode(message)
        for output in wanting:
            output.send(topic, payload)

    def _head(self, kind: str) -> dict[str, Any]:
        """Return a message's `boot_id`, the next `seq` of its kind, and the wall-clock time `t`."""
        seq = self._sent[kind]
        self._sent[kind] += 1
        return {"boot_id": self.boot_id, "seq": seq, "t": self._wall_clock()}

    def _send(self, kind: str, payload: bytes) -> None:
        for output in self._outputs:
            output.send(self._topics[kind], payload)

    def _gate_change(self, t_ns: int, moment: Moment, change: GateChange) -> None:
        message = GateMessage(
            **self._head("gate"),
            t_mono_ns=t_ns,
            grasp=change.grasp,
            former=change.former,
            state=change.state,
            cause=change.cause,
            still_ms=moment.still_ms,
            motion=moment.motion,
            motion_limits=moment.motion_limits,
        )
        self._send("gate", encode(message))

    def status(
        self,
        state: State,
        readings_hz: float,
        drivers: dict[str, dict[str, int]],
        pipeline: Pipeline,
        beside: dict[str, Reason],
        *,
        skipped_readings: int,
        overloaded: bool,
    ) -> Status:
        """Send and return one status.

        `drivers`: counters of drivers and companions, by part. `beside`: current problems of
        companions, by part; `pipeline` tells its own.
        """
        session, hand, trust = pipeline.session, pipeline.hand, pipeline.trust
        deadlines = self._deadlines
        health = pipeline.health() | beside
        if state is State.SILENT:
            health["link"] = Reason.STALE
        message = Status(
            **self._head("status"),
            t_mono_ns=self._clock(),
            state=state,
            readings_hz=readings_hz,
            verdicts={decision: self._decisions[decision] for decision in Decision},
            reasons=dict(self._reasons),
            drivers=drivers,
            repaired=dict(self._repaired),
            session_grasps=None if session is None else session.grasps,
            session_calibrated=None if session is None else session.calibrated,
            gate=hand.state,
            tared=None if hand.tared is None else list(hand.tared),
            health=health,
            latency_us=self._latency.spread_us(),
            jitter_us=deadlines.jitter.spread_us() if deadlines.jitter.count else {},
            late_readings=deadlines.late,
            worst_age_ms=deadlines.worst_age_ms,
            skipped_readings=skipped_readings,
            overloaded=overloaded,
            lifts=None if trust is None else _lifts(trust),
            learner=None if trust is None else _learner(trust),
            model=self._model,
            model_sha=self._model_sha,
            versions=self._versions,
        )
        self._send("status", encode(message))
        return message


def _lifts(trust: Trust) -> Lifts:
    book, target = trust.lifts, trust.risk.limits.max_slip_when_stable
    return Lifts(
        reported=trust.risk.lifts,
        outstanding=book.outstanding,
        unreported=book.unreported,
        announced=book.announced,
        awaited=book.awaited,
        covered=None if target is None else book.announced > 0,
    )


def _learner(trust: Trust) -> LearnerHealth:
    return LearnerHealth(
        enabled=trust.learns,
        outcomes=trust.learner.outcomes,
        told=dict(trust.lifts.told),
        uncertainty=trust.learner.uncertainty,
    )
