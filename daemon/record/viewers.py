"""Make tactile images (`foxglove.RawImage`) and log lines (`foxglove.Log`) for viewers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from graspd.biotac import ELECTRODES
from graspd.daemon.judge.reasons import ADVICE, Decision, GateState, Reason, to_act_on
from graspd.daemon.publish.messages import (
    MESSAGES,
    Count,
    GateMessage,
    Message,
    OutcomeMessage,
    State,
    Status,
    Tactile,
    Verdict,
)
from graspd.models.levels import FULL, HEIGHT, PIXELS, WIDTH, RestCounts, fall_of, levels_of

INFO: Final = 2
WARNING: Final = 3
SCALE: Final = 4
"""Factor by which the drawn image is wider and higher than the tactile one."""
_COLOURS: Final = {
    -100: (59, 125, 216),
    0: (38, 44, 54),
    11: (92, 44, 104),
    30: (158, 47, 98),
    55: (229, 92, 48),
    80: (251, 180, 26),
    100: (252, 255, 190),
}
"""Colour (RGB) by level, -100..100: blue is risen, yellow is pressed most."""
_PALETTE = np.array(
    [
        np.interp(np.arange(-FULL, FULL + 1), list(_COLOURS), channel)
        for channel in zip(*_COLOURS.values(), strict=True)
    ]
).T.astype(np.uint8)
_MARK = np.array((0, 220, 220), np.uint8)
"""Colour of an electrode with a faulty count."""

LogLine = tuple[int, str, str]
"""Level, name and text of a log line."""


class Time(msgspec.Struct, frozen=True):
    """Wall-clock time since 1970."""

    sec: Count
    nsec: Annotated[int, msgspec.Meta(ge=0, le=999_999_999)]

    @classmethod
    def of(cls, wall_ns: int) -> Time:
        return cls(*divmod(max(wall_ns, 0), 1_000_000_000))


class RawImage(msgspec.Struct, frozen=True, kw_only=True):
    """A reading as `foxglove.RawImage`: how far each electrode is below its resting count.

    The fingers are side by side, in the order of the reading. The darkest grey is rest, red to
    yellow pressed, blue risen, cyan a faulty count. While the rest of a finger is unknown, and
    without a gate, its electrodes are drawn relative to their median.
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
    """Level: 2 information, 3 warning."""
    message: str
    name: str
    """Name of what changed: `gate`, `verdict`, `outcome`, `health` or `state`."""
    file: str = ""
    line: int = 0


IMAGE_PERIOD_NS: Final = 100_000_000
"""Time between two tactile images, ns: fast enough to watch, a tenth of the readings."""


class Viewer:
    """Makes Foxglove's log lines and images from the messages of one hand.

    Images are relative to the resting counts of each finger, which it learns.
    """

    def __init__(self) -> None:
        self._due_ns = 0
        self._gate: GateState | None = None
        self._rest = RestCounts()
        self._verdict: tuple[int, Decision, list[Reason]] | None = None
        self._state: State | None = None
        self._health: dict[str, Reason] = {}

    def of(self, kind: str, content: object, wall_ns: int) -> Iterator[tuple[str, bytes]]:
        """Yield kind and payload of each log line and image of a message; none if malformed.

        `kind`: first part of the message's topic. `content`: its decoded JSON.
        """
        if kind not in MESSAGES:
            return
        try:
            message = msgspec.convert(content, MESSAGES[kind])
            image = self._image_if_due(message, wall_ns)
        except ValueError:
            return
        for level, name, text in self._changes(message):
            log = Log(timestamp=Time.of(wall_ns), level=level, name=name, message=text)
            yield "log", msgspec.json.encode(log)
        if image is not None:
            yield "image", msgspec.json.encode(image)

    def _changes(self, message: Message) -> Iterator[LogLine]:
        """Yield a log line for each change in a message."""
        match message:
            case GateMessage():
                text = f"{message.former} to {message.state} ({message.cause})"
                yield INFO, "gate", f"grasp {message.grasp}: {text}"
            case Verdict():
                yield from self._of_verdict(message)
            case OutcomeMessage():
                lifted = "" if message.object is None else f", {message.object}"
                text = f"the lift ended in {message.outcome}{lifted}"
                yield INFO, "outcome", f"grasp {message.grasp}: {text}"
            case Status():
                yield from self._of_status(message)

    def _of_verdict(self, message: Verdict) -> Iterator[LogLine]:
        self._gate = message.gate
        verdict = message.grasp, message.verdict, message.reasons
        if verdict == self._verdict:
            return
        self._verdict = verdict
        why = "; ".join(f"{reason}: {ADVICE[reason]}" for reason in to_act_on(message.reasons))
        if message.p_slip is not None:
            why = f"slips with a probability of {message.p_slip:.1%}"
        level = WARNING if message.verdict is Decision.SLIP else INFO
        yield level, "verdict", f"grasp {message.grasp}: {message.verdict} ({why})"

    def _of_status(self, message: Status) -> Iterator[LogLine]:
        if message.state is not self._state:
            level = WARNING if message.state is State.SILENT else INFO
            yield level, "state", str(message.state)
        for part, reason in message.health.items():
            if self._health.get(part) is not reason:
                yield WARNING, "health", f"{part}: {reason}: {ADVICE[reason]}"
        for part in self._health.keys() - message.health.keys():
            yield INFO, "health", f"{part}: well again"
        self._state, self._health = message.state, message.health

    def _image_if_due(self, message: Message, wall_ns: int) -> RawImage | None:
        """Return the image of a `tactile` message if one is due, else None. Raises `ValueError`."""
        if not isinstance(message, Tactile):
            return None
        late_ns = wall_ns - self._due_ns
        if -IMAGE_PERIOD_NS <= late_ns < 0:
            return None
        image = self._image(message, wall_ns)
        is_on_time = 0 <= late_ns < IMAGE_PERIOD_NS
        self._due_ns = (self._due_ns if is_on_time else wall_ns) + IMAGE_PERIOD_NS
        return image

    def _image(self, reading: Tactile, wall_ns: int) -> RawImage:
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
        """Return a finger's picture, shape (`HEIGHT`, `WIDTH`, 3); while idle, learn its rest."""
        if self._gate is GateState.IDLE:
            self._rest.learn(name, counts, sound)
        rest = self._rest.of(name)
        fall = fall_of(counts, sound, rest)
        pixels = _PALETTE[levels_of(fall, from_rest=rest is not None) + FULL]
        pixels[np.array(PIXELS)[~sound]] = _MARK
        return pixels.reshape(HEIGHT, WIDTH, 3)
