"""What is lost in the middle of a grasp is `unknown` at the subscriber, as soon as is promised.

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
from graspd.drivers.joints import JointMessage
from graspd.drivers.twins.spi import SpiTwin
from tests.bench.attacks.doors import HANG_UPS, hand, hang_up
from tests.bench.live import PATIENCE_S, Subscriber, held_grasp, running, spi_section
from tests.daemon.processes import before_others
from tests.ports import free_port
from tests.threads import at_work

PROMISED_S = {
    "sensor": 0.02,
    "link": 0.1,
    "joints": 0.15,
    "joints, and judged without them": 1.0,
    "daemon": 0.1,
}
"""README: two periods; the age limit; late joints; lost joints; silence."""
STALL_S = 3.0
"""A machine that does other things too may hold a process up for so long."""
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
        """Have something done; returns when it is done."""
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
                message = JointMessage(seq, None, JOINTS, angles)
                with contextlib.suppress(OSError):  # the daemon is not there
                    sender.send(message.to_bytes())
                seq += 1


def comes_s(subscriber: Subscriber, wanted: Callable[[Verdict], bool]) -> float:
    """Return when the first verdict like that came from now on, s. Raises `TimeoutError`."""
    subscriber.drain()
    subscriber.wait_for(wanted)
    return subscriber.received_ns / 1e9


def is_valid(verdict: Verdict) -> bool:
    return verdict.valid


def until_unknown_s(subscriber: Subscriber, deed: Callable[[], object], reason: Reason) -> float:
    """Do it while a verdict stands; s until one came that is unknown for this reason.

    A busy computer that stands still makes verdicts unknown for another one.
    """
    comes_s(subscriber, is_valid)
    began_s = time.monotonic()
    deed()
    unknown_s = comes_s(
        subscriber, lambda said: said.verdict is Decision.UNKNOWN and reason in said.reasons
    )
    return unknown_s - began_s


def outages(folder: Path) -> Iterator[tuple[str, float]]:
    """Cause each outage once: its name, and s until unknown for the right reason."""
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
        yield "sensor", until_unknown_s(subscriber, partial(twin.do, pull), Reason.SENSOR_MISSING)
        twin.do(twin.pull_fingers)
        yield "link", until_unknown_s(subscriber, partial(twin.do, unplug), Reason.STALE)
        twin.do(twin.plug)
        took_s = until_unknown_s(subscriber, flow.clear, Reason.JOINTS_LATE)
        yield "joints", took_s
        began_s = time.monotonic()
        without_s = comes_s(subscriber, is_valid) - began_s
        yield "joints, and judged without them", took_s + without_s
        flow.set()
        subscriber.drain()
        verdict: Verdict | None = subscriber.wait_for(is_valid)
        began_s = time.monotonic()
        daemon.kill()
        while verdict is not None:  # a subscriber knows by silence alone
            verdict = subscriber.verdict(verdict.silence_ms / 1e3)
        yield "daemon", time.monotonic() - began_s


def test_heartbeats_of_peers_that_hang_up_do_not_end_the_daemon(tmp_path: Path) -> None:
    with hand(tmp_path) as daemon:
        for door in daemon.doors:
            for says in HANG_UPS:
                hang_up(door, *says)
        daemon.friend.drain()
        assert daemon.friend.take(PATIENCE_S) is not None
        assert daemon.process.poll() is None


def test_every_outage_is_unknown_in_time_and_says_why(tmp_path: Path) -> None:
    with before_others():
        outages_s = dict(outages(tmp_path))
    assert outages_s.keys() == PROMISED_S.keys()
    late = {name: s for name, s in outages_s.items() if s > PROMISED_S[name] + STALL_S}
    assert not late
