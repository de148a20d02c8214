"""The state of one hand, by the messages that came and by how long none came."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from daemon.judge.reasons import ADVICE, WATCHED_LIFT, Decision, GateState, Reason
from daemon.publish.messages import (
    GateMessage,
    OutcomeMessage,
    Status,
    Tactile,
    Verdict,
    decode_gate,
    decode_outcome,
    decode_status,
    decode_tactile,
    decode_verdict,
)
from daemon.watch.evidence import WATCHED, doubt, learning, rests_on, stillness
from daemon.watch.fingers import FingerImage, FingerMotion, Rest, image
from daemon.watch.grasps import OPEN, Grasps
from daemon.watch.snapshot import Line, Session, Snapshot, Timing, Tone
from daemon.watch.timeline import Timeline
from models.contract import Finger
from models.layout import ELECTRODES

SNAPSHOTS_HZ = 10
"""How often a snapshot is taken, 1/s."""
RATE_OVER = SNAPSHOTS_HZ
"""Snapshots that a rate is taken over: a second."""
TACTILE_OLD_NS = 1_000_000_000
"""Images older than this are not shown: they would look alive."""
AS_IT_SHOULD_BE = {
    Reason.NO_CONTACT,
    Reason.MOVING,
    Reason.SETTLING,
    Reason.NOT_TARED,
    Reason.NOT_ASKED,
}
"""Reasons of a grasp that is on its way."""
OVERLOADED = "readings come faster than they are judged: check the PC's load, use a smaller model"
NOTHING_CAME = "no message has come yet: is graspd running on this endpoint?"

Message = Verdict | GateMessage | Tactile | OutcomeMessage | Status
DECODERS: dict[str, Callable[[bytes], Message]] = {
    "verdict": decode_verdict,
    "gate": decode_gate,
    "tactile": decode_tactile,
    "outcome": decode_outcome,
    "status": decode_status,
}
"""By what a topic begins with."""


class View:
    """Takes messages and gives a `Snapshot` at any time. Constant memory, no socket."""

    def __init__(
        self, endpoint: str, hand: str | None = None, wall: Callable[[], float] = time.time
    ) -> None:
        """Of one `hand`, or of the first that is heard of."""
        self.link = "connecting"
        self._endpoint = endpoint
        self._hand = hand
        self._wall = wall
        self._verdict: Verdict | None = None
        self._verdict_ns = 0
        self._gate: GateState | None = None
        self._tactile: Tactile | None = None
        self._tactile_ns = 0
        self._status: Status | None = None
        self._grasps = Grasps()
        self._rests: dict[str, Rest] = {}
        self._received = self._lost = self._not_understood = 0
        self._rate_marks: deque[tuple[int, int]] = deque(maxlen=RATE_OVER + 1)
        self._timeline = Timeline()

    def take(self, topic: bytes, payload: bytes, now_ns: int) -> None:
        """Take one message that arrived at `now_ns`, monotonic ns of this computer."""
        kind, _, hand = topic.decode("ascii", "replace").partition(".")
        decode = DECODERS.get(kind)
        if decode is None or (self._hand is not None and hand != self._hand):
            return
        try:
            message = decode(payload)
        except (msgspec.DecodeError, UnicodeDecodeError):
            self._not_understood += 1
            return
        self._hand = hand
        match message:
            case Verdict():
                self._take_verdict(message, now_ns)
            case GateMessage():
                self._gate = message.state
            case Tactile():
                self._take_tactile(message, now_ns)
            case OutcomeMessage():
                self._grasps.end(message)
            case Status():
                self._status = message

    def _take_verdict(self, verdict: Verdict, now_ns: int) -> None:
        last = self._verdict
        if last is not None and verdict.boot_id == last.boot_id:
            if verdict.seq <= last.seq:
                return  # old or repeated: no sign of life
            self._lost += verdict.seq - last.seq - 1
        self._received += 1
        self._verdict, self._verdict_ns, self._gate = verdict, now_ns, verdict.gate
        self._grasps.take(verdict, now_ns)

    def _take_tactile(self, tactile: Tactile, now_ns: int) -> None:
        if not len(tactile.fingers) == len(tactile.counts) == len(tactile.faults):
            self._not_understood += 1
            return
        self._tactile, self._tactile_ns = tactile, now_ns
        tared = () if self._status is None else self._status.tared or ()
        if self._gate is not GateState.IDLE:
            return
        for index, finger in enumerate(tactile.fingers):
            counts, sound = _arrays(tactile, index)
            if finger in tared and counts is not None:
                self._rests.setdefault(finger, Rest()).learn(counts, sound)

    def snapshot(self, now_ns: int) -> Snapshot:
        """What is to be seen at `now_ns`. Call it `SNAPSHOTS_HZ` times a second."""
        tone, why = self._finding(now_ns)
        verdict = self._verdict
        stands = verdict is not None and tone in {Tone.STABLE, Tone.LEANS, Tone.SLIP}
        p_slip = verdict.p_slip if verdict is not None and stands else None
        said = verdict.verdict.value if verdict is not None and stands else "unknown"
        self._timeline.add(now_ns, tone, p_slip)
        if tone is not Tone.SILENT or not self._rate_marks:
            self._rate_marks.append((now_ns, self._received))
        silent = tone is Tone.SILENT
        status = self._status
        grasps = self._grasps.last(now_ns, None if silent else self._held())
        wall_t = self._wall()
        return Snapshot(
            endpoint=self._endpoint,
            link=self.link,
            hand=self._hand,
            t=wall_t,
            last_t=None if verdict is None else wall_t - (now_ns - self._verdict_ns) / 1e9,
            tone=tone,
            verdict=said,
            headline="leans to stable" if tone is Tone.LEANS else said,
            evidence="" if verdict is None or silent else rests_on(verdict),
            learning=learning(verdict, status),
            p_slip=p_slip,
            why=why,
            grasp=None if verdict is None else verdict.grasp,
            gate=None if self._gate is None or silent else self._gate.value,
            contact=None if verdict is None or silent else _names(verdict.contact),
            still=stillness(None if verdict is None or silent else verdict.still_ms),
            judged=grasps[0] if grasps else None,
            grasps=grasps,
            fingers=[] if silent else self._images(now_ns),
            joints={} if self._tactile is None or silent else self._tactile.joints,
            health=[] if status is None or silent else _health(status),
            repaired=[] if verdict is None or silent else verdict.repaired,
            session=_session(status),
            timing=self._timing(),
            state=None if status is None or silent else status.state.value,
            counts=self._grasps.counts(),
            drivers={} if status is None else status.drivers,
            model=None if verdict is None else f"{verdict.model} {verdict.model_sha}",
            versions={} if status is None else status.versions,
            history=self._timeline.tones,
            history_p=self._timeline.shares,
        )

    def _finding(self, now_ns: int) -> tuple[Tone, list[Line]]:
        """What holds now, by the rule for subscribers: silence means unknown."""
        verdict = self._verdict
        if verdict is None:
            return Tone.SILENT, [Line("silent", NOTHING_CAME), Line("link", self.link)]
        silent_ms = (now_ns - self._verdict_ns) / 1e6
        if silent_ms > verdict.silence_ms:
            long = f"{silent_ms:.0f} ms" if silent_ms < 1e4 else f"{silent_ms / 1e3:.0f} s"
            silence = Line("silent", f"no message for {long}")
            return Tone.SILENT, [silence, Line("link", self.link)]
        if verdict.verdict is Decision.UNKNOWN:
            why = [Line(reason.value, ADVICE[reason]) for reason in verdict.reasons]
            if verdict.supervised and WATCHED_LIFT.issuperset(verdict.reasons):
                return Tone.LEARNING, [WATCHED, *why]
            quiet = AS_IT_SHOULD_BE.issuperset(verdict.reasons)
            return Tone.WAITING if quiet else Tone.TROUBLE, why
        also = [WATCHED] if verdict.supervised else []
        if verdict.session_calibrated is False:
            also.append(Line("less sure", ADVICE[Reason.NOT_CALIBRATED]))
        if verdict.verdict is Decision.SLIP:
            what = "do not lift unwatched" if verdict.supervised else "do not lift"
            return Tone.SLIP, [Line(what, "it is judged to slip; grasp again"), *also]
        why_not = doubt(verdict)
        if why_not is not None or verdict.supervised:
            return Tone.LEANS, [Line("leans to stable", why_not or "supervised"), *also]
        return Tone.STABLE, [Line("lift", "it is judged to hold"), *also]

    def _images(self, now_ns: int) -> list[FingerImage]:
        tactile, verdict = self._tactile, self._verdict
        if tactile is None or now_ns - self._tactile_ns > TACTILE_OLD_NS:
            return []
        contact = None if verdict is None else verdict.contact
        images = []
        for index, finger in enumerate(tactile.fingers):
            counts, sound = _arrays(tactile, index)
            if counts is None:
                continue
            rest = self._rests.get(finger)
            images.append(
                image(
                    finger,
                    counts,
                    sound,
                    None if rest is None else rest.counts,
                    touches=None if contact is None else finger in contact,
                    repaired=() if verdict is None else verdict.repaired,
                    motion=_motion(verdict, finger),
                )
            )
        return images

    def _held(self) -> tuple[str, int] | None:
        verdict = self._verdict
        return None if verdict is None or self._gate in OPEN else (verdict.boot_id, verdict.grasp)

    def _timing(self) -> Timing:
        verdict, status = self._verdict, self._status
        (first_ns, before), (last_ns, received) = self._rate_marks[0], self._rate_marks[-1]
        elapsed_s = (last_ns - first_ns) / 1e9
        delays = {} if status is None else status.latency_us
        return Timing(
            verdicts_hz=(received - before) / elapsed_s if elapsed_s > 0.0 else 0.0,
            readings_hz=None if status is None else status.readings_hz,
            age_ms=None if verdict is None else verdict.age_ms,
            p50_us=delays.get("p50"),
            p99_us=delays.get("p99"),
            max_us=delays.get("max"),
            jitter_p99_us=None if status is None else status.jitter_us.get("p99"),
            late=None if status is None else status.late_readings,
            worst_age_ms=None if status is None else status.worst_age_ms,
            lost=self._lost,
            not_understood=self._not_understood,
        )


def _arrays(tactile: Tactile, index: int) -> tuple[NDArray[np.float64] | None, NDArray[np.bool_]]:
    """Counts of a finger, None if they are not 24, and which of them are sound; shapes (24,)."""
    counts, faults = tactile.counts[index], tactile.faults[index]
    if not len(counts) == len(faults) == ELECTRODES:
        return None, np.zeros(ELECTRODES, dtype=np.bool_)
    return np.array(counts, dtype=np.float64), np.array(faults) == 0


def _motion(verdict: Verdict | None, finger: Finger) -> FingerMotion | None:
    if verdict is None or verdict.motion is None:
        return None
    limit = (verdict.motion_limits or {}).get(finger, 0.0)
    return FingerMotion(now=verdict.motion.get(finger) if limit > 0.0 else None, limit=limit)


def _names(fingers: Sequence[str] | None) -> list[str] | None:
    return None if fingers is None else list(fingers)


def _health(status: Status) -> list[Line]:
    found = [Line("overloaded", OVERLOADED)] if status.overloaded else []
    return found + [
        Line(f"{part} {reason.value}", ADVICE[reason]) for part, reason in status.health.items()
    ]


def _session(status: Status | None) -> Session | None:
    if status is None or status.session_grasps is None:
        return None
    return Session(grasps=status.session_grasps, calibrated=bool(status.session_calibrated))
