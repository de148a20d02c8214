"""One peer without keys: what it subscribes to, what waits for it, for whom it may speak."""

from __future__ import annotations

import os
import select
import socket
import struct
from collections import deque
from collections.abc import Sequence
from typing import Final

from daemon.publish.zmtp import CANCEL, SUBSCRIBE, Message, Parser, Role, ZmtpError

SUBSCRIPTIONS_MAX: Final = 64
"""Topics of one peer; the daemon has five."""
SHARE_BYTES: Final = 4096
"""Taken of one peer before it has to wait for its next share; 580 questions."""
_CREDENTIALS = struct.Struct("3i")
"""Process, user and group (unix(7), SO_PEERCRED)."""


class PlainPeer:
    """One connection."""

    def __init__(self, connection: socket.socket, role: Role, now_ns: int) -> None:
        """Of a listening socket in this `role`, accepted now."""
        self.socket: socket.socket | None = connection
        self.parser = Parser(role)
        self.since_ns = now_ns
        self.subscriptions: set[bytes] = set()
        self.queue: deque[bytes] = deque()
        """What the kernel has not taken yet."""
        self.share = SHARE_BYTES
        """Bytes that are still taken before the others are heard again."""
        self.events: int = select.EPOLLIN
        self.process, self.user = 0, -1
        """As the kernel tells for Unix sockets; not known over TCP."""
        if connection.family == socket.AF_UNIX:
            asked = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
            self.process, self.user, _ = _CREDENTIALS.unpack(asked)

    @property
    def is_open(self) -> bool:
        """Whether it may still be connected."""
        return self.socket is not None

    def stands_for(self, former: object) -> bool:
        """Whether it is the same connection, or that has gone and this is of the same process, or
        of the same user once that process has ended. TCP does not tell who that is: anybody."""
        if self is former or not isinstance(former, PlainPeer):
            return self is former
        if former.is_open or self.user != former.user:
            return False
        return self.process == former.process or not _runs(former.process)

    def may_follow(self, former: object) -> bool:
        """Whether it is of the same process, and stands for the other once that has gone."""
        return isinstance(former, PlainPeer) and self.process == former.process

    def subscribe(self, messages: Sequence[Message]) -> bool:
        """Take in what subscribes; whether that changes anything. Raises `ZmtpError` for a topic
        too many."""
        changed = False
        for asked, *_ in messages:
            known = asked[1:] in self.subscriptions
            if asked[:1] == CANCEL and known:
                self.subscriptions.discard(asked[1:])
                changed = True
            elif asked[:1] == SUBSCRIBE and not known:
                self.subscriptions.add(asked[1:])
                changed = True
        if len(self.subscriptions) > SUBSCRIPTIONS_MAX:
            raise ZmtpError("too many subscriptions")
        return changed


def _runs(process: int) -> bool:
    """Whether there is such a process; of 0 the kernel does not tell which it is."""
    try:
        if process > 0:
            os.kill(process, 0)
    except PermissionError:
        return True
    except ProcessLookupError:
        return False
    return process > 0
