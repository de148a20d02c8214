"""A controller tells how its lifts ended: what fits is published, what does not is refused."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, Literal

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.judge.network import Opinion
from daemon.judge.pipeline import Judgement
from daemon.judge.reasons import Decision, Moment, Reason
from daemon.publish.companion import Answer
from daemon.publish.messages import OutcomeMessage, decode_outcome, schema
from daemon.publish.outbox import JUDGED_MAX, Outbox
from daemon.publish.questions import Questions
from daemon.trust.ledger import GRASPS_MAX, GraspId, Told
from daemon.trust.trust import Trust
from tests.daemon.fakes import FINGERS, Clock
from tests.daemon.publish.doors import Asked as Requests

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


TELLER, OTHER, THIRD = b"teller", b"other", b"third"


class Asked:
    """Questions, and what was answered to whom."""

    def __init__(self) -> None:
        self.sent: list[tuple[bytes, ...]] = []
        self.questions = Questions(self._send, 10**9)

    def _send(self, frames: Sequence[bytes]) -> bool:
        self.sent.append(tuple(frames))
        return True

    def ask_about(self, grasp: int, *peers: bytes, text: bytes = b"lift") -> None:
        """Ask, and be answered about a grasp."""
        self.questions.take([[peer, text] for peer in peers], 0, Requests())
        self.questions.answer(b"{}", grasp=GraspId(BOOT, grasp))

    def tell(self, peer: bytes, *frames: bytes, requests: Requests | None = None) -> dict[str, Any]:
        """Tell an outcome, which is no question."""
        requests = requests or Requests(takes_the_seventh)
        self.questions.take([[peer, *frames]], 0, requests)
        assert requests.times == 0
        answer: dict[str, Any] = json.loads(self.sent[-1][-1])
        assert self.sent[-1] == (peer, *frames[:-1], self.sent[-1][-1])
        return answer

    def refusal(self, peer: bytes, text: bytes) -> str:
        """First words of the refusal; empty if it is taken."""
        why: str = self.tell(peer, text).get("why", "")
        return why.partition(":")[0]


def takes_the_seventh(boot_id: str, grasp: int, *_told: object) -> str | None:
    return None if (boot_id, grasp) == (BOOT, 7) else "no such"


@pytest.fixture
def asked() -> Asked:
    return Asked()


SLIP, STABLE = (f"outcome {BOOT} 7 {how}".encode() for how in ("slip", "stable"))


def test_an_outcome_is_answered_at_once(asked: Asked) -> None:
    assert asked.tell(TELLER, STABLE) == {"v": 1, "ok": True}
    assert asked.tell(TELLER, b"", STABLE) == {"v": 1, "ok": True}
    refused = asked.tell(TELLER, f"outcome {BOOT} 8 slip".encode())
    assert refused == {"v": 1, "ok": False, "why": "no such"}
    assert asked.questions.waiting == 0
    assert asked.questions.counters["outcomes"] == 2
    assert asked.questions.counters["outcomes_refused"] == 1
    assert asked.questions.counters["malformed"] == 0


def test_an_outcome_that_is_to_be_kept_is_answered_when_it_is(asked: Asked) -> None:
    requests = Requests(takes_the_seventh)
    waiting: list[Answer] = []
    requests.waiting = waiting
    texts = [f"outcome {BOOT} {grasp} slip".encode() for grasp in (7, 8, 7)]
    messages = [[TELLER, text] for text in texts]
    asked.questions.take(messages, 0, requests)
    assert [json.loads(frames[-1]) for frames in asked.sent] == [
        {"v": 1, "ok": False, "why": "no such"}
    ]
    waiting[0]("not kept: full")
    waiting[1](None)
    assert [json.loads(frames[-1]) for frames in asked.sent[1:]] == [
        {"v": 1, "ok": False, "why": "not kept: full"},
        {"v": 1, "ok": True},
    ]
    assert asked.questions.counters["outcomes_refused"] == 2
    assert asked.questions.counters["outcomes"] == 1


def test_a_grasp_that_a_peer_asked_to_lift_is_told_of_by_that_peer_alone(asked: Asked) -> None:
    asked.ask_about(7, TELLER, OTHER)
    asked.ask_about(7, OTHER)  # the second peer owns nothing
    assert asked.refusal(OTHER, SLIP) == "not yours"
    assert asked.refusal(TELLER, STABLE) == ""
    assert asked.refusal(OTHER, STABLE) == "not yours"
    assert asked.questions.counters["outcomes_refused"] == 2
    assert asked.questions.counters["outcomes"] == 1


def test_a_peer_that_asks_judge_takes_no_grasp_over(asked: Asked) -> None:
    asked.ask_about(7, OTHER, text=b"judge")
    asked.ask_about(7, TELLER)
    assert asked.refusal(OTHER, SLIP) == "not yours"
    assert asked.refusal(TELLER, STABLE) == ""


def test_a_peer_that_asks_judge_tells_of_grasps_where_no_peer_asks_lift(asked: Asked) -> None:
    """Clients of before `lift`."""
    asked.ask_about(7, OTHER, text=b"judge")
    assert asked.refusal(OTHER, STABLE) == ""


def test_a_question_that_is_replaced_owns_nothing(asked: Asked) -> None:
    messages = [[OTHER, b"lift"], [OTHER, b"judge"], [TELLER, b"lift"]]
    asked.questions.take(messages, 0, Requests())
    asked.questions.answer(b"{}", grasp=GraspId(BOOT, 7))
    assert asked.refusal(OTHER, SLIP) == "not yours"
    assert asked.refusal(TELLER, SLIP) == ""


def test_no_grasp_is_owned_by_an_answer_that_is_about_none(asked: Asked) -> None:
    asked.ask_about(0, OTHER)
    assert asked.refusal(TELLER, SLIP) == ""


def test_connections_of_one_client_are_one_owner(asked: Asked) -> None:
    """By the first 16 bytes of their routing ids."""
    name = bytes(range(1, 17))
    asked.ask_about(7, name + b"1")
    assert asked.refusal(name[:-1] + b"\xff2", SLIP) == "not yours"
    assert asked.refusal(name[:-1], SLIP) == "not yours"
    assert asked.refusal(name + b"2", SLIP) == ""


def test_what_was_told_stays_and_may_be_told_again(asked: Asked) -> None:
    asked.ask_about(7, TELLER)
    assert asked.refusal(TELLER, SLIP) == ""
    assert asked.refusal(TELLER, SLIP) == ""
    assert asked.refusal(TELLER, STABLE) == "contradicts"


def test_a_grasp_without_an_owner_is_told_of_by_all_in_one_word(asked: Asked) -> None:
    assert asked.refusal(OTHER, SLIP) == ""
    assert asked.refusal(TELLER, SLIP) == ""
    assert asked.refusal(TELLER, STABLE) == "contradicts"
    assert asked.refusal(OTHER, STABLE) == "contradicts"


def test_a_grasp_without_an_owner_is_told_of_by_owners_of_others(asked: Asked) -> None:
    """A grasp is known to all once it is judged, and may be asked about later."""
    asked.ask_about(6, TELLER)
    asked.ask_about(5, THIRD)
    assert asked.refusal(OTHER, SLIP) == "not yours"
    assert asked.refusal(THIRD, SLIP) == ""
    asked.ask_about(7, TELLER)
    assert asked.refusal(TELLER, STABLE) == "contradicts"


def test_owners_are_forgotten_with_the_last_of_their_grasps(asked: Asked) -> None:
    asked.ask_about(1000, OTHER)
    for grasp in range(1001, 1001 + GRASPS_MAX):
        asked.ask_about(grasp, TELLER)
    assert asked.refusal(OTHER, SLIP) == "not yours"
    assert asked.refusal(TELLER, SLIP) == ""


NO_NAMES = ("=HYPERLINK(0)", "-1", "+1", "@SUM(1)", "..", ".mug", "a/b", "a;b", "a=1", "a|b", "~")
"""What a spreadsheet or a shell takes for more than a name."""


@pytest.mark.parametrize("name", [None, "mug", "035_power-drill", "_.-", "x" * 64, "Z"])
def test_the_object_arrives_as_it_was_told(asked: Asked, name: str | None) -> None:
    requests = Requests()
    text = f"outcome {BOOT} 7 slip" + (f" {name}" if name else "")
    answer = asked.tell(TELLER, text.encode(), requests=requests)
    assert answer == {"v": 1, "ok": True}
    assert requests.outcomes == [(BOOT, 7, "slip", name)]


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
def test_an_outcome_that_is_malformed_is_answered_and_counted(asked: Asked, text: str) -> None:
    answer = asked.tell(TELLER, text.encode("latin-1"))
    assert answer["ok"] is False
    assert answer["why"].startswith("malformed")
    assert asked.questions.counters["malformed"] == 1


@given(st.lists(st.binary(max_size=200), min_size=1, max_size=20))
def test_all_texts_after_the_word_get_an_answer(texts: list[bytes]) -> None:
    asked = Asked()
    for text in texts:
        answer = asked.tell(TELLER, b"outcome " + text, requests=Requests())
        assert answer["v"] == 1
    counters = asked.questions.counters
    assert counters["malformed"] + counters["outcomes"] == len(texts)
