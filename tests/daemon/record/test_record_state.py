"""Each file has the state at its start, and later events that change the state from outside."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import cast

import pytest
from msgspec.structs import replace

from graspd.daemon import scene
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.parts import Parts, build_recorder
from graspd.daemon.assembly.plan import Plan
from graspd.daemon.assembly.recordings import RecordedRun
from graspd.daemon.judge.exchange import Exchanged
from graspd.daemon.judge.pipeline import Judgement
from graspd.daemon.judge.reasons import Decision, GateState, Reason
from graspd.daemon.publish.companion import LoopEvent, PublishedVerdict
from graspd.daemon.publish.messages import Verdict
from graspd.daemon.publish.outbox import Outbox
from graspd.daemon.record.mcap import RecordingHeader
from graspd.daemon.record.mcap_reader import header_of
from graspd.daemon.record.recorder import Recorder
from graspd.drivers.base import TactileReading
from graspd.drivers.recordings.csv_player import DEMO_RECORDING, ReplayDriver
from graspd.drivers.twins.grasps.grasp_script import Durations
from graspd.drivers.twins.grasps.whole_grasps import synthetic_grasps
from tests.daemon.fakes import NO_LIFT, sound
from tests.daemon.record.recorded import BOOT, HEADER, NO_STATUS, files, messages, recorder
from tests.kit.clock import Clock

MS = 1_000_000
STATUS, VERDICT = b"status.right", b"verdict.right"
START_NS = 10**12
NO_VERDICT = cast(Verdict, None)
"""Verdict in the argument of `on_verdict`, which a recorder ignores: it records what is sent."""


class Loop:
    """Stand-in for the loop; its headers say how many messages it had sent before the file."""

    def __init__(self) -> None:
        self.sent = 0

    def header(self) -> Callable[[], RecordingHeader]:
        header = replace(HEADER, grasps=self.sent)
        return lambda: header

    def send(self, recorder: Recorder, topic: bytes) -> None:
        payload = json.dumps({"number": self.sent}).encode()
        self.sent += 1
        recorder.send(topic, payload)
        if topic == STATUS:
            recorder.on_status(NO_STATUS)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Clock of a recorder whose thread sleeps: tests call `go_round`. Files end after 600 ms."""
    monkeypatch.setattr("graspd.daemon.record.recorder.ROUNDS_PER_FLUSH", 1e-6)
    monkeypatch.setattr("graspd.daemon.record.recorder.ROTATE_NS", 600 * MS)
    return Clock()


def pass_time(clock: Clock, writing: Recorder) -> dict[str, int]:
    """Let 20 ms pass and the recorder go one round; return its counters."""
    clock.now_ns += 20 * MS
    writing.go_round()
    return writing.counters["record"]


def test_each_files_header_has_the_state_at_its_start(tmp_path: Path, clock: Clock) -> None:
    loop = Loop()
    loop.sent = 7
    writing = recorder(tmp_path, loop.header, clock=clock)
    while pass_time(clock, writing)["files"] < 4:
        for _ in range(20):
            loop.send(writing, VERDICT)
        loop.send(writing, STATUS)
    loop.send(writing, STATUS)
    writing.close()
    number = 7
    for path in files(tmp_path):
        assert header_of(path).grasps == number
        found = messages(path)
        assert [content["number"] for _, content in found] == [*range(number, number + len(found))]
        assert found[-1][0] == "status"
        number += len(found)
    assert number == loop.sent
    assert writing.counters["record"]["recorded"] == loop.sent - 7


def test_a_failing_disk_is_warned_of_once_and_retried(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr("graspd.daemon.record.recorder.RETRY_NS", 100 * MS)
    blocked = tmp_path / "record"
    blocked.write_text("a file where the folder should be")
    loop = Loop()
    writing = recorder(tmp_path, loop.header, clock=clock)
    while pass_time(clock, writing)["failures"] < 3:
        loop.send(writing, STATUS)
    assert [each.levelname for each in caplog.records] == ["WARNING"]
    assert writing.counters["record"]["writing"] == 0
    blocked.unlink()
    while not pass_time(clock, writing)["writing"]:
        loop.send(writing, VERDICT)
        loop.send(writing, STATUS)
    loop.send(writing, VERDICT)
    writing.close()
    (path,) = files(tmp_path)
    known = header_of(path).grasps
    assert [content["number"] for _, content in messages(path)] == [*range(known, loop.sent)]
    assert writing.counters["record"]["lost"] == known > 0


class Daemon:
    """The parts of a daemon that judge and record; readings set its clock."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        path = folder / "scene.toml"
        path.write_text(
            '[tactile]\ndriver = "spi"\nport = "/dev/null"\n[session]\nkeep = false\n'
            '[record]\ndirectory = "record"\n'
        )
        wanted = scene.load(path)
        model = assembly.load_model(wanted)
        self._now_ns = START_NS
        monkeypatch.setattr("graspd.daemon.record.recorder.ROTATE_NS", 3_000 * MS)
        monkeypatch.setattr("graspd.daemon.record.recorder.ROUNDS_PER_FLUSH", 1e-6)
        monkeypatch.setattr(
            "graspd.daemon.record.recorder.Recorder", partial(Recorder, clock=self._clock)
        )
        plan = Plan.of(wanted)
        self.pipeline = assembly.build_pipeline(plan, model, self._clock)
        self.pipeline.boot_id = BOOT
        assert wanted.record is not None
        parts = Parts(plan, model, self.pipeline, [])
        self.recorder = build_recorder(parts, wanted.record, BOOT, None)
        self._outbox = Outbox("right", wanted.hand.fingers, "any", BOOT, [self.recorder])

    def _clock(self) -> int:
        return self._now_ns

    def judge(self, reading: TactileReading, ages_ms: tuple[int, int] = (0, 0)) -> Judgement:
        """Judge and record a reading; after every 100th write the queue and send a status.

        `ages_ms`: age of the reading before the model runs, and after it.
        """
        ages = iter(ages_ms)
        self._now_ns = reading.t_ns
        self._outbox.tactile(reading, {})
        self.pipeline.clock = lambda: reading.t_ns + next(ages) * 1_000_000
        judgement = self.pipeline.judge(reading)
        if Reason.STALE in judgement.reasons:  # a lift that waited is taken back first
            self.recorder.on_event(LoopEvent.TAKEN_BACK)
        self.recorder.on_verdict(
            PublishedVerdict(judgement, NO_VERDICT, b"", reading, True, *NO_LIFT)
        )
        self.pipeline.learn()
        if reading.seq % 100 == 99:
            self.recorder.go_round()
            self.recorder.send(STATUS, b"{}")
            self.recorder.on_status(NO_STATUS)
        return replace(judgement, judged_counts=None)  # arrays are not compared


def sweeps() -> list[TactileReading]:
    """Return the sweeps of the demo recording, as if they came live, at its pace."""
    found = []
    with ReplayDriver([DEMO_RECORDING], speed=None, clock=lambda: 0) as driver:
        while not driver.exhausted:
            for reading in driver.read_ready():
                if isinstance(reading, TactileReading):
                    t_ns = START_NS + reading.made_ns
                    found.append(replace(reading, t_ns=t_ns, recorded_ns=None, annotation=None))
    return found


def again(*paths: Path) -> list[Judgement]:
    """Return the judgements of a replay of `paths`, with the recorded times of the readings."""
    run = RecordedRun(paths)
    wanted = run.scene({}, {}, None)
    parts = run.parts(wanted, assembly.load_model(wanted), None)
    (driver,), pipeline = parts.drivers, parts.pipeline
    run.restore(pipeline)
    found = []
    driver.open()
    with closing(driver):
        while not driver.exhausted:
            for reading in driver.read_ready():
                assert isinstance(reading, TactileReading)
                judgement = pipeline.judge(reading)
                found.append(replace(judgement, t_ns=reading.made_ns, judged_counts=None))
                pipeline.learn()
    return found


def judged_grasps(judgements: list[Judgement]) -> list[tuple[int, Decision]]:
    """Return the number and decision of each grasp, by its first judgement."""
    return [(each.moment.grasp, each.decision) for each in judgements if each.moment.judged]


@pytest.mark.slow
def test_a_later_file_replays_alike_once_the_hand_was_idle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon = Daemon(tmp_path, monkeypatch)
    rests = Durations(first_rest_s=(3.0, 3.0), rest_s=(2.5, 3.5))
    stream = enumerate(synthetic_grasps(7, durations=rests, seed=3))
    made = (sound(each.counts, START_NS + place * 10_000_000, place) for place, each in stream)
    expected = [daemon.judge(each) for each in made]
    daemon.recorder.close()
    assert again(*files(tmp_path)) == expected
    compared = 0
    for path in files(tmp_path)[1:]:
        if compared >= 2:
            break
        times = {content["t_mono_ns"] for kind, content in messages(path) if kind == "tactile"}
        then, rest = [each for each in expected if each.t_ns in times], 0
        for place, each in enumerate(then):
            rest = rest + 1 if each.moment.state is GateState.IDLE else 0
            if rest == 130:
                found = judged_grasps(again(path)[place:])
                assert found == judged_grasps(then[place:])
                compared += len(found)
    assert compared >= 2


def test_a_replay_repeats_sensor_exchanges_and_late_readings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Readings that were late only because the model was slow are late again too."""
    daemon = Daemon(tmp_path, monkeypatch)
    expected, states = [], []
    ages_ms = {7: (101, 101), 8: (101, 120), 20: (50, 101), 31: (0, 200), 32: (100, 100)}
    for reading in sweeps()[:1700]:
        if reading.seq in (1250, 1500):
            assert daemon.pipeline.session is not None
            states.append(daemon.pipeline.session.state())
            known = Exchanged(states[0] if reading.seq == 1500 else None)
            daemon.pipeline.sensors_exchanged(known)
        expected.append(daemon.judge(reading, ages_ms.get(reading.seq % 50, (0, 0))))
    daemon.recorder.close()
    assert states[0].grasps > 3 > states[1].grasps
    assert expected[1249].reasons != expected[1250].reasons
    late = [each for each in expected if Reason.STALE in each.reasons]
    assert len(late) == 1700 // 50 * 4
    assert {each.moment.judges for each in late} == {False, True}
    assert again(*files(tmp_path)) == expected
