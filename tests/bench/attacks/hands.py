"""Another hand on the link, and a serial number that was misread."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from graspd.daemon.assembly import assembly, plan
from graspd.daemon.publish.messages import Verdict
from graspd.daemon.scene import load as load_scene
from graspd.daemon.session.file import KeptSession
from graspd.daemon.session.folder import SessionFolder
from graspd.drivers.spi.messages import Hello
from graspd.drivers.twins.datagrams import PalmTwin
from graspd.drivers.twins.grasps.whole_grasps import PALM_RATE_HZ
from graspd.drivers.twins.spi import SpiTwin
from tests.bench.attacks.attack import Outcome, Plan
from tests.bench.live import PATIENCE_S, SEED, STOP_S, Subscriber, held_grasp, running, spi_section
from tests.daemon.session.learning import last_kept
from tests.ports import free_port
from tests.threads import at_work

SILENCE_S = 0.16
"""Above the 140 ms after which the palm's link is given up."""
SECOND_VERDICTS = 150
KEPT_GRASPS = 30
SPI_VERDICTS = 60


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


def sending(port: int) -> AbstractContextManager[object]:
    """A palm that closes and holds, whose relay sends from a socket of its own in the block."""
    counts = held_grasp(PALM_RATE_HZ)
    return at_work(partial(PalmTwin(counts).serve, f"udp://127.0.0.1:{port}"))


def second_palm(plan: Plan) -> Outcome:
    """The first hand is judged and falls silent; another one, which holds, sends instead of it."""
    known, told, stable, tried = 0, 0, 0, 0
    for folder in plan.folders():
        tried += 1
        port = free_port(socket.SOCK_DGRAM)
        sections = (
            f'[tactile]\ndriver = "palm"\nsource = "udp://127.0.0.1:{port}"\n'
            '[model]\nname = "cnn1"\n[session]\nkeep = false\n'
        )
        with running(folder, sections) as (_, subscriber):
            subscriber.wait_for(lambda _: True)  # it is there, and sees the hand at rest
            with sending(port):
                first = hear(subscriber, any_valid, PATIENCE_S)
            known += any_valid(first)
            time.sleep(SILENCE_S)
            hear(subscriber, never, 0.02)
            with sending(port):
                second = hear(subscriber, lambda heard: len(heard) >= SECOND_VERDICTS, PATIENCE_S)
            told += len(second)
            stable += sum(verdict.valid for verdict in second)
    happened = f"{stable} of {told} verdicts on the second hand by the first one's tare"
    well = stable == 0 and told == tried * SECOND_VERDICTS and known == tried
    return Outcome(tried, happened, well)


class MisreadTwin(SpiTwin):
    """A bridge that reads a serial number wrong by a character in one HELLO."""

    def __init__(self, path: Path, misread: int) -> None:
        """`misread`: number of that HELLO, from 0."""
        self._misread = misread
        self._hellos = 0
        super().__init__(path, held_grasp())

    def work(self, stop: threading.Event) -> None:
        """Serve until `stop`."""
        self.serve(stop.is_set)

    def _hello(self, nonce: int) -> Hello:
        hello = super()._hello(nonce)
        is_wrong = self._misread == self._hellos
        self._hellos += 1
        first, *others = hello.serials
        return replace(hello, serials=(first.replace("W", "V"), *others)) if is_wrong else hello


def keep_grasps(folder: Path, text: str) -> SessionFolder:
    """A kept session of the twin's sensors, calibrated, as a daemon would have left it."""
    scene = folder / "before.toml"
    scene.write_text(text)
    wanted = load_scene(scene)
    session = assembly.build_pipeline(plan.Plan.of(wanted), assembly.load_model(wanted)).session
    if session is None:
        raise ValueError("the model keeps no session")
    for counts in np.random.default_rng(SEED).integers(500, 3500, (KEPT_GRASPS, 3, 24)):
        session.observe(counts)
    serials: dict[str, str] = {
        finger: f"BTSP-TWIN-{at}" for at, finger in enumerate(wanted.hand.fingers)
    }
    with SessionFolder(wanted.session_path) as kept:
        kept.save([KeptSession(session.state(), wanted.hand.fingers, serials)])
    return kept


def kept_grasps(folder: SessionFolder) -> int:
    kept = last_kept(folder.path)
    return 0 if kept is None or kept.statistics is None else kept.statistics.grasps


def misread_serial(plan: Plan) -> Outcome:
    """One HELLO of the first eight is wrong."""
    wiped, tried = 0, 0
    for folder in plan.folders():
        tried += 1
        sections = f'{spi_section(folder)}[session]\nfolder = "{folder}/session"\n'
        file = keep_grasps(folder, sections)
        wrong = 1 + plan.random.randrange(8)
        with (
            MisreadTwin(folder / "bridge", wrong) as twin,
            at_work(twin.work),
            running(folder, sections) as (daemon, subscriber),
        ):
            heard = hear(subscriber, lambda heard: len(heard) >= SPI_VERDICTS, PATIENCE_S)
            daemon.terminate()
            daemon.wait(STOP_S)
        wiped += kept_grasps(file) < KEPT_GRASPS or len(heard) < SPI_VERDICTS
    happened = f"{wiped} of {tried} kept sessions of {KEPT_GRASPS} grasps wiped"
    return Outcome(tried, happened, wiped == 0)


def any_valid(heard: list[Verdict]) -> bool:
    """Whether something was judged."""
    return bool(heard) and heard[-1].valid


def never(_heard: list[Verdict]) -> bool:
    return False
