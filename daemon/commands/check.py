"""`graspd check SCENE`: is it right, what is in, what is left out."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from daemon import assembly, scene
from drivers.base import DriverError
from models.contract import ModelError
from models.runtime import TactileModel


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("scene", type=Path, help="scene file (TOML)")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")


def run(args: argparse.Namespace) -> int:
    """Check everything that can be checked without publishing; 0 if `graspd run` would start."""
    try:
        wanted = scene.load(args.scene)
        model = assembly.load_model(wanted)
        assembly.build_pipeline(wanted, model)
        _try_driver(wanted)
    except (scene.SceneError, ModelError, DriverError) as error:
        sys.stderr.write(f"graspd: {error}\n")
        return 2
    parts = {"in": _what_is_in(wanted, model), "left_out": _what_is_left_out(wanted)}
    if args.json:
        sys.stdout.write(json.dumps({"scene": str(args.scene), **parts}) + "\n")
        return 0
    sys.stdout.write(f"{args.scene}: fine\n")
    for title, entries in (("in", parts["in"]), ("left out", parts["left_out"])):
        sys.stdout.write(f"{title}\n")
        for key, value in entries.items():
            sys.stdout.write(f"  {key:9} {value}\n")
    return 0


def _try_driver(wanted: scene.Scene) -> None:
    driver = assembly.build_driver(wanted)
    try:
        driver.open()
    finally:
        driver.close()


def _what_is_in(wanted: scene.Scene, model: TactileModel) -> dict[str, Any]:
    tactile = wanted.tactile
    contract = model.contract
    measured = contract.measured
    return {
        "hand": f"{wanted.hand.name}: {', '.join(wanted.hand.fingers)}",
        "tactile": f"{tactile.driver}: {', '.join(map(str, tactile.recordings))}, {tactile.pace}",
        "model": (
            f"{contract.name} ({model.sha256[:12]}): F1 {100 * measured.f1_mean:.1f} +- "
            f"{100 * measured.f1_std:.1f} % ({measured.protocol}), slip from p_slip "
            f"{wanted.model.slip_threshold:g} on"
        ),
        "gate": f"{wanted.gate.mode} reading, not older than {wanted.gate.max_age_ms:g} ms",
        "publish": f"verdict.{wanted.hand.name}, status.{wanted.hand.name} on {wanted.endpoint}",
    }


def _what_is_left_out(wanted: scene.Scene) -> dict[str, Any]:
    left_out: dict[str, Any] = {"joints": "no joint readings are used"}
    without = [name for name in ("ff", "mf", "rf", "lf", "th") if name not in wanted.hand.fingers]
    if without:
        left_out["fingers"] = f"{', '.join(without)}: no channel in image or network"
    faults = wanted.tactile.faults
    if faults == type(faults)():
        left_out["faults"] = "none are injected"
    return left_out
