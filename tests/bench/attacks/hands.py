"""Another hand on the link, a serial number that was misread, and sweeps that are torn apart."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from daemon.publish.messages import Verdict, decode_verdict
from drivers.twins.grasps.grasps import Counts
from drivers.twins.grasps.whole_grasps import synthetic_grasps
from drivers.twins.palm import PalmTwin
from tests.bench.attacks.attack import Aim, Attack, Outcome, Plan
from tests.bench.live import HELD, SEED, Subscriber, judged_counts, start_daemon

PALM_HZ = 1000.0 / 14.0
SILENCE_S = 0.16
"""Above the 140 ms after which the palm's link is given up."""
HELD_S = 2.0
UP_S = 15.0
"""Longest wait for a daemon's first verdict, s."""


@dataclass
class Heard:
    """Verdicts, in the order in which they came."""

    verdicts: list[Verdict] = field(default_factory=list)


@contextmanager
def daemon_of(folder: Path, tactile: str, model: str, more: str = "") -> Iterator[Subscriber]:
    """A daemon that judges settled grasps, and who hears it."""
    endpoint = f"ipc://{folder}/verdicts"
    scene = folder / "scene.toml"
    scene.write_text(
        f'{tactile}[hand]\nname = "right"\n[model]\nname = "{model}"\n'
        f'[publish]\nendpoint = "{endpoint}"\n{more}'
    )
    with start_daemon(scene, folder / "log"), Subscriber(endpoint) as subscriber:
        yield subscriber


def hear(subscriber: Subscriber, until: Callable[[Heard], bool], seconds: float) -> Heard:
    """Verdicts until a condition holds or the time is over."""
    heard, end_s = Heard(), time.monotonic() + seconds
    while time.monotonic() < end_s and not until(heard):
        message = subscriber.take(min(0.1, max(end_s - time.monotonic(), 0.0)))
        if message is not None:
            heard.verdicts.append(decode_verdict(message[1]))
    return heard


def grasped() -> Iterator[Counts]:
    """An open hand that closes and holds."""
    return (
        moment.counts for moment in synthetic_grasps(1, rate_hz=PALM_HZ, durations=HELD, seed=SEED)
    )


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
        return port


@contextmanager
def sending(counts: Iterator[Counts], port: int) -> Iterator[None]:
    """A palm's relay, on a socket of its own, for as long as the block."""
    stop = threading.Event()
    twin = PalmTwin(counts)
    thread = threading.Thread(target=twin.serve, args=(f"udp://127.0.0.1:{port}", stop))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def second_palm(plan: Plan) -> Outcome:
    """The first hand is judged and falls silent; another one, which holds, sends instead of it."""
    known, told, stable, rounds = 0, 0, 0, 0
    for rounds in plan.rounds():
        folder = plan.folder / str(rounds)
        folder.mkdir()
        port = free_port()
        tactile = f'[tactile]\ndriver = "palm"\nsource = "udp://127.0.0.1:{port}"\n'
        with daemon_of(folder, tactile, "cnn1", "[session]\nkeep = false\n") as subscriber:
            with sending(grasped(), port):
                first = hear(subscriber, any_valid, UP_S)
            known += any_valid(first)
            time.sleep(SILENCE_S)
            hear(subscriber, never, 0.02)
            with sending(judged_counts(), port):
                second = hear(subscriber, never, HELD_S)
            told += len(second.verdicts)
            stable += sum(verdict.valid for verdict in second.verdicts)
    happened = f"{stable} of {told} verdicts on the second hand by the first one's tare"
    return Outcome(rounds + 1, happened, stable == 0 and told > 50 and known == rounds + 1)


def any_valid(heard: Heard) -> bool:
    """Whether something was judged."""
    return bool(heard.verdicts) and heard.verdicts[-1].valid


def never(_heard: Heard) -> bool:
    return False


ATTACKS = (
    Attack(
        "second-palm",
        Aim.FALSE_STABLE,
        "a second palm sends after 160 ms of silence of the first, and holds something",
        "times",
        second_palm,
    ),
)
