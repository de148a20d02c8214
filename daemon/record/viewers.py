"""What a recording says once more for people: tactile images as `foxglove.RawImage`, and what
changed as `foxglove.Log`, which viewers show without knowing anything of graspd."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Annotated, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from daemon.judge.reasons import ADVICE, Decision, GateState, Reason
from daemon.publish.messages import Count, GateMessage, OutcomeMessage, State
from drivers.base import ELECTRODES
from models.levels import FULL, HEIGHT, PIXELS, WIDTH, Rest, fall_of, levels_of

INFO: Final = 2
WARNING: Final = 3
SCALE: Final = 4
"""Pixels of an image per pixel of the tactile image, each way."""
_COLOURS: Final = {
    -100: (59, 125, 216),
    0: (38, 44, 54),
    11: (92, 44, 104),
    30: (158, 47, 98),
    55: (229, 92, 48),
    80: (251, 180, 26),
    100: (252, 255, 190),
}
"""By level: blue is risen, yellow pressed the most."""
_PALETTE = np.array(
    [
        np.interp(np.arange(-FULL, FULL + 1), list(_COLOURS), channel)
        for channel in zip(*_COLOURS.values(), strict=True)
    ]
).T.astype(np.uint8)
_MARK = np.array((0, 220, 220), np.uint8)
"""Of an electrode whose count is faulty."""


class Time(msgspec.Struct, frozen=True):
    """Wall-clock time since 1970."""

    sec: Count
    nsec: Annotated[int, msgspec.Meta(ge=0, le=999_999_999)]

    @classmethod
    def of(cls, wall_ns: int) -> Time:
        """The time `wall_ns`, ns since 1970."""
        return cls(*divmod(max(wall_ns, 0), 1_000_000_000))


class RawImage(msgspec.Struct, frozen=True, kw_only=True):
    """A reading as `foxglove.RawImage`: how far each electrode is below where it rests.

    The fingers stand side by side in the order of the reading. The darkest grey is rest, red to
    yellow pressed, blue risen, cyan an electrode whose count is faulty. Until it is known where a
    finger rests, and where there is no gate, its electrodes are drawn by their own median.
    """

    timestamp: Time
    frame_id: str
    width: Count
    height: Count
    encoding: str
    step: Count
    data: bytes


class Log(msgspec.Struct, frozen=True, kw_only=True):
    """A change of gate, verdict, state or health, or an outcome, as `foxglove.Log`."""

    timestamp: Time
    level: Annotated[int, msgspec.Meta(ge=0, le=5)]
    """2: information, 3: warning."""
    message: str
    name: str
    """Of what: `gate`, `verdict`, `outcome`, `health` or `state`."""
    file: str = ""
    line: int = 0


class _Verdict(msgspec.Struct, frozen=True):
    """What is read of a verdict here."""

    grasp: int
    verdict: Decision
    reasons: list[Reason]
    p_slip: float | None = None
    gate: GateState | None = None


class _Tactile(msgspec.Struct, frozen=True):
    """What is read of a reading here; counts and faults by finger."""

    fingers: list[str]
    counts: list[list[int]]
    faults: list[list[int]]


class _Status(msgspec.Struct, frozen=True):
    """What is read of a status here."""

    state: State
    health: dict[str, Reason]


_Line = tuple[int, str, str]
"""Level, name and text."""


class Journal:
    """Says in words what changes from message to message."""

    def __init__(self) -> None:
        """Nothing was said yet."""
        self._verdict: tuple[object, ...] = ()
        self._state: State | None = None
        self._health: dict[str, Reason] = {}
        self._readers: dict[str, Callable[[object], Iterator[_Line]]] = {
            "gate": self._gate,
            "verdict": self._of_verdict,
            "outcome": self._outcome,
            "status": self._status,
        }

    def of(self, kind: str, content: object, wall_ns: int) -> list[Log]:
        """What a message of a kind of topic, as JSON has it, changes; nothing for a broken one."""
        if kind not in self._readers:
            return []
        stamp = Time.of(wall_ns)
        try:
            return [
                Log(timestamp=stamp, level=level, name=name, message=text)
                for level, name, text in self._readers[kind](content)
            ]
        except msgspec.ValidationError:
            return []

    def _gate(self, content: object) -> Iterator[_Line]:
        gate = msgspec.convert(content, GateMessage)
        yield INFO, "gate", f"grasp {gate.grasp}: {gate.former} to {gate.state} ({gate.cause})"

    def _of_verdict(self, content: object) -> Iterator[_Line]:
        seen = msgspec.convert(content, _Verdict)
        now = seen.grasp, seen.verdict, seen.reasons
        if now == self._verdict:
            return
        self._verdict = now
        level = WARNING if seen.verdict is Decision.SLIP else INFO
        why = "; ".join(f"{reason}: {ADVICE[reason]}" for reason in seen.reasons)
        if seen.p_slip is not None:
            why = f"slips with a probability of {seen.p_slip:.1%}"
        yield level, "verdict", f"grasp {seen.grasp}: {seen.verdict} ({why})"

    def _outcome(self, content: object) -> Iterator[_Line]:
        told = msgspec.convert(content, OutcomeMessage)
        what = "" if told.object is None else f", {told.object}"
        yield INFO, "outcome", f"grasp {told.grasp}: the lift ended in {told.outcome}{what}"

    def _status(self, content: object) -> Iterator[_Line]:
        seen = msgspec.convert(content, _Status)
        if seen.state is not self._state:
            level = WARNING if seen.state is State.SILENT else INFO
            yield level, "state", str(seen.state)
        for part, reason in seen.health.items():
            if self._health.get(part) is not reason:
                yield WARNING, "health", f"{part}: {reason}: {ADVICE[reason]}"
        for part in self._health.keys() - seen.health.keys():
            yield INFO, "health", f"{part}: well again"
        self._state, self._health = seen.state, seen.health


class Painter:
    """Draws readings, so many a second, by where each finger rests, which it learns."""

    def __init__(self, images_hz: float) -> None:
        """Draw `images_hz` images a second at most; 0 draws none."""
        self._period_ns = round(1e9 / images_hz) if images_hz else None
        self._due_ns = 0
        self._gate: GateState | None = None
        self._rests: dict[str, Rest] = {}

    def of(self, kind: str, content: object, wall_ns: int) -> RawImage | None:
        """The image of a reading of wall time `wall_ns`, ns, if one is due; None for all others."""
        if self._period_ns is None or kind not in ("tactile", "verdict"):
            return None
        try:
            if kind == "verdict":
                self._gate = msgspec.convert(content, _Verdict).gate
            elif not 0 < self._due_ns - wall_ns <= self._period_ns:
                image = self._image(msgspec.convert(content, _Tactile), wall_ns)
                late_ns = wall_ns - self._due_ns
                on_time = 0 <= late_ns < self._period_ns
                self._due_ns = (self._due_ns if on_time else wall_ns) + self._period_ns
                return image
        except ValueError:  # a message that is broken has no image
            pass
        return None

    def _image(self, reading: _Tactile, wall_ns: int) -> RawImage:
        shape = len(reading.fingers), ELECTRODES
        counts = np.array(reading.counts, np.float64).reshape(shape)
        sound = np.array(reading.faults).reshape(shape) == 0
        fingers = [self._finger(*one) for one in zip(reading.fingers, counts, sound, strict=True)]
        gap = np.zeros((HEIGHT, 1, 3), np.uint8)
        parts = [part for finger in fingers for part in (finger, gap)][:-1]
        pixels = np.hstack(parts).repeat(SCALE, 0).repeat(SCALE, 1)
        height, width, channels = pixels.shape
        return RawImage(
            timestamp=Time.of(wall_ns),
            frame_id="fingers",
            width=width,
            height=height,
            encoding="rgb8",
            step=width * channels,
            data=pixels.tobytes(),
        )

    def _finger(
        self, name: str, counts: NDArray[np.float64], sound: NDArray[np.bool_]
    ) -> NDArray[np.uint8]:
        """One finger, shape (`HEIGHT`, `WIDTH`, 3); `counts` and `sound` have shape (24,)."""
        rest = self._rests.setdefault(name, Rest())
        if self._gate is GateState.IDLE:
            rest.learn(counts, sound)
        fall = fall_of(counts, sound, rest.counts)
        pixels = _PALETTE[levels_of(fall, from_rest=rest.counts is not None) + FULL]
        pixels[np.array(PIXELS)[~sound]] = _MARK
        return pixels.reshape(HEIGHT, WIDTH, 3)


class ForPeople:
    """What the messages of one hand come to, on topics `log` and `image`."""

    def __init__(self, images_hz: float) -> None:
        """`images_hz` as in `Painter`."""
        self._journal, self._painter = Journal(), Painter(images_hz)

    def of(self, kind: str, content: object, wall_ns: int) -> Iterator[tuple[str, bytes]]:
        """Kind and payload of what is said and drawn of a message, as JSON has it."""
        for line in self._journal.of(kind, content, wall_ns):
            yield "log", msgspec.json.encode(line)
        image = self._painter.of(kind, content, wall_ns)
        if image is not None:
            yield "image", msgspec.json.encode(image)
