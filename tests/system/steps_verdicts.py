"""Steps of the system test: what comes out is what was put in, and nothing is lost on the way."""

from __future__ import annotations

import json
import math
import time
from collections import Counter
from typing import Final

from tests.system.lab import CAN_RATE_HZ, LOOK_S, PATIENCE_S, PAYLOAD, Lab, Outcome, StepError
from tests.system.messages import Message

REPLAYED_ROWS: Final = 60
"""Verdicts in a row that are compared with a replay."""
P_SLIP_ERROR_MAX: Final = 1e-5
"""Same counts, same network, same processor: only the text of a number may round."""
GRASPS: Final = 3
SETTLING_S: Final = 2.0
"""After a twin's end: for what is on its way."""
BURST_RATE_HZ: Final = 100.0
BURST_S: Final = 10.0


def can_verdicts(lab: Lab) -> Outcome:
    """Each reading of the CAN bus has the verdict that a replay of the same recording gives."""
    recording = f"{PAYLOAD}/recording.csv"
    replayed = lab.sh(f"graspd replay --json --session off {recording}", 180.0)
    expected = [json.loads(line)["p_slip"] for line in replayed.splitlines()]
    began_s = lab.now_s()
    lab.twin("--rate", str(CAN_RATE_HZ), "--recording", recording, "--loop")
    lab.await_message("can", began_s, "a verdict")
    judged = _run_of_judged(lab, began_s)
    at = _place(judged, expected)
    if at is None:
        raise StepError(f"{judged[:5]} and so on are not what a replay gives")
    return Outcome(f"{len(judged)} verdicts in a row are those of a replay, from row {at + 1} on")


def _run_of_judged(lab: Lab, began_s: float) -> list[float]:
    """`p_slip` of readings in a row, none of which came late: emulation stalls now and then."""
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        run: list[float] = []
        for message in lab.verdicts("can", began_s, math.inf):
            run = [*run, message.body["p_slip"]] if message.judged else []
            if len(run) == REPLAYED_ROWS:
                return run
        time.sleep(LOOK_S)
    raise StepError(f"no {REPLAYED_ROWS} verdicts in a row: {lab.last('can', 'status')['reasons']}")


def _place(judged: list[float], expected: list[float]) -> int | None:
    """From which row of the recording, played in a loop, the judgements are; None if of none."""
    for at in range(len(expected)):
        rows = (expected[(at + row) % len(expected)] for row in range(len(judged)))
        if all(abs(a - b) <= P_SLIP_ERROR_MAX for a, b in zip(judged, rows, strict=True)):
            return at
    return None


def serial_verdicts(lab: Lab) -> Outcome:
    """Whole grasps over the serial port: each is judged once, when it has settled."""
    began_s = after_s = lab.now_s()
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
    return message.judged and bool(message.body["judged"])


def can_frames(lab: Lab) -> Outcome:
    """The kernel's count of frames on the bus is the daemon's count of frames taken in."""
    try:
        steady = _lossless(lab)
        lab.twin("--rate", str(BURST_RATE_HZ))
        time.sleep(BURST_S)
        burst = _lossless(lab) - steady
    finally:
        lab.twin("--rate", str(CAN_RATE_HZ))
    return Outcome(f"{steady} frames steady, {burst} as fast as the twin can: none lost")


def _lossless(lab: Lab) -> int:
    """Frames so far, after the twin was stopped. Raises `StepError` if one was lost."""
    lab.sh("systemctl stop twin-can")
    time.sleep(SETTLING_S)
    now_s = lab.now_s()
    status = lab.await_message("can", now_s, "a status", lambda m: m.kind == "status")
    counters = status.body["drivers"]["can"]
    interface = lab.interface()
    sent, taken = interface["sent"], counters["accepted_frames"]
    dropped = interface["dropped"] + counters["kernel_drops"]
    if dropped or taken != sent:
        raise StepError(f"{sent} frames sent, {taken} taken, {dropped} dropped")
    return sent
