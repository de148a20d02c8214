"""Questions to the daemon: each gets one answer, and nothing that comes in hurts."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from graspd.daemon.publish.porter import Frames
from graspd.daemon.publish.questions import Questions
from tests.daemon.publish.doors import USER, Asked, published

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
def test_other_frames_than_questions_are_counted_and_not_answered(
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
