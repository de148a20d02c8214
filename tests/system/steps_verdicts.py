"""Steps of the system test: verdicts on known grasps over both links, and no loss of frames."""

from __future__ import annotations

import json
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Final

from tests.kit.programs import ran
from tests.system.lab import RATE_HZ, Lab, Outcome, StepError
from tests.system.messages import Message
from tests.system.payload import write_recording

P_SLIP_ERROR_MAX: Final = 0.05
"""Largest difference of `p_slip` from a replay's: under emulation a grasp may settle some sweeps
later, and noise then changes `p_slip` by up to 0.03."""
CAN_MODEL: Final = "small-electrodes"
"""Model that `can.toml` names."""
GRASPS: Final = 3


def can_verdicts(lab: Lab) -> Outcome:
    """Check that the first grasps over CAN have a replay's verdicts, and no frame was lost."""
    expected = _replayed()
    after_s = 0.0
    judged: list[float] = []
    while len(judged) < GRASPS:
        message = lab.await_message("can", after_s, "a judged grasp", judgement)
        after_s = message.t_s
        if message.body["valid"]:
            judged.append(message.body["p_slip"])
    lab.verdicts("can", 0.0, after_s)
    for p_slip in judged:
        if min(abs(p_slip - each) for each in expected) > P_SLIP_ERROR_MAX:
            raise StepError(f"{judged} are not what a replay gives, {expected}")
    counters, interface = lab.last("can", "status")["drivers"]["can"], lab.interface()
    dropped = interface["dropped"] + counters["kernel_drops"]
    if dropped:
        raise StepError(f"{dropped} of {interface['sent']} frames lost at {RATE_HZ:g} Hz")
    return Outcome(
        f"{len(judged)} grasps have the verdicts of a replay; of {interface['sent']} frames at "
        f"{RATE_HZ:g} Hz none is lost"
    )


def _replayed() -> list[float]:
    """Replay the recording on the host; return `p_slip` of its grasps. Raises `StepError`."""
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "recording.csv"
        write_recording(recording)
        command = ["replay", "--json", "--model", CAN_MODEL, recording]
        done = ran(sys.executable, "-m", "graspd", *command)
    verdicts = [json.loads(line) for line in done.stdout.splitlines()]
    expected = [each["p_slip"] for each in verdicts if each["judged"] and each["valid"]]
    if done.returncode or len(expected) < GRASPS:
        raise StepError(
            f"a replay judges {len(expected)} grasps ({done.returncode}): {done.stderr}"
        )
    return expected


def serial_verdicts(lab: Lab) -> Outcome:
    """Wait until grasps over the serial port since the start are judged, one of them validly.

    The outcome says how often each was judged.
    """
    began_s = after_s = 0.0
    lab.await_message("serial", began_s, "rest learned", _tared)
    for _ in range(GRASPS):
        judged = lab.await_message("serial", after_s, "a judged grasp", judgement)
        after_s = judged.t_s
    # What `disk_full` replays must hold one.
    lab.await_message("serial", began_s, "a valid verdict", _valid)
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
    """True if the message is the verdict by which a grasp is judged."""
    return message.told and bool(message.body["judged"])


def _valid(message: Message) -> bool:
    return judgement(message) and bool(message.body["valid"])
