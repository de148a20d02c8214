"""The wire: golden messages, the exported schema, and what a plotting tool can take."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import pytest

from graspd.daemon.commands.texts import schema_text
from graspd.daemon.judge.reasons import ADVICE, GateState, Reason
from graspd.daemon.publish.messages import (
    MESSAGES,
    LearnerHealth,
    Lifts,
    RiskReport,
    decode_outcome,
    encode,
    schema,
)
from tests.kit.messages import GOLDEN, decode_verdict, golden

SCHEMA_FILE = Path(__file__).parents[3] / "deploy" / "wire" / "messages.schema.json"
NAMES = sorted(path.stem for path in GOLDEN.glob("*.json"))
"""Names of the golden messages, which begin with the kind of the message."""


@pytest.mark.parametrize(
    ("name", "added"),
    [
        ("verdict_stable", "judged gate contact repaired session_calibrated p_slip_model outcomes"),
        ("verdict_stable", "supervised risk early still_ms motion motion_limits fingers"),
        ("gate", "still_ms motion motion_limits"),
        ("outcome", "object"),
        ("status", "lifts learner"),
    ],
)
def test_a_message_without_fields_added_later_is_still_read(name: str, added: str) -> None:
    former = json.loads((GOLDEN / f"{name}.json").read_text())
    for field in added.split():
        del former[field]
    kind = MESSAGES[name.partition("_")[0]]
    read = msgspec.to_builtins(msgspec.json.decode(json.dumps(former), type=kind))
    assert former.items() <= read.items()


@pytest.mark.parametrize(
    "name",
    ["", "a mug", "mug,cup", 'the "mug"', "mug's", "x" * 65, "m\u00fcg", "mug\n", "=1", "-", "a/b"],
)
def test_an_outcome_with_a_malformed_object_name_is_refused(name: str) -> None:
    content = json.loads((GOLDEN / "outcome.json").read_text()) | {"object": name}
    with pytest.raises(msgspec.DecodeError):
        decode_outcome(json.dumps(content).encode())
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(content, schema() | {"$ref": "#/$defs/OutcomeMessage"})


@pytest.mark.parametrize("name", NAMES)
def test_golden_messages_are_read_and_written_as_committed(name: str) -> None:
    made, kept = encode(golden(name)), (GOLDEN / f"{name}.json").read_bytes()
    assert made == kept.rstrip(b"\n"), f"if that is meant, write {made.decode()} to {name}.json"


@pytest.mark.parametrize("name", NAMES)
def test_golden_messages_fit_the_exported_schema(name: str) -> None:
    validator = jsonschema.Draft202012Validator(json.loads(SCHEMA_FILE.read_text()))
    validator.validate(json.loads((GOLDEN / f"{name}.json").read_text()))


def test_the_committed_schema_is_the_one_of_the_code() -> None:
    assert SCHEMA_FILE.read_text() == schema_text(), f"graspd schema > {SCHEMA_FILE}"
    jsonschema.Draft202012Validator.check_schema(schema())


def test_a_probability_that_is_not_a_number_becomes_null() -> None:
    broken = msgspec.structs.replace(golden("verdict_unknown"), p_slip=math.nan)
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
def test_a_malformed_verdict_fails_decoding_and_schema_validation(change: dict[str, Any]) -> None:
    content = json.loads((GOLDEN / "verdict_stable.json").read_text()) | change
    with pytest.raises(msgspec.ValidationError):
        decode_verdict(json.dumps(content).encode())
    validator = jsonschema.Draft202012Validator(
        json.loads(SCHEMA_FILE.read_text()) | {"anyOf": [{"$ref": "#/$defs/Verdict"}]}
    )
    assert not validator.is_valid(content)


def fields_of(page: str, heading: str) -> set[str]:
    """Return the names in backticks before the colons of a section's list, and in its lines that
    begin with a backtick."""
    section = page.partition(f"{heading}\n")[2].partition("\n## ")[0]
    heads = re.findall(r"^- (`[^:]*`):|^(`.*)$", section, re.MULTILINE)
    return {name for head in heads for name in re.findall(r"`(\w+)`", "".join(head))}


def test_the_documentation_names_all_fields_and_reasons() -> None:
    text = (SCHEMA_FILE.parent / "README.md").read_text()
    for reason in Reason:
        assert f"- `{reason}`: {ADVICE[reason]}\n" in text
    nested: dict[str, list[type[msgspec.Struct]]] = {
        "verdict": [RiskReport],
        "status": [Lifts, LearnerHealth],
    }
    common = fields_of(text, "## Fields of several messages")
    for name, message in MESSAGES.items():
        described = fields_of(text, f"## `{name}.<hand>`")
        for part in (message, *nested.get(name, [])):
            known = described | (common if part is message else set())
            assert set(part.__struct_fields__) - known == set(), part
    gate = text.partition("## `gate.<hand>`")[2].partition("\n## ")[0]
    assert [state for state in GateState if f"- `{state}`: " not in gate] == []


def test_a_reader_of_version_1_skips_fields_added_later() -> None:
    content = json.loads((GOLDEN / "verdict_stable.json").read_text()) | {"new_field": 1}
    assert decode_verdict(json.dumps(content).encode()) == golden("verdict_stable")
