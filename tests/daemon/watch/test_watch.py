"""What is seen of a hand: by its messages, by their absence, and as text in a terminal."""

from __future__ import annotations

import json
import math
import random
import re
import time
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import pytest
from msgspec import structs

from daemon.judge.reasons import ADVICE, Decision, GateState, Reason
from daemon.publish.messages import LearnerHealth, Lifts, OutcomeMessage, encode
from daemon.trust.lift_book import OutcomeStatus
from daemon.trust.trust import RiskReport
from daemon.watch.evidence import WATCHED
from daemon.watch.fingers import FULL, HEIGHT, WIDTH, FingerMotion, Rest, image
from daemon.watch.pixels import Canvas
from daemon.watch.snapshot import Line, Snapshot, Tone
from daemon.watch.view import View
from models.layout import D1
from tests.daemon.watch.watch_fakes import (
    BOOT,
    MS,
    RESTING,
    RISK,
    a_view,
    after,
    status,
    tactile,
    text_of,
    verdict,
)

GOLDEN = sorted((Path(__file__).parents[1] / "publish" / "golden").glob("*.json"))
ODD: tuple[object, ...] = (
    0,
    -1,
    2**63,
    1e308,
    1e-320,
    "",
    "x" * 5000,
    "\x1b[2J",
    [],
    [[]],
    {},
    {"": 0},
    None,
    True,
)
"""Values where others belong."""
SOUND = np.ones(24, dtype=np.bool_)


def rested(view: View, readings: int = 30) -> None:
    """Let it see an open hand at rest."""
    view.take(b"status.right", status(0), 0)
    for seq in range(readings):
        view.take(b"verdict.right", verdict(seq), 0)
        view.take(b"tactile.right", tactile(seq, RESTING, RESTING), 0)


def test_before_the_first_message_it_is_unknown_and_says_what_may_be_wrong() -> None:
    seen = a_view().snapshot(0)
    assert (seen.tone, seen.verdict) == (Tone.SILENT, "unknown")
    assert "is graspd running" in seen.why[0].advice
    assert seen.why[1] == Line("link", "connecting")


@pytest.mark.parametrize(
    ("outcome", "tone", "p_slip"),
    [(Decision.STABLE, Tone.STABLE, 0.25), (Decision.SLIP, Tone.SLIP, 0.75)],
)
def test_a_verdict_stands_until_the_silence_is_longer_than_it_says(
    outcome: Decision, tone: Tone, p_slip: float
) -> None:
    view = after((b"verdict.right", verdict(0, outcome)))
    seen = view.snapshot(100 * MS)
    assert (seen.tone, seen.verdict, seen.p_slip) == (tone, outcome.value, p_slip)
    seen = view.snapshot(101 * MS)
    assert (seen.tone, seen.verdict, seen.p_slip) == (Tone.SILENT, "unknown", None)
    assert seen.why[0] == Line("silent", "no message for 101 ms")
    assert (seen.gate, seen.contact, seen.fingers, seen.state) == (None, None, [], None)


def test_a_long_silence_is_told_in_seconds() -> None:
    view = after((b"verdict.right", verdict(0, Decision.STABLE)))
    assert view.snapshot(9_999 * MS).why[0].advice == "no message for 9999 ms"
    assert view.snapshot(124_385 * MS).why[0].advice == "no message for 124 s"


def test_a_message_that_is_repeated_for_somebody_else_is_no_sign_of_life() -> None:
    view = after((b"verdict.right", verdict(5, Decision.STABLE)))
    view.take(b"verdict.right", verdict(5, Decision.STABLE), 90 * MS)
    assert view.snapshot(101 * MS).tone is Tone.SILENT


def test_gaps_are_counted_as_lost_but_not_over_a_restart() -> None:
    view = after(*[(b"verdict.right", verdict(seq)) for seq in (3, 4, 9)])
    assert view.snapshot(0).timing.lost == 4
    view.take(b"verdict.right", verdict(0, Decision.SLIP, boot_id="another"), 0)
    seen = view.snapshot(0)
    assert (seen.timing.lost, seen.verdict) == (4, "slip")


@pytest.mark.parametrize(
    "payload",
    [b"", b"{", b"\xff\xfe", b"[]", verdict(1, Decision.STABLE).replace(b'"v":1', b'"v":2')],
)
def test_what_is_not_understood_is_counted_and_is_no_sign_of_life(payload: bytes) -> None:
    view = after((b"verdict.right", verdict(0, Decision.STABLE)))
    view.take(b"verdict.right", payload, 90 * MS)
    seen = view.snapshot(101 * MS)
    assert seen.timing.not_understood == 1
    assert seen.tone is Tone.SILENT


def test_other_hands_and_other_topics_are_not_looked_at() -> None:
    view = a_view("right")
    for topic in (b"verdict.right2", b"verdict.left", b"verdict", b"other.right", b"\xff"):
        view.take(topic, verdict(0, Decision.STABLE), 0)
    seen = view.snapshot(0)
    assert (seen.verdict, seen.timing.not_understood) == ("unknown", 0)


@pytest.mark.parametrize(
    ("reasons", "tone"),
    [
        ([Reason.NO_CONTACT], Tone.WAITING),
        ([Reason.MOVING, Reason.SETTLING], Tone.WAITING),
        ([Reason.NEVER_SEEN], Tone.TROUBLE),
        ([Reason.MOVING, Reason.STALE], Tone.TROUBLE),
    ],
)
def test_unknown_is_told_apart_by_whether_something_is_wrong(
    reasons: list[Reason], tone: Tone
) -> None:
    seen = after((b"verdict.right", verdict(0, reasons=reasons))).snapshot(0)
    assert seen.tone is tone
    assert seen.why == [Line(reason.value, ADVICE[reason]) for reason in reasons]


def test_a_verdict_without_a_calibrated_session_is_said_to_be_less_sure() -> None:
    message = verdict(0, Decision.STABLE, session_calibrated=False)
    why = after((b"verdict.right", message)).snapshot(0).why
    assert [line.what for line in why] == ["lift", "less sure"]


def test_the_last_judgement_stays_and_gets_how_its_lift_ended() -> None:
    view = after((b"verdict.right", verdict(0, Decision.SLIP, grasp=42)))
    view.take(b"verdict.right", verdict(1, grasp=42), 2_000 * MS)
    for grasp, ended in ((41, None), (42, "slip")):
        told = OutcomeMessage(boot_id=BOOT, seq=0, t=0.0, t_mono_ns=0, grasp=grasp, outcome="slip")
        view.take(b"outcome.right", encode(told), 2_000 * MS)
        last = view.snapshot(2_000 * MS).judged
        assert last is not None
        assert (last.verdict, last.p_slip, last.grasp, last.ago_s) == ("slip", 0.75, 42, 2.0)
        assert last.ended == ended


def risk(**other: Any) -> RiskReport:  # noqa: ANN401
    return structs.replace(RISK, **other)


NOTHING_TOLD = risk(lifts=0, slips=0)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"p_slip": 0.44}, "a slip is too likely for a promise"),
        ({"p_slip": 0.251}, "a slip is too likely for a promise"),
        ({"risk": None, "outcomes": 0}, "no outcome told yet"),
        ({"risk": NOTHING_TOLD, "outcomes": 0}, "no outcome told yet"),
        ({"risk": NOTHING_TOLD}, "too few `stable` lifts"),
        ({"risk": risk(lifts=9, slips=0)}, "too few `stable` lifts"),
        ({"risk": risk(target=None, bound=None)}, "no target is set"),
        ({"risk": risk(slips=5)}, "more `stable` lifts slipped"),
        ({"early": True}, "judged early"),
    ],
)
def test_a_stable_without_evidence_only_leans_to_it(change: dict[str, Any], why: str) -> None:
    """Enough are ten lifts for a target of 10 %, of which one may slip."""
    assert tone_of() is Tone.STABLE
    assert tone_of(risk=risk(lifts=10, slips=1)) is Tone.STABLE
    seen = after((b"verdict.right", verdict(0, Decision.STABLE, **change))).snapshot(0)
    assert (seen.tone, seen.verdict, seen.headline) == (Tone.LEANS, "stable", "leans to stable")
    assert seen.why[0].advice.startswith(why)
    assert "lift" not in [line.what for line in seen.why]
    assert "STABLE" not in text_of(seen, 80, 24, Canvas())[3].replace("LEANS TO STABLE", "")


def tone_of(**other: Any) -> Tone:  # noqa: ANN401
    return after((b"verdict.right", verdict(0, Decision.STABLE, **other))).snapshot(0).tone


@pytest.mark.parametrize(
    ("still_ms", "words"),
    [
        (None, "-"),
        (0.0, "0 ms"),
        (100.0, "100 ms, may slide"),
        (239.999999, "239 ms, may slide"),
        (240.0, "240 ms"),
        (9999.9, "9999 ms"),
        (75_600.0, "75 s"),
    ],
)
def test_for_how_long_the_hand_has_been_still_is_said(still_ms: float | None, words: str) -> None:
    view = after((b"verdict.right", verdict(0, Decision.STABLE, still_ms=still_ms)))
    assert view.snapshot(0).still == words
    assert f"   still {words}" in text_of(view.snapshot(0), 80, 24, Canvas())[2]
    assert view.snapshot(101 * MS).still == "-"  # silent


MOVES: dict[str, Any] = {"still_ms": 130.0, "motion": {"ff": 1.2, "th": None}}
LIMITS: dict[str, Any] = {"motion_limits": {"ff": 1.5, "th": 1.0}}


@pytest.mark.parametrize(
    ("told", "seen"),
    [
        (MOVES | LIMITS, {"ff": (1.2, 1.5), "th": (None, 1.0)}),
        ({"motion": {"ff": 0.0}} | LIMITS, {"ff": (0.0, 1.5), "th": (None, 1.0)}),
        (MOVES, {"ff": (None, 0.0), "th": (None, 0.0)}),
        ({"motion": {"ff": 1.0}, "motion_limits": {"ff": 0.0}}, {"ff": (None, 0.0)}),
        ({}, {"ff": None, "th": None}),
    ],
    ids=["all", "one", "no limits", "no limit", "nothing"],
)
def test_a_finger_has_its_motion_and_what_is_not_known_is_not_0(
    told: dict[str, Any], seen: dict[str, tuple[float | None, float] | None]
) -> None:
    view = after(
        (b"tactile.right", tactile(0, RESTING, RESTING)),
        (b"verdict.right", verdict(0, **told)),
    )
    found = {
        finger.name: None if finger.motion is None else (finger.motion.now, finger.motion.limit)
        for finger in view.snapshot(0).fingers
    }
    assert seen.items() <= found.items()


@pytest.mark.parametrize(
    ("now", "bar"),
    [
        (0.0, "-----|-----"),
        (0.3, "#----|-----"),
        (1.5, "#####|-----"),
        (1.51, "#####|#----"),
        (2.0, "#####|##---"),
        (3.0, "#####|#####"),
        (1e308, "#####|#####"),
        (None, "???????????"),
    ],
)
def test_a_bar_of_motion_has_the_limit_in_its_middle(now: float | None, bar: str) -> None:
    """It ends at twice the limit, so five characters are the limit, here 1.5."""
    ascii_only = Canvas(colour=False, ascii_only=True)
    assert ascii_only.motion(FingerMotion(now=now, limit=1.5), 11).plain == bar
    drawn = str.maketrans("#-|", "█░┃")
    assert Canvas().motion(FingerMotion(now=now, limit=1.5), 11).plain == bar.translate(drawn)


def test_the_terminal_shows_each_finger_s_motion_below_its_image() -> None:
    seen = a_grasp(**MOVES | LIMITS)
    small, large = (
        text_of(seen, *size, Canvas(colour=False, ascii_only=True))
        for size in ((80, 24), (120, 40))
    )
    assert "1379 ##-|--     0 ??????" in small[16]  # by hand: 1.2 / 1.5 of 3 are 2.4
    assert "fall, motion to |: counts, sigma" in small[16]
    assert "fall 1379 counts" in large[23]
    assert large[24].rstrip() == "moves 1.2  ####-|-----  moves      ???????????"
    assert "-" not in text_of(a_grasp(), 80, 24, Canvas(colour=False, ascii_only=True))[16]
    assert "moves 1.2\u03c3" in "\n".join(text_of(seen, 120, 40, Canvas()))


def test_messages_of_before_there_were_outcomes_are_never_a_promise() -> None:
    former = json.loads((GOLDEN[0].parent / "verdict_stable.json").read_text())
    for added in ("p_slip_model", "outcomes", "supervised", "risk"):
        del former[added]
    seen = after((b"verdict.right", json.dumps(former).encode())).snapshot(0)
    assert (seen.tone, seen.evidence, seen.learning) == (Tone.LEANS, "no outcome told yet", [])


@pytest.mark.parametrize(
    ("change", "evidence"),
    [
        ({}, "network 30 %, rests on 57 lifts; of 41 `stable` ones 2 slipped, target 10 %"),
        (
            {"outcomes": 1, "risk": risk(lifts=0, slips=0, target=0.05)},
            "network 30 %, rests on 1 lift; no `stable` one told yet, target 5 %",
        ),
        (
            {"risk": risk(target=None)},
            "network 30 %, rests on 57 lifts; of 41 `stable` ones 2 slipped",
        ),
        ({"risk": NOTHING_TOLD, "outcomes": 0}, "network 30 %, no outcome told yet"),
        ({"risk": None, "outcomes": 0, "p_slip_model": None}, "no outcome told yet"),
    ],
)
def test_a_verdict_says_what_it_rests_on(change: dict[str, Any], evidence: str) -> None:
    seen = after((b"verdict.right", verdict(0, Decision.STABLE, **change))).snapshot(0)
    assert seen.evidence == evidence
    assert text_of(seen, 80, 24, Canvas())[6].rstrip() == evidence


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
def test_a_lift_to_be_watched_is_told_apart(
    decision: Decision, reasons: list[Reason], tone: Tone
) -> None:
    message = verdict(0, decision, reasons=reasons, supervised=True)
    seen = after((b"verdict.right", message)).snapshot(0)
    asked = tone not in {Tone.TROUBLE, Tone.WAITING}
    assert (seen.tone, WATCHED in seen.why) == (tone, asked)
    assert "lift" not in [line.what for line in seen.why]


def test_how_learning_goes_is_seen_what_nobody_told_first() -> None:
    lifts = Lifts(reported=41, outstanding=1, unreported=3)
    told = {OutcomeStatus.TAKEN: 57, OutcomeStatus.CONTRADICTS: 1}
    learner = LearnerHealth(enabled=True, outcomes=57, told=told, uncertainty=0.41)
    seen = after(
        (b"status.right", status(0, lifts=lifts, learner=learner)),
        (b"verdict.right", verdict(0, Decision.STABLE)),
    ).snapshot(0)
    assert seen.learning == [
        Line("never told", "3 lifts"),
        Line("warm-up left", "0 outcomes"),
        Line("still out", "1 lift"),
        Line("learner", "on"),
        Line("learned from", "57 outcomes"),
        Line("uncertainty", "41 %"),
        Line("slips of `stable`", "2 of 41 lifts, at most 9.5"),
        Line("outcomes taken", "57"),
        Line("outcomes contradicts", "1"),
    ]
    text = "\n".join(text_of(seen, 80, 24, Canvas()))
    assert "never told 3 lifts  warm-up left 0 outcomes" in text
    large = "\n".join(text_of(seen, 200, 60, Canvas()))
    assert re.search(r"slips of `stable` +2 of 41 lifts, at most 9\.5", large)


def test_the_verdict_stays_in_view_until_the_next_grasp_and_is_marked_as_past() -> None:
    view = after((b"verdict.right", verdict(0, Decision.STABLE, grasp=41)))
    view.take(b"verdict.right", verdict(1, grasp=41, gate=GateState.CLOSING), 0)
    for seq, gate, word in ((2, GateState.JUDGED, "judged"), (3, GateState.RELEASED, "past:")):
        view.take(b"verdict.right", verdict(seq, grasp=41, gate=gate), 0)
        seen = view.snapshot(0)
        field = [line[:24].strip() for line in text_of(seen, 80, 24, Canvas())[1:6]]
        assert field == ["", "", "UNKNOWN", f"({word} stable 25 %)", ""]
        assert seen.judged is not None
        assert seen.judged.held == (gate is GateState.JUDGED)
    assert "stable 25 %, 0 s ago, past" in "\n".join(text_of(seen, 80, 24, Canvas()))
    view.take(b"verdict.right", verdict(4, grasp=42, gate=GateState.CLOSING), 0)
    assert "(" not in text_of(view.snapshot(0), 80, 24, Canvas())[4]


def test_a_grasp_whose_verdict_turns_while_it_stands_is_listed_once_as_it_was_told_last() -> None:
    view = after((b"verdict.right", verdict(0, Decision.STABLE, grasp=41)))
    turned = verdict(1, Decision.SLIP, grasp=41, judged=False, gate=GateState.JUDGED)
    view.take(b"verdict.right", turned, 0)
    assert [(last.grasp, last.verdict) for last in view.snapshot(0).grasps] == [(41, "slip")]


def test_silence_hides_what_was_judged_but_in_the_list() -> None:
    view = after((b"verdict.right", verdict(0, Decision.STABLE)))
    seen = view.snapshot(101 * MS)
    assert seen.tone is Tone.SILENT
    assert [(last.verdict, last.held) for last in seen.grasps] == [("stable", False)]
    assert text_of(seen, 80, 24, Canvas())[4][:24].strip() == ""


def outcome(grasp: int, ended: Literal["stable", "slip"], judged_by: str | None = None) -> bytes:
    told = OutcomeMessage(
        boot_id=BOOT, seq=0, t=0.0, t_mono_ns=0, grasp=grasp, outcome=ended, grasp_boot_id=judged_by
    )
    return encode(told)


def test_the_last_grasps_stay_with_how_their_lifts_ended() -> None:
    view = a_view()
    rested(view)
    for grasp in range(1, 12):
        seq = 100 + 2 * grasp
        watched = grasp == 10
        decision = Decision.UNKNOWN if watched else Decision.SLIP if grasp == 9 else Decision.STABLE
        reasons = [Reason.UNPROVEN] if watched else []
        message = verdict(
            seq, decision, grasp=grasp, judged=True, supervised=watched, reasons=reasons
        )
        view.take(b"verdict.right", message, grasp * 1000 * MS)
        view.take(b"verdict.right", verdict(seq + 1, grasp=grasp), grasp * 1000 * MS)
    view.take(b"tactile.right", tactile(99, RESTING, RESTING), 11_000 * MS)
    view.take(b"outcome.right", outcome(1, "slip"), 0)
    view.take(b"outcome.right", outcome(8, "stable"), 0)
    view.take(b"outcome.right", outcome(9, "slip", "another"), 0)
    view.take(b"outcome.right", outcome(10, "slip", BOOT), 0)
    seen = view.snapshot(11_000 * MS)
    assert [(last.grasp, last.verdict, last.ended) for last in seen.grasps] == [
        *((11, "stable", None), (10, "unknown", "slip"), (9, "slip", None)),
        *((8, "stable", "stable"), (7, "stable", None), (6, "stable", None)),
        *((5, "stable", None), (4, "stable", None)),
    ]
    assert [last.ago_s for last in seen.grasps[:3]] == [0.0, 1.0, 2.0]
    lifts = [last.lift for last in seen.grasps[:4]]
    assert lifts == ["not told", "slipped", "-", "held"]
    lines = "\n".join(text_of(seen, 80, 24, Canvas()))
    for row in ("11 stable  25 % not told", "10 unknown      slipped*", "8 stable  25 % held"):
        assert row in lines
    assert "FFJ3   28.6" in lines


def test_a_grasp_that_is_judged_again_is_in_the_list_once() -> None:
    view = after(*[(b"verdict.right", verdict(seq, Decision.SLIP)) for seq in range(3)])
    assert len(view.snapshot(0).grasps) == 1


def test_rates_and_the_last_five_minutes_are_of_what_arrived() -> None:
    view = a_view()
    for moment in range(4 * 320):  # by hand: 320 s, of which 300 are kept
        now_ns = moment * 250 * MS
        for part in range(5):
            view.take(b"verdict.right", verdict(moment * 5 + part, Decision.STABLE), now_ns)
        seen = view.snapshot(now_ns)
    assert seen.timing.verdicts_hz == pytest.approx(20.0)
    silent = view.snapshot(now_ns + 60_000 * MS)
    assert silent.tone is Tone.SILENT
    assert silent.timing.verdicts_hz == pytest.approx(20.0)  # as all figures, of then
    assert seen.history == ["s"] * 300
    assert seen.history_p == [25] * 300


@pytest.mark.parametrize(("fall", "level"), [(0, 0), (16, 10), (400, 50), (1600, 100), (3000, 100)])
def test_a_pixel_shows_the_root_of_the_fall_below_the_rest(fall: int, level: int) -> None:
    """Root of the share of 1600 counts, in %: 16 / 1600 = 0.1 squared."""
    view = a_view()
    rested(view)
    view.take(b"verdict.right", verdict(98, gate=GateState.CLOSING), 0)
    view.take(b"tactile.right", tactile(99, [3000 - fall] * 24, RESTING), 0)
    first, second = view.snapshot(0).fingers
    assert (first.name, first.from_rest, first.deepest) == ("ff", True, fall)
    assert first.levels == [level] * 132
    assert second.levels == [0] * 132


def test_an_electrode_that_rises_is_below_zero() -> None:
    counts = np.array([3000.0 + 400] * 24)
    shown = image("ff", counts, SOUND, np.array(RESTING, dtype=float), touches=False)
    assert shown.levels == [-50] * 132


def test_an_electrode_is_where_the_layout_has_it() -> None:
    """E7 stands in row 8, column 1 of D1 (the paper's table)."""
    counts = np.array(RESTING, dtype=float)
    counts[6] -= 1600
    shown = image("ff", counts, SOUND, np.array(RESTING, dtype=float), touches=True)
    assert (D1.rows[6], D1.columns[6]) == (8, 1)
    assert (HEIGHT, WIDTH, len(shown.levels)) == (12, 11, 132)
    assert shown.levels[8 * WIDTH + 1] == FULL


def test_a_rest_is_learned_only_while_nothing_touches_and_the_finger_is_tared() -> None:
    view = a_view()
    rested(view, 24)
    view.take(b"status.right", status(1, tared=["th"]), 0)
    for seq in range(50, 80):
        view.take(b"tactile.right", tactile(seq, RESTING, RESTING), 0)
    assert [finger.from_rest for finger in view.snapshot(0).fingers] == [False, True]
    view.take(b"verdict.right", verdict(90, gate=GateState.CLOSING, contact=["th"]), 0)
    for seq in range(90, 200):
        view.take(b"tactile.right", tactile(seq, RESTING, [1400] * 24), 0)
    assert view.snapshot(0).fingers[1].levels == [100] * 132


def test_the_rest_follows_a_slow_drift() -> None:
    rest = Rest()
    for _ in range(25):
        rest.learn(np.full(24, 3000.0), SOUND)
    assert rest.counts is not None
    assert rest.counts == pytest.approx(np.full(24, 3000.0))
    for _ in range(500):  # ten times the fifty readings that a share of 2 % goes back
        rest.learn(np.full(24, 3010.0), SOUND)
    assert rest.counts == pytest.approx(np.full(24, 3010.0), abs=0.01)


def test_a_touch_that_the_gate_has_not_seen_yet_hardly_moves_the_rest() -> None:
    rest = Rest()
    for _ in range(100):
        rest.learn(np.full(24, 3000.0), SOUND)
    for _ in range(3):
        rest.learn(np.full(24, 1400.0), SOUND)
    assert rest.counts is not None
    assert rest.counts.min() == pytest.approx(2998.8)  # three times 2 % of 20 counts


def test_without_a_rest_an_image_shows_how_the_electrodes_differ() -> None:
    counts = np.array([3000.0] * 12 + [2000.0] * 12)
    shown = image("ff", counts, SOUND, None, touches=None)
    # The median is 2500, and 500 counts are one standard deviation, of two and a half.
    assert not shown.from_rest
    assert (min(shown.levels), max(shown.levels)) == (-40, 40)
    flat = image("ff", np.full(24, 3000.0), SOUND, None, touches=None)
    assert flat.levels == [0] * 132


def test_a_faulty_electrode_is_marked_and_not_taken_for_a_touch() -> None:
    view = a_view()
    rested(view)
    counts = [3000] * 24
    counts[6] = 0
    view.take(b"tactile.right", tactile(99, counts, RESTING, faulty=(6,)), 0)
    view.take(b"verdict.right", verdict(99, Decision.STABLE, repaired=["ff_1", "th_24"]), 0)
    first, second = view.snapshot(0).fingers
    assert first.levels == [0] * 132
    assert first.marked == [1, 8 * WIDTH + 1]  # E1 stands in row 0, column 1
    assert second.marked == [5 * WIDTH + 5]  # E24 in row 5, column 5
    nothing = image("ff", np.zeros(24), ~SOUND, None, touches=None)
    assert (nothing.levels, len(nothing.marked)) == ([0] * 132, 24)


@pytest.mark.parametrize("counts", [[], [1] * 23])
def test_a_finger_of_fewer_electrodes_is_left_out(counts: list[int]) -> None:
    seen = after((b"verdict.right", verdict(0)), (b"tactile.right", tactile(0, counts, RESTING)))
    assert [finger.name for finger in seen.snapshot(0).fingers] == ["th"]


def test_images_go_when_readings_no_longer_come() -> None:
    view = after((b"tactile.right", tactile(0, RESTING, RESTING)))
    view.take(b"verdict.right", verdict(0), 1001 * MS)
    assert view.snapshot(1001 * MS).fingers == []


def a_grasp(**more: Any) -> Snapshot:  # noqa: ANN401
    view = a_view()
    rested(view)
    pressed = [3000 - 60 * electrode for electrode in range(24)]
    view.take(b"tactile.right", tactile(99, pressed, RESTING, faulty=(6,)), 0)
    view.take(b"verdict.right", verdict(99, Decision.SLIP, **more), 0)
    return view.snapshot(0)


@pytest.mark.parametrize("canvas", [Canvas(), Canvas(colour=False), Canvas(False, True)], ids=str)
@pytest.mark.parametrize(("width", "height"), [(80, 24), (100, 34), (120, 40), (200, 60)])
@pytest.mark.parametrize("moves", [False, True])
def test_the_view_fits_the_terminal(width: int, height: int, canvas: Canvas, moves: bool) -> None:
    seen = a_grasp(**MOVES | LIMITS) if moves else a_grasp()
    lines = text_of(seen, width, height, canvas)
    assert len(lines) <= height
    assert max(map(len, lines)) <= width
    text = "\n".join(lines)
    for what in ("slip probability 75 %", "ff touches", "FFJ3   28.6", "gate judged", "q ends"):
        assert what in text
    assert f"ff_7 electrode-dead: {ADVICE[Reason.ELECTRODE_DEAD]}" in text
    assert math.degrees(0.5) == pytest.approx(28.6, abs=0.05)


def test_a_terminal_of_ascii_gets_ascii() -> None:
    for seen in (a_grasp(), a_grasp(**MOVES | LIMITS)):
        for line in text_of(seen, 80, 24, Canvas(colour=False, ascii_only=True)):
            assert line.replace("°", "").isascii()


def test_the_header_has_the_wall_clock_of_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TZ", "CET-1")
    time.tzset()
    seen = after((b"verdict.right", verdict(0, Decision.STABLE))).snapshot(0)
    header = text_of(seen, 80, 24, Canvas())[0]
    monkeypatch.undo()
    time.tzset()
    assert header.startswith("graspd right  15:13:20")  # date -u -d @1790000000: 14:13:20


@pytest.mark.parametrize(("width", "height"), [(1, 1), (10, 3), (40, 12), (79, 23)])
def test_a_terminal_that_is_too_small_is_no_error(width: int, height: int) -> None:
    assert text_of(a_grasp(), width, height, Canvas())


def test_without_colour_the_pressed_side_of_a_finger_is_darker() -> None:
    lines = text_of(a_grasp(), 80, 24, Canvas(colour=False))
    images = "".join(line[:11] for line in lines)
    assert "█" in images
    assert "\u00d7" in images


def test_more_is_unwell_than_fits_and_the_rest_is_counted() -> None:
    view = a_view()
    health = {f"ff_{number}": Reason.ELECTRODE_DEAD for number in range(1, 25)}
    view.take(b"status.right", status(0, health=health), 0)
    view.take(b"verdict.right", verdict(0), 0)
    lines = text_of(view.snapshot(0), 80, 24, Canvas())
    assert len(lines) == 24
    assert "and 24 more" in "\n".join(lines)


@pytest.mark.parametrize("overloaded", [False, True])
def test_an_overloaded_daemon_is_not_well(overloaded: bool) -> None:
    view = a_view()
    view.take(b"status.right", status(0, overloaded=overloaded), 0)
    view.take(b"verdict.right", verdict(0), 0)
    assert ("overloaded" in [line.what for line in view.snapshot(0).health]) is overloaded


def test_names_that_come_in_messages_cannot_move_the_cursor() -> None:
    evil = "\x1b[2J\x1b]0;owned\x07"
    view = after(
        (b"verdict.right", verdict(0, Decision.SLIP, model=evil, repaired=[evil])),
        (b"status.right", status(0, health={evil: Reason.HELD}, drivers={evil: {evil: 1}})),
    )
    text = "\n".join(text_of(view.snapshot(0), 120, 40, Canvas()))
    assert "\x1b" not in text
    assert "\x07" not in text
    assert r"\x1b[2J" in text


@pytest.mark.parametrize("outcome", Decision)
def test_the_verdict_stands_alone_in_a_field_of_five_lines(outcome: Decision) -> None:
    seen = after((b"verdict.right", verdict(0, outcome))).snapshot(0)
    field = [line[:24].strip() for line in text_of(seen, 80, 24, Canvas())[1:6]]
    assert field == ["", "", outcome.value.upper(), "", ""]


def mutated(rng: random.Random, golden: dict[str, object]) -> bytes:
    """A message with odd values, odd bytes, or cut off."""
    content = dict(golden)
    for key in rng.sample(sorted(content), rng.randrange(3)):
        if isinstance(content[key], list | dict) and rng.random() < 0.5:
            content[key] = [rng.choice(ODD) for _ in range(rng.choice((1, 2, 24, 1000)))]
        else:
            content[key] = rng.choice(ODD)
    payload = bytearray(json.dumps(content).encode())
    if rng.random() < 0.2:
        payload[rng.randrange(len(payload))] = rng.randrange(256)
    if rng.random() < 0.1:
        del payload[rng.randrange(len(payload)) :]
    return bytes(payload)


def test_ten_thousand_malformed_messages_neither_stop_the_view_nor_its_drawing() -> None:
    seed = 20261121
    rng = random.Random(seed)
    goldens = [(path.stem.split("_")[0], json.loads(path.read_text())) for path in GOLDEN]
    view = a_view()
    for number in range(10_000):
        kind, golden = rng.choice(goldens)
        payload = mutated(rng, golden)
        try:
            view.take(f"{kind}.right".encode(), payload, number * MS)
            seen = view.snapshot(number * MS)
            if number % 100 == 0:
                json.loads(msgspec.json.encode(seen))
                assert len(text_of(seen, 80, 24, Canvas())) <= 24
        except Exception as error:
            error.add_note(f"seed {seed}, message {number}: {payload[:500]!r}")
            raise
    assert 1000 < seen.timing.not_understood < 9000
