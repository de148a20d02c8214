"""Questions and reported outcomes: each gets one answer; malformed messages do no harm."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, Literal

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graspd.daemon.publish.companion import KEPT, Answer, Reply, Told
from graspd.daemon.publish.messages import OutcomeMessage, decode_outcome, schema
from graspd.daemon.publish.outbox import Outbox
from graspd.daemon.publish.questions import Questions
from graspd.daemon.trust.lift_book import GraspId, LiftBook, Peer, Report
from tests.daemon.fakes import FINGERS, Clock, sound
from tests.daemon.publish.doors import USER, published
from tests.daemon.publish.doors import Asked as Requests
from tests.kit.loops import SentMessages

BOOT = "0123456789abcdef" * 2
NOW_NS = 10**12
BOTH: tuple[Literal["stable", "slip"], ...] = ("stable", "slip")


def outbox(output: SentMessages) -> Outbox:
    return Outbox(
        "right", FINGERS, "fake", "0" * 64, [output], Clock(NOW_NS), lambda: 5.0, boot_id=BOOT
    )


def test_outcomes_are_published_as_the_schema_says() -> None:
    output = SentMessages()
    sender = outbox(output)
    for outcome in BOTH:
        sender.outcome(Report(GraspId(BOOT, 3), outcome, "mug"))
    assert [topic for topic, _ in output.sent] == [b"outcome.right"] * 2
    payloads = [payload for _, payload in output.sent]
    assert [decode_outcome(payload) for payload in payloads] == [
        OutcomeMessage(
            boot_id=BOOT, seq=seq, t=5.0, t_mono_ns=NOW_NS, grasp=3, outcome=outcome, object="mug"
        )
        for seq, outcome in enumerate(BOTH)
    ]
    for payload in payloads:
        jsonschema.validate(json.loads(payload), schema() | {"$ref": "#/$defs/OutcomeMessage"})


def test_an_outcome_of_an_earlier_start_names_that_start() -> None:
    output = SentMessages()
    sender = outbox(output)
    for boot_id, judged_by in ((BOOT, None), ("f" * 32, "f" * 32)):
        sender.outcome(Report(GraspId(boot_id, 3), "slip"))
        message = decode_outcome(output.sent[-1][1])
        assert (message.boot_id, message.grasp, message.grasp_boot_id) == (BOOT, 3, judged_by)


TELLER = b"teller"


class Asked:
    """`Questions`, and the frames of the answers that it sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[bytes, ...]] = []
        self.questions = Questions(self._send, 10**9)

    def _send(self, frames: Sequence[bytes]) -> bool:
        self.sent.append(tuple(frames))
        return True

    def tell(self, peer: bytes, *frames: bytes, requests: Requests | None = None) -> dict[str, Any]:
        """Report an outcome by `frames`; return the answer.

        `requests`: stand-in for the loop; None: one that takes only outcomes of grasp 7.
        """
        requests = requests or Requests(takes_the_seventh)
        self.questions.take([[peer, USER, *frames]], 0, requests)
        assert requests.times == 0
        answer: dict[str, Any] = json.loads(self.sent[-1][-1])
        assert self.sent[-1] == (peer, *frames[:-1], self.sent[-1][-1])
        return answer


def takes_the_seventh(report: Report) -> Reply:
    return KEPT if report.grasp == GraspId(BOOT, 7) else Reply(Told.UNKNOWN_GRASP, "no such")


@pytest.fixture
def asked() -> Asked:
    return Asked()


def test_a_clock_question_is_answered_at_once_without_a_judgement(asked: Asked) -> None:
    requests = Requests()
    asked.questions.take([[b"asker", USER, b"clock"]], 1_234_567_890_123, requests)
    assert asked.sent == [(b"asker", b'{"v":1,"t_mono_ns":1234567890123}')]
    assert (requests.times, asked.questions.counters["clocks"]) == (0, 1)
    assert asked.questions.waiting == {}


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
    asked: Asked, frames: list[bytes]
) -> None:
    requests = Requests()
    asked.questions.take([[b"asker", USER, *frames]], 0, requests)
    assert requests.times == 0
    asked.questions.take([[b"asker", USER, b"judge"]], 0, requests)
    asked.questions.answer(published(b"{}"))
    assert asked.sent == [(b"asker", b"{}")]
    assert asked.questions.counters["malformed"] == 1


def test_a_question_due_before_the_first_reading_publishes_silence(
    asked: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    requests, silences = Requests(), list[bool]()
    monkeypatch.setattr(requests, "silence", lambda: silences.append(True))
    asked.questions.take([[b"asker", USER, b"judge"]], 0, requests)
    asked.questions.serve([], 10**9, requests)
    assert silences == [True]


@pytest.mark.parametrize(
    ("answers", "restarts", "left"),
    [
        (["stable"], False, []),
        (["stable", "stable"], False, [1]),
        (["stable", "slip"], False, [1]),
        (["stable", "told"], False, [1]),
        (["stable", "stable"], True, [1]),
    ],
)
def test_not_lifting_takes_back_only_the_last_lift(
    asked: Asked, answers: list[str], restarts: bool, left: list[int]
) -> None:
    """The answers are to a `lift` of grasp 1, then 2; `told`: `stable`, and its outcome is told."""
    requests, book = Requests(), LiftBook()
    peer = [TELLER.ljust(16), USER]
    for number, name in enumerate(answers, 1):
        grasp, name = GraspId("0" * 32, number), name.replace("told", "stable")
        book.note(grasp, bytes(8), stable=name == "stable")
        asked.questions.take([[*peer, b"lift"]], 0, requests)
        asked.questions.answer(published(b"{}", name, book, grasp=number))
        asked.questions.answer(published(b"{}", name, book, grasp=number))
        if answers[number - 1] == "told":
            book.tell(grasp, slipped=False)
    if restarts:
        asked = Asked()
        asked.questions.answer(published(lifts=book))
    for _ in range(2):  # the second has nothing to take back
        asked.questions.take([[*peer, b"not-lifting"]], 0, requests)
        for report in requests.outcomes:
            assert report.outcome == "not-lifted"
            book.take_back(report.grasp)
    assert [lift.id.grasp for lift in book.state().records if lift.is_awaited] == left
    assert json.loads(asked.sent[-1][-1]) == {"v": 1, "ok": True}


@pytest.mark.parametrize(
    ("name", "is_silence", "age_ms", "reasons"),
    [
        ("unknown", False, 0, ["parity", "no-contact"]),
        ("unknown", False, 100, ["parity", "no-contact"]),
        ("unknown", False, 101, ["stale"]),
        ("unknown", True, 0, ["stale"]),
        ("stable", False, 0, ["stale"]),
        ("slip", False, 0, ["stale"]),
    ],
)
def test_an_overdue_question_gets_the_last_reasons_until_silence(
    asked: Asked, name: str, is_silence: bool, age_ms: int, reasons: list[str]
) -> None:
    """The golden verdicts tell that 100 ms are silence."""
    requests, judged_ns = Requests(), 10**9 - age_ms * 10**6
    last = ["parity", "no-contact"] if name == "unknown" else []
    verdict = published(name=name, t_mono_ns=judged_ns, reasons=last)
    asked.questions.take([[b"asker", USER, b"judge"]], 0, requests)
    reading = None if is_silence else sound(np.zeros((3, 24), np.uint16), judged_ns)
    asked.questions.answer(verdict._replace(reading=reading), judged_ns - 1)
    assert asked.sent == []
    asked.questions.serve([], 10**9, requests)
    answer = json.loads(asked.sent[0][1])
    assert (answer["verdict"], answer["reasons"]) == ("unknown", reasons)
    assert (answer["p_slip"], answer["valid"], answer["judged"]) == (None, False, False)


@pytest.mark.parametrize(("name", "early"), [("stable", True), ("slip", True), ("unknown", False)])
def test_a_lift_refused_for_its_routing_id_is_answered_as_judge(
    asked: Asked, caplog: pytest.LogCaptureFixture, name: str, early: bool
) -> None:
    asked.questions.take([[TELLER, USER, b"lift"]], 0, Requests())
    asked.questions.answer(published(name=name, early=True, supervised=True))
    answer = json.loads(asked.sent[0][-1])
    assert (answer["verdict"], answer["supervised"], answer["early"]) == (name, False, early)
    assert "'user 1000' asks `lift` and may not: its routing id has under 16 bytes" in caplog.text


SLIP, STABLE = (f"outcome {BOOT} 7 {how}".encode() for how in ("slip", "stable"))


def test_a_taken_or_refused_outcome_is_answered_and_counted(asked: Asked) -> None:
    assert asked.tell(TELLER, STABLE) == {"v": 1, "ok": True}
    assert asked.tell(TELLER, b"", STABLE) == {"v": 1, "ok": True}
    refused = asked.tell(TELLER, f"outcome {BOOT} 8 slip".encode())
    assert refused == {"v": 1, "ok": False, "why": "unknown grasp: no such"}
    assert len(asked.questions.waiting) == 0
    assert asked.questions.counters["outcomes"] == 2
    assert asked.questions.counters["outcomes_refused"] == 1
    assert asked.questions.counters["malformed"] == 0


def test_an_accepted_outcome_is_answered_once_the_disk_has_replied(asked: Asked) -> None:
    requests = Requests(takes_the_seventh)
    waiting: list[Answer] = []
    requests.waiting = waiting
    texts = [f"outcome {BOOT} {grasp} slip".encode() for grasp in (7, 8, 7)]
    messages = [[TELLER, USER, text] for text in texts]
    asked.questions.take(messages, 0, requests)
    assert [json.loads(frames[-1]) for frames in asked.sent] == [
        {"v": 1, "ok": False, "why": "unknown grasp: no such"}
    ]
    waiting[0](Reply(Told.NOT_KEPT, "full"))
    waiting[1](KEPT)
    assert [json.loads(frames[-1]) for frames in asked.sent[1:]] == [
        {"v": 1, "ok": False, "why": "not kept: full"},
        {"v": 1, "ok": True},
    ]
    assert asked.questions.counters["outcomes_refused"] == 2
    assert asked.questions.counters["outcomes"] == 1


def test_a_repeated_outcome_is_answered_as_taken_and_repeated(asked: Asked) -> None:
    answer = asked.tell(TELLER, SLIP, requests=Requests(lambda _report: Reply(Told.REPEATED)))
    assert answer == {"v": 1, "ok": True, "repeated": True}
    assert asked.questions.counters["outcomes"] == 1


NO_NAMES = ("=HYPERLINK(0)", "-1", "+1", "@SUM(1)", "..", ".mug", "a/b", "a;b", "a=1", "a|b", "~")
"""Refused names of objects, which a spreadsheet or a shell could read as more than a name."""


@pytest.mark.parametrize("name", [None, "mug", "035_power-drill", "_.-", "x" * 64, "Z"])
def test_the_loop_gets_the_object_name_as_reported(asked: Asked, name: str | None) -> None:
    requests = Requests()
    text = f"outcome {BOOT} 7 slip" + (f" {name}" if name else "")
    answer = asked.tell(TELLER, text.encode(), requests=requests)
    assert answer == {"v": 1, "ok": True}
    assert requests.outcomes == [Report(GraspId(BOOT, 7), "slip", name, Peer(TELLER, USER))]


@pytest.mark.parametrize(
    "text",
    [
        "outcome",
        f"outcome {BOOT} 7",
        f"outcome {BOOT} 7 Slip",
        f"outcome {BOOT} 7 slip ",
        f"outcome {BOOT} -7 slip",
        f"outcome {BOOT[:-1]} 7 slip",
        f"outcome {BOOT.upper()} 7 slip",
        "outcome \xff",
        f"outcome {BOOT} 7 slip a mug",
        f"outcome {BOOT} 7 slip mug,cup",
        f"outcome {BOOT} 7 slip mug\n",
        f"outcome {BOOT} 7 slip m\xfcg",
        f"outcome {BOOT} 7 slip " + "x" * 65,
        *(f"outcome {BOOT} 7 slip {name}" for name in NO_NAMES),
    ],
)
def test_an_outcome_that_is_malformed_is_answered_and_counted(asked: Asked, text: str) -> None:
    answer = asked.tell(TELLER, text.encode("latin-1"))
    assert answer["ok"] is False
    assert answer["why"].startswith("malformed")
    assert asked.questions.counters["malformed"] == 1


@given(st.lists(st.binary(max_size=200), min_size=1, max_size=20))
def test_any_text_after_the_word_outcome_gets_an_answer(texts: list[bytes]) -> None:
    asked = Asked()
    for text in texts:
        answer = asked.tell(TELLER, b"outcome " + text, requests=Requests())
        assert answer["v"] == 1
    counters = asked.questions.counters
    assert counters["malformed"] + counters["outcomes"] == len(texts)
