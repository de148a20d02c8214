"""Names that a Shadow hand gives its joints."""

from __future__ import annotations

HAND_PREFIXES = ("rh_", "lh_")
"""Shadow's prefixes of a right and a left hand."""
JOINTS = frozenset(
    [f"{finger}J{joint}" for finger in ("FF", "MF", "RF") for joint in range(5)]
    + [f"LFJ{joint}" for joint in range(6)]
    + [f"THJ{joint}" for joint in range(1, 6)]
    + ["WRJ1", "WRJ2"]
)
"""Joint names of the Shadow hand; J0 is the coupled sum of J1 and J2."""


def joint_name(column: str) -> str | None:
    """Return the joint of a column (`rh_FFJ3` gives `FFJ3`); None if it names no joint."""
    if column.startswith(HAND_PREFIXES):
        column = column.partition("_")[2]
    return column if column in JOINTS else None
