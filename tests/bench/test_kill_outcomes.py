"""No acknowledged outcome is lost when a daemon is killed while a client tells how lifts ended.

The daemon plays a table, every row a grasp. What it publishes and acknowledges is noted; from that
alone it is learned here once more, without kills, and must come to the same state, to the bit: in
the daemon's file after every kill, and at the end.
"""

from __future__ import annotations

import random
import threading
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import pytest
from numpy.typing import NDArray

from deploy.clients.python.graspd_client import Client, Outcome, Verdict
from graspd.daemon import scene
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.plan import Plan
from graspd.daemon.session.file import KeptSession
from graspd.daemon.session.folder import SessionFolder
from graspd.daemon.trust.lift_book import GraspId, OutcomeStatus
from graspd.daemon.trust.trust import Trust, TrustState
from graspd.drivers.recordings.csv_player import DEMO_TABLE
from graspd.drivers.recordings.csv_rows import read_rows
from tests.bench.live import Subscriber
from tests.daemon.fakes import Clock, sound
from tests.daemon.processes import TIMEOUT_S, start, wait_for
from tests.daemon.session.learning import last_kept
from tests.kit.messages import decode_tactile, decode_verdict

ANSWER_S: Final = 0.5
"""How long the client waits for an answer unless told otherwise."""
LATE_S: Final = 0.1
"""Longest time from an outcome to the kill that was drawn for it, s."""
KNOWN_MAX: Final = 1000
"""Published grasps that are remembered here."""


class Reference:
    """Learns from what was published and acknowledged, without a file and without kills."""

    def __init__(self, wanted: scene.Scene) -> None:
        self._scene, self._model = wanted, assembly.load_model(wanted)
        kept = last_kept(wanted.session_path)
        assert kept is not None
        assert kept.statistics is not None
        self._statistics = kept.statistics
        trust = assembly.build_pipeline(Plan.of(wanted), self._model).trust
        assert trust is not None
        self.trust: Trust = trust

    def note(self, grasp: GraspId, counts: NDArray[np.uint16], *, stable: bool) -> None:
        """Judge a published reading as the daemon did.

        With a judge of its own: to the one before it a row that it has had is an old one.
        """
        plan, clock = Plan.of(self._scene), Clock()
        pipeline = assembly.build_pipeline(plan, self._model, clock, learns=False)
        assert pipeline.session is not None
        pipeline.session.restore(self._statistics)
        assessment = pipeline.judge(sound(counts, clock())).assessment
        if assessment is not None:
            self.trust.lifts.note(grasp, assessment.features, stable=stable)

    def agrees(self, kept: TrustState) -> bool:
        """Whether that is the same, to the bit."""
        mine = self.trust.state()
        return (mine.learner, mine.risk) == (kept.learner, kept.risk)


class Bench:
    """A daemon that is killed, and a client that goes on."""

    def __init__(self, folder: Path, seed: int, stack: ExitStack) -> None:
        self.acknowledged = self.kills = self.not_learned = 0
        self._choose = random.Random(seed)
        self._path = folder / "scene.toml"
        self._path.write_text(
            f'[tactile]\ndriver = "replay"\nloop = true\nrecordings = ["{DEMO_TABLE}"]\n'
            "[risk]\nmax_slip_when_stable = 0.2\n"
            '[session]\nfolder = "right.session"\nkeep = true\nlearn = false\n'
            f'[publish]\nendpoint = "ipc://{folder}/graspd"\ntactile_hz = 10000\n'
            f'[ask]\nendpoint = "ipc://{folder}/ask"\n'
        )
        self._scene = scene.load(self._path)
        self._seed_session()
        self._reference = Reference(self._scene)
        topics = ("tactile.", "verdict.")
        self._log = stack.enter_context(Subscriber(f"ipc://{folder}/graspd", topics=topics))
        self._slipped = {
            row.counts.tobytes(): bool(row.annotation.slipped)
            for row in read_rows(DEMO_TABLE, self._scene.hand.fingers)
        }
        self._counts: dict[int, NDArray[np.uint16]] = {}
        self._known: dict[GraspId, tuple[NDArray[np.uint16], bool]] = {}
        self._not_lifted: list[GraspId] = []
        """Offers that were on the disk when the daemon was killed."""
        self._client = stack.enter_context(
            Client(f"ipc://{folder}/graspd", ask_endpoint=f"ipc://{folder}/ask", max_age_ms=1e4)
        )
        self._ask = folder / "ask"
        self._start()
        stack.callback(self._end)

    def _seed_session(self) -> None:
        """Statistics that stay what they are: a grasp is then the same whenever it is judged."""
        plan, model, clock = Plan.of(self._scene), assembly.load_model(self._scene), Clock()
        pipeline = assembly.build_pipeline(plan, model, clock)
        for row in read_rows(DEMO_TABLE, self._scene.hand.fingers):
            pipeline.judge(sound(row.counts, clock()))
        assert pipeline.session is not None
        with SessionFolder(self._scene.session_path) as folder:
            folder.save([KeptSession(pipeline.session.state(), self._scene.hand.fingers, {})])

    def run(self, outcomes: int, kills: int) -> None:
        """Tell that many outcomes, with as many kills; fail if an acknowledged one is lost."""
        former = None
        due = sorted(self._choose.sample(range(outcomes // 20, outcomes), kills))
        while self.acknowledged < outcomes:
            said = self._client.verdict(0.05)
            self._hear()
            grasp = GraspId(said.boot_id or "", said.grasp or 0)
            self._leave_lifts(said)
            if grasp == former or grasp not in self._known:
                if self._process.poll() is not None:
                    self._look_and_start_again()
                continue
            former = grasp
            if due and self.acknowledged >= due[0]:
                del due[0]
                threading.Timer(self._choose.uniform(0.0, LATE_S), self._process.kill).start()
                self.kills += 1
            self._lift(grasp, said)
        self._process.terminate()
        self._process.communicate(timeout=TIMEOUT_S)
        kept = self._kept()
        assert self._reference.agrees(kept), self._differs(kept)

    def _lift(self, grasp: GraspId, said: Verdict) -> None:
        counts, stable = self._known[grasp]
        slipped = self._slipped[counts.tobytes()]
        how = Outcome.SLIPPED if slipped else Outcome.HELD
        self._reference.note(grasp, counts, stable=stable)
        while not (answer := self._client.tell(said, how, wait_s=ANSWER_S)):
            if answer.why.startswith("unknown"):
                return  # the kill came before it was kept, and it is not known any more
            if answer.why.startswith("not yours"):
                # Since its start the daemon has offered this client no lift. The offer counts: with
                # every row a grasp none lasts until it is on the disk and answered.
                self._client.may_i_lift(ANSWER_S, supervised=True)
            if self._process.poll() is not None:
                self._look_and_start_again((grasp, slipped))
        self.acknowledged += 1
        if self._reference.trust.outcome(grasp, slipped=slipped) is OutcomeStatus.UNKNOWN:
            self.not_learned += 1  # the model had not judged it

    def _look_and_start_again(self, told: tuple[GraspId, bool] | None = None) -> None:
        """After a kill the file holds what was acknowledged, and at most the one outcome more."""
        kept = self._kept()
        if not self._reference.agrees(kept):
            more = Reference(self._scene)
            more.trust.restore(self._reference.trust.state())
            if told is not None:
                more.trust.outcome(told[0], slipped=told[1])
            assert more.agrees(kept), self._differs(kept)
            # It counts, however long the next start takes, and whether it is known then.
            self._reference.trust.restore(more.trust.state())
        self._process.communicate(timeout=TIMEOUT_S)
        self._not_lifted = [lift.id for lift in kept.lifts.records if lift.is_awaited]
        self._start()

    def _leave_lifts(self, said: Verdict) -> None:
        """Report that no lift followed an offer which a kill cut off.

        Without an outcome it would count as a slip once it leaves the book.
        """
        while self._not_lifted and self._process.poll() is None:
            boot_id, grasp = self._not_lifted[0]
            offer = replace(said, boot_id=boot_id, grasp=grasp)
            answer = self._client.tell(offer, Outcome.NOT_LIFTED, wait_s=ANSWER_S)
            if answer or answer.why.startswith("unknown"):
                del self._not_lifted[0]

    def _differs(self, kept: TrustState) -> str:
        mine = self._reference.trust.state()
        return (
            f"after kill {self.kills} and {self.acknowledged} outcomes the state is "
            f"another one: of {kept.learner.outcomes} outcomes, {kept.risk}; "
            f"expected {mine.learner.outcomes}, {mine.risk}"
        )

    def _kept(self) -> TrustState:
        kept = last_kept(self._scene.session_path)
        assert kept is not None
        assert kept.trust is not None
        return kept.trust

    def _hear(self) -> None:
        """Note what was published."""
        while (message := self._log.take(0.0)) is not None:
            topic, payload = message
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


@pytest.mark.slow
def test_no_acknowledged_outcome_is_lost_by_a_kill(tmp_path: Path) -> None:
    with ExitStack() as stack:
        bench = Bench(tmp_path, 7, stack)
        bench.run(outcomes=90, kills=3)
    assert (bench.acknowledged, bench.kills) == (90, 3)
    assert bench.not_learned < 9
