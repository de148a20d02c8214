"""The serial bridge's frames as a target of `tests.bench.fuzz`."""

from __future__ import annotations

import random

import numpy as np

from graspd.drivers.spi.messages import (
    DELIMITER,
    DIGEST,
    ENCODED_MAX_BYTES,
    UNSEEDED,
    BridgeStatus,
    FrameParser,
    Hello,
    Message,
    Ping,
    Start,
    Stop,
    Sweep,
    encode_frame,
)
from tests.bench.fuzz import Target

Value = tuple[int, bytes]


def _message(rng: random.Random) -> Message:
    kind = rng.randrange(8)
    if kind < 4:
        return _sweep(rng)
    if kind == 4:
        return _hello(rng)
    if kind == 5:
        errors = tuple(rng.getrandbits(8) for _ in range(rng.randint(1, 5)))
        return BridgeStatus(
            rng.getrandbits(40), rng.getrandbits(32), 1, 2, rng.getrandbits(8), errors
        )
    host: list[Message] = [Ping(rng.getrandbits(32)), Start(), Stop()]
    return rng.choice(host)


def _sweep(rng: random.Random) -> Sweep:
    slots, sensors = rng.choice([(24, 3), (54, 3), (2, 1), (64, 5)])
    words = np.frombuffer(rng.randbytes(2 * slots * sensors), np.uint16).reshape(slots, sensors)
    tick = rng.getrandbits(40)
    return Sweep(rng.getrandbits(32), tick, tick + 1900, rng.getrandbits(sensors), words)


def _hello(rng: random.Random) -> Hello:
    serials = tuple(rng.choice(["BTSP-0001", ""]) for _ in range(rng.randint(1, 5)))
    commands = bytes(rng.choice(b"\x80\x83\xa2\xd0") for _ in range(rng.randint(1, 64)))
    return Hello(
        rng.getrandbits(32), rng.getrandbits(40), 1_000_000, 10_000, serials, tuple(commands)
    )


def _frame(rng: random.Random) -> tuple[bytes, Value]:
    """Half of them real messages, half of any type and length, full of zeros and ones."""
    if rng.random() < 0.5:
        message = _message(rng)
        kind, payload = message.TYPE, message.to_bytes()
    else:
        kind = rng.getrandbits(8)
        length = rng.choice([0, 1, 8, 249, 250, 254, rng.randrange(300)])
        payload = rng.choice([bytes(length), b"\xff" * length, rng.randbytes(length)])
    return encode_frame(kind, payload, 0 if kind in UNSEEDED else DIGEST), (kind, payload)


FRAMING = Target(
    name="framing",
    frame=_frame,
    parser=lambda: FrameParser(DIGEST),
    held_max=ENCODED_MAX_BYTES,
    delimiter=DELIMITER,
)
