"""What is lost in the middle of a grasp is `unknown` at the subscriber, and says why.

Daemon and subscriber are real processes, the serial line and the sockets are real; only the
hardware is a twin.
"""

from __future__ import annotations

import contextlib
import queue
import socket
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from graspd.daemon.judge.reasons import Decision, Reason
from graspd.daemon.publish.messages import Verdict
from graspd.drivers.datagrams.joints import JointMessage
from graspd.drivers.datagrams.messages import Stamp
from graspd.drivers.twins.spi import SpiTwin
from tests.bench.attacks.doors import hand
from tests.bench.attacks.hang_ups import HANG_UPS, hang_up
from tests.bench.live import PATIENCE_S, Subscriber, held_grasp, running, spi_section
from tests.daemon.processes import before_others
from tests.ports import free_port
from tests.threads import at_work

JUDGED_MAX = {"sensor": 2, "link": 0}
"""README: readings that are judged all the same: a sensor is lost with the third without it."""
CLOCK = 1
"""Readings that the mapping of the bridge's clock may put after the outage."""
AGE_MAX_MS = 100.0
JOINTS = ("FFJ3", "MFJ3", "THJ5")
JOINT_PERIOD_S = 0.01
JOINT_NOISE_RAD = 0.0003


class Twin(SpiTwin):
    """A twin that does what it is told in its own thread."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, held_grasp())
        self._deeds: queue.Queue[Callable[[], object]] = queue.Queue()

    def work(self, stop: threading.Event) -> None:
        """Serve until `stop`."""

        def is_over() -> bool:
            while not self._deeds.empty():
                self._deeds.get()()
                self._deeds.task_done()
            return stop.is_set()

        self.serve(is_over)

    def do(self, deed: Callable[[], object]) -> None:
        """Have `deed` done in the other thread; return when it is done."""
        self._deeds.put(deed)
        self._deeds.join()


def send_joints(port: int, flow: threading.Event, stop: threading.Event) -> None:
    """Send angles of joints that keep still while `flow` is set."""
    random, seq = np.random.default_rng(1), 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect(("127.0.0.1", port))
        while not stop.wait(JOINT_PERIOD_S):
            if flow.is_set():
                angles = 0.8 + JOINT_NOISE_RAD * random.standard_normal(len(JOINTS))
                message = JointMessage(Stamp(seq, None), JOINTS, angles)
                with contextlib.suppress(OSError):  # the daemon is not there
                    sender.send(message.to_bytes())
                seq += 1


def is_valid(verdict: Verdict) -> bool:
    assert not verdict.valid or verdict.age_ms <= AGE_MAX_MS
    return verdict.valid


def until_unknown(subscriber: Subscriber, deed: Callable[[], object], reason: Reason) -> int:
    """Do it while a verdict stands, and wait until one is unknown for this reason.

    Return how many readings after it were judged. A busy computer that stands still makes verdicts
    unknown for another reason.
    """
    subscriber.drain()
    subscriber.wait_for(is_valid)
    deed()
    done_ns, judged = time.monotonic_ns(), set()

    def is_unknown(verdict: Verdict) -> bool:
        if is_valid(verdict) and verdict.t_mono_ns > done_ns:
            judged.add(verdict.t_mono_ns)
        return verdict.verdict is Decision.UNKNOWN and reason in verdict.reasons

    subscriber.wait_for(is_unknown)
    return len(judged)


def outages(folder: Path) -> Iterator[tuple[str, int]]:
    """Cause each outage once: its name, and how many readings were judged all the same."""
    port, flow = free_port(socket.SOCK_DGRAM), threading.Event()
    flow.set()
    sections = (
        f'{spi_section(folder)}[joints]\ndriver = "stream"\n'
        f'source = "udp://127.0.0.1:{port}"\n[model]\nname = "cnn1"\n'
    )
    with (
        Twin(folder / "bridge") as twin,
        at_work(twin.work, partial(send_joints, port, flow)),
        running(folder, sections) as (daemon, subscriber),
    ):
        pull, unplug = partial(twin.pull_fingers, 1), twin.unplug
        yield "sensor", until_unknown(subscriber, partial(twin.do, pull), Reason.SENSOR_MISSING)
        twin.do(twin.pull_fingers)
        yield "link", until_unknown(subscriber, partial(twin.do, unplug), Reason.STALE)
        twin.do(twin.plug)
        until_unknown(subscriber, flow.clear, Reason.JOINTS_LATE)
        subscriber.wait_for(is_valid)  # without them
        flow.set()
        subscriber.drain()
        verdict: Verdict | None = subscriber.wait_for(is_valid)
        daemon.kill()
        while verdict is not None:  # a subscriber knows by silence alone
            verdict = subscriber.verdict(verdict.silence_ms / 1e3)


def test_peers_that_hang_up_end_no_daemon(tmp_path: Path) -> None:
    with hand(tmp_path) as daemon:
        for door in daemon.doors:
            for says in HANG_UPS:
                hang_up(door, *says)
        daemon.friend.drain()
        assert daemon.friend.take(PATIENCE_S) is not None
        assert daemon.process.poll() is None


def test_every_outage_is_unknown_and_says_why(tmp_path: Path) -> None:
    with before_others():
        judged = dict(outages(tmp_path))
    assert judged.keys() == JUDGED_MAX.keys()
    assert all(number <= JUDGED_MAX[name] + CLOCK for name, number in judged.items())
