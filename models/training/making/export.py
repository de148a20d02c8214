"""Export a trained system to an ONNX file, and check that the daemon judges the same with it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray

from graspd.models import known_grasps
from graspd.models.contract import METADATA_KEY, ModelContract
from graspd.models.inputs import SessionBuilder, builder
from graspd.models.runtime import TactileModel
from graspd.models.training.estimators.graphs import Fitted
from graspd.models.training.evaluating.files import replacing
from graspd.models.training.fitting.standards import Standards

TOLERANCE = 1e-5
"""Largest allowed difference of a probability between the trained system and its file."""


class ExportError(Exception):
    """The exported file judges differently from the system: a bug; no file is written."""


@dataclass(frozen=True, slots=True)
class Parity:
    """Comparison of a file and its system on `grasps` grasps."""

    grasps: int
    largest_difference: float
    """Largest difference of a probability between file and trainer, before any rounding."""
    verdicts_flipped: int


def export(
    fitted: Fitted,
    temperature: float,
    contract: ModelContract,
    counts: NDArray[np.uint16],
    path: Path,
    standards: Standards | None = None,
) -> Parity:
    """Write `sigmoid(margin / temperature)` with its contract to `path`, one self-contained file.

    The same system and contract give the same bytes. The file has hashes of the training's counts
    (N, fingers, 24), and is first run as the daemon runs it on each of them; those of a session
    model are standardised by `standards` (N, features), or by its contract. Raises `ExportError` if
    a probability differs by more than `TOLERANCE` or a verdict flips, and leaves `path` as it was;
    `ModelError` if the contract does not fit.
    """
    model = fitted.to_onnx(temperature, builder(contract.input, len(contract.fingers)).name)
    known = known_grasps.as_text(known_grasps.hashes(counts))
    entries = {METADATA_KEY: contract.to_json(), known_grasps.METADATA_KEY: known}
    onnx.helper.set_model_props(model, entries)
    onnx.checker.check_model(model, full_check=True)
    with replacing(path) as part:
        part.write_bytes(model.SerializeToString(deterministic=True))
        parity = _compare(part, fitted, temperature, counts, standards)
        # Not written with "greater than", which would let a NaN pass.
        if not parity.largest_difference <= TOLERANCE or parity.verdicts_flipped:
            raise ExportError(
                f"the exported file differs from the system by {parity.largest_difference:.1e} "
                f"and flips {parity.verdicts_flipped} verdicts of {parity.grasps}"
            )
    return parity


def _compare(
    path: Path,
    fitted: Fitted,
    temperature: float,
    counts: NDArray[np.uint16],
    standards: Standards | None,
) -> Parity:
    model = TactileModel(path)
    inputs = np.empty((len(counts), *model.input.shape), dtype=np.float32)
    actual = np.empty(len(counts))
    for index, reading in enumerate(counts):
        if standards is not None and isinstance(model.inputs, SessionBuilder):
            model.inputs.use(standards.mean[index], standards.spread[index])
        model.inputs.build(reading, model.input)
        inputs[index] = model.input
        stable, actual[index] = model.run()
        if not abs(stable + actual[index] - 1.0) <= TOLERANCE:
            raise ExportError(f"probabilities sum up to {stable + actual[index]}")
    # The logistic function is written as a tanh, which cannot overflow.
    expected = 0.5 + 0.5 * np.tanh(0.5 * fitted.margins(inputs) / temperature)
    return Parity(
        grasps=len(counts),
        largest_difference=float(np.abs(actual - expected).max()),
        verdicts_flipped=int(((actual > 0.5) != (expected > 0.5)).sum()),
    )
