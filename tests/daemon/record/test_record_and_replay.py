"""Recordings can be judged again, bit for bit, and exported as grasp tables to learn from."""

from __future__ import annotations

import hashlib
import json
import zlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jsonschema
import jsonschema.validators
import msgspec
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from msgspec.structs import replace

from graspd import judge, read_recording
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.recordings import RecordedRun
from graspd.daemon.publish.messages import encode
from graspd.daemon.record.player import McapReplayDriver
from graspd.daemon.record.topics import TakenBack
from graspd.daemon.trust.lift_book import GraspId
from graspd.drivers.base import RecordingError
from graspd.models.training.data.datasets import read_table
from tests.daemon.record.recorded import compared, files, messages, without_null
from tests.daemon.record.test_export import Writer as Written
from tests.kit.inside import graspd, output, refused
from tests.process_replay.judging import Case, run
from tests.process_replay.streams import demo


@dataclass(frozen=True)
class Lab:
    """Recordings of a run, and the messages that it sent, each as kind and JSON."""

    files: list[Path]
    messages: list[tuple[str, str]]


def lab_of(folder: Path, **case: Any) -> Lab:  # noqa: ANN401
    """Judge the demo recording, with a controller that asks and reports outcomes; record it.
    `case`: other fields of `Case`."""
    sent = run(Case(readings=demo, joints=True, tells=True, asks=True, **case), folder / "record")
    return Lab(files(folder), sent)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    """A run of a model without a session, recorded in one file."""
    model = {"model": {"name": "cnn1"}}
    return lab_of(tmp_path_factory.mktemp("lab"), sections=model, readings_max=3000)


@pytest.fixture(scope="module")
def rotated(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    """A run of a session model on a slow computer; a file ends every 3 s, also amid a grasp."""
    sections = {
        "risk": {"max_slip_when_stable": 0.5, "warm_up": 2},
        "gate": {"max_age_ms": 97.0},  # no reading of the stepped clock is as old to the ns
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("graspd.daemon.record.recorder.ROTATE_NS", 3_000_000_000)
        patch.setattr("graspd.daemon.record.recorder.FLUSH_NS", 100_000_000)
        return lab_of(tmp_path_factory.mktemp("rotated"), sections=sections, slow=True)


def of_kind(path: Path, kind: str) -> list[dict[str, Any]]:
    return [content for which, content in messages(path) if which == kind]


def of_readings(path: Path) -> list[dict[str, Any]]:
    """Return the verdicts on readings, without those on silence, which repeat a reading's time."""
    found: dict[int, dict[str, Any]] = {}
    for verdict in of_kind(path, "verdict"):
        found.setdefault(verdict["t_mono_ns"], verdict)
    times = {reading["t_mono_ns"] for reading in of_kind(path, "tactile")}
    return [verdict for t_ns, verdict in found.items() if t_ns in times]


@cache
def again(*arguments: object) -> list[dict[str, Any]]:
    """Return the verdicts of `graspd replay --json` with `arguments`; the same ones run once."""
    return [json.loads(line) for line in output("replay", "--json", *arguments).splitlines()]


def test_a_recording_has_all_that_was_published_and_the_joints(lab: Lab) -> None:
    (path,) = lab.files
    kinds = [kind for kind, _ in messages(path)]
    sent = {kind for kind, _ in lab.messages} - {"answer"}
    assert set(kinds) == sent | {"joints", "judged", "image", "log", "asked"}
    assert kinds.count("tactile") == kinds.count("joints") == len(of_readings(path)) > 0
    published = [json.loads(content) for kind, content in lab.messages if kind == "verdict"]
    assert of_kind(path, "verdict") == [without_null(verdict) for verdict in published]
    last = of_kind(path, "status")[-1]
    assert last["drivers"]["record"]["dropped"] == last["drivers"]["record"]["lost"] == 0


def test_recorded_messages_are_as_their_schemas_say(lab: Lab) -> None:
    with lab.files[0].open("rb") as stream:
        seen: dict[str, int] = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            assert schema.encoding == "jsonschema"
            assert channel.message_encoding == "json"
            seen[channel.topic] = seen.get(channel.topic, 0) + 1
            if seen[channel.topic] % 100 == 1:  # the first of each topic, and some more
                jsonschema.validate(json.loads(message.data), json.loads(schema.data))
    assert set(seen) >= {"tactile.right", "joints.right", "verdict.right", "outcome.right"}


def test_a_run_on_a_slow_computer_replays_bit_for_bit(rotated: Lab) -> None:
    """Its readings are skipped, late, asked for and learned from, and its files rotate."""
    assert len(rotated.files) > 2
    before = [verdict for path in rotated.files for verdict in of_readings(path)]
    now = again(*rotated.files)
    assert [compared(v) for v in now] == [compared(v) for v in before]
    assert {verdict["outcomes"] for verdict in now} >= {0, 1, 2}
    assert {verdict["risk"]["warm_up_left"] for verdict in now} == {0, 1, 2}
    assert any(verdict["supervised"] for verdict in now)
    assert {"stale", "sequence-gap"} <= {why for verdict in now for why in verdict["reasons"]}


def filtered(source: Path, path: Path, *, metadata: bool = True, every: int = 1) -> Path:
    """Write a recording again as another tool does, and return its path.

    `metadata`: copy it too. `every`: keep only readings whose number is a multiple of it.
    """
    with source.open("rb") as stream, path.open("wb") as target:
        writer, reader = Writer(target), make_reader(stream)
        writer.start(profile="", library="another tool")
        for record in reader.iter_metadata() if metadata else ():
            writer.add_metadata(record.name, record.metadata)
        for schema, channel, message in reader.iter_messages():
            if channel.topic.startswith("tactile.") and message.sequence % every:
                continue
            kind = 0
            if schema is not None:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
            topic = writer.register_channel(channel.topic, channel.message_encoding, kind)
            writer.add_message(topic, message.log_time, message.data, message.publish_time)
        writer.finish()
    return path


def test_replay_reports_verdicts_that_differ_from_recorded_ones(lab: Lab, tmp_path: Path) -> None:
    whole = filtered(lab.files[0], tmp_path / "whole.mcap")
    assert "not those of the run" not in graspd("replay", whole).stderr
    path = filtered(lab.files[0], tmp_path / "part.mcap", every=3)
    assert "verdicts are not those of the run" in graspd("replay", path).stderr


def test_a_recording_without_metadata_is_judged_with_a_warning(
    lab: Lab, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As `mcap filter` leaves it: no metadata."""
    path = filtered(lab.files[0], tmp_path / "filtered.mcap", metadata=False)
    verdicts = list(judge(path, model="cnn1"))
    assert "has dropped the record `graspd`" in caplog.text
    assert "was judged by" not in caplog.text
    said = [verdict["p_slip"] for verdict in of_kind(lab.files[0], "verdict") if verdict["judged"]]
    assert [verdict.p_slip for verdict in verdicts if verdict.judged][:1] == said[:1]


@pytest.mark.filterwarnings("ignore:of 12 grasps 8 were not judged")
def test_the_library_judges_a_recording_as_a_replay_does(rotated: Lab) -> None:
    now = [json.loads(encode(verdict)) for verdict in judge(rotated.files)]
    assert [compared(v) for v in now] == [compared(v) for v in again(*rotated.files)]


def test_the_library_reads_counts_and_angles_of_a_recording(lab: Lab) -> None:
    table, readings = read_recording(lab.files[0]), of_kind(lab.files[0], "tactile")
    counts = [reading["counts"] for reading in readings]
    assert table.filter(like="_biotac_").to_numpy().tolist() == counts
    joints = of_kind(lab.files[0], "joints")
    assert len(table.columns) == 1 + 72 + len(joints[0]["names"])
    steps = [reading["t_mono_ns"] - readings[0]["t_mono_ns"] for reading in readings]
    assert ((table["t"] - table["t"][0]) * 1e9).tolist() == pytest.approx(steps, abs=1000)


def test_the_summary_of_a_replay_counts_recorded_outcomes(rotated: Lab) -> None:
    result = graspd("replay", "--json", *rotated.files)
    summary = json.loads(result.stderr.splitlines()[-1])
    told = [each for path in rotated.files for each in of_kind(path, "outcome")]
    assert summary["labelled"] == len(told) > 0
    assert summary["outcomes"] == max(v["outcomes"] for v in again(*rotated.files))
    assert graspd("replay", "--outcomes", *rotated.files).returncode == 2


def test_a_warning_names_a_file_after_a_gap(rotated: Lab, caplog: pytest.LogCaptureFixture) -> None:
    first, second, third = rotated.files[:3]
    recorded = RecordedRun([first, second, third])
    wanted = recorded.scene({}, {}, None)
    recorded.restore(recorded.parts(wanted, assembly.load_model(wanted), None).pipeline)
    assert not caplog.records
    RecordedRun([first, third])
    assert f"{third}: does not continue where the file before it ends" in caplog.text


def test_a_file_of_another_run_is_refused(rotated: Lab, tmp_path: Path) -> None:
    """Else its grasps are mistaken for those with the same numbers of the run before."""
    first, second = rotated.files[:2]
    other = tmp_path / "other.mcap"
    Written(other, boot_id="f" * 32).close()
    problem = f"{other}: is of another run than the file before it: replay each run alone"
    assert problem in refused("replay", first, second, other)
    with pytest.raises(RecordingError, match="is of another run"):
        list(judge([first, other]))


def test_a_replay_takes_back_the_same_lift_as_the_run(rotated: Lab) -> None:
    """Old recordings do not name the grasp; then it is the newest announced one."""
    run = RecordedRun(rotated.files[:1])
    wanted, boot_id = run.scene({}, {}, None), run.header.boot_id
    parts = run.parts(wanted, assembly.load_model(wanted), None)
    (driver,), book = parts.drivers, parts.pipeline.lifts
    assert isinstance(driver, McapReplayDriver)
    assert driver.on_event is not None
    for grasp in (1, 2, 3):
        book.note(GraspId(boot_id, grasp), b"", stable=True)
        book.announce()
    for event, awaited in ((TakenBack(boot_id, 1), [2, 3]), (TakenBack(), [2])):
        driver.on_event(event)
        assert [lift.id.grasp for lift in book.state().records if lift.is_awaited] == awaited


def test_learning_of_an_older_version_is_left_out_with_warning(
    rotated: Lab, caplog: pytest.LogCaptureFixture
) -> None:
    run = RecordedRun(rotated.files[1:2])
    state = {"version": 1, "model": run.header.model_sha256, "learner": {}}
    content = zlib.compress(msgspec.msgpack.encode(state))
    run.header = replace(run.header, trust=hashlib.sha256(content).digest() + content)
    recorded = run.scene({}, {}, None)
    pipeline = run.parts(recorded, assembly.load_model(recorded), None).pipeline
    run.restore(pipeline)
    assert pipeline.trust is not None
    assert pipeline.trust.learner.outcomes == 0
    assert "what was learned is of format 1; this graspd reads 2 and 3" in caplog.text
    assert f"{rotated.files[1]}: begins in the middle of a run" in caplog.text


def test_exported_grasps_are_judged_as_in_the_run(lab: Lab, tmp_path: Path) -> None:
    table = tmp_path / "lab.csv"
    result = graspd("export-grasps", *lab.files, "--out", table, "--object", "mug")
    assert result.returncode == 0, result.stderr
    ended = {content["grasp"]: content["outcome"] for content in of_kind(lab.files[0], "outcome")}
    grasps = read_table(table)
    assert grasps.slipped.tolist() == [outcome == "slip" for outcome in ended.values()]
    judged: dict[int, float] = {}
    wanted: dict[int, float] = {}
    for kind, content in messages(lab.files[0]):
        if kind == "verdict" and content["judged"]:
            judged[content["grasp"]] = content["p_slip_model"]
        if kind == "outcome":
            wanted.setdefault(content["grasp"], judged[content["grasp"]])
    found = [v["p_slip"] for v in again(table, "--model", "cnn1", "--gate", "every")]
    assert found == list(wanted.values())
