"""Questions to the daemon: each gets one answer, and nothing that comes in hurts."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pytest
import zmq

from graspd.daemon.judge.reasons import Decision
from graspd.daemon.publish.messages import Verdict
from graspd.daemon.publish.porter import Frames
from graspd.daemon.publish.questions import Questions
from graspd.drivers.recordings.csv_player import DEMO_RECORDING
from tests.daemon.processes import TIMEOUT_S, start, wait_for
from tests.daemon.publish.doors import USER, Asked, Peers, published
from tests.kit.messages import decode_verdict
from tests.kit.waiting import wait_until

PATIENCE_NS = 1_000_000_000


@pytest.fixture
def sent() -> list[Frames]:
    """What was answered."""
    return []


@pytest.fixture
def questions(sent: list[Frames]) -> Questions:
    def send(frames: Sequence[bytes]) -> bool:
        sent.append([*frames])
        return True

    return Questions(send, PATIENCE_NS)


def test_the_daemons_clock_is_told_at_once_and_judges_nothing(
    questions: Questions, sent: list[Frames]
) -> None:
    requests = Asked()
    questions.take([[b"asker", USER, b"clock"]], 1_234_567_890_123, requests)
    assert sent == [[b"asker", b'{"v":1,"t_mono_ns":1234567890123}']]
    assert (requests.times, questions.counters["clocks"], questions.waiting) == (0, 1, {})


@pytest.mark.parametrize("text", [b"judge", b"lift"])
@pytest.mark.parametrize("delimiter", [[], [b""]], ids=["DEALER", "REQ"])
def test_a_question_gets_one_answer(
    questions: Questions, sent: list[Frames], delimiter: list[bytes], text: bytes
) -> None:
    requests = Asked()
    questions.take([[b"asker", USER, *delimiter, text]], 0, requests)
    assert (requests.times, len(questions.waiting)) == (1, 1)
    questions.answer(published(b"{}"))
    questions.answer(published(b"{}"))
    ((*envelope, answer),) = sent
    assert envelope == [b"asker", *delimiter]
    assert json.loads(answer).get("owner") == ("another" if text == b"lift" else None)
    assert len(questions.waiting) == 0
    short_id = {"not_theirs": 1} if text == b"lift" else {}
    assert questions.counters == {"asked": 1, "answered": 1, "dropped": 0} | short_id


@pytest.mark.parametrize(
    "frames",
    [
        [b""],
        [b"Judge"],
        [b"judge", b"judge"],
        [b"", b"", b"judge"],
        [b"judge", b""],
        [b"\xff" * 128],
        [b"judge mug"],
        [b"lift mug"],
    ],
)
def test_what_is_no_question_is_counted_and_not_answered(
    questions: Questions, sent: list[Frames], frames: list[bytes]
) -> None:
    requests = Asked()
    questions.take([[b"asker", USER, *frames]], 0, requests)
    assert requests.times == 0
    questions.take([[b"asker", USER, b"judge"]], 0, requests)
    questions.answer(published(b"{}"))
    assert sent == [[b"asker", b"{}"]]
    assert questions.counters["malformed"] == 1


def test_before_the_first_reading_silence_is_the_answer(
    questions: Questions, monkeypatch: pytest.MonkeyPatch
) -> None:
    requests, silences = Asked(), list[bool]()
    monkeypatch.setattr(requests, "silence", lambda: silences.append(True))
    questions.take([[b"asker", USER, b"judge"]], 0, requests)
    questions.serve([], PATIENCE_NS, requests)
    assert silences == [True]


def test_an_answer_that_is_dropped_is_counted() -> None:
    questions = Questions(lambda _frames: False, PATIENCE_NS)
    questions.take([[b"asker", USER, b"judge"]], 0, Asked())
    questions.answer(published(b"{}"))
    assert questions.counters["dropped"] == 1


def scene(folder: Path, mode: str, request_ms: float) -> Path:
    path = folder / "scene.toml"
    path.write_text(
        '[tactile]\ndriver = "replay"\nloop = true\n'
        f'recordings = ["{DEMO_RECORDING}"]\n'
        f'[gate]\nmode = "{mode}"\nrequest_ms = {request_ms}\n[model]\nname = "cnn1"\n'
        f'[publish]\nendpoint = "ipc://{folder}/graspd"\n[ask]\nendpoint = "ipc://{folder}/ask"\n'
    )
    return path


def ask(asker: zmq.Socket[bytes]) -> Verdict:
    """One answer."""
    asker.send(b"judge")
    return decode_verdict(asker.recv())


def test_a_controller_that_asks_gets_its_verdict_or_unknown(tmp_path: Path, peers: Peers) -> None:
    with start("run", scene(tmp_path, "request", 200.0)) as daemon:
        wait_for(tmp_path / "ask")
        asker = peers.connect(zmq.REQ, f"ipc://{tmp_path}/ask")
        answers: list[Verdict] = []

        def has_had_both() -> bool:
            """Both what was judged, and that the time was over before something could be."""
            answers.append(answer := ask(asker))
            assert answer.valid == (answer.judged and answer.verdict is not Decision.UNKNOWN)
            judged = [answer.judged for answer in answers]
            return len([answer for answer in answers if answer.valid]) >= 2 and not all(judged)

        wait_until(has_had_both)
        daemon.terminate()
        daemon.communicate(timeout=TIMEOUT_S)
    for answer in answers:
        assert answer.valid or answer.reasons
        if not answer.judged:
            assert answer.verdict is Decision.UNKNOWN


def test_without_a_gate_the_next_verdict_answers(tmp_path: Path, peers: Peers) -> None:
    with start("run", scene(tmp_path, "settled", 10_000.0)) as daemon:
        wait_for(tmp_path / "ask")
        asker = peers.connect(zmq.REQ, f"ipc://{tmp_path}/ask")
        # Did each wait until its time was over, the test's would be, too.
        answers = [ask(asker) for _ in range(60)]
        daemon.terminate()
        daemon.communicate(timeout=TIMEOUT_S)
    assert [answer.seq for answer in answers] == sorted({answer.seq for answer in answers})
