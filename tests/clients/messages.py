"""Verdict messages for the clients' tests: as deploy/wire/README.md has them, and broken ones."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from hypothesis import strategies as st

TOPIC = b"verdict.right"
MS = 1_000_000
MAX_AGE_NS = 100 * MS
"""Largest age of a reading that permits a lift, ns."""
RISK = {
    "target": 0.05, "lifts": 41, "slips": 2, "outstanding": 1, "bound": 6.1, "warm_up_left": 0,
    "announced": 40, "awaited": 1,
}  # fmt: skip
ADDED: dict[str, Any] = {
    "p_slip_model": 0.3, "outcomes": 57, "supervised": False, "risk": RISK,
    "early": False, "still_ms": 250.0, "motion": {"ff": 0.9, "th": None},
    "motion_limits": {"ff": 1.5, "th": 1.0}, "fingers": {"ff": "touch", "th": None},
}  # fmt: skip
"""Fields that older daemons leave out, with values for a verdict that is not unknown."""
TEACHES = ADDED | {"p_slip_model": None, "supervised": True, "reasons": ["unproven"]}
"""The same fields for an unknown verdict whose grasp may be lifted under supervision."""


def verdict(
    seq: int = 0,
    read_ns: int = 0,
    outcome: str = "stable",
    *,
    boot_id: str = "a",
    grasp: int = 1,
    age_ms: float = 1.0,
    silence_ms: float = 100.0,
    **more: Any,  # noqa: ANN401
) -> dict[str, Any]:
    """Return a verdict message on a reading at `read_ns`, of a daemon that lacks `ADDED`, with
    `more` fields."""
    known = outcome != "unknown"
    return {
        "v": 1,
        "boot_id": boot_id,
        "seq": seq,
        "t": 1.7e9,
        "t_mono_ns": read_ns,
        "grasp": grasp,
        "verdict": outcome,
        "verdict_code": {"unknown": 0, "stable": 1, "slip": 2}[outcome],
        "p_slip": 0.125 if known else None,
        "valid": known,
        "reasons": [] if known else ["moving"],
        "age_ms": age_ms,
        "latency_us": 300.0,
        "silence_ms": silence_ms,
        "model": "small-session",
        "model_sha": "0123456789ab",
        "of_a_later_version": [1.5],
        **more,
    }


def supervised(seq: int = 0, read_ns: int = 0) -> dict[str, Any]:
    """Return a verdict message of the warm-up: unknown, to be lifted while a person watches."""
    return verdict(seq, read_ns, "unknown", **TEACHES)


def frames(message: dict[str, Any]) -> list[bytes]:
    """Return the frames of a message as they come from the socket."""
    return [TOPIC, json.dumps(message).encode()]


@dataclass(frozen=True)
class Event:
    """The frames of a message that arrives, and the time that passes after it, ns."""

    frames: list[bytes]
    wait_ns: int


_anything = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 3),
    st.sampled_from([1e12, 1.1e12, 2**60, 2**60 + 1, 2**63, 2**64, -1]),
    st.floats(),
    st.sampled_from(["", "stable", "slip", "unknown", "b"]),
    st.lists(st.sampled_from(["moving", "", "x"]), max_size=2),
    st.dictionaries(st.just("x"), st.integers(0, 1)),
)


@st.composite
def _added(draw: st.DrawFn, known: bool) -> dict[str, Any]:
    """Draw the fields that newer daemons add, or some; `known`: for verdict `stable` or `slip`."""
    risk: dict[str, Any] = RISK | {"slips": draw(st.sampled_from([0, 2, 41, 42]))}
    if draw(st.booleans()):
        risk |= {draw(st.sampled_from(sorted(RISK))): draw(_anything)}
    if draw(st.integers(0, 4)) == 0:
        del risk[draw(st.sampled_from(sorted(RISK)))]
    found: dict[str, Any] = {
        "p_slip_model": draw(st.sampled_from([None, 0.3 if known else None, 0.3])),
        "outcomes": draw(st.integers(0, 99)),
        "supervised": draw(st.booleans()),
        "risk": draw(st.sampled_from([None, RISK, RISK, risk])),
        "early": draw(st.booleans()),
        "still_ms": draw(st.sampled_from([None, 0, 99.9, 100.0, 239.999999, 240, 500.5])),
        "motion": draw(st.sampled_from([None, {}, {"ff": 0.5}, {"mf": None, "ff": 3, "": 0.0}])),
        "motion_limits": draw(st.sampled_from([None, {}, {"ff": 1.5, "th": 2}])),
        "fingers": draw(st.sampled_from([None, {}, {"ff": "slide", "th": None}, {"": "free"}])),
        "owner": draw(st.sampled_from([None, "you", "another", "", 1])),
    }
    if not known:
        reasons = [["moving"], ["unproven"], ["low-confidence"], ["unproven", "moving"]]
        found["reasons"] = draw(st.sampled_from(reasons))
    return {name: found[name] for name in found if draw(st.integers(0, 9))}


@st.composite
def events(draw: st.DrawFn, broken: bool = True) -> list[Event]:
    """Draw messages that arrive one after another from 1 s on, from one clock; `broken`: some with
    a wrong or missing field."""
    now_ns = 1000 * MS
    seqs = {"a": 0, "b": 0, "c": 0}
    found = []
    for _ in range(draw(st.integers(1, 12))):
        boot_id = draw(st.sampled_from("aaaabc"))
        seqs[boot_id] += draw(st.sampled_from([1, 1, 1, 0, -1, 3]))
        seq = max(seqs[boot_id], 0)
        age_ms = draw(st.sampled_from([0, 1, 1, 1, 60, 120, 300]))
        behind_ns = draw(st.sampled_from([0, 0, 0, 30, 90, 110, -10])) * MS
        outcome = draw(st.sampled_from(["stable"] * 4 + ["slip", "unknown", "unknown"]))
        added = draw(_added(outcome != "unknown")) if draw(st.booleans()) else {}
        message = verdict(
            seq,
            max(now_ns - behind_ns - age_ms * MS, 0),
            outcome,
            boot_id=boot_id,
            grasp=draw(st.integers(1, 2)),
            age_ms=age_ms,
            silence_ms=draw(st.sampled_from([100, 100, 20])),
            **added,
        )
        sent = draw(_spoiled(message)) if broken and draw(st.booleans()) else frames(message)
        wait_ns = draw(st.sampled_from([0, 1, 10, 10, 40, 100, 101, 250])) * MS
        found.append(Event(sent, wait_ns))
        now_ns += wait_ns
    return found


@st.composite
def _spoiled(draw: st.DrawFn, message: dict[str, Any]) -> list[bytes]:
    """Draw the frames of the message with a field changed or missing.

    Wrong frames are in golden/refused.json.
    """
    name = draw(st.sampled_from([*verdict(), *ADDED]))
    if draw(st.integers(0, 3)):
        return frames(message | {name: draw(_anything)})
    return frames({key: value for key, value in message.items() if key != name})
