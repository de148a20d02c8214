"""`graspd report error-vs-time`: how wrong each model is against how long it takes, measured here.

Errors are those of the models' cards, measured on grasps that were left out; times are measured
now, all candidates in turns, because machines are shared and noisy: compare ratios.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from daemon.measure.error_vs_time import stages, tables
from daemon.measure.error_vs_time.picture import DEFAULT
from daemon.measure.error_vs_time.timing import Step, bandwidth_bytes_per_s, measure
from daemon.measure.reference.reference import Reference
from daemon.process.text import complain, progress
from models import zoo
from models.bts3 import FINGERS
from models.contract import Finger, ModelError
from models.runtime import TactileModel
from models.training.data.datasets import DatasetError, Grasps, read_all

READINGS, PACED = 2000, 300
QUICK_READINGS, QUICK_PACED, QUICK_GRASPS = 100, 5, 300
CONFIDENCE = 0.95
PEER_OF = {
    "published: loops, Keras predict": "cnn1",
    "PyTorch eager, CNN1": "cnn1",
    "scikit-learn predict_proba, svm": "svm",
    "scikit-learn predict_proba, mlp": "mlp",
    "scikit-learn predict_proba, rf": "rf",
}
"""Whose error a peer has: it computes the same."""
START = """
import sys, time
from pathlib import Path
import models.runtime
def resident():
    return int(next(l for l in open("/proc/self/status") if l.startswith("VmRSS")).split()[1])
before, began = resident(), time.perf_counter()
models.runtime.TactileModel(Path(sys.argv[1]))
print(1e3 * (time.perf_counter() - began), (resident() - before) / 1024)
"""


@dataclass(slots=True)
class Row:
    """One candidate."""

    name: str
    kind: str
    """`model`, `peer` or `floor`."""
    fingers: tuple[Finger, ...] = ()
    """That it judges; none for a floor."""
    error: dict[str, Any] = field(default_factory=dict)
    """By protocol: `f1` with `low` and `high` (95 %), accuracy, brier, ece; all in 0..1."""
    numerical: dict[str, Any] = field(default_factory=dict)
    """Against float64: `largest` and `mean` deviation of p_slip, `flipped`, `grasps`."""
    time: dict[str, float] = field(default_factory=dict)
    """Quantiles in us, as `timing.Times` has them."""
    sha256: str | None = None
    bytes: int | None = None
    parameters: int | None = None
    floor_us: float | None = None
    """Bytes of the file over the memory's bandwidth."""
    start_ms: float | None = None
    memory_mib: float | None = None
    """That the loaded model adds to the process."""


def run(args: argparse.Namespace) -> int:
    """Measure and write. Returns 0, or 2 if data, models or folder are wrong."""
    try:
        grasps = read_all(args.data)
        found = report(grasps, [zoo.ZOO, *args.models], quick=args.quick)
        args.out.mkdir(parents=True, exist_ok=True)
        tables.write(found, args.out)
    except (DatasetError, ModelError, OSError) as error:
        complain(error)
        return 2
    sys.stdout.write(json.dumps(found) + "\n" if args.json else tables.table(found) + "\n")
    return 0


def report(grasps: Grasps, folders: Sequence[Path], *, quick: bool = False) -> dict[str, Any]:
    """Everything that is known about all models of these folders, JSON-ready.

    Raises `ModelError` for a file that is no model or has no card.
    """
    if quick:
        chosen = np.linspace(0, len(grasps) - 1, min(QUICK_GRASPS, len(grasps)))
        grasps = grasps.rows(chosen.astype(np.int64))
    paths = [path for folder in folders for path in sorted(folder.glob("*.onnx"))]
    models = {path.stem: TactileModel(path) for path in paths}
    counts = {name: _counts(model, grasps) for name, model in models.items()}
    rows = {}
    for done, (name, model) in enumerate(models.items(), 1):
        progress(f"how exact is {name}, {done} of {len(models)}")
        rows[name] = _model_row(model, counts[name])
    progress("fitting the peers")
    steps: dict[str, Step] = {name: _step(model, counts[name]) for name, model in models.items()}
    _add_peers(rows, steps, grasps)
    readings, paced = (QUICK_READINGS, QUICK_PACED) if quick else (READINGS, PACED)
    times = measure(steps, readings, paced)
    progress("")
    bandwidth = bandwidth_bytes_per_s()
    for name, row in rows.items():
        row.time = times[name].quantiles()
        if row.bytes is not None:
            row.floor_us = row.bytes / bandwidth * 1e6
    default = DEFAULT if DEFAULT in models else next(iter(models))
    return {
        "machine": {"processor": _processor(), "python": platform.python_version()}
        | {package: version(package) for package in ("numpy", "onnxruntime")},
        "quick": quick,
        "readings": {"hot": readings, "paced": paced},
        "bandwidth_bytes_per_s": bandwidth,
        "stages": {
            "model": models[default].contract.name,
            "us": stages.measure(models[default], counts[default], readings),
        },
        "rows": [asdict(row) for row in rows.values()],
    }


def _counts(model: TactileModel, grasps: Grasps) -> NDArray[np.uint16]:
    """Counts (N, fingers, 24) of the model's own fingers."""
    try:
        return grasps.of_fingers(model.contract.fingers).counts
    except ValueError as error:
        raise ModelError(f"{model.path}: {error}") from error


def _model_row(model: TactileModel, counts: NDArray[np.uint16]) -> Row:
    card = _card(model.path)
    start_ms, memory_mib = _start(model.path)
    return Row(
        model.contract.name,
        "model",
        model.contract.fingers,
        error={name: _errors(figures) for name, figures in card["protocols"].items()},
        numerical=_numerical(model, counts),
        sha256=model.sha256,
        bytes=model.path.stat().st_size,
        parameters=card["parameters"],
        start_ms=start_ms,
        memory_mib=memory_mib,
    )


def _card(path: Path) -> dict[str, Any]:
    card_path = path.with_suffix(".json")
    try:
        content: dict[str, Any] = json.loads(card_path.read_bytes())
    except (OSError, ValueError) as error:
        raise ModelError(f"{card_path}: cannot read the card: {error}") from error
    return content


def _errors(figures: dict[str, Any]) -> dict[str, float]:
    """Figures of a protocol; the interval of F1 by Nadeau and Bengio's corrected t-test."""
    spreads, folds = figures["spreads"], figures["folds"]
    f1 = spreads["f1"]
    share = figures["test_grasps"] / figures["train_grasps"]
    error = f1["std"] * math.sqrt(1.0 / folds + share)
    reach = error * float(stats.t.ppf(0.5 + CONFIDENCE / 2.0, folds - 1))
    return {
        "f1": f1["mean"],
        "low": max(f1["mean"] - reach, 0.0),
        "high": min(f1["mean"] + reach, 1.0),
        **{name: spreads[name]["mean"] for name in ("accuracy", "brier", "ece")},
    }


def _numerical(model: TactileModel, counts: NDArray[np.uint16]) -> dict[str, Any]:
    """What rounding does, on real grasps: against the same file in float64."""
    try:
        reference = Reference(model.path)
    except ModelError as error:
        return {"why_not": str(error)}
    inputs, _ = model.inputs.build_batch(counts)
    exact = reference.probabilities(inputs)[:, 1]
    actual = np.empty(len(counts))
    for index, given in enumerate(inputs):
        model.input[...] = given
        actual[index] = model.run()[1]
    moved = np.abs(actual - exact)
    return {
        "largest": float(moved.max()),
        "mean": float(moved.mean()),
        "flipped": int(((actual >= 0.5) != (exact >= 0.5)).sum()),
        "grasps": len(counts),
    }


def _step(model: TactileModel, counts: NDArray[np.uint16]) -> Step:
    def step(index: int) -> None:
        model.inputs.build(counts[index % len(counts)], model.input)
        model.run()

    return step


def _add_peers(rows: dict[str, Row], steps: dict[str, Step], grasps: Grasps) -> None:
    from daemon.measure.error_vs_time.peers import empty_session, peers

    for name, step in peers(grasps):
        same = rows.get(PEER_OF[name])
        rows[name] = Row(name, "peer", FINGERS, error={} if same is None else same.error)
        steps[name] = step
    rows["empty session"] = Row("empty session", "floor")
    steps["empty session"] = empty_session()


def _start(path: Path) -> tuple[float, float]:
    """Time, ms, and memory, MiB, that loading a model takes in a process of its own."""
    command = [sys.executable, "-c", START, str(path)]
    try:
        result = subprocess.run(command, capture_output=True, check=True, text=True, timeout=60)
    except subprocess.SubprocessError as error:
        raise ModelError(f"{path}: cannot be loaded in a process of its own: {error}") from error
    start_ms, memory_mib = map(float, result.stdout.split())
    return start_ms, memory_mib


def _processor() -> str:
    return next(_processors(), platform.machine())


def _processors() -> Iterator[str]:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                yield line.partition(":")[2].strip()
    except OSError:
        return
