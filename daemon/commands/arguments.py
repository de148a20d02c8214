"""Numbers on the command line."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable


def positive(text: str) -> float:
    """A positive, finite number; for `argparse`."""
    value = _number(text)
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def within(lowest: float, highest: float) -> Callable[[str], float]:
    """Takes numbers from `lowest` to `highest`; for `argparse`."""

    def parse(text: str) -> float:
        value = _number(text)
        if not lowest <= value <= highest:
            raise argparse.ArgumentTypeError(
                f"{text} is not a number from {lowest:g} to {highest:g}"
            )
        return value

    return parse


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
