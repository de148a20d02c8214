"""The last five minutes of a hand in columns of a second each, by the clock of whoever watches."""

from __future__ import annotations

from collections import deque

from daemon.watch.snapshot import MOMENTS, TONE_CODE, TONES, Tone, worst

MOMENT_NS = 1_000_000_000
"""What a column of the timeline stands for, ns."""
NO_SHARE = -1
"""Probability of slip where there is none."""


class Timeline:
    """Remembers the worst tone and the highest probability of slip of each of the last seconds."""

    def __init__(self) -> None:
        """Without a second."""
        self._moments: deque[tuple[str, int]] = deque(maxlen=MOMENTS)
        self._second: int | None = None

    def add(self, now_ns: int, tone: Tone, p_slip: float | None) -> None:
        """What holds at `now_ns`; seconds in which nobody called it were silent."""
        second, share = now_ns // MOMENT_NS, NO_SHARE if p_slip is None else round(100 * p_slip)
        code = TONE_CODE[tone]
        if self._second is not None and second <= self._second:
            before, highest = self._moments.pop()
            code, share = TONE_CODE[worst((TONES[before], tone))], max(highest, share)
        elif self._second is not None:
            missed = min(second - self._second - 1, MOMENTS)
            self._moments.extend([(TONE_CODE[Tone.SILENT], NO_SHARE)] * missed)
        self._moments.append((code, share))
        self._second = second if self._second is None else max(second, self._second)

    @property
    def tones(self) -> str:
        """By second, the oldest first; see `TONE_CODE`."""
        return "".join(code for code, _ in self._moments)

    @property
    def shares(self) -> list[int]:
        """Probability of slip by second, %; `NO_SHARE` where there is none."""
        return [share for _, share in self._moments]
