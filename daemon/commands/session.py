"""`graspd session show|reset|seed|settle SCENE`: kept calibration and learning."""

from __future__ import annotations

import argparse
import contextlib
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
from msgspec.structs import replace

from graspd.daemon import scene
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.plan import Plan, recorded_kind
from graspd.daemon.commands.arguments import add_reading
from graspd.daemon.judge.pipeline import Judgement, Pipeline
from graspd.daemon.judge.reasons import Reason
from graspd.daemon.process.text import complain, printable, write_json, write_lines
from graspd.daemon.run.replaying import trained_on
from graspd.daemon.run.unjudged import Unjudged
from graspd.daemon.scene import drivers as scene_drivers
from graspd.daemon.scene.scene import GateMode
from graspd.daemon.session.file import KeptSession, SessionFileError
from graspd.daemon.session.folder import ENDING, Found, SessionFolder, look
from graspd.daemon.session.keeper import continue_kept, newest_of_each
from graspd.daemon.trust.lift_book import GraspId, Lift, LiftBook
from graspd.daemon.trust.trust import Trust, TrustState
from graspd.drivers.base import Annotation, DriverError, JointReading, Reading, TactileReading
from graspd.drivers.recordings.kinds import Kind, files_of, kind_of_all
from graspd.models.contract import ModelError, SessionInput
from graspd.models.runtime import TactileModel
from graspd.models.session_statistics import SessionState


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    actions = parser.add_subparsers(
        dest="action", metavar="ACTION", required=True, help="what to do"
    )
    for action, text in (
        ("show", "say how many grasps are known, of which sensors, and what outcomes have taught"),
        ("reset", "forget the session and what was learned: after a sensor was refilled"),
        ("settle", "say how announced lifts ended whose outcome was never told"),
        ("seed", "start the session from recorded grasps; learn from those whose outcome is known"),
    ):
        command = actions.add_parser(action, help=text, description=f"{text[0].upper()}{text[1:]}.")
        command.add_argument("scene", type=Path, help="scene file (TOML)")
        if action == "show":
            command.add_argument("--json", action="store_true", help="one JSON object on stdout")
        if action == "settle":
            command.add_argument(
                "lifts", nargs="*", metavar="LIFT", help="names of open lifts; without any: all"
            )
            outcomes = "held", "slipped", "not-lifted"
            command.add_argument("--as", dest="told", choices=outcomes, help="how these ended")
        if action == "seed":
            command.add_argument(
                "recordings",
                nargs="+",
                type=Path,
                metavar="RECORDING",
                help="grasp tables or streams, or recordings with outcomes (MCAP): twenty grasps "
                "of different objects or more",
            )
            add_reading(command)


def run(args: argparse.Namespace) -> int:
    """Show, reset, seed or settle the kept session; return the exit code."""
    wanted = scene.load(args.scene)
    model = assembly.load_model(wanted)
    learns = wanted.learn.enabled or wanted.risk is not None
    if not (learns or isinstance(model.contract.input, SessionInput)):
        raise ModelError(f"the model {model.contract.name} keeps no session")
    named = wanted.session.folder is not None and wanted.session.keep is None
    if args.action != "show" and not (wanted.keeps_session or named):
        raise SessionFileError(
            f"{args.scene} keeps no session, and {wanted.session_path} may be that of a hand: "
            "say `[session] keep = true`"
        )
    if args.action == "show":
        return _show(wanted, model, as_json=args.json)
    if args.action == "settle":
        _settle(wanted, model, list(dict.fromkeys(args.lifts)), args.told)
    elif args.action == "reset":
        with SessionFolder(wanted.session_path).if_there() as folder:
            result = "forgotten" if folder.remove() else "no session was kept"
        write_lines(f"{printable(str(wanted.session_path))}: {result}")
    else:
        with files_of(args.recordings) as recordings:
            played = scene_drivers.ReplayTactile(
                driver="replay",
                recordings=tuple(path.absolute() for path in recordings),
                pace="fast",
                read_as=args.read_as,
                rate_hz=args.rate_hz,
            )
            _seed(wanted, model, played)
    return 0


def _show(wanted: scene.Scene, model: TactileModel, *, as_json: bool) -> int:
    """Show the kept sessions; return 2 if a file cannot be read, else 0."""
    path, found = wanted.session_path, look(wanted.session_path)
    sessions, calibrated = _continued(wanted, model, _readable(found))
    if isinstance(next(iter(found.values()), None), SessionFileError):
        calibrated = False  # the unreadable session may be of other sensors
    if as_json:
        documents = [
            {"file": f"{n}{ENDING}", **msgspec.to_builtins(one), "trust": _learned(one.trust)}
            for n, one in sessions.items()
        ]
        document = {
            "folder": str(path),
            "calibrated": calibrated,
            "session": documents[0] if documents else None,
            "others": documents[1:],
        }
        write_json(document)
    else:
        write_lines(*_lines(path, sessions, model, calibrated))
    return 2 if len(sessions) < len(found) else 0


def _readable(found: Found) -> dict[int, KeptSession]:
    """Return the sessions by file number; complain about each file that cannot be read."""
    for problem in found.values():
        if isinstance(problem, SessionFileError):
            complain(str(problem))
    return {number: kept for number, kept in found.items() if isinstance(kept, KeptSession)}


def _continued(
    wanted: scene.Scene, model: TactileModel, sessions: dict[int, KeptSession]
) -> tuple[dict[int, KeptSession], bool]:
    """Return the sessions, first the one that a start continues; True if it is then calibrated."""
    pipeline = assembly.build_pipeline(Plan.of(wanted), model)
    fingers, kept = tuple(wanted.hand.fingers), list(sessions.values())
    used, learned, problems = continue_kept(pipeline, fingers, newest_of_each(kept))
    for problem in problems:
        complain(problem)
    calibrated = pipeline.session is not None and pipeline.session.calibrated
    if used is None:
        mine = {n: each for n, each in sessions.items() if each.fingers == fingers}
        return mine | sessions, calibrated
    number = next(n for n, each in sessions.items() if each is used)
    first = replace(used, trust=None if learned is None else learned.trust)
    return {number: first} | {n: each for n, each in sessions.items() if n != number}, calibrated


def _lines(
    path: Path, sessions: Mapping[int, KeptSession], model: TactileModel, calibrated: bool
) -> Iterator[str]:
    if not sessions:
        yield f"{printable(str(path))}: no session is kept"
        return
    (newest, kept), *others = sessions.items()
    state, given = "", model.contract.input
    if isinstance(given, SessionInput):
        state = "calibrated" if calibrated else "not calibrated yet"
        state = f", {state} (from {given.calibrated_from:g} on)"
    yield f"{printable(str(path))}: {kept.grasps} grasps{state}"
    yield f"  saved    {_when(kept)}, {newest}{ENDING}"
    for number, each in others:
        names = ", ".join(" ".join((name, each.serials.get(name, "?"))) for name in each.fingers)
        what = f"{each.grasps} grasps of {printable(names)}"
        yield f"  other    {_when(each)}, {number}{ENDING}, {what}"
    for finger in kept.fingers:
        yield f"  {finger:8} sensor {printable(kept.serials.get(finger, 'of unknown serial'))}"
    learned = _learned(kept.trust)
    if learned is None:
        yield "  learned  nothing"
        return
    yield f"  learned  {learned['outcomes']} outcomes, by the model {learned['model'][:12]}"
    yield (
        f"  stable   {learned['lifts']} lifts reported, {learned['slips']} slipped, "
        f"{learned['outstanding']} outstanding, {learned['unreported']} never reported"
    )


def _when(kept: KeptSession) -> str:
    saved = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(kept.saved_at))
    return f"{saved}, {max(time.time() - kept.saved_at, 0.0) / 60.0:.0f} minutes ago"


def _learned(state: TrustState | None) -> dict[str, Any] | None:
    """Return model, risk, numbers of outcomes and lifts of a state as JSON; None: no state."""
    if state is None:
        return None
    return {
        "model": state.model,
        "outcomes": state.learner.outcomes,
        "told": {str(told): number for told, number in state.lifts.told.items()},
        "max_slip_when_stable": state.risk.max_slip_when_stable,
        "lifts": state.risk.lifts,
        "slips": state.risk.slips,
        "outstanding": sum(lift.is_outstanding for lift in state.lifts.records),
        "unreported": state.lifts.unreported,
        "proven": state.risk.proven,
    }


def _seed(wanted: scene.Scene, model: TactileModel, played: scene_drivers.ReplayTactile) -> None:
    """Replace the kept sessions of the hand's fingers by one of `played`. Raises `DriverError`."""
    mode: GateMode | None = "every" if kind_of_all(played.recordings) is Kind.MCAP else None
    plan = Plan.of(_on_recordings(wanted, played, mode))
    pipeline = assembly.build_pipeline(plan, model)
    session, trust = pipeline.session, pipeline.trust
    with SessionFolder(wanted.session_path) as folder:
        before = list(_readable(folder.load()).values())
        unjudged = Unjudged(complain, wanted.gate.fingers)
        judgements = _judge(plan, pipeline, unjudged)
        unjudged.end()
        readings = len(judgements)
        outcomes = 0 if trust is None else trust.learner.outcomes
        grasps, state = outcomes, None
        if session is not None:
            grasps, state = session.grasps, session.state()
            if not session.calibrated:
                raise DriverError(
                    f"{grasps} grasps of {readings} readings are too few, or they are not grasps"
                )
            _check(plan, model, state)
        elif not outcomes:
            raise DriverError(f"of {readings} readings none is a grasp whose outcome is known")
        rest = _rest(wanted, model, played)
        mine = [kept for kept in before if kept.fingers == tuple(wanted.hand.fingers)]
        if trust is None:  # the scene may learn again later
            learned = next((kept.trust for kept in mine if kept.trust is not None), None)
        else:
            learned = _taught(trust, proves=rest is not None)
        seeded = KeptSession(state, tuple(wanted.hand.fingers), {}, learned, rest)
        folder.save([seeded, *(kept for kept in before if kept not in mine)])
    write_lines(
        f"{printable(str(wanted.session_path))}: {grasps} grasps of {readings} readings taken in, "
        f"each once for as long as it was held, {outcomes} outcomes learned"
    )
    refused = Counter(
        reason for each in judgements if each.p_slip is None for reason in each.reasons
    )
    if refused:
        why = ", ".join(f"{reason} {count}" for reason, count in refused.most_common())
        write_lines(f"  nothing was learned from readings that were not judged: {why}")
    (known,) = trained_on(plan.layouts, [model])
    if known:
        which = ", ".join(known.values())
        complain(
            f"warning: the model was trained on {which}: it judges other grasps "
            "worse, so what these outcomes taught promises too much; better seed with other grasps"
        )


def _settle(wanted: scene.Scene, model: TactileModel, names: list[str], told: str | None) -> None:
    """Report how open lifts ended, in place of their controller; without `told` list them.

    `names`: the lifts; empty: all. `told`: their outcome. A lift announced before an exchange of
    sensors is open in the files of both sensors' sessions.
    """
    path, trust = wanted.session_path, assembly.build_pipeline(Plan.of(wanted), model).trust
    with SessionFolder(path).if_there() as folder:
        found = _readable(look(path))
        mine = {number: kept for number, kept in found.items() if kept.model == model.sha256}
        if trust is None or not mine:
            raise SessionFileError(f"{path}: no lifts are kept")
        known: dict[str, Lift] = {}
        for kept in mine.values():
            known = _restored_lifts(trust, kept, path) | known  # the last used file prevails
        lifts = [name for name, lift in known.items() if lift.is_awaited]
        if unknown := set(names).difference(lifts):
            raise SessionFileError(f"{', '.join(unknown)}: not open")
        if told is None:
            write_lines(f"{printable(str(path))}: {len(lifts)} lifts without outcome", *lifts)
            return
        for number, kept in mine.items():
            here = _restored_lifts(trust, kept, path)
            ended = [name for name in names or lifts if name in here and here[name].is_awaited]
            for name in ended:
                if told == "not-lifted":
                    trust.lifts.take_back(here[name].id)
                else:
                    trust.outcome(here[name].id, slipped=told == "slipped")
            if ended:
                folder.replace(number, replace(kept, trust=trust.state()))
    write_lines(f"{printable(str(path))}: {len(names or lifts)} lifts {told}")


def _restored_lifts(trust: Trust, kept: KeptSession, path: Path) -> dict[str, Lift]:
    """Restore kept learning into `trust`; return the lifts by name. Raises `SessionFileError`."""
    if kept.trust is None:
        return {}
    try:
        trust.restore(kept.trust)
    except ValueError as error:
        raise SessionFileError(f"{path}: what was learned {error}") from error
    lifts = trust.lifts.state().records
    return {f"{lift.id.boot_id[:8]}-{lift.id.grasp}": lift for lift in lifts}


def _taught(trust: Trust, *, proves: bool) -> TrustState:
    """Return the state learned from recorded outcomes. `proves`: they count for the warm-up.
    Their lifts are left out: the bound of `[risk]` counts only those of `stable` verdicts."""
    state = trust.state()
    risk = replace(state.risk, lifts=0, slips=0, proven=state.risk.proven if proves else 0)
    return replace(state, risk=risk, lifts=LiftBook().state())


def _rest(
    wanted: scene.Scene, model: TactileModel, recordings: scene_drivers.ReplayTactile
) -> tuple[float, ...] | None:
    """Return the resting count of each recorded electrode at the first tare; None: no tare."""
    played = Plan.of(_on_recordings(wanted, recordings, mode=None))
    pipeline = assembly.build_pipeline(played, model, learns=False)
    read_rest = pipeline.read_rest
    for reading in () if read_rest is None else _played(played):
        if isinstance(reading, TactileReading) and read_rest is not None:
            pipeline.judge(reading)
            rest = read_rest()
            if rest.any(axis=1).all():
                return tuple(rest.ravel().tolist())
    return None


def _check(plan: Plan, model: TactileModel, state: SessionState) -> None:
    """Raise `DriverError` if most judged readings are `never-seen` with the new session `state`."""
    pipeline = assembly.build_pipeline(plan, model, learns=False)
    if pipeline.session is not None:
        pipeline.session.restore(state)
    again = _judge(plan, pipeline, Unjudged(lambda _: None))
    unlike = sum(Reason.NEVER_SEEN in judgement.reasons for judgement in again)
    if 2 * unlike > len(again):
        trained = sum(file.rows for file in model.contract.datasets)
        raise DriverError(
            f"{unlike} of {len(again)} readings are unlike all grasps that {model.contract.name} "
            f"was trained on, which were {trained}: nothing is written"
        )


def _on_recordings(
    wanted: scene.Scene, recordings: scene_drivers.ReplayTactile, mode: GateMode | None
) -> scene.Scene:
    """Return the scene with recordings for sensors, gate `mode`, no joints, age limit or risk."""
    max_age_ms = assembly.NO_SILENCE_NS / 1e6  # a recorded reading is never late
    gate = wanted.gate.model_copy(update={"mode": mode, "max_age_ms": max_age_ms})
    changes = {"tactile": recordings, "joints": None, "gate": gate, "risk": None}
    return wanted.model_copy(update=changes)


def _judge(plan: Plan, pipeline: Pipeline, unjudged: Unjudged) -> list[Judgement]:
    """Return the judgements of readings that the gate passed; report known outcomes after each."""
    judgements: list[Judgement] = []
    for reading in _readings(plan):
        unjudged.on_reading(reading)
        if isinstance(reading, JointReading):
            pipeline.observe_joints(reading)
            continue
        judgement = pipeline.judge(reading)
        unjudged.add(judgement, reading.made_ns)
        if not judgement.moment.judged:
            continue
        judgements.append(judgement)
        slipped = None if reading.annotation is None else reading.annotation.slipped
        if slipped is not None:
            pipeline.outcome(GraspId(pipeline.boot_id, judgement.moment.grasp), slipped=slipped)
    pipeline.learn()
    return judgements


def _readings(plan: Plan) -> Iterator[Reading]:
    tactile = cast(scene_drivers.ReplayTactile, plan.scene.tactile)
    if recorded_kind(tactile) is Kind.MCAP:
        yield from _recorded_grasps(tactile.recordings, plan.scene.hand.fingers)
    else:
        yield from _played(plan)


def _played(plan: Plan) -> Iterator[Reading]:
    tactile = cast(scene_drivers.ReplayTactile, plan.scene.tactile)
    with contextlib.closing(assembly.player(plan, tactile, None, outcomes=True)) as driver:
        assembly.open_driver(driver)
        while not driver.exhausted:
            yield from driver.read_ready()


def _recorded_grasps(paths: Sequence[Path], fingers: Sequence[str]) -> Iterator[TactileReading]:
    """Yield the grasps with outcomes of MCAP files. Raises `SceneError`, `RecordingError`."""
    from graspd.daemon.record.export import collect

    export = collect(paths)
    if export.fingers != tuple(fingers):
        theirs, ours = ", ".join(export.fingers), ", ".join(fingers)
        raise scene.SceneError(f"{paths[0]}: is of the fingers {theirs}, the hand has {ours}")
    for number, grasp in enumerate(export.grasps.values(), 1):
        told = Annotation(paths[0], number, grasp.object_name, grasp.slipped)
        faults = np.zeros(grasp.counts.shape, dtype=np.uint8)
        yield TactileReading(time.monotonic_ns(), number, grasp.counts, faults, told)
