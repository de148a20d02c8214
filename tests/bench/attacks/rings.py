"""Old sweeps in a ring, and joint angles that stand still to the bit, while the hand opens.

A bridge or relay goes on with new numbers and times, but what it sends was read before.
"""

from __future__ import annotations

import contextlib
import itertools
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from graspd.daemon.judge.reasons import Decision
from graspd.daemon.publish.messages import Verdict
from graspd.drivers.datagrams.joints import JointMessage
from graspd.drivers.datagrams.messages import Stamp
from graspd.drivers.twins.grasps.grasp_script import JOINT_NAMES
from graspd.drivers.twins.grasps.grasps import Counts
from graspd.drivers.twins.grasps.whole_grasps import PALM_RATE_HZ, RATE_HZ
from graspd.drivers.twins.spi import SpiTwin
from tests.bench.attacks.attack import Outcome, Plan
from tests.bench.live import held_grasp, running, spi_section
from tests.ports import free_port
from tests.threads import at_work

RING_MIN, RING_MAX = 2, 64
"""Sweeps that are repeated."""
GRACE = 3
"""So many sweeps after the first turn of a ring no verdict may be `stable` any more."""
UNDER_ATTACK_S = 2.5
"""How long the ring turns, s, the first turn and the grace not counted."""
STABLE_FIRST = 30
"""Verdicts `stable` before it begins."""
JOINTS_MAY_STAND_S = 1.5
"""How long joint angles may be equal to the bit before no verdict may be `stable`, s."""

RATES_HZ = (PALM_RATE_HZ, RATE_HZ)
Send = Callable[[threading.Event], None]
"""Sends until it is told to stop."""


class Ring:
    """A held grasp whose last sweeps are repeated from `begin` on, of one finger or of all."""

    def __init__(self, sweeps: int, finger: int | None, rate_hz: float) -> None:
        """`finger` is its row; None: all."""
        self.sweeps = sweeps
        self.finger = finger
        self.begin = threading.Event()
        self.turned_ns: int | None = None
        """When the first sweep after turn and grace was asked for, monotonic ns."""
        self._held = held_grasp(rate_hz)

    def counts(self) -> Iterator[Counts]:
        """What the board sends."""
        last: deque[Counts] = deque(maxlen=self.sweeps)
        for counts in self._held:
            if self.begin.is_set():
                break
            last.append(counts)
            yield counts
        for number, (old, fresh) in enumerate(zip(itertools.cycle(last), self._held, strict=False)):
            if number == self.sweeps + GRACE:
                self.turned_ns = time.monotonic_ns()
            yield ringed(old, fresh, self.finger)


def ringed(old: Counts, fresh: Counts, finger: int | None) -> Counts:
    """A sweep whose finger, or all of it, is the old one."""
    if finger is None:
        return old
    counts = fresh.copy()
    counts[finger] = old[finger]
    return counts


def serving(folder: Path, counts: Iterator[Counts], rate_hz: float) -> Send:
    twin = SpiTwin(folder / "bridge", counts, rate_hz=rate_hz)

    def serve(stop: threading.Event) -> None:
        with twin:
            twin.serve(stop.is_set)

    return serve


def under_attack(
    folder: Path,
    serve: Sequence[Send],
    begin: threading.Event,
    since_ns: Callable[[], int | None],
    joints: str = "",
) -> tuple[int, int]:
    """Verdicts of readings since then, and how many of them were `stable`.

    The attack begins when the grasp has been `stable` for a while. `joints`: a section.
    """
    stable = itertools.count(1)
    sections = f'{spi_section(folder)}{joints}[model]\nname = "cnn1"\n'
    with running(folder, sections) as (_, subscriber), contextlib.ExitStack() as within:
        subscriber.wait_for(lambda _: True)  # it is there, and sees the hand at rest
        within.enter_context(at_work(*serve))
        subscriber.wait_for(
            lambda verdict: verdict.verdict is Decision.STABLE and next(stable) >= STABLE_FIRST
        )
        begin.set()
        late: list[Decision] = []

        def is_over(verdict: Verdict) -> bool:
            began_ns = since_ns()
            if began_ns is None or verdict.t_mono_ns < began_ns:
                return False
            late.append(verdict.verdict)
            return verdict.t_mono_ns - began_ns > UNDER_ATTACK_S * 1e9

        subscriber.wait_for(is_over)
    return len(late), late.count(Decision.STABLE)


def rings(plan: Plan) -> Iterator[tuple[Path, int, int | None]]:
    """A folder for each ring, its length, and the finger that it is of; None: all."""
    for folder in plan.folders():
        finger = None if plan.random.random() < 0.5 else plan.random.randrange(3)
        # Short rings more often than long ones: what is looked for is the same in all.
        yield folder, round(RING_MIN * (RING_MAX / RING_MIN) ** plan.random.random()), finger


def tallied(verdicts: Iterable[tuple[int, int]]) -> Outcome:
    """What came of all rounds: verdicts, and `stable` ones among them."""
    tried, said, stable = 0, 0, 0
    for in_round, stable_in_round in verdicts:
        tried += 1
        said += in_round
        stable += stable_in_round
    return Outcome(tried, f"{stable} of {said:,} verdicts `stable`", said > 0 and stable == 0)


def ring_over_spi(plan: Plan) -> Outcome:
    """A ring over a serial line, at one of the two rates."""

    def one(folder: Path, sweeps: int, finger: int | None) -> tuple[int, int]:
        rate_hz = plan.random.choice(RATES_HZ)
        ring = Ring(sweeps, finger, rate_hz)
        serve = serving(folder, ring.counts(), rate_hz)
        return under_attack(folder, [serve], ring.begin, lambda: ring.turned_ns)

    return tallied(one(*each) for each in rings(plan))


def joints_frozen(plan: Plan) -> Outcome:
    """Joint angles that stand still to the bit beside sweeps that go on."""

    def one(folder: Path) -> tuple[int, int]:
        port, begin = free_port(socket.SOCK_DGRAM), threading.Event()
        frozen_ns: list[int] = []
        serve = serving(folder, held_grasp(), RATE_HZ)
        joints = f'[joints]\ndriver = "stream"\nsource = "udp://127.0.0.1:{port}"\n'
        rng = np.random.default_rng(plan.random.randrange(1 << 32))

        def send_joints(stop: threading.Event) -> None:
            angles = np.full(len(JOINT_NAMES), 0.8)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                for seq in itertools.count():
                    if stop.wait(1.0 / RATE_HZ):
                        return
                    if not begin.is_set():
                        angles = 0.8 + rng.normal(0.0, 0.0003, len(JOINT_NAMES))
                    elif not frozen_ns:
                        frozen_ns.append(time.monotonic_ns())
                    message = JointMessage(Stamp(seq, None), JOINT_NAMES, angles)
                    sender.sendto(message.to_bytes(), ("127.0.0.1", port))

        def since_ns() -> int | None:
            return frozen_ns[0] + round(JOINTS_MAY_STAND_S * 1e9) if frozen_ns else None

        return under_attack(folder, [serve, send_joints], begin, since_ns, joints)

    return tallied(one(folder) for folder in plan.folders())
