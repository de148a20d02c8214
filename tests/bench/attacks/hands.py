"""Another hand on the link, and a serial number that was misread."""

from __future__ import annotations

import operator
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from graspd.daemon.assembly import assembly
from graspd.daemon.publish.messages import Verdict
from graspd.daemon.scene import load as load_scene
from graspd.daemon.session.file import SessionFile, kept_now, load
from graspd.drivers.spi.messages import Hello
from graspd.drivers.twins.datagrams import PalmTwin
from graspd.drivers.twins.grasps.grasps import Counts
from graspd.drivers.twins.grasps.whole_grasps import synthetic_grasps
from graspd.drivers.twins.spi import SpiTwin
from tests.bench.attacks.attack import Aim, Attack, Outcome, Plan
from tests.bench.live import (
    HELD,
    SEED,
    Subscriber,
    judged_counts,
    start_daemon,
    tactile_section,
)
from tests.ports import free_port
from tests.threads import at_work

PALM_HZ = 1000.0 / 14.0
SILENCE_S = 0.16
"""Above the 140 ms after which the palm's link is given up."""
HELD_S = 2.0
KEPT_GRASPS = 30
SPI_VERDICTS = 60
UP_S = 15.0
"""Longest wait for a daemon's first verdict, s."""


@contextmanager
def daemon_of(folder: Path, tactile: str, model: str, more: str = "") -> Iterator[Subscriber]:
    """A daemon that judges settled grasps, and who hears it."""
    endpoint = f"ipc://{folder}/verdicts"
    scene = folder / "scene.toml"
    scene.write_text(
        f'{tactile}[hand]\nname = "right"\n[model]\nname = "{model}"\n'
        f'[publish]\nendpoint = "{endpoint}"\ntactile_hz = 10000\n{more}'
    )
    with start_daemon(scene, folder / "log") as daemon, Subscriber(endpoint) as subscriber:
        yield subscriber
        daemon.terminate()


def hear(
    subscriber: Subscriber, until: Callable[[list[Verdict]], bool], seconds: float
) -> list[Verdict]:
    """Verdicts until a condition holds or the time is over."""
    heard: list[Verdict] = []
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s and not until(heard):
        verdict = subscriber.verdict(min(0.1, end_s - time.monotonic()))
        if verdict is not None:
            heard.append(verdict)
    return heard


def grasped() -> Iterator[Counts]:
    """An open hand that closes and holds."""
    return (
        moment.counts for moment in synthetic_grasps(1, rate_hz=PALM_HZ, durations=HELD, seed=SEED)
    )


def sending(counts: Iterator[Counts], port: int) -> AbstractContextManager[object]:
    """A palm's relay, on a socket of its own, for as long as the block."""
    return at_work(partial(PalmTwin(counts).serve, f"udp://127.0.0.1:{port}"))


def second_palm(plan: Plan) -> Outcome:
    """The first hand is judged and falls silent; another one, which holds, sends instead of it."""
    known, told, stable, tried = 0, 0, 0, 0
    for folder in plan.folders():
        tried += 1
        port = free_port(socket.SOCK_DGRAM)
        tactile = f'[tactile]\ndriver = "palm"\nsource = "udp://127.0.0.1:{port}"\n'
        with daemon_of(folder, tactile, "cnn1", "[session]\nkeep = false\n") as subscriber:
            with sending(grasped(), port):
                first = hear(subscriber, any_valid, UP_S)
            known += any_valid(first)
            time.sleep(SILENCE_S)
            hear(subscriber, never, 0.02)
            with sending(judged_counts(), port):
                second = hear(subscriber, never, HELD_S)
            told += len(second)
            stable += sum(verdict.valid for verdict in second)
    happened = f"{stable} of {told} verdicts on the second hand by the first one's tare"
    return Outcome(tried, happened, stable == 0 and told > 50 and known == tried)


class MisreadTwin(SpiTwin):
    """A bridge that reads some serial numbers wrong."""

    def __init__(self, path: Path, misread: Callable[[int], bool]) -> None:
        """`misread` says whether the HELLO of this number, from 0, is wrong by a character."""
        self._misread = misread
        self.hellos = 0
        super().__init__(path, judged_counts())

    def _hello(self, nonce: int) -> Hello:
        hello = super()._hello(nonce)
        wrong = self._misread(self.hellos)
        self.hellos += 1
        first, *others = hello.serials
        return replace(hello, serials=(first.replace("W", "V"), *others)) if wrong else hello


@contextmanager
def bridge(twin: SpiTwin) -> Iterator[None]:
    """A twin at work in a thread."""
    with twin, at_work(lambda stop: twin.serve(stop.is_set)):
        yield


def keep_grasps(folder: Path, text: str) -> SessionFile:
    """A kept session of the twin's sensors, calibrated, as a daemon would have left it."""
    scene = folder / "before.toml"
    scene.write_text(text)
    wanted = load_scene(scene)
    session = assembly.build_pipeline(wanted, assembly.load_model(wanted)).session
    if session is None:
        raise ValueError("the model keeps no session")
    for counts in np.random.default_rng(SEED).integers(500, 3500, (KEPT_GRASPS, 3, 24)):
        session.observe(counts)
    serials: dict[str, str] = {
        finger: f"BTSP-TWIN-{at}" for at, finger in enumerate(wanted.hand.fingers)
    }
    with SessionFile(wanted.session_path) as file:
        file.save(kept_now(session.state(), wanted.hand.fingers, serials))
    return file


def kept_grasps(file: SessionFile) -> int:
    kept = load(file.path)
    return 0 if kept is None or kept.statistics is None else kept.statistics.grasps


def misread_serial(plan: Plan) -> Outcome:
    """One HELLO of the first eight is wrong."""
    wiped, tried = 0, 0
    for folder in plan.folders():
        tried += 1
        tactile = tactile_section("spi", str(folder / "bridge"))
        session = f'[session]\nfile = "{folder}/session.json"\n'
        file = keep_grasps(folder, tactile + session)
        wrong = 1 + plan.random.randrange(8)
        with (
            bridge(MisreadTwin(folder / "bridge", partial(operator.eq, wrong))),
            daemon_of(folder, tactile, "small-session", session) as subscriber,
        ):
            heard = hear(subscriber, lambda heard: len(heard) >= SPI_VERDICTS, UP_S)
        wiped += kept_grasps(file) < KEPT_GRASPS or len(heard) < SPI_VERDICTS
    happened = f"{wiped} of {tried} kept sessions of {KEPT_GRASPS} grasps wiped"
    return Outcome(tried, happened, wiped == 0)


def any_valid(heard: list[Verdict]) -> bool:
    """Whether something was judged."""
    return bool(heard) and heard[-1].valid


def never(_heard: list[Verdict]) -> bool:
    return False


ATTACKS = (
    Attack(
        "second-palm",
        Aim.FALSE_STABLE,
        "a second palm sends after 160 ms of silence of the first, and holds something",
        "times",
        second_palm,
    ),
    Attack(
        "misread-serial",
        Aim.FALLS,
        "a bridge misreads one character of a serial number in one of its first HELLOs",
        "times",
        misread_serial,
    ),
)
