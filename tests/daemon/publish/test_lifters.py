"""Who may lift and tell: an answered `lift` on the disk, of one user or key; all else looks."""

from __future__ import annotations

import json
from typing import Any

import pytest

from graspd.daemon.publish.companion import KEPT, Answer, Reply, Told
from graspd.daemon.publish.porter import Frames
from graspd.daemon.publish.questions import WAITING_MAX, Questions
from graspd.daemon.trust.lift_book import GraspId, LiftBook, Report
from tests.daemon.publish.doors import Asked, published

ROBOT, STRANGER = b"user 1000", b"user 1001"
NAME, OTHER = b"controller-16byt", b"another-16-bytes"
SEVENTH = GraspId("0" * 32, 7)
S = 1_000_000_000


class Book(Asked):
    """The loop's part: the book of lifts, with grasp 7 called `stable`."""

    def __init__(self) -> None:
        super().__init__()
        self.lifts = LiftBook()
        self.lifts.note(SEVENTH, bytes(8), stable=True)
        self.disk: list[Answer] = []
        self.silences = 0

    def silence(self) -> None:
        self.silences += 1

    def outcome(self, report: Report, answer: Answer) -> None:
        if not self.lifts.may_report(report.grasp, report.peer):
            answer(Reply(Told.NOT_YOURS))
        elif report.outcome == "not-lifted":
            answer(KEPT if self.lifts.take_back(report.grasp) else Reply(Told.CONTRADICTS))
        else:
            self.lifts.tell(report.grasp, slipped=report.outcome == "slip")
            answer(KEPT)


class Bench:
    """Questions of peers, what they are answered, and verdicts."""

    def __init__(self, **options: Any) -> None:  # noqa: ANN401
        self.sent: list[Frames] = []
        self.book = Book()
        self.questions = Questions(self._send, S, **options)

    def _send(self, frames: Any) -> bool:  # noqa: ANN401
        self.sent.append([*frames])
        return True

    def say(self, text: bytes, who: bytes = NAME, user: bytes = ROBOT, now_ns: int = 0) -> Any:  # noqa: ANN401
        """Return the answer if there is one at once."""
        known = len(self.sent)
        self.questions.take([[who, user, text]], now_ns, self.book)
        return json.loads(self.sent[-1][-1]) if len(self.sent) > known else None

    def verdict(self, name: str = "stable", now_ns: int | None = None, **more: Any) -> None:  # noqa: ANN401
        payload = f'{{"said":"{name}"}}'.encode()
        self.questions.answer(published(payload, name, self.book.lifts, **more), now_ns)

    @property
    def answers(self) -> list[Any]:
        return [json.loads(frames[-1]) for frames in self.sent]

    @property
    def announced(self) -> tuple[int, int]:
        return self.book.lifts.announced, self.book.lifts.awaited

    def tells(self, who: bytes = NAME, user: bytes = ROBOT) -> bool:
        ok: bool = self.say(b"outcome " + b"0" * 32 + b" 7 slip", who, user)["ok"]
        return ok


@pytest.fixture
def bench() -> Bench:
    return Bench()


def lifted(bench: Bench, who: bytes = NAME, user: bytes = ROBOT) -> None:
    bench.say(b"lift", who, user)
    bench.verdict()


@pytest.mark.parametrize("name", ["unknown", "slip"])
def test_asking_alone_owns_nothing(bench: Bench, name: str) -> None:
    bench.say(b"lift")
    bench.verdict(name, supervised=False)
    assert bench.answers == [{"said": name}]
    assert not bench.tells()


def test_the_first_user_that_may_lift_stays_the_only_one(bench: Bench) -> None:
    lifted(bench)
    lifted(bench, OTHER, STRANGER)
    assert len(bench.answers) == 2
    assert bench.announced == (1, 1)
    assert [bench.tells(who, STRANGER) for who in (OTHER, NAME)] == [False, False]
    assert bench.tells()


@pytest.mark.parametrize("more", [{}, {"name": "unknown", "supervised": True}], ids=str)
@pytest.mark.parametrize(
    ("taken_back", "who", "user", "owner"),
    [
        (False, OTHER, ROBOT, "another"),
        (False, OTHER, STRANGER, "another"),
        (False, NAME + b"2", ROBOT, "you"),
        (True, OTHER, ROBOT, "you"),
        (True, OTHER, STRANGER, "another"),
    ],
)
def test_a_second_controller_learns_who_owns_the_grasp(
    bench: Bench, more: dict[str, Any], taken_back: bool, who: bytes, user: bytes, owner: str
) -> None:
    bench.say(b"lift")
    bench.verdict(**more)
    if taken_back:
        bench.say(b"not-lifting")
    bench.say(b"lift", who, user)
    bench.verdict(**more)
    assert (bench.answers[0]["owner"], bench.answers[-1]["owner"]) == ("you", owner)
    assert bench.tells(*((who, user) if owner == "you" else (NAME, ROBOT)))


def test_a_user_that_only_looks_does_not_take_the_place(bench: Bench) -> None:
    bench.say(b"judge", OTHER, STRANGER)
    bench.verdict()
    bench.say(b"lift", OTHER, STRANGER)
    bench.verdict("unknown", supervised=False)
    lifted(bench)
    assert bench.announced == (1, 1)
    assert bench.tells()


def test_the_scene_says_who_may_lift() -> None:
    bench = Bench(tells={ROBOT}.__contains__)
    lifted(bench, OTHER, STRANGER)
    assert bench.announced == (0, 0)
    assert not bench.tells(OTHER, STRANGER)
    lifted(bench)
    assert bench.announced == (1, 1)
    assert bench.tells()


@pytest.mark.parametrize("size", [1, 5, 15])
def test_a_short_routing_id_owns_nothing(bench: Bench, size: int) -> None:
    lifted(bench, NAME[:size])
    assert (len(bench.answers), bench.announced) == (1, (0, 0))
    assert not bench.tells(NAME[:size])


def test_a_supervised_lift_is_offered_to_lifters_alone(bench: Bench) -> None:
    for who, user in ((NAME, ROBOT), (OTHER, STRANGER)):
        bench.say(b"lift", who, user)
        bench.verdict("unknown", supervised=True, reasons=["unproven"])
    said = [(answer["supervised"], answer["owner"]) for answer in bench.answers]
    assert said == [(True, "you"), (False, "another")]
    assert bench.announced == (0, 0)
    assert bench.tells()


def test_a_lift_is_on_the_disk_before_the_answer(bench: Bench) -> None:
    bench.say(b"lift")
    bench.verdict(keep=bench.book.disk.append)
    assert (bench.sent, bench.announced) == ([], (1, 1))
    bench.verdict(now_ns=0)
    bench.book.disk[0](KEPT)
    assert bench.sent == []
    bench.verdict(now_ns=0)
    assert [answer["verdict"] for answer in bench.answers] == ["stable"]
    assert len(bench.book.disk) == 1


def test_a_lift_that_cannot_be_kept_is_unknown(bench: Bench) -> None:
    bench.say(b"lift")
    bench.verdict(keep=lambda answer: answer(Reply(Told.NOT_KEPT, "full")))
    (answer,) = bench.answers
    assert (answer["verdict"], answer["reasons"], answer["p_slip"]) == (
        "unknown",
        ["not-kept"],
        None,
    )
    assert bench.announced == (0, 0)


@pytest.mark.parametrize("name", ["unknown", "slip"])
def test_what_is_no_longer_stable_is_not_announced(bench: Bench, name: str) -> None:
    bench.say(b"lift")
    bench.verdict(keep=bench.book.disk.append)
    bench.book.disk[0](KEPT)
    bench.verdict(name, now_ns=0, supervised=False)
    assert (bench.answers, bench.announced) == ([{"said": name}], (0, 0))


@pytest.mark.parametrize("answered", [True, False])
def test_a_word_takes_a_lift_back(bench: Bench, answered: bool) -> None:
    bench.say(b"lift")
    bench.verdict(keep=(lambda answer: answer(KEPT)) if answered else bench.book.disk.append)
    assert bench.announced == (1, 1)
    assert bench.say(b"not-lifting") == {"v": 1, "ok": True}
    assert bench.announced == (0, 0)
    bench.verdict()
    assert len(bench.sent) == 1 + answered


def test_a_question_that_is_taken_back_is_not_answered(bench: Bench) -> None:
    bench.say(b"lift")
    bench.say(b"not-lifting")
    bench.verdict()
    assert (bench.answers, bench.announced) == ([{"v": 1, "ok": True}], (0, 0))


@pytest.mark.parametrize(("who", "user"), [(NAME, STRANGER), (NAME + b"2", ROBOT), (OTHER, ROBOT)])
def test_the_word_of_another_connection_takes_nothing_back(
    bench: Bench, who: bytes, user: bytes
) -> None:
    lifted(bench)
    bench.say(b"not-lifting", who, user)
    assert bench.announced == (1, 1)


def test_a_second_question_does_not_take_the_first_lift_back(bench: Bench) -> None:
    """The hand may be lifting by the first answer."""
    lifted(bench)
    lifted(bench, NAME + b"2")
    bench.say(b"not-lifting", NAME + b"2")
    assert bench.announced == (1, 1)


def test_an_owner_says_that_no_lift_followed(bench: Bench) -> None:
    lifted(bench)
    not_lifted = b"outcome " + b"0" * 32 + b" 7 not-lifted"
    assert not bench.say(not_lifted, NAME, STRANGER)["ok"]
    assert bench.announced == (1, 1)
    assert bench.say(not_lifted, NAME + b"2")["ok"]
    assert bench.announced == (0, 0)


def test_five_questions_without_a_lift_leave_none_announced(bench: Bench) -> None:
    for grasp in range(8, 13):
        bench.book.lifts.note(GraspId("0" * 32, grasp), bytes(8), stable=True)
        bench.say(b"lift")
        bench.verdict(grasp=grasp)
        bench.say(b"not-lifting")
    assert bench.announced == (0, 0)


def test_a_question_ends_in_time_without_a_reading(bench: Bench) -> None:
    bench.verdict("slip")
    bench.say(b"judge")
    assert (bench.questions.serve([], S - 1, bench.book), bench.sent) == (S, [])
    assert bench.questions.serve([], S, bench.book) is None
    assert [(answer["verdict"], answer["reasons"]) for answer in bench.answers] == [
        ("unknown", ["stale"])
    ]
    assert bench.book.silences == 0


def test_before_the_first_reading_silence_is_the_answer(bench: Bench) -> None:
    bench.say(b"judge")
    bench.questions.serve([], S, bench.book)
    assert bench.book.silences == 1


def test_a_lift_too_late_on_the_disk_is_unknown(bench: Bench) -> None:
    bench.say(b"lift")
    bench.verdict(keep=bench.book.disk.append)
    bench.questions.serve([], S, bench.book)
    assert [answer["reasons"] for answer in bench.answers] == [["not-kept"]]
    assert bench.announced == (0, 0)
    bench.book.disk[0](KEPT)
    bench.verdict()
    assert len(bench.sent) == 1


def test_a_question_that_makes_place_is_answered_unknown(bench: Bench) -> None:
    bench.verdict("slip")
    bench.say(b"lift")
    for number in range(WAITING_MAX):
        bench.say(b"judge", b"%016d" % number)
    assert bench.sent[0][0] == NAME
    assert (bench.answers[0]["verdict"], len(bench.sent)) == ("unknown", 1)


# Credentials
