"""`graspd run SCENE`: the daemon."""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

from daemon import assembly, scene
from daemon.publisher import Publisher, PublishError
from daemon.reporter import Reporter
from daemon.service import Service
from daemon.stop import StopSignal
from drivers.base import DriverError, RecordingError
from models.contract import ModelError

log = logging.getLogger("graspd")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("scene", type=Path, help="scene file (TOML)")


def run(args: argparse.Namespace) -> int:
    """Run until stopped; 0 after SIGINT, SIGTERM or the end of a recording."""
    try:
        _run(scene.load(args.scene))
    except (scene.SceneError, ModelError, RecordingError) as error:
        sys.stderr.write(f"graspd: {error}\n")
        return 2
    except (PublishError, DriverError) as error:
        sys.stderr.write(f"graspd: {error}\n")
        return 1
    return 0


def _run(wanted: scene.Scene) -> None:
    model = assembly.load_model(wanted)
    pipeline = assembly.build_pipeline(wanted, model)
    driver = assembly.build_driver(wanted)
    with (
        StopSignal() as stop,
        Publisher(wanted.endpoint, wanted.publish.high_water_mark) as publisher,
    ):
        reporter = Reporter(wanted.hand.name, model.contract.name, model.sha256, publisher)
        try:
            driver.open()
            log.info("verdict.%s on %s", wanted.hand.name, wanted.endpoint)
            Service(
                [driver],
                pipeline,
                reporter,
                stop,
                max_age_ns=wanted.max_age_ns,
                publisher=publisher,
            ).run()
        finally:
            driver.close()
