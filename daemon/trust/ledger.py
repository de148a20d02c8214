"""Which grasps were judged how, until outcomes of their lifts are told: late, twice or never."""

from __future__ import annotations

from collections import Counter
from enum import StrEnum
from typing import Annotated, Final, NamedTuple

import msgspec

from daemon.trust.learner import vector

GRASPS_MAX: Final = 256
"""Grasps that are remembered: those of an hour and more. Outcomes of older ones are refused."""


class GraspId(NamedTuple):
    """Names a grasp for ever."""

    boot_id: str
    """Of the start of the daemon that judged it."""
    grasp: Annotated[int, msgspec.Meta(ge=0)]
    """Its number since that start."""


class Told(StrEnum):
    """What became of an outcome."""

    TAKEN = "taken"
    REPEATED = "repeated"
    """Known already, and the same: ignored."""
    CONTRADICTS = "contradicts"
    """Known already, and the opposite: refused, the first one counts."""
    UNKNOWN = "unknown"
    """Of a grasp that was not judged or is too long ago: refused."""


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One judged grasp."""

    id: GraspId
    stable: bool
    """Whether it was called `stable`."""
    features: bytes | None
    """What it was judged by, float64; None once it must no longer be learned from."""
    slipped: bool | None = None
    """None until it is told."""


class LedgerState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a ledger knows."""

    records: Annotated[tuple[Record, ...], msgspec.Meta(max_length=GRASPS_MAX)]
    """Oldest first."""
    told: dict[Told, Annotated[int, msgspec.Meta(ge=0)]]
    unreported: Annotated[int, msgspec.Meta(ge=0)]

    @property
    def outstanding(self) -> int:
        """Grasps called `stable` whose outcome can still come."""
        return sum(each.stable and each.slipped is None for each in self.records)


class Ledger:
    """Remembers the last `GRASPS_MAX` judged grasps."""

    def __init__(self) -> None:
        """Start empty."""
        self._records: dict[GraspId, Record] = {}
        self.told: Counter[Told] = Counter()
        """Outcomes, by what became of them."""
        self.unreported = 0
        """Grasps that were called `stable` and forgotten before an outcome came."""
        self.outstanding = 0
        """Grasps called `stable` whose outcome can still come."""

    def __contains__(self, grasp: object) -> bool:
        """Whether a grasp is remembered."""
        return grasp in self._records

    def is_told(self, grasp: GraspId) -> bool:
        """Whether the outcome of a grasp is known."""
        known = self._records.get(grasp)
        return known is not None and known.slipped is not None

    def contradicts(self, grasp: GraspId, *, slipped: bool) -> bool:
        """Whether the opposite outcome of a grasp is known."""
        return self.is_told(grasp) and self._records[grasp].slipped != slipped

    def is_stable(self, grasp: GraspId) -> bool:
        """Whether a grasp was called `stable`."""
        known = self._records.get(grasp)
        return known is not None and known.stable

    def note(self, grasp: GraspId, features: bytes, *, stable: bool) -> bool:
        """Remember how a grasp was judged, and by which features, float64.

        Its first verdict counts, or the first that called it `stable`: that is what it is lifted
        on. Once its outcome is known, nothing changes. Returns whether this was new.
        """
        known = self._records.get(grasp)
        if known is not None and (known.stable or not stable or known.slipped is not None):
            return False
        self._records[grasp] = Record(grasp, stable, features)
        self.outstanding += stable
        if len(self._records) > GRASPS_MAX:
            oldest = self._records.pop(next(iter(self._records)))
            forgotten = oldest.stable and oldest.slipped is None
            self.unreported += forgotten
            self.outstanding -= forgotten
        return True

    def tell(self, grasp: GraspId, *, slipped: bool) -> tuple[Told, Record | None]:
        """Take an outcome; returns also what was known of the grasp until now."""
        record = self._records.get(grasp)
        if record is None:
            told = Told.UNKNOWN
        elif record.slipped is None:
            told = Told.TAKEN
            self.outstanding -= record.stable
            self._records[grasp] = Record(grasp, record.stable, None, slipped)
        else:
            told = Told.REPEATED if record.slipped == slipped else Told.CONTRADICTS
        self.told[told] += 1
        return told, record

    def exchanged(self) -> None:
        """A sensor was exchanged: what is still to be told teaches nothing any more."""
        for grasp, known in self._records.items():
            self._records[grasp] = Record(grasp, known.stable, None, known.slipped)

    def state(self) -> LedgerState:
        """What `restore` needs."""
        return LedgerState(tuple(self._records.values()), dict(self.told), self.unreported)

    def restore(self, state: LedgerState, width: int) -> None:
        """Go on from an earlier state, with features (width,). Raises `ValueError`."""
        records = {record.id: record for record in state.records}
        if len(records) != len(state.records):
            raise ValueError("holds a grasp twice")
        for record in state.records:
            if record.features is not None:
                vector(record.features, width)
            if record.features is not None and record.slipped is not None:
                raise ValueError("would learn from a grasp twice")
        self._records, self.told = records, Counter(state.told)
        self.unreported = state.unreported
        self.outstanding = state.outstanding
