"""Parts that all steps share: the emulated machine, simulated links of both hands, and calls to
ask and wait."""

from __future__ import annotations

import contextlib
import itertools
import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from graspd.drivers.twins.grasps.grasp_script import Durations
from graspd.drivers.twins.grasps.whole_grasps import synthetic_grasps
from graspd.drivers.twins.spi import SpiTwin
from tests.system.machine import COMMAND_TIMEOUT_S, Machine
from tests.system.messages import Message
from tests.threads import at_work

PAYLOAD: Final = "/payload"
PYTHON: Final = "/opt/graspd/venv/bin/python"
HANDS: Final = ("can", "serial")
MEMBER, STRANGER = "member", "stranger"
"""Users in the emulated machine: in the group graspd, and in none."""
RATE_HZ: Final = 20.0
"""Sweeps/s of each hand: as many as two emulated processors can judge."""
GRASPS: Final = Durations(first_rest_s=(6.5, 6.5), settle_s=(2.0, 2.0), rest_s=(6.5, 6.5))
"""Durations of grasps at a fifth of the usual rate: longer, as the daemon needs a hundred sweeps to
learn where the fingers rest, and more to settle."""
PATIENCE_S: Final = 600.0
"""Longest wait, s, for what takes a second on an idle computer without emulation."""
LOOK_S: Final = 0.5


class StepError(Exception):
    """A step failed: something in the emulated machine is wrong; the message says what."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a step that succeeded."""

    what: str
    """What the step saw, in one line."""
    recovery_s: float | None = None
    """Time from the fault or command to the result that the step awaits, s, by the emulated
    machine's clock; None: not measured."""


class Lab:
    """The emulated machine, and calls for the steps: its commands, its journal, the messages of its
    daemons, one for each hand."""

    def __init__(self, machine: Machine, bridge: Bridge) -> None:
        self.machine = machine
        self.bridge = bridge
        self.deeds_s: dict[str, float] = {}
        """Times of what a step did and a later step awaits, s, by the emulated machine's monotonic
        clock."""

    def sh(self, script: str, timeout_s: float = COMMAND_TIMEOUT_S) -> str:
        """Run a shell script in the emulated machine; return its output without the last newline.

        Raises `StepError` if it fails.
        """
        done = self.machine.run(script, timeout_s)
        if done.code:
            said = (done.err or done.out).strip()[-2000:]
            raise StepError(f"{script.splitlines()[0]} failed ({done.code}): {said}")
        return done.out.rstrip("\n")

    def deed(self, script: str) -> float:
        """Run a shell script in the emulated machine; return when it began, s, by the monotonic
        clock there."""
        return float(self.sh(f"read now _ < /proc/uptime; echo $now\n{script}").split()[0])

    def done_s(self, what: str) -> float:
        """Return the time that an earlier step noted as `what`. Raises `StepError` if none did."""
        if what not in self.deeds_s:
            raise StepError(f"{what}: the step that does it did not come so far")
        return self.deeds_s[what]

    def now_s(self) -> float:
        """Return the time of the emulated machine's monotonic clock, s."""
        return self.deed(":")

    def show(self, hand: str, what: str) -> str:
        """Return the property `what` of a hand's unit, as `systemctl show` prints it."""
        return self.sh(f"systemctl show --value -p {what} graspd@{hand}")

    def journal(self, hand: str, after_s: float, priority: str = "debug") -> list[str]:
        """Return journal lines of a hand's unit after `after_s`, of at least this priority.

        Times are monotonic, as the wall clock is stepped; a cursor would skip the first match.
        """
        said = self.sh(
            "journalctl -q -b --no-pager -o json --output-fields=MESSAGE "
            f"-p {priority} -u graspd@{hand}"
        )
        entries = [json.loads(line) for line in said.splitlines()]
        return [
            str(entry["MESSAGE"])
            for entry in entries
            if int(entry["__MONOTONIC_TIMESTAMP"]) / 1e6 > after_s
        ]

    def warnings(self, hand: str, after_s: float) -> list[str]:
        """Return a hand's warnings after `after_s`, without those of an overloaded processor."""
        said = self.journal(hand, after_s, "warning")
        return [line for line in said if not line.startswith("overloaded: ")]

    def await_journal(self, hand: str, after_s: float, text: str) -> None:
        """Wait until a hand's journal has a line with `text`. Raises `StepError` without one."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not any(text in line for line in self.journal(hand, after_s)):
            if time.monotonic() > deadline_s:
                raise StepError(f"{hand}: no word of {text!r} within {PATIENCE_S:g} s")
            time.sleep(LOOK_S)

    def await_message(
        self,
        hand: str,
        after_s: float,
        what: str,
        wanted: Callable[[Message], bool] | None = None,
        timeout_s: float = PATIENCE_S,
    ) -> Message:
        """Return the first message of a hand after `after_s` for which `wanted` is True.

        `wanted` None: a verdict on a reading. `what`: words for the `StepError` that it raises if
        none comes in `timeout_s`.
        """

        def fits(message: Message) -> bool:
            return message.hand == hand and (message.told if wanted is None else wanted(message))

        found = self.machine.messages.wait(fits, timeout_s, after_s)
        if found is None:
            raise StepError(f"{hand}: {what}: not within {timeout_s:g} s")
        return found

    def await_true(
        self, script: str, what: str, timeout_s: float = PATIENCE_S, look_s: float = LOOK_S
    ) -> None:
        """Run a shell script every `look_s` until it succeeds. Raises `StepError` if it never does.

        `what`: words for the error.
        """
        deadline_s = time.monotonic() + timeout_s
        while self.machine.run(script).code:
            if time.monotonic() > deadline_s:
                raise StepError(f"{what}: not within {timeout_s:g} s")
            time.sleep(look_s)

    def last(self, hand: str, kind: str) -> dict[str, Any]:
        """Return the body of a hand's newest message of a kind. Raises `StepError` without one."""
        message = self.machine.messages.last(hand, kind)
        if message is None:
            raise StepError(f"{hand}: no {kind} has come")
        return message.body

    def verdicts(self, hand: str, from_s: float, to_s: float) -> list[Message]:
        """Return all verdicts of a hand from `from_s` to `to_s`.

        Raises `StepError` if one was lost, or the daemon restarted meanwhile.
        """
        found = self.machine.messages.between(hand, "verdict", from_s, to_s)
        for former, following in itertools.pairwise(found):
            if former.body["boot_id"] != following.body["boot_id"]:
                raise StepError(f"{hand}: started anew between {former.t_s} and {following.t_s} s")
            if former.body["seq"] + 1 != following.body["seq"]:
                raise StepError(f"{hand}: messages were lost after {former.body['seq']}")
        return found

    def observe(self) -> None:
        """Start guest/observe.py in the emulated machine, as a member of the group graspd, for both
        hands."""
        endpoints = " ".join(f"ipc:///run/graspd/{hand}.ipc" for hand in HANDS)
        self.sh(
            f"systemd-run -q --unit=observer --uid={MEMBER} "
            "-p StandardOutput=file:/dev/virtio-ports/graspd.messages "
            f"{PYTHON} {PAYLOAD}/guest/observe.py {endpoints}"
        )

    def twin(self) -> None:
        """Start a simulated CAN board on vcan0. It plays a recording, which takes less than making
        grasps."""
        self.sh(
            "systemd-run -q --unit=twin-can /usr/local/bin/graspd twin can "
            f"--interface socketcan --channel vcan0 --rate {RATE_HZ} "
            f"--recording {PAYLOAD}/recording.csv --loop"
        )

    def await_new_reading(self, hand: str) -> None:
        """Wait for a verdict on a reading that is made after this call."""
        now_s = self.now_s()
        self.await_message(hand, now_s, "a verdict", lambda m: m.told and m.made_s > now_s)

    def interface(self) -> dict[str, int]:
        """Return how many frames the kernel has `sent` and `dropped` on vcan0."""
        told = json.loads(self.sh("ip -s -j link show vcan0"))[0]["stats64"]
        return {"sent": told["tx"]["packets"], "dropped": told["tx"]["dropped"]}


class Bridge:
    """A simulated SPI bridge on a terminal of the host; the emulated machine sees a USB adapter."""

    def __init__(self, path: Path) -> None:
        self.path = path
        grasps = synthetic_grasps(rate_hz=RATE_HZ, durations=GRASPS, loop=True)
        counts = (moment.counts for moment in grasps)
        self._twin = SpiTwin(path, counts, rate_hz=RATE_HZ)

    @contextlib.contextmanager
    def serving(self) -> Iterator[None]:
        """Run the twin in a thread during the block."""
        with self._twin, at_work(self._serve):
            yield

    def _serve(self, stop: threading.Event) -> None:
        self._twin.serve(stop.is_set)
