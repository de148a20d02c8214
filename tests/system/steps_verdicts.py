"""Steps of the system test: what comes out is what was put in, and nothing is lost on the way."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.system.lab import RATE_HZ, Lab, Outcome, StepError
from tests.system.messages import Message
from tests.system.payload import write_recording

P_SLIP_ERROR_MAX: Final = 0.05
"""Emulation stalls, so a grasp may settle some sweeps later than in a replay: by noise alone its
`p_slip` is up to 0.03 another then."""
CAN_MODEL: Final = "small-electrodes"
"""As in `can.toml`."""
GRASPS: Final = 3
QUOTAS: Final = (20, 10, 5, 2)
"""Percent of a processor that the daemon gets; the first that overloads it is taken.

The smallest is for a host so busy that the twin sends few sweeps."""
BURST_HZ: Final = 30.0
"""Sweeps/s that are to overload it: the twin on a busy host can send them."""
OVERLOADS_IN_S: Final = 30.0
"""A daemon that skips readings calls that overload after 3 s. The process that sends its messages
gets no more of the processor."""
BURST_S: Final = 10.0


def can_verdicts(lab: Lab) -> Outcome:
    """Grasps that came over CAN so far have the verdicts of a replay, and no frame was lost."""
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
    carried = _tally(lab)
    carried = carried.since(Tally(carried.boot_id))
    if carried.dropped:
        raise StepError(f"frames lost at {RATE_HZ:g} Hz: {carried}")
    return Outcome(
        f"{len(judged)} grasps have the verdicts of a replay; of {carried.sent} frames at "
        f"{RATE_HZ:g} Hz none is lost"
    )


def _replayed() -> list[float]:
    """Replay the recording on the host; return p_slip of its grasps."""
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "recording.csv"
        write_recording(recording)
        command = ["replay", "--json", "--model", CAN_MODEL, str(recording)]
        done = subprocess.run(
            [sys.executable, "-m", "graspd", *command], capture_output=True, text=True, check=False
        )
    verdicts = [json.loads(line) for line in done.stdout.splitlines()]
    expected = [each["p_slip"] for each in verdicts if each["judged"] and each["valid"]]
    if done.returncode or len(expected) < GRASPS:
        raise StepError(
            f"a replay judges {len(expected)} grasps ({done.returncode}): {done.stderr}"
        )
    return expected


def serial_verdicts(lab: Lab) -> Outcome:
    """Whole grasps over the serial port: each is judged once, when it has settled.

    From the start on: they are made all the time.
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
    """Whether it is the verdict of a grasp that has just been judged."""
    return message.told and bool(message.body["judged"])


def _valid(message: Message) -> bool:
    return judgement(message) and bool(message.body["valid"])


@dataclass(frozen=True, slots=True)
class Tally:
    """Counts of frames and readings, while nothing is on its way."""

    boot_id: str
    sent: int = 0
    """Frames that the kernel has carried."""
    taken: int = 0
    """Frames that the daemon has taken in."""
    dropped: int = 0
    """Frames that the kernel could not keep."""
    readings: int = 0
    judged: int = 0
    """Verdicts on readings, from a start that is the same for all tallies: see `Messages`."""
    skipped: int = 0

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


def can_overload(lab: Lab) -> Outcome:
    """All frames and readings are accounted for under overload, and then all is well again.

    The processor time of the daemon is limited: a busy host could not send fast enough. Realtime
    threads know no such limit, so the daemon gives up its priority; `killed` starts another one.
    """
    restarts, pid = lab.show("can", "NRestarts"), lab.show("can", "MainPID")
    try:
        before = _tally(lab)
        lab.sh(f"systemctl service-watchdogs no; chrt --all-tasks --other --pid 0 {pid}")
        quota = _overload(lab)
        # What was dropped is told with the frames after it.
        lab.await_new_reading("can")
        burst = _tally(lab).since(before)
    finally:
        lab.sh("systemctl service-watchdogs yes")
        lab.twin(RATE_HZ)
    if not burst.skipped:
        raise StepError(f"no reading was left out at {quota} % of a processor")
    lab.await_new_reading("can")
    lab.await_message("can", lab.now_s(), "no longer overloaded", _calm)
    if lab.show("can", "NRestarts") != restarts:
        raise StepError("was started anew")
    return Outcome(
        f"{burst.sent} frames at up to {BURST_HZ:g} Hz and {quota} % of a processor: "
        f"{burst.dropped} dropped, {burst.skipped} of {burst.readings} readings left out, then "
        "well again"
    )


def _overload(lab: Lab) -> int:
    """Overload the daemon for a while; return the quota that did, %. Ends at the usual rate."""
    limit = "systemctl set-property --runtime graspd@can CPUQuota="
    lab.twin(BURST_HZ)
    try:
        for quota in QUOTAS:
            began_s = lab.deed(f"{limit}{quota}%")
            if lab.machine.messages.wait(_overloaded, OVERLOADS_IN_S, began_s):
                time.sleep(BURST_S)
                return quota
    finally:
        lab.sh(limit)
        lab.twin(RATE_HZ)
    raise StepError(f"not overloaded at {QUOTAS[-1]} % of a processor")


def _overloaded(message: Message) -> bool:
    is_status = message.kind == "status" and message.hand == "can"
    return is_status and bool(message.body["overloaded"])


def _calm(message: Message) -> bool:
    return message.kind == "status" and not message.body["overloaded"]


def _tally(lab: Lab) -> Tally:
    """Stop the twin if there is one, and count when the daemon has taken all that was sent."""
    lab.sh("systemctl stop twin-can 2>/dev/null || :")
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
