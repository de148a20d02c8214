"""The wire: golden messages, the exported schema, and what a plotting tool can take."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import pytest

from daemon.commands.texts import schema_text
from daemon.judge.reasons import ADVICE, Decision, GateCause, GateState, Reason
from daemon.publish.messages import (
    GateMessage,
    LearnerHealth,
    Lifts,
    OutcomeMessage,
    State,
    Status,
    Tactile,
    Verdict,
    decode_gate,
    decode_outcome,
    decode_status,
    decode_tactile,
    decode_verdict,
    encode,
    schema,
)
from daemon.trust.lift_book import OutcomeStatus
from daemon.trust.trust import RiskReport

GOLDEN = Path(__file__).parent / "golden"
SCHEMA_FILE = Path(__file__).parents[3] / "deploy" / "wire" / "messages.schema.json"

BOOT = "0f0e0d0c0b0a09080706050403020100"
MESSAGES: dict[str, Verdict | GateMessage | Tactile | OutcomeMessage | Status] = {
    "verdict_stable": Verdict(
        boot_id=BOOT,
        seq=41,
        t=1790000000.25,
        t_mono_ns=123456789012345,
        grasp=42,
        verdict=Decision.STABLE,
        verdict_code=1,
        p_slip=0.03125,
        valid=True,
        reasons=[],
        age_ms=0.25,
        latency_us=250.0,
        silence_ms=100.0,
        model="cnn1",
        model_sha="0123456789ab",
    ),
    "verdict_slip": Verdict(
        boot_id=BOOT,
        seq=42,
        t=1790000000.5,
        t_mono_ns=123456799012345,
        grasp=43,
        verdict=Decision.SLIP,
        verdict_code=2,
        p_slip=0.96875,
        valid=True,
        reasons=[],
        age_ms=0.5,
        latency_us=500.0,
        silence_ms=100.0,
        model="cnn1",
        model_sha="0123456789ab",
    ),
    "verdict_unknown": Verdict(
        boot_id=BOOT,
        seq=43,
        t=1790000000.75,
        t_mono_ns=123456809012345,
        grasp=44,
        verdict=Decision.UNKNOWN,
        verdict_code=0,
        p_slip=None,
        valid=False,
        reasons=[Reason.PARITY, Reason.STALE],
        age_ms=150.5,
        latency_us=75.0,
        silence_ms=100.0,
        model="cnn1",
        model_sha="0123456789ab",
    ),
    "verdict_repaired": Verdict(
        boot_id=BOOT,
        seq=44,
        t=1790000000.875,
        t_mono_ns=123456819012345,
        grasp=45,
        verdict=Decision.STABLE,
        verdict_code=1,
        p_slip=0.25,
        valid=True,
        reasons=[],
        age_ms=0.5,
        latency_us=500.0,
        repaired=["ff_7", "th_24"],
        session_calibrated=False,
        silence_ms=100.0,
        model="small-session",
        model_sha="0123456789ab",
    ),
    "verdict_gated": Verdict(
        boot_id=BOOT,
        seq=45,
        t=1790000000.9375,
        t_mono_ns=123456829012345,
        grasp=3,
        verdict=Decision.SLIP,
        verdict_code=2,
        p_slip=0.75,
        valid=True,
        reasons=[],
        age_ms=0.5,
        latency_us=500.0,
        session_calibrated=True,
        judged=True,
        gate=GateState.JUDGED,
        contact=["ff", "mf", "th"],
        silence_ms=100.0,
        model="small-session",
        model_sha="0123456789ab",
        p_slip_model=0.5,
        outcomes=57,
        supervised=True,
        risk=RiskReport(target=0.0625, lifts=41, slips=2, outstanding=1, bound=8.5, warm_up_left=0),
        early=True,
        still_ms=130.0,
        motion={"ff": 1.25, "mf": 0.75, "th": 1.0},
        motion_limits={"ff": 1.5, "mf": 1.5, "th": 1.625},
    ),
    "gate": GateMessage(
        boot_id=BOOT,
        seq=11,
        t=1790000000.9375,
        t_mono_ns=123456829012345,
        grasp=3,
        former=GateState.SETTLED,
        state=GateState.JUDGED,
        cause=GateCause.JUDGED,
        still_ms=130.0,
        motion={"ff": 1.25, "mf": 0.75, "th": 1.0},
        motion_limits={"ff": 1.5, "mf": 1.5, "th": 1.625},
    ),
    "gate_moved": GateMessage(
        boot_id=BOOT,
        seq=12,
        t=1790000001.5,
        t_mono_ns=123457391512345,
        grasp=3,
        former=GateState.JUDGED,
        state=GateState.CLOSING,
        cause=GateCause.MOVED,
        still_ms=0.0,
        motion={"ff": 1.25, "mf": 12.5, "th": None},
        motion_limits={"ff": 1.5, "mf": 1.5, "th": 1.0},
    ),
    "tactile": Tactile(
        boot_id=BOOT,
        seq=5,
        t=1790000000.25,
        t_mono_ns=123456789012345,
        fingers=["ff", "th"],
        counts=[list(range(2000, 2024)), [4095, 0, *range(3000, 3022)]],
        faults=[[0] * 24, [0, 1, *[0] * 22]],
        joints={"FFJ3": 0.5},
    ),
    "outcome": OutcomeMessage(
        boot_id=BOOT,
        seq=1,
        t=1790000003.5,
        t_mono_ns=123459789012345,
        grasp=42,
        outcome="slip",
        object="mug",
    ),
    "status": Status(
        boot_id=BOOT,
        seq=7,
        t=1790000001.0,
        t_mono_ns=123456909012345,
        state=State.RUNNING,
        readings_hz=100.0,
        verdicts={Decision.STABLE: 1, Decision.SLIP: 1, Decision.UNKNOWN: 1},
        reasons={Reason.PARITY: 1, Reason.STALE: 1},
        drivers={"replay": {"readings": 3, "faulty_readings": 1, "missed_readings": 0}},
        repaired={"ff_7": 12},
        session_grasps=57,
        session_calibrated=True,
        gate=GateState.IDLE,
        tared=["ff", "th"],
        health={"ff_7": Reason.SATURATED, "mf": Reason.NOT_TARED},
        latency_us={"p50": 250.0, "p99": 500.0, "max": 500.0},
        jitter_us={"p50": 12.5, "p99": 250.0, "max": 1000.0},
        late_readings=3,
        worst_age_ms=12.25,
        skipped_readings=4,
        overloaded=False,
        lifts=Lifts(reported=41, outstanding=1, unreported=3),
        learner=LearnerHealth(
            enabled=True,
            outcomes=57,
            told={OutcomeStatus.TAKEN: 57, OutcomeStatus.CONTRADICTS: 1},
            uncertainty=0.5,
        ),
        model="cnn1",
        model_sha="0123456789ab",
        versions={"graspd": "0.1.0", "onnxruntime": "1.31.1", "python": "3.11.7"},
    ),
}


DECODE: dict[type, Callable[[bytes], object]] = {
    Verdict: decode_verdict,
    GateMessage: decode_gate,
    Tactile: decode_tactile,
    OutcomeMessage: decode_outcome,
    Status: decode_status,
}


def test_a_verdict_of_before_there_was_a_gate_or_a_learner_is_still_read() -> None:
    former = json.loads((GOLDEN / "verdict_stable.json").read_text())
    gate = ("judged", "gate", "contact", "repaired", "session_calibrated")
    stillness = ("early", "still_ms", "motion", "motion_limits")
    for added in (*gate, "p_slip_model", "outcomes", "supervised", "risk", *stillness):
        del former[added]
    assert decode_verdict(json.dumps(former).encode()) == MESSAGES["verdict_stable"]


def test_a_change_of_the_gate_of_before_motion_was_told_is_still_read() -> None:
    former = json.loads((GOLDEN / "gate.json").read_text())
    del former["still_ms"], former["motion"], former["motion_limits"]
    read = decode_gate(json.dumps(former).encode())
    assert (read.state, read.still_ms, read.motion) == (GateState.JUDGED, None, None)


def test_an_outcome_of_before_objects_were_told_is_still_read() -> None:
    former = json.loads((GOLDEN / "outcome.json").read_text())
    del former["object"]
    read = decode_outcome(json.dumps(former).encode())
    assert (read.grasp, read.outcome, read.object) == (42, "slip", None)


def test_a_status_of_before_there_was_a_learner_is_still_read() -> None:
    former = json.loads((GOLDEN / "status.json").read_text())
    del former["lifts"], former["learner"]
    read = decode_status(json.dumps(former).encode())
    assert (read.seq, read.lifts, read.learner) == (7, None, None)


@pytest.mark.parametrize(
    "name",
    ["", "a mug", "mug,cup", 'the "mug"', "mug's", "x" * 65, "m\u00fcg", "mug\n", "=1", "-", "a/b"],
)
def test_an_object_that_is_no_word_of_a_message_is_no_outcome(name: str) -> None:
    content = json.loads((GOLDEN / "outcome.json").read_text()) | {"object": name}
    with pytest.raises(msgspec.DecodeError):
        decode_outcome(json.dumps(content).encode())
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(content, schema() | {"$ref": "#/$defs/OutcomeMessage"})


@pytest.mark.parametrize("name", MESSAGES)
def test_golden_messages_are_written_and_read_as_committed(name: str) -> None:
    payload = (GOLDEN / f"{name}.json").read_bytes().rstrip(b"\n")
    message = MESSAGES[name]
    assert encode(message) == payload
    assert DECODE[type(message)](payload) == message


@pytest.mark.parametrize("name", MESSAGES)
def test_golden_messages_fit_the_exported_schema(name: str) -> None:
    validator = jsonschema.Draft202012Validator(json.loads(SCHEMA_FILE.read_text()))
    validator.validate(json.loads((GOLDEN / f"{name}.json").read_text()))


def test_the_committed_schema_is_the_one_of_the_code() -> None:
    assert SCHEMA_FILE.read_text() == schema_text()
    jsonschema.Draft202012Validator.check_schema(schema())


@pytest.mark.parametrize("name", MESSAGES)
def test_a_message_is_one_object_without_nan(name: str) -> None:
    def refuse(text: str) -> Any:  # noqa: ANN401 - the json module's own signature
        raise AssertionError(f"{text} on the wire")

    content = json.loads((GOLDEN / f"{name}.json").read_text(), parse_constant=refuse)
    assert isinstance(content, dict)
    assert content["v"] == 1


def test_a_probability_that_is_not_a_number_never_reaches_the_wire_as_one() -> None:
    broken = msgspec.structs.replace(MESSAGES["verdict_unknown"], p_slip=math.nan)
    assert json.loads(encode(broken))["p_slip"] is None


@pytest.mark.parametrize(
    "change",
    [
        {"v": 2},
        {"verdict": "maybe"},
        {"p_slip": 1.5},
        {"seq": -1},
        {"seq": "1"},
        {"reasons": ["because"]},
        {"verdict_code": 3},
    ],
)
def test_a_message_that_breaks_the_schema_is_refused_by_both(change: dict[str, Any]) -> None:
    content = json.loads((GOLDEN / "verdict_stable.json").read_text()) | change
    with pytest.raises(msgspec.ValidationError):
        decode_verdict(json.dumps(content).encode())
    validator = jsonschema.Draft202012Validator(
        json.loads(SCHEMA_FILE.read_text()) | {"anyOf": [{"$ref": "#/$defs/Verdict"}]}
    )
    assert not validator.is_valid(content)


def test_the_documentation_names_every_field_and_every_reason_with_its_advice() -> None:
    text = (SCHEMA_FILE.parent / "README.md").read_text()
    for reason in Reason:
        assert f"| `{reason}` | {ADVICE[reason]} |" in text
    for message in (Verdict, GateMessage, Tactile, OutcomeMessage, Status):
        for field in message.__struct_fields__:
            assert f"`{field}`" in text, field
    for name in (*GateState, *GateCause):
        assert f"| `{name}` |" in text, name


def test_a_reader_of_version_1_skips_fields_added_later() -> None:
    content = json.loads((GOLDEN / "verdict_stable.json").read_text()) | {"new_field": 1}
    assert decode_verdict(json.dumps(content).encode()) == MESSAGES["verdict_stable"]
