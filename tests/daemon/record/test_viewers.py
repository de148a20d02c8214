"""What viewers get of a recording: schemas that their parsers take, images, and a log."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.daemon.judge.exchange import Exchanged
from graspd.daemon.judge.reasons import Decision, GateState, Reason
from graspd.daemon.publish.companion import LoopEvent
from graspd.daemon.record.player import McapReplayDriver
from graspd.daemon.record.topics import TakenBack, Topic, flat, schemas
from graspd.daemon.record.viewers import INFO, SCALE, WARNING, Viewer
from graspd.daemon.trust.lift_book import GraspId
from graspd.models.layout import D1
from graspd.models.session_statistics import SessionState
from graspd.models.trust.learner import LearnerState
from tests.daemon.record.recorded import BOOT, files, recorder
from tests.daemon.watch.watch_fakes import tactile, verdict

PLAIN = ("boolean", "string", "number", "integer")


def faults(schema: dict[str, Any], where: str) -> Iterator[str]:
    """Yield what Lichtblick's `parseJsonSchema` refuses in a schema, and words unknown to it.

    `where`: name of the schema, or of the part, in the texts.
    """
    known = {"$schema", "title", "description", "type", "properties", "additionalProperties"}
    known |= {"required", "items", "enum", "contentEncoding"}
    known |= {"minimum", "maximum", "maxItems", "pattern"}
    yield from (f"{where}: {word}" for word in schema.keys() - known)
    kind = schema.get("type")
    if kind == "object":
        if "properties" not in schema:
            yield f"{where}: an object without properties"
        for name, inner in schema.get("properties", {}).items():
            yield from faults(inner, f"{where}.{name}")
        if isinstance(schema.get("additionalProperties"), dict):
            yield from faults(schema["additionalProperties"], f"{where}.*")
    elif kind == "array":
        if schema.get("items", {}).get("type") not in (*PLAIN, "object"):
            yield f"{where}: an array of {schema.get('items', {}).get('type')}"
        yield from faults(schema.get("items", {}), f"{where}[]")
    elif kind not in PLAIN:
        yield f"{where}: type {kind}"
    if schema.get("contentEncoding", "base64") != "base64":
        yield f"{where}: contentEncoding {schema['contentEncoding']}"


@pytest.mark.parametrize("topic", list(Topic))
def test_a_viewer_can_read_the_schema_of_every_topic(topic: Topic) -> None:
    name, text = schemas()[topic]
    assert name.count(".") == 1
    schema = json.loads(text)
    assert schema["type"] == "object"
    assert list(faults(schema, topic)) == []


def test_a_null_finger_state_is_recorded_as_unknown() -> None:
    told = {"fingers": {"ff": "slide", "mf": None}, "motion": {"ff": None}, "p_slip": None}
    assert flat(told) == {"fingers": {"ff": "slide", "mf": "unknown"}, "motion": {}}
    fields = json.loads(schemas()[Topic.VERDICT][1])["properties"]["fingers"]["properties"]
    assert fields["ff"] == {"type": "string", "enum": ["free", "touch", "slide", "unknown"]}


def reading(counts: NDArray[np.int64], faulty: tuple[int, ...] = ()) -> object:
    return json.loads(tactile(0, *counts.tolist(), faulty=faulty))


def open_hand(gate: GateState | None = GateState.IDLE) -> object:
    return json.loads(verdict(0, gate=gate))


def said(viewer: Viewer, kind: str, content: object) -> list[tuple[int, str, str]]:
    made = [json.loads(payload) for kind, payload in viewer.of(kind, content, 5) if kind == "log"]
    return [(line["level"], line["name"], line["message"]) for line in made]


def drawn(viewer: Viewer, content: object, wall_ns: int = 10**8) -> NDArray[np.uint8] | None:
    """Return the tactile image of a reading, shape (height, width, 3); None if none is drawn."""
    images = [
        json.loads(payload)
        for kind, payload in viewer.of("tactile", content, wall_ns)
        if kind == "image"
    ]
    if not images:
        return None
    (image,) = images
    assert (image["encoding"], image["step"]) == ("rgb8", 3 * image["width"])
    data = base64.b64decode(image["data"])
    whole = np.frombuffer(data, np.uint8).reshape(image["height"], image["width"], 3)
    small = whole[::SCALE, ::SCALE]
    assert np.array_equal(small.repeat(SCALE, 0).repeat(SCALE, 1), whole)
    return small


REST = np.full((2, 24), 2000)
DARK, YELLOW, CYAN, BLACK = (38, 44, 54), (252, 255, 190), (0, 220, 220), (0, 0, 0)


def test_only_the_pressed_electrodes_pixel_is_drawn_yellow() -> None:
    viewer = Viewer()
    said(viewer, "verdict", open_hand())
    for number in range(1, 30):
        still = drawn(viewer, reading(REST), number * 10**8)
    assert still is not None
    assert still.shape == (12, 2 * 11 + 1, 3)
    assert {tuple(one) for one in still[:, 12:].reshape(-1, 3).tolist()} == {DARK}
    assert {tuple(one) for one in still[:, 11].tolist()} == {BLACK}
    pressed = REST.copy()
    pressed[1, 6] = 300  # E7 of the thumb, 1700 counts below rest
    said(viewer, "verdict", open_hand(GateState.JUDGED))
    image = drawn(viewer, reading(pressed, faulty=(3,)), 30 * 10**8)
    assert image is not None
    assert tuple(image[D1.rows[6], 12 + D1.columns[6]]) == YELLOW
    assert tuple(image[D1.rows[3], D1.columns[3]]) == CYAN
    others = [(row, 12 + column) for row, column in zip(D1.rows, D1.columns, strict=True)]
    others.remove((D1.rows[6], 12 + D1.columns[6]))
    assert {tuple(image[pixel]) for pixel in others} == {DARK}


@pytest.mark.parametrize(
    ("times_ms", "drawn_ms"),
    [
        (range(0, 1000, 10), range(0, 1000, 100)),
        ((0, 105, 199, 200), (0, 105, 200)),  # a little late: the next is due as before
        ((0, 250, 349, 350), (0, 250, 350)),
        ((1000, 500, 599, 600), (1000, 500, 600)),  # the clock was set back
    ],
)
def test_at_most_ten_images_are_drawn_a_second(
    times_ms: Sequence[int], drawn_ms: Sequence[int]
) -> None:
    viewer = Viewer()
    made = {at: drawn(viewer, reading(REST), 10**18 + at * 1_000_000) for at in times_ms}
    assert [at for at, image in made.items() if image is not None] == list(drawn_ms)


@pytest.mark.parametrize(
    ("kind", "content"),
    [
        ("tactile", {}),
        ("tactile", {**json.loads(tactile(0, [2000] * 24)), "faults": 0}),
        ("tactile", {**json.loads(tactile(0, [2000] * 24)), "counts": [[1, 2]]}),
        *[(kind, {"grasp": "one"}) for kind in ("gate", "verdict", "outcome", "status", "joints")],
    ],
)
def test_a_malformed_message_gives_no_log_line_or_image(kind: str, content: object) -> None:
    assert list(Viewer().of(kind, content, 10**9)) == []


def test_a_verdict_is_logged_only_when_it_changes() -> None:
    viewer = Viewer()
    moving = json.loads(verdict(0, grasp=1, reasons=[Reason.MOVING]))
    (line,) = said(viewer, "verdict", moving)
    assert line[:2] == (INFO, "verdict")
    assert line[2].startswith("grasp 1: unknown (moving: fingers or object move")
    assert said(viewer, "verdict", moving) == []
    slip = json.loads(verdict(1, Decision.SLIP, grasp=1, p_slip=0.813))
    assert said(viewer, "verdict", slip) == [
        (WARNING, "verdict", "grasp 1: slip (slips with a probability of 81.3%)")
    ]
    assert said(viewer, "verdict", {**slip, "p_slip": 0.9}) == []


KNOWN = Exchanged(
    SessionState(weight=2.5, grasps=3, mean=(0.1, 1e-9), squares=(4.0, 0.0)),
    LearnerState(outcomes=4, mean=bytes(range(16)), covariance=b"\xff" * 32),
    proven=4,
)
ASKED, SKIPPED = Topic.ASKED, Topic.SKIPPED


@pytest.mark.parametrize(
    ("events", "recorded"),
    [
        ([ASKED, ASKED], [ASKED]),  # questions in a row are one
        ([ASKED, SKIPPED, ASKED], [ASKED, SKIPPED, ASKED]),
        ([ASKED, KNOWN, ASKED], [ASKED, KNOWN, ASKED]),
        ([TakenBack(BOOT, 1), TakenBack(BOOT, 2)], [TakenBack(BOOT, 1), TakenBack(BOOT, 2)]),
    ],
    ids=["in a row", "around a loss", "around an exchange", "taken back"],
)
def test_events_are_replayed_in_order_and_repeated_questions_once(
    tmp_path: Path, events: list[Topic | Exchanged | TakenBack], recorded: list[object]
) -> None:
    writing = recorder(tmp_path)
    for event in events:
        if isinstance(event, Exchanged):
            writing.exchanged(event)
        elif isinstance(event, TakenBack):
            writing.on_event(LoopEvent.TAKEN_BACK, GraspId(event.boot_id, event.grasp or 0))
        else:
            writing.on_event(LoopEvent(event))
    writing.send(b"tactile.right", tactile(0, *REST.tolist()))
    writing.close()
    found: list[object] = []
    with McapReplayDriver(files(tmp_path), ("th", "ff")) as driver:
        driver.on_event = found.append
        while not driver.exhausted:
            driver.read_ready()
        assert driver.counters.malformed == 0
    assert found == recorded
