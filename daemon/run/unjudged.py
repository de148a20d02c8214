"""Explain to a person why recorded readings were not judged."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from statistics import median
from typing import Final

import numpy as np

from graspd.biotac import Finger
from graspd.daemon.judge.contact import WINDOW
from graspd.daemon.judge.hand import GAP_NS
from graspd.daemon.judge.pipeline import Judgement
from graspd.daemon.judge.reasons import ADVICE, OPEN, UNREADABLE, Reason
from graspd.daemon.publish.companion import Companion, PublishedVerdict
from graspd.drivers.base import ANGLE_MAX_RAD, DriverCounters, JointReading, Reading, TactileReading

STEPS: Final = 20
"""Number of the first steps between readings, whose median is the usual step."""
STEP_MAX_S: Final = GAP_NS / 2e9
"""Longest usual step, s. With a longer one each lost reading is a gap, after which a grasp must
settle again."""
STEP_MIN_S: Final = 1e-4
"""Shortest step of a sensor, s: a sweep of 24 electrodes takes a hundred times as long."""
UNITS: Final = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}
"""Names of units in which times may be by mistake, by the number of units in a second."""
CAUSES_MAX: Final = 3
"""Most reasons to write, the most frequent ones."""


class Unjudged(Companion):
    """Follows a replay, and finds why grasps are not judged.

    Times and angles in a wrong unit are reported as soon as they are seen.
    """

    def __init__(
        self, say: Callable[[str], None], required: Sequence[Finger] | None = None
    ) -> None:
        """`say`: writes a line. `required`: fingers that must touch; None: all."""
        self._say = say
        self._required = required
        self._last_ns: int | None = None
        self._steps_s: list[float] = []
        self._angle: tuple[str, float] | None = None
        """Name and value of an angle that no joint has, rad."""
        self._touched: set[Finger] = set()
        self._fingers: tuple[Finger, ...] = ()
        self._was_tared = False
        self._now: Counter[Reason] = Counter()
        """Count of each reason during the current grasp."""
        self._grasp = 0
        self._is_judged = False
        self._unreadable: Counter[Reason] = Counter()
        """Count of each reason of readings that cannot be used."""
        self._faulty = 0
        """Number of readings in which electrodes were not read."""
        self.readings = 0
        self.judged = 0
        """Grasps that were judged."""
        self.not_judged: Counter[Reason] = Counter()
        """Number of unjudged grasps by their most frequent reason."""

    def on_reading(self, reading: Reading) -> None:
        """Report the first angle that no joint can have; count faulty tactile readings."""
        if isinstance(reading, TactileReading):
            self._faulty += bool(reading.faults.any())
        elif self._angle is None:
            self._look_at_angles(reading)

    def on_verdict(self, published: PublishedVerdict) -> None:
        """Take in a verdict, unless it reports silence."""
        if published.reading is not None:
            self.add(published.judgement, published.reading.made_ns)

    def add(self, judgement: Judgement, made_ns: int) -> None:
        """Take in the judgement of a reading that was made at `made_ns`."""
        self.readings += 1
        self._look_at_step(made_ns)
        moment = judgement.moment
        if moment.touching is not None:
            self._touched.update(moment.touching)
            self._fingers = tuple(moment.fingers or ())
        self._unreadable.update(each for each in judgement.reasons if each in UNREADABLE)
        self._was_tared |= {Reason.NOT_TARED, *UNREADABLE}.isdisjoint(judgement.reasons)
        if moment.grasp != self._grasp:
            self._end_grasp()
            self._grasp = moment.grasp
        if moment.judges and judgement.opinion.p_slip is not None:
            self._is_judged = True
        if moment.state not in OPEN:
            self._now.update(judgement.reasons)

    def end(self, counters: DriverCounters | None = None) -> None:
        """Say why no grasp, or less than half of them, was judged; else say nothing.

        `counters`: the driver's, to show if no reading came; None: not known.
        """
        self._end_grasp()
        missed = self.not_judged.total()
        if not self.judged:
            self._say("nothing was judged:")
        elif missed > self.judged:
            self._say(f"of {self.judged + missed} grasps {missed} were not judged:")
        else:
            return
        for cause in self._causes(counters):
            self._say(f"  {cause}")

    def _end_grasp(self) -> None:
        if self._is_judged:
            self.judged += 1
        elif self._now:
            ((reason, _),) = self._now.most_common(1)
            self.not_judged[reason] += 1
        self._is_judged = False
        self._now.clear()

    def _causes(self, counters: DriverCounters | None) -> Iterator[str]:
        """Yield the causes, as texts. A cause that explains all others stands alone."""
        if not self.readings:
            yield "no reading came of it: is it of another sensor, bus or board?"
            counts = {} if counters is None else counters.as_dict()
            found = ", ".join(f"{name} {number}" for name, number in counts.items() if number)
            yield f"counted: {found or 'nothing'}"
        elif step := self._step_in_words():
            yield step
        elif self._angle is not None:
            yield self._angle_in_words(*self._angle)
        elif damage := self._damage_in_words():
            yield damage
        elif self._fingers and not self._was_tared:
            yield self._rest_in_words()
        elif self._fingers and not self._touched:
            yield "no finger touched: the hand was open all the time"
        else:
            required = self._required or self._fingers
            if missing := [finger for finger in required if finger not in self._touched]:
                yield f"{', '.join(missing)} never touched: all required fingers hold a grasp"
            for reason, number in self.not_judged.most_common(CAUSES_MAX):
                yield f"{number} {reason}: {ADVICE[reason]}"

    def _rest_in_words(self) -> str:
        """Return text on how long the hand must be open for a tare at the rate of the readings."""
        rest_s = WINDOW * median(self._steps_s) if self._steps_s else 1.0
        faulty = f", or electrodes were not read ({self._faulty} readings)" if self._faulty else ""
        return (
            f"no {WINDOW} readings of an open hand come first ({rest_s:.2g} s at this rate){faulty}"
            ": it is not known where the fingers rest"
        )

    def _damage_in_words(self) -> str | None:
        """Return text on the reason that makes most readings unusable; None: no single one."""
        for reason, number in self._unreadable.most_common(1):
            if 2 * number > self.readings:
                return f"{number} of {self.readings} readings {reason}: {ADVICE[reason]}"
        return None

    def _look_at_step(self, made_ns: int) -> None:
        if self._last_ns is not None and len(self._steps_s) < STEPS:
            self._steps_s.append((made_ns - self._last_ns) / 1e9)
            if len(self._steps_s) == STEPS and (step := self._step_in_words()):
                self._say(step)
        self._last_ns = made_ns

    def _step_in_words(self) -> str | None:
        """Return text if readings are too close or too far apart; None: neither, or no gate."""
        if not self._steps_s or not self._fingers:
            return None
        step_s = median(self._steps_s)
        if step_s < STEP_MIN_S:
            return (
                f"readings are {step_s * 1e6:g} us apart: is the time in seconds, with fractions?"
            )
        if step_s <= STEP_MAX_S * 1.001:
            return None
        for per_s, unit in UNITS.items():
            if STEP_MIN_S < step_s / per_s <= STEP_MAX_S and step_s > 1.0:
                return f"readings are {step_s:g} s apart: is the time in {unit}?"
        return (
            f"readings are {step_s * 1e3:.3g} ms apart ({1 / step_s:.3g} Hz): a grasp settles from "
            f"{1 / STEP_MAX_S:g} Hz on, or {0.5 / STEP_MAX_S:g} Hz while no reading is late"
        )

    def _look_at_angles(self, reading: JointReading) -> None:
        beyond = np.flatnonzero(np.abs(reading.position_rad) > ANGLE_MAX_RAD)
        if beyond.size:
            place = int(beyond[0])
            self._angle = reading.names[place], float(reading.position_rad[place])
            self._say(self._angle_in_words(*self._angle))

    def _angle_in_words(self, name: str, angle_rad: float) -> str:
        return f"{name} = {angle_rad:g} rad is not a joint angle: is it in degrees?"
