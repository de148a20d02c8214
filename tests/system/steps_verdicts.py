"""Steps of the system test: what comes out is what was put in, and nothing is lost on the way."""

from __future__ import annotations

import itertools
import json
import math
import statistics
import time
from collections import Counter
from dataclasses import dataclass
from typing import Final

from tests.system.lab import CAN_RATE_HZ, PATIENCE_S, PAYLOAD, Lab, Outcome, StepError
from tests.system.messages import Message

P_SLIP_ERROR_MAX: Final = 0.05
"""Emulation stalls, so a grasp may settle some sweeps later than in a replay: by noise alone its
`p_slip` is up to 0.03 another then."""
CAN_MODEL: Final = "small-electrodes"
"""As in `can.toml`."""
GRASPS: Final = 3
BURST_RATES_HZ: Final = (100.0, 200.0, 400.0, 800.0)
"""Sweeps/s, of which the first that is more than can be judged is the measure of what can be."""
RECORDING: Final = ("--recording", f"{PAYLOAD}/recording.csv", "--loop")
"""Costs a twin less than to make up grasps."""
REPLAY_TIMEOUT_S: Final = 600.0
TRIAL_STATUSES: Final = 15
"""Statuses after which a rate is one that is carried, if it has not overloaded by then."""
OVERLOADED_STATUSES: Final = 5
"""Statuses that tell what is judged of a rate that overloads."""
LOOK_S: Final = 0.5
OVERLOAD_MIN: Final = 3.0
"""By which a rate that is carried is below what is judged at most ..."""
BURST_TIMES: Final = 10.0
"""... and by which another one is above that, at least, but for what a twin can."""
TWIN_MAX_HZ: Final = 1000.0
STEADY_S: Final = 10.0
BURST_S: Final = 10.0


def can_verdicts(lab: Lab) -> Outcome:
    """Whole grasps over the CAN bus have the verdicts that a replay of the same recording gives."""
    replayed = lab.sh(
        f"graspd replay --json --model {CAN_MODEL} {PAYLOAD}/recording.csv", REPLAY_TIMEOUT_S
    )
    verdicts = [json.loads(line) for line in replayed.splitlines()]
    expected = [each["p_slip"] for each in verdicts if each["judged"] and each["valid"]]
    if len(expected) < GRASPS:
        raise StepError(f"a replay of the recording judges {len(expected)} grasps")
    began_s = after_s = lab.now_s()
    lab.twin("--rate", str(CAN_RATE_HZ), *RECORDING)
    judged: list[float] = []
    while len(judged) < GRASPS:
        message = lab.await_message("can", after_s, "a judged grasp", judgement)
        after_s = message.t_s
        if message.body["valid"]:
            judged.append(message.body["p_slip"])
    lab.verdicts("can", began_s, after_s)
    for p_slip in judged:
        if min(abs(p_slip - each) for each in expected) > P_SLIP_ERROR_MAX:
            raise StepError(f"{judged} are not what a replay gives, {expected}")
    return Outcome(f"{len(judged)} grasps have the verdicts of a replay")


def serial_verdicts(lab: Lab) -> Outcome:
    """Whole grasps over the serial port: each is judged once, when it has settled.

    From the start on: they are made all the time.
    """
    began_s = after_s = 0.0
    lab.await_message("serial", began_s, "rest learned", _tared)
    for _ in range(GRASPS):
        judged = lab.await_message("serial", after_s, "a judged grasp", judgement)
        after_s = judged.t_s
    judgements = lab.machine.messages.between("serial", "gate", began_s, after_s)
    grasps = Counter(m.body["grasp"] for m in judgements if m.body["state"] == "judged")
    counters = lab.last("serial", "status")["drivers"]["spi"]
    if counters["bad_crc"] > 1:  # the piece of a frame that was in the line when it was opened
        raise StepError(f"{counters['bad_crc']} damaged frames on the serial port")
    often = max(grasps.values())
    return Outcome(
        f"{len(grasps)} grasps judged, each {'once' if often == 1 else f'up to {often} times'}; "
        f"{counters['readings']} readings, {counters['bad_crc']} damaged frames"
    )


def _tared(message: Message) -> bool:
    return message.kind == "status" and len(message.body["tared"]) == 3


def judgement(message: Message) -> bool:
    """Whether it is the verdict of a grasp that has just been judged."""
    return message.told and bool(message.body["judged"])


@dataclass(frozen=True, slots=True)
class Tally:
    """Counts of frames and readings, while nothing is on its way."""

    boot_id: str
    sent: int
    """Frames that the kernel has carried."""
    taken: int
    """Frames that the daemon has taken in."""
    dropped: int
    """Frames that the kernel could not keep."""
    readings: int
    judged: int
    """Verdicts on readings, from a start that is the same for all tallies: see `Messages`."""
    skipped: int

    def since(self, former: Tally) -> Tally:
        """What was counted after `former`. Raises `StepError` unless all is accounted for."""
        counts = {
            name: getattr(self, name) - getattr(former, name)
            for name in ("sent", "taken", "dropped", "readings", "judged", "skipped")
        }
        more = Tally(self.boot_id, **counts)
        if former.boot_id != self.boot_id:
            raise StepError("was started anew")
        if more.taken + more.dropped != more.sent or more.judged + more.skipped != more.readings:
            raise StepError(f"not accounted for: {more}")
        return more


def can_frames(lab: Lab) -> Outcome:
    """No frame is lost at a rate that is carried, and all are accounted for at ten times that."""
    restarts = lab.show("can", "NRestarts")
    try:
        first = _tally(lab)
        sent_hz, judged_hz = _overloaded_hz(lab)
        carried_hz = judged_hz / OVERLOAD_MIN
        burst_hz = min(max(BURST_TIMES * carried_hz, sent_hz), TWIN_MAX_HZ)
        before = _tally(lab)
        before.since(first)
        lab.twin("--rate", f"{carried_hz:.3f}", *RECORDING)
        lab.await_twin()
        time.sleep(STEADY_S)
        after_steady = _tally(lab)
        steady = after_steady.since(before)
        if steady.dropped:
            raise StepError(f"frames lost at {carried_hz:.1f} Hz: {steady}")
        began_s = lab.now_s()
        lab.twin("--rate", f"{burst_hz:.3f}", *RECORDING)
        lab.await_message("can", began_s, "overloaded", _overloaded)
        time.sleep(BURST_S)
        burst = _tally(lab).since(after_steady)
    finally:
        lab.twin("--rate", str(CAN_RATE_HZ), *RECORDING)
    lab.await_twin()
    lab.await_message("can", lab.now_s(), "no longer overloaded", _calm)
    if lab.show("can", "NRestarts") != restarts:
        raise StepError("was started anew")
    if not burst.skipped:
        raise StepError(f"nothing was left out at {burst_hz:.0f} Hz")
    return Outcome(
        f"{steady.sent} frames at {carried_hz:.0f} Hz: none lost; {burst.sent} at "
        f"{burst_hz:.0f} Hz: {burst.dropped} dropped, {burst.skipped} of "
        f"{burst.readings} readings left out, overloaded, then well again"
    )


def _overloaded_hz(lab: Lab) -> tuple[float, float]:
    """A rate that overloads, and what is judged of it. Raises `StepError` if none does."""
    for rate_hz in BURST_RATES_HZ:
        began_s = lab.now_s()
        lab.twin("--rate", str(rate_hz), *RECORDING)
        lab.await_message("can", began_s, "a verdict")
        statuses: list[Message] = []
        deadline_s = time.monotonic() + PATIENCE_S
        while len(statuses) < TRIAL_STATUSES and time.monotonic() < deadline_s:
            time.sleep(LOOK_S)
            statuses = lab.machine.messages.between("can", "status", began_s, math.inf)
            judged: list[float] = [
                later.body["readings_hz"]
                for former, later in itertools.pairwise(statuses)
                if later.body["skipped_readings"] > former.body["skipped_readings"]
            ]
            if len(judged) >= OVERLOADED_STATUSES and any(map(_overloaded, statuses)):
                return rate_hz, statistics.median(judged)
    raise StepError(f"not overloaded at {BURST_RATES_HZ[-1]} Hz")


def _overloaded(message: Message) -> bool:
    return message.kind == "status" and bool(message.body["overloaded"])


def _calm(message: Message) -> bool:
    return message.kind == "status" and not message.body["overloaded"]


def _tally(lab: Lab) -> Tally:
    """Stop the twin and count when the daemon has taken all that was sent."""
    # What was dropped is told with the frames after it.
    lab.twin("--rate", str(CAN_RATE_HZ), *RECORDING)
    lab.await_twin()
    lab.sh("systemctl stop twin-can")
    now_s = lab.now_s()
    status = lab.await_message(
        "can", now_s, "silence", lambda message: _silent(message) and message.made_s > now_s
    ).body
    counters, interface = status["drivers"]["can"], lab.interface()
    return Tally(
        boot_id=status["boot_id"],
        sent=interface["sent"],
        taken=counters["accepted_frames"],
        dropped=interface["dropped"] + counters["kernel_drops"],
        readings=counters["readings"],
        judged=lab.machine.messages.readings("can"),
        skipped=status["skipped_readings"],
    )


def _silent(message: Message) -> bool:
    return message.kind == "status" and message.body["state"] == "silent"
