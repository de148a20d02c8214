"""Kill a daemon at random while a client tells it how lifts ended, and see what is lost.

    python -m tests.bench.outcomes [--outcomes 10000] [--kills 20]

The daemon plays a table, every row a grasp. What it publishes and acknowledges is noted; from that
alone it is learned here once more, without kills, and must come to the same state, to the bit: in
the daemon's file after every kill, and at the end.
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import zmq
from numpy.typing import NDArray

from deploy.clients.python.graspd_client import Client, Outcome, Verdict
from graspd.daemon import scene
from graspd.daemon.assembly import assembly
from graspd.daemon.session.file import SessionFile, kept_now, load
from graspd.daemon.trust.lift_book import GraspId, OutcomeStatus
from graspd.daemon.trust.trust import Trust, TrustState, decode
from graspd.drivers.base import TactileReading
from graspd.drivers.recordings.csv_player import DEMO_TABLE
from graspd.drivers.recordings.csv_rows import read_rows
from tests.daemon.processes import TIMEOUT_S, start, wait_for
from tests.kit.messages import decode_tactile, decode_verdict

RATE_HZ: Final = 50.0
"""256 grasps are remembered: an outcome that is told again must come within five seconds."""
ANSWER_S: Final = 0.5
"""How long the client waits for an answer unless told otherwise."""
LATE_S: Final = 0.1
"""The kill comes so long after the outcome that it was drawn for, at most."""
KNOWN_MAX: Final = 1000
"""Published grasps that are remembered here."""


@dataclass
class Found:
    """What came of it."""

    acknowledged: int = 0
    refused: int = 0
    """Told again after a kill that came before they were kept, and not known any more."""
    told_again: int = 0
    kills: int = 0
    written_unanswered: int = 0
    """Kills between the disk and the answer."""
    not_learned: int = 0
    """Acknowledged outcomes of grasps that the model had not judged."""
    stable: int = 0
    """Lifts of `stable` verdicts."""
    seconds: float = 0.0
    answers_ms: list[float] = field(default_factory=list)


class LostError(Exception):
    """The daemon's state is not what its acknowledged outcomes make."""


class Reference:
    """Learns from what was published and acknowledged, without a file and without kills."""

    def __init__(self, wanted: scene.Scene) -> None:
        self._scene, self._model = wanted, assembly.load_model(wanted)
        kept = load(wanted.session_path)
        if kept is None or kept.statistics is None:
            raise LostError("no session to begin with")
        self._statistics = kept.statistics
        trust = assembly.build_pipeline(wanted, self._model).trust
        if trust is None:
            raise LostError("nothing learns")
        self.trust: Trust = trust

    def note(self, grasp: GraspId, counts: NDArray[np.uint16], *, stable: bool) -> None:
        """Judge a published reading as the daemon did.

        With a judge of its own: to the one before it a row that it has had is an old one.
        """
        pipeline = assembly.build_pipeline(self._scene, self._model, learns=False)
        if pipeline.session is None:
            raise LostError("the model keeps no session")
        pipeline.session.restore(self._statistics)
        faults = np.zeros(counts.shape, dtype=np.uint8)
        pipeline.judge(TactileReading(time.monotonic_ns(), 0, counts, faults))
        assessment = pipeline.memory.assessment
        if assessment is not None:
            self.trust.lifts.note(grasp, assessment.features, stable=stable)

    def agrees(self, kept: TrustState) -> bool:
        """Whether that is the same, to the bit."""
        mine = self.trust.state()
        return (mine.learner, mine.risk) == (kept.learner, kept.risk)


class Bench:
    """A daemon that is killed, and a client that goes on."""

    def __init__(self, folder: Path, seed: int, stack: ExitStack) -> None:
        self.found = Found()
        self._choose = random.Random(seed)
        self._path = folder / "scene.toml"
        self._path.write_text(
            f'[tactile]\ndriver = "replay"\nloop = true\nrecordings = ["{DEMO_TABLE}"]\n'
            f"rate_hz = {RATE_HZ}\n[risk]\nmax_slip_when_stable = 0.2\n"
            '[session]\nfile = "right.session.json"\nkeep = true\nlearn = false\n'
            f'[publish]\nendpoint = "ipc://{folder}/graspd"\ntactile_hz = 10000\n[ask]\nendpoint = "ipc://{folder}/ask"\n'
        )
        self._scene = scene.load(self._path)
        self._seed_session()
        self._reference = Reference(self._scene)
        context = stack.enter_context(zmq.Context())
        self._log = stack.enter_context(context.socket(zmq.SUB))
        self._log.connect(f"ipc://{folder}/graspd")
        self._log.subscribe("tactile.")
        self._log.subscribe("verdict.")
        self._slipped = {
            row.counts.tobytes(): bool(row.annotation.slipped)
            for row in read_rows(DEMO_TABLE, self._scene.hand.fingers)
        }
        self._counts: dict[int, NDArray[np.uint16]] = {}
        self._known: dict[GraspId, tuple[NDArray[np.uint16], bool]] = {}
        self._client = stack.enter_context(
            Client(f"ipc://{folder}/graspd", ask_endpoint=f"ipc://{folder}/ask", max_age_ms=1e4)
        )
        self._ask = folder / "ask"
        self._start()
        stack.callback(self._end)

    def _seed_session(self) -> None:
        """Statistics that stay what they are: a grasp is then the same whenever it is judged."""
        pipeline = assembly.build_pipeline(self._scene, assembly.load_model(self._scene))
        for row in read_rows(DEMO_TABLE, self._scene.hand.fingers):
            pipeline.judge(TactileReading(time.monotonic_ns(), 0, row.counts, row.faults))
        if pipeline.session is None:
            raise LostError("the model keeps no session")
        with SessionFile(self._scene.session_path) as file:
            file.save(kept_now(pipeline.session.state(), self._scene.hand.fingers, {}))

    def run(self, outcomes: int, kills: int) -> Found:
        """Tell so many; raises `LostError` if an acknowledged one is lost."""
        began_s, former = time.monotonic(), None
        due = sorted(self._choose.sample(range(outcomes // 20, outcomes), kills))
        while self.found.acknowledged < outcomes:
            said = self._client.verdict(0.05)
            self._hear()
            grasp = GraspId(said.boot_id or "", said.grasp or 0)
            if grasp == former or grasp not in self._known:
                if self._process.poll() is not None:
                    self._look_and_start_again()
                continue
            former = grasp
            if due and self.found.acknowledged >= due[0]:
                del due[0]
                threading.Timer(self._choose.uniform(0.0, LATE_S), self._process.kill).start()
                self.found.kills += 1
            self._lift(grasp, said)
        self._process.terminate()
        self._process.communicate(timeout=TIMEOUT_S)
        if not self._reference.agrees(kept := self._kept()):
            raise LostError(self._differs(kept))
        self.found.seconds = time.monotonic() - began_s
        self.found.stable = self._reference.trust.risk.lifts
        return self.found

    def _lift(self, grasp: GraspId, said: Verdict) -> None:
        counts, stable = self._known[grasp]
        slipped = self._slipped[counts.tobytes()]
        how = Outcome.SLIPPED if slipped else Outcome.HELD
        self._reference.note(grasp, counts, stable=stable)
        began_s = time.monotonic()
        while not (answer := self._client.tell(said, how, wait_s=ANSWER_S)):
            if answer.why.startswith("unknown"):
                self.found.refused += 1
                return
            if self._process.poll() is not None:
                self._look_and_start_again((grasp, slipped))
            self.found.told_again += 1
        self.found.answers_ms.append((time.monotonic() - began_s) * 1e3)
        self.found.acknowledged += 1
        if self._reference.trust.outcome(grasp, slipped=slipped) is OutcomeStatus.UNKNOWN:
            self.found.not_learned += 1

    def _look_and_start_again(self, told: tuple[GraspId, bool] | None = None) -> None:
        """After a kill the file holds what was acknowledged, and at most the one outcome more."""
        kept = self._kept()
        if not self._reference.agrees(kept):
            more = Reference(self._scene)
            more.trust.restore(self._reference.trust.state())
            if told is not None:
                more.trust.outcome(told[0], slipped=told[1])
            if not more.agrees(kept):
                raise LostError(self._differs(kept))
            # It counts, however long the next start takes, and whether it is known then.
            self._reference.trust.restore(more.trust.state())
            self.found.written_unanswered += 1
        self._process.communicate(timeout=TIMEOUT_S)
        self._start()

    def _differs(self, kept: TrustState) -> str:
        mine = self._reference.trust.state()
        return (
            f"after kill {self.found.kills} and {self.found.acknowledged} outcomes the state is "
            f"another one: of {kept.learner.outcomes} outcomes, {kept.risk}; "
            f"expected {mine.learner.outcomes}, {mine.risk}"
        )

    def _kept(self) -> TrustState:
        kept = load(self._scene.session_path)
        if kept is None or kept.trust is None:
            raise LostError("nothing is kept")
        return decode(kept.trust)

    def _hear(self) -> None:
        """Note what was published."""
        while self._log.poll(0):
            topic, payload = self._log.recv_multipart()
            if topic.startswith(b"tactile."):
                reading = decode_tactile(payload)
                self._counts[reading.t_mono_ns] = np.array(reading.counts, dtype=np.uint16)
                continue
            verdict = decode_verdict(payload)
            counts = self._counts.pop(verdict.t_mono_ns, None)
            if counts is not None:
                grasp = GraspId(verdict.boot_id, verdict.grasp)
                self._known[grasp] = counts, verdict.verdict == "stable"
                if len(self._known) > KNOWN_MAX:
                    del self._known[next(iter(self._known))]

    def _start(self) -> None:
        self._process = start("run", self._path)
        wait_for(self._ask)

    def _end(self) -> None:
        self._process.kill()
        self._process.communicate(timeout=TIMEOUT_S)


def kill_often(folder: Path, outcomes: int, kills: int, seed: int) -> Found:
    """What came of so many outcomes and kills. Raises `LostError` if one was lost."""
    with ExitStack() as stack:
        return Bench(folder, seed, stack).run(outcomes, kills)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what came of it; 1 if an acknowledged outcome was lost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--outcomes", type=int, default=10_000)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        try:
            found = kill_often(Path(folder), args.outcomes, args.kills, args.seed)
        except (LostError, OSError, subprocess.SubprocessError) as error:
            sys.stderr.write(f"{error}\n")
            return 1
    answers = sorted(found.answers_ms)
    sys.stdout.write(
        f"{found.acknowledged} outcomes acknowledged, {found.kills} kills, seed {args.seed}: none "
        f"lost, learner and risk are the same to the bit; {found.stable} lifts were of `stable` "
        f"verdicts, {found.not_learned} of none; {found.told_again} told again, "
        f"{found.refused} refused after a kill, {found.written_unanswered} kills between disk and "
        f"answer; answers after {answers[len(answers) // 2]:.1f} ms, 99 % within "
        f"{answers[len(answers) * 99 // 100]:.0f} ms; {found.seconds:.0f} s\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
