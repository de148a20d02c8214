"""Damaged CAN frames among good ones."""

from __future__ import annotations

import random

from graspd.drivers.base import TactileReading
from graspd.drivers.can.decoders import CanDecoder, make_decoder
from graspd.drivers.can.formats import CanFormat, SweepFrame
from graspd.drivers.can.frames import ERROR, FD, REMOTE, CanFrame, unpack_frame
from graspd.drivers.can.readings import CanCounters
from tests.drivers.can.can_standin import sweep_of_frames
from tests.drivers.can.can_words import pack_frame, truth, word
from tests.kit.clock import Clock

SAMPLE_ID = 0x100


def decoder(
    frame_format: CanFormat, arbitration_id: int | None = SAMPLE_ID, **options: int
) -> tuple[CanDecoder, CanCounters]:
    counters = CanCounters()
    made = make_decoder(
        ("ff", "mf", "th"),
        counters,
        format=frame_format,
        arbitration_id=arbitration_id,
        sequence="electrodes",
        data_length=options.get("data_length"),
    )
    return made, counters


def sweep_frames(frame_format: CanFormat, sweep: int) -> list[CanFrame]:
    """Undamaged frames of one sweep."""
    if frame_format is CanFormat.SYNTOUCH:
        return sweep_of_frames(sweep)
    return [
        CanFrame(
            SAMPLE_ID + finger,
            SweepFrame(
                finger,
                sweep % (1 << 16),
                10_000 * sweep,
                b"".join(word(int(count)) for count in truth(sweep)[row]),
            ).to_bytes(),
            FD,
        )
        for row, finger in enumerate((0, 1, 4))
    ]


def damaged(raw: bytes, chance: random.Random) -> bytes:
    """The record of a frame, broken in one of the ways that adapters and memory break them."""
    kind = chance.randrange(6)
    spoiled = bytearray(raw)
    if kind == 0:
        spoiled[chance.randrange(len(raw))] ^= 1 << chance.randrange(8)
    elif kind == 1:
        for _ in range(chance.randrange(2, 9)):
            spoiled[chance.randrange(len(raw))] = chance.randrange(256)
    elif kind == 2:
        del spoiled[chance.randrange(len(raw)) :]
    elif kind == 3:
        spoiled += chance.randbytes(chance.randrange(1, 80))
    elif kind == 4:
        spoiled = bytearray(chance.randbytes(len(raw)))
    else:
        spoiled[8:] = chance.randbytes(len(raw) - 8)
    return bytes(spoiled)


def fuzz(frame_format: CanFormat, frames: int, seed: int) -> int:
    """Push damaged frames among good ones; the readings made. The seed is in any failure."""
    try:
        return push_damaged(frame_format, frames, seed)
    except BaseException as error:
        error.add_note(f"seed {seed}, format {frame_format}, {frames} frames")
        raise


def push_damaged(frame_format: CanFormat, frames: int, seed: int) -> int:
    """Bursts of damage; after each, the last reading of three good sweeps must be the truth."""
    chance = random.Random(seed)
    made, counters = decoder(frame_format)
    clock = Clock(0)
    readings, pushed, sweep = 0, 0, 0
    while pushed < frames:
        raws = [pack_frame(frame) for frame in sweep_frames(frame_format, sweep % 500)]
        for _ in range(chance.randrange(1, 200)):
            pushed += 1
            clock.now_ns += chance.randrange(10) * 100_000
            frame = unpack_frame(damaged(chance.choice(raws), chance))
            if frame is None or frame.flags & (REMOTE | ERROR):
                continue
            readings += len(made.push(frame, clock.now_ns))
        if chance.random() < 0.1:
            made.interrupt()
        last: TactileReading | None = None
        # A damaged sequence number may make up to eight good sweeps look late, until time passes.
        if frame_format is CanFormat.SWEEP_FD or chance.random() < 0.5:
            clock.now_ns += 5_000_000_000
        for ahead in range(sweep + 1, sweep + 4):
            for frame in sweep_frames(frame_format, ahead % 500):
                clock.now_ns += 227_000
                for reading in made.push(frame, clock.now_ns):
                    last = reading
                    readings += 1
        assert last is not None, f"no reading after damage, frame {pushed}"
        assert not last.faults.any(), f"faults after damage, frame {pushed}"
        assert (last.counts == truth((sweep + 3) % 500)).all(), (
            f"wrong counts after damage, frame {pushed}"
        )
        sweep += 4
    assert counters.readings == readings
    return readings
