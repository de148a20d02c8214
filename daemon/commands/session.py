"""`graspd session show|reset|seed SCENE`: what the daemon knows of today's sensors."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec

from daemon import scene
from daemon.assembly import assembly
from daemon.judge.pipeline import Judgement, Pipeline
from daemon.judge.reasons import Reason
from daemon.process.text import complain, printable
from daemon.scene import drivers as scene_drivers
from daemon.session.file import KeptSession, SessionFile, SessionFileError, load
from drivers.base import DriverError, JointReading
from models.contract import ModelError, SessionInput
from models.runtime import TactileModel
from models.session_statistics import SessionState


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    for action, text in (
        ("show", "say how many grasps are known, of which sensors, since when"),
        ("reset", "forget the session: after a sensor was refilled or exchanged"),
        ("seed", "start the session from recorded grasps; needs no labels"),
    ):
        command = actions.add_parser(action, help=text, description=f"{text[0].upper()}{text[1:]}.")
        command.add_argument("scene", type=Path, help="scene file (TOML)")
        if action == "show":
            command.add_argument("--json", action="store_true", help="one JSON object on stdout")
        if action == "seed":
            command.add_argument(
                "recordings",
                nargs="+",
                type=Path,
                metavar="RECORDING",
                help="grasp tables (CSV): twenty grasps of different objects or more",
            )


def run(args: argparse.Namespace) -> int:
    """Do it. Returns 0, or 2 if scene, model, recording or the kept session is wrong."""
    try:
        wanted = scene.load(args.scene)
        model = assembly.load_model(wanted)
        if not isinstance(model.contract.input, SessionInput):
            raise ModelError(f"the model {model.contract.name} keeps no session")
        if args.action == "show":
            _show(wanted, model.contract.input, as_json=args.json)
        elif args.action == "reset":
            _reset(wanted)
        else:
            _seed(wanted, model, args.recordings)
    except (scene.SceneError, ModelError, DriverError, SessionFileError) as error:
        complain(error)
        return 2
    return 0


def _show(wanted: scene.Scene, needs: SessionInput, *, as_json: bool) -> None:
    path = wanted.session_path
    kept = load(path)
    if as_json:
        known = None if kept is None else msgspec.to_builtins(kept)
        calibrated = kept is not None and kept.statistics.grasps >= needs.calibrated_from
        document = {"file": str(path), "calibrated": calibrated, "session": known}
        sys.stdout.write(json.dumps(document) + "\n")
        return
    sys.stdout.write("\n".join(_lines(path, kept, needs)) + "\n")


def _lines(path: Path, kept: KeptSession | None, needs: SessionInput) -> Iterator[str]:
    if kept is None:
        yield f"{printable(str(path))}: no session is kept"
        return
    grasps = kept.statistics.grasps
    state = "calibrated" if grasps >= needs.calibrated_from else "not calibrated yet"
    yield f"{printable(str(path))}: {grasps} grasps, {state} (from {needs.calibrated_from:g} on)"
    saved = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(kept.saved_at))
    yield f"  saved    {saved}"
    for finger in kept.fingers:
        yield f"  {finger:8} sensor {printable(kept.serials.get(finger, 'of unknown serial'))}"


def _reset(wanted: scene.Scene) -> None:
    with SessionFile(wanted.session_path) as file:
        was_kept = file.remove()
    where = printable(str(wanted.session_path))
    sys.stdout.write(f"{where}: {'forgotten' if was_kept else 'no session was kept'}\n")


def _seed(wanted: scene.Scene, model: TactileModel, recordings: list[Path]) -> None:
    """Judge the recordings as the daemon does, and keep the session that comes out."""
    wanted = _on_recordings(wanted, recordings)
    pipeline = assembly.build_pipeline(wanted, model)
    session = pipeline.session
    if session is None:
        raise ModelError(f"the model {model.contract.name} keeps no session")
    with SessionFile(wanted.session_path) as file:
        read = len(_judge(wanted, pipeline))
        if not session.calibrated:
            raise DriverError(
                f"{session.grasps} grasps of {read} readings are too few, or they are no grasps"
            )
        _check(wanted, model, session.state())
        # Of which sensors they are is not known before the daemon hears from them.
        file.save(session.state(), wanted.hand.fingers, {})
    where = printable(str(wanted.session_path))
    sys.stdout.write(f"{where}: {session.grasps} grasps of {read} readings taken in\n")


def _check(wanted: scene.Scene, model: TactileModel, state: SessionState) -> None:
    """Raise `DriverError` if the session does not know its own recordings again."""
    pipeline = assembly.build_pipeline(wanted, model, learns=False)
    if pipeline.session is not None:
        pipeline.session.restore(state)
    again = _judge(wanted, pipeline)
    unlike = sum(Reason.NEVER_SEEN in judgement.reasons for judgement in again)
    if 2 * unlike > len(again):
        raise DriverError(f"{unlike} of {len(again)} readings are unlike all grasps")


def _on_recordings(wanted: scene.Scene, recordings: list[Path]) -> scene.Scene:
    """The scene with recordings in place of its sensors: tables are judged row by row."""
    replay = scene_drivers.ReplayTactile(
        driver="replay", recordings=tuple(path.absolute() for path in recordings), pace="fast"
    )
    gate = wanted.gate.model_copy(update={"mode": None, "sweeps": None})
    return wanted.model_copy(update={"tactile": replay, "joints": None, "gate": gate})


def _judge(wanted: scene.Scene, pipeline: Pipeline) -> list[Judgement]:
    """What is judged of the recordings, grasp by grasp."""
    (driver,) = assembly.build_drivers(wanted)
    judgements: list[Judgement] = []
    with contextlib.closing(driver):
        assembly.open_driver(driver)
        while not driver.exhausted:
            readings = driver.read_ready()
            for reading in readings:
                if isinstance(reading, JointReading):
                    pipeline.observe_joints(reading)
                else:
                    judgements.append(pipeline.judge(reading))
    return [judgement for judgement in judgements if judgement.judged]
