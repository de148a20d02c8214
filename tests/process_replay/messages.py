"""References of the messages of some runs: `references/<name>.messages`.

A line stands for messages that follow each other and differ in numbers only: how many they are,
their kind, and the first of them, without versions. Kind `answer`: the loop's to an outcome.
"""

from __future__ import annotations

import re
from itertools import groupby
from pathlib import Path
from typing import Final

from tests.process_replay.commands import NUMBER, lines_apart
from tests.process_replay.judging import Message
from tests.process_replay.verdicts import FOLDER, played

NAMES: Final = ("request_risk", "slow", "spi_early")
"""Cases of `verdicts` whose messages are kept."""
TOLERANCE: Final = 2e-4
"""Largest difference of numbers with a point, absolute and relative: processors differ."""

_COUNTER: Final = re.compile(r'(?<="seq":)\d+|(?<="t_mono_ns":)\d+')
_VERSIONS: Final = re.compile(r'(?<="(?:graspd|python)":)"[^"]*"|(?<="onnxruntime":)"[^"]*"')


def path_of(name: str) -> Path:
    """Return the file of a reference."""
    return FOLDER / f"{name}.messages"


def made(name: str) -> str:
    """Return the text of a reference as it would be now."""
    lines = []
    for _, group in groupby(played(name), _frame):
        alike = list(group)
        kind, payload = alike[0]
        payload = NUMBER.sub(_rounded, _VERSIONS.sub('"*"', payload))
        lines.append(f"{len(alike)} {kind} {payload}\n")
    return "".join(lines)


def _frame(message: Message) -> tuple[str, str]:
    """Return kind and payload of a message with its numbers masked, to group equal ones."""
    kind, payload = message
    return kind, _COUNTER.sub("*", NUMBER.sub("*", payload))


def _rounded(number: re.Match[str]) -> str:
    return str(round(float(number[0]), 4))


def differences(before: str, now: str) -> list[str]:
    """Return where two texts differ, line by line; numbers with a point may differ a little."""
    return lines_apart(before.splitlines(), now.splitlines(), TOLERANCE)
