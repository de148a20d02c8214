"""A finding of the doctor: how bad it is, its cause, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple


class Level(StrEnum):
    """How bad a finding is."""

    OK = "ok"
    WARNING = "warning"
    ERROR = "error"


class Cause(StrEnum):
    """Cause of a fault, in the order in which to act on them.

    Programs may rely on these names; deploy/CONNECT.md lists them.
    """

    PORT_MISSING = "port-missing"
    PORT_DENIED = "port-denied"
    PORT_HELD = "port-held"
    INTERFACE_MISSING = "interface-missing"
    INTERFACE_DOWN = "interface-down"
    ADDRESS = "address"
    """The address to listen on is not one of this computer."""
    SILENT = "silent"
    LINK_LOST = "link-lost"
    LINK_DOWN = "link-down"
    """The link is down for another reason, which the finding quotes."""
    NOT_A_BRIDGE = "not-a-bridge"
    """Another device answers, or a bridge with another baud rate."""
    BITRATE = "bitrate"
    BUS_ERRORS = "bus-errors"
    VERSION = "protocol-version"
    FIRMWARE_OLD = "firmware-old"
    SETTINGS = "settings"
    """Settings of scene and board differ."""
    FOREIGN_SENDER = "foreign-sender"
    DAMAGED = "damaged-bytes"
    FRAMES_LOST = "frames-lost"
    OUT_OF_ORDER = "out-of-order"
    RESTARTED = "restarted"
    """The board started again."""
    COMPUTER_BUSY = "computer-busy"
    SLOW = "slow"
    CLOCK = "clock"
    REPEATED = "repeated"
    """Old data was sent again."""
    PALM_MODE = "palm-mode"
    MESSAGES = "messages"
    """JSON messages are not as their page says."""
    RECORDING = "recording"
    SENSOR_ABSENT = "sensor-absent"
    SENSOR_TWICE = "sensor-twice"
    SENSOR_WORDS = "sensor-words"
    """Words between a sensor and its board are damaged."""
    ELECTRODE_DEAD = "electrode-dead"
    ELECTRODE_FROZEN = "electrode-frozen"
    ELECTRODE_RESTLESS = "electrode-restless"
    ELECTRODE_RAIL = "electrode-rail"
    ELECTRODE_UNREAD = "electrode-unread"
    KEYS = "keys"
    MODEL_MISSING = "model-missing"
    MODEL_MISFIT = "model-misfit"
    SOCKET_FOLDER = "socket-folder"
    SOCKET_DENIED = "socket-denied"
    SOCKET_HELD = "socket-held"
    SOCKET_GROUP = "socket-group"
    SOCKET_USER = "socket-user"
    FOLDER = "folder"
    """The session or the recordings cannot be written."""
    REALTIME = "realtime"


_LOSS = frozenset({Cause.FRAMES_LOST, Cause.SLOW, Cause.ELECTRODE_UNREAD, Cause.SILENT})
_NOISE = frozenset({Cause.SENSOR_WORDS, Cause.REPEATED, Cause.ELECTRODE_RESTLESS})
EXPLAINS: dict[Cause | None, frozenset[Cause]] = {
    Cause.PORT_HELD: _LOSS
    | _NOISE
    | {Cause.LINK_LOST, Cause.DAMAGED, Cause.CLOCK, Cause.RESTARTED},
    Cause.LINK_LOST: _LOSS | {Cause.DAMAGED, Cause.MESSAGES, Cause.REPEATED, Cause.RESTARTED},
    Cause.DAMAGED: _LOSS | _NOISE | {Cause.CLOCK, Cause.RESTARTED},
    Cause.BUS_ERRORS: _LOSS | {Cause.LINK_LOST},
    Cause.COMPUTER_BUSY: _LOSS | {Cause.CLOCK, Cause.OUT_OF_ORDER, Cause.RESTARTED},
    Cause.SENSOR_WORDS: frozenset({Cause.RESTARTED, Cause.ELECTRODE_UNREAD}),
    Cause.CLOCK: _LOSS | {Cause.LINK_LOST, Cause.REPEATED, Cause.RESTARTED},
    Cause.OUT_OF_ORDER: _LOSS | {Cause.RESTARTED},
    Cause.REPEATED: _LOSS | {Cause.RESTARTED},
    Cause.RESTARTED: _LOSS,
    Cause.SETTINGS: _LOSS,
    Cause.PALM_MODE: _LOSS,
    Cause.MESSAGES: frozenset({Cause.FRAMES_LOST, Cause.RESTARTED, Cause.SENSOR_WORDS}),
    Cause.FRAMES_LOST: _LOSS - {Cause.FRAMES_LOST},
}
"""Consequences of each cause. They are not reported beside it."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of an examination. Level `OK` has no cause and no advice, other levels have both."""

    level: Level
    what: str
    cause: Cause | None = None
    advice: str | None = None


class Trouble(NamedTuple):
    """Cause, advice and level that all findings on one fault share."""

    cause: Cause
    advice: str
    level: Level = Level.WARNING

    def finding(self, what: str) -> Finding:
        """Return a finding with this cause and advice; `what`: text on what was seen."""
        return Finding(self.level, what, self.cause, self.advice)


def fine(what: str) -> Finding:
    """Return a finding that needs nothing done."""
    return Finding(Level.OK, what)


def roots(findings: Iterable[Finding]) -> list[Finding]:
    """Drop findings that another cause explains, and put the others in the order of `Cause`.

    A cause gets the worst level of the findings that it explains.
    """
    findings = list(findings)
    causes = {finding.cause for finding in findings}
    follows = {effect for cause in causes for effect in EXPLAINS.get(cause, ())}
    errors = {finding.cause for finding in findings if finding.level is Level.ERROR}
    kept = [
        replace(finding, level=Level.ERROR)
        if errors & EXPLAINS.get(finding.cause, frozenset())
        else finding
        for finding in findings
        if finding.cause not in follows
    ]
    order = [None, *Cause]
    return sorted(kept, key=lambda finding: order.index(finding.cause))
