"""A controller tells how its lifts ended: what fits is published, what does not is refused."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import jsonschema
import numpy as np
import pytest
import zmq
from hypothesis import given, settings
from hypothesis import strategies as st

from daemon.judge.network import Opinion
from daemon.judge.pipeline import Judgement
from daemon.judge.reasons import Decision, Moment, Reason
from daemon.publish.companion import Answer
from daemon.publish.messages import OutcomeMessage, decode_outcome, schema
from daemon.publish.outbox import JUDGED_MAX, Outbox
from daemon.publish.peer import PlainPeer
from daemon.publish.questions import MESSAGE_MAX_BYTES, Questions, TakeOutcome
from daemon.publish.zmtp import Role
from daemon.trust.ledger import GraspId, Told
from daemon.trust.trust import Trust
from tests.daemon.fakes import FINGERS, Clock

BOOT = "0123456789abcdef" * 2
NOW_NS = 10**12
BOTH: tuple[Literal["stable", "slip"], ...] = ("stable", "slip")


class Output:
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.sent: list[tuple[bytes, bytes]] = []

    def send(self, topic: bytes, payload: bytes) -> None:
        self.sent.append((topic, payload))

    def wanted(self, _topic: bytes) -> bool:
        return True


def outbox(output: Output) -> Outbox:
    return Outbox(
        "right", FINGERS, "fake", "0" * 64, [output], Clock(NOW_NS), lambda: 5.0, boot_id=BOOT
    )


def judge(outbox: Outbox, grasp: int, *, judged: bool = True) -> None:
    outcome = Decision.SLIP if judged else Decision.UNKNOWN
    reasons = () if judged else (Reason.MOVING,)
    p_slip = 0.9 if judged else None
    moment, opinion = Moment(grasp, judged=judged), Opinion(p_slip, ())
    outbox.verdict(Judgement(NOW_NS, outcome, reasons, p_slip, moment, opinion), NOW_NS, 10**8)


def test_an_outcome_of_a_judged_grasp_is_published_as_the_schema_says() -> None:
    output = Output()
    sender = outbox(output)
    judge(sender, 3)
    assert sender.outcome(BOOT, 3, "stable") is None
    assert sender.outcome(BOOT, 3, "slip") is None
    messages = [payload for topic, payload in output.sent if topic == b"outcome.right"]
    assert [decode_outcome(payload) for payload in messages] == [
        OutcomeMessage(boot_id=BOOT, seq=seq, t=5.0, t_mono_ns=NOW_NS, grasp=3, outcome=outcome)
        for seq, outcome in enumerate(BOTH)
    ]
    assert {decode_outcome(payload).object for payload in messages} == {None}
    for payload in messages:
        jsonschema.validate(json.loads(payload), schema() | {"$ref": "#/$defs/OutcomeMessage"})


def test_an_outcome_names_the_object_if_the_controller_does() -> None:
    output = Output()
    sender = outbox(output)
    judge(sender, 3)
    assert sender.outcome(BOOT, 3, "slip", "mug") is None
    payload = json.loads(output.sent[-1][1])
    assert (payload["outcome"], payload["object"]) == ("slip", "mug")
    jsonschema.validate(payload, schema() | {"$ref": "#/$defs/OutcomeMessage"})


def test_an_outcome_of_another_start_or_of_a_grasp_that_was_not_judged_is_refused() -> None:
    output = Output()
    sender = outbox(output)
    judge(sender, 3)
    judge(sender, 4, judged=False)
    for boot_id, grasp, why in (
        ("f" * 32, 3, "unknown boot_id"),
        (BOOT, 4, "unknown grasp"),
        (BOOT, 5, "unknown grasp"),
        (BOOT, 0, "unknown grasp"),
    ):
        said = sender.outcome(boot_id, grasp, "slip")
        assert said is not None
        assert said.startswith(why)
    assert not [topic for topic, _ in output.sent if topic == b"outcome.right"]


def test_an_outcome_of_a_grasp_that_an_earlier_start_judged_says_which() -> None:
    output = Output()
    sender = outbox(output)
    for boot_id, judged_by in ((BOOT, None), ("f" * 32, "f" * 32)):
        assert sender.outcome(boot_id, 3, "slip", known=True) is None
        message = decode_outcome(output.sent[-1][1])
        assert (message.boot_id, message.grasp, message.grasp_boot_id) == (BOOT, 3, judged_by)


def test_no_grasp_is_remembered_longer_than_its_outcome_could_teach() -> None:
    trust, sender = Trust("fake", 0), outbox(Output())
    for number in range(3 * JUDGED_MAX):
        judge(sender, number)
        grasp = GraspId(BOOT, number)
        trust.note(grasp, trust.judge(grasp, 0.5, 0.0, np.empty(0)), stable=False)
    taken = [sender.outcome(BOOT, number, "slip") is None for number in range(3 * JUDGED_MAX)]
    assert sum(taken) > 100
    for number, was_taken in enumerate(taken):
        told = trust.outcome(GraspId(BOOT, number), slipped=True)
        assert told is Told.TAKEN or not was_taken


def test_only_so_many_grasps_are_remembered() -> None:
    sender = outbox(Output())
    for grasp in range(1, JUDGED_MAX + 2):
        judge(sender, grasp)
        judge(sender, grasp)  # a grasp that is judged twice is one
    assert sender.outcome(BOOT, 1, "slip") is not None
    assert sender.outcome(BOOT, 2, "slip") is None
    assert sender.outcome(BOOT, JUDGED_MAX + 1, "slip") is None


@pytest.fixture
def questions(tmp_path: Path) -> Iterator[Questions]:
    with Questions(f"ipc://{tmp_path}/ask", 10**9) as taker:
        yield taker


def takes_the_seventh(boot_id: str, grasp: int, *_told: object) -> str | None:
    return None if (boot_id, grasp) == (BOOT, 7) else "no such"


@contextmanager
def peer(questions: Questions) -> Iterator[zmq.Socket[bytes]]:
    """Who asks and tells over a connection of its own."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as socket:
        socket.linger = 0
        socket.connect(questions.endpoint)
        yield socket


@pytest.fixture
def teller(questions: Questions) -> Iterator[zmq.Socket[bytes]]:
    with peer(questions) as socket:
        yield socket


def told(
    questions: Questions,
    teller: zmq.Socket[bytes],
    *frames: bytes,
    outcome: TakeOutcome | None = takes_the_seventh,
) -> dict[str, Any]:
    teller.send_multipart(frames)
    deadline_s = time.monotonic() + 100.0
    while not teller.poll(1):
        assert questions.take(0, outcome) == 0  # it is no question: nobody is judged for it
        assert time.monotonic() < deadline_s
    answer: dict[str, Any] = json.loads(teller.recv_multipart()[-1])
    return answer


def test_an_outcome_is_answered_at_once(questions: Questions, teller: zmq.Socket[bytes]) -> None:
    text = f"outcome {BOOT} 7 stable".encode()
    assert told(questions, teller, text) == {"v": 1, "ok": True}
    assert told(questions, teller, b"", text) == {"v": 1, "ok": True}
    refused = told(questions, teller, f"outcome {BOOT} 8 slip".encode())
    assert refused == {"v": 1, "ok": False, "why": "no such"}
    assert questions.waiting == 0
    assert questions.counters["outcomes"] == 2
    assert questions.counters["outcomes_refused"] == 1
    assert questions.counters["malformed"] == 0


def test_an_outcome_that_is_to_be_kept_is_answered_when_it_is(
    questions: Questions, teller: zmq.Socket[bytes]
) -> None:
    waiting: list[Answer] = []
    deadline_s = time.monotonic() + 100.0
    for grasp in (7, 8, 7):
        teller.send(f"outcome {BOOT} {grasp} slip".encode())
    while len(waiting) < 2:
        assert questions.take(0, takes_the_seventh, waiting.append) == 0
        assert time.monotonic() < deadline_s
    assert json.loads(teller.recv()) == {"v": 1, "ok": False, "why": "no such"}
    assert not teller.poll(50)
    assert questions.counters == {"asked": 0, "outcomes_refused": 1}
    waiting[0]("not kept: full")
    waiting[1](None)
    assert json.loads(teller.recv()) == {"v": 1, "ok": False, "why": "not kept: full"}
    assert json.loads(teller.recv()) == {"v": 1, "ok": True}
    assert questions.counters == {"asked": 0, "outcomes_refused": 2, "outcomes": 1}
    questions.close()
    waiting[0](None)  # nobody hears it, and nothing breaks


def test_answers_are_on_their_way_before_the_socket_closes(tmp_path: Path) -> None:
    waiting: list[Answer] = []
    with zmq.Context() as context, context.socket(zmq.DEALER) as teller:
        teller.linger = 0
        with Questions(f"ipc://{tmp_path}/ask", 10**9) as taker:
            teller.connect(taker.endpoint)
            teller.send(f"outcome {BOOT} 7 slip".encode())
            while not waiting:
                taker.take(0, takes_the_seventh, waiting.append)
            waiting[0](None)
        assert teller.poll(100_000)
        assert json.loads(teller.recv()) == {"v": 1, "ok": True}


def ask_about(questions: Questions, asker: zmq.Socket[bytes], grasp: int) -> None:
    """Ask, and be answered about a grasp."""
    asker.send(b"judge")
    deadline_s = time.monotonic() + 100.0
    while not questions.take(0):
        assert time.monotonic() < deadline_s
    questions.answer(b"{}", grasp=GraspId(BOOT, grasp))
    assert asker.recv() == b"{}"


def test_a_grasp_that_somebody_asked_about_is_told_of_by_nobody_else(
    questions: Questions, teller: zmq.Socket[bytes]
) -> None:
    slip, stable = (f"outcome {BOOT} 7 {how}".encode() for how in ("slip", "stable"))
    with peer(questions) as other:
        ask_about(questions, teller, 7)
        ask_about(questions, other, 7)  # who comes second owns nothing
        refused = told(questions, other, slip)
        assert (refused["ok"], refused["why"].partition(":")[0]) == (False, "not yours")
        assert told(questions, teller, stable)["ok"]
        assert not told(questions, other, stable)["ok"]
    assert questions.counters["outcomes_refused"] == 2
    assert questions.counters["outcomes"] == 1


def test_who_owns_a_grasp_and_has_gone_is_stood_for_by_another_connection_of_its(
    questions: Questions, teller: zmq.Socket[bytes]
) -> None:
    with peer(questions) as former:
        ask_about(questions, former, 7)
    deadline_s = time.monotonic() + 100.0
    while not told(questions, teller, f"outcome {BOOT} 7 slip".encode())["ok"]:
        assert time.monotonic() < deadline_s


def test_who_tells_before_its_former_connection_is_seen_to_go_is_heard(
    questions: Questions, teller: zmq.Socket[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daemon.publish.questions.GRACE_NS", 5_000_000_000)
    with peer(questions) as former:
        ask_about(questions, former, 7)
        teller.send(f"outcome {BOOT} 7 slip".encode())
        for _ in range(100):
            questions.take(0, takes_the_seventh)
            time.sleep(0.001)
        assert not teller.poll(0)
    deadline_s = time.monotonic() + 100.0
    while not teller.poll(1):
        questions.take(0, takes_the_seventh)
        assert time.monotonic() < deadline_s
    assert json.loads(teller.recv()) == {"v": 1, "ok": True}


def test_what_was_told_stays_and_may_be_told_again(
    questions: Questions, teller: zmq.Socket[bytes]
) -> None:
    slip, stable = (f"outcome {BOOT} 7 {how}".encode() for how in ("slip", "stable"))
    ask_about(questions, teller, 7)
    assert told(questions, teller, slip)["ok"]
    assert told(questions, teller, slip)["ok"]
    refused = told(questions, teller, stable)
    assert (refused["ok"], refused["why"].partition(":")[0]) == (False, "contradicts")


def test_a_grasp_that_nobody_asked_about_is_told_of_by_anybody_in_one_word(
    questions: Questions, teller: zmq.Socket[bytes]
) -> None:
    slip, stable = (f"outcome {BOOT} 7 {how}".encode() for how in ("slip", "stable"))
    with peer(questions) as other:
        assert told(questions, other, slip)["ok"]
        assert told(questions, teller, slip)["ok"]
        assert not told(questions, teller, stable)["ok"]
        assert not told(questions, other, stable)["ok"]


def test_who_asks_about_grasps_is_not_forestalled_by_who_does_not(
    questions: Questions, teller: zmq.Socket[bytes]
) -> None:
    """A grasp is known to all once it is judged, and may be asked about later."""
    slip, stable = (f"outcome {BOOT} 7 {how}".encode() for how in ("slip", "stable"))
    with peer(questions) as other:
        ask_about(questions, teller, 6)
        assert told(questions, other, slip)["why"].startswith("not yours")
        ask_about(questions, teller, 7)
        assert told(questions, teller, stable)["ok"]


def test_who_stands_for_whom() -> None:
    """By process and user, as the kernel tells them for Unix sockets."""
    with subprocess.Popen(["true"]) as ended:
        pass
    left, right = socket.socketpair()
    with left, right:
        owner, other = (PlainPeer(each, Role.ROUTER, 0) for each in (left, right))
        assert (owner.process, owner.user) == (os.getpid(), os.getuid())
        assert owner.stands_for(owner)
        assert not other.stands_for(owner)  # which is there, and speaks for itself
        owner.socket = None
        assert other.stands_for(owner)
        other.process = 1
        assert not other.stands_for(owner)  # its process still runs, and could have connected again
        owner.process = ended.pid
        assert other.stands_for(owner)
        other.user += 1
        assert not other.stands_for(owner)
        other.process = owner.process
        assert not other.stands_for(owner)


NO_NAMES = ("=HYPERLINK(0)", "-1", "+1", "@SUM(1)", "..", ".mug", "a/b", "a;b", "a=1", "a|b", "~")
"""What a spreadsheet or a shell takes for more than a name."""


@pytest.mark.parametrize("name", [None, "mug", "035_power-drill", "_.-", "x" * 64, "Z"])
def test_the_object_arrives_as_it_was_told(
    questions: Questions, teller: zmq.Socket[bytes], name: str | None
) -> None:
    heard: list[tuple[object, ...]] = []
    text = f"outcome {BOOT} 7 slip" + (f" {name}" if name else "")
    answer = told(questions, teller, text.encode(), outcome=lambda *told: heard.append(told))
    assert answer == {"v": 1, "ok": True}
    assert heard == [(BOOT, 7, "slip", name)]


@pytest.mark.parametrize(
    "text",
    [
        "outcome",
        "outcome ",
        f"outcome {BOOT} 7",
        f"outcome {BOOT} 7 Slip",
        f"outcome {BOOT} 7 slip ",
        f"outcome {BOOT} -7 slip",
        f"outcome {BOOT} 7.0 slip",
        f"outcome {BOOT[:-1]} 7 slip",
        f"outcome {BOOT}  7 slip",
        f"outcome {BOOT.upper()} 7 slip",
        "outcome \xff",
        f"outcome {BOOT} 7 slip  mug",
        f"outcome {BOOT} 7 slip mug ",
        f"outcome {BOOT} 7 slip a mug",
        f"outcome {BOOT} 7 slip mug,cup",
        f'outcome {BOOT} 7 slip "mug"',
        f"outcome {BOOT} 7 slip mug's",
        f"outcome {BOOT} 7 slip mug\n",
        f"outcome {BOOT} 7 slip m\xfcg",
        f"outcome {BOOT} 7 slip mug\x7f",
        f"outcome {BOOT} 7 slip mug\0",
        f"outcome {BOOT} 7 slip " + "x" * 65,
        *(f"outcome {BOOT} 7 slip {name}" for name in NO_NAMES),
    ],
)
def test_an_outcome_that_is_malformed_is_answered_and_counted(
    questions: Questions, teller: zmq.Socket[bytes], text: str
) -> None:
    answer = told(questions, teller, text.encode("latin-1"))
    assert answer["ok"] is False
    assert answer["why"].startswith("malformed")
    assert questions.counters["malformed"] == 1


def test_the_longest_outcome_fits_into_a_message() -> None:
    assert len(f"outcome {BOOT} {10**15 - 1} stable " + "x" * 64) <= MESSAGE_MAX_BYTES


def test_without_anybody_who_takes_outcomes_the_controller_hears_so(
    questions: Questions, teller: zmq.Socket[bytes]
) -> None:
    text = f"outcome {BOOT} 7 slip".encode()
    assert told(questions, teller, text, outcome=None)["ok"] is False


@settings(max_examples=20)
@given(st.lists(st.binary(max_size=MESSAGE_MAX_BYTES - 8), min_size=1, max_size=20))
def test_whatever_follows_the_word_nothing_breaks(texts: list[bytes]) -> None:
    with (
        tempfile.TemporaryDirectory() as folder,
        Questions(f"ipc://{folder}/ask", 10**9) as taker,
        peer(taker) as socket,
    ):
        for text in texts:
            answer = told(taker, socket, b"outcome " + text, outcome=lambda *_told: None)
            assert answer["v"] == 1
        assert taker.counters["malformed"] + taker.counters["outcomes"] == len(texts)
