"""The book of lifts: the verdict on each grasp, the peer that lifts it, and the outcome."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from enum import StrEnum
from typing import Annotated, Final, NamedTuple

import msgspec
from msgspec.structs import replace

from graspd.models.trust.learner import INPUT_MAX, vector

LIFTS_MAX: Final = 256
"""Most grasps in the book, those of an hour or more. Outcomes of older grasps are refused."""
NAME_BYTES: Final = 16
"""Bytes at the start of a routing id that stay the same when a client reconnects."""
NOT_ASSESSED: Final = b""
"""Value of `features` of a grasp from which nothing can be learned: the model refused it, or the
scene has no learner and no risk."""


class GraspId(NamedTuple):
    """Id of a grasp that is unique over all starts of the daemon."""

    boot_id: str
    """Id of the daemon's start that judged the grasp."""
    grasp: Annotated[int, msgspec.Meta(ge=0)]
    """Number of the grasp since that start."""


class Peer(NamedTuple):
    """Connection of a program that asks for verdicts and reports outcomes."""

    routing_id: bytes
    credential: bytes
    """User or key of the peer, which it cannot choose; with neither, the routing id's start."""

    @property
    def name(self) -> tuple[bytes, bytes]:
        """Part of the routing id, and credential, that stay the same when the peer reconnects."""
        return self.routing_id[:NAME_BYTES], self.credential


class Report(NamedTuple):
    """Outcome of a lift, as a peer reports it."""

    grasp: GraspId
    outcome: str
    """`stable`, `slip` or `not-lifted`."""
    object_name: str | None = None
    """Name of the lifted object; None: not told."""
    peer: Peer | None = None
    """Peer that reports; None: the daemon itself, when it replays a recording."""


class OutcomeStatus(StrEnum):
    """Result of reporting an outcome."""

    TAKEN = "taken"
    REPEATED = "repeated"
    """The same outcome is known already; the report is ignored."""
    CONTRADICTS = "contradicts"
    """The opposite outcome is known already and stays; the report is refused."""
    UNKNOWN = "unknown"
    """The grasp was not judged or is too old; the outcome is refused."""


class Lift(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One judged grasp."""

    id: GraspId
    stable: bool
    """True if the grasp was called `stable`."""
    features: bytes | None
    """Features of the grasp, float64; `NOT_ASSESSED`: it had none.

    None: the learner must not learn from it, because its outcome is known, or a sensor was
    exchanged since.
    """
    slipped: bool | None = None
    """Outcome: True for a slip. None: not known yet."""
    announced: bool = False
    """True if a `lift` question was answered yes for this `stable` grasp, and not taken back."""
    owner: Peer | None = None
    """First peer that was answered that it may lift the grasp; None: no peer, or taken back."""

    @property
    def is_outstanding(self) -> bool:
        """True if the grasp was called `stable` and its outcome can still come."""
        return self.stable and self.slipped is None

    @property
    def is_awaited(self) -> bool:
        """True if the lift was announced and has no outcome yet."""
        return self.announced and self.slipped is None


class LiftBookState(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """State of the book that is kept between two starts of the daemon."""

    records: Annotated[tuple[Lift, ...], msgspec.Meta(max_length=LIFTS_MAX)]
    """Oldest first."""
    told: dict[OutcomeStatus, Annotated[int, msgspec.Meta(ge=0)]]
    unreported: Annotated[int, msgspec.Meta(ge=0)]
    announced: Annotated[int, msgspec.Meta(ge=0)]


class LiftBook:
    """The last `LIFTS_MAX` judged grasps, and who may report how their lifts ended.

    The first peer that was answered that it may lift a grasp owns it and reports its outcome. The
    last such peer also reports for owners that have its credential, as these may have ended.
    """

    def __init__(self) -> None:
        """Start empty."""
        self._lifts: dict[GraspId, Lift] = {}
        """Oldest first."""
        self.lifter: Peer | None = None
        """Last peer that was answered that it may lift a grasp; None: none since the start."""
        self.on_announced: Callable[[GraspId, bool], None] = lambda _grasp, _announced: None
        """Called with True after `announce` changed anything of a grasp, with False after its
        announcement was taken back. A recording has these calls, so its replay learns the same."""
        self._judged: tuple[GraspId, bytes] | None = None
        """Grasp noted last, and the features that an offer takes: of its last judgement after
        settling, or of a later first `stable` verdict. None: none since a start or exchange."""
        self._offered: GraspId | None = None
        """Newest grasp at the last `announce`; None: no grasp since the start."""
        self._unkept: set[GraspId] = set()
        """Grasps whose outcome was accepted and is not on the disk yet."""
        self.told: Counter[OutcomeStatus] = Counter()
        """Number of reported outcomes by their status."""
        self.unreported = 0
        """Number of grasps called `stable` that left the book before an outcome came."""
        self.outstanding = 0
        """Number of grasps called `stable` whose outcome can still come."""
        self.announced = 0
        """Number of lifts that were announced and not taken back."""
        self.awaited = 0
        """Number of announced lifts without an outcome."""

    def __contains__(self, grasp: object) -> bool:
        """True if the grasp was judged and is in the book."""
        return grasp in self._lifts

    def is_told(self, grasp: GraspId) -> bool:
        """True if the outcome of the grasp is known."""
        lift = self._lifts.get(grasp)
        return lift is not None and lift.slipped is not None

    def is_stable(self, grasp: GraspId) -> bool:
        """True if the grasp was called `stable`."""
        lift = self._lifts.get(grasp)
        return lift is not None and lift.stable

    def awaited_besides(self, grasp: GraspId) -> int:
        """Return the number of announced lifts without an outcome, of other grasps than this."""
        lift = self._lifts.get(grasp)
        return self.awaited - (lift is not None and lift.is_awaited)

    def note(self, grasp: GraspId, features: bytes, *, stable: bool, judged: bool = False) -> bool:
        """Enter how a grasp was judged, and by which features (float64). `judged`: as in `Moment`.

        The outcome teaches the features at the last offer (`announce`). Without an offer the daemon
        does not know when the lift began. Then those of the first `stable` verdict count: who does
        not ask lifts on that one, and later ones may be of an object in the air. If there is none,
        those of the last judgement after settling count: the hand may have pressed harder before.
        A grasp that was not assessed is entered again once it is. Nothing changes after the outcome
        is known. Return True if an announced lift left the book without an outcome.
        """
        lift = self._lifts.get(grasp)
        if judged and features != NOT_ASSESSED:
            self._judged = grasp, features
        if lift is not None:
            first_stable = stable and not lift.stable
            first_assessed = lift.features == NOT_ASSESSED != features
            again = judged and not lift.stable and bool(lift.features and features)
            if lift.slipped is not None or not (first_stable or first_assessed or again):
                return False
            stable = stable or lift.stable
        self._judged = grasp, features
        if lift is not None and lift.features and grasp == self._offered:
            features = lift.features
        former = lift or Lift(grasp, stable, features)
        self._lifts[grasp] = replace(former, stable=stable, features=features)
        is_counted, is_abandoned = stable, False
        if len(self._lifts) > LIFTS_MAX:
            oldest = self._lifts.pop(next(iter(self._lifts)))
            self._unkept.discard(oldest.id)
            self.unreported += oldest.is_outstanding
            is_counted |= oldest.is_outstanding
            is_abandoned = oldest.is_awaited
        if is_counted:
            self._count()
        return is_abandoned

    def claim(self, grasp: GraspId, peer: Peer) -> bool:
        """Let a peer lift a grasp, and own it unless a peer with its credential does. Return False
        if another credential owns it, its outcome is known, or it is not in the book."""
        lift = self._lifts.get(grasp)
        if lift is None or lift.slipped is not None:
            return False
        if lift.owner is not None and lift.owner.credential != peer.credential:
            return False
        if lift.owner is None:
            self._lifts[grasp] = replace(lift, owner=peer)
        self.lifter = peer
        return True

    def announce(self) -> None:
        """Note that a `lift` question about the newest grasp was answered yes.

        Its outcome teaches the last judgement after settling, or a later first `stable` verdict:
        the hand may have pressed harder since. It counts as announced, once, if it was ever called
        `stable`. Nothing changes if its outcome is known.
        """
        lift = next(reversed(self._lifts.values()), None)
        if lift is None or lift.slipped is not None:
            return
        features = lift.features
        if features is not None and self._judged is not None and self._judged[0] == lift.id:
            features = self._judged[1]
        is_known = lift.id == self._offered and lift.stable == lift.announced
        if is_known and features == lift.features:
            return
        self._offered = lift.id
        self._lifts[lift.id] = replace(lift, features=features, announced=lift.stable)
        if not lift.announced and lift.stable:
            self.announced += 1
            self._count()
        self.on_announced(lift.id, True)

    def take_back(self, grasp: GraspId | None) -> bool:
        """Note that no lift of a grasp follows, and remove its owner. None: the newest announced
        grasp without outcome.

        Return False, and change nothing, if its outcome is known or there is no such grasp here.
        """
        awaited = (lift for lift in reversed(self._lifts.values()) if lift.is_awaited)
        lift = next(awaited, None) if grasp is None else self._lifts.get(grasp)
        if lift is None or lift.slipped is not None:
            return False
        self._lifts[lift.id] = replace(lift, announced=False, owner=None)
        if lift.announced:
            self.announced -= 1
            self._count()
            self.on_announced(lift.id, False)
        return True

    def offered(self, peer: Peer) -> GraspId | None:
        """Return the newest grasp without outcome that this connection owns, or None."""
        for lift in reversed(self._lifts.values()):
            if lift.owner == peer and lift.slipped is None:
                return lift.id
        return None

    def withdraw(self) -> None:
        """Mark all lifts as not announced, as another risk is set, which counts from the start."""
        self._lifts = {grasp: replace(lift, announced=False) for grasp, lift in self._lifts.items()}
        self.announced = 0
        self._count()

    def owns(self, grasp: GraspId, peer: Peer) -> bool:
        """Return True if this peer, on any of its connections, owns the grasp."""
        lift = self._lifts.get(grasp)
        return lift is not None and lift.owner is not None and lift.owner.name == peer.name

    def may_report(self, grasp: GraspId, peer: Peer | None) -> bool:
        """Return True if this peer may report the outcome: the grasp's owner, or None (the daemon).

        The last peer that could lift may also report for other owners with its credential, and for
        grasps without an owner; any peer may for a grasp that is not in the book.
        """
        lift = self._lifts.get(grasp)
        if peer is None or lift is None or self.owns(grasp, peer):
            return True
        is_heir = lift.owner is None or lift.owner.credential == peer.credential
        return is_heir and self.lifter is not None and self.lifter.name == peer.name

    def tell(self, grasp: GraspId, *, slipped: bool) -> tuple[OutcomeStatus, Lift | None]:
        """Enter an outcome; return its status, and the lift as it was before (None: not in the
        book)."""
        lift = self._lifts.get(grasp)
        if lift is None:
            status = OutcomeStatus.UNKNOWN
        elif lift.slipped is None:
            status = OutcomeStatus.TAKEN
            self._lifts[grasp] = replace(lift, features=None, slipped=slipped)
            self._unkept.add(grasp)
            if lift.is_outstanding:
                self._count()
        elif lift.slipped == slipped:
            status = OutcomeStatus.REPEATED
        else:
            status = OutcomeStatus.CONTRADICTS
        self.told[status] += 1
        return status, lift

    def is_kept(self, grasp: GraspId) -> bool:
        """Return False if an outcome of the grasp was accepted and is not on the disk yet."""
        return grasp not in self._unkept

    def keep(self, grasp: GraspId) -> None:
        """Note that the outcome of the grasp is on the disk, or that no disk is used."""
        self._unkept.discard(grasp)

    def exchanged(self) -> None:
        """Note that a sensor was exchanged: outcomes of the lifts until now teach nothing more."""
        self._lifts = {grasp: replace(lift, features=None) for grasp, lift in self._lifts.items()}
        self._judged = None

    def state(self) -> LiftBookState:
        """Return what `restore` needs."""
        lifts, told = tuple(self._lifts.values()), dict(self.told)
        return LiftBookState(lifts, told, self.unreported, self.announced)

    def restore(self, state: LiftBookState, width: int) -> None:
        """Continue from an earlier state, of `width` features per grasp. Raises `ValueError`."""
        lifts = {lift.id: lift for lift in state.records}
        if len(lifts) != len(state.records):
            raise ValueError("holds a grasp twice")
        for lift in state.records:
            if lift.features:
                vector(lift.features, width, INPUT_MAX)
            if lift.features is not None and lift.slipped is not None:
                raise ValueError("would learn from a grasp twice")
        self._lifts = lifts
        self._judged = self._offered = None
        self._unkept.clear()
        self.told = Counter(state.told)
        self.unreported, self.announced = state.unreported, state.announced
        self._count()

    def _count(self) -> None:
        self.outstanding = sum(lift.is_outstanding for lift in self._lifts.values())
        self.awaited = sum(lift.is_awaited for lift in self._lifts.values())
