"""Compares texts whose numbers may differ a little, since they depend on the processor."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Final

NUMBER: Final = re.compile(r"(?<=[\[:, ])-?\d+(?:\.\d+(?:e[-+]?\d+)?|e[-+]?\d+)(?=[\],} \n]|$)")
"""A number with a point or exponent. Others are counted and must be equal."""


def lines_apart(before: Sequence[str], now: Sequence[str], tolerance: float) -> list[str]:
    """Return where lines differ. Numbers with a point may differ by `tolerance`."""
    found = [
        f"line {number}: {was}\n  became: {is_now}"
        for number, (was, is_now) in enumerate(zip(before, now, strict=False), start=1)
        if was != is_now and not _alike(was, is_now, tolerance)
    ]
    if len(before) != len(now):
        found.append(f"{len(before)} lines became {len(now)}")
    return found


def _alike(was: str, is_now: str, tolerance: float) -> bool:
    if NUMBER.sub("*", was) != NUMBER.sub("*", is_now):
        return False
    pairs = zip(NUMBER.findall(was), NUMBER.findall(is_now), strict=True)
    return all(
        math.isclose(float(left), float(right), rel_tol=tolerance, abs_tol=tolerance)
        for left, right in pairs
    )
