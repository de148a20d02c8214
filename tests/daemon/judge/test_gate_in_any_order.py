"""The gate against a simulation, in random order: touch, motion, gaps, joints, questions, rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test

from graspd.biotac import Finger
from graspd.daemon.judge.decision import GateLimits, HandLimits
from graspd.daemon.judge.gate import Gate
from graspd.daemon.judge.reasons import Moment, Reason
from graspd.daemon.judge.stillness import Motion
from tests.daemon.fakes import FINGERS, MS

TOUCHES = st.sampled_from((FINGERS, FINGERS, ("ff", "th"), ("ff",), ()))
MOTIONS = {
    "still": (True, True, True, True),
    "trembles": (True, False, True, True),
    "slides": (True, False, True, False),
    "shakes": (False, False, True, True),
    "rushes": (False, False, False, False),
}
"""Kinds of motion: whether it is within the strict limit in the short window, and in both windows;
then the same for the loose limit."""
OBJECTIONS = st.sampled_from(
    ((),) * 4 + ((Reason.JOINTS_LATE,), (Reason.JOINTS_LATE, Reason.NOT_TARED))
)
Change = tuple[int, int, str, str, str]
"""Time, ms, grasp, former state, state and cause."""


@dataclass
class Within:
    """Stands for `MotionLimits`."""

    early: bool = False
    sure: bool = False


class Felt:
    """Stands for `Motion`: no window is longer than the time since the last gap."""

    looked = False

    def __init__(self) -> None:
        self.kind, self.lasts = "still", 0
        self.reset()

    def reset(self) -> None:
        self.lasts, self.known = 0, False
        self.strict, self.loose = Within(), Within()

    def add(self, step: int) -> None:
        self.lasts += step
        self.known = self.lasts >= 100
        early, sure, loosely_early, loosely_sure = MOTIONS[self.kind]
        self.strict = Within(self.known and early, self.lasts >= 240 and sure)
        self.loose = Within(self.known and loosely_early, self.lasts >= 240 and loosely_sure)

    @property
    def slides(self) -> bool:
        return self.lasts >= 240 and self.kind != "still"


class Model:
    """Simulates when a grasp settles, is judged and ends, as deploy/JUDGING.md says; in ms."""

    def __init__(self, *, early: bool, on_request: bool) -> None:
        self.settles, self.on_request = 100 if early else 240, on_request
        self.state, self.grasp, self.changes = "idle", 0, list[Change]()
        self.touches = self.asked = False
        self.sure = self.early = False  # settled with slow slides excluded; judged before that
        self.still_from: int | None = None
        self.moves_from: int | None = None
        self.asked_until: int | None = None
        self.now = self.still = self.touched = self.opened = self.judged = 0

    def go(self, state: str, cause: str) -> None:
        self.changes.append((self.now, self.grasp, self.state, state, cause))
        self.state, is_held = state, state in ("settled", "judged")
        self.sure = is_held and (self.sure or self.still >= 240)
        self.early, self.moves_from = is_held and self.early, self.moves_from if is_held else None

    def gap(self, now: int) -> None:
        if now < self.now:
            self.opened, self.asked_until = now, None
        self.now, self.touched = now, min(self.touched, now)
        self.still, self.still_from = 0, None
        if self.state in ("settled", "judged"):
            self.go("closing", "gap")

    def wait(self, window: int | None) -> None:
        """Update how long touch and stillness have lasted, and drop an old question.

        `window`: length of the window in which nothing moves, ms; None: something moves.
        """
        if self.asked and self.asked_until is None:
            self.asked_until = self.now + 1000
        self.asked = self.asked and self.now <= (self.asked_until or 0)
        self.still = 0
        if window is None:
            self.still_from = None
            return
        begun = max(self.now - window, self.touched)
        begun = begun if self.still_from is None else min(begun, self.still_from)
        self.still_from = begun if window == 240 else max(begun, self.now - 239)
        self.still = self.now - self.still_from

    def follow(self, *, touched: bool, is_other: bool, is_sound: bool, is_still: bool) -> None:
        if self.state == "released" and self.now - self.opened >= 100:
            self.go("idle", "time")
        if touched and self.state in ("idle", "released"):
            self.grasp += 1
            self.go("closing", "contact")
        elif not touched and self.state not in ("idle", "released"):
            self.opened = self.now
            self.go("released", "contact-lost")
        has_settled = is_sound and self.still >= self.settles
        if self.state in ("settled", "judged") and not self.touches:
            self.go("closing", "contact-lost")
        elif self.state == "judged" and is_other:
            self.go("closing", "changed")
        elif self.state == "judged":
            self.moves_from = None if is_still else self.moves_from or self.now
            if self.moves_from and self.now - self.moves_from >= 480:
                self.go("closing", "moved")
            elif is_still and self.early and self.still >= 240:
                self.go("settled", "still")
        elif self.state == "settled" and not has_settled:
            self.go("closing", "moved")
        elif self.state == "closing" and has_settled:
            self.go("settled", "still")

    def judge(self, *, fresh: bool) -> tuple[bool, bool]:
        """Return whether a sound, timely reading is judged, and if so, as more than a refresh."""
        age, wanted = self.now - self.judged, self.asked or not self.on_request
        if self.state == "judged":
            is_due = age > 100 or (fresh and (self.asked or age >= 50))
        else:
            is_due = fresh and self.state == "settled" and (self.early or wanted)
        if not is_due:
            return False, False
        answers = self.state == "settled" or (self.asked and self.on_request)
        self.judged, self.asked = self.now, False
        if self.state == "settled":
            self.early, self.moves_from = self.still < 240, None
            self.go("judged", "judged")
        return True, answers


class Readings(RuleBasedStateMachine):
    """Gives a gate and its `Model` the same random readings and questions, and compares them."""

    early: bool
    on_request: bool

    @initialize(some=st.booleans())
    def begin(self, some: bool) -> None:
        self.required = ("ff", "th") if some else FINGERS
        self.against: tuple[Reason, ...] = ()
        self.model = Model(early=self.early, on_request=self.on_request)
        self.felt, self.now, self.step, self.pressed = Felt(), 10_000, 10, 0
        self.touching: tuple[Finger, ...] = ()
        self.usable = np.ones((3, 24), dtype=np.bool_)
        self.counts = np.zeros((3, 24), dtype=np.int64)
        limits = HandLimits(self.on_request, self.required, GateLimits(early=self.early))
        self.gate = Gate(FINGERS, limits, cast(Motion, self.felt))
        self.read(30)
        self.grasp()

    @rule(touching=TOUCHES)
    def touch(self, touching: tuple[Finger, ...]) -> None:
        self.touching = touching
        self.read()

    @rule(
        motion=st.sampled_from(("still", "slides", *MOTIONS)),
        times=st.sampled_from((1, 10, 24, 49, 49)),
    )
    def move(self, motion: str, times: int) -> None:
        self.felt.kind = motion
        self.read(times)

    @rule(kept=TOUCHES)
    def grasp(self, kept: tuple[Finger, ...] = FINGERS) -> None:
        self.touching, self.step = FINGERS, 10
        self.move("still", 25)
        self.touch(kept)

    @rule(pressed=st.sampled_from((40, 41, -40)), is_broken=st.booleans(), is_held=st.booleans())
    def press(self, pressed: int, is_broken: bool, is_held: bool) -> None:
        """Press one finger harder by `pressed` counts; over 40 since the first judgement make the
        grasp settle again. `is_broken`: half of its electrodes break. `is_held`: grasp first."""
        if is_held:
            self.grasp()
        self.pressed += pressed
        self.usable[0, :12] = not is_broken
        self.read()

    @rule(step=st.sampled_from((1, 10, 16, 50, 99, 100)))
    def change_the_period(self, step: int) -> None:
        self.step = step
        self.read()

    @rule(
        times=st.sampled_from((1, 3, 13)),
        objections=OBJECTIONS,
        fresh=st.booleans(),
        in_time=st.sampled_from((True, True, False)),
    )
    def read(
        self,
        times: int = 1,
        objections: tuple[Reason, ...] = (),
        fresh: bool = True,
        in_time: bool = True,
    ) -> None:
        median = np.full((3, 24), 3000, dtype=np.int64)
        median[0] += self.pressed
        median[~self.usable] = 4095
        change = np.abs(median - self.counts).mean(axis=1, where=self.usable).max()
        for _ in range(times):
            self.now += self.step
            self.felt.add(self.step)
            was_settled, expected = self.follow(objections, change), (False, False)
            if in_time and not self.against:
                expected = self.model.judge(fresh=fresh)
            if was_settled and expected[0]:
                self.counts, change = median, 0.0
            found = self.gate.step(
                *(self.now * MS, median.astype(np.uint16), self.usable, self.touching, objections),
                in_time=in_time,
                fresh=fresh,
            )
            assert (found.judges, found.judged) == expected
            self.agree(found)

    def follow(self, objections: tuple[Reason, ...], change: float) -> bool:
        """Update the simulation, and `against`, the reasons against judging; return True if the
        simulated state is `settled`. `change`: largest mean change of a finger, counts."""
        model, felt, former = self.model, self.felt, self.model.touches
        within = felt.loose if model.sure else felt.strict
        model.now, model.touches = self.now, set(self.required) <= set(self.touching)
        model.touched = self.now if model.touches and not former else model.touched
        if not model.touches:
            not_tared = (Reason.NOT_TARED,) if Reason.NOT_TARED in objections else ()
            self.against = (*not_tared, Reason.NO_CONTACT)
        else:
            unknown = () if felt.known else (Reason.SEQUENCE_GAP,)
            self.against = objections + (unknown or (Reason.MOVING,) * (not within.early))
        model.wait(None if self.against else 240 if within.sure else 100)
        is_still = within.early if model.early else within.sure
        was_judged = model.state == "judged" and model.touches and change <= 40
        model.follow(
            touched=bool(self.touching),
            is_other=change > 40,
            is_sound=not self.against,
            is_still=is_still,
        )
        if was_judged and within.early and not is_still:
            self.against += (Reason.MOVING,)
        if model.state == "closing" and not self.against:
            self.against = (Reason.MOVING if felt.slides else Reason.SETTLING,)
        return model.state == "settled"

    @rule(after=st.sampled_from((101, 5000, -1, -60_000)), touching=st.sampled_from((FINGERS, ())))
    def lose_readings(self, after: int, touching: tuple[Finger, ...]) -> None:
        self.touch(touching)
        self.now += after
        self.gate.restart(self.now * MS)
        self.model.gap(self.now)
        self.against = (Reason.SEQUENCE_GAP,)
        self.look()
        self.read(11)

    @rule(waits=st.booleans())
    def ask(self, waits: bool) -> None:
        """Ask; a question lasts a second from the next reading. `waits`: let 0.9 s of it pass."""
        self.gate.ask()
        self.model.asked, self.model.asked_until = True, None
        if waits:
            self.step = 100
            self.read(10, in_time=False)

    @rule()
    def look(self) -> None:
        self.agree(self.gate.moment(self.touching))

    def agree(self, found: Moment) -> None:
        model, is_judged = self.model, self.model.state == "judged"
        reasons = self.against
        if not (reasons or is_judged):
            wanted = model.early or model.asked or not model.on_request
            reasons = (Reason.SETTLING if wanted else Reason.NOT_ASKED,)
        assert found.reasons == reasons
        assert (found.grasp, found.state) == (model.grasp, model.state)
        assert (found.in_contact, found.settled) == (model.touches, not reasons)
        assert (found.still_ms, found.early) == (model.still, is_judged and model.early)
        strict = self.felt.strict
        assert found.steady is (strict.early if model.early else strict.sure)
        changes = [
            (each.t_ns / MS, each.grasp, each.former, each.state, each.cause)
            for each in found.changes
        ]
        assert changes == model.changes
        model.changes.clear()


@pytest.mark.parametrize("early", [False, True])
@pytest.mark.parametrize("on_request", [False, True])
def test_the_gate_agrees_with_a_simulation_on_random_sequences(
    monkeypatch: pytest.MonkeyPatch, on_request: bool, early: bool
) -> None:
    monkeypatch.setattr(Readings, "early", early, raising=False)
    monkeypatch.setattr(Readings, "on_request", on_request, raising=False)
    run_state_machine_as_test(
        Readings, settings=settings(derandomize=True, max_examples=60, stateful_step_count=40)
    )
