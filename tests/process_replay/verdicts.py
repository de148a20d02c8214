"""References of all verdicts on each stream: `references/<name>.jsonl`, one line for equal ones.

A line has `n`, how many verdicts it stands for, and the fields that differ from the line before it;
null means that the field is null or missing again.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache, partial
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, Final

from graspd.drivers.base import Reading
from graspd.drivers.recordings.csv_player import DEMO_DAY, DEMO_RECORDING
from tests.daemon.record.recorded import IGNORED_FIELDS
from tests.process_replay import streams
from tests.process_replay.commands import execute
from tests.process_replay.judging import Case, Message, run
from tests.process_replay.streams import WIRED

FOLDER: Final = Path(__file__).parents[1] / "references"
P_SLIP_TOLERANCE: Final = 1e-4
"""Largest difference of `p_slip`. Other processors add float32 in another order: 7e-7 measured."""
NEAR_THRESHOLD: Final = 1e-3
"""Distance of `p_slip` from the threshold within which `UNSURE_FIELDS` are not compared, since the
tolerance could turn them. The references name such an entry `near`."""
UNSURE_FIELDS: Final = frozenset({"verdict", "verdict_code"})
PROBABILITIES: Final = frozenset({"p_slip", "p_slip_model"})
LEFT_OUT: Final = IGNORED_FIELDS | {
    "v",
    "still_ms",
    "motion",
    "motion_limits",
    "model",
    "model_sha",
}
"""Fields that the references lack: those of versions and runs, and those that differ at every
reading, whose effect the verdict shows."""
RISK: Final = {"risk": {"max_slip_when_stable": 0.3, "warm_up": 4, "explore": 0.3}}
TWO_FINGERS: Final = ("ff", "th")

Entry = dict[str, Any]
"""Fields of a verdict, and `n`: number of equal verdicts in a row."""

CASES: Final[Mapping[str, Case]] = {
    "demo": Case(readings=streams.demo, joints=True),
    "twin_faults": Case(readings=streams.can),
    "spi_early": Case(readings=streams.spi, sections={"gate": {"early": True}}, readings_max=1500),
    "palm": Case(readings=streams.palm, joints=True, readings_max=1500),
    "request_risk": Case(
        readings=streams.demo,
        sections={"gate": {"mode": "request"}, **RISK},
        joints=True,
        asks=True,
        tells=True,
    ),
    "every_risk": Case(
        readings=partial(streams.recording, DEMO_DAY),
        sections={"tactile": {"driver": "replay", "recordings": [str(DEMO_DAY)]}, **RISK},
        tells=True,
    ),
    "cnn1_session": Case(
        readings=streams.demo, sections={"model": {"name": "cnn1-session"}}, readings_max=1500
    ),
    "two_fingers": Case(
        readings=partial(streams.recording, DEMO_RECORDING, TWO_FINGERS),
        sections={"hand": {"fingers": TWO_FINGERS}},
        joints=True,
        readings_max=1500,
    ),
    "slow": Case(readings=streams.demo, joints=True, slow=True),
}
"""Runs of the loop by name. `readings_max` counts joint readings too."""


def _serial_log(folder: Path) -> list[str]:
    sensors = f'driver = "spi"\nport = "none"\nsensors = {json.dumps(WIRED)}'
    return _link_log(folder, "serial", sensors, streams.spi)


def _can_log(folder: Path) -> list[str]:
    board = 'driver = "can"\nchannel = "can0"'
    return _link_log(folder, "log", board, streams.can)


def _link_log(
    folder: Path, ending: str, tactile: str, play: Callable[[BinaryIO], Iterator[Reading]]
) -> list[str]:
    path, scene = folder / f"link.{ending}", folder / "scene.toml"
    scene.write_text(f"[tactile]\n{tactile}\n[gate]\nearly = true\n")
    with path.open("wb") as log:
        for _ in play(log):
            pass
    return [str(path), "--scene", str(scene)]


REPLAYED: Final[Mapping[str, Callable[[Path], list[str]]]] = {
    "serial_log": _serial_log,
    "can_log": _can_log,
}
"""Functions that make a recording in a folder and return `graspd replay`'s arguments for it."""
NAMES: Final = (*CASES, *REPLAYED)


@cache
def played(name: str) -> tuple[Message, ...]:
    """Return all messages of a case; of a recording only the verdicts of `graspd replay`."""
    if name in CASES:
        return tuple(run(CASES[name]))
    with TemporaryDirectory() as folder:
        said = execute(["replay", *REPLAYED[name](Path(folder)), "--json"], Path(folder))
    return tuple(("verdict", line) for line in said.stdout.splitlines())


def judged(readings: Iterable[Reading], *, joints: bool) -> list[Entry]:
    """Return the verdicts of the default model and gate on readings; equal ones are one entry."""
    return entries_of(run(Case(readings=lambda: iter(readings), joints=joints)))


def entries_of(messages: Iterable[Message]) -> list[Entry]:
    """Return the verdicts among messages; equal ones in a row are one entry."""
    found: list[Entry] = []
    for kind, payload in messages:
        if kind == "verdict":
            fields: Entry = json.loads(payload)
            found.append(
                {
                    name: value
                    for name, value in fields.items()
                    if name not in LEFT_OUT and value is not None
                }
            )
    return [{"n": len(list(same)), **entry} for entry, same in groupby(found)]


def is_near(entry: Entry) -> bool:
    """Return True if `p_slip` is so near the threshold that another processor may differ."""
    p_slip = entry.get("p_slip")
    return p_slip is not None and abs(p_slip - 0.5) < NEAR_THRESHOLD


def path_of(name: str) -> Path:
    """Return the file of a reference."""
    return FOLDER / f"{name}.jsonl"


def made(name: str) -> str:
    """Return the text of a reference as it would be now."""
    lines, former = [], Entry()
    for entry in entries_of(played(name)):
        if is_near(entry):
            entry["near"] = True
        lines.append(json.dumps(_changes(former, entry)) + "\n")
        former = entry
    return "".join(lines)


def _changes(former: Entry, entry: Entry) -> Entry:
    gone = {name: None for name in former if name not in entry}
    return gone | {
        name: value for name, value in entry.items() if name == "n" or former.get(name) != value
    }


def parsed(text: str) -> list[Entry]:
    """Return the entries in the text of a reference."""
    found, former = [], Entry()
    for line in text.splitlines():
        fields = former | json.loads(line)
        former = {name: value for name, value in fields.items() if value is not None}
        found.append(former)
    return found


def reference(name: str) -> list[Entry]:
    """Return the entries of a reference, as last renewed."""
    return parsed(path_of(name).read_text())


def differences(before: str, now: str) -> list[str]:
    """Return where two texts of references differ, one line for each field."""
    return entries_apart(parsed(before), parsed(now))


def entries_apart(before: Sequence[Entry], now: Sequence[Entry]) -> list[str]:
    """Return where two lists of verdicts differ, one line for each field."""
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
    if name in PROBABILITIES and left is not None and right is not None:
        return math.isclose(left, right, rel_tol=0.0, abs_tol=P_SLIP_TOLERANCE)
    return bool(left == right)
