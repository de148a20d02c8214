"""The BioTac SP and the fingers that carry it: names, numbers, columns. Imports no other room."""

from __future__ import annotations

from typing import Final, Literal

Finger = Literal["ff", "mf", "rf", "lf", "th"]
"""Name of a finger: first, middle, ring, little, thumb."""
FINGERS: Final[tuple[Finger, ...]] = ("ff", "mf", "rf", "lf", "th")
"""Fingers in the order of the Shadow hand."""
TABLE_FINGERS: Final[tuple[Finger, ...]] = ("ff", "mf", "th")
"""Fingers of the published grasp tables, in the order of their columns; a scene's default."""
ELECTRODES: Final = 24
"""Electrodes of one BioTac SP (manual section 5)."""
FORMER_ELECTRODES: Final = 19
"""Electrodes of the BioTac, which is another sensor than the BioTac SP."""
COUNT_MAX: Final = 4095
"""Largest 12-bit reading of an electrode (manual section 5.1)."""


def electrode_columns(finger: str) -> list[str]:
    """Return a finger's columns in a grasp table, `ff_biotac_1` to `ff_biotac_24`."""
    return [f"{finger}_biotac_{electrode}" for electrode in range(1, ELECTRODES + 1)]


def electrode_name(finger: str, place: int) -> str:
    """Return the name of an electrode, counted from 1: `ff_7` for finger `ff` and place 6."""
    return f"{finger}_{place + 1}"
