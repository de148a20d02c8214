"""The states of the gate, and all ways from one to another."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from graspd.daemon.judge.reasons import GateCause as Cause
from graspd.daemon.judge.reasons import GateChange, GateState

IDLE, CLOSING, SETTLED, JUDGED, RELEASED = GateState


class Transition(NamedTuple):
    """A transition from any of several states to another."""

    states: tuple[GateState, ...]
    """States from which it starts."""
    when: str
    """Event that makes the gate take it."""
    to: GateState
    cause: Cause


TOUCHED = Transition((IDLE, RELEASED), "a finger touches", CLOSING, Cause.CONTACT)
STILL = Transition((CLOSING,), "all fingers touch and have kept still", SETTLED, Cause.STILL)
ANSWERED = Transition((SETTLED,), "it is judged", JUDGED, Cause.JUDGED)
SURE = Transition((JUDGED,), "judged `early`, and now nothing slides", SETTLED, Cause.STILL)
MOVED = Transition((SETTLED, JUDGED), "it moves; judged: for 480 ms", CLOSING, Cause.MOVED)
CHANGED = Transition((JUDGED,), "a finger reads 40 counts more or less", CLOSING, Cause.CHANGED)
LET_GO = Transition((SETTLED, JUDGED), "some finger lets go", CLOSING, Cause.CONTACT_LOST)
GAP = Transition((SETTLED, JUDGED), "readings are missing", CLOSING, Cause.GAP)
OPENED = Transition((CLOSING, SETTLED, JUDGED), "nothing touches", RELEASED, Cause.CONTACT_LOST)
FORGOTTEN = Transition((RELEASED,), "nothing touches for 100 ms", IDLE, Cause.TIME)
TRANSITIONS = TOUCHED, STILL, ANSWERED, SURE, MOVED, CHANGED, LET_GO, GAP, OPENED, FORGOTTEN
"""All transitions, in the order of deploy/wire/README.md."""


class Phase:
    """State of the gate, number of the grasp, and changes that no `Moment` has reported yet."""

    def __init__(self) -> None:
        self.state = IDLE
        self.grasp = 0
        """Number of the current grasp; each first touch adds one."""
        self.changes: list[GateChange] = []
        """Changes since the last `Moment`: at most three by a reading, and one by a restart."""

    def take(self, way: Transition, t_ns: int) -> bool:
        """Take a transition at a reading of `t_ns`; False: it does not start from this state."""
        former = self.state
        if former not in way.states:
            return False
        self.state = way.to
        self.changes.append(GateChange(t_ns, self.grasp, former, way.to, way.cause))
        return True


def lines() -> Iterator[str]:
    """Yield the transitions as a list of Markdown, for deploy/wire/README.md."""
    for states, when, to, cause in TRANSITIONS:
        yield f"- {', '.join(f'`{state}`' for state in states)} to `{to}`, `{cause}`: {when}"
