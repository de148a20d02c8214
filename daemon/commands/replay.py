"""`graspd replay [RECORDING...]`: judge recordings, print the verdicts and how good they were."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from graspd.biotac import TABLE_FINGERS
from graspd.daemon.assembly import assembly
from graspd.daemon.assembly.parts import Assembly, Parts
from graspd.daemon.assembly.plan import require_mcap
from graspd.daemon.assembly.sources import LINK_LOGS, LinkLogs, Source, Tables, model_keys
from graspd.daemon.commands.arguments import UsageError, add_reading, within
from graspd.daemon.judge.pipeline import Pipeline
from graspd.daemon.process.files import require_linux
from graspd.daemon.process.signals import StopSignal
from graspd.daemon.process.sleep import Sleep
from graspd.daemon.process.text import complain, printable
from graspd.daemon.publish import PublishError
from graspd.daemon.publish.companion import Companion
from graspd.daemon.run.day_table import PUBLISHED, DayTable
from graspd.daemon.run.loop import Loop, LoopTiming
from graspd.daemon.run.replaying import Controller, trained_on
from graspd.daemon.run.summary import Printer, trained_on_line
from graspd.daemon.run.unjudged import Unjudged
from graspd.daemon.scene import SceneError
from graspd.daemon.scene.endpoints import check_endpoint, is_private
from graspd.daemon.session import file as session_file
from graspd.drivers.base import RecordingError
from graspd.drivers.recordings.columns import SLIPPED
from graspd.drivers.recordings.csv_player import DEMO_DAY
from graspd.drivers.recordings.kinds import (
    BAGS,
    PAGE,
    Kind,
    files_of,
    kind_of_all,
    refuse_options,
)
from graspd.models import zoo
from graspd.models.bts3 import TABLES
from graspd.models.contract import ModelError
from graspd.models.runtime import TactileModel

WAIT_MAX_S = 3600
REPLAY_QUEUE = 1000
"""Most messages that wait for a subscriber. In a replay a late message is still useful."""
RUNNING, OFF = "running", "off"
DEMO_RISK = 0.05
DEMO_TITLE = "A day on which the sensors drift. All grasps are synthetic: no hand made them."
RISK_OPTIONS = ("max_slip_when_stable", "warm_up", "explore")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    pace = within(0.001, 1e6)
    parser.add_argument(
        "recordings",
        nargs="*",
        type=Path,
        metavar="RECORDING",
        help="grasp tables or streams (CSV, Parquet); what `graspd run` has recorded (MCAP); ROS "
        "bags; what came over a link (a CAN log, serial bytes); known by their content; all except "
        "bags may be packed by gzip; - is standard input; without any, the demo: a synthetic day, "
        "with --outcomes, --only-lifted and --max-slip-when-stable 0.05",
    )
    parser.add_argument(
        "--scene", type=Path, help="of a link log: the scene that says how to decode it"
    )
    parser.add_argument(
        "--model",
        help="name of a model, as `graspd models` lists them, or an .onnx file (default: "
        f"{assembly.DEFAULT_MODEL}; of an MCAP recording, the one that judged then)",
    )
    parser.add_argument(
        "--speed",
        type=pace,
        metavar="FACTOR",
        help="pace at this factor of real time (default: as fast as possible)",
    )
    add_reading(parser)
    parser.add_argument("--loop", action="store_true", help="start again at the end, for ever")
    parser.add_argument(
        "--strict", action="store_true", help="stop at the first value that is not a count"
    )
    parser.add_argument(
        "--session",
        default=RUNNING,
        metavar="HOW",
        help=f"what a session model is calibrated by: '{RUNNING}' (default) by the grasps as they "
        f"come, '{OFF}' by nothing, or the file of a kept session",
    )
    parser.add_argument(
        "--outcomes",
        action="store_true",
        help="of tables and streams: tell how each lift ended after its verdict, as a controller "
        "would; what graspd has recorded has its outcomes inside",
    )
    parser.add_argument(
        "--only-lifted",
        action="store_true",
        help="with --outcomes: only of lifts that a controller would make, which are those of "
        "`stable` verdicts and where supervision is asked for",
    )
    parser.add_argument(
        "--max-slip-when-stable",
        type=within(0.001, 0.5),
        metavar="SHARE",
        help="for tables and streams: largest share of `stable` lifts that may slip",
    )
    parser.add_argument(
        "--warm-up",
        type=int,
        metavar="N",
        help="with it: outcomes before which uncertain lifts are supervised (default: 50)",
    )
    parser.add_argument(
        "--explore",
        type=within(0.0, 1.0),
        metavar="SHARE",
        help="with it: grasps that are not `stable` to lift under supervision (default: 0.05)",
    )
    parser.add_argument(
        "--min-confidence",
        type=within(0.0, 0.999),
        metavar="P",
        help="of tables and streams: call less sure verdicts `unknown`",
    )
    parser.add_argument(
        "--gate",
        choices=("settled", "every"),
        help="judge each grasp once it has settled, or every reading as a grasp of its own "
        "(default: settled for streams, every for grasp tables, as then for MCAP recordings)",
    )
    parser.add_argument(
        "--publish", type=_endpoint, metavar="ENDPOINT", help="publish too, as `graspd run` does"
    )
    parser.add_argument(
        "--wait",
        type=within(0, WAIT_MAX_S),
        metavar="S",
        help="with --publish: wait up to S seconds for a subscriber, else fail",
    )
    parser.add_argument(
        "--json",
        action="store_true",
        help="verdict messages on stdout, summary in the last line on stderr",
    )
    parser.add_argument(
        "--verbose",
        action="store_true",
        help="of grasp tables with outcomes: a line for each verdict and all scores, in place of "
        "a line for 25 grasps",
    )


def run(args: argparse.Namespace) -> int:
    """Replay; return 0 at the end, 1 if nothing was judged or `--publish` failed, 128 + its number
    after a signal."""
    if args.wait is not None and args.publish is None:
        raise UsageError("--wait is for subscribers: it needs --publish")
    if args.publish is not None:
        require_linux("--publish")
    try:
        with StopSignal() as stop, files_of(args.recordings) as args.recordings:
            return _replay(args, stop)
    except RecordingError as error:
        if os.path.exists(error.path) or error.path.stem not in {table.name for table in TABLES}:
            raise
        raise UsageError(f"{error}; `graspd data` gets it") from error
    except PublishError as error:
        complain(error)
        return 1


def _replay(args: argparse.Namespace, stop: StopSignal) -> int:
    if not args.recordings:
        args.recordings = [DEMO_DAY]
        args.outcomes = args.only_lifted = True
        args.max_slip_when_stable = args.max_slip_when_stable or DEMO_RISK
    source = _source(args)
    parts = _parts(args, source)
    model, pipeline = parts.model, parts.pipeline
    shown: Printer | DayTable
    if _shows_table(args, source, parts):
        shown = _day_table(args, parts)
        told: list[Companion] = [shown]
    else:
        shown = Printer(as_json=args.json)
        if isinstance(source, Tables):
            (shown.result.trained_on,) = trained_on(parts.plan.layouts, [model])
        told = [shown]
    why = Unjudged(complain, parts.scene.gate.fingers)
    controller = Controller(only_lifted=args.only_lifted)
    if args.outcomes:
        told.append(controller)
    source.tell(shown)
    timing = LoopTiming(
        parts.scene.max_age_ns if isinstance(source, Tables) else assembly.NO_SILENCE_NS,
        sleep=Sleep(boot_clock=time.monotonic_ns),  # sleep does not age a recording
    )
    with ExitStack() as stack:
        around = Assembly(parts, stack)
        sockets = None
        if args.publish is not None:
            sockets = around.open_sockets(REPLAY_QUEUE)
        around.open_drivers()
        if sockets is not None and args.wait is not None:
            came = sockets.wait_for_subscriber(args.wait, stop)
            if not came and stop.received is None:
                where = f"{sockets.endpoint} within {args.wait:g} s"
                raise PublishError(f"no subscriber of {where}")
        companions = [*around.companions, *told, *source.companions(), why]
        loop = Loop(parts.drivers, pipeline, around.build_outbox(), stop, companions, timing)
        stack.callback(lambda: shown.summary(pipeline.trust))
        stack.callback(source.end)
        stack.callback(loop.close)
        stack.callback(controller.tell)
        loop.run()
        if stop.received is None:
            why.end(parts.drivers[0].counters)
    if stop.received is not None:
        return 128 + stop.received
    return 0 if why.judged else 1


def _shows_table(args: argparse.Namespace, source: Source, parts: Parts) -> bool:
    """Return True if the table that compares two methods is printed: for grasp tables with
    outcomes and a model of `ff`, `mf`, `th`, without `--json` and `--verbose`."""
    fingers = parts.model.contract.fingers
    if args.json or args.verbose or not isinstance(source, Tables) or fingers != TABLE_FINGERS:
        return False
    return parts.plan.mode == "every" and not parts.plan.without_outcomes


def _day_table(args: argparse.Namespace, parts: Parts) -> DayTable:
    model, published = parts.model, TactileModel(zoo.find(PUBLISHED))
    names = ", ".join(path.name for path in args.recordings)
    title = DEMO_TITLE if args.recordings == [DEMO_DAY] else f"Grasps of {printable(names)}."
    warnings = []
    known = trained_on(parts.plan.layouts, [model, published])
    for which, tables in zip(("the model", "the published network"), known, strict=True):
        if tables:
            warnings.append(trained_on_line(which, tables.values()))
    return DayTable(title, published, model.contract.name, warnings)


def _source(args: argparse.Namespace) -> Source:
    """Return the source that plays the recordings. Imports only modules for their kind."""
    kind = kind_of_all(args.recordings)
    given = {"--loop": args.loop, "--strict": args.strict, "--as": args.read_as}
    refuse_options(args.recordings[0], kind, given | {"--rate-hz": args.rate_hz})
    if args.scene is not None and kind not in LINK_LOGS:
        problem = f"is {kind.value}: --scene is for what came over a link"
        raise UsageError(
            f"{args.recordings[0]}: {problem}; {PAGE} lists the CAN logs that are read"
        )
    if kind is Kind.TEXT or kind in BAGS:
        return _tables(args)
    if args.outcomes or args.only_lifted or args.min_confidence is not None or _risk(args):
        raise UsageError(
            "what graspd has recorded is judged under its own risk: no --outcomes, --only-lifted, "
            "--max-slip-when-stable, --warm-up, --explore or --min-confidence"
        )
    if kind in LINK_LOGS:
        return LinkLogs(args.recordings, args.scene)
    require_mcap("replaying MCAP")
    from graspd.daemon.assembly.recordings import RecordedRun

    return RecordedRun(args.recordings)


def _tables(args: argparse.Namespace) -> Tables:
    """Return the tables, with the options of the command line for judging them."""
    if args.only_lifted and not args.outcomes:
        raise UsageError("--only-lifted says which outcomes are told: it needs --outcomes")
    if args.max_slip_when_stable and not args.outcomes:
        raise UsageError("--max-slip-when-stable rests on outcomes: it needs --outcomes")
    sections: dict[str, dict[str, Any]] = {}
    if args.min_confidence is not None:
        sections["model"] = {"min_confidence": args.min_confidence}
    if args.max_slip_when_stable is not None:
        sections["risk"] = _risk(args)
    elif _risk(args):
        raise UsageError("--warm-up and --explore need --max-slip-when-stable")
    return Tables(
        args.recordings,
        sections,
        read_as=args.read_as,
        rate_hz=args.rate_hz,
        loop=args.loop,
        strict=args.strict,
        outcomes=args.outcomes,
    )


def _risk(args: argparse.Namespace) -> dict[str, Any]:
    """Return the keys of `[risk]` that the command line sets, with their values."""
    given = {name: getattr(args, name) for name in RISK_OPTIONS}
    return {name: value for name, value in given.items() if value is not None}


def _parts(args: argparse.Namespace, source: Source) -> Parts:
    """Make the driver and the judge. Raises `SessionFileError` for a session of another hand."""
    chosen = {} if args.model is None else model_keys(args.model)
    wanted = source.scene({"endpoint": args.publish}, chosen, args.gate)
    learns = wanted.session.learn and args.session != OFF
    session = wanted.session.model_copy(update={"learn": learns})
    wanted = wanted.model_copy(update={"session": session})
    parts = source.parts(wanted, assembly.load_model(wanted), args.speed)
    for path in parts.plan.without_outcomes if args.outcomes else ():
        raise SceneError(f"{path}: no outcomes to tell: none is known in a column `{SLIPPED}`")
    if args.session not in (RUNNING, OFF) and parts.pipeline.session is None:
        raise ModelError(f"the model {parts.model.contract.name} keeps no session")
    _restore_session(args, source, parts.pipeline, wanted.hand.fingers)
    return parts


def _restore_session(
    args: argparse.Namespace, source: Source, pipeline: Pipeline, fingers: Sequence[str]
) -> None:
    """Restore the session that `--session` names: the recorded one, that of a file, or none."""
    if args.session == RUNNING:
        source.restore(pipeline)
    if args.session in (RUNNING, OFF) or pipeline.session is None:
        return
    session_file.restore(Path(args.session), fingers, pipeline.session)


def _endpoint(text: str) -> str:
    try:
        check_endpoint(text)
        if not is_private(text):
            raise ValueError("not a loopback address; anyone could listen")
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text}: {error}") from error
    return text
