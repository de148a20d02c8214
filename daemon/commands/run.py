"""`graspd run SCENE`: the daemon."""

from __future__ import annotations

import argparse
import logging
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from daemon import assembly, scene
from daemon.binding import PublishError
from daemon.judge.pipeline import Pipeline
from daemon.publisher import Publisher
from daemon.reporter import Reporter
from daemon.service import Service
from daemon.stop import StopSignal
from daemon.text import complain
from drivers.base import Driver, DriverError, RecordingError
from models.contract import ModelError

if TYPE_CHECKING:
    from daemon.printer import Printer
    from daemon.questions import Questions
    from daemon.session_keeper import SessionKeeper

log = logging.getLogger("graspd")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("scene", type=Path, help="scene file (TOML)")
    parser.add_argument("--print", action="store_true", help="print every verdict, and a summary")


def run(args: argparse.Namespace) -> int:
    """Run until stopped; 0 after SIGINT, SIGTERM or the end of a recording."""
    try:
        with StopSignal() as stop:
            _run(scene.load(args.scene), _printer() if args.print else None, stop)
    except (scene.SceneError, ModelError, RecordingError) as error:
        complain(error)
        return 2
    except (PublishError, DriverError) as error:
        complain(error)
        return 1
    return 0


def _run(wanted: scene.Scene, printer: Printer | None, stop: StopSignal) -> None:
    model = assembly.load_model(wanted)
    pipeline = assembly.build_pipeline(wanted, model, learns=wanted.session_learns)
    drivers = assembly.build_drivers(wanted)
    with ExitStack() as stack:
        publisher = stack.enter_context(Publisher(wanted.endpoint, wanted.publish.high_water_mark))
        for driver in drivers:
            stack.callback(driver.close)
            assembly.open_driver(driver)
        log.info("verdict.%s on %s", wanted.hand.name, wanted.endpoint)
        kept = keeper(wanted, pipeline, drivers[0], stack)
        service = Service(
            drivers,
            pipeline,
            Reporter(wanted.hand.name, model.contract.name, model.sha256, publisher),
            stop,
            max_age_ns=wanted.max_age_ns,
            listener=printer.verdict if printer else None,
            chore=None if kept is None else kept.mind,
            questions=questions(wanted, stack),
        )
        try:
            service.run()
        finally:
            if kept is not None:
                kept.save()
            if printer is not None:
                printer.summary()


def _printer() -> Printer:
    from daemon.printer import Printer

    return Printer(as_json=False, prompt=True)


def questions(wanted: scene.Scene, stack: ExitStack) -> Questions | None:
    """Who takes questions; None if the scene takes none. Raises `PublishError`."""
    if wanted.ask_endpoint is None:
        return None
    from daemon.questions import Questions

    log.info("questions on %s", wanted.ask_endpoint)
    patience_ns = round(wanted.gate.request_ms * 1e6)
    return stack.enter_context(Questions(wanted.ask_endpoint, patience_ns))


def keeper(
    wanted: scene.Scene, pipeline: Pipeline, tactile: Driver, stack: ExitStack
) -> SessionKeeper | None:
    """Who keeps the session; None if model or scene need none, or if there is no place for it."""
    if pipeline.session is None or not wanted.keeps_session:
        return None
    from daemon.session_file import SessionFile, SessionFileError
    from daemon.session_keeper import SessionKeeper

    try:
        file = SessionFile(wanted.session_path)
    except SessionFileError as error:
        log.warning("%s; every start begins a new session", error)
        return None
    stack.callback(file.close)
    return SessionKeeper(
        pipeline.session,
        wanted.hand.fingers,
        tactile,
        file,
        on_exchange=pipeline.sensors_exchanged,
    )
