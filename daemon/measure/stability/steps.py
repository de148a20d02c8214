"""A step of the daemon that is no model's: what was expected of it and what was found."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class StepRow:
    """One step under one stress."""

    step: str
    expected: str
    found: str
    held: bool
    """Whether what was found is what was expected."""
