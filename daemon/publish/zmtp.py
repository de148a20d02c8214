"""ZMTP 3 with the NULL mechanism (RFC 23, RFC 37), as a listening socket speaks it: bytes to
messages and back, without a socket."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import Enum
from typing import Final

SIGNATURE_BYTES: Final = 10
GREETING_BYTES: Final = 64
GREETING: Final = (
    b"\xff" + bytes(8) + b"\x7f"  # signature
    b"\x03\x01"  # version
    + b"NULL".ljust(20, b"\0")  # mechanism
    + bytes(32)  # as-server and filler
)
MORE, LONG, COMMAND = 1, 2, 4
"""Flags of a frame: another follows, its size has 8 bytes, it is a command."""
FRAME_MAX_BYTES = 128
"""The longest outcome; a topic has 40 bytes."""
FRAMES_MAX = 4
"""Of a message: a question has two from a REQ socket."""
READY_MAX_BYTES = 512
"""The command by which a handshake ends names a socket type and an identity of 255 bytes."""
PING_CONTEXT_MAX_BYTES = 16
"""What a PING wants to have repeated (RFC 37)."""
SUBSCRIBE, CANCEL = b"\x01", b"\x00"
"""How a message begins that subscribes to a topic, or does so no more (ZMTP 3.0)."""

_LONG_HEAD = struct.Struct(">BQ")

Message = list[bytes]


class Role(Enum):
    """What a listening socket is, and the types of sockets that may connect."""

    XPUB = frozenset({b"SUB", b"XSUB"})
    ROUTER = frozenset({b"REQ", b"DEALER", b"ROUTER"})


class ZmtpError(Exception):
    """A peer broke a rule: cut it off."""


def frame(body: bytes, flags: int = 0) -> bytes:
    """One frame."""
    size = len(body)
    if size > 255:
        return _LONG_HEAD.pack(flags | LONG, size) + body
    return bytes((flags, size)) + body


def command(name: bytes, body: bytes = b"") -> bytes:
    """One command."""
    return frame(bytes((len(name),)) + name + body, COMMAND)


def message(frames: Sequence[bytes]) -> bytes:
    """A message of some frames."""
    *begun, last = frames
    whole = b""
    for body in begun:
        whole += frame(body, MORE)
    return whole + frame(last)


def ready(role: Role) -> bytes:
    """The command that ends the handshake."""
    return command(b"READY", _named(b"Socket-Type", role.name.encode()))


def _named(name: bytes, value: bytes) -> bytes:
    return bytes((len(name),)) + name + len(value).to_bytes(4, "big") + value


class Parser:
    """Parses what one peer sends; holds one frame and one message at most."""

    def __init__(self, role: Role) -> None:
        """`role` is what the peer has connected to."""
        self.is_ready = False
        """Whether the handshake has ended well."""
        self._role = role
        self._greeted = False
        self._held = bytearray()
        self._frames: Message = []

    def take(self, data: bytes, messages: list[Message]) -> bytes:
        """Append messages that are whole with `data`; what to send in return.

        Commands that subscribe become messages that do. Raises `ZmtpError`.
        """
        self._held += data
        if not self._greeted:
            self._greet()
        answers = b""
        while self._greeted and (found := self._next_frame()) is not None:
            flags, body = found
            if flags & COMMAND or not self.is_ready:
                answers += self._obey(flags, body, messages)
                continue
            self._frames.append(body)
            if not flags & MORE:
                messages.append(self._frames)
                self._frames = []
            elif len(self._frames) >= FRAMES_MAX:
                raise ZmtpError("too many frames")
        return answers

    def _greet(self) -> None:
        held = self._held
        if held[0] != GREETING[0] or (len(held) >= SIGNATURE_BYTES and held[9] != GREETING[9]):
            raise ZmtpError("no ZMTP")
        if len(held) > SIGNATURE_BYTES and held[SIGNATURE_BYTES] < 3:
            raise ZmtpError("an older ZMTP")
        if len(held) < GREETING_BYTES:
            return
        if held[12:32] != GREETING[12:32]:
            raise ZmtpError("another mechanism")
        del held[:GREETING_BYTES]
        self._greeted = True

    def _next_frame(self) -> tuple[int, bytes] | None:
        held = self._held
        if len(held) < 2:
            return None
        flags, size, head = held[0], held[1], 2
        if flags > (MORE | LONG | COMMAND) or flags & (MORE | COMMAND) == MORE | COMMAND:
            raise ZmtpError("no such flags")
        if flags & LONG:
            if len(held) < 9:
                return None
            size, head = int.from_bytes(held[1:9], "big"), 9
        if size > (FRAME_MAX_BYTES if self.is_ready else READY_MAX_BYTES):
            raise ZmtpError("too long a frame")
        if len(held) < head + size:
            return None
        body = bytes(held[head : head + size])
        del held[: head + size]
        return flags, body

    def _obey(self, flags: int, body: bytes, messages: list[Message]) -> bytes:
        """Do what a command says; what to answer."""
        size = body[0] + 1 if body else 0
        name, rest = body[1:size], body[size:]
        if not self.is_ready:
            if not flags & COMMAND or name != b"READY":
                raise ZmtpError("no READY")
            if _properties(rest).get(b"socket-type") not in self._role.value:
                raise ZmtpError("another type of socket")
            self.is_ready = True
            return ready(self._role)
        if name == b"SUBSCRIBE":
            messages.append([SUBSCRIBE + rest])
        elif name == b"CANCEL":
            messages.append([CANCEL + rest])
        elif name == b"PING":
            return command(b"PONG", rest[2 : 2 + PING_CONTEXT_MAX_BYTES])
        return b""


def _properties(text: bytes) -> dict[bytes, bytes]:
    """What a READY tells, by names in small letters. Raises `ZmtpError`."""
    found = {}
    while text:
        name_end = 1 + text[0]
        value_at = name_end + 4
        value_end = value_at + int.from_bytes(text[name_end:value_at], "big")
        if len(text) < max(value_at, value_end):
            raise ZmtpError("no READY")
        found[text[1:name_end].lower()] = text[value_at:value_end]
        text = text[value_end:]
    return found
