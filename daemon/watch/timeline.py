"""The last five minutes of a hand in columns of a second each, by the clock of whoever watches."""

from __future__ import annotations

from collections import deque

from daemon.watch.snapshot import MOMENTS, TONE_CODE, WORST_FIRST, Tone

MOMENT_NS = 1_000_000_000
"""What a column of the timeline stands for, ns."""
NO_SHARE = -1
"""Probability of slip where there is none."""


class Timeline:
    """Remembers the tones and the highest probability of slip of each of the last seconds."""

    def __init__(self) -> None:
        """Without a second."""
        self._moments: deque[tuple[frozenset[Tone], int]] = deque(maxlen=MOMENTS)
        self._second: int | None = None

    def add(self, now_ns: int, tone: Tone, p_slip: float | None) -> None:
        """What holds at `now_ns`; seconds in which nobody called it were silent."""
        second, share = now_ns // MOMENT_NS, NO_SHARE if p_slip is None else round(100 * p_slip)
        tones = frozenset([tone])
        if self._second is not None and second <= self._second:
            before, highest = self._moments.pop()
            tones, share = tones | before, max(highest, share)
        elif self._second is not None:
            missed = min(second - self._second - 1, MOMENTS)
            self._moments.extend([(frozenset([Tone.SILENT]), NO_SHARE)] * missed)
        self._moments.append((tones, share))
        self._second = second if self._second is None else max(second, self._second)

    @property
    def tones(self) -> list[str]:
        """By second, the oldest first: what there was in it, the worst first; see `TONE_CODE`."""
        return [
            "".join(TONE_CODE[t] for t in WORST_FIRST if t in tones) for tones, _ in self._moments
        ]

    @property
    def shares(self) -> list[int]:
        """Probability of slip by second, %; `NO_SHARE` where there is none."""
        return [share for _, share in self._moments]
