"""Tools for tests of the bridge's firmware: its programs, and sound and damaged frames.

Frames are computed with `zlib`, `cobs` and `struct` alone, so that they owe nothing to the driver.
"""

from __future__ import annotations

import random
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from cobs import cobs
from numpy.typing import NDArray

from tests.conftest import ROOT
from tests.kit.programs import ran

BRIDGE = ROOT / "deploy" / "bridge"
WARNINGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wconversion", "-g", "-O1")
SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
POSIX = "-D_XOPEN_SOURCE=700"

HELLO, SWEEP, STATUS, PING, START, STOP = 0x01, 0x02, 0x03, 0x81, 0x82, 0x83
DIGEST = 0x0D99E4D6
UNSEEDED = (HELLO, PING)
HOST_PAYLOADS = {PING: 4, START: 0, STOP: 0}
ENCODED_MAX = 1024
ELECTRODE_COMMANDS = bytes.fromhex(
    "A2 A4 A7 A8 AB AD AE B0 B3 B5 B6 B9 BA BC BF C1 C2 C4 C7 C8 CB CD CE D0"
)
"""First command bytes of E1..E24 (manual table 7)."""
PAC, PDC, TAC, TDC = 0x80, 0x83, 0x85, 0x86

Counts = NDArray[np.uint16]


def build_program(folder: Path, name: str, *sources: str) -> Path:
    """Compile the program `name` of `sources`, files under `deploy/bridge`, with sanitizers.

    Warnings are errors.
    """
    program = folder / name
    files = [file for source in sources for file in sorted(BRIDGE.glob(source))]
    includes = [f"-I{BRIDGE}/src", f"-I{BRIDGE}/host"]
    done = ran("cc", *WARNINGS, *SANITIZERS, POSIX, *includes, *files, "-o", program)
    assert done.returncode == 0, done.stderr
    return program


def ask(probe: Path, requests: Sequence[str]) -> list[str]:
    """The answers of the C implementation, one per request."""
    done = ran(probe, typed="\n".join(requests) + "\n")
    assert done.returncode == 0, done.stderr
    answers = done.stdout.splitlines()
    assert len(answers) == len(requests)
    return answers


def frame(kind: int, payload: bytes = b"", digest: int = DIGEST) -> bytes:
    """A frame with its zero, computed with zlib and cobs alone."""
    body = bytes([kind]) + payload
    crc = zlib.crc32(body, 0 if kind in UNSEEDED else digest)
    encoded: bytes = cobs.encode(body + struct.pack("<I", crc))
    return encoded + b"\0"


def unframe(encoded: bytes) -> tuple[int, bytes] | None:
    """Type and payload of an encoded frame without its zero, or None if it is damaged."""
    if len(encoded) > ENCODED_MAX:
        return None
    try:
        body = cobs.decode(encoded)
    except cobs.DecodeError:
        return None
    if len(body) < 5:
        return None
    seed = 0 if body[0] in UNSEEDED else DIGEST
    if zlib.crc32(body[:-4], seed) != int.from_bytes(body[-4:], "little"):
        return None
    return body[0], body[1:-4]


def judged(stream: bytes) -> tuple[list[str], int]:
    """The sound frames of a host in a stream, as the probe prints them, and the number of other
    pieces between zeros."""
    found, errors = [], 0
    for encoded in stream.split(b"\0")[:-1]:
        if not encoded:
            continue
        one = unframe(encoded)
        if one is None or len(one[1]) != HOST_PAYLOADS.get(one[0]):
            errors += 1
        else:
            found.append(f"{one[0]:02x} {int.from_bytes(one[1], 'little')}")
    return found, errors


def damaged(rng: random.Random) -> bytes:
    """A frame of a host, spoilt in one of seven ways, with its zero."""
    kind = rng.choice((PING, START, STOP, rng.randrange(256)))
    size = HOST_PAYLOADS.get(kind, rng.randrange(8))
    whole = bytearray(frame(kind, rng.randbytes(size), rng.choice((DIGEST, DIGEST, 0))))
    match rng.randrange(7):
        case 0:
            whole[rng.randrange(len(whole))] ^= 1 << rng.randrange(8)
        case 1:
            del whole[rng.randrange(len(whole))]
        case 2:
            whole.insert(rng.randrange(len(whole)), rng.randrange(256))
        case 3:
            del whole[rng.randrange(len(whole)) : -1]
        case 4:
            whole[:] = rng.randbytes(rng.randrange(1, 40)) + b"\0"
        case 5:
            whole[:] = bytes(rng.randrange(1, 256) for _ in range(rng.choice((32, 33, 1025))))
        case _:
            whole[:] = frame(kind, rng.randbytes(size + rng.choice((-1, 1, 30)) % 40))
    return bytes(whole)


def words_of(sweep: bytes) -> Counts:
    """Response words of a SWEEP as sent, with parity bits, shape (slots, sensors)."""
    sensors, slots = sweep[21], sweep[22]
    return np.frombuffer(sweep, ">u2", offset=23).reshape(slots, sensors).astype(np.uint16)


def counts_of(sweep: bytes) -> Counts:
    """Counts of an electrodes-only SWEEP, shape (sensors, 24), as the C library decodes them."""
    words = words_of(sweep).T
    return ((words >> 9) * 32 + ((words & 0xFF) >> 3)).astype(np.uint16)


def pattern(row: int, sensors: int = 3) -> Counts:
    sensor, electrode = np.ogrid[:sensors, :24]
    counts: Counts = ((1000 + 7 * row + 811 * sensor + 131 * electrode) % 4096).astype(np.uint16)
    return counts


def seq_of(sweep: bytes) -> int:
    return int.from_bytes(sweep[:4], "little")
