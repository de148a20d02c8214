"""The state of a hand: by its messages, by their absence, and by what its verdicts rest on."""

from __future__ import annotations

import json
from typing import Any, Literal

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import structs

from graspd.daemon.judge.reasons import ADVICE, Decision, GateState, Reason
from graspd.daemon.publish.messages import LearnerHealth, Lifts, OutcomeMessage, RiskReport, encode
from graspd.daemon.trust.lift_book import OutcomeStatus
from graspd.daemon.watch.figures import SUPERVISED, likely
from graspd.daemon.watch.snapshot import Line, Snapshot, Tone
from graspd.daemon.watch.view import History
from tests.daemon.watch.watch_fakes import (
    BOOT,
    MS,
    NOTHING_TOLD,
    RISK,
    a_view,
    after,
    status,
    text_of,
    verdict,
)
from tests.kit.messages import GOLDEN

ODD: tuple[object, ...] = (
    *(0, -1, 2**63, 1e308, 1e-320, "", "x" * 5000, "\x1b[2J"),
    *([], [[]], [0] * 1000, ["\x1b[2J"], {}, {"": 0}, None, True),
)
"""Values to put into fields of messages where others belong."""


def risk(**other: Any) -> RiskReport:  # noqa: ANN401
    return structs.replace(RISK, **other)


def seen_after(decision: Decision = Decision.UNKNOWN, **other: Any) -> Snapshot:  # noqa: ANN401
    return after((b"verdict.right", verdict(0, decision, **other))).snapshot(0)


def figures(lines: list[Line]) -> dict[str, str]:
    return {line.what: line.advice for line in lines}


def test_before_the_first_message_the_view_says_why_nothing_came() -> None:
    seen = a_view().snapshot(0)
    assert (seen.tone, seen.headline) == (Tone.SILENT, "no verdict yet")
    assert "is graspd running" in seen.why[0].advice
    assert seen.why[1] == Line("link", "connecting")


@pytest.mark.parametrize(
    ("outcome", "tone", "p_slip"),
    [(Decision.STABLE, Tone.STABLE, 0.25), (Decision.SLIP, Tone.SLIP, 0.75)],
)
def test_a_verdict_is_shown_until_its_silence_limit_has_passed(
    outcome: Decision, tone: Tone, p_slip: float
) -> None:
    view = after((b"verdict.right", verdict(0, outcome)))
    seen = view.snapshot(100 * MS)
    assert (seen.tone, seen.headline, seen.p_slip) == (tone, outcome.value, p_slip)
    seen = view.snapshot(101 * MS)
    assert (seen.tone, seen.p_slip) == (Tone.SILENT, None)
    assert (seen.headline, seen.why[0]) == ("unknown", Line("silent", "no message for 101 ms"))
    assert (seen.gate, seen.contact, seen.fingers, seen.state) == (None, None, [], None)
    assert [(last.verdict, last.held) for last in seen.grasps] == [(outcome.value, False)]
    assert view.snapshot(124_385 * MS).why[0].advice == "no message for 124 s"


def test_a_repeated_message_is_not_a_sign_of_life() -> None:
    view = after((b"verdict.right", verdict(5, Decision.STABLE)))
    view.take(b"verdict.right", verdict(5, Decision.STABLE), 90 * MS)
    assert view.snapshot(101 * MS).tone is Tone.SILENT


def test_a_verdict_with_an_absurd_age_is_still_shown() -> None:
    assert seen_after(Decision.SLIP, age_ms=1e308).headline == "slip"


def test_gaps_are_counted_as_lost_but_not_over_a_restart() -> None:
    view = after(*[(b"verdict.right", verdict(seq)) for seq in (3, 4, 9)])
    assert figures(view.snapshot(0).timing)["lost here"] == "4 messages"
    view.take(b"verdict.right", verdict(0, Decision.SLIP, boot_id="another"), 0)
    seen = view.snapshot(0)
    assert (figures(seen.timing)["lost here"], seen.headline) == ("4 messages", "slip")


@pytest.mark.parametrize(
    "payload",
    [b"", b"{", b"\xff\xfe", b"[]", verdict(1, Decision.STABLE).replace(b'"v":1', b'"v":2')],
)
def test_a_malformed_message_is_counted_and_shows_no_life(payload: bytes) -> None:
    view = after((b"verdict.right", verdict(0, Decision.STABLE)))
    view.take(b"verdict.right", payload, 90 * MS)
    seen = view.snapshot(101 * MS)
    assert figures(seen.timing)["lost here"] == "1 message"
    assert seen.tone is Tone.SILENT


def test_other_hands_and_other_topics_are_ignored() -> None:
    view = a_view("right")
    for topic in (b"verdict.right2", b"verdict.left", b"verdict", b"other.right", b"\xff"):
        view.take(topic, verdict(0, Decision.STABLE), 0)
    seen = view.snapshot(0)
    assert seen.headline == "no verdict yet"
    assert figures(seen.timing)["lost here"] == "0 messages"


@pytest.mark.parametrize(
    ("reasons", "tone"),
    [
        ([Reason.NO_CONTACT], Tone.WAITING),
        ([Reason.MOVING, Reason.SETTLING], Tone.WAITING),
        ([Reason.NEVER_SEEN], Tone.TROUBLE),
        ([Reason.JOINTS_LATE, Reason.NO_CONTACT], Tone.TROUBLE),
        ([Reason.OUTCOME_TOLD], Tone.WAITING),
        ([Reason.LOW_CONFIDENCE], Tone.WAITING),
    ],
)
def test_the_tone_of_unknown_shows_if_something_is_wrong(reasons: list[Reason], tone: Tone) -> None:
    seen = seen_after(reasons=reasons)
    assert seen.tone is tone
    why = [(reason.value, ADVICE[reason]) for reason in reasons]
    assert [(line.what, line.advice) for line in seen.why] == why


def test_in_overload_the_advice_names_overload_not_a_cable() -> None:
    view = after((b"status.right", status(0, overloaded=True, health={})))
    view.take(b"verdict.right", verdict(0, reasons=[Reason.SEQUENCE_GAP, Reason.MOVING]), 0)
    seen = view.snapshot(0)
    assert [line.what for line in seen.why] == ["overloaded", "moving"]
    assert "cable" not in " ".join(line.advice for line in seen.why)
    assert (seen.tone, seen.not_well) == (Tone.TROUBLE, "")  # the verdict says it
    view.take(b"verdict.right", verdict(1, reasons=[Reason.MOVING]), 0)
    assert view.snapshot(0).not_well == "not well: overloaded"


@pytest.mark.parametrize(("late", "not_well"), [(5, ""), (6, "not well: late")])
def test_over_five_percent_late_readings_are_reported_not_well(late: int, not_well: str) -> None:
    """In the second there are 100 readings; those late before it do not count."""
    view = after((b"verdict.right", verdict(0)))
    for second, count in enumerate((5000, 5000 + late)):
        at_ns = second * 1000 * MS
        told = status(second, t_mono_ns=at_ns, readings_hz=100.0, late_readings=count, health={})
        view.take(b"status.right", told, 0)
    assert view.snapshot(0).not_well == not_well


@pytest.mark.parametrize(
    ("p_slip", "words"),
    [(0.0, "< 1 %"), (0.0099, "< 1 %"), (0.01, "1 %"), (0.254, "25 %"), (0.991, "> 99 %")],
)
def test_no_slip_probability_is_shown_as_0_or_100_percent(p_slip: float, words: str) -> None:
    assert likely(p_slip) == words


def test_without_a_calibrated_session_a_stable_is_less_sure() -> None:
    why = seen_after(Decision.STABLE, session_calibrated=False).why
    assert [line.what for line in why] == ["lift", "less sure"]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"p_slip": 0.251}, "risky: a slip is too likely for a promise"),
        ({"risk": None, "outcomes": 0}, "unproven: no outcome reported yet"),
        ({"risk": NOTHING_TOLD, "outcomes": 0}, "unproven: no outcome reported yet"),
        ({"risk": NOTHING_TOLD}, "unproven: too few `stable` lifts"),
        ({"risk": risk(lifts=9, slips=0)}, "unproven: too few `stable` lifts"),
        ({"risk": risk(target=None, bound=None)}, "unlimited: no target is set"),
        ({"risk": risk(slips=5)}, "disproven: more `stable` lifts slipped"),
        ({"early": True}, "early: it may still slide"),
    ],
)
def test_a_stable_without_evidence_is_shown_as_leans_to_stable(
    change: dict[str, Any], why: str
) -> None:
    """A target of 10 % needs ten lifts, of which one may slip."""
    assert seen_after(Decision.STABLE).tone is Tone.STABLE
    assert seen_after(Decision.STABLE, risk=risk(lifts=10, slips=1)).tone is Tone.STABLE
    seen = seen_after(Decision.STABLE, **change)
    assert (seen.tone, seen.headline) == (Tone.LEANS, "leans to stable")
    assert f"{seen.why[0].what}: {seen.why[0].advice}".startswith(why)
    assert "lift" not in [line.what for line in seen.why]


@pytest.mark.parametrize(
    ("decision", "reasons", "tone"),
    [
        (Decision.UNKNOWN, [Reason.UNPROVEN], Tone.LEARNING),
        (Decision.UNKNOWN, [Reason.LOW_CONFIDENCE], Tone.LEARNING),
        (Decision.UNKNOWN, [Reason.UNPROVEN, Reason.STALE], Tone.TROUBLE),
        (Decision.UNKNOWN, [Reason.MOVING], Tone.WAITING),
        (Decision.SLIP, [], Tone.SLIP),
        (Decision.STABLE, [], Tone.LEANS),
    ],
)
def test_supervised_lifts_are_advised_unless_other_reasons_forbid(
    decision: Decision, reasons: list[Reason], tone: Tone
) -> None:
    seen = seen_after(decision, reasons=reasons, supervised=True)
    is_wanted = tone not in {Tone.TROUBLE, Tone.WAITING}
    assert (seen.tone, SUPERVISED in seen.why) == (tone, is_wanted)
    assert "lift" not in [line.what for line in seen.why]


def test_learning_lists_lifts_without_reported_outcome_first() -> None:
    lifts = Lifts(reported=41, outstanding=1, unreported=3, covered=False)
    told = {OutcomeStatus.TAKEN: 57, OutcomeStatus.CONTRADICTS: 1}
    learner = LearnerHealth(enabled=True, outcomes=57, told=told, uncertainty=0.41)
    seen = after(
        (b"status.right", status(0, lifts=lifts, learner=learner, session_calibrated=False)),
        (b"verdict.right", verdict(0, Decision.STABLE)),
    ).snapshot(0)
    assert seen.learning == [
        Line("never reported", "3 lifts"),
        Line("risk", "covers only announced lifts, and none was announced"),
        Line("awaited", "1 outcome"),
        Line("announced", "40 lifts, 1 awaited"),
        Line("slips", "2 of 41 lifts, 9 allowed"),
        Line("learned from", "57 outcomes"),
        Line("refused", "1 outcome"),
        Line("session", "57 grasps, not yet calibrated"),
    ]


def outcome(grasp: int, ended: Literal["stable", "slip"], judged_by: str | None = None) -> bytes:
    told = OutcomeMessage(
        boot_id=BOOT, seq=0, t=0.0, t_mono_ns=0, grasp=grasp, outcome=ended, grasp_boot_id=judged_by
    )
    return encode(told)


def test_the_last_grasps_are_listed_with_their_lifts_outcomes() -> None:
    view = a_view()
    decisions = {9: Decision.SLIP, 10: Decision.UNKNOWN}
    for grasp in range(1, 12):
        told: dict[str, Any] = {"grasp": grasp, "judged": True}
        if grasp == 10:
            told |= {"supervised": True, "reasons": [Reason.UNPROVEN]}
        message = verdict(100 + 2 * grasp, decisions.get(grasp, Decision.STABLE), **told)
        for _ in range(2):  # a judgement that is repeated is listed once
            view.take(b"verdict.right", message, grasp * 1000 * MS)
        open_hand = verdict(101 + 2 * grasp, grasp=grasp)
        view.take(b"verdict.right", open_hand, grasp * 1000 * MS)
    view.take(b"outcome.right", outcome(1, "slip"), 0)
    view.take(b"outcome.right", outcome(8, "stable"), 0)
    view.take(b"outcome.right", outcome(9, "slip", "another"), 0)
    view.take(b"outcome.right", outcome(10, "slip", BOOT), 0)
    seen = view.snapshot(11_000 * MS)
    assert [(last.grasp, last.verdict, last.lift) for last in seen.grasps] == [
        *((11, "stable", "not reported"), (10, "unknown", "slipped"), (9, "slip", "-")),
        *((8, "stable", "held"), (7, "stable", "not reported"), (6, "stable", "not reported")),
        *((5, "stable", "not reported"), (4, "stable", "not reported")),
    ]
    assert [last.ago_s for last in seen.grasps[:3]] == [0.0, 1.0, 2.0]


@pytest.mark.parametrize(
    ("decision", "gate", "held"),
    [
        (Decision.SLIP, GateState.JUDGED, True),
        (Decision.UNKNOWN, GateState.JUDGED, True),
        (Decision.UNKNOWN, GateState.RELEASED, False),
    ],
)
def test_a_grasp_is_listed_with_its_last_judgement(
    decision: Decision, gate: GateState, held: bool
) -> None:
    view = after((b"verdict.right", verdict(0, Decision.STABLE, grasp=41)))
    view.take(b"verdict.right", verdict(1, decision, grasp=41, judged=False, gate=gate), 0)
    (last,) = view.snapshot(0).grasps
    assert last.verdict == ("slip" if decision is Decision.SLIP else "stable")
    assert last.held is held


@pytest.mark.parametrize(
    ("moments", "seconds"),
    [
        ([(0, Tone.STABLE, 0.1), (900, Tone.STABLE, 0.2)], [("s", 20)]),
        ([(0, Tone.SLIP, 0.9), (999, Tone.STABLE, 0.1)], [("xs", 90)]),
        ([(999, Tone.STABLE, 0.1), (1000, Tone.WAITING, None)], [("s", 10), ("w", -1)]),
        ([(0, Tone.STABLE, 0.1), (3000, Tone.SLIP, 0.8)], [("s", 10), *[("", -1)] * 2, ("x", 80)]),
        ([(0, Tone.WAITING, None), (3_600_000, Tone.STABLE, 0.0)], [("", -1)] * 299 + [("s", 0)]),
    ],
    ids=["one", "both", "next", "gap", "hour"],
)
def test_each_second_keeps_its_tones_and_highest_slip_probability(
    moments: list[tuple[int, Tone, float | None]], seconds: list[tuple[str, int]]
) -> None:
    history = History()
    for at_ms, tone, p_slip in moments:
        history.add(at_ms * MS, tone, p_slip)
    assert list(history.seconds) == seconds


@pytest.mark.slow
@given(st.data())
@settings(max_examples=300, deadline=None)
def test_odd_values_stop_neither_the_view_nor_the_terminal(data: st.DataObject) -> None:
    path = data.draw(st.sampled_from(sorted(GOLDEN.glob("*.json"))))
    content = json.loads(path.read_text())
    for key in data.draw(st.sets(st.sampled_from(sorted(content)), max_size=3)):
        content[key] = data.draw(st.sampled_from(ODD))
    view = a_view()
    kind = path.stem.split("_")[0]
    view.take(f"{kind}.right".encode(), json.dumps(content).encode(), 0)
    seen = view.snapshot(0)
    json.loads(msgspec.json.encode(seen))
    assert max(map(len, text_of(seen))) <= 80
    assert text_of(seen, data.draw(st.sampled_from((1, 10, 40))))
