"""The last five minutes of a hand, second by second."""

from __future__ import annotations

from daemon.watch.snapshot import Tone

SECONDS = 300
SECOND_NS = 1_000_000_000
NO_SHARE = -1
"""A second without a probability of slip."""
TONE_CODE = {
    Tone.SLIP: "x",
    Tone.TROUBLE: "t",
    Tone.SILENT: ".",
    Tone.LEARNING: "u",
    Tone.STABLE: "s",
    Tone.LEANS: "l",
    Tone.WAITING: "w",
}
"""Letter of each tone in `Snapshot.history`."""


class History:
    """Remembers the tones and the highest probability of slip of each second."""

    def __init__(self) -> None:
        self._first: int | None = None
        self._seconds: dict[int, tuple[str, int]] = {}
        """By number, the newest last: letters of its tones; highest probability, %."""

    def add(self, now_ns: int, tone: Tone, p_slip: float | None) -> None:
        second, code = now_ns // SECOND_NS, TONE_CODE[tone]
        share = NO_SHARE if p_slip is None else round(100 * p_slip)
        if self._first is None:
            self._first = second
        codes, highest = self._seconds.get(second, ("", NO_SHARE))
        self._seconds[second] = codes.replace(code, "") + code, max(share, highest)
        while len(self._seconds) > SECONDS:
            del self._seconds[next(iter(self._seconds))]

    def seconds(self) -> list[tuple[str, int]]:
        """Return five minutes, the oldest second first; one without a call was silent."""
        if self._first is None:
            return []
        newest = max(self._seconds)
        oldest = max(self._first, newest - SECONDS + 1)
        silent = TONE_CODE[Tone.SILENT], NO_SHARE
        return [self._seconds.get(second, silent) for second in range(oldest, newest + 1)]
