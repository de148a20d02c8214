"""Steps of the system test: faults, and the time until verdicts come again.

Each returns what it saw, and raises `StepError` if graspd did something else.
"""

from __future__ import annotations

import time
from collections import Counter
from typing import Final

from tests.system.lab import HANDS, PATIENCE_S, Lab, Outcome, StepError
from tests.system.messages import Message
from tests.system.steps_verdicts import judgement

OUTAGE_S: Final = 2.0
"""Time for which a link is down, s."""
WATCHED_S: Final = 1.0
"""Time after a step of the clock in which it must have no effect, s."""
STALE_S: Final = 5.0
"""Age at which a reading is stale, s: `max_age_ms` of both scenes."""
DAY_S: Final = 86_400
STEPS: Final = ("+", "-", "+", "-")
"""Signs of the wall clock's steps of a day, each twice: a busy host may cause a warning by itself,
but a step that the daemon notices would cause one each time."""
FILLER: Final = "/filler"
FILL: Final = f"""
for size in 64M 1M 64K 4K; do
    while fallocate -l $size {FILLER}.$((n = n + 1)) 2>/dev/null; do :; done
done
cat /proc/cpuinfo > {FILLER}.last 2>/dev/null && exit 1
:"""
"""Shell script that fills the disk to the last block, by allocation; fails if a file still fits."""
REPLAY_TIMEOUT_S: Final = 600.0
NO_SPACE: Final = "No space left on device"
CANNOT_KEEP: Final = f"cannot keep the session: {NO_SPACE}"
CANNOT_RECORD: Final = f"{NO_SPACE}; nothing is recorded"
RECORDINGS: Final = "/var/lib/graspd/record/*.mcap"
SESSION: Final = "/var/lib/graspd/serial.session/*.session"


def killed(lab: Lab) -> Outcome:
    """Kill the CAN hand's daemon: systemd restarts it, and a subscriber receives it again."""
    at_s = lab.deed(f"kill -KILL {lab.show('can', 'MainPID')}")
    recovery_s = _started_anew(lab, "can", at_s, "signal")
    return Outcome("kill -9 -> first verdict of the new process", recovery_s)


def hangs(lab: Lab) -> Outcome:
    """Stop the serial hand's daemon by SIGSTOP; other steps run until `hung` sees the result."""
    lab.deeds_s["SIGSTOP"] = lab.deed(f"kill -STOP {lab.show('serial', 'MainPID')}")
    return Outcome("SIGSTOP to the serial hand")


def hung(lab: Lab) -> Outcome:
    """Wait until the watchdog has noticed the daemon of `hangs`, and systemd has restarted it."""
    recovery_s = _started_anew(lab, "serial", lab.done_s("SIGSTOP"), "watchdog")
    limit = lab.show("serial", "WatchdogUSec")
    what = f"SIGSTOP -> watchdog ({limit} here) -> first verdict of the new process"
    return Outcome(what, recovery_s)


def _started_anew(lab: Lab, hand: str, at_s: float, result: str) -> float:
    """Wait for a verdict of a new daemon after the fault at `at_s`; return the time between, s.

    `result`: systemd's result of the former process.
    """
    # By a verdict: the last status may be that of a process before.
    former = lab.machine.messages.between(hand, "verdict", 0.0, at_s)[-1].body["boot_id"]
    well = lab.await_message(
        hand, at_s, "a verdict", lambda m: m.told and m.body["boot_id"] != former
    )
    lab.await_journal(hand, at_s, f"Failed with result '{result}'")
    return well.t_s - at_s


def bus_down(lab: Lab) -> Outcome:
    """Take the CAN interface down and up: verdicts are unknown, then come again, no restart."""
    pid = lab.show("can", "MainPID")
    down_s = lab.deed("ip link set vcan0 down")
    said = lab.await_message("can", down_s, "unknown", _unknown)
    time.sleep(OUTAGE_S)
    up_s = lab.deed("ip link set vcan0 up")
    well = lab.await_message("can", up_s, "a verdict")
    _same_process(lab, "can", pid)
    unknown_s = said.t_s - down_s
    return Outcome(f"unknown {unknown_s:.1f} s after down; from up to verdict", well.t_s - up_s)


def unplugged(lab: Lab) -> Outcome:
    """Unplug and plug the USB serial adapter: the driver finds it again by its stable name."""
    pid = lab.show("serial", "MainPID")
    out_s = lab.now_s()
    lab.machine.unplug()
    said = lab.await_message("serial", out_s, "silence", _stale)
    time.sleep(OUTAGE_S)
    in_s = lab.now_s()
    lab.machine.plug()
    reading = lab.await_message(
        "serial", in_s, "a reading", lambda m: m.kind == "verdict" and not _stale(m)
    )
    lab.await_message("serial", in_s, "a judged grasp")
    _same_process(lab, "serial", pid)
    unknown_s = said.t_s - out_s
    return Outcome(f"silent {unknown_s:.1f} s after pull; from plug to reading", reading.t_s - in_s)


def _unknown(message: Message) -> bool:
    return message.kind == "verdict" and not message.told


def _stale(message: Message) -> bool:
    return _unknown(message) and "stale" in message.body["reasons"]


def _same_process(lab: Lab, hand: str, pid: str) -> None:
    if lab.show(hand, "MainPID") != pid:
        raise StepError(f"{hand}: was started anew")


def disk_full(lab: Lab) -> Outcome:
    """Fill the disk: judging continues, one warning each for the session and the recording."""
    pid = lab.show("serial", "MainPID")
    try:
        full_s = lab.deed(FILL)
        for text in (CANNOT_KEEP, CANNOT_RECORD):
            lab.await_journal("serial", full_s, text)
        for _ in range(2):  # grasps: another one that cannot be kept
            lab.await_message("serial", lab.now_s(), "a judged grasp", judgement)
        # A host that is busy may cost the link for a moment, which is warned of as well.
        warnings = [line for line in lab.warnings("serial", full_s) if NO_SPACE in line]
        if len(warnings) != 2:
            raise StepError(f"{len(warnings)} warnings: {warnings}")
        lab.sh("graspd session show /etc/graspd/serial.toml")  # what was kept before is whole
        lab.sh(f"touch -d @0 {SESSION}")
    finally:
        free_s = lab.deeds_s["room"] = lab.deed(f"rm -f {FILLER}.*")
    lab.await_true(
        f"[ $(stat -c %Y {SESSION} | sort -n | tail -n 1) -gt 0 ]",
        "the session kept again",
        look_s=0.2,
    )
    kept_s = lab.now_s() - free_s
    first = f"$(ls {RECORDINGS} | head -n 1)"
    lab.sh(f"graspd replay --json {first} | grep -c '\"valid\":true'", REPLAY_TIMEOUT_S)
    for hand in HANDS:
        lab.verdicts(hand, full_s, lab.now_s())
    _same_process(lab, "serial", pid)
    what = "verdicts go on, a warning each, what was kept is whole; from room to a kept session"
    return Outcome(what, kept_s)


def recording_again(lab: Lab) -> Outcome:
    """Wait until the recorder that a full disk ended begins a recording again by itself."""
    free_s = lab.done_s("room")
    again = lab.await_message("serial", free_s, "a recording again", _recording)
    lab.verdicts("serial", free_s, again.t_s)
    return Outcome("from room on the disk to a recording", again.t_s - free_s)


def _recording(message: Message) -> bool:
    return message.kind == "status" and bool(message.body["drivers"]["record"]["writing"])


def clock_stepped(lab: Lab) -> Outcome:
    """Step the wall clock by a day and back, twice: no verdict is stale or lost, and no hand warns
    each time."""
    compared = 0
    warned: Counter[tuple[str, str]] = Counter()
    for sign in STEPS:
        at_s = lab.deed(f"date -s @$(($(date +%s) {sign} {DAY_S}))")
        for hand in HANDS:
            lab.await_new_reading(hand)
        time.sleep(WATCHED_S)
        for hand in HANDS:
            verdicts = lab.verdicts(hand, at_s, lab.now_s())
            if any(_stale_too_early(verdict) for verdict in verdicts):
                raise StepError(f"{hand}: notices the step {sign} {DAY_S} s")
            compared += len(verdicts)
            warned[hand, sign] += bool(lab.warnings(hand, at_s))
    for (hand, sign), times in warned.items():
        if times == STEPS.count(sign):
            raise StepError(f"{hand}: warns after each step {sign} {DAY_S} s")
    return Outcome(f"by a day and back, twice: {compared} verdicts, none stale or lost")


def _stale_too_early(message: Message) -> bool:
    """True if the verdict has the reason `stale`, but by the monotonic clock is not that old.

    A busy host may stall and make readings truly stale, which is not a fault.
    """
    return "stale" in message.body["reasons"] and message.t_s - message.made_s < STALE_S


def stopped(lab: Lab) -> Outcome:
    """Stop the CAN hand by systemctl: it sends a last status and exits with code 0."""
    lab.sh("systemctl -q enable graspd@can")  # else systemd forgets how it ended
    at_s = lab.deed("systemctl stop graspd@can")
    ended_s = int(lab.show("can", "ExecMainExitTimestampMonotonic")) / 1e6 - at_s
    code, result = lab.show("can", "ExecMainStatus"), lab.show("can", "Result")
    if (code, result) != ("0", "success"):
        raise StepError(f"exit code {code}, {result}, after {ended_s:.1f} s")
    lab.await_message("can", at_s, "a last status", _stopping)
    lab.sh("systemctl stop twin-can; test ! -e /run/graspd/can.ipc")
    return Outcome("SIGTERM -> last status, exit code 0, socket gone", ended_s)


def _stopping(message: Message) -> bool:
    return message.kind == "status" and message.body["state"] == "stopping"


def wrong_start(lab: Lab) -> Outcome:
    """Start a hand with a wrong scene: it fails with exit code 2, and systemd does not retry."""
    lab.sh("echo '[tactile]' > /etc/graspd/wrong.toml")
    if lab.machine.run("systemctl start graspd@wrong", PATIENCE_S).code == 0:
        raise StepError("a wrong scene starts")
    # A unit that systemd will start again is `activating` until then.
    state, code = (lab.show("wrong", name) for name in ("ActiveState", "ExecMainStatus"))
    restarts = lab.show("wrong", "NRestarts")
    if (state, code, restarts) != ("failed", "2", "0"):
        raise StepError(f"{state}, exit code {code}, {restarts} restarts")
    lab.sh("rm /etc/graspd/wrong.toml; systemctl reset-failed graspd@wrong")
    return Outcome("exit code 2, no restart")
