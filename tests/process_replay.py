"""Process replay: what is judged of known streams stays what it was, or a test says where not.

References stand in `tests/references`, one JSON Lines file per stream. Renew them, and look at what
`git diff` says, with

    python -m tests.process_replay --renew
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, Final, cast

import msgspec

from daemon import scene
from daemon.assembly import assembly
from daemon.judge.pipeline import Pipeline
from daemon.publish.outbox import Outbox
from drivers.base import JointReading, Reading
from drivers.can.decoders import make_decoder
from drivers.can.formats import CanFormat
from drivers.can.frames import CanFrame
from drivers.can.readings import CanCounters
from drivers.recordings.csv_player import DEMO_RECORDING, Pace, ReplayDriver
from drivers.twins.can import CanTwin
from drivers.twins.faults import LinkFaultInjector, LinkFaults
from drivers.twins.grasps.grasps import recorded_counts
from models.contract import Finger
from tests.daemon.record.recorded import IGNORED_FIELDS

FOLDER: Final = Path(__file__).parent / "references"
FINGERS: Final[tuple[Finger, ...]] = ("ff", "mf", "th")
P_SLIP_TOLERANCE: Final = 1e-4
"""Of `p_slip`: other processors add float32 in another order; measured 7e-7 at worst."""
NEAR_THRESHOLD: Final = 1e-3
"""From the threshold: what is so close to call is not compared as to `UNSURE_FIELDS`, since the
tolerance could turn it. The references name it `near`."""
UNSURE_FIELDS: Final = frozenset({"verdict", "verdict_code"})
LEFT_OUT: Final = IGNORED_FIELDS | {"v", "still_ms", "motion", "motion_limits"}
"""Fields that are of the run, what the format's own tests hold, and what differs at every reading
and shows in verdict and gate."""
FAULTS: Final = LinkFaults(
    bit_flip_probability=2e-4,
    drop_probability=2e-4,
    duplicate_probability=2e-4,
    dead_electrodes=((0, 6), (2, 15)),
    seed=7,
)
"""Of the CAN twin: two dead electrodes, and now and then a frame that is damaged or missing."""
PERIOD_NS: Final = 10_000_000
START_NS: Final = 10**12
SHOWN_MAX: Final = 5
"""Differences that are told; the rest only as a number."""

Entry = dict[str, Any]
"""Fields of a verdict, and `n`: how many readings in a row gave it."""


def streams() -> dict[str, Iterator[Reading]]:
    """The streams by the names of their references; each can be gone through once."""
    return {"demo": demo(), "twin_faults": twin_under_faults()}


def demo() -> Iterator[Reading]:
    """The synthetic demo recording, with joints."""
    with ReplayDriver([DEMO_RECORDING], FINGERS, pace=Pace.FAST, clock=lambda: START_NS) as driver:
        while not driver.exhausted:
            yield from driver.read_ready()


def twin_under_faults() -> Iterator[Reading]:
    """The same grasps from a CAN twin with `FAULTS`, decoded."""
    twin = CanTwin("virtual", "none", recorded_counts(DEMO_RECORDING), FINGERS, faults=FAULTS)
    injector = LinkFaultInjector(FAULTS)
    decoder = make_decoder(
        CanFormat.SYNTOUCH,
        FINGERS,
        counters=CanCounters(),
        arbitration_id=None,
        sequence="interleaved",
        data_length=None,
    )
    began_ns = START_NS
    while frames := twin.next_frames():
        for number, (arbitration_id, data) in enumerate(frames):
            t_ns = began_ns + PERIOD_NS * (number + 1) // len(frames)
            for spoilt in injector.spoil(data):
                yield from decoder.push(CanFrame(arbitration_id, spoilt), t_ns, t_ns)
        began_ns += PERIOD_NS


def judged(readings: Iterator[Reading], *, joints: bool) -> list[Entry]:
    """What the default model says of readings, with the default gate; equal ones put together."""
    now_ns = START_NS
    pipeline = _pipeline(lambda: now_ns, joints=joints)
    outbox = Outbox("right", FINGERS, "replay", "0" * 64, [])
    found: list[Entry] = []
    for reading in readings:
        now_ns = reading.t_ns
        if isinstance(reading, JointReading):
            pipeline.observe_joints(reading)
            continue
        verdict, _ = outbox.verdict(pipeline.judge(reading), now_ns, PERIOD_NS)
        fields = cast(Entry, msgspec.to_builtins(verdict))
        kept = {name: value for name, value in fields.items() if name not in LEFT_OUT}
        kept |= {"model": None, "model_sha": None}
        found.append({name: value for name, value in kept.items() if value is not None})
    return [{"n": len(list(same)), **entry} for entry, same in groupby(found)]


def _pipeline(clock: assembly.Clock, *, joints: bool) -> Pipeline:
    sections: dict[str, Any] = {
        "hand": {"fingers": FINGERS},
        "tactile": {"driver": "palm", "source": "udp://127.0.0.1:9870"},
        "joints": {"driver": "stream", "source": "udp://127.0.0.1:9871"},
    }
    if not joints:
        del sections["joints"]
    wanted = scene.parse(sections, Path("process replay"))
    return assembly.build_pipeline(wanted, assembly.load_model(wanted), clock)


def entries(name: str) -> list[Entry]:
    """What is judged now of the stream of this name."""
    found = judged(streams()[name], joints=name == "demo")
    return [entry | {"near": True} if is_near(entry) else entry for entry in found]


def is_near(entry: Entry) -> bool:
    """Whether a verdict is too close to call for another processor."""
    p_slip = entry.get("p_slip")
    return p_slip is not None and abs(p_slip - 0.5) < NEAR_THRESHOLD


def reference(name: str) -> list[Entry]:
    """What was judged when the references were renewed."""
    lines = (FOLDER / f"{name}.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


def differences(before: Sequence[Entry], now: Sequence[Entry]) -> list[str]:
    """Where two lists of verdicts differ, one line each."""
    found: list[str] = []
    for number, (was, is_now) in enumerate(zip(before, now, strict=False)):
        found += [
            f"{number}: {name}: {was.get(name)} became {is_now.get(name)}"
            for name in sorted(set(was) | set(is_now))
            if not _equal(name, was, is_now)
        ]
    if len(before) != len(now):
        found.append(f"{len(before)} entries became {len(now)}")
    return found


def _equal(name: str, was: Entry, is_now: Entry) -> bool:
    left, right = was.get(name), is_now.get(name)
    if name == "near" or (name in UNSURE_FIELDS and (is_near(was) or is_near(is_now))):
        return True
    if name == "p_slip" and left is not None and right is not None:
        return math.isclose(left, right, rel_tol=0.0, abs_tol=P_SLIP_TOLERANCE)
    return bool(left == right)


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare with the references, or renew them; 1 if something differs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--renew", action="store_true", help="write the references anew")
    args = parser.parse_args(arguments)
    code = 0
    for name in streams():
        now = entries(name)
        if args.renew:
            text = "".join(json.dumps(entry) + "\n" for entry in now)
            (FOLDER / f"{name}.jsonl").write_text(text)
            sys.stdout.write(f"{name}: {len(now)} entries\n")
            continue
        found = differences(reference(name), now)
        sys.stdout.writelines(f"{name}: {line}\n" for line in found[:SHOWN_MAX])
        sys.stdout.write(f"{name}: {len(found)} differences\n")
        code = code or int(bool(found))
    return code


if __name__ == "__main__":
    sys.exit(main())
